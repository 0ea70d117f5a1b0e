"""Rigid colliders: distances, laws at a node, motion, exact exchange of momentum."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.collider import COLLIDER_COLUMNS, SDF_ALIGN
from gsfluent.ops.reference import collider as reference
from gsfluent.ops.reference import mpm as reference_mpm

DX = 0.1
ZERO = (0.0, 0.0, 0.0)
TILT = (0.9, 0.2, -0.3, 0.25)
EPS = 1e-9


def ball_grid(radius: float, spacing: float, half: int) -> tuple[Tensor, dict[str, Any]]:
    """A distance grid of a ball about the body's origin, behind 64 values of something else."""
    axis = torch.arange(-half, half + 1, dtype=torch.float64) * spacing
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    values = (nodes.norm(dim=-1) - radius).flatten()
    sdf = torch.cat([torch.full((SDF_ALIGN,), 7.0), values.float()])
    size = 2 * half + 1
    place = {"normal": [-half * spacing] * 3, "radius": spacing, "extent": [size] * 3}
    return sdf, {**place, "offset": SDF_ALIGN}


SDF, GRID = ball_grid(0.3, 0.05, 10)
SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"normal": (0.3, -0.2, 2.0)},
    "disc": {"normal": (0.3, -0.2, 2.0), "radius": 0.35},
    "sphere": {"radius": 0.31},
    "box": {"extent": (0.2, 0.35, 0.1)},
    "capsule": {"radius": 0.12, "extent": (0, 0, 0.3)},
    "cylinder": {"radius": 0.22, "extent": (0, 0, 0.15)},
    "sdf": GRID,
}


def shape(name: str, **kw: Any) -> Tensor:
    kind = "plane" if name == "disc" else name
    return ops.collider_row(kind, **{**SHAPES[name], **kw})


def somewhere(n: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return 1.6 * (torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5)


# --- distances ---


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_distances_and_normals_match_the_reference(name: str, dtype: torch.dtype) -> None:
    row = shape(name, point=(0.1, -0.05, 0.2), orientation=TILT)
    x = somewhere(4000)
    d, n = ops.collider_distance(x.to(dtype), row[None].to(dtype), SDF)
    want_d, want_n = reference.signed_distance(row, SDF, x)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    assert (d[:, 0] - want_d).abs().max() < tolerance
    # Normals jump where two faces are equally near: rounding may choose the other one there.
    wrong = ((n[:, 0] - want_n).norm(dim=1) > 100 * tolerance).double().mean()
    assert wrong <= (0.0 if dtype == torch.float64 else 2e-3)
    assert (n.norm(dim=-1) - 1).abs().max() < tolerance
    assert bool((d < 0).any() and (d > 0).any())


@pytest.mark.parametrize("name", ["plane", "disc", "sphere", "box", "capsule", "cylinder"])
def test_walking_the_distance_along_the_normal_ends_on_the_surface(name: str) -> None:
    """For an exact distance ``x - d n`` is the nearest surface point (d > 0)."""
    row = shape(name, orientation=TILT)[None]
    x = somewhere(2000, 1)
    d, n = ops.collider_distance(x, row)
    foot, _ = ops.collider_distance(x - d * n[:, 0], row)
    assert foot[d > 0].abs().max() < 1e-12


def test_distance_grid_is_trilinear_inside_and_a_lower_bound_outside() -> None:
    row = shape("sdf", point=(0.2, 0.0, -0.1), orientation=TILT)[None]
    x = somewhere(4000, 2)
    true = (x - row[0, 3:6]).norm(dim=1) - 0.3
    d, n = ops.collider_distance(x, row, SDF)
    inside = ((x - row[0, 3:6]) @ reference.rotation(row[0, 16:20])).abs().amax(dim=1) < 0.5
    # Linear interpolation of |x|: error h^2 / 8 times its second derivatives, 1 / |x| each of two.
    close = inside & (true.abs() < 0.15)
    assert (d[:, 0] - true)[close].abs().max() < 2 * 0.05**2 / 8 / 0.15
    assert bool((~inside).any())
    assert (d[:, 0] - true)[~inside].max() < 2e-3
    radial = torch.nn.functional.normalize(x - row[0, 3:6], dim=1)
    assert (n[:, 0] * radial).sum(1)[close].min() > math.cos(math.radians(12))


def test_a_point_or_a_row_that_is_not_finite_gives_nan_not_a_crash() -> None:
    x = torch.tensor([[float("nan"), 0, 0], [float("inf"), 0, 0], [1e30, 0, 0]]).double()
    d, _ = ops.collider_distance(x, shape("sdf")[None], SDF)
    assert d[:2].isnan().all() and d[2, 0] > 1e29
    raw = torch.ops.gsfluent.collider_distance
    for column, value in [(0, 9.0), (9, float("nan")), (26, 5000.0), (29, 2.0**24), (27, 2.5)]:
        row = shape("sdf")[None].clone()
        row[0, column] = value
        assert raw(torch.zeros(1, 3).double(), row, SDF)[0].isnan().all()
    assert raw(torch.zeros(1, 3).double(), shape("sdf")[None], None)[0].isnan().all()


@pytest.mark.parametrize(
    ("kw", "match"),
    [
        ({"kind": "cone"}, "kind must be one of"),
        ({"kind": "plane", "mode": "glue"}, "mode must be one of"),
        ({"kind": "sphere"}, "row 0 must be finite"),
        ({"kind": "plane", "mass": 1.0}, "no mass"),
        ({"kind": "box", "extent": (1, 1, 0)}, "half edges > 0"),
        ({"kind": "sphere", "radius": 1.0, "restitution": 1.5}, r"restitution in \[0, 1\]"),
        ({"kind": "sdf", "radius": 0.1, "extent": (4, 4, 4), "offset": 5}, "multiple of 64"),
        ({"kind": "sphere", "radius": 1.0, "velocity": (1.0, 2.0)}, "velocity must have 3 numbers"),
    ],
)
def test_row_errors(kw: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        ops.collider_row(**kw)


def test_ops_pass_opcheck() -> None:
    rows = torch.stack([shape("sphere", mass=1.0, inertia=(1, 1, 1)), shape("box")])
    x = somewhere(5)
    torch.library.opcheck(torch.ops.gsfluent.collider_distance, (x, rows, SDF))
    impulse = torch.randn(2, 6, dtype=torch.float64)
    torch.library.opcheck(torch.ops.gsfluent.advance_colliders, (rows, impulse, 0.1, 0, 0, -9.81))


# --- at the nodes ---


class Cloud:
    """Particles around the origin on their grid, moving at random."""

    def __init__(self, fields: int = 2, speed: float = 1.0, seed: int = 0) -> None:
        n = 700
        g = torch.Generator().manual_seed(seed)
        self.x = somewhere(n, seed)
        self.v = speed * torch.randn(n, 3, generator=g, dtype=torch.float64)
        self.mass = torch.rand(n, generator=g, dtype=torch.float64) + 0.1
        self.body = torch.randint(0, fields, (n,), generator=g, dtype=torch.int32)
        self.blocks = ops.build_blocks(self.x, DX)
        zero = torch.zeros(n, 3, 3, dtype=torch.float64)
        self.grid, _ = ops.p2g(
            self.x, self.v, zero, self.mass, dx=DX, blocks=self.blocks, body=self.body,
            fields=fields,
        )  # fmt: skip

    def update(self, rows: Tensor, dt: float = 0.01) -> tuple[Tensor, ...]:
        return ops.grid_update(
            self.grid, dx=DX, dt=dt, blocks=self.blocks, gravity=ZERO, colliders=rows, sdf=SDF,
            return_torque=True,
        )  # fmt: skip

    @property
    def free(self) -> Tensor:
        return self.grid[..., :3] / self.grid[..., 3:].clamp_min(1e-300)


def moving(name: str, **kw: Any) -> Tensor:
    return shape(name, point=(0.02, -0.03, 0.04), orientation=TILT, velocity=(0.5, -1.0, 0.3),
                 angular_velocity=(1.0, 2.0, -3.0), **kw)  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("mode", ["sticky", "slip", "separate"])
def test_grid_update_matches_the_reference(name: str, mode: str) -> None:
    cloud = Cloud()
    kw: dict[str, Any] = {"mode": mode, "friction": 0.3, "restitution": 0.4}
    if name not in ("plane", "disc"):
        kw |= {"mass": 3.0, "inertia": (0.1, 0.2, 0.3)}
    row = moving(name, **kw)[None]
    v, impulse, torque, _ = cloud.update(row)
    args: dict[str, Any] = {"dx": DX, "dt": 0.01, "blocks": cloud.blocks, "gravity": ZERO}
    want = reference_mpm.grid_update(cloud.grid, colliders=row, sdf=SDF, **args)
    assert (v - want[0]).abs().max() < 1e-11
    assert torch.allclose(impulse, want[1], atol=1e-11) and impulse.abs().max() > 0
    assert torch.allclose(torque, want[2], atol=1e-11)


@pytest.mark.parametrize("name", ["sphere", "box", "sdf"])
def test_sweep_matches_the_reference(name: str) -> None:
    cloud = Cloud(fields=1)
    row = moving(name, sweep=True)[None].clone()
    row[0, 10] = 30.0  # 3 dx per step
    v, impulse, _, _ = cloud.update(row)
    args: dict[str, Any] = {"dx": DX, "dt": 0.01, "blocks": cloud.blocks, "gravity": ZERO}
    want = reference_mpm.grid_update(cloud.grid, colliders=row, sdf=SDF, **args)
    # The walk stops within 1e-3 dx of the surface, the bisection on it.
    wrong = ((v - want[0]).norm(dim=-1) > 0.05 * 30).double().mean()
    assert wrong < 2e-3
    assert (impulse - want[1]).norm() < 0.02 * want[1].norm()


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("mode", ["sticky", "slip", "separate"])
@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_no_node_gains_energy_in_the_colliders_frame(
    name: str, mode: str, restitution: float
) -> None:
    cloud = Cloud()
    row = moving(name, mode=mode, friction=0.7, restitution=restitution, sweep=True)
    v, *_ = cloud.update(row[None])
    own = row[10:13] + torch.linalg.cross(
        row[20:23].expand(len(v[0]), 64, 3), cloud.blocks.node_positions(DX) - row[3:6]
    )
    heavy = cloud.grid[..., 3] > 0
    before, after = ((w - own).norm(dim=-1)[heavy] for w in (cloud.free, v))
    assert (after - before).max() < 1e-12
    assert int((after < before - 1e-9).sum()) > 20


@pytest.mark.parametrize("name", ["sphere", "box", "capsule", "cylinder", "sdf"])
@pytest.mark.parametrize("mass", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("mode", ["sticky", "slip", "separate"])
def test_two_way_bodies_exchange_momentum_and_lose_energy(
    name: str, mass: float, mode: str
) -> None:
    """Momentum and angular momentum of node and body exact; energy falls, however light it is."""
    cloud = Cloud()
    inertia = (0.02 * mass, 0.03 * mass, 0.04 * mass)
    # Explicit torque on a tumbling body needs a small angle per step to be judged by its energy.
    row = moving(name, mode=mode, friction=0.5, restitution=0.2, mass=mass, inertia=inertia)[None]
    v, impulse, torque, _ = cloud.update(row, dt=1e-9)
    after = ops.advance_colliders(row, 0.0, impulse=impulse, torque=torque)
    node_mass = cloud.grid[..., 3:]
    x = cloud.blocks.node_positions(DX)
    change = (node_mass * (v - cloud.free)).sum((0, 1, 2))
    scale = (node_mass * (v - cloud.free)).abs().sum()
    assert scale > 0
    assert (mass * (after - row)[0, 10:13] + change).abs().max() < 1e-13 * max(scale, mass)
    turn = reference.rotation(row[0, 16:20])

    def spin(r: Tensor) -> Tensor:
        moments = torch.tensor(inertia, dtype=torch.float64)
        return turn @ (moments * (turn.T @ r[0, 20:23]))

    arm = (x - row[0, 3:6]).expand_as(v)
    twist = torch.linalg.cross(arm, node_mass * (v - cloud.free)).sum((0, 1, 2))
    assert (spin(after) - spin(row) + twist).abs().max() < 1e-12 * max(float(scale), mass)

    def energy(r: Tensor, w: Tensor) -> float:
        own = 0.5 * mass * r[0, 10:13].square().sum() + 0.5 * (r[0, 20:23] @ spin(r))
        return float(own + 0.5 * (node_mass * w.square()).sum())

    assert energy(after, v) < energy(row, cloud.free)


def test_a_fast_bullet_thinner_than_its_step_does_not_tunnel() -> None:
    """solver.md 4, row 23: radius 1 dx, 2 dx per step, aimed at a wall one cell thick."""
    axis = (torch.arange(-8, 8, dtype=torch.float64) + 0.5) * 0.5 * DX
    x = torch.cartesian_prod(axis[7:9], axis, axis)
    mass = torch.full((len(x),), 0.1, dtype=torch.float64)
    zero = torch.zeros(len(x), 3, 3, dtype=torch.float64)
    dt, speed = 1e-3, 2 * DX / 1e-3
    blocks = ops.build_blocks(x, DX)

    def shoot(start: float, sweep: bool) -> tuple[float, float]:
        row = ops.collider_row(
            "sphere", point=(start, 0.013, 0.021), radius=DX, velocity=(speed, 0, 0), mass=1.0,
            inertia=(4e-3,) * 3, sweep=sweep,
        )[None]  # fmt: skip
        v = torch.zeros_like(x)
        for _ in range(8):
            grid, _ = ops.p2g(x, v, zero, mass, dx=DX, blocks=blocks)
            field, push, torque, _ = ops.grid_update(
                grid, dx=DX, dt=dt, blocks=blocks, gravity=ZERO, colliders=row, return_torque=True
            )
            _, v, _, _ = ops.g2p(field, x, dx=DX, dt=dt, blocks=blocks)
            row = ops.advance_colliders(row, dt, impulse=push, torque=torque)
        return float(row[0, 10]), float((mass[:, None] * v)[:, 0].sum())

    starts = [-8 * DX + 2 * DX * i / 8 for i in range(8)]
    swept = [shoot(s, True) for s in starts]
    assert all(v < 0.98 * speed for v, _ in swept)
    for v, momentum in swept:
        assert momentum == pytest.approx(speed - v, rel=1e-9)
    # The phase decides how much a bullet that is only looked at between steps notices.
    assert max(v for v, _ in swept) < max(shoot(s, False)[0] for s in starts)


def test_rows_of_the_older_layout_mean_what_they_meant() -> None:
    cloud = Cloud(fields=1)
    old = torch.zeros(2, 16, dtype=torch.float64)
    old[0, [1, 2, 5, 8]] = torch.tensor([2, 0.4, -0.1, 1.0], dtype=torch.float64)
    old[1, [0, 1, 3, 9, 10]] = torch.tensor([1, 1, 0.2, 0.23, 0.5], dtype=torch.float64)
    new = torch.stack(
        [
            ops.collider_row("plane", point=(0, 0, -0.1), friction=0.4),
            ops.collider_row(
                "sphere", point=(0.2, 0, 0), radius=0.23, mode="slip", velocity=(0.5, 0, 0)
            ),
        ]
    )
    assert new.shape[1] == COLLIDER_COLUMNS
    assert all(torch.equal(a, b) for a, b in zip(cloud.update(old), cloud.update(new), strict=True))


# --- motion ---


def test_kinematic_motion_is_exact() -> None:
    row = ops.collider_row(
        "box", extent=(1, 1, 1), velocity=(1.0, -2.0, 0.5), angular_velocity=(0.3, -0.5, 0.7)
    )[None]
    start = row.clone()
    for _ in range(200):
        row = ops.advance_colliders(row, 0.01)
    assert torch.allclose(row[0, 3:6], 2.0 * start[0, 10:13], atol=1e-12)
    omega = start[0, 20:23]
    angle = 2.0 * omega.norm()
    axis = omega / omega.norm()
    want = torch.cat([torch.cos(angle / 2)[None], torch.sin(angle / 2) * axis])
    assert torch.allclose(row[0, 16:20], want, atol=1e-12)
    assert torch.equal(row[0, 10:13], start[0, 10:13])


def test_a_free_body_keeps_angular_momentum_and_nearly_its_energy() -> None:
    inertia = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    row = ops.collider_row(
        "box", extent=(1, 1, 1), mass=2.0, inertia=(1, 2, 3), angular_velocity=(0.1, 5.0, 0.1)
    )[None]

    def state(r: Tensor) -> tuple[Tensor, float]:
        turn = reference.rotation(r[0, 16:20])
        local = turn.T @ r[0, 20:23]
        return turn @ (inertia * local), float((inertia * local**2).sum())

    momentum, energy = state(row)
    for _ in range(2000):  # 10 turns about the unstable axis: it tumbles
        row = ops.advance_colliders(row, 2 * math.pi / 5 / 200, gravity=(0, 0, -1.0))
    now, left = state(row)
    assert (now - momentum).norm() < 1e-10 * momentum.norm()
    assert left == pytest.approx(energy, rel=1e-3)
    assert float(row[0, 12]) == pytest.approx(-2000 * 2 * math.pi / 5 / 200, rel=1e-12)
