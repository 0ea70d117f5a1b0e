"""p2g, g2p, build_blocks: reference and properties."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops import blocks as block_ops
from gsfluent.ops.reference import mpm as reference

DX = 0.0625


def cloud(
    n: int, dtype: torch.dtype = torch.float64, fields: int = 1, seed: int = 0
) -> dict[str, Tensor]:
    """Random particles over a box that straddles the origin, several blocks wide."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    box = torch.tensor([1.1, 0.7, 0.5], dtype=torch.float64)
    out = {
        "position": rand(n, 3) * box - 0.37,
        "velocity": rand(n, 3) * 2 - 1,
        "affine": rand(n, 3, 3) * 2 - 1,
        "mass": rand(n) + 0.1,
        "stress": rand(n, 6) * 2 - 1,
        "volume": rand(n) * 1e-3,
    }
    out = {k: v.to(dtype) for k, v in out.items()}
    out["body"] = torch.randint(0, fields, (n,), generator=g, dtype=torch.int32)
    return out


def run_p2g(c: dict[str, Tensor], impl: Any = ops.p2g, **kw: Any) -> tuple[Tensor, Tensor | None]:
    return impl(c["position"], c["velocity"], c["affine"], c["mass"], **kw)


def loaded(c: dict[str, Tensor]) -> dict[str, Any]:
    return {"stress": c["stress"], "volume": c["volume"], "body": c["body"], "dt": 1e-2}


# --- reference ---


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("margin", [0, 1, 2])
@pytest.mark.parametrize("fields", [1, 3])
def test_p2g_matches_reference(dtype: torch.dtype, margin: int, fields: int) -> None:
    c = cloud(400, dtype, fields)
    blocks = ops.build_blocks(c["position"], DX, margin=margin)
    c["position"] += (torch.rand(400, 3, dtype=dtype) * 2 - 1) * 0.98 * margin * DX
    kw = {"dx": DX, "blocks": blocks, "fields": fields, "contact": True, **loaded(c)}
    grid, moments = run_p2g(c, **kw)
    double = {k: v.double() if v.is_floating_point() else v for k, v in c.items()}
    want, want_moments = run_p2g(double, reference.p2g, **{**kw, **loaded(double)})
    assert moments is not None and want_moments is not None
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    for got, expected in ((grid, want), (moments, want_moments)):
        assert got.dtype == dtype
        error = (got.double() - expected).abs().amax((0, 1, 2))
        assert (error <= tolerance * expected.abs().amax((0, 1, 2))).all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("fields", [1, 3])
def test_g2p_matches_reference(dtype: torch.dtype, fields: int) -> None:
    c = cloud(400, dtype, fields)
    blocks = ops.build_blocks(c["position"], DX)
    field = torch.randn(fields, blocks.block_count, 64, 3, dtype=dtype)
    f = torch.randn(400, 3, 3, dtype=dtype)
    kw: dict[str, Any] = {"dx": DX, "dt": 1e-2, "blocks": blocks, "body": c["body"]}
    got = ops.g2p(field, c["position"], deformation=f, velocity=c["velocity"], **kw)
    want = reference.g2p(
        field.double(),
        c["position"].double(),
        deformation=f.double(),
        **kw,
        velocity=c["velocity"].double(),
    )
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    for a, b in zip(got, want, strict=False):
        assert a is not None and b is not None
        assert (a.double() - b).abs().max() <= tolerance * b.abs().max()


def test_empty_and_single_particles() -> None:
    for n in (0, 1):
        c = cloud(n)
        blocks = ops.build_blocks(c["position"], DX)
        grid, _ = run_p2g(c, dx=DX, blocks=blocks)
        x, v, affine, f = ops.g2p(
            grid[..., :3].contiguous(), c["position"], dx=DX, dt=0.1, blocks=blocks
        )
        assert (x.shape, v.shape, affine.shape, f) == ((n, 3), (n, 3), (n, 3, 3), None)
        assert torch.allclose(grid[..., 3].sum(), c["mass"].sum())


def test_particle_exactly_on_a_cell_face_is_finite() -> None:
    # The trap of equations.md section 8: one weight is exactly zero and so is the node's mass.
    position = torch.tensor([[0.5, 1.5, -2.5], [0.0, 1.0, 2.0]], dtype=torch.float64) * DX
    blocks = ops.build_blocks(position, DX)
    ones = torch.ones(2, dtype=torch.float64)
    grid, _ = ops.p2g(
        position, torch.ones_like(position), position.new_zeros(2, 3, 3), ones, dx=DX, blocks=blocks
    )
    v, _, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks, gravity=(0, 0, 0))
    _, velocity, affine, _ = ops.g2p(v, position, dx=DX, dt=0.1, blocks=blocks)
    assert torch.allclose(velocity, torch.ones_like(velocity), atol=1e-14)
    assert affine.isfinite().all()


# --- build_blocks ---


@pytest.mark.parametrize("margin", [0, 1, 2])
def test_blocks_are_sorted_cover_and_match_the_device_version(margin: int) -> None:
    c = cloud(300)
    blocks = ops.build_blocks(c["position"], DX, margin=margin)
    assert sorted(blocks.order.tolist()) == list(range(300))
    base = torch.floor(c["position"][blocks.order.long()] / DX - 0.5).long()
    home = torch.repeat_interleave(
        torch.arange(blocks.block_count), (blocks.start[1:] - blocks.start[:-1]).long()
    )
    assert (blocks.coords[home] == base >> 2).all()
    cell = home * 64 + ((base & 3) * torch.tensor([16, 4, 1])).sum(1)
    assert (cell[1:] >= cell[:-1]).all()
    for shift in (-margin, margin):
        node = base + shift
        for corner in (0, 2):
            assert (reference.node_index(node + corner, blocks) >= 0).all()
    table, coords, order, start, info = block_ops.build_blocks_on_device(
        c["position"], DX, margin, 2**20
    )
    assert torch.equal(table, blocks.table) and torch.equal(coords, blocks.coords)
    assert torch.equal(order, blocks.order) and torch.equal(start, blocks.start)
    assert tuple(info[:3].tolist()) == blocks.origin


def test_device_version_of_build_blocks_handles_empty_and_bad_input() -> None:
    empty = torch.zeros(0, 3)
    table, coords, order, start, info = block_ops.build_blocks_on_device(empty, DX, 1, 100)
    assert table.tolist() == [[[-1]]] and coords.shape == (0, 3) and start.tolist() == [0]
    assert order.numel() == 0 and info.tolist() == [0, 0, 0, 0, 1]
    far = torch.tensor([[0.0, 0, 0], [1e3, 1e3, 1e3]])
    assert block_ops.build_blocks_on_device(far, DX, 1, 100)[4][4] > 100
    assert block_ops.build_blocks_on_device(far * float("nan"), DX, 1, 100)[4][3] == 2


def test_blocks_expire_when_a_particle_may_have_left_the_margin() -> None:
    blocks = ops.build_blocks(cloud(10)["position"], DX)
    assert not blocks.expired(0.9 * DX, DX)
    assert blocks.expired(1.01 * DX, DX)
    assert blocks.expired(float("nan"), DX)


# --- properties ---


def test_weights_are_a_partition_of_unity_with_linear_precision() -> None:
    c = cloud(200)
    node, w, gradient = reference.stencil(c["position"], DX)
    assert torch.allclose(w.sum(1), torch.ones(200, dtype=torch.float64), atol=1e-14)
    assert torch.allclose((w[..., None] * node * DX).sum(1), c["position"], atol=1e-14)
    assert gradient.sum(1).abs().max() < 1e-12


def test_p2g_conserves_mass_and_momentum() -> None:
    c = cloud(500)
    blocks = ops.build_blocks(c["position"], DX)
    grid, _ = run_p2g(c, dx=DX, blocks=blocks, **{**loaded(c), "body": None})
    assert torch.allclose(grid[..., 3].sum(), c["mass"].sum(), rtol=1e-13)
    momentum = (c["mass"][:, None] * c["velocity"]).sum(0)
    # The stress impulse has no resultant: sum_i w (x_i - x_p) = 0.
    assert torch.allclose(grid[..., :3].sum((0, 1, 2)), momentum, atol=1e-12)


def test_p2g_conserves_angular_momentum_of_particles_and_affine_parts() -> None:
    c = cloud(500)
    blocks = ops.build_blocks(c["position"], DX)
    grid, _ = run_p2g(c, dx=DX, blocks=blocks, **{**loaded(c), "body": None})
    nodes = blocks.node_positions(DX)
    on_grid = torch.linalg.cross(nodes[None], grid[..., :3]).sum((0, 1, 2))
    # APIC: L = sum m x cross v + m D : (C - C^T) with D = dx^2 / 4 (Jiang et al. 2015); the
    # symmetric stress gives no torque.
    spin = c["affine"] * (c["mass"] * DX**2 / 4)[:, None, None]
    torque = torch.stack(
        [
            spin[:, 2, 1] - spin[:, 1, 2],
            spin[:, 0, 2] - spin[:, 2, 0],
            spin[:, 1, 0] - spin[:, 0, 1],
        ],
        1,
    )
    orbital = c["mass"][:, None] * torch.linalg.cross(c["position"], c["velocity"])
    assert torch.allclose(on_grid, (orbital + torque).sum(0), atol=1e-11)


def test_a_free_step_conserves_momentum_and_angular_momentum() -> None:
    c = cloud(500)
    dt = 1e-2
    blocks = ops.build_blocks(c["position"], DX)
    grid, _ = run_p2g(c, dx=DX, blocks=blocks, **{**loaded(c), "body": None, "dt": dt})
    v, _, _ = ops.grid_update(grid, dx=DX, dt=dt, blocks=blocks, gravity=(0, 0, 0))
    x, velocity, affine, _ = ops.g2p(v, c["position"], dx=DX, dt=dt, blocks=blocks)
    m = c["mass"][:, None]
    assert torch.allclose((m * velocity).sum(0), (m * c["velocity"]).sum(0), atol=1e-11)
    nodes = blocks.node_positions(DX)
    before = torch.linalg.cross(nodes[None], grid[..., :3]).sum((0, 1, 2))
    spin = affine * (c["mass"] * DX**2 / 4)[:, None, None]
    torque = torch.stack(
        [
            spin[:, 2, 1] - spin[:, 1, 2],
            spin[:, 0, 2] - spin[:, 2, 0],
            spin[:, 1, 0] - spin[:, 0, 1],
        ],
        1,
    )
    after = (m * torch.linalg.cross(c["position"], velocity) + torque).sum(0)
    assert torch.allclose(before, after, atol=1e-10)
    assert torch.allclose(x, c["position"] + dt * velocity, atol=1e-15)


def test_affine_velocity_fields_are_reproduced_exactly() -> None:
    c = cloud(300)
    a = torch.randn(3, 3, dtype=torch.float64)
    b = torch.randn(3, dtype=torch.float64)
    blocks = ops.build_blocks(c["position"], DX)
    field = (blocks.node_positions(DX) @ a.T + b)[None].contiguous()
    _, v, affine, f = ops.g2p(
        field,
        c["position"],
        dx=DX,
        dt=0.01,
        blocks=blocks,
        deformation=torch.eye(3, dtype=torch.float64).expand(300, 3, 3),
    )
    assert torch.allclose(v, c["position"] @ a.T + b, atol=1e-13)
    assert torch.allclose(affine, a.expand(300, 3, 3), atol=1e-11)
    assert f is not None
    assert torch.allclose(
        f, (torch.eye(3, dtype=torch.float64) + 0.01 * a).expand_as(f), atol=1e-12
    )


def test_p2g_and_g2p_are_adjoint() -> None:
    c = cloud(300, fields=2)
    blocks = ops.build_blocks(c["position"], DX)
    field = torch.randn(2, blocks.block_count, 64, 3, dtype=torch.float64)
    one = torch.ones(300, dtype=torch.float64)
    grid, _ = ops.p2g(
        c["position"],
        c["velocity"],
        c["affine"],
        one,
        dx=DX,
        blocks=blocks,
        body=c["body"],
        fields=2,
    )
    _, v, affine, _ = ops.g2p(field, c["position"], dx=DX, dt=0.0, blocks=blocks, body=c["body"])
    left = (grid[..., :3] * field).sum()
    right = (c["velocity"] * v).sum() + (c["affine"] * affine).sum() * DX**2 / 4
    assert torch.allclose(left, right, rtol=1e-12)


def test_first_moment_leads_to_the_centroid() -> None:
    # A body in x < 0: a node beyond its face sees it at -x, and the centroid it sees is in it.
    c = cloud(3000)
    c["position"][:, 0] = -c["position"][:, 0].abs()
    blocks = ops.build_blocks(c["position"], DX)
    grid, moments = run_p2g(c, dx=DX, blocks=blocks, contact=True)
    assert moments is not None
    outside = (blocks.node_positions(DX)[..., 0] > 0.5 * DX)[None] & (grid[..., 3] > 0)
    assert int(outside.sum()) > 20
    first = moments[..., 0][outside] / grid[..., 3][outside]
    x = blocks.node_positions(DX)[..., 0].expand(grid.shape[:3])[outside]
    assert (first < 0).all() and (x + DX * first <= 0).all()


def test_p2g_is_bitwise_equal_for_any_number_of_threads() -> None:
    c = cloud(4000, torch.float32)
    blocks = ops.build_blocks(c["position"], DX / 2)
    kw = {"dx": DX / 2, "blocks": blocks, **loaded(c), "contact": True}
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = run_p2g(c, **kw)
        torch.set_num_threads(2)
        two = run_p2g(c, **kw)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(one[0], two[0])
    assert one[1] is not None and two[1] is not None and torch.equal(one[1], two[1])


def test_particles_outside_are_counted_and_fly_on() -> None:
    c = cloud(100)
    blocks = ops.build_blocks(c["position"], DX)
    x = c["position"].clone()
    x[3], x[4], x[5], x[6] = float("nan"), float("inf"), 1e30, 5.0
    c["body"][7], c["body"][8] = 1, -1
    kw: dict[str, Any] = {"dx": DX, "blocks": blocks, "body": c["body"]}
    grid, _ = ops.p2g(x, c["velocity"], c["affine"], c["mass"], **kw)
    keep = torch.ones(100, dtype=torch.bool)
    keep[3:9] = False
    assert torch.allclose(grid[..., 3].sum(), c["mass"][keep].sum(), rtol=1e-13)
    field = torch.ones(1, blocks.block_count, 64, 3, dtype=torch.float64)
    f = torch.randn(100, 3, 3, dtype=torch.float64)
    moved, v, affine, f_new, skipped = ops.g2p(
        field, x, dt=0.1, velocity=c["velocity"], deformation=f, return_skipped=True, **kw
    )
    assert skipped.item() == 6 and f_new is not None
    assert torch.equal(v[~keep], c["velocity"][~keep])
    assert torch.equal(moved[6], x[6] + 0.1 * c["velocity"][6])
    assert moved[3].isnan().all() and affine[~keep].eq(0).all() and torch.equal(f_new[6], f[6])
    assert torch.allclose(v[keep], torch.ones_like(v[keep]))


def test_particles_beyond_their_block_window_are_still_transferred() -> None:
    # Moved by many cells, yet over active blocks: slow path, same result as freshly built blocks.
    c = cloud(300)
    blocks = ops.build_blocks(c["position"], DX)
    c["position"] = c["position"].flip(0).contiguous()
    kw = {"dx": DX, "contact": True, **loaded(c)}
    grid, moments = run_p2g(c, blocks=blocks, **kw)
    want, want_moments = run_p2g(c, reference.p2g, blocks=blocks, **kw)
    assert torch.allclose(grid, want, atol=1e-13)
    assert moments is not None and torch.allclose(moments, want_moments, atol=1e-12)
    field = torch.randn(1, blocks.block_count, 64, 3, dtype=torch.float64)
    got = ops.g2p(field, c["position"], dx=DX, dt=0.1, blocks=blocks)
    expected = reference.g2p(field, c["position"], dx=DX, dt=0.1, blocks=blocks)
    assert torch.allclose(got[0], expected[0], atol=1e-13)
    assert torch.allclose(got[2], expected[2], atol=1e-10)


def test_garbage_in_block_tensors_never_leaves_the_arrays() -> None:
    c = cloud(200)
    good = ops.build_blocks(c["position"], DX)
    g = torch.Generator().manual_seed(1)

    def noise(t: Tensor) -> Tensor:
        return torch.randint(-(2**31), 2**31 - 1, t.shape, generator=g).to(torch.int32)

    for name in ("table", "coords", "order", "start"):
        blocks = good._replace(**{name: noise(getattr(good, name))})
        grid, _ = run_p2g(c, dx=DX, blocks=blocks, contact=True, **loaded(c))
        assert grid.isfinite().all()
        ops.g2p(grid[..., :3].contiguous(), c["position"], dx=DX, dt=0.1, blocks=blocks)
        rows = torch.zeros(1, 16, dtype=torch.float64)
        rows[0, 8] = 1.0
        v, _, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks, colliders=rows)
        assert v.shape == (1, good.block_count, 64, 3)


@pytest.mark.parametrize("far", [2**31 - 1, -(2**31), 2**29])
def test_block_coordinates_at_the_ends_of_int32_lose_nothing(far: int) -> None:
    # signed overflow; the sanitizer build (scripts/safety/sanitize.sh) would say so
    c = cloud(200)
    good = ops.build_blocks(c["position"], DX)
    wrong = good.coords.clone()
    wrong[::2] = far
    blocks = good._replace(coords=wrong)
    # particles of such a block go the slow way, by their positions
    grid, moments = run_p2g(c, dx=DX, blocks=blocks, contact=True, **loaded(c))
    want, _ = run_p2g(c, dx=DX, blocks=good, contact=True, **loaded(c))
    assert torch.allclose(grid, want, atol=1e-12)
    field = torch.randn(1, good.block_count, 64, 3, dtype=torch.float64)
    got = ops.g2p(field, c["position"], dx=DX, dt=0.1, blocks=blocks)
    expected = ops.g2p(field, c["position"], dx=DX, dt=0.1, blocks=good)
    assert torch.allclose(got[1], expected[1], atol=1e-12)
    pair = torch.cat([grid, grid])
    both = torch.cat([moments, moments])
    v = ops.grid_update(pair, dx=DX, dt=0.1, blocks=blocks, moments=both)[0]
    assert v.shape == (2, good.block_count, 64, 3) and v.isfinite().all()
