"""Points that are held and driven: which nodes hold them, what a scene's grips give, bad grips."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gsfluent import materials, ops
from gsfluent.data import INTERIOR, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.lab.world.shapes import box, parameters
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene

DX = 0.02
SOFT = materials.elastic.override(young_modulus=2e4, density=1000.0)


def bar(edges: tuple[int, int, int] = (12, 3, 3)) -> Solid:
    """A bar with a corner at the origin, so many cells long along x, y, z."""
    matter = torch.ones(*edges, dtype=torch.bool)
    one = Gaussians.from_colors(
        torch.full((1, 3), DX), torch.full((1,), DX), torch.full((1, 3), 0.5), label=INTERIOR
    )
    return Solid(one, matter, DX * matter.float(), torch.zeros(3), DX)


def scene_of(gravity: float = 0.0) -> Scene:
    scene = Scene(floor=None, gravity=(0.0, 0.0, -gravity))
    scene.add(bar(), SOFT, name="bar")
    return scene


def run_of(scene: Scene, frames: int = 6, **options: object) -> Run:
    run = Run(scene, build_matter(scene, DX), 40.0, SolverOptions(**options))
    for frame in range(frames + 1):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
    assert run.ledger.worst < 1e-4
    return run


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.75])
def test_the_face_that_is_felt_is_that_of_the_points_to_half_a_cell(shift: float) -> None:
    points = box([shift - 4.0, 0.0, 0.0], [8.0, 4.0, 4.0], 0.5)
    free = points[:, 0] > shift
    rows, sdf = ops.grip_rows(points, torch.ones(len(points)), free.long().neg(), dx=1.0)
    nodes = torch.zeros(12, 3, dtype=torch.float64) + 2.0
    nodes[:, 0] = torch.arange(-6.0, 6.0)
    held = nodes[ops.collider_distance(nodes, rows, sdf)[0][:, 0] <= 0.0, 0]
    assert abs(float(held.max()) - 0.211 - shift) <= 0.5
    assert float(held.min()) <= shift - 4.0


def test_driven_points_move_as_one_rigid_body_and_held_ones_stay() -> None:
    points = box([0.0, 0.0, 0.0], [8.0, 2.0, 2.0], 0.5)
    number = torch.where(points[:, 0] < 3.0, 0, torch.where(points[:, 0] > 5.0, 1, -1))
    mass = torch.full((len(points),), 0.125, dtype=torch.float64)
    velocity = torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.01]], dtype=torch.float64)
    turn = torch.tensor([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0]], dtype=torch.float64)
    about = torch.tensor([[0.0, 1.0, 1.0], [8.0, 1.0, 1.0]], dtype=torch.float64)
    rows, sdf = ops.grip_rows(
        points, mass, number, dx=1.0, about=about, velocity=velocity, angular_velocity=turn
    )
    solver = ops.Solver(
        points, torch.zeros_like(points), mass, mass, dx=1.0, gravity=(0.0, 0.0, -1e-3),
        law=torch.zeros(1, dtype=torch.int32), params=parameters(1.0, 0.2, 1.0)[None],
        colliders=rows, sdf=sdf,
    )  # fmt: skip
    solver.advance(10.0)
    far = points[:, 0] > 7.0
    arm = points - about[1]
    s, c = torch.tensor(0.3).double().sin(), torch.tensor(0.3).double().cos()
    turned = torch.stack(
        [arm[:, 0], c * arm[:, 1] - s * arm[:, 2], s * arm[:, 1] + c * arm[:, 2]], 1
    )
    want = about[1] + 10.0 * velocity[1] + turned
    assert float((solver.position - want)[far].abs().max()) < 5e-3
    assert float((solver.position - points)[points[:, 0] < 1.0].abs().max()) < 1e-12
    momentum = (mass[:, None] * solver.velocity).sum(dim=0)
    weight = float(mass.sum()) * torch.tensor([0.0, 0.0, -1e-3], dtype=torch.float64) * 10.0
    torch.testing.assert_close(solver.impulse.sum(dim=0) + weight, momentum, atol=1e-9, rtol=0)


@pytest.mark.parametrize("resident", [True, False])
def test_what_hangs_in_a_grip_pulls_with_its_weight(resident: bool) -> None:
    scene = scene_of(gravity=9.81)
    scene.grip([[-1.0, -1.0, -1.0], [0.06, 1.0, 1.0]], name="jaw")
    run = run_of(scene, resident=resident)
    frames = [frame["jaw"] for frame in run.report()["per_frame"]["grips"]]
    given = sum(frame["force"][2] for frame in frames[1:]) / 40.0
    mass = float(run.matter.particles.mass.double().sum())
    # what the grip gave is what gravity took and what still moves
    moved = run.per_frame[-1]["momentum"][2]
    assert given == pytest.approx(mass * 9.81 * 6 / 40.0 + moved, rel=1e-4)
    assert frames[0]["force"] == [0.0, 0.0, 0.0]
    assert run.report()["grips"][0]["name"] == "jaw"


def test_pull_twist_and_bend_drive_the_ends_as_told() -> None:
    scene = scene_of()
    held, pulled = scene.pull(0.004, 0.1, (1.0, 0.0, 0.0), depth=0.06, at=0.025)
    run = run_of(scene)
    last = run.per_frame[-1]["grips"]
    assert last[pulled]["displacement"] == pytest.approx([0.004, 0.0, 0.0], abs=1e-9)
    assert run.per_frame[1]["grips"][pulled]["displacement"] == [0.0, 0.0, 0.0]
    assert max(f["grips"][pulled]["force"][0] for f in run.per_frame) > 0.0
    assert min(f["grips"][held]["force"][0] for f in run.per_frame) < 0.0
    for turned in ("twist", "bend"):
        scene = scene_of()
        first, second = (
            scene.twist(3.0, 0.1, (1.0, 0.0, 0.0))
            if turned == "twist"
            else scene.bend(6.0, 0.1, axis=(0.0, 0.0, 1.0))
        )
        axis = 0 if turned == "twist" else 2
        last = run_of(scene, 4).per_frame[-1]["grips"]
        assert last[second]["turn"][axis] == pytest.approx(3.0, abs=1e-6)
        assert last[first]["turn"][axis] == pytest.approx(0.0 if axis == 0 else -3.0, abs=1e-6)
        assert last[second]["moment"][axis] > 0.0 > last[first]["moment"][axis]


def test_a_resumed_run_gives_the_same_reactions(tmp_path: Path) -> None:
    runs = []
    for resumed in (False, True):
        scene = scene_of()
        scene.pull(0.004, 0.1, (1.0, 0.0, 0.0))
        run = Run(scene, build_matter(scene, DX), 40.0)
        for frame in range(4):
            if resumed and frame == 2:
                run.save(tmp_path / "state.pt", {})
                run = Run(scene, build_matter(scene, DX), 40.0)
                run.resume(tmp_path / "state.pt")
            run.advance_to(frame, None)
            run.record(frame)
        runs.append(run.per_frame[-1]["grips"])
    assert runs[0] == runs[1]


def test_an_object_that_is_moved_takes_its_grips_along() -> None:
    scene = scene_of()
    scene.pull(0.004, 0.1, (1.0, 0.0, 0.0))
    scene.drop(0.5)
    assert [row.tolist() for row in RigidSet(scene, DX, particles=build_matter(scene, DX).particles)
            .start[:, 5:6]] == [[pytest.approx(0.53, abs=2e-3)]] * 2  # fmt: skip


@pytest.mark.parametrize(
    ("event", "says"),
    [
        ({"type": "grip", "box": [[0, 0, 0]]}, "two corners"),
        ({"type": "grip", "box": [[0] * 3, [1] * 3], "turn": [0, 0, 9]}, "'duration' is missing"),
        ({"type": "grip", "box": [[0] * 3, [1] * 3], "at": 2, "until": 1}, "before its way"),
        ({"type": "pull", "distance": 1, "duration": 1, "direction": [1, 1, 0]}, "along x, y or z"),
        ({"type": "pull", "distance": 1, "duration": 1, "depth": 1}, "both ends are gripped"),
        ({"type": "bend", "angle": 1, "duration": 1, "axis": [1, 0, 0]}, "must lie across"),
        ({"type": "twist", "angle": 1, "duration": 1, "object": "rod"}, "no object is called"),
    ],
)
def test_grips_that_cannot_be_are_refused(event: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        scene_of().add_event(event)


def test_a_grip_without_matter_is_refused() -> None:
    scene = scene_of()
    scene.grip([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
    with pytest.raises(InputError, match="no matter of bar in its box"):
        Run(scene, build_matter(scene, DX), 40.0)
    with pytest.raises(ValueError, match="grip 0 has no points"):
        ops.grip_rows(torch.zeros(2, 3), torch.ones(2), torch.tensor([-1, 1]), dx=1.0)
