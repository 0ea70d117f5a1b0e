"""Render: light, shadow, floor, normals, holes, cameras, each on something of known look."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gsfluent.data import INTERIOR, SURFACE, Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.lab.truth import light as truth
from gsfluent.pipeline.light.lamps import Lamp, Lighting, key_light, pack_lamps, studio_light
from gsfluent.pipeline.light.normals import (
    estimate_normals,
    grid_for,
    plate_normals,
    splat_normals,
)
from gsfluent.pipeline.light.occlusion import ambient_occlusion
from gsfluent.pipeline.light.shade import shade_points, surface_points, to_display, to_linear
from gsfluent.pipeline.light.shadow import transmittance
from gsfluent.pipeline.light.shadow_maps import bulk, shadow_maps
from gsfluent.pipeline.render.camera import Action, cameras_for, orbit
from gsfluent.pipeline.render.holes import Holes, MatterView, small
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio, wants_dark

SIZE = 96


def ball(
    radius: float = 0.1,
    *,
    center: tuple[float, float, float] = (0.0, 0.0, 0.1),
    spacing: float = 0.008,
) -> Gaussians:
    """A solid grey ball of isotropic splats on a lattice."""
    axis = torch.arange(-radius, radius + spacing, spacing)
    points = torch.cartesian_prod(axis, axis, axis)
    points = points[points.norm(dim=1) <= radius] + torch.tensor(center)
    scales = torch.full((points.shape[0],), 0.6 * spacing)
    return Gaussians.from_colors(points, scales, torch.full_like(points, 0.5), opacities=0.9)


def front(distance: float = 1.0, height: float = 0.1) -> Camera:
    return Camera.look_at(
        (0.0, -distance, height), (0.0, 0.0, height), width=SIZE, height=SIZE, fov=20.0
    )


def brightness(image: Tensor, row: int, column: int) -> float:
    return float(image[row - 2 : row + 3, column - 2 : column + 3].mean())


def test_without_light_the_captured_colour_stays() -> None:
    image = Render(front(), background=(0.0, 0.0, 0.0))(ball()).image
    assert brightness(image, SIZE // 2, SIZE // 2) == pytest.approx(0.5, abs=0.01)


def test_default_light_is_mild_where_it_falls() -> None:
    light = key_light(direction=(0.0, -1.0, 0.0), shadow=False)
    image = Render(front(), light)(ball()).image
    assert brightness(image, SIZE // 2, SIZE // 2) == pytest.approx(0.5, rel=0.12)


def test_side_light_brightens_the_lit_side_only() -> None:
    light = key_light(direction=(1.0, 0.0, 0.0), ambient=0.3, intensity=0.8, shadow=False)
    image = Render(front(), light)(ball()).image
    offset = SIZE // 5
    lit = brightness(image, SIZE // 2, SIZE // 2 + offset)
    dark = brightness(image, SIZE // 2, SIZE // 2 - offset)
    # the dark side sees ambient light alone: 0.5 * 0.3^(1/2.2)
    assert dark == pytest.approx(0.5 * 0.3 ** (1 / 2.2), abs=0.03)
    assert lit > dark + 0.1


def test_blinn_phong_follows_its_equation() -> None:
    lamp = Lamp(direction=(0.0, 0.0, 1.0), intensity=0.5, color=(1.0, 0.5, 0.0), shadow=False)
    normal = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    albedo = torch.tensor([0.5, 0.25, 1.0]).expand(3, 3)
    radiance = shade_points(
        torch.zeros(3, 3),
        normal,
        torch.tensor([0.0, 0.0, 1.0]).expand(3, 3),
        albedo,
        torch.tensor([0.3, 4.0]),
        pack_lamps((lamp,), (0,), normal),
        Lighting(ambient=0.2).around(normal),
    )
    color = 0.5 * torch.tensor([1.0, 0.5, 0.0])
    head_on = albedo[0] * (0.2 + color) + color * 0.3
    aside = albedo[0] * 0.2
    slanted = albedo[0] * (0.2 + color * 0.8) + color * 0.3 * 0.8**4
    torch.testing.assert_close(radiance, torch.stack([head_on, aside, slanted]))


def test_linear_and_display_values_are_inverse() -> None:
    color = torch.linspace(0, 1, 11)
    torch.testing.assert_close(to_display(to_linear(color)), color)


def test_shadow_map_darkens_what_lies_behind() -> None:
    lamps = (Lamp(direction=(0.0, 0.0, 1.0)),)
    maps = shadow_maps(ball(), lamps, (1,), 256, bulk(ball()))
    assert maps is not None
    points = torch.tensor([[0.0, 0.0, -0.2], [0.25, 0.0, -0.2], [0.0, 0.0, 0.4]])
    up = torch.tensor([0.0, 0.0, 1.0]).expand(3, 3)
    arrives = transmittance(points, up, pack_lamps(lamps, (1,), points)[0], maps)
    assert float(arrives[0]) < 0.05  # under the ball
    assert float(arrives[1]) == 1.0  # beside it
    assert float(arrives[2]) == 1.0  # above it


@pytest.mark.parametrize(
    ("grey", "dark"), [(0.15, False), (0.45, False), (0.7, True), (0.95, True)]
)
def test_the_studio_differs_from_what_stands_in_it(grey: float, dark: bool) -> None:
    bare = ball()
    thing = bare.with_colors(torch.full((bare.count, 3), grey)).replace(
        labels=torch.full((bare.count,), SURFACE, dtype=torch.int32)
    )
    assert wants_dark(thing) == dark
    # what fills it says nothing about how it looks
    inner = thing.replace(labels=torch.full((thing.count,), INTERIOR, dtype=torch.int32))
    inner = inner.with_colors(torch.full((thing.count, 3), 1.0 - grey))
    assert wants_dark(Gaussians.cat([thing, inner])) == dark
    studio = Studio(-0.1, (0.0, 0.0), 0.1, 0.2, wants_dark(thing))
    camera = Camera.look_at((0.0, -0.8, 0.3), (0, 0, 0), width=64, height=48, fov=30.0)
    image = Render(camera, studio_light(), studio=studio)(thing).image
    around = float(torch.cat([image[:4].flatten(), image[-4:].flatten()]).mean())
    assert abs(around - grey) > 0.2
    assert (around < 0.4) == dark


def test_ball_over_floor_casts_a_shadow_where_geometry_says() -> None:
    light = key_light(direction=(1.0, 0.0, 1.0), ambient=0.3, intensity=1.0)
    studio = Studio(0.0, (0.0, 0.0), 0.2, 0.2)
    camera = Camera.look_at((0.0, -0.01, 3.0), (0.0, 0.0, 0.0), width=SIZE, height=SIZE, fov=20.0)
    high = ball(center=(0.0, 0.0, 0.3))
    layers = Render(camera, light, studio=studio)(high)
    image = layers.image
    # light from +x at 45 degrees: the shadow's centre lies 0.3 m to the -x side
    ones = torch.ones(SIZE, SIZE)
    _, rays = surface_points(ones, camera.viewmat.float(), camera.K.float())
    eye = camera.center().float()
    floor = eye + rays * (-eye[2] / rays[..., 2])[..., None]
    inside = (floor[..., :2] - torch.tensor([-0.3, 0.0])).norm(dim=-1) < 0.04
    outside = (floor[..., :2] - torch.tensor([0.3, 0.0])).norm(dim=-1) < 0.04
    bare = layers.alpha < 0.01
    shadow = image[inside & bare].mean()
    open_floor = image[outside & bare].mean()
    assert float(shadow) < 0.75 * float(open_floor)


def test_contact_shadow_fades_with_height() -> None:
    spot, up = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]])

    def sky(height: float) -> float:
        grey = ball(center=(0.0, 0.0, height))
        return float(
            ambient_occlusion(spot, up, grid_for(grey, cell=0.012).of(grey, bulk(grey).center))
        )

    assert sky(0.1) < 0.6
    assert sky(0.2) > sky(0.1) + 0.1
    assert sky(0.5) > 0.95


def test_normals_of_a_ball_point_outward() -> None:
    grey = ball()
    normals = torch.nn.functional.normalize(estimate_normals(grey), dim=1)
    away = grey.means - torch.tensor([0.0, 0.0, 0.1])
    skin = away.norm(dim=1) > 0.09
    agreement = (normals[skin] * torch.nn.functional.normalize(away[skin], dim=1)).sum(1)
    assert float(agreement.mean()) > 0.97
    assert float(agreement.min()) > 0.7


def test_debris_far_apart_does_not_need_a_huge_grid() -> None:
    near, far = ball(), ball(center=(40.0, 0.0, 0.1))
    spray = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 100.0
    crumbs = Gaussians.from_colors(spray, torch.full((400,), 0.005), torch.rand(400, 3))
    normals = estimate_normals(Gaussians.cat([near, far, crumbs]), cell=0.012)
    assert torch.isfinite(normals).all()
    assert float(normals.norm(dim=1).max()) <= 1.0 + 1e-6


def test_flat_splats_on_a_solid_add_their_axis_to_the_density() -> None:
    grey = ball()
    away = torch.nn.functional.normalize(grey.means - torch.tensor([0.0, 0.0, 0.1]), dim=1)
    skin = (grey.means - torch.tensor([0.0, 0.0, 0.1])).norm(dim=1) > 0.09
    slanted = skin & (away[:, 2] > 0.7) & (away[:, 2] < 0.95)
    scales = grey.scales.clone()
    scales[slanted, 2] *= 0.1  # flat in z, which is 18 to 45 degrees off the surface's normal
    plain = torch.nn.functional.normalize(estimate_normals(grey)[slanted], dim=1)
    normals = estimate_normals(grey.replace(scales=scales))[slanted]
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(normals)))
    bent = (normals[:, 2] - plain[:, 2]).mean()
    assert float(bent) > 0.05  # toward the axis
    assert float((normals * plain).sum(1).min()) > 0.9  # the density leads


def test_the_normal_of_a_plate_is_its_shortest_axis_and_faces_the_eye() -> None:
    # beside a solid, whose density bends the normals of what is near
    solid = ball()
    plate = truth.surface_splats(truth.Ball((0.0, 0.0, 0.1), 0.102), 4000, 0.5)
    both = Gaussians.cat([solid, plate])
    flat = torch.arange(both.count) >= solid.count
    eye = torch.tensor([0.3, -1.0, 0.4])
    found = plate_normals(plate, eye)
    outward = (plate.means - torch.tensor([0.0, 0.0, 0.1])) / 0.102
    toward = ((eye - plate.means) * outward).sum(1) > 0
    torch.testing.assert_close(found[toward], outward[toward], atol=1e-5, rtol=0)
    torch.testing.assert_close(found[~toward], -outward[~toward], atol=1e-5, rtol=0)
    camera = front()
    picture = Render(camera, key_light())(both, plates=flat)
    points, _ = surface_points(picture.depth, camera.viewmat.float(), camera.K.float())
    here = torch.nn.functional.normalize(points - torch.tensor([0.0, 0.0, 0.1]), dim=-1)
    assert picture.blended is not None
    seen = torch.nn.functional.normalize(picture.blended[..., :3], dim=-1)
    middle = (picture.alpha > 0.99) & (here[..., 1] < -0.5)
    assert float((seen * here).sum(-1)[middle].min()) > 0.998


def test_sheet_of_flat_splats_faces_the_eye() -> None:
    axis = torch.arange(-0.1, 0.1, 0.004)
    spots = torch.cartesian_prod(axis, axis)
    means = torch.cat([spots, torch.zeros_like(spots[:, :1])], 1)
    scales = torch.tensor([0.004, 0.004, 0.0002]).expand_as(means).contiguous()
    sheet = Gaussians.from_colors(means, scales, torch.full_like(means, 0.5))
    grid = grid_for(sheet).of(sheet, (0.0, 0.0, 0.0))
    for height in (1.0, -1.0):
        normals = splat_normals(sheet, grid, torch.tensor([0.1, 0.2, height]))
        inner = spots.abs().amax(1) < 0.08
        expected = torch.tensor([0.0, 0.0, height]).expand(int(inner.sum()), 3)
        torch.testing.assert_close(normals[inner], expected, atol=1e-5, rtol=0)


def test_hole_fraction_counts_what_shows_through() -> None:
    grey = ball()
    volume = torch.full((grey.count,), 0.008**3)

    def hole_fraction(splats: Gaussians) -> float:
        view = small(front())
        drawn = draw(splats, view, colors=splats.means[:, :1], near=0.01, depth=True)
        assert drawn.depth is not None
        matter = MatterView.of(grey.means, volume, view)
        return Holes.of(drawn.alpha, drawn.depth, matter).fraction

    # the rasterizer leaves 1e-4 of the light, and a little more at the rim
    assert hole_fraction(grey) < 5e-4
    # drill a square tunnel along the view: the particles stay, the splats go
    tunnel = (grey.means[:, 0].abs() < 0.05) & ((grey.means[:, 2] - 0.1).abs() < 0.05)
    holed = hole_fraction(grey.select(~tunnel))
    expected = 0.1**2 / (math.pi * 0.1**2)
    # perspective and the soft rims of the splats make the opening smaller, never larger
    assert 0.5 * expected < holed < expected


@pytest.mark.parametrize("step", [0.1, 0.9])
def test_orbit_keeps_the_action_in_frame(step: float) -> None:
    """Also of a ball that is thrown by nine radii a frame."""
    falling = [ball(center=(0.0, 0.0, 1.0 - step * i)).means for i in range(6)]
    cameras = orbit(Action.of(falling), (SIZE, SIZE))
    assert len(cameras) == 6
    for camera, points in zip(cameras, falling, strict=True):
        pixels, depth = camera.project(points.double())
        assert float(depth.min()) > 0
        assert float(pixels.min()) > 0 and float(pixels.max()) < SIZE


def drum(wide: float, tall: float) -> torch.Tensor:
    """Points on the rims of an upright cylinder, far more of them than a twentieth."""
    turn = torch.arange(720).double() * (2.0 * math.pi / 720)
    rim = torch.stack([wide * turn.cos(), wide * turn.sin(), 0.0 * turn], dim=1)
    return torch.cat([rim + rim.new_tensor([0.0, 0.0, z]) for z in (-tall, tall)])


@pytest.mark.parametrize("size", [(96, 54), (54, 96), (64, 64)])
@pytest.mark.parametrize(("wide", "tall"), [(1.0, 0.02), (0.1, 1.0), (1.0, 1.0), (0.6, 0.3)])
def test_a_picture_holds_what_lies_flat_and_what_stands_tall(
    size: tuple[int, int], wide: float, tall: float
) -> None:
    points = drum(wide, tall)
    camera = orbit(Action(
        torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, dtype=torch.float64),
        extent=torch.tensor([[wide, tall]], dtype=torch.float64),
    ), size)[0]  # fmt: skip
    pixels, depth = camera.project(points)
    assert float(depth.min()) > 0.0
    off = ((pixels / torch.tensor(size) - 0.5).abs() * 2.0).amax()
    # nothing is cropped, and no more is free than the film asks for: 1.2 times 1.15, and the tilt
    assert 0.55 < float(off) < 1.0


def test_the_camera_steps_back_for_a_burst_and_comes_nearer_again() -> None:
    scale = [1.0] * 20 + [3.0] * 10 + [1.0] * 90
    cameras = orbit(Action.of([drum(0.1 * k, 0.1 * k) for k in scale]), (96, 54))
    away = [float(camera.center().norm()) for camera in cameras]
    assert away[25] > 2.0 * away[0]
    assert away[0] < away[18] < away[22]  # it begins before
    assert away[-1] == pytest.approx(away[0], rel=0.01)
    # a spray of debris does not make a dot of what broke
    far = orbit(Action.of([drum(0.1 * k, 0.1 * k) for k in [1.0] * 30 + [50.0] * 60]), (96, 54))
    assert float(far[-1].center().norm()) < 4.0 * float(far[0].center().norm())


def test_what_rolls_away_on_one_side_stays_in_the_picture() -> None:
    """A hand of 4 % of the matter; where it is 0.2 %, it is let go and the subject stays large."""
    body = ball().means
    ends = {}
    for share in (0.04, 0.002):
        hand = body[torch.arange(max(2, int(share * len(body))))]
        rolled = hand.new_tensor([0.012, 0.0, 0.0])
        film = [torch.cat([body, hand + i * rolled]) for i in range(60)]
        cameras = orbit(Action.of(film), (96, 72), sweep=0.0)
        places, _ = cameras[-1].project(film[-1][len(body) :].double())
        whole, _ = cameras[-1].project(body.double())
        assert float(whole.min()) > 0.0 and bool((whole < whole.new_tensor([96.0, 72.0])).all())
        height = float(whole[:, 1].max() - whole[:, 1].min())
        ends[share] = (float((places[:, 0] / 96.0 - 0.5).abs().max()), height)
    assert ends[0.04][0] < 0.5 < ends[0.002][0]
    assert ends[0.002][1] > 1.3 * ends[0.04][1]


def test_camera_path_is_interpolated(tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    keys = [{"eye": [x, -1.0, 0.5], "target": [0.0, 0.0, 0.0]} for x in (0.0, 1.0)]
    path.write_text(json.dumps({"fov": 40, "frames": keys}))
    action = Action.of([torch.zeros(4, 3)] * 3)
    cameras = cameras_for(str(path), action, (64, 48))
    centers = torch.stack([camera.center() for camera in cameras])
    torch.testing.assert_close(centers[:, 0], torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64))


@pytest.mark.parametrize(
    "text",
    [
        "not json",
        "{}",
        '{"frames": [{"eye": [0, 0, 0], "target": [0, 0, 0]}]}',
        '{"frames": [[1]]}',
    ],
)
def test_bad_camera_path_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "path.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"output\.camera"):
        cameras_for(str(path), Action.of([torch.zeros(4, 3)] * 3), (64, 48))


def test_photograph_index_needs_a_capture() -> None:
    with pytest.raises(InputError, match="needs a `capture:`"):
        cameras_for("3", Action.of([torch.zeros(4, 3)]), (64, 48))


def test_render_refuses_missing_camera_and_distortion() -> None:
    with pytest.raises(InputError, match="no camera"):
        Render()(ball())
    bent = front().replace(distortion=(0.1, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="distortion"):
        Render(bent)(ball())


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (float("nan"), 0.0, 1.0)])
def test_light_without_direction_is_refused(direction: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match=r"light\.key\.direction"):
        key_light(direction=direction)


def test_nearest_sibling_alone_shades_a_pixel() -> None:
    means = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.05, 0.1]])
    pair = Gaussians.from_colors(
        means,
        torch.full((2,), 0.05),
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        opacities=0.5,
    )
    alone = Render(front())(pair.select(torch.tensor([0]))).image
    grouped = Render(front())(pair, groups=torch.tensor([7, 7], dtype=torch.int32)).image
    plain = Render(front())(pair).image
    middle = (SIZE // 2, SIZE // 2)
    torch.testing.assert_close(grouped[middle], alone[middle])
    assert not torch.allclose(plain[middle], alone[middle])
