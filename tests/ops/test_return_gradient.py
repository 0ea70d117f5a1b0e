"""The adjoint kernel of return_mapping against the reference differentiated by PyTorch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops._plasticity_grad import adjoint_of_elastic
from gsfluent.ops.reference import plasticity as reference

N = 3000
LAWS = torch.tensor([0, 1, 1, 1], dtype=torch.int32)
ROWS = torch.tensor(
    [  # mu, kappa, M, beta, xi, eta, density, exponent
        [60.0, 230.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [60.0, 230.0, 1.85, 0.6, 3.0, 0.3, 1.0, 0.0],
        [6e8, 8e8, 2.36, 0.5, 1.0, 0.0, 2.0, 0.0],
        [60.0, 230.0, 0.0, 0.2, 2.0, 0.0, 1.0, 0.0],
    ],
    dtype=torch.float64,
)


def particles() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Strain, alpha, increment and row; about half of the NACC ones yield."""
    f = torch.eye(3, dtype=torch.float64) + 0.12 * torch.randn(N, 3, 3, dtype=torch.float64)
    b = f @ f.mT - torch.eye(3, dtype=torch.float64)
    strain = b.reshape(N, 9)[:, [0, 4, 8, 1, 2, 5]].contiguous()
    strain[::7] *= 1e-6
    strain[5] = 0.0
    alpha = -0.08 * torch.rand(N, dtype=torch.float64)
    alpha[::11] = 0.05
    increment = 0.03 * torch.randn(N, 3, 3, dtype=torch.float64)
    increment[5] = 0.0
    row = torch.randint(0, len(LAWS), (N,)).int()
    return strain, alpha, increment, row


@pytest.mark.parametrize("implicit", [True, False])
def test_kernel_is_the_gradient_of_the_reference(implicit: bool) -> None:
    strain, alpha, increment, row = particles()
    weights = torch.randn(N, 6).double(), torch.randn(N).double(), torch.randn(N, 6).double()
    moduli = ROWS[row.long(), 1]
    weights = weights[0], weights[1], weights[2] / moduli[:, None]
    kw = {"law": LAWS, "material": row, "implicit": implicit}
    _, new_alpha, _, info = ops.return_mapping(strain, alpha, increment, params=ROWS, **kw)
    assert N // 5 < int(info[0]) < 4 * N // 5
    options = (2.0, 0.1, implicit)
    *grads, g_rows, done = torch.ops.gsfluent.return_mapping_adjoint(
        *weights, new_alpha, strain, alpha, increment, LAWS, ROWS, row, *options
    )
    assert (done == 1).double().mean() > 0.95

    def forward(e: Tensor, a: Tensor, inc: Tensor, rows: Tensor) -> tuple[Tensor, ...]:
        laws = LAWS[row.long()]
        return reference.return_mapping(
            e, a, inc, law=laws, params=rows, implicit=implicit, root=new_alpha
        )[:3]

    rows = ROWS[row.long()]
    _, pull_back, *_ = torch.func.vjp(forward, strain, alpha, increment, rows)
    *want, want_rows = pull_back(weights)
    done = done > 0
    scale = rows[:, :6].abs().clamp(min=1.0)  # relative changes of the moduli
    assert (g_rows[row == 3, 2] == 0).all()  # friction is switched off below 1e-3
    scale[row == 3, 2] = 0.0
    for got, right in zip((*grads, g_rows * scale), (*want, want_rows[:, :6] * scale), strict=True):
        got, right = got[done].flatten(1) if got.dim() > 1 else got[done, None], right[done]
        right = right.reshape(got.shape)
        error = (got - right).abs().amax(1) / right.abs().amax(1).clamp(min=1e-3)
        # a particle within rounding of a kink may be on another piece
        assert error.quantile(0.998) < 1e-8, error.topk(5)
    assert (g_rows[done & (row == 1), 2:].abs().amax(0) > 0).all()  # M, beta, xi, eta all act


def test_elastic_adjoint_of_cuda_agrees_with_the_kernel() -> None:
    strain, alpha, increment, row = particles()
    weights = torch.randn(N, 6).double(), torch.randn(N).double(), torch.randn(N, 6).double()
    laws, rows = LAWS[row.long()], ROWS[row.long()]
    *torch_grads, elastic = adjoint_of_elastic(*weights, strain, alpha, increment, laws, rows)
    *grads, done = torch.ops.gsfluent.return_mapping_adjoint(
        *weights, alpha, strain, alpha, increment, LAWS, ROWS, row, 2.0, 0.1, True
    )
    assert 0.2 < elastic.double().mean() < 0.8
    assert (done[elastic] == 1).all()
    for ours, kernel in zip(torch_grads, grads, strict=True):
        assert (ours[~elastic] == 0).all()
        torch.testing.assert_close(ours[elastic], kernel[elastic], rtol=1e-9, atol=1e-9)


def test_what_the_kernel_leaves_is_marked() -> None:
    strain, alpha, increment, row = particles()
    increment[0] = -2.0 * torch.eye(3, dtype=torch.float64)  # inverted
    strain[1, 0] = float("nan")
    alpha[2], row[2] = 0.6, 1  # beyond the range of alpha
    row[3] = 99
    strain[4] = torch.tensor([500.0, 0, 0, 0, 0, 0], dtype=torch.float64)  # guarded
    ones = torch.ones(N, 6).double(), torch.ones(N).double(), torch.ones(N, 6).double()
    *grads, done = torch.ops.gsfluent.return_mapping_adjoint(
        *ones, alpha, strain, alpha, increment, LAWS, ROWS, row, 2.0, 0.1, True
    )
    assert (done[:5] == 0).all()
    for g in grads:
        assert (g[:5] == 0).all()
        assert g.isfinite().all()
