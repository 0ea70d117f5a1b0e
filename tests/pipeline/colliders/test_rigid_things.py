"""Rigid things in a simulation: standing, pressing, free; mesh distances; poured liquid."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials, ops
from gsfluent.data import Camera, Frame
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.colliders.splats import rigid_splats
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene
from gsfluent.spatial.mesh_distance import _point_triangle, mesh_body, signed_distances
from gsfluent.stages.simulate import saved

SOFT = materials.elastic.override(young_modulus=2e4)
DX = 0.05


def at(x: float, y: float, z: float) -> Frame:
    return Frame(torch.eye(3), torch.tensor([x, y, z]), 1.0)


def run_of(scene: Scene, fps: float = 20.0, dx: float = DX) -> Run:
    return Run(scene, build_matter(scene, dx), fps, SolverOptions(max_rollbacks=3))


def go(run: Run, frames: int) -> None:
    for frame in range(1, frames + 1):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
    assert run.report()["verdict"] == "clean", run.report()["reason"]
    assert run.ledger.worst < 1e-4


# --- meshes ---


@pytest.fixture(scope="module")
def mesh_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box of 0.2 x 0.3 x 0.4 as a mesh, off its own origin, in millimetres."""
    import trimesh

    path = tmp_path_factory.mktemp("mesh") / "box.obj"
    box = trimesh.creation.box((200.0, 300.0, 400.0))
    box.apply_translation((50.0, 0.0, 0.0))
    box.export(path)
    return path


def test_mesh_distances_are_those_of_the_shape(mesh_file: Path) -> None:
    body = mesh_body(mesh_file, 1e-3, 0.02)
    assert body.volume == pytest.approx(0.024)
    assert body.center == pytest.approx([0.05, 0, 0], abs=1e-9)
    edges = np.array([0.2, 0.3, 0.4])
    want = [0.024 / 12 * ((edges**2).sum() - e**2) for e in edges]
    assert np.sort(body.inertia) == pytest.approx(np.sort(want), rel=1e-6)
    axes = [body.corner[i] + body.spacing * np.arange(body.values.shape[i]) for i in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    file_frame = nodes @ body.axes.T
    q = np.abs(file_frame) - 0.5 * edges
    exact = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)
    assert np.abs(body.values - exact).max() < 1e-6


def test_distances_far_from_a_mesh_are_those_of_its_nearest_triangle() -> None:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    triangles, spacing = np.asarray(ball.triangles), 0.17
    size, corner = np.array([24, 23, 22]), np.array([-2.0, -1.9, -1.8])
    values = np.abs(signed_distances(triangles, corner, spacing, size))
    axes = [corner[i] + spacing * np.arange(size[i]) for i in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    exact = np.full(len(nodes), np.inf)
    for triangle in triangles:  # every one of them
        each = np.broadcast_to(triangle, (len(nodes), 3, 3))
        exact = np.minimum(exact, _point_triangle(nodes, each))
    beyond = values.reshape(-1) - exact
    far = exact > 5.0 * spacing
    assert far.sum() > 1000
    assert np.abs(beyond[exact < 4.0 * spacing]).max() < 1e-6
    assert beyond.min() > -1e-6 and beyond[far].max() < 0.15 * spacing


def test_open_meshes_and_other_files_are_refused(mesh_file: Path, tmp_path: Path) -> None:
    import trimesh

    mesh = trimesh.load_mesh(str(mesh_file))
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(tmp_path / "open.obj")
    with pytest.raises(InputError, match="is not closed"):
        mesh_body(tmp_path / "open.obj", 1.0, 10.0)
    (tmp_path / "bad.obj").write_text("nothing here")
    with pytest.raises(InputError, match=r"cannot be read|holds no triangles"):
        mesh_body(tmp_path / "bad.obj", 1.0, 10.0)


def test_a_mesh_collider_is_the_box_it_is_made_of(mesh_file: Path) -> None:
    scene = Scene(floor=None)
    scene.add_collider("mesh", mesh=mesh_file, scale=1e-3, at=(0.1, 0, 0.2), turn=(0, 0, 30))
    turned = torch.tensor([0.05 * math.cos(math.pi / 6), 0.05 * math.sin(math.pi / 6), 0.0])
    middle = (torch.tensor([0.1, 0, 0.2]) + turned).tolist()
    scene.add_collider("box", size=(0.2, 0.3, 0.4), at=middle, turn=(0, 0, 30), mass=2.0)
    rigid = RigidSet(scene, 0.04)
    x = torch.rand(3000, 3, dtype=torch.float64) - 0.5 + torch.tensor([0.1, 0, 0.2])
    d, _ = ops.collider_distance(x, rigid.start, rigid.sdf)
    near = d[:, 1].abs() < 0.03
    # Interpolation rounds the edges off by up to half a spacing of 0.02.
    assert (d[:, 0] - d[:, 1])[near].abs().max() < 0.0085
    assert (d[:, 0] - d[:, 1])[near].abs().mean() < 1e-3
    density = 2.0 / 0.024
    want = [density * 0.024 / 12 * v for v in (0.09 + 0.16, 0.04 + 0.16, 0.04 + 0.09)]
    assert rigid.start[1, 23:26].tolist() == pytest.approx(want)


# --- motion ---


def test_a_plate_moves_between_its_times_only() -> None:
    scene = Scene()
    scene.add(ellipsoid(), SOFT)
    scene.press(speed=0.5, stroke=0.05, at=0.13)
    rigid = RigidSet(scene, DX)
    rows, time = rigid.start, 0.0
    top = float(rows[1, 5])
    while time < 0.4:
        dt = min(0.031, 0.4 - time, rigid.next_change(time) - time)
        before = float(rows[1, 5])
        rows = rigid.advance(rows, time, dt)
        assert (before - float(rows[1, 5]) > 0) == (0.13 <= time < 0.23 - 1e-12)
        time += dt
    assert top - float(rows[1, 5]) == pytest.approx(0.05, abs=1e-12)
    assert rigid.next_change(0.3) == math.inf


def test_a_press_and_its_floor_are_stiffer_than_what_bodies_land_on() -> None:
    scene = Scene()
    scene.add(ellipsoid(), SOFT)
    scene.add_collider("sphere", at=(0.0, 0.0, 2.0), radius=0.1)
    assert RigidSet(scene, DX).start[:, 31].tolist() == [0.0, 0.0]
    scene.press(speed=0.5, stroke=0.05)
    assert RigidSet(scene, DX).start[:, 31].tolist() == [3.0, 0.0, 3.0]


def test_a_free_ball_passes_its_point_at_its_time_and_stops_at_the_floor() -> None:
    scene = Scene()
    scene.add(ellipsoid(), SOFT)
    scene.bullet((1.0, 0.2, 0.5), (0, 0, 0), 3.0, radius=0.06, at=0.2, rigid=True)
    rigid = RigidSet(scene, DX)
    rows = rigid.start
    for i in range(20):
        rows = rigid.advance(rows, 0.01 * i, 0.01)
    assert rows[1, 3:6].tolist() == pytest.approx([1.0, 0.2, 0.5], abs=1e-12)
    way = torch.tensor([-1.0, -0.2, -0.5])
    assert rows[1, 10:13].tolist() == pytest.approx((3 * way / way.norm()).tolist(), abs=1e-6)
    for i in range(20, 60):
        rows = rigid.advance(rows, 0.01 * i, 0.01)
    assert float(rows[1, 5]) == pytest.approx(0.06) and float(rows[1, 12]) >= 0.0


# --- with matter ---


def test_a_press_squeezes_and_does_work() -> None:
    scene = Scene()
    scene.add(ellipsoid(), SOFT)
    scene.press(speed=0.4, stroke=0.06)
    run = run_of(scene)
    go(run, 4)
    top = float(run.state.particles.position[:, 2].max())
    face = float(run.state.colliders[1, 5] - run.state.colliders[1, 28])
    assert face == pytest.approx(0.2 - 0.06, abs=1e-6)
    # The grid holds nodes, not points: matter sinks in by a fraction of a cell.
    assert face - 1.2 * DX < top < face + 0.5 * DX
    # The work of the plate is what the ball gained, at least; its weight strains it, too.
    gained = run.figures.total - run.start.total
    assert run.figures.elastic > 0.1 and float(run.state.work) > gained


def test_a_rigid_bullet_gives_its_target_what_it_loses() -> None:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid(), SOFT)
    scene.bullet((0.4, 0.02, 0.01), (0, 0.02, 0.01), 10.0, radius=0.02, rigid=True)
    run = run_of(scene, fps=50)
    mass = float(run.state.colliders[0, 14])
    go(run, 3)
    lost = mass * (torch.tensor([-10.0, 0, 0]).double() - run.state.colliders[0, 10:13])
    given = torch.tensor(run.figures.momentum).double()
    assert (lost - given).norm() < 1e-5 * mass * 10.0
    assert float(lost.norm()) > 0.1 * mass * 10.0


def test_a_table_holds_what_falls_on_it() -> None:
    scene = Scene()
    scene.add_collider("box", at=(0, 0, 0.15), size=(0.6, 0.6, 0.3), friction=0.5)
    scene.add(ellipsoid(), SOFT, frame=at(0, 0, 0.42))
    run = run_of(scene)
    go(run, 8)
    assert float(run.state.particles.position[:, 2].min()) > 0.3 - 0.5 * DX
    assert run.state.landed == (True,)


def test_two_thrown_objects_meet_and_their_middle_stays() -> None:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    scene.add(ellipsoid(), SOFT, name="a", frame=at(-0.3, 0, 0))
    scene.add(ellipsoid(), SOFT, name="b", frame=at(0.3, 0.03, 0))
    scene.collide(["a", "b"], 4.0)
    run = run_of(scene)
    middle = run.matter.rest.double().mean(dim=0)
    go(run, 6)
    now = run.state.particles.position.double().mean(dim=0)
    assert (now - middle).norm() < 1e-3
    (a, b), (c, d) = run.matter.ranges
    speeds = [run.state.particles.velocity[i:j, 0].mean() for i, j in ((a, b), (c, d))]
    assert speeds[0] < -0.3 and speeds[1] > 0.3
    assert run.stepper.counters.flight_seconds > 0.03


def test_a_jet_waits_then_falls_then_meets_the_table() -> None:
    scene = Scene()
    scene.add_collider("box", at=(0, 0, 0.05), size=(0.6, 0.6, 0.1))
    scene.pour((0, 0, 0.5), 1.0, 0.06, duration=0.15, material=SOFT, at=0.1)
    run = run_of(scene, dx=0.04)
    rest = run.matter.rest.clone()
    volume = float(run.matter.particles.volume.sum())
    assert volume == pytest.approx(math.pi * 0.06**2 * 0.15, rel=1e-5)
    go(run, 2)
    assert torch.equal(run.state.particles.position, rest)
    go_on = run.advance_to(3, None)
    fallen = (run.state.particles.position - rest).double()
    assert go_on and fallen[:, 2].mean() == pytest.approx(-(0.05 + 0.5 * 9.81 * 0.05**2), rel=1e-4)
    for frame in range(4, 10):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
    assert run.ledger.worst < 1e-4 and run.state.landed == (True,)
    assert float(run.state.particles.position[:, 2].min()) > 0.1 - 0.5 * 0.04


def test_surfaces_to_draw_lie_on_the_shapes(mesh_file: Path) -> None:
    scene = Scene()
    scene.add_collider("sphere", radius=0.2, at=(0, 0, 1))
    scene.add_collider("mesh", mesh=mesh_file, scale=1e-3, at=(1, 0, 1))
    scene.add_collider("box", size=(0.3, 0.2, 0.04), turn=(0, 30, 0), at=(0, 1, 1))
    scene.add_collider("cylinder", radius=0.1, length=0.3, turn=(40, 0, 0), at=(0, 2, 1))
    rigid = RigidSet(scene, 0.04)
    drawn = rigid.surfaces(rigid.start)
    assert drawn is not None
    points, normals = drawn.points, drawn.turn[..., 2]
    d, n = ops.collider_distance(points, rigid.start[1:], rigid.sdf)
    assert d.abs().min(dim=1).values.max() < 0.01
    shape = d.abs().argmin(dim=1)
    exact = (d.abs().min(dim=1).values < 1e-6) & (shape != 1)
    assert torch.equal(exact, shape != 1)  # all but the mesh, whose distances are interpolated
    assert torch.allclose(normals[shape == 0], n[shape == 0, 0], atol=1e-6)
    for number in range(4):
        mine = shape == number
        assert 300 < int(mine.sum()) < 20_000
        # a rotation: no mirrored splat
        assert torch.allclose(torch.linalg.det(drawn.turn[mine]), torch.ones(()).double())


def test_a_plate_is_closed_and_ends_at_its_edges() -> None:
    scene = Scene(floor=None)
    scene.add_collider("box", size=(0.3, 0.2, 0.04))
    rigid = RigidSet(scene, 0.04)
    splats = rigid_splats(rigid, rigid.start)
    assert splats is not None
    above = Camera.look_at(
        (0, 0, 2.0), (0, 0, 0), width=240, height=160, fov=8.5, up=(0.0, 1.0, 0.0)
    )
    alpha = draw(splats, above).alpha
    # where a ray through the middle of each pixel meets the plane of the upper face
    pixel = (2.0 - 0.02) / float(above.K[0, 0])
    x = (torch.arange(240) + 0.5 - float(above.K[0, 2])) * pixel
    y = (torch.arange(160) + 0.5 - float(above.K[1, 2])) * pixel
    inward = torch.minimum(0.15 - x.abs()[None, :], 0.1 - y.abs()[:, None])
    assert float(alpha[inward > 0.001].min()) > 0.99
    # within a pixel and a half of the edge it is gone
    assert float(alpha[inward < -1.5 * pixel].max()) < 0.02


def test_frames_show_plate_bullet_and_liquid() -> None:
    scene = Scene()
    scene.add(ellipsoid(), SOFT)
    scene.press(speed=0.4, stroke=0.02, thickness=0.05)
    scene.bullet((1, 0, 0.6), (0, 0, 0.5), 1.0, radius=0.03, rigid=True)
    scene.pour((0.4, 0, 0.6), 0.5, 0.03, duration=0.1, material="milk", at=1.0)
    solid = scene.bodies[0].solid
    assert solid is not None
    (frame,) = Simulate(dx=DX)(scene, fps=20, seconds=0.05)
    kept = saved(frame, scene)
    own = frame.carried.count
    assert own == solid.gaussians.count
    extra = kept.gaussians.means[own : kept.carried]
    jet = int((frame.particles.body == 1).sum())
    assert extra.shape[0] > jet + 600
    # One splat a point, in its sheet: no farther off than the points are apart.
    milk = kept.gaussians.means[own : own + jet]
    points = frame.particles.position[frame.particles.body == 1]
    assert float((milk - points).norm(dim=1).max()) < 1.5 * DX / 2.0
    steel = extra[jet:]
    ball = (steel - torch.tensor([1.0, 0.0, 0.6])).norm(dim=1)
    # Drawn as large as it is, though the grid sees it with 0.9 cells.
    assert ((ball - 0.03).abs() < 1e-4).sum() > 200
    plate = steel[(ball > 0.1)]
    assert float(plate[:, 2].min()) == pytest.approx(0.2, abs=1e-3)
    assert float(plate[:, 2].max()) == pytest.approx(0.25, abs=1e-3)
