"""p2g, grid_update, g2p: gradients, registration, errors."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from gsfluent import ops
from gsfluent.ops._mpm_slope import transfer_slope

DX = 0.25
N = 8


def setup(fields: int = 2) -> tuple[Tensor, ops.Blocks, Tensor]:
    position = torch.rand(N, 3, dtype=torch.float64)
    body = torch.randint(0, fields, (N,), dtype=torch.int32)
    return position, ops.build_blocks(position, DX), body


def leaf(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, requires_grad=True)


def p2g_inputs() -> tuple[Tensor, ...]:
    return leaf(N, 3), leaf(N, 3, 3), leaf(N), leaf(N, 6), leaf(N)


# --- gradients ---


def test_p2g_gradients() -> None:
    position, blocks, body = setup()

    def scatter(v: Tensor, c: Tensor, m: Tensor, s: Tensor, vol: Tensor) -> Tensor:
        return ops.p2g(
            position,
            v,
            c,
            m,
            dx=DX,
            blocks=blocks,
            dt=0.1,
            stress=s,
            volume=vol,
            body=body,
            fields=2,
        )[0]

    assert gradcheck(scatter, p2g_inputs(), fast_mode=True)


def test_p2g_gradient_without_stress() -> None:
    position, blocks, _ = setup()
    v, c, m = leaf(N, 3), leaf(N, 3, 3), leaf(N)
    assert gradcheck(
        lambda *a: ops.p2g(position, *a, dx=DX, blocks=blocks)[0], (v, c, m), fast_mode=True
    )


def test_g2p_gradients() -> None:
    position, blocks, body = setup()
    position[0] = float("nan")  # a skipped particle passes its velocity through
    field, f, v = leaf(2, blocks.block_count, 64, 3), leaf(N, 3, 3), leaf(N, 3)

    def gather(field: Tensor, f: Tensor, v: Tensor) -> tuple[Tensor, ...]:
        out = ops.g2p(
            field, position, dx=DX, dt=0.1, blocks=blocks, body=body, deformation=f, velocity=v
        )
        return out[0][1:], out[1], out[2], out[3]

    assert gradcheck(gather, (field, f, v), fast_mode=True)


def test_grid_update_gradient() -> None:
    _, blocks, _ = setup()
    grid = torch.rand(1, blocks.block_count, 64, 4, dtype=torch.float64) + 0.5
    grid[0, 0, 0] = 0.0
    grid.requires_grad_()

    def update(grid: Tensor) -> Tensor:
        # Node (0, 0) is empty: its velocity is zero whatever is done to it, so leave it out.
        v, _, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks)
        return v.flatten(0, 2)[1:]

    assert gradcheck(update, (grid,), fast_mode=True)
    update(grid).sum().backward()
    assert grid.grad is not None and grid.grad.isfinite().all()
    assert (grid.grad[0, 0, 0] == 0).all()


def test_gradients_flow_through_a_whole_step() -> None:
    position, blocks, _ = setup()
    v, c, m = leaf(N, 3), leaf(N, 3, 3), torch.rand(N, dtype=torch.float64) + 0.5

    def step(v: Tensor, c: Tensor) -> Tensor:
        grid, _ = ops.p2g(position, v, c, m, dx=DX, blocks=blocks)
        field, _, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks)
        return ops.g2p(field, position, dx=DX, dt=0.1, blocks=blocks)[0]

    assert gradcheck(step, (v, c), fast_mode=True)


def test_p2g_position_gradient() -> None:
    position, blocks, body = setup()
    v, c, m, stress, volume = p2g_inputs()

    def scatter(x: Tensor, v: Tensor, c: Tensor, m: Tensor, s: Tensor, vol: Tensor) -> Tensor:
        kw: dict[str, Any] = {"dt": 0.1, "stress": s, "volume": vol, "body": body, "fields": 2}
        return ops.p2g(x, v, c, m, dx=DX, blocks=blocks, **kw)[0]

    assert gradcheck(scatter, (position.requires_grad_(), v, c, m, stress, volume), fast_mode=True)


def test_p2g_moments_gradient() -> None:
    position, blocks, body = setup()
    v, c, m, _, _ = p2g_inputs()

    def scatter(x: Tensor, v: Tensor, m: Tensor) -> tuple[Tensor, ...]:
        out = ops.p2g(x, v, c, m, dx=DX, blocks=blocks, body=body, fields=2, contact=True)
        assert out[1] is not None
        return out[0], out[1]

    assert gradcheck(scatter, (position.requires_grad_(), v, m), fast_mode=True)


def test_g2p_position_gradient() -> None:
    position, blocks, body = setup()
    field, f, v = leaf(2, blocks.block_count, 64, 3), leaf(N, 3, 3), leaf(N, 3)
    body[0] = 7  # in no field: flies on, x' = x + dt v

    def gather(field: Tensor, x: Tensor, f: Tensor, v: Tensor) -> tuple[Tensor, ...]:
        out = ops.g2p(field, x, dx=DX, dt=0.1, blocks=blocks, body=body, deformation=f, velocity=v)
        assert out[3] is not None
        return out[0], out[1], out[2], out[3]

    assert gradcheck(gather, (field, position.requires_grad_(), f, v), fast_mode=True)


def test_position_kernel_agrees_with_its_definition() -> None:
    position, blocks, body = setup()
    position[3] = float("nan")
    body[5] = -1
    grid = torch.randn(2, blocks.block_count, 64, 4, dtype=torch.float64)
    constant, linear = torch.randn(N, 4).double(), torch.randn(N, 3, 3).double()
    index: tuple[Any, ...] = (*blocks[:1], *blocks[2:5], blocks.origin, blocks.margin, DX)
    kernel = torch.ops.gsfluent.transfer_slope(grid, constant, linear, position, body, *index)
    definition = transfer_slope(grid, constant, linear, position, body, *index)
    torch.testing.assert_close(kernel, definition, rtol=1e-12, atol=1e-12)
    assert (kernel[[3, 5]] == 0).all()
    assert (kernel[[0, 1]] != 0).all()


def rows(*kinds: tuple[int, float, float]) -> Tensor:
    """A floor and a ball, (mode, friction, restitution) each."""
    out = torch.zeros(len(kinds), 16, dtype=torch.float64)
    for row, (mode, friction, restitution) in zip(out, kinds, strict=True):
        row[[1, 2, 13]] = torch.tensor([mode, friction, restitution], dtype=torch.float64)
    out[0, [5, 8, 10]] = torch.tensor([0.4, 1.0, 0.2], dtype=torch.float64)
    out[1:, [0, 3, 4, 5, 9]] = torch.tensor([1.0, 0.6, 0.5, 1.1, 0.5], dtype=torch.float64)
    return out


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_grid_update_gradient_with_colliders(mode: int) -> None:
    _, blocks, _ = setup()
    grid = torch.randn(1, blocks.block_count, 64, 4, dtype=torch.float64)
    grid[..., 3] = torch.rand_like(grid[..., 3]) + 0.5
    colliders = rows((mode, 0.4, 0.3), (mode, 0.1, 0.0))

    def update(grid: Tensor) -> tuple[Tensor, Tensor]:
        v, impulse, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks, colliders=colliders)
        return v, impulse

    assert (update(grid)[1].abs().sum(1) > 0).all()  # both take part
    assert gradcheck(update, (grid.requires_grad_(),), fast_mode=True)


def test_frictionless_floor_passes_the_tangential_gradient_of_a_vertical_fall() -> None:
    _, blocks, _ = setup()
    grid = torch.zeros(1, blocks.block_count, 64, 4, dtype=torch.float64)
    grid[..., 2], grid[..., 3] = -1.0, 1.0
    grid.requires_grad_()
    for friction, passed in ((0.0, 1.0), (0.5, 0.0)):
        colliders = rows((2, friction, 0.0))
        v, _, _ = ops.grid_update(grid, dx=DX, dt=0.0, blocks=blocks, colliders=colliders)
        below = blocks.node_positions(DX)[..., 2] < 0.4
        (slope,) = torch.autograd.grad(v[..., 1].sum(), grid)
        assert (slope[0, below][:, 1] == passed).all()
        assert (slope[0, ~below][:, 1] == 1.0).all()


@pytest.mark.parametrize("friction", [0.0, 0.2, 5.0])
def test_gradients_flow_through_a_step_with_contact(friction: float) -> None:
    position, blocks, body = setup()
    body[:] = (position[:, 0] > 0.5).int()
    v, c, m = leaf(N, 3), leaf(N, 3, 3), torch.rand(N, dtype=torch.float64) + 0.5
    v = (v.detach() + torch.where(body[:, None] == 0, 2.0, -2.0)).requires_grad_()
    colliders = rows((2, 0.3, 0.2))

    def step(x: Tensor, v: Tensor, c: Tensor, m: Tensor) -> tuple[Tensor, ...]:
        kw: dict[str, Any] = {"dx": DX, "blocks": blocks}
        grid, moments = ops.p2g(x, v, c, m, body=body, fields=2, contact=True, **kw)
        field, _, touched = ops.grid_update(
            grid,
            dt=0.01,
            colliders=colliders,
            moments=moments,
            friction=friction,
            restitution=0.4,
            contact_gap=3.0,
            **kw,
        )
        assert touched > 10
        return ops.g2p(field, x, dt=0.01, body=body, **kw)[:3]

    assert gradcheck(step, (position.requires_grad_(), v, c, m.requires_grad_()), fast_mode=True)


def test_missing_gradients_are_refused() -> None:
    _, blocks, _ = setup()
    grid = torch.ones(1, blocks.block_count, 64, 4, dtype=torch.float64)
    colliders = rows((2, 0.3, 0.0)).requires_grad_()
    with pytest.raises(NotImplementedError, match="no gradient with respect to colliders"):
        ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks, colliders=colliders)


# --- registration ---


@pytest.mark.parametrize("grad", [False, True])
def test_opcheck(grad: bool) -> None:
    position, blocks, body = setup()
    inputs = [t if grad else t.detach() for t in p2g_inputs()]
    index: tuple[Any, ...] = (*blocks[:1], *blocks[2:5], blocks.origin, blocks.margin)
    lib = torch.ops.gsfluent
    position.requires_grad_(grad)
    torch.library.opcheck(lib.p2g.default, (position, *inputs, body, *index, DX, 0.1, 2, not grad))
    field = torch.randn(2, blocks.block_count, 64, 3, dtype=torch.float64, requires_grad=grad)
    torch.library.opcheck(
        lib.g2p.default, (field, position, inputs[0], inputs[1], body, *index, DX, 0.1)
    )
    grid = torch.rand(2, blocks.block_count, 64, 4, dtype=torch.float64, requires_grad=grad)
    moments = None if grad else torch.rand(2, blocks.block_count, 64, 3, dtype=torch.float64)
    rest = (DX, 0.1, 0.0, 0.0, -9.81, 0.3, 0.0, 1.0)
    pairs = torch.tensor([2, 1])  # fields 0 and 1 move as one
    where = (blocks.table, blocks.coords, blocks.origin)
    for merged in (None, pairs):
        torch.library.opcheck(
            lib.grid_update.default, (grid, moments, None, None, merged, None, *where, *rest)
        )
    position = position.detach()
    torch.library.opcheck(lib.p2g_adjoint.default, (grid.detach(), position, body, *index, DX))
    slopes = (grid.detach(), torch.ones(N, 4).double(), torch.ones(N, 3, 3).double(), position)
    torch.library.opcheck(lib.transfer_slope.default, (*slopes, body, *index, DX))
    torch.library.opcheck(lib.build_blocks.default, (position, DX, 1, 1000))


def test_step_compiles_to_the_same_numbers() -> None:
    position, blocks, _ = setup()
    v, c, m, s, vol = (t.detach() for t in p2g_inputs())
    m = m.abs() + 0.1

    def step(v: Tensor) -> tuple[Tensor, ...]:
        grid, _ = ops.p2g(position, v, c, m, dx=DX, blocks=blocks, dt=0.1, stress=s, volume=vol)
        field, _, _ = ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks)
        x, v, affine, _ = ops.g2p(field, position, dx=DX, dt=0.1, blocks=blocks)
        return x, v, affine

    compiled = torch.compile(step, fullgraph=True, backend="aot_eager")
    for a, b in zip(step(v), compiled(v), strict=True):
        assert torch.equal(a, b)


# --- errors ---


def call_p2g(**change: Any) -> None:
    position, blocks, _ = setup()
    v, c, m, s, vol = (t.detach() for t in p2g_inputs())
    args: dict[str, Any] = {
        "position": position,
        "velocity": v,
        "affine": c,
        "mass": m,
        "dx": DX,
        "blocks": blocks,
        "stress": s,
        "volume": vol,
    }
    ops.p2g(**{**args, **change})


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"position": [1.0]}, TypeError, "position must be a torch.Tensor, got list"),
        ({"mass": torch.ones(N)}, TypeError, "mass must be float64 like the first tensor"),
        ({"velocity": torch.ones(N, 3).half()}, TypeError, "velocity must be float32 or float64"),
        ({"velocity": torch.ones(N, 2).double()}, ValueError, r"velocity must have shape \[8, 3\]"),
        ({"stress": torch.ones(N, 5).double()}, ValueError, r"stress must have shape \[8, 6\]"),
        ({"stress": None}, ValueError, "stress and volume must be given together"),
        ({"body": torch.zeros(N, dtype=torch.int64)}, TypeError, "body must be int32, got int64"),
        ({"fields": 0}, ValueError, "fields must be 1 to 64, got 0"),
        ({"dx": 0.0}, ValueError, "dx must be a positive number"),
        ({"dt": float("nan")}, ValueError, "dt must be a finite number"),
        ({"blocks": (1, 2)}, TypeError, "blocks must be a Blocks from build_blocks, got tuple"),
        ({"mass": torch.ones(N, device="meta").double()}, ValueError, "mass must be on cpu"),
    ],
)
def test_p2g_errors(change: dict[str, Any], error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        call_p2g(**change)


def test_blocks_of_other_particles_are_refused() -> None:
    _, blocks, _ = setup()
    position = torch.rand(N + 1, 3, dtype=torch.float64)
    field = torch.zeros(1, blocks.block_count, 64, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match="built for 8 particles, got 9; call build_blocks again"):
        ops.g2p(field, position, dx=DX, dt=0.1, blocks=blocks)
    with pytest.raises(ValueError, match=r"velocity_grid must have shape"):
        ops.g2p(field[:, :0], position[:N], dx=DX, dt=0.1, blocks=blocks)


def test_build_blocks_errors() -> None:
    x = torch.rand(5, 3)
    with pytest.raises(ValueError, match="margin must be 0, 1 or 2, got 3"):
        ops.build_blocks(x, DX, margin=3)
    with pytest.raises(ValueError, match="max_blocks must be 1 to"):
        ops.build_blocks(x, DX, max_blocks=2**26)
    with pytest.raises(ValueError, match="dx must be a positive number, got -1"):
        ops.build_blocks(x, -1.0)
    x[2] = float("nan")
    with pytest.raises(ValueError, match="got 1 of 5 rows that are not"):
        ops.build_blocks(x, DX)
    x[2] = 1e6
    with pytest.raises(ValueError, match="more than max_blocks"):
        ops.build_blocks(x, DX)


@pytest.mark.parametrize(
    ("kw", "match"),
    [
        ({"gravity": (0.0, 1.0)}, "gravity must have three numbers, got 2"),
        ({"friction": -1.0}, "friction must be >= 0"),
        ({"restitution": 1.5}, r"restitution must be in \[0, 1\]"),
        ({"colliders": torch.zeros(1, 3).double()}, r"colliders must have shape \[\*, 32\]"),
        ({"colliders": torch.zeros(1, 16).double()}, "colliders row 0 must be finite, with type 0"),
        ({"colliders": torch.full((1, 16), 7.0).double()}, "colliders row 0"),
        ({"moments": torch.zeros(1, 1, 64, 6).double()}, "moments must have shape"),
        ({"merged": torch.zeros(2, 2, dtype=torch.bool)}, "merged must have shape"),
    ],
)
def test_grid_update_errors(kw: dict[str, Any], match: str) -> None:
    _, blocks, _ = setup()
    grid = torch.rand(1, blocks.block_count, 64, 4, dtype=torch.float64)
    with pytest.raises(ValueError, match=match):
        ops.grid_update(grid, dx=DX, dt=0.1, blocks=blocks, **kw)
