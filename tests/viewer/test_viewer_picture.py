"""From a moment, a camera and a look to a picture: no browser in it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from viewer_scene import FRAMES, HEIGHT, RADIUS, SIGMA, SPEED, frame, write_run

from gsfluent import geometry
from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.light.from_shot import clear_of
from gsfluent.pipeline.light.lamps import key_light
from gsfluent.pipeline.light.wetness import Wetness
from gsfluent.pipeline.render.stage import Picture, Render
from gsfluent.viewer.draw.picture import PictureMaker, browser_camera, hidden
from gsfluent.viewer.draw.splats import unit_size
from gsfluent.viewer.model import look
from gsfluent.viewer.model.color import distinct, splat_colors
from gsfluent.viewer.model.look import COLOR_BY, Cut, Look, angles, direction
from gsfluent.viewer.model.source import RunSource
from gsfluent.viewer.model.timeline import Timeline

LAST = FRAMES - 1


@pytest.fixture(scope="module")
def maker(tmp_path_factory: pytest.TempPathFactory) -> PictureMaker:
    out = write_run(tmp_path_factory.mktemp("run") / "ball")
    return PictureMaker(Timeline(RunSource(out), torch.device("cpu")))


def front(width: int, height: int, distance: float = 0.7) -> Camera:
    """A camera before the ball, on the side of -y."""
    eye, target = (0.0, -distance, HEIGHT), (0.0, 0.0, HEIGHT)
    return Camera.look_at(eye, target, width=width, height=height, fov=32.0)


def masks(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where it is green, where red."""
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return (g > r + 25) & (g > b + 25), (r > g + 50) & (r > b + 50)


@pytest.mark.parametrize("size", [(320, 160), (160, 320), (200, 200)])
def test_a_ball_is_round_and_of_the_right_size_in_every_window(
    maker: PictureMaker, size: tuple[int, int]
) -> None:
    distance = 0.7 if size[0] >= size[1] else 1.3  # the whole ball is in the picture
    given = front(*size, distance)
    # as the browser tells it: orientation, place and vertical angle
    turn = geometry.matrix_to_quaternion(given.viewmat[:3, :3].T[None])[0].numpy()
    camera = browser_camera(turn, given.center().numpy(), math.radians(32.0), size)
    torch.testing.assert_close(camera.viewmat, given.viewmat, atol=1e-6, rtol=0)
    torch.testing.assert_close(camera.K, given.K)
    green, _ = masks(maker.picture(0, camera, Look(floor=False)))
    rows, columns = np.nonzero(green.any(1))[0], np.nonzero(green.any(0))[0]
    high, wide = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert abs(high - wide) <= 2
    # the outline of a sphere: sin = radius / distance; splats are seen to 1.5 of their sigma
    expected = 2 * float(given.K[0, 0]) * math.tan(math.asin((RADIUS + 1.5 * SIGMA) / distance))
    assert wide == pytest.approx(expected, rel=0.1)


def test_following_the_object_is_moving_the_camera(maker: PictureMaker) -> None:
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    here = browser_camera(turn, np.array([0.1, 0.2, 0.3]), 0.5, (64, 48), (0.0, 0.0, 1.0))
    there = browser_camera(turn, np.array([0.1, 0.2, 1.3]), 0.5, (64, 48))
    torch.testing.assert_close(here.viewmat, there.viewmat)


def test_light_comes_from_where_it_is_set(maker: PictureMaker) -> None:
    camera = front(160, 160)
    sides = {}
    for name, azimuth in (("right", 0.0), ("left", 180.0)):
        light = key_light(direction=direction(azimuth, 10.0), ambient=0.3, intensity=0.9)
        picture = maker.picture(0, camera, Look(light=light)).astype(float)
        green, _ = masks(picture)
        x = np.nonzero(green)[1]
        values = picture[green].sum(1)
        sides[name] = values[x > 90].mean() / values[x < 70].mean()
    assert sides["right"] > 1.15 and sides["left"] < 1 / 1.15


def test_the_cut_opens_the_ball_and_the_other_side_leaves_the_rest(maker: PictureMaker) -> None:
    camera = front(160, 160)
    green, red = masks(maker.picture(0, camera, Look()))
    assert red.sum() == 0
    cut_green, cut_red = masks(maker.picture(0, camera, Look(cut=Cut(look.AXES["y"]))))
    # the plane is seen head on: a red disc of nine tenths of the ball, less what the skin covers
    core, whole = 0.9 * RADIUS, RADIUS + 1.5 * SIGMA
    share = math.sqrt(cut_red.sum() / green.sum())
    assert (core - 2.0 * SIGMA) / whole < share < core / whole
    assert cut_green.sum() + cut_red.sum() > 0.8 * green.sum()
    behind = maker.picture(0, camera, Look(cut=Cut((0.0, 1.0, 0.0))))
    assert masks(behind)[1].sum() == 0 and masks(behind)[0].sum() > 0.8 * green.sum()
    nothing = maker.picture(0, camera, Look(cut=Cut(look.AXES["y"], -1.0)))
    assert not masks(nothing)[0].any() and nothing.std() < 30


def test_every_point_is_hidden_on_exactly_one_side() -> None:
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    cut = Cut((0.3, -2.0, 0.4), 0.2)
    other = Cut((-0.3, 2.0, -0.4), -0.2)
    assert bool((hidden(points, cut, (0.1, 0, 0)) ^ hidden(points, other, (0.1, 0, 0))).all())


def test_pieces_have_one_colour_each_for_good(maker: PictureMaker) -> None:
    seen = {}
    for index in (3, LAST):
        moment = maker.timeline.frame(index)
        colors, legend = splat_colors(moment, maker.timeline, look.FRAGMENT)
        anchor = moment.anchor.long()
        left = (moment.fragments[anchor] >= 0) & (moment.velocity[anchor, 0] < 0)
        right = (moment.fragments[anchor] >= 0) & (moment.velocity[anchor, 0] > 0)
        assert legend is not None and legend.title.startswith("Fragments: 2")
        pair = [colors[side].unique(dim=0) for side in (left, right)]
        assert all(len(one) == 1 for one in pair)
        seen[index] = torch.cat(pair)
        # broken matter beside a piece has its hue, paler
        broken = (moment.damage[anchor] > 0) & (moment.velocity[anchor, 0] < 0)
        paler = seen[index][0].lerp(torch.ones(3), 0.4)
        torch.testing.assert_close(colors[broken], paler.expand(int(broken.sum()), 3))
    torch.testing.assert_close(seen[3], seen[LAST])
    assert float((seen[3][0] - seen[3][1]).abs().max()) > 0.3


def test_scales_end_where_the_legend_says(maker: PictureMaker) -> None:
    moment = maker.timeline.frame(LAST)
    whole = maker.timeline.frame(0)
    colors, legend = splat_colors(moment, maker.timeline, look.DAMAGE)
    assert legend is not None and legend.bar is not None
    for value, color in ((0.0, legend.bar[0]), (1.0, legend.bar[-1])):
        found = colors[moment.damage[moment.anchor.long()] == value]
        torch.testing.assert_close(found, torch.tensor(color).float().expand_as(found))
    # 0.6 m/s on a scale to 1 m/s, and nothing moves at first
    colors, legend = splat_colors(moment, maker.timeline, look.SPEED)
    assert legend is not None and legend.ticks == ("0", "0.5", "1")
    expected = torch.tensor(legend.bar[round(255 * SPEED)]).float()
    torch.testing.assert_close(colors, expected.expand_as(colors), atol=0.02, rtol=0)
    colors, _ = splat_colors(whole, maker.timeline, look.SPEED)
    torch.testing.assert_close(colors, torch.tensor(legend.bar[0]).float().expand_as(colors))
    # half the square of the speed: 0.18 J/kg on a logarithmic scale of four decades to 0.2
    colors, legend = splat_colors(moment, maker.timeline, look.ENERGY)
    assert legend is not None and legend.ticks[-1] == "0.2"
    row = round(255 * (1 + math.log10(0.5 * SPEED**2 / 0.2) / 4))
    torch.testing.assert_close(
        colors, torch.tensor(legend.bar[row]).float().expand_as(colors), atol=0.03, rtol=0
    )


def test_depth_is_the_distance_to_the_skin_and_stays_with_the_matter(maker: PictureMaker) -> None:
    first, last = maker.timeline.frame(0), maker.timeline.frame(LAST)
    depth = maker.timeline.depth(last)
    below = RADIUS - (first.positions - torch.tensor([0.0, 0.0, HEIGHT])).norm(dim=1)
    # the skin's splats are 9 mm apart
    torch.testing.assert_close(depth, below, atol=0.006, rtol=0)


def test_splats_without_matter_are_grey_and_unknown_colours_refused(maker: PictureMaker) -> None:
    moment = frame(0)
    moment.anchor[:7] = -1
    colors, _ = splat_colors(moment, maker.timeline, look.MATERIAL)
    torch.testing.assert_close(colors[:7], torch.tensor(distinct(-1)).expand(7, 3))
    assert float((colors[7:] - colors[0]).abs().amax(1).min()) > 0.1
    with pytest.raises(ValueError, match="color_by"):
        splat_colors(moment, maker.timeline, "Taste")


def test_liquids_rigid_things_and_wet_skin_are_drawn_as_in_the_film(
    maker: PictureMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the film hands to the picture stage the viewer does, too, and cuts it with the rest."""
    moment = frame(1)
    count = moment.gaussians.count
    # a hundred splats of the skin are water, seven a blade's
    moment.ids[:100] = -1 - torch.arange(100)
    moment.anchor[100:107] = -1
    moment.body[moment.anchor[:100].long()] = 1
    moment.facts["bodies"] = [["ball", "wood"], ["pool", "water"]]
    monkeypatch.setattr(maker.timeline, "frame", lambda index: moment)
    monkeypatch.setattr(maker, "_wetness", Wetness(lambda index: moment, clear_of))
    asked: dict[str, torch.Tensor] = {}

    def seen(self: Render, gaussians: Gaussians, camera: Camera, **given: object) -> Picture:
        asked.update(given)  # type: ignore[arg-type]
        return drawn(self, gaussians, camera, **given)  # type: ignore[arg-type]

    drawn = Render.forward
    monkeypatch.setattr(Render, "forward", seen)
    maker.picture(1, front(32, 24), Look())
    assert asked["rigid"].nonzero()[:, 0].tolist() == list(range(100, 107))
    liquid = asked["clear"]
    assert torch.equal(liquid.rows, clear_of(moment).rows) and bool(liquid.rows[:100].any())
    assert 0.0 < float(asked["wet"].mean()) < 0.5
    # colours that tell something are not looked through
    maker.picture(1, front(32, 24), Look(look.MATERIAL))
    assert asked["clear"] is None and asked["wet"] is None
    kept = maker.splats(moment, Look(cut=Cut((0.0, -1.0, 0.0), 0.0)))
    rows = kept.gaussians.count
    assert kept.liquid is not None and kept.wet is not None and rows < count
    assert kept.liquid.rows.shape == kept.wet.shape == kept.rigid.shape == (rows,)
    assert kept.liquid.volume.shape[0] == int(kept.liquid.rows.sum()) < 100


@pytest.mark.parametrize("name", COLOR_BY)
def test_every_choice_makes_a_picture_and_a_legend(maker: PictureMaker, name: str) -> None:
    picture, legend = maker.picture_and_legend(LAST, front(64, 48), Look(name))
    assert picture.shape == (48, 64, 3) and picture.dtype == np.uint8 and picture.std() > 5
    if name == look.APPEARANCE:
        assert legend is None
    else:
        assert legend is not None and legend.title in legend.html().replace("&amp;", "&")


def test_colours_of_many_pieces_stay_apart() -> None:
    colors = torch.tensor([distinct(number) for number in range(24)])
    apart = torch.cdist(colors, colors) + 9 * torch.eye(24)
    assert float(apart.min()) > 0.08


def test_angles_and_directions_are_inverse() -> None:
    for azimuth, elevation in ((-170.0, 10.0), (35.0, 80.0), (0.0, -20.0)):
        assert angles(direction(azimuth, elevation)) == pytest.approx((azimuth, elevation))


def test_splats_survive_the_browsers_half_precision() -> None:
    gaussians = frame(0).gaussians
    tiny = gaussians.replace(scales=gaussians.scales * 0.01, means=gaussians.means * 10.0)
    centers, covariances, size = unit_size(tiny)
    assert float(tiny.covariances().half().abs().max()) < 1e-8  # what would arrive otherwise
    arrived = covariances.half().float() * size**2
    truth = torch.diag_embed(tiny.scales**2)
    torch.testing.assert_close(arrived, truth, rtol=1e-3, atol=1e-12)
    torch.testing.assert_close(centers * size, tiny.means)
