"""Blades: sides, swept strips, fields that part; a cut block comes apart, an uncut one does not."""

from __future__ import annotations

import math

import pytest
import torch
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.data import Frame
from gsfluent.pipeline.colliders.blades import BladeSet
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene

DX = 0.1
ZERO = (0.0, 0.0, 0.0)
SOFT = materials.elastic.override(young_modulus=2e4)
BEND = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]


def sides(x: list[list[float]], rows: Tensor, reach: float = 0.3) -> list[int]:
    position = torch.tensor(x, dtype=torch.float64)
    cut = torch.zeros(len(x), dtype=torch.int32)
    return ops.blade_sides(position, rows, cut, reach).tolist()


def test_sides_are_given_over_the_swept_strip_only() -> None:
    rows = ops.blade_rows([[0, 0, 0], [2, 0, 0]], (0, 1, 0), 1.0, swept=(0.5, 1.2))
    # edge x way = y x x = -z: below is side 1
    points = [[1.0, 0, -0.1], [1.0, 0, 0.1], [1.3, 0, 0.1], [0.4, 0, 0.1], [1, 0.6, 0.1], [1, 0, 1]]
    assert sides(points, rows) == [1, 2, 0, 0, 0, 0]


def test_a_side_once_given_stays_and_blades_do_not_mix() -> None:
    first = ops.blade_rows([[0, 0, 0], [2, 0, 0]], (0, 1, 0), 1.0, number=0)
    second = ops.blade_rows([[1, 0, 1], [1, 0, -1]], (0, 1, 0), 1.0, number=3)
    x = torch.tensor([[0.9, 0, 0.1], [1.1, 0, 0.1]], dtype=torch.float64)
    cut = ops.blade_sides(x, torch.cat([first, second]), torch.zeros(2, dtype=torch.int32), 0.3)
    assert [(c >> 0) & 3 for c in cut.tolist()] == [2, 2]
    assert sorted((c >> 6) & 3 for c in cut.tolist()) == [1, 2]
    moved = x * torch.tensor([1, 1, -1])
    again = ops.blade_sides(moved, torch.cat([first, second]), cut, 0.3)
    assert torch.equal(again, cut)


def test_the_sheet_has_no_gap_at_a_bend() -> None:
    rows = ops.blade_rows(BEND, (0, 0, 1), 1.0)
    angle = torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)[:-1] + 0.01
    ring = torch.stack([1 + 0.2 * angle.cos(), 0.2 * angle.sin(), 0 * angle], dim=1)
    cut = ops.blade_sides(ring, rows, torch.zeros(72, dtype=torch.int32), 0.3)
    # The sheet comes from -x and leaves to +y: inside its right angle is one side, the rest other.
    inner = (ring[:, 0] < 1) & (ring[:, 1] > 0)
    assert torch.equal(cut, torch.where(inner, 1, 2).to(torch.int32))
    open_end = ops.blade_rows(BEND, (0, 0, 1), 1.0, swept=(0.0, 0.999))
    outer = (ring[:, 0] > 1.0) & (ring[:, 1] < 0)
    cut = ops.blade_sides(ring, open_end, torch.zeros(72, dtype=torch.int32), 0.3)
    assert cut[outer].abs().max() == 0


def test_merged_fields() -> None:
    parent = torch.tensor([0, 0, 0, 0, 1])
    cut = torch.tensor([0, 1, 2, 1 | 4, 2], dtype=torch.int32)
    merged = ops.merged_fields(parent, cut)
    assert merged[0].tolist() == [True, True, True, True, False]
    assert merged[1].tolist() == [True, True, False, True, False]
    assert merged[2].tolist() == [True, False, True, False, False]
    assert torch.equal(merged, merged.T)


def test_garbage_rows_do_nothing() -> None:
    rows = torch.full((3, 16), float("nan"), dtype=torch.float64)
    rows[1] = 1e300
    rows[2] = 0.0
    assert sides([[0, 0, 0], [float("nan"), 0, 0]], rows) == [0, 0]
    torch.library.opcheck(
        torch.ops.gsfluent.blade_sides,
        (torch.zeros(2, 3).double(), rows, torch.zeros(2, dtype=torch.int32), 1.0),
    )


@pytest.mark.parametrize(
    ("kw", "match"),
    [
        ({"path": [[0, 0, 0]]}, "path must have shape"),
        ({"path": [[0, 0, 0], [0, 0, 0]]}, "across the edge"),
        ({"edge": (1, 0, 0)}, "across the edge"),
        ({"edge": (0, 0, 0)}, "edge must be a direction"),
        ({"width": 0.0}, "width must be > 0"),
        ({"number": 15}, "number must be 0 to 14"),
    ],
)
def test_row_errors(kw: dict, match: str) -> None:  # type: ignore[type-arg]
    given = {"path": [[0, 0, 0], [1, 0, 0]], "edge": (0, 1, 0), "width": 1.0} | kw
    with pytest.raises(ValueError, match=match):
        ops.blade_rows(**given)


class Block:
    """An elastic or brittle block of 12 x 4 x 8 cells, 8 particles per cell."""

    def __init__(self, law: int = 0) -> None:
        axes = [(torch.arange(-n, n, dtype=torch.float64) + 0.5) * DX / 2 for n in (12, 4, 8)]
        self.x = torch.cartesian_prod(*axes) + 0.013
        n = len(self.x)
        self.v = torch.zeros(n, 3, dtype=torch.float64)
        self.c = torch.zeros(n, 3, 3, dtype=torch.float64)
        self.strain = torch.zeros(n, 6, dtype=torch.float64)
        self.stress = torch.zeros(n, 6, dtype=torch.float64)
        self.alpha = torch.full((n,), -0.02, dtype=torch.float64)
        self.volume = torch.full((n,), DX**3 / 8, dtype=torch.float64)
        self.mass = 1000.0 * self.volume
        self.law = torch.tensor([law], dtype=torch.int32)
        # E = 2e5 Pa, nu = 0.3; NACC: M, beta, xi of flesh.
        row = [7.69e4, 1.667e5, 1.85, 0.6, 3.0, 0.0, 1000.0, 0.0]
        self.params = torch.tensor([row], dtype=torch.float64)
        self.cut = torch.zeros(n, dtype=torch.int32)
        self.left = self.x[:, 0] < 0
        self.dt = 0.3 * DX / math.sqrt((1.667e5 + 4 / 3 * 7.69e4) / 1000)
        self.time = 0.0
        self.touched = 0
        self.impulse = torch.zeros(3, dtype=torch.float64)

    def step(self, blades: BladeSet | None = None, rows: Tensor | None = None) -> None:
        body = torch.zeros(len(self.x), dtype=torch.int32)
        now = self.time + self.dt
        if blades is not None:
            self.cut = blades.look(self.x, self.cut, self.time, now)
            rows = blades.faces(now)
        fields = BladeSet(Scene(), DX).fields(body, self.cut)
        blocks = ops.build_blocks(self.x, DX)
        grid, moments = ops.p2g(
            self.x, self.v, self.c, self.mass, dx=DX, dt=self.dt, blocks=blocks,
            stress=self.stress, volume=self.volume, body=fields.field, fields=fields.total,
            contact=True,
        )  # fmt: skip
        field, push, touched = ops.grid_update(
            grid, dx=DX, dt=self.dt, blocks=blocks, gravity=ZERO, moments=moments,
            merged=fields.merged, cut=fields.cut, colliders=rows, friction=0.3,
        )  # fmt: skip
        self.x, self.v, self.c, _ = ops.g2p(
            field, self.x, dx=DX, dt=self.dt, blocks=blocks, body=fields.field
        )
        self.strain, self.alpha, self.stress, _ = ops.return_mapping(
            self.strain, self.alpha, self.dt * self.c, law=self.law, params=self.params
        )
        self.time, self.touched = now, self.touched + int(touched)
        self.impulse = self.impulse + push.sum(dim=0)

    def momentum(self, which: Tensor) -> float:
        return float((self.mass * self.v[:, 0])[which].sum())


def knife(depth: float, thickness: float = 0.0, speed: float = 20.0) -> BladeSet:
    scene = Scene()
    scene.blade(
        [(0, 0, 0.5), (0, 0, 0.5 - depth)], width=1.0, thickness=thickness, speed=speed,
        edge=(0, 1, 0),
    )  # fmt: skip
    return BladeSet(scene, DX)


def cut_block(depth: float, law: int = 1) -> Block:
    block, blades = Block(law), knife(depth)
    while block.time < blades.ends(0)[1]:
        block.step(blades)
    return block


def test_a_zero_thickness_blade_moves_and_breaks_nothing() -> None:
    block, fresh = cut_block(1.0), Block()
    assert torch.equal(block.x, fresh.x) and torch.equal(block.alpha, fresh.alpha)
    assert block.v.abs().max() == 0.0 and block.touched == 0
    band = block.x[:, 0].abs() < 3 * DX
    assert torch.equal(block.cut != 0, band)
    # The path goes down (-z) with the edge along y: y x (-z) = -x is side 1.
    assert torch.equal(block.cut[band] == 1, block.left[band])


@pytest.mark.parametrize("law", [0, 1])
def test_a_cut_block_comes_apart_without_resistance(law: int) -> None:
    block = cut_block(1.0, law)
    block.v[:, 0] = torch.where(block.left, -0.05, 0.05).double()
    start = block.momentum(~block.left)
    mass = float(block.mass.sum())
    for _ in range(120):
        block.step()
    assert abs(block.momentum(~block.left) / start - 1) < 1e-3
    assert abs(block.momentum(block.left) / start + 1) < 1e-3
    gap = float(block.x[~block.left, 0].min() - block.x[block.left, 0].max())
    assert gap == pytest.approx(DX / 2 + 0.1 * 120 * block.dt, rel=0.02)
    assert float(block.mass.sum()) == mass and block.alpha.max() < 0


def test_an_uncut_block_and_one_cut_halfway_hold_together() -> None:
    """Tension is carried ahead of the edge: the halves are held back, the more the less is cut."""
    left = []
    for block in (Block(), cut_block(0.5, 0)):
        block.v[:, 0] = torch.where(block.left, -0.05, 0.05).double()
        start = block.momentum(~block.left)
        for _ in range(120):
            block.step()
        left.append(block.momentum(~block.left) / start)
    # A free bar would swing: half a period of 2 L / c is about 90 steps.
    assert left[0] < 0.5 and left[0] < left[1] < 0.9


def test_the_halves_push_each_other_when_pressed_together() -> None:
    block = cut_block(1.0, 0)
    block.v[:, 0] = torch.where(block.left, 0.05, -0.05).double()
    for _ in range(60):
        block.step()
    assert block.touched > 0
    overlap = float(block.x[block.left, 0].max() - block.x[~block.left, 0].min())
    assert overlap < 0.1 * DX
    assert block.momentum(~block.left) > -0.5 * 0.05 * float(block.mass.sum()) / 2


def test_a_thick_blade_opens_the_cut_by_its_thickness() -> None:
    thickness = 0.4 * DX
    block, blades = Block(), knife(1.2, thickness, speed=4.0)
    while block.time < blades.ends(0)[1] - 0.5 * DX / 4.0:
        block.step(blades)
    near = (block.x[:, 2] > -0.2) & (block.x[:, 2] < 0.3)
    right = float(block.x[near & ~block.left, 0].min())
    left = float(block.x[near & block.left, 0].max())
    # At the start the nearest layers are half a cell apart.
    assert right - left > DX / 2 + 0.5 * thickness
    assert right - left < DX / 2 + 3 * thickness
    assert block.cut.ne(0).any() and block.impulse.norm() > 0


def test_the_solver_is_the_operators_with_sides_and_faces() -> None:
    """A body cut halfway, its halves thrown together, and faces that push each its own side."""
    block = cut_block(0.5, 0)
    block.v = torch.where(block.left[:, None], 2.0, -2.0) * torch.tensor([1.0, 0.3, 0.1])
    block.v = block.v.double()
    block.v[:, 2] += block.x[:, 0]
    rows = knife(0.5, 0.4 * DX, speed=4.0).faces(0.12)
    assert rows.shape[0] == 4
    fields = BladeSet(Scene(), DX).fields(torch.zeros(len(block.x), dtype=torch.int32), block.cut)
    assert fields.total == 3

    def solver(order: Tensor) -> ops.Solver:
        return ops.Solver(
            block.x[order], block.v[order], block.mass[order], block.volume[order], dx=DX,
            law=block.law, params=block.params, body=fields.field[order], parent=fields.parent,
            cut=fields.cut, colliders=rows, gravity=ZERO, friction=0.3, dt=block.dt,
        )  # fmt: skip

    order = torch.randperm(len(block.x), generator=torch.Generator().manual_seed(0))
    one, other = solver(torch.arange(len(order))), solver(order)
    one.advance(steps=3)
    other.advance(steps=3)
    assert torch.equal(one.position[order], other.position)
    moving = rows.clone()
    for _ in range(3):
        block.step(rows=moving)
        moving[:, 3:6] += block.dt * moving[:, 10:13]
    assert block.touched > 0 and block.impulse.norm() > 0
    torch.testing.assert_close(one.position, block.x, rtol=0, atol=1e-12)
    torch.testing.assert_close(one.velocity, block.v, rtol=0, atol=1e-9)
    torch.testing.assert_close(one.impulse.sum(dim=0), block.impulse, rtol=1e-9, atol=1e-9)
    with pytest.raises(TypeError, match="cut must"):
        ops.Solver(
            block.x, block.v, block.mass, block.volume, dx=DX, law=block.law, params=block.params,
            body=fields.field, parent=fields.parent,
        )  # fmt: skip


# --- in a simulation ---


def sliced(
    depth: float,
    thickness: float = 0.0,
    material: materials.Material = SOFT,
    *,
    resident: bool = True,
    **scene_options: object,
) -> Run:
    """A ball of radius 0.1 in free space, cut along x = 0 from above."""
    scene = Scene(**{"floor": None, "gravity": ZERO} | scene_options)  # type: ignore[arg-type]
    lifted = Frame(torch.eye(3), torch.tensor([0.0, 0.0, 0.3]), 1.0)
    scene.add(ellipsoid(), material, frame=lifted)
    scene.blade(
        [(0, 0, 0.45), (0, 0, 0.45 - depth)], width=0.4, edge=(0, 1, 0), speed=4.0, at=0.02,
        thickness=thickness,
    )  # fmt: skip
    options = SolverOptions(max_rollbacks=3, resident=resident)
    return Run(scene, build_matter(scene, 0.04), 25.0, options)


def test_a_simulated_blade_makes_two_pieces_that_part() -> None:
    run = sliced(0.3)
    for frame in range(1, 5):
        assert run.advance_to(frame, None), run.failure
        _, pieces, stats = run.record(frame)
    assert run.report()["verdict"] == "clean" and stats["damaged_fraction"] == 0.0
    assert pieces.count == 2
    assert pieces.mass_fractions.tolist() == pytest.approx([0.5, 0.5], abs=0.02)
    assert stats["kinetic"] < 1e-6
    p = run.state.particles
    away = torch.where(p.position[:, :1] > 0, 0.5, -0.5) * torch.tensor([1.0, 0, 0])
    run.state = run.state._replace(particles=p.replace(velocity=away))
    run.watch.energy = float(0.5 * p.mass.sum() * 0.25)  # the push comes from outside
    half = away[:, 0] > 0
    start = [float((p.mass * away[:, 0])[which].sum()) for which in (half, ~half)]
    for frame in range(5, 8):
        assert run.advance_to(frame, None), run.failure
        run.record(frame)
    v = run.state.particles.velocity[:, 0]
    for which, before in zip((half, ~half), start, strict=True):
        assert float((p.mass * v)[which].sum()) == pytest.approx(before, rel=1e-3)


def test_a_blade_that_stops_inside_leaves_one_piece() -> None:
    run = sliced(0.15)
    for frame in range(1, 4):
        assert run.advance_to(frame, None), run.failure
        _, pieces, _ = run.record(frame)
    assert pieces.count == 1 and bool((run.state.cut != 0).any())
    # What is cut stays cut, what is not holds: the solver has to know both sides.
    assert run.stepper.blades.splits(run.state.field, run.state.cut).tolist() == [0]


def test_a_thick_blade_pushes_the_halves_apart_and_its_work_is_booked() -> None:
    run = sliced(0.35, thickness=0.03)
    for frame in range(1, 6):
        assert run.advance_to(frame, None), run.failure
        _, pieces, stats = run.record(frame)
    assert run.report()["verdict"] == "clean", run.report()["reason"]
    assert pieces.count == 2 and run.ledger.worst < 1e-4
    p = run.state.particles
    right = run.matter.rest[:, 0] > 0
    assert float(p.velocity[right, 0].mean() - p.velocity[~right, 0].mean()) > 0.01
    assert float(run.state.work) >= stats["kinetic"] > 0.0


def test_powder_of_both_sides_does_not_hold_the_halves_together() -> None:
    run = sliced(0.35, 0.03, materials.fruit.apple.override(alpha0=-0.02))
    for frame in range(1, 8):
        assert run.advance_to(frame, None), run.failure
        _, pieces, stats = run.record(frame)
    assert stats["damaged_fraction"] > 0.02 and pieces.count >= 2
    broken = run.state.ever
    assert bool((run.state.cut[broken] == 1).any() and (run.state.cut[broken] == 2).any())
    assert run.stepper.counters.composed_steps == 0 < run.stepper.counters.steps


@pytest.mark.parametrize("depth", [0.15, 0.35], ids=["halfway", "through"])
def test_both_engines_cut_alike(depth: float) -> None:
    """They differ by when they look: every step, or once per cell that the edge moves."""
    runs = []
    for resident in (True, False):
        run = sliced(depth, 0.03, resident=resident)
        right = run.matter.rest[:, 0] > 0
        for frame in range(1, 5):
            assert run.advance_to(frame, None), run.failure
            _, pieces, stats = run.record(frame)
        assert run.report()["verdict"] == "clean", run.report()["reason"]
        assert run.ledger.worst < 1e-4
        counters = run.stepper.counters
        assert counters.composed_steps == (0 if resident else counters.steps)
        p = run.state.particles
        given = float((p.mass * p.velocity[:, 0])[right].sum())
        runs.append((run.state, pieces, stats["kinetic"], given))
    (fast, made, kinetic, pushed), (slow, expected, *others) = runs
    assert made.count == expected.count == (1 if depth < 0.2 else 2)
    torch.testing.assert_close(made.mass_fractions, expected.mass_fractions, rtol=0, atol=0.01)
    assert float((fast.cut != slow.cut).double().mean()) < 0.01
    assert (fast.position - slow.position).norm(dim=1).mean() < 0.2 * 0.04
    if depth > 0.2:
        assert [kinetic, pushed] == pytest.approx(others, rel=0.2)


def test_what_begins_to_stand_is_cut_without_a_roll_back() -> None:
    """Its weight begins to act, which raises its energy while it has hardly any."""
    scene = Scene()
    scene.add(ellipsoid((0.125, 0.105, 0.105)), "fruit.watermelon")
    scene.blade([(0, 0, 0.23), (0, 0, 0.1)], width=0.4, edge=(0, 1, 0), speed=4.0, thickness=0.01)
    run = Run(scene, build_matter(scene, 0.25 / 22), 25.0)
    assert run.advance_to(1, None), run.failure
    assert run.report()["rollbacks"] == 0 and bool((run.state.cut != 0).any())
    assert float(run.state.work) > 0.0
