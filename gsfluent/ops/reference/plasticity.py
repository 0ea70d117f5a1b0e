"""Algorithm D in plain PyTorch: the definition of ``return_mapping``, and its gradient.

Differentiable with respect to strain, alpha, increment and params: the two scalar roots (the cubic
of the unit-determinant state and the implicit alpha) are found without a graph and then corrected
by one Newton step with it, which is the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

J_MIN, J_MAX, DEVIATOR_MAX, STRAIN_MAX = 0.05, 20.0, 100.0, 1e4
P0_FLOOR, P0_CAP, COHESION_MAX, FRICTION_MIN = 1e-5, 0.495, 1e3, 1e-3
ALPHA_MIN, ALPHA_MAX, ALPHA_STEP_MAX = -10.0, 0.5, 0.2


class Material(NamedTuple):
    """Columns of ``params`` per particle: moduli [Pa], M, beta, xi, eta."""

    mu: Tensor
    kappa: Tensor
    friction: Tensor
    cohesion: Tensor
    hardening: Tensor
    shear_damage: Tensor


class Options(NamedTuple):
    """How the map is computed: exponent k, regularisation epsilon, implicit alpha or not."""

    k: float
    epsilon: float
    implicit: bool


def to_matrix(sym: Tensor) -> Tensor:
    """[N, 6] (xx, yy, zz, xy, xz, yz) to [N, 3, 3]."""
    return sym[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)


def to_sym(matrix: Tensor) -> Tensor:
    """[N, 3, 3] symmetric to [N, 6]."""
    return matrix.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]


def _diagonal(value: Tensor) -> Tensor:
    zero = torch.zeros_like(value)
    return torch.stack([value, value, value, zero, zero, zero], dim=1)


def _det_minus_one(matrix: Tensor) -> Tensor:
    """det(I + m) - 1 by its invariants."""
    trace = matrix.diagonal(dim1=1, dim2=2).sum(1)
    second = 0.5 * (trace**2 - (matrix @ matrix).diagonal(dim1=1, dim2=2).sum(1))
    return trace + second + _det(matrix)


def _det(m: Tensor) -> Tensor:
    return (m[:, 0] * torch.linalg.cross(m[:, 1], m[:, 2], dim=1)).sum(1)


def _safe_norm(sym: Tensor) -> Tensor:
    square = (sym[:, :3] ** 2).sum(1) + 2.0 * (sym[:, 3:] ** 2).sum(1)
    tiny = square < 1e-60 if sym.dtype == torch.float64 else square < 1e-37
    return torch.where(tiny, 0.0, torch.where(tiny, 1.0, square).sqrt())


def unit_det_shift(d: Tensor) -> Tensor:
    """Largest root m of det(m I + d) = 1, minus one; d traceless, [N, 6]."""
    norm2 = (d[:, :3] ** 2).sum(1) + 2.0 * (d[:, 3:] ** 2).sum(1)
    h, c = 0.5 * norm2, 0.5 * norm2 - _det(to_matrix(d))

    def residual(y: Tensor, h: Tensor, c: Tensor) -> Tensor:
        return ((y + 3.0) * y + (3.0 - h)) * y - c

    def slope(y: Tensor, h: Tensor) -> Tensor:
        return (3.0 * y + 6.0) * y + (3.0 - h)

    with torch.no_grad():
        y = 2.0 * (h / 3.0).sqrt()
        for _ in range(60):  # monotone from above
            step = torch.where(slope(y, h) > 0, residual(y, h, c) / slope(y, h), 0.0)
            y = y - step
            if not bool((step.abs() > 1e-15 * (1.0 + y.abs())).any()):
                break
        safe_slope = torch.where(slope(y, h) > 0, slope(y, h), 1.0)
    return y - residual(y, h, c) / safe_slope


def strain_from_isochoric(d: Tensor, log_j: Tensor) -> Tensor:
    """Strain b - I of the state with isochoric deviator d and volume ratio exp(log_j)."""
    y = unit_det_shift(d)
    s = torch.expm1(2.0 / 3.0 * log_j)
    return (1.0 + s)[:, None] * d + _diagonal(y + s * (1.0 + y))


def yield_surface(m: Material, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Tips p0 and -beta p0, centre, half-width in p and half-height in q, all [Pa]."""
    beta = m.cohesion.clamp(max=COHESION_MAX)
    x = (m.hardening * (-alpha).clamp(min=0.0)).clamp(max=5.0)
    p0 = m.kappa * (P0_FLOOR + torch.sinh(x)).clamp(max=P0_CAP)
    half = 0.5 * (1.0 + beta) * p0
    height = m.friction * half / (1.0 + 2.0 * beta).sqrt()
    return p0, -beta * p0, 0.5 * (1.0 - beta) * p0, half, height


def _normalized(m: Material, alpha: Tensor, p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    _, _, center, half, height = yield_surface(m, alpha)
    u = ((p - center) / half).clamp(-1e4, 1e4)
    w = (q / torch.maximum(height, 1e-8 * m.kappa)).clamp(max=1e6)
    return u, w


def project(
    m: Material, o: Options, alpha: Tensor, p: Tensor, q: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(crossing pressure, returned pressure, deviator factor): equations.md section 5, 4 to 7."""
    p0, tip, middle, half, height = yield_surface(m, alpha)
    u, w = _normalized(m, alpha, p, q)
    a = u.abs().clamp(max=1.0)
    sign = torch.where(u < 0, -1.0, 1.0).to(u.dtype)
    center = sign * (1.0 - o.epsilon) * (a**3 if o.k == 2.0 else a ** (o.k + 1.0))
    gap, g = u - center, 1.0 - center**2
    square = gap**2 + w**2 * g
    root = torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)
    t = (g / (center * gap + root).clamp(min=1e-30)).clamp(max=1.0)
    cross = middle + half * (center + t * gap)
    inside = torch.minimum(torch.maximum(p, tip), p0)
    zero = torch.zeros_like(inside)
    relaxed = torch.minimum(
        torch.maximum(cross, inside.clamp(max=0.0)), torch.maximum(inside, zero)
    )
    frictionless = m.friction < FRICTION_MIN
    cross = torch.where(frictionless, inside, cross)
    p_new = torch.where(frictionless, inside, relaxed)
    product = ((p0 - p_new) * (p_new - tip)).clamp(min=0.0)
    safe = torch.where(product > 0, product, 1.0).sqrt()
    w_tip = torch.where(product > 0, safe, 0.0) / half
    w_new = torch.where((p_new == cross) & ~frictionless, t * w, w_tip)
    r = (height * w_new / torch.maximum(q, 1e-30 * m.kappa)).clamp(max=1.0)
    return cross, p_new, torch.where((t < 1.0) | (p_new != p), r, 1.0)


def _alpha_step(m: Material, log_j: Tensor, n: Tensor, cross: Tensor, r: Tensor) -> Tensor:
    volume = log_j - 0.5 * torch.log1p(-2.0 * cross / m.kappa)
    shear = m.shear_damage * (1.0 - r) * n / 6.0**0.5
    return (volume + shear).clamp(-ALPHA_STEP_MAX, ALPHA_STEP_MAX)


def _bracketed_root(
    residual: Callable[[Tensor], Tensor], x: Tensor, step: Tensor, tolerance: Tensor
) -> Tensor:
    """Root of ``residual`` beyond x on the side of ``step``: walk to a bracket, then close it.

    The walk (secant steps, at least once and at most four times the last, ALPHA_STEP_MAX in all)
    and the Anderson-Bjorck secants that close the bracket are part of the definition, because a
    step that overshoots the surface by more than its own size can have several roots.
    """
    far = x + torch.where(step > 0, ALPHA_STEP_MAX, -ALPHA_STEP_MAX).to(x.dtype)
    lo, hi = x, x + step
    f_lo, f_hi = -step, residual(x + step)
    solve = step.abs() > tolerance
    for _ in range(40):
        walking = solve & (f_lo * f_hi > 0) & (f_hi.abs() > tolerance) & (hi != far)
        if not bool(walking.any()):
            break
        ratio = f_hi / torch.where(f_lo == f_hi, 1.0, f_lo - f_hi)
        ratio = torch.where((f_lo == f_hi) | (ratio <= 0), 4.0, ratio.clamp(1.0, 4.0))
        ahead = hi + (hi - lo) * ratio
        ahead = torch.where((ahead - x).abs() < ALPHA_STEP_MAX, ahead, far)
        lo, f_lo = torch.where(walking, hi, lo), torch.where(walking, f_hi, f_lo)
        hi = torch.where(walking, ahead, hi)
        f_hi = torch.where(walking, residual(hi), f_hi)
    open_, before = solve, f_hi.abs()
    for i in range(60):
        open_ = open_ & (f_hi.abs() > tolerance) & ((hi - lo).abs() > tolerance)
        if not bool(open_.any()):
            break
        guess = hi - f_hi * (hi - lo) / torch.where(open_, f_hi - f_lo, 1.0)
        left, right = torch.minimum(lo, hi), torch.maximum(lo, hi)
        halve = ~((guess > left) & (guess < right))
        if i % 8 == 7:  # secants that gain little
            halve |= f_hi.abs() > 0.1 * before
            before = f_hi.abs()
        guess = torch.where(halve, 0.5 * (left + right), guess)
        f = residual(guess)
        crossed = f * f_hi < 0
        scale = 1.0 - f / torch.where(open_, f_hi, 1.0)
        kept = torch.where(scale > 0, scale, 0.5) * f_lo
        lo = torch.where(open_ & crossed, hi, lo)
        f_lo = torch.where(open_, torch.where(crossed, f_hi, kept), f_lo)
        hi, f_hi = torch.where(open_, guess, hi), torch.where(open_, f, f_hi)
    return hi


def _solve_alpha(
    m: Material,
    o: Options,
    log_j: Tensor,
    n: Tensor,
    p: Tensor,
    q: Tensor,
    alpha: Tensor,
    root: Tensor | None = None,
) -> Tensor:
    """X = alpha + step(surface at x), with its derivative; ``root`` is x where it is known."""

    def residual(x: Tensor) -> Tensor:
        cross, _, r = project(m, o, x, p, q)
        return x - alpha - _alpha_step(m, log_j, n, cross, r)

    with torch.no_grad():
        if root is None:
            step = -residual(alpha)
            eps = 4.0 * torch.finfo(alpha.dtype).eps
            size = alpha.abs() + step.abs() + log_j.abs()
            x = _bracketed_root(residual, alpha, step, eps * size)
        else:
            x = root
        # The residual of a particle depends on its own x only: one tangent gives every slope.
        slope = torch.func.jvp(residual, (x,), (torch.ones_like(x),))[1]
        slope = torch.where(slope.abs() > 1e-6, slope, 1.0)
    correction = residual(x) / slope.detach()
    return x - (correction - correction.detach())


def gather_material(params: Tensor, rows: Tensor | None, count: int) -> Material:
    """Per-particle columns of ``params`` [M, 8]; ``rows`` is the material index or None."""
    index = rows.long() if rows is not None else None
    table = params[index] if index is not None else params.expand(count, -1)
    return Material(*table.unbind(1)[:6])


def return_mapping(
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    *,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    k: float = 2.0,
    epsilon: float = 0.1,
    implicit: bool = True,
    dt: float = 0.0,
    root: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One constitutive step; arguments and results as :func:`gsfluent.ops.return_mapping`.

    ``root``, [N], is the implicit alpha when it is known already; only its derivative is computed.
    """
    count = strain.shape[0]
    m = gather_material(params, material, count)
    laws = law[material.long()] if material is not None else law.expand(count)
    o = Options(k, epsilon, implicit)
    if bool((laws > 1).any()):
        raise NotImplementedError("the reference knows the laws elastic and nacc so far")

    # Lost states are replaced by rest before anything is differentiated.
    with torch.no_grad():
        h = increment + increment @ to_matrix(strain)
        e = strain + to_sym(h + h.transpose(1, 2) + h @ increment.transpose(1, 2))
        valid = torch.isfinite(e).all(1) & torch.isfinite(alpha)
    strain = torch.where(valid[:, None], strain, 0.0)
    increment = torch.where(valid[:, None, None], increment, 0.0)
    alpha_in, alpha = alpha, torch.where(torch.isfinite(alpha), alpha, 0.0)
    h = increment + increment @ to_matrix(strain)
    e = strain + to_sym(h + h.transpose(1, 2) + h @ increment.transpose(1, 2))

    # Guards (csrc/core/elastic.h): inversion, size, volume, distortion.
    inverted = valid & ~(1.0 + _det_minus_one(increment) > 0)
    largest = e.abs().amax(1)
    too_large = largest > STRAIN_MAX
    e = torch.where(too_large, STRAIN_MAX / largest.clamp(min=STRAIN_MAX), 1.0)[:, None] * e
    lo, hi = J_MIN**2 - 1.0, J_MAX**2 - 1.0
    raw = torch.where(inverted, lo, _det_minus_one(to_matrix(e)))
    came_with = raw.clamp(min=lo)
    j2m1 = came_with.clamp(max=hi)
    isochoric = torch.exp(-torch.log1p(came_with) / 3.0)
    log_j = 0.5 * torch.log1p(j2m1)
    d = isochoric[:, None] * (e - _diagonal(e[:, :3].mean(1)))
    n = _safe_norm(d)
    too_sheared = n > DEVIATOR_MAX
    d = torch.where(too_sheared, DEVIATOR_MAX / n.clamp(min=DEVIATOR_MAX), 1.0)[:, None] * d
    n = n.clamp(max=DEVIATOR_MAX)
    guarded = valid & (inverted | too_large | (raw < lo) | (raw > hi) | too_sheared)

    # Return to the surface (csrc/core/nacc.h).
    p, q = -0.5 * m.kappa * j2m1, 1.5**0.5 * m.mu * n
    nacc = laws == 1
    alpha = torch.where(nacc & valid, alpha.clamp(ALPHA_MIN, ALPHA_MAX), alpha)
    u, w = _normalized(m, alpha, p, q)
    slack = 2e-15 if e.dtype == torch.float64 else 1e-6
    plastic = valid & nacc & (u**2 + w**2 > 1.0 + slack)
    if implicit:
        new_alpha = _solve_alpha(m, o, log_j, n, p, q, alpha, root)
        if root is not None:  # at a limit it moves no further
            new_alpha = torch.where((root > ALPHA_MIN) & (root < ALPHA_MAX), new_alpha, root)
        new_alpha = new_alpha.clamp(ALPHA_MIN, ALPHA_MAX)
        _, p_new, r = project(m, o, new_alpha, p, q)
    else:
        cross, p_new, r = project(m, o, alpha, p, q)
        new_alpha = (alpha + _alpha_step(m, log_j, n, cross, r)).clamp(ALPHA_MIN, ALPHA_MAX)
    alpha = torch.where(plastic, new_alpha, alpha)
    d = torch.where(plastic[:, None], r[:, None] * d, d)
    j2m1 = torch.where(plastic, -2.0 * p_new / m.kappa, j2m1)
    log_j = torch.where(plastic, 0.5 * torch.log1p(j2m1), log_j)

    rebuilt = (plastic | guarded)[:, None]
    new_strain = torch.where(rebuilt, strain_from_isochoric(d, log_j), e)
    stress = m.mu[:, None] * d + _diagonal(0.5 * m.kappa * j2m1)
    new_strain = torch.where(valid[:, None], new_strain, 0.0)
    stress = torch.where(valid[:, None], stress, 0.0)
    alpha = torch.where(torch.isfinite(alpha_in), alpha, 0.0)
    info = torch.stack([plastic.sum(), guarded.sum(), inverted.sum(), (~valid).sum()])
    return new_strain, alpha, stress, info.to(torch.int32)


def elastic_energy(strain: Tensor, m: Material) -> Tensor:
    """Stored energy per initial volume [J/m^3] of Borden's neo-Hookean law, [N]."""
    x = _det_minus_one(to_matrix(strain))
    log_j = 0.5 * torch.log1p(x)
    d = torch.exp(-2.0 / 3.0 * log_j)[:, None] * (strain - _diagonal(strain[:, :3].mean(1)))
    series = x * x * (0.5 - x * (1.0 / 3.0 - x * (0.25 - x * 0.2)))
    volumetric = torch.where(x.abs() < 1e-3, series, x - 2.0 * log_j)
    return 1.5 * m.mu * unit_det_shift(d) + 0.25 * m.kappa * volumetric
