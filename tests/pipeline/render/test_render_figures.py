"""Holes and flicker on constructed matter whose figures can be worked out."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from gsfluent import geometry
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.pipeline.light.from_shot import clear_of
from gsfluent.pipeline.render.camera import Action
from gsfluent.pipeline.render.figures import FilmFigures, RawCarry, cameras_around
from gsfluent.pipeline.render.flicker import Flow, flicker
from gsfluent.pipeline.render.holes import REACH, RIM, Holes, MatterView
from gsfluent.pipeline.render.stage import Render
from gsfluent.results.frames import SavedFrame

STEP = 0.01
WIDE = 0.3  # metres across the picture


def camera(size: int = 240, x: float = 0.0) -> Camera:
    """Looks along +y from far off."""
    fov = 2 * math.degrees(math.atan(0.5 * WIDE / 20.0))
    return Camera.look_at((x, -20.0, 0.0), (x, 0.0, 0.0), width=size, height=size, fov=fov)


def slab(layers: int = 2, half: float = 0.1, depth: float = 0.0) -> torch.Tensor:
    """Points of a plate across the view, [N, 3]."""
    line = torch.arange(-half + 0.5 * STEP, half, STEP)
    deep = depth + STEP * torch.arange(layers)
    return torch.stack(torch.meshgrid(line, deep, line, indexing="ij"), -1).reshape(-1, 3)


def volume(points: torch.Tensor) -> torch.Tensor:
    return torch.full((len(points),), STEP**3)


def fine(points: torch.Tensor, opacity: float = 0.95, edge: int = 2) -> Gaussians:
    """Opaque splats, ``edge`` cubed for each point."""
    corner = ((torch.arange(edge) + 0.5) / edge - 0.5) * STEP
    offset = torch.stack(torch.meshgrid(corner, corner, corner, indexing="ij"), -1).reshape(-1, 3)
    means = (points[:, None] + offset).reshape(-1, 3)
    size = torch.full((len(means),), 0.7 / edge * STEP)
    colors = 0.5 + 0.4 * torch.sin(60.0 * means)
    return Gaussians.from_colors(means, size, colors, opacities=opacity)


def measured(splats: Gaussians, points: torch.Tensor) -> Holes:
    view = camera()
    drawn = draw(splats, view, near=0.01, depth=True)
    return Holes.of(drawn.alpha, drawn.depth, MatterView.of(points, volume(points), view))


def silhouette(points: torch.Tensor) -> float:
    """Area of the silhouette [m^2]."""
    seen = MatterView.of(points, volume(points), camera()).silhouette
    return float(seen.sum()) * (WIDE / 240) ** 2


def test_the_silhouette_is_the_plate_less_its_rim() -> None:
    # discs reach beyond the plate's half spacing; the rim and a pixel are taken off
    side = 0.2 + 2 * (REACH - 0.5 - RIM) * STEP - 2 * WIDE / 240
    assert silhouette(slab()) == pytest.approx(side**2, rel=0.03)
    assert measured(fine(slab()), slab()).fraction < 5e-4


@pytest.mark.parametrize("radius", [0.03, 0.06])
def test_a_round_hole_counts_with_its_area(radius: float) -> None:
    points = slab()
    splats = fine(points, edge=5)
    kept = splats.means[:, [0, 2]].norm(dim=1) > radius
    found = measured(splats.select(kept), points)
    # the splats at its edge reach into it, by no more than half their spacing and two sigmas
    area = found.fraction * silhouette(points)
    assert math.pi * (radius - 0.38 * STEP) ** 2 < area < math.pi * radius**2
    assert found.through == 0.0  # there is nothing behind


def test_a_slit_is_a_hole_in_one_surface_and_none_between_two_bodies() -> None:
    left, wide = slab(half=0.05), 1.1 * STEP  # too narrow for the points to know of

    def slit(depth: float) -> tuple[torch.Tensor, Holes]:
        right = left + torch.tensor([0.1 - STEP + wide, depth, 0.0])
        points = torch.cat([left, right]) - torch.tensor([0.05, 0.0, 0.0])
        splats = fine(points, edge=5)
        x = splats.means[:, 0]
        return points, measured(splats.select((x < -0.5 * STEP) | (x > wide - 0.5 * STEP)), points)

    torn, apart = slit(0.0), slit(0.06)
    assert torn[1].fraction > 5e-3 and apart[1].fraction < 5e-4
    # it belongs to the silhouette of the one, and parts those of the two
    assert silhouette(torn[0]) > silhouette(apart[0]) + 0.5 * STEP * 0.1


def test_a_faint_veil_counts_with_its_transmittance() -> None:
    points = slab(layers=1)
    one = Gaussians.from_colors(
        torch.zeros(1, 3), torch.tensor([[5.0, 1e-3, 5.0]]), torch.ones(1, 3), opacities=0.5
    )
    assert measured(one, points).fraction == pytest.approx(0.5, abs=0.002)


def test_a_gap_between_fragments_is_no_hole() -> None:
    points = slab()
    points[:, 0] += torch.where(points[:, 0] > 0, 0.02, -0.02)
    assert measured(fine(points), points).fraction < 5e-4
    # but what the pieces lack is
    splats = fine(points)
    half = splats.select(splats.means[:, 0] < 0)
    assert measured(half, points).fraction == pytest.approx(0.5, abs=0.01)


def test_a_view_through_the_front_wall_of_a_shell_counts_though_no_background_shows() -> None:
    front, back = slab(layers=1), slab(layers=1, depth=0.15)
    points = torch.cat([front, back])
    splats = Gaussians.cat([fine(front, 0.99), fine(back, 0.99)])
    whole = measured(splats, points)
    assert whole.through == 0.0 and whole.fraction < 2e-3
    broken = (splats.means[:, 1] < 0.1) & (splats.means[:, [0, 2]].abs().amax(1) < 0.05)
    found = measured(splats.select(~broken), points)
    assert found.fraction < 5e-3
    assert found.through == pytest.approx((0.1 - 0.5 * STEP) ** 2 / silhouette(points), rel=0.1)
    # the same opening in the matter, so that the back is rightly seen
    gone = (points[:, 1] < 0.1) & (points[:, [0, 2]].abs().amax(1) < 0.05)
    assert measured(splats.select(~broken), points[~gone]).through < 1e-3


def test_the_matter_out_of_view_has_no_holes() -> None:
    points = slab() + torch.tensor([5.0, 0.0, 0.0])
    assert measured(fine(points), points).fraction == 0.0


def moved(points: torch.Tensor, angle: float, shift: tuple[float, float, float]) -> torch.Tensor:
    turn = geometry.quaternion_to_matrix(
        torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])
    )
    return points @ turn.T + torch.tensor(shift)


def flow_of(now: torch.Tensor, then: torch.Tensor, views: tuple[Camera, Camera]) -> Flow:
    first = MatterView.of(now, volume(now), views[0])
    second = MatterView.of(then, volume(then), views[1])
    return Flow.of(first, second, (now, then), views, STEP)


def image(splats: Gaussians, view: Camera) -> torch.Tensor:
    return draw(splats, view, near=0.01, background=torch.ones(3)).image


def test_a_rigid_motion_and_a_moving_camera_do_not_flicker() -> None:
    now = slab()
    then = moved(now, 0.06, (0.012, 0.0, -0.008))
    views = camera(), camera(x=0.01)
    splats = fine(now)
    carried = splats.replace(means=moved(splats.means, 0.06, (0.012, 0.0, -0.008)))
    flow = flow_of(now, then, views)
    assert float(flow.valid.float().mean()) > 0.3
    change = flicker(image(splats, views[0]), image(carried, views[1]), flow)
    still = flicker(image(splats, views[0]), image(splats, views[1]), flow)
    assert change is not None and still is not None
    assert change < 2e-3 and still > 20 * change  # had the splats not moved


def test_a_blinking_splat_counts_with_its_area_and_contrast() -> None:
    now = slab()
    view = camera()
    black = torch.zeros(1, 3)
    disc = Gaussians.from_colors(
        torch.tensor([[0.0, -0.05, 0.0]]), torch.tensor([0.008]), black, opacities=0.8
    )
    grey = fine(now).with_colors(torch.full((8 * len(now), 3), 0.6))
    flow = flow_of(now, now, (view, view))
    both = Gaussians.cat([grey, disc])
    change = flicker(image(grey, view), image(both, view), flow)
    # a Gaussian of peak 0.8 covers 0.8 * 2 pi sigma^2
    area = 0.8 * 2 * math.pi * 0.008**2
    assert change == pytest.approx(0.6 * area / silhouette(now), rel=0.05)


def test_what_comes_into_view_is_left_out() -> None:
    """A front plate moves aside; the back plate it uncovers has another colour."""
    front, back = slab(half=0.05), slab(depth=0.1)
    now = torch.cat([back, front])
    then = torch.cat([back, front + torch.tensor([0.03, 0.0, 0.0])])
    colors = torch.tensor([[0.2, 0.2, 0.2], [0.9, 0.9, 0.9]])

    def drawn(points: torch.Tensor) -> torch.Tensor:
        which = (torch.arange(len(points)) >= len(back)).long()
        splats = fine(points, edge=4).with_colors(colors[which].repeat_interleave(64, 0))
        return image(splats, view)

    view = camera()
    change = flicker(drawn(now), drawn(then), flow_of(now, then, (view, view)))
    # 0.7 of 0.03 x 0.1 m if it counted; the rims of the splats in front do
    assert change is not None and change < 0.25 * 0.7 * 0.03 * 0.1 / silhouette(back)
    away = slab() + torch.tensor([9.0, 0.0, 0.0])
    assert flicker(drawn(now), drawn(then), flow_of(away, away, (view, view))) is None


def saved(points: torch.Tensor, splats: Gaussians, index: int, carried: int) -> SavedFrame:
    count = splats.count
    return SavedFrame(
        index=index, time=0.1 * index, gaussians=splats,
        groups=torch.full((count,), -1, dtype=torch.int32), carried=carried,
        ids=torch.arange(count), anchor=torch.arange(count, dtype=torch.int32) // 8,
        positions=points, volumes=volume(points), damage=torch.zeros(len(points)),
        fragments=torch.zeros(len(points), dtype=torch.int32),
        velocity=torch.zeros_like(points), body=torch.zeros(len(points), dtype=torch.int32),
        material=torch.zeros(len(points), dtype=torch.int32), facts={},
    )  # fmt: skip


def test_raw_splats_ride_rigidly_on_their_points() -> None:
    points = slab(layers=3)
    splats = fine(points)
    raw = RawCarry(saved(points, splats, 0, splats.count))
    then = moved(points, 0.4, (0.1, 0.2, 0.0))
    made = raw.at(saved(then, splats, 1, splats.count))
    assert torch.allclose(made.means, moved(splats.means, 0.4, (0.1, 0.2, 0.0)), atol=1e-5)


def test_holes_are_judged_where_the_matter_is_drawn() -> None:
    """A crumb that a chunk carries leaves no hole where the solver has it."""
    points = slab(layers=1)
    whole = fine(points)
    frame = saved(points, whole, 0, whole.count)
    gone = points + torch.tensor([-0.04, 0.0, 0.0]) * (torch.arange(len(points)) < 20)[:, None]
    rows = torch.arange(20, dtype=torch.int32)
    view = camera()
    picture = draw(whole, view, near=0.01, depth=True)
    assert picture.depth is not None
    found = []
    for led in (None, (rows, points[:20])):
        figures = FilmFigures(frame)
        there = dataclasses.replace(saved(gone, whole, 1, whole.count), led=led)
        figures.add(there, view, picture.alpha, picture.depth)
        found.append(figures.report()["hole_fraction"][0])
    assert found[0] is not None and found[1] is not None and 10.0 * found[1] < found[0]


def test_figures_around_are_those_of_the_picture_that_is_shown() -> None:
    """Milk that lacks points is closed there, and a blade set in by depth, as in the film."""
    points = torch.cat([slab(layers=1), slab(layers=1, half=0.03, depth=-0.04)])
    milk, plate = fine(points[:400], edge=1), fine(points[400:])
    torn = milk.select((points[:400].norm(dim=1) > 0.8 * STEP).nonzero()[:, 0])
    blade = Gaussians.from_colors(
        torch.tensor([[0.05, -0.001, 0.0]]), torch.tensor([[0.01, 0.03, 0.01]]), torch.ones(1, 3)
    )
    whole = Gaussians.cat([torn, plate, blade])
    anchor = torch.arange(whole.count, dtype=torch.int32)
    anchor = torch.where(anchor < torn.count, anchor, 400)
    anchor[-1] = -1
    ids = torch.arange(whole.count)
    liquid = ids < torn.count
    frame = dataclasses.replace(
        saved(points, whole, 1, whole.count),
        anchor=anchor,
        ids=torch.where(liquid | (anchor < 0), -1 - ids, ids),
        body=(torch.arange(len(points)) >= 400).int(),
        damage=torch.ones(len(points)),
        facts={"bodies": [["pool", "milk"], ["plate", "wood"]]},
    )
    view = cameras_around(Action.of([points]))[1]
    figures = FilmFigures(frame, [view, view], every=1)
    nothing = torch.zeros(240, 240)
    for _ in range(2):
        figures.add(frame, camera(), nothing, nothing)
    report, clear = figures.report(), clear_of(frame)
    shown = Render()(whole, view, rigid=anchor < 0, clear=clear)
    wanted = Holes.of(shown.alpha, shown.depth, MatterView.of(points, frame.volumes, view))
    assert report["hole_fraction_around"][1] == pytest.approx(wanted.fraction, abs=1e-6)
    assert report["see_through_around"][1] == pytest.approx(wanted.through, abs=1e-6)
    # splats as they are, which the figures were of, have the hole
    assert wanted.fraction < 0.5 * report["hole_fraction_around_before"][1]


def test_the_figures_of_a_film_put_what_is_drawn_beside_what_is_not_repaired() -> None:
    points = slab(layers=1)
    splats = fine(points, opacity=0.5)
    figures = FilmFigures(
        saved(points, splats, 0, splats.count), cameras_around(Action.of([points]))[:1], every=4
    )

    def add(points: torch.Tensor, splats: Gaussians, carried: int) -> None:
        frame = saved(points, splats, 0, carried)
        if carried < splats.count:
            frame.damage[0] = 1.0
        drawn = draw(splats, camera(), near=0.01, depth=True)
        figures.add(frame, camera(), drawn.alpha, drawn.depth)

    add(points, splats, splats.count)
    apart = points.clone()
    apart[:, 0] *= 1.05
    repaired = fine(apart)
    wide = Gaussians.cat([repaired, repaired.replace(scales=1.5 * repaired.scales)])
    for _ in range(4):
        add(apart, wide, splats.count)
    report = figures.report()
    assert report["transition_gaussians"] == [0] + 4 * [splats.count]
    assert all(len(values) == 5 for values in report.values())
    before, after = report["hole_fraction_before"], report["hole_fraction"]
    # two of four broken frames are measured in full; unbroken ones need no second picture
    assert before[0] == after[0] and before[1] is before[4] is None
    assert all(after[k] < 0.5 * before[k] for k in (2, 3))
    assert after[1] == after[2] == after[4]
    assert [value is not None for value in report["flicker"]] == [False, False, False, True, False]
    assert report["flicker"][3] == report["flicker_before"][3] == 0.0
    assert 0 < report["hole_fraction_around"][2] < 0.01
