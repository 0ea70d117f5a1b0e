"""Gradient of ``return_mapping``.

On the CPU a kernel (csrc/core/material/return_gradient.h) does the laws elastic and nacc; on CUDA
elastic particles, which most particles of most steps are, have their page of algebra here. What is
left (other laws, guarded states) goes through :mod:`gsfluent.ops.reference.plasticity`, with the
alpha the forward pass found: the implicit function theorem needs the root and not the search.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsfluent.ops.reference import plasticity as reference

LAW_ELASTIC, LAW_NACC = 0, 1
_DIAGONAL, _OFF = slice(0, 3), slice(3, 6)


def _matrix(sym: Tensor) -> Tensor:
    """[N, 6] -> [3, 3, N], particles last: elementwise operations on whole columns."""
    return sym.T[[0, 3, 4, 3, 1, 5, 4, 5, 2]].view(3, 3, -1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0, None] * b[None, 0] + a[:, 1, None] * b[None, 1] + a[:, 2, None] * b[None, 2]


def _transposed(a: Tensor) -> Tensor:
    return a.transpose(0, 1)


def _cofactors(a: Tensor) -> Tensor:
    """Derivative of the determinant of [3, 3, N] with respect to each entry."""
    return torch.stack(
        [torch.linalg.cross(a[(i + 1) % 3], a[(i + 2) % 3], dim=0) for i in range(3)]
    )


def _symmetric(g: Tensor) -> Tensor:
    """Gradient of six components, [N, 6] -> symmetric S, [3, 3, N], with dL = tr(S dB)."""
    return _matrix(torch.cat([g[:, _DIAGONAL], 0.5 * g[:, _OFF]], dim=1))


def _components(s: Tensor) -> Tensor:
    """The inverse of :func:`_symmetric`."""
    return torch.stack(
        [s[0, 0], s[1, 1], s[2, 2], s[0, 1] + s[1, 0], s[0, 2] + s[2, 0], s[1, 2] + s[2, 1]], dim=1
    )


def _deviator(sym: Tensor) -> Tensor:
    mean = sym[:, _DIAGONAL].mean(1, keepdim=True)
    return torch.cat([sym[:, _DIAGONAL] - mean, sym[:, _OFF]], dim=1)


class _Trial:
    """The trial state of every particle and whether the map leaves it as it is."""

    def __init__(self, strain: Tensor, alpha: Tensor, increment: Tensor) -> None:
        eye = torch.eye(3, dtype=strain.dtype, device=strain.device)[:, :, None]
        self.push = increment.permute(1, 2, 0).contiguous() + eye  # I + A
        self.before = _matrix(strain) + eye
        spread = _product(self.push, self.before)
        e = _matrix(strain)
        h = increment.permute(1, 2, 0) + _product(self.push - eye, e)  # A (I + e)
        trial = e + h + _transposed(h) + _product(h, _transposed(self.push - eye))
        self.spread = spread  # (I + A) b
        self.strain = torch.stack(
            [trial[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], dim=1
        )
        self.cofactors = _cofactors(trial + eye)
        # J^2 - 1 from the invariants of e, as the kernel does: strains below 1e-7 keep their digits
        t = trial
        trace = t[0, 0] + t[1, 1] + t[2, 2]
        pairs = (
            t[0, 0] * t[1, 1]
            + t[1, 1] * t[2, 2]
            + t[2, 2] * t[0, 0]
            - (t[0, 1] ** 2 + t[0, 2] ** 2 + t[1, 2] ** 2)
        )
        self.j2m1 = trace + pairs + (t[0] * _cofactors(t)[0]).sum(0)
        self.valid = torch.isfinite(self.strain).all(1) & torch.isfinite(alpha)

    def untouched(self, m: reference.Material, laws: Tensor, alpha: Tensor) -> Tensor:
        """Particles of law elastic or NACC that are valid, not guarded and not yielding."""
        lo, hi = reference.J_MIN**2 - 1.0, reference.J_MAX**2 - 1.0
        upright = (self.push[0] * _cofactors(self.push)[0]).sum(0) > 0
        simple = self.valid & upright & (self.j2m1 >= lo) & (self.j2m1 <= hi)
        simple &= self.strain.abs().amax(1) <= reference.STRAIN_MAX
        scale = torch.exp(-torch.log1p(self.j2m1.clamp(lo, hi)) / 3.0)
        d = scale[:, None] * _deviator(self.strain)
        n = ((d[:, _DIAGONAL] ** 2).sum(1) + 2.0 * (d[:, _OFF] ** 2).sum(1)).sqrt()
        simple &= n <= reference.DEVIATOR_MAX
        nacc = laws == LAW_NACC
        if bool(nacc.any()):
            p, q = -0.5 * m.kappa * self.j2m1, 1.5**0.5 * m.mu * n
            limited = alpha.clamp(reference.ALPHA_MIN, reference.ALPHA_MAX)
            u, w = reference.normalized(m, limited, p, q)
            slack = 2e-15 if n.dtype == torch.float64 else 1e-6
            within = (u**2 + w**2 <= 1.0 + slack) & (limited == alpha)
            simple &= (laws == LAW_ELASTIC) | (nacc & within)
        else:
            simple &= laws == LAW_ELASTIC
        return simple

    def pull_back(
        self, g_strain: Tensor, g_stress: Tensor, m: reference.Material
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients of strain, increment, mu and kappa where the map is elastic."""
        j2 = (1.0 + self.j2m1).clamp(min=reference.J_MIN**2)
        scale = torch.exp(-torch.log(j2) / 3.0)
        dev, g_dev = _deviator(self.strain), _deviator(g_stress)
        pulled = (g_stress * dev).sum(1) * scale
        pressed = 0.5 * g_stress[:, _DIAGONAL].sum(1)
        along_j2 = m.kappa * pressed - m.mu * pulled / (3.0 * j2)
        s = _symmetric(g_strain + (m.mu * scale)[:, None] * g_dev) + along_j2 * self.cofactors
        through = _product(s, self.push)
        g_before = _components(_product(_transposed(self.push), through))
        g_push = 2.0 * _product(s, self.spread)
        return g_before, g_push.permute(2, 0, 1), pulled, pressed * self.j2m1


def adjoint_of_elastic(
    grad_strain: Tensor,
    grad_alpha: Tensor,
    grad_stress: Tensor,
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    laws: Tensor,
    params: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of the particles the map leaves elastic, in PyTorch.

    Args:
        grad_strain: [N, 6].
        grad_alpha: [N].
        grad_stress: [N, 6].
        strain: [N, 6].
        alpha: [N].
        increment: [N, 3, 3].
        laws: Law of each particle, [N].
        params: Material row of each particle, [N, 8].

    Returns:
        Gradients of strain, alpha, increment and of the first six columns of each particle's row
        [N, 6], zero elsewhere; and where they were computed, bool [N].
    """
    m = reference.Material(*params.unbind(1)[: len(reference.Material._fields)])
    trial = _Trial(strain, alpha, increment)
    done = trial.untouched(m, laws, alpha)
    g_strain, g_increment, g_mu, g_kappa = trial.pull_back(grad_strain, grad_stress, m)
    keep = done[:, None]
    # `where` and not a product: a particle that is not elastic may hold anything.
    g_rows = strain.new_zeros(len(strain), 6)
    g_rows[:, :2] = torch.where(keep, torch.stack([g_mu, g_kappa], dim=1), 0.0)
    return (
        torch.where(keep, g_strain, 0.0),
        torch.where(done, grad_alpha, 0.0),
        torch.where(keep[:, None], g_increment, 0.0),
        g_rows,
        done,
    )


@torch.library.custom_op("gsfluent::return_mapping_backward", mutates_args=())
def _return_mapping_backward(
    grad_strain: Tensor,
    grad_alpha: Tensor,
    grad_stress: Tensor,
    new_alpha: Tensor,
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    law: Tensor,
    params: Tensor,
    material: Tensor | None,
    k: float,
    epsilon: float,
    implicit: bool,
    dt: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    count, rows = strain.shape[0], params.shape[0]
    if material is not None:
        row = material.long()
    elif rows == count:
        row = torch.arange(count, device=params.device)
    else:
        row = torch.zeros(count, dtype=torch.int64, device=params.device)
    grads, state = (grad_strain, grad_alpha, grad_stress), (strain, alpha, increment)
    if strain.device.type == "cpu":
        g_strain, g_alpha, g_increment, g_rows, done = torch.ops.gsfluent.return_mapping_adjoint(
            *grads, new_alpha, *state, law, params, material, k, epsilon, implicit
        )
        done = done > 0
    else:
        g_strain, g_alpha, g_increment, g_rows, done = adjoint_of_elastic(
            *grads, *state, law[row], params[row]
        )
    g_params = torch.zeros_like(params)
    if rows == 1:
        g_params[0, :6] = g_rows.sum(0)
    else:
        g_params[:, :6] = torch.zeros_like(params[:, :6]).index_add(0, row, g_rows)

    rest = (~done).nonzero().squeeze(1)
    if rest.numel():
        of = row[rest]

        def forward(e: Tensor, a: Tensor, inc: Tensor, par: Tensor) -> tuple[Tensor, ...]:
            return reference.return_mapping(
                e,
                a,
                inc,
                law=law[of],
                params=par,
                k=k,
                epsilon=epsilon,
                implicit=implicit,
                dt=dt,
                root=new_alpha[rest],
            )[:3]

        # torch.func works inside a custom op, where ordinary autograd is switched off.
        pull_back: Callable[..., tuple[Tensor, ...]]
        _, pull_back, *_ = torch.func.vjp(
            forward, strain[rest], alpha[rest], increment[rest], params[of]
        )
        part = pull_back((grad_strain[rest], grad_alpha[rest], grad_stress[rest]))
        g_strain[rest], g_alpha[rest], g_increment[rest] = part[:3]
        g_params.index_add_(0, of, part[3])
    return g_strain, g_alpha, g_increment.contiguous(), g_params


_return_mapping_backward.register_fake(
    lambda *inputs: tuple(torch.empty_like(inputs[k]) for k in (4, 5, 6, 8))
)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    strain, alpha, increment, law, params, material, *options, _apart = inputs
    ctx.save_for_backward(output[1], strain, alpha, increment, law, params, material)
    ctx.options = options


def _backward(
    ctx: Any, grad_strain: Tensor, grad_alpha: Tensor, grad_stress: Tensor, _info: Tensor
) -> tuple[Tensor | None, ...]:
    strain, alpha, increment, params = torch.ops.gsfluent.return_mapping_backward.default(
        grad_strain, grad_alpha, grad_stress, *ctx.saved_tensors, *ctx.options
    )
    return strain, alpha, increment, None, params, *((None,) * (2 + len(ctx.options)))


torch.library.register_autograd("gsfluent::return_mapping", _backward, setup_context=_setup_context)
