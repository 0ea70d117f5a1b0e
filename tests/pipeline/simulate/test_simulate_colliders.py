"""Rigid colliders in a run: the resident solver against the composed operators."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.ops.reference import touch
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.resident import apart
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)
DX = 0.05


def run_of(scene: Scene, *, fps: float = 20.0, frames: int, **options: object) -> Run:
    """A finished run, clean and with its momentum balanced."""
    run = Run(scene, build_matter(scene, DX), fps, SolverOptions(**options, max_rollbacks=3))
    for frame in range(1, frames + 1):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
    assert run.report()["verdict"] == "clean", run.report()["reason"]
    assert run.ledger.worst < 1e-5
    return run


def steel(kind: str, tmp_path: Path) -> Scene:
    """A ball of jelly that meets something rigid."""
    floating = kind in ("bullet", "light bullet")
    scene = Scene(floor=None, gravity=(0, 0, 0)) if floating else Scene()
    placed = Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.42]), 1.0)
    if kind == "bullet":
        scene.add(ellipsoid(), SOFT)
        scene.bullet((0.4, 0.02, 0), (0, 0.02, 0), 10.0, radius=0.05, density=9e3, rigid=True)
    elif kind == "light bullet":
        scene.add(ellipsoid(), SOFT)
        scene.bullet((0.4, 0.02, 0), (0, 0.02, 0), 10.0, radius=0.02, density=300, rigid=True)
    elif kind == "press":
        scene.add(ellipsoid(), SOFT)
        scene.press(speed=0.4, stroke=0.06)
    elif kind == "turning":
        scene.add(ellipsoid(), SOFT)
        scene.add_collider("box", at=(0.18, 0, 0.1), size=(0.2, 0.3, 0.15), spin=(0, 0, 4.0))
    elif kind == "mesh":
        import trimesh

        path = tmp_path / "box.obj"
        trimesh.creation.box((0.6, 0.6, 0.3)).export(path)
        scene.add_collider("mesh", mesh=path, at=(0, 0, 0.15), friction=0.5)
        scene.add(ellipsoid(), SOFT, frame=placed)
    elif kind == "falling box":
        scene.add(ellipsoid(), SOFT)
        scene.add_collider("box", at=(0.05, 0, 0.4), size=(0.2, 0.2, 0.1), mass=300.0)
    return scene


# Contact is one blow per step, so two runs whose steps differ by a few percent differ as much.
@pytest.mark.parametrize(
    ("kind", "fps", "frames", "tolerance"),
    [
        ("bullet", 50, 2, 0.1),
        ("press", 20, 4, 0.03),
        ("turning", 20, 4, 0.03),
        ("mesh", 20, 6, 0.03),
        ("falling box", 50, 5, 0.1),
    ],
)
def test_both_engines_agree(
    kind: str, fps: float, frames: int, tolerance: float, tmp_path: Path
) -> None:
    runs = [
        run_of(steel(kind, tmp_path), fps=fps, frames=frames, resident=resident, surface=False)
        for resident in (True, False)
    ]
    fast, slow = runs
    assert fast.stepper.counters.composed_steps == 0 < fast.stepper.counters.steps
    assert slow.stepper.counters.composed_steps == slow.stepper.counters.steps > 0
    given = [run.state.impulse for run in runs]
    assert float(given[1].norm()) > 0.1
    assert float((given[0] - given[1]).norm()) < tolerance * float(given[1].norm())
    apart = (fast.state.position - slow.state.position).norm(dim=1)
    assert float(apart.mean()) < tolerance * DX
    moved = fast.state.colliders[:, 3:6] - slow.state.colliders[:, 3:6]
    assert float(moved.norm(dim=1).max()) < tolerance * DX
    work = [float(run.state.work) for run in runs]
    assert work[0] == pytest.approx(work[1], rel=tolerance, abs=1e-9)


def test_a_bullet_loses_exactly_what_its_target_gets(tmp_path: Path) -> None:
    run = run_of(steel("bullet", tmp_path), fps=50, frames=2)
    assert run.stepper.counters.composed_steps == 0
    row = run.state.colliders[0]
    lost = float(row[14]) * (torch.tensor([-10.0, 0, 0]).double() - row[10:13])
    assert float(lost.norm()) > 1.0
    # In float64 the sums are exact; the points of a run are float32.
    assert float((lost - run.state.impulse).norm()) < 1e-12 * float(row[14]) * 10.0
    given = torch.tensor(run.figures.momentum).double()
    assert float((lost - given).norm()) < 1e-5 * float(lost.norm())


def test_a_body_lighter_than_what_it_hits_needs_the_composed_operators(tmp_path: Path) -> None:
    """The resident solver knows the touched mass one step late: a light body would gain energy."""
    run = run_of(steel("light bullet", tmp_path), fps=50, frames=2)
    assert run.stepper.counters.composed_steps == run.stepper.counters.steps > 0
    energy = 0.5 * float(run.state.colliders[0, 14]) * 10.0**2
    assert run.figures.kinetic + run.figures.elastic < energy


def test_a_plate_stops_after_its_stroke_in_the_solver_too(tmp_path: Path) -> None:
    """What the nodes see ends with the stroke, not only what is drawn."""
    run = run_of(steel("press", tmp_path), fps=2.0, frames=1)  # the stroke ends within the frame
    assert run.stepper.counters.composed_steps == 0
    face = run.state.colliders[1, 5] - run.state.colliders[1, 28]
    assert float(face) == pytest.approx(0.14, abs=1e-6)
    top = float(run.state.particles.position[:, 2].max())
    assert 0.14 - 1.0 * DX < top < 0.14 + 0.5 * DX


def test_a_free_ball_rests_on_the_floor_beside_matter() -> None:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), SOFT)
    scene.add_collider("sphere", at=(0.6, 0, 0.2), radius=0.1, mass=50.0)
    run = run_of(scene, frames=8)
    assert run.stepper.counters.composed_steps == 0
    assert float(run.state.colliders[1, 5]) == pytest.approx(0.1, abs=0.06 * DX)
    assert abs(float(run.state.colliders[1, 12])) < 0.1


def _dropped(surface: bool) -> float:
    """Lowest that the bottom of a cube comes in a second after a small drop [dx above a floor]."""
    ball = ellipsoid((0.2, 0.2, 0.2))
    cube = dataclasses.replace(ball, occupancy=torch.ones_like(ball.occupancy))
    scene = Scene()
    half = 0.5 * cube.occupancy.shape[2] * float(cube.voxel)
    stiff = materials.elastic.override(young_modulus=4e5)
    scene.add(cube, stiff, frame=Frame(torch.eye(3), torch.tensor([0.0, 0.0, half + 0.005]), 1.0))
    run = Run(scene, build_matter(scene, DX), 100.0, SolverOptions(surface=surface, sleep=False))
    low = torch.argsort(run.matter.rest[:, 2])[: len(run.matter.rest) // 8]
    inside = float(run.matter.rest[low, 2].mean()) - 0.005  # of its points above its bottom
    gaps = []
    for frame in range(1, 41):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
        gaps.append(float(run.state.position[low, 2].mean()) - inside)
    assert run.report()["verdict"] == "clean", run.report()["reason"]
    return min(gaps) / DX


def test_bodies_lie_on_a_floor_that_pushes_points() -> None:
    assert abs(_dropped(surface=True)) < 0.1


def test_what_overlaps_at_the_start_is_not_thrown_out() -> None:
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    placed = Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.18]), 1.0)  # 0.4 cells into the floor
    scene.add(ellipsoid((0.2, 0.2, 0.2)), SOFT, frame=placed)
    run = run_of(scene, frames=4, surface=True)
    assert float(run.state.particles.velocity.abs().max()) < 1e-5  # of rounding


def test_surface_refuses_long_steps() -> None:
    with pytest.raises(InputError, match="cfl must be at most"):
        SolverOptions(surface=True, cfl=0.8)


def _stacked(gap: float, surface: bool, gravity: float = -9.81) -> Run:
    """A cube `gap` metres above another that stands on a floor."""
    ball = ellipsoid((0.2, 0.2, 0.2))
    cube = dataclasses.replace(ball, occupancy=torch.ones_like(ball.occupancy))
    scene = Scene(gravity=(0.0, 0.0, gravity))
    edge = cube.occupancy.shape[2] * float(cube.voxel)
    stiff = materials.elastic.override(young_modulus=4e5)
    for height in (0.5 * edge, 1.5 * edge + gap):
        scene.add(cube, stiff, frame=Frame(torch.eye(3), torch.tensor([0.0, 0.0, height]), 1.0))
    return Run(scene, build_matter(scene, DX), 100.0, SolverOptions(surface=surface, sleep=False))


def _fallen(surface: bool) -> float:
    """Smallest gap that a cube leaves above another within half a second [dx]."""
    run = _stacked(0.005, surface)
    count = run.matter.ranges[0][1]
    rest = run.matter.rest
    top = torch.argsort(-rest[:count, 2])[: count // 8]
    low = count + torch.argsort(rest[count:, 2])[: (len(rest) - count) // 8]
    start = float(rest[low, 2].mean() - rest[top, 2].mean()) - 0.005
    gaps = []
    for frame in range(1, 21):
        assert run.advance_to(frame, None), run.failure
        place = run.state.position
        gaps.append(float(place[low, 2].mean() - place[top, 2].mean()) - start)
    return min(gaps) / DX


def test_bodies_lie_on_each_other_where_their_points_end() -> None:
    assert abs(_fallen(surface=True)) < 0.1


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("gap", [-0.3, 0.0, 0.4])
def test_how_far_points_start_from_the_faces_of_others(gap: float, device: str) -> None:
    """As defined, by every pair of points; what is out of reach counts as a cell away and more."""
    scene = _stacked(gap * DX, True, gravity=0.0).scene
    matter = build_matter(scene, DX, device=device)
    got = apart(matter).cpu() / DX
    place, volume = matter.rest.double().cpu() / DX, matter.particles.volume.double().cpu() / DX**3
    count = matter.ranges[0][1]
    weight = touch.kernel(torch.cdist(place[:count], place[count:]))
    found = torch.cat([weight @ volume[count:], weight.T @ volume[:count]])
    met = found > 1e-4
    assert int(met.sum()) > 100
    assert torch.allclose(touch.share(got[met] + 1e-5), found[met], rtol=0.0, atol=1e-6)
    assert bool((got[~met] > 0.7).all())


def test_bodies_that_overlap_at_the_start_are_not_thrown_apart() -> None:
    run = _stacked(-0.3 * DX, True, gravity=0.0)
    for frame in (1, 2):
        assert run.advance_to(frame, None), run.failure
    assert float(run.state.particles.velocity.abs().max()) < 1e-5  # of rounding


@pytest.mark.parametrize(
    ("material", "options", "wanted"),
    [
        ("elastic", {}, "points"),
        ("rubber", {}, "points"),
        ("steel", {}, "points"),
        ("elastic", {"cfl": 0.8}, "nodes"),  # longer steps make energy there
        ("elastic", {"surface": False}, "nodes"),
        ("glass", {}, "nodes"),  # its rebound was fitted there
        ("glass", {"surface": True}, "points"),
        ("water", {}, "nodes"),
    ],
)
def test_points_are_pushed_where_all_matter_is_elastic(
    material: str, options: dict[str, object], wanted: str
) -> None:
    scene = Scene()
    there = [Frame(torch.eye(3), torch.tensor([x, 0.0, 0.2]), 1.0) for x in (0.0, 1.0)]
    scene.add(ellipsoid((0.2, 0.2, 0.2)), SOFT, frame=there[0])
    scene.add(ellipsoid((0.2, 0.2, 0.2)), materials.get(material), frame=there[1])
    run = Run(scene, build_matter(scene, DX), 20.0, SolverOptions(**options))
    assert run.report()["contact"] == wanted == SolverOptions(**options).decided(scene).contact
