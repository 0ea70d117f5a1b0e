"""Contact between fields (equations.md 11.3, 11.4) and rigid colliders: physics, exact sums."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import mpm as reference
from gsfluent.ops.reference.contact import contact_normal

DX = 0.1
ZERO = (0.0, 0.0, 0.0)


def block(
    lo: tuple[float, ...], hi: tuple[float, ...], density: float = 1.0
) -> tuple[Tensor, Tensor]:
    """A box given in cells, filled by a lattice of 8 particles per cell; positions, masses."""
    axes = [(torch.arange(2 * round(b - a)) + 0.5) / 2 + a for a, b in zip(lo, hi, strict=True)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    return grid.double() * DX, torch.full((len(grid),), density * DX**3 / 8, dtype=torch.float64)


class Pair:
    """Two bodies, one step at a time."""

    def __init__(
        self, a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor], va: Any, vb: Any
    ) -> None:
        self.x = torch.cat([a[0], b[0]])
        self.mass = torch.cat([a[1], b[1]])
        na, nb = len(a[0]), len(b[0])
        self.body = torch.tensor([0] * na + [1] * nb, dtype=torch.int32)
        velocity = [torch.tensor(v, dtype=torch.float64) for v in (va, vb)]
        self.v = torch.cat([velocity[0].expand(na, 3), velocity[1].expand(nb, 3)])
        self.affine = torch.zeros(na + nb, 3, 3, dtype=torch.float64)

    def scatter(self, dt: float = 0.0, load: tuple[Tensor, Tensor] | None = None) -> None:
        stress, volume = load if load is not None else (None, None)
        self.blocks = ops.build_blocks(self.x, DX)
        self.grid, self.moments = ops.p2g(
            self.x,
            self.v,
            self.affine,
            self.mass,
            dx=DX,
            blocks=self.blocks,
            dt=dt,
            stress=stress,
            volume=volume,
            body=self.body,
            fields=2,
            contact=True,
        )

    def update(
        self, dt: float = 1e-3, load: tuple[Tensor, Tensor] | None = None, **law: Any
    ) -> tuple[Tensor, int]:
        self.scatter(dt, load)
        v, self.impulse, touched = ops.grid_update(
            self.grid,
            dx=DX,
            dt=dt,
            blocks=self.blocks,
            gravity=ZERO,
            moments=self.moments,
            **law,
        )
        return v, int(touched)

    def step(self, dt: float, **kw: Any) -> int:
        v, touched = self.update(dt, **kw)
        self.x, self.v, self.affine, _ = ops.g2p(
            v, self.x, dx=DX, dt=dt, blocks=self.blocks, body=self.body
        )
        return touched

    def kinetic(self, v: Tensor) -> Tensor:
        return 0.5 * (self.grid[..., 3] * v.square().sum(-1)).sum()

    def momentum(self, v: Tensor) -> Tensor:
        return (self.grid[..., 3:] * v).sum((0, 1, 2))

    def mean(self, which: int, what: Tensor) -> Tensor:
        return what[self.body == which].mean(0)


def head_on(density_b: float = 1.0, boost: Any = ZERO) -> Pair:
    va = [1.0 + boost[0], boost[1], boost[2]]
    vb = [-1.0 + boost[0], boost[1], boost[2]]
    return Pair(block((-4, 0, 0), (0, 4, 4)), block((0, 0, 0), (4, 4, 4), density_b), va, vb)


def before(pair: Pair) -> Tensor:
    mass = pair.grid[..., 3:]
    return torch.where(mass > 0, pair.grid[..., :3] / mass.clamp_min(1e-300), 0.0)


def normal_of_contact(pair: Pair) -> tuple[Tensor, Tensor]:
    """Nodes the two fields share and the normal out of field 0, by the reference."""
    assert pair.moments is not None
    shared = (pair.grid[..., 3] > 0).all(0)
    near = reference.neighbours(torch.cat([pair.grid[..., 3:], pair.moments], -1), pair.blocks)
    normal, _ = contact_normal(
        (near[0, ..., 0], near[1, ..., 0]), (near[0, ..., 1:], near[1, ..., 1:])
    )
    return shared, normal


# --- reference ---


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("fields", [2, 4])
def test_contact_and_colliders_match_reference(dtype: torch.dtype, fields: int) -> None:
    n = 600
    x = (torch.rand(n, 3) - 0.4).to(dtype)
    body = torch.randint(0, fields, (n,), dtype=torch.int32)
    blocks = ops.build_blocks(x, DX)
    c = torch.zeros(n, 3, 3, dtype=dtype)
    grid, moments = ops.p2g(
        x,
        torch.randn(n, 3, dtype=dtype),
        c,
        torch.rand(n, dtype=dtype) + 0.1,
        dx=DX,
        blocks=blocks,
        body=body,
        fields=fields,
        contact=True,
    )
    assert moments is not None
    colliders = torch.tensor(
        [
            [0, 0, 0, 0, 0, -0.3, 0.1, 0, 2, 0, 0, 0, 0, 0, 0, 0],
            [0, 1, 0, 0.4, 0, 0, -1, 0, 0, 0, 0.3, 0, 0, 0, 0, 0],
            [1, 2, 0.3, 0.1, 0, 0, 0, 0, 0, 0.23, 0, 0.5, 0, 0.4, 0, 0],
        ],
        dtype=dtype,
    )
    kw: dict[str, Any] = {"dx": DX, "dt": 1e-2, "blocks": blocks, "restitution": 0.3}
    v, impulse, touched = ops.grid_update(grid, moments=moments, colliders=colliders, **kw)
    want = reference.grid_update(
        grid.double(), moments=moments.double(), colliders=colliders.double(), **kw
    )
    if dtype == torch.float64:
        assert touched == want[-1]
        assert (v - want[0]).abs().max() <= 1e-12 * want[0].abs().max()
        assert (impulse - want[1]).abs().max() <= 1e-12 * want[1].abs().max()
    else:  # nodes that sit on a gate within rounding may go the other way
        wrong = ((v.double() - want[0]).abs() > 1e-4 * want[0].abs().max()).double().mean()
        assert wrong < 2e-3


# --- contact, equations.md 11.4 ---


def test_head_on_blocks_have_no_approach_velocity_left() -> None:
    pair = head_on()
    v, touched = pair.update(friction=0.0, contact_gap=3.0)  # every shared node is in contact
    shared, n = normal_of_contact(pair)
    assert touched == int(shared.sum()) > 50
    gap_speed = ((v[0] - v[1]) * n).sum(-1)[shared]
    assert gap_speed.max() <= 1e-12
    old = before(pair)
    assert (old[0] - old[1])[..., 0][shared].min() > 1.99


def test_contact_is_galilean_invariant() -> None:
    v, touched = head_on().update()
    boost = (3.0, -7.0, 11.0)
    w, touched_moving = head_on(boost=boost).update()
    mass = head_on()
    mass.scatter()
    heavy = mass.grid[..., 3:] > 1e-30
    assert touched == touched_moving
    shifted = torch.where(heavy, w - torch.tensor(boost, dtype=torch.float64), 0.0)
    assert (v - shifted).abs().max() < 1e-12


@pytest.mark.parametrize("density", [1.0, 1e3, 1e-3])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_contact_conserves_momentum_and_never_gains_energy(
    density: float, restitution: float, friction: float
) -> None:
    pair = head_on(density)
    pair.v[pair.body == 1] += torch.tensor([0.0, 0.8, -0.3], dtype=torch.float64)
    v, touched = pair.update(friction=friction, restitution=restitution)
    old = before(pair)
    assert touched > 0
    scale = (pair.grid[..., 3:] * old.abs()).sum()
    assert (pair.momentum(v) - pair.momentum(old)).abs().max() <= 1e-14 * scale
    assert pair.kinetic(v) <= pair.kinetic(old) * (1 + 1e-13)
    if restitution == 1.0 and friction == 0.0:
        assert math.isclose(float(pair.kinetic(v)), float(pair.kinetic(old)), rel_tol=1e-12)
    shared, n = normal_of_contact(pair)
    approach_before = ((old[0] - old[1]) * n).sum(-1)
    approach_after = ((v[0] - v[1]) * n).sum(-1)
    changed = shared & ((v[0] - old[0]).abs().sum(-1) > 1e-9)
    assert torch.allclose(
        approach_after[changed], -restitution * approach_before[changed], atol=1e-9
    )


def test_contact_in_float32_conserves_momentum() -> None:
    pair = head_on(1e3)
    pair.scatter()
    assert pair.moments is not None
    grid = pair.grid.float()
    kw: dict[str, Any] = {"dx": DX, "dt": 1e-3, "blocks": pair.blocks, "gravity": ZERO}
    v, _, touched = ops.grid_update(grid, moments=pair.moments.float(), **kw)
    total = (grid.double()[..., 3:] * v.double()).sum((0, 1, 2))
    old = grid.double()[..., :3]
    assert touched > 0
    assert (total - old.sum((0, 1, 2))).abs().max() <= 1e-6 * old.abs().sum()


def test_separating_and_distant_bodies_do_not_touch() -> None:
    leaving = head_on()
    leaving.v.neg_()
    v, touched = leaving.update()
    assert touched == 0 and torch.allclose(v, before(leaving), atol=1e-14)
    # A gap of one cell: the fields share nodes, the bodies do not touch (11.3, gate).
    apart = Pair(
        block((-4, 0, 0), (0, 4, 4)), block((1, 0, 0), (5, 4, 4)), [1.0, 0, 0], [-1.0, 0, 0]
    )
    _, touched = apart.update(contact_gap=1.0)
    shared, _ = normal_of_contact(apart)
    assert int(shared.sum()) > 0 and touched == 0
    assert apart.update(contact_gap=2.5)[1] > 0


def test_pulled_apart_bodies_do_not_stick() -> None:
    # One velocity field glues touching bodies; two do not (solver.md 0.5).
    pair = Pair(
        block((-4, 0, 0), (0, 4, 4)), block((0, 0, 0), (4, 4, 4)), [-0.1, 0, 0], [0.1, 0, 0]
    )
    for _ in range(10):
        pair.step(0.02)
    assert torch.allclose(pair.mean(0, pair.v), torch.tensor([-0.1, 0, 0]).double(), atol=1e-12)
    assert torch.allclose(pair.mean(1, pair.v), torch.tensor([0.1, 0, 0]).double(), atol=1e-12)


def test_resting_block_does_not_sink() -> None:
    """A small-strain elastic block on fixed ground under 1 m/s^2."""
    # It starts a third of a cell into the reach of the ground, so that it is in contact at once.
    pair = Pair(block((-2, -2, -0.3), (2, 2, 1.7)), block((-3, -3, -1), (3, 3, 0), 1e9), ZERO, ZERO)
    ours, dt, lame = pair.body == 0, 4e-3, 60.0  # wave speed 13 m/s at density 1: CFL 0.5
    strain = torch.zeros(len(pair.x), 3, 3, dtype=torch.float64)
    volume = torch.full_like(pair.mass, DX**3 / 8)
    height = []
    for _ in range(80):
        pair.v[ours, 2] -= dt
        trace = strain.diagonal(dim1=1, dim2=2).sum(1)
        tau = lame * (trace[:, None, None] * torch.eye(3) + 2 * strain)
        tau = torch.where(ours[:, None, None], tau, 0.0)
        six = tau.flatten(1)[:, [0, 4, 8, 1, 2, 5]].contiguous()
        assert pair.step(dt, load=(six, volume)) > 0
        strain = strain + 0.5 * dt * (pair.affine + pair.affine.mT)
        pair.v[~ours], pair.affine[~ours] = 0.0, 0.0
        height.append(pair.mean(0, pair.x)[2])
    # Mean height over two successive windows: the elastic bounce averages out.
    sunk = torch.stack(height[30:55]).mean() - torch.stack(height[55:]).mean()
    assert abs(float(sunk)) <= 0.1 * DX * (25 * dt)


@pytest.mark.parametrize("friction", [0.5, 1.0, 1.5])
def test_forty_five_degree_impact_stops_at_friction_one(friction: float) -> None:
    # The relative velocity makes 45 degrees with the normal: Coulomb friction stops the slide
    # exactly when its coefficient reaches tan 45 = 1, and leaves 1 - mu of it below.
    ground = block((-4, -4, -1), (4, 4, 0), 1e9)
    pair = Pair(block((-4, -4, -0.3), (4, 4, 0.7)), ground, [1.0, 0.0, -1.0], ZERO)
    v, touched = pair.update(friction=friction)
    shared, n = normal_of_contact(pair)
    old = before(pair)
    hit = shared & (n[..., 2] < -1 + 1e-12) & ((v[0] - old[0]).abs().sum(-1) > 1e-9)
    assert 4 <= int(hit.sum()) <= touched
    assert v[0][hit][:, 2].abs().max() < 1e-6
    assert (v[0][hit][:, 0] - max(0.0, 1.0 - friction)).abs().max() < 1e-6


def test_three_bodies_exchange_momentum_exactly() -> None:
    n = 900
    x = torch.rand(n, 3, dtype=torch.float64) * 0.5
    body = torch.randint(0, 3, (n,), dtype=torch.int32)
    v = torch.randn(n, 3, dtype=torch.float64)
    blocks = ops.build_blocks(x, DX)
    grid, moments = ops.p2g(
        x,
        v,
        torch.zeros(n, 3, 3, dtype=torch.float64),
        torch.rand(n, dtype=torch.float64) + 0.1,
        dx=DX,
        blocks=blocks,
        body=body,
        fields=3,
        contact=True,
    )
    after, _, touched = ops.grid_update(
        grid, dx=DX, dt=0.0, blocks=blocks, moments=moments, gravity=ZERO
    )
    old, new = grid[..., :3], grid[..., 3:] * after
    assert touched > 50
    assert torch.allclose(old.sum((0, 1, 2)), new.sum((0, 1, 2)), atol=1e-12)
    mass = grid[..., 3].clamp_min(1e-300)
    assert (new.square().sum(-1) / mass).sum() <= (old.square().sum(-1) / mass).sum() * (1 + 1e-13)


# --- colliders ---


def plane(mode: int, friction: float = 0.0, z: float = 0.0, **kw: float) -> Tensor:
    row = torch.zeros(1, 16, dtype=torch.float64)
    row[0, [1, 2, 5, 8]] = torch.tensor([mode, friction, z, 1.0], dtype=torch.float64)
    row[0, 10:13] = torch.tensor([kw.get(k, 0.0) for k in ("vx", "vy", "vz")])
    row[0, 13] = kw.get("restitution", 0.0)
    return row


def one_step(
    colliders: Tensor, v: tuple[float, float, float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A block across z = 0: mass, velocity before, velocity after, impulse."""
    x, mass = block((0, 0, -2), (4, 4, 2))
    velocity = torch.tensor(v, dtype=torch.float64).expand_as(x)
    blocks = ops.build_blocks(x, DX)
    affine = torch.zeros(len(x), 3, 3, dtype=torch.float64)
    grid, _ = ops.p2g(x, velocity, affine, mass, dx=DX, blocks=blocks)
    old, _, _ = ops.grid_update(grid, dx=DX, dt=0.0, blocks=blocks, gravity=ZERO)
    new, impulse, _ = ops.grid_update(
        grid, dx=DX, dt=0.0, blocks=blocks, gravity=ZERO, colliders=colliders
    )
    inside = (blocks.node_positions(DX)[..., 2] <= 1e-9)[None] & (grid[..., 3] > 0)
    assert int(inside.sum()) > 50
    assert torch.equal(new[~inside], old[~inside])
    assert torch.allclose(impulse.sum(0), (grid[..., 3:] * (new - old)).sum((0, 1, 2)), atol=1e-15)
    return grid[..., 3][inside], old[inside], new[inside], impulse


def test_sticky_collider_carries_nodes_along() -> None:
    _, _, new, _ = one_step(plane(0, vx=0.5), (1.0, 2.0, -3.0))
    assert torch.allclose(new, torch.tensor([0.5, 0, 0]).double().expand_as(new))


def test_slip_collider_removes_normal_velocity_both_ways() -> None:
    for vz in (-3.0, 3.0):
        _, _, new, _ = one_step(plane(1, friction=9.0), (1.0, 2.0, vz))
        assert torch.allclose(
            new, torch.tensor([1.0, 2.0, 0.0]).double().expand_as(new), atol=1e-14
        )


def test_separating_collider_lets_go_and_rubs() -> None:
    _, old, new, impulse = one_step(plane(2, friction=0.5), (0.0, 2.0, 3.0))
    assert torch.equal(new, old) and impulse.abs().max() == 0
    _, _, new, _ = one_step(plane(2, friction=0.5), (0.0, 2.0, -1.0))
    assert torch.allclose(new, torch.tensor([0.0, 1.5, 0.0]).double().expand_as(new), atol=1e-13)
    _, _, new, _ = one_step(plane(2, friction=9.0), (0.0, 2.0, -1.0))
    assert new.abs().max() < 1e-13


@pytest.mark.parametrize("mode", [0, 1, 2])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_resting_collider_never_gains_energy(mode: int, restitution: float) -> None:
    rows = plane(mode, 0.4, restitution=restitution)
    mass, old, new, _ = one_step(rows, (0.7, -2.0, -1.0))
    kinetic = [0.5 * (mass * v.square().sum(-1)).sum() for v in (old, new)]
    assert kinetic[1] <= kinetic[0] * (1 + 1e-13)
    if mode == 2:
        assert torch.allclose(new[:, 2], torch.full_like(new[:, 2], restitution), atol=1e-13)


def test_impulse_of_two_colliders_balances_the_momentum_change() -> None:
    rows = torch.cat([plane(2, 0.3), plane(2, 0.2, z=-0.1, restitution=0.5)])
    _, _, _, impulse = one_step(rows, (1.0, 0.0, -2.0))
    assert impulse.dtype == torch.float64
    assert impulse[0, 2] > 0 and impulse[0, 0] < 0  # floor pushes up and rubs against the motion
    assert impulse[1].abs().max() == 0  # the first one already stopped its nodes


def test_sphere_collider_pushes_outwards_and_moves_with_its_velocity() -> None:
    row = torch.zeros(1, 16, dtype=torch.float64)
    row[0, [0, 1, 3, 4, 5, 9, 12]] = torch.tensor([1, 2, 0.2, 0.2, 0, 0.17, 1.5]).double()
    x, mass = block((0, 0, 0), (4, 4, 4))
    blocks = ops.build_blocks(x, DX)
    zero = torch.zeros(len(x), 3, 3, dtype=torch.float64)
    grid, _ = ops.p2g(x, torch.zeros_like(x), zero, mass, dx=DX, blocks=blocks)
    v, impulse, _ = ops.grid_update(grid, dx=DX, dt=0.0, blocks=blocks, gravity=ZERO, colliders=row)
    node = blocks.node_positions(DX)
    offset = node - row[0, 3:6]
    above = ((offset.norm(dim=-1) <= 0.17) & (offset[..., 2] > 0.5 * DX))[None] & (grid[..., 3] > 0)
    n = torch.nn.functional.normalize(offset, dim=-1)[None][above]
    assert int(above.sum()) > 3
    # A node overtaken by the sphere gets exactly the sphere's normal velocity (frictionless).
    assert torch.allclose((v[above] * n).sum(-1), 1.5 * n[:, 2], atol=1e-13)
    assert impulse[0, 2] > 0
    assert torch.allclose(impulse[0], (grid[..., 3:] * v).sum((0, 1, 2)), atol=1e-15)


def test_floor_at_a_multiple_of_dx_holds_its_own_nodes_in_float32() -> None:
    # 3 * 0.1f is above 0.3f: the tolerance of the collider surface decides, not rounding.
    for k in range(-7, 8):
        x = torch.tensor([[0.0, 0.0, k * 0.1]])
        blocks = ops.build_blocks(x, 0.1)
        grid, _ = ops.p2g(
            x,
            torch.tensor([[0.0, 0, -1]]),
            torch.zeros(1, 3, 3),
            torch.ones(1),
            dx=0.1,
            blocks=blocks,
        )
        row = plane(0, z=k * 0.1).float()
        v, _, _ = ops.grid_update(grid, dx=0.1, dt=0.0, blocks=blocks, gravity=ZERO, colliders=row)
        layer = ((blocks.node_positions(0.1)[..., 2] - k * 0.1).abs() < 1e-3)[None]
        assert int((layer & (grid[..., 3] > 0)).sum()) == 9
        assert v[layer].abs().max() == 0
