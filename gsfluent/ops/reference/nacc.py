"""The NACC surface and its implicit alpha in plain PyTorch: equations.md section 5, steps 3 to 9.

The implicit alpha is found without a graph and then corrected by one Newton step with it, which is
the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

P0_FLOOR, P0_CAP, COHESION_MAX, FRICTION_MIN = 1e-5, 0.495, 1e3, 1e-3
ALPHA_MIN, ALPHA_MAX, ALPHA_STEP_MAX = -10.0, 0.5, 0.2


class Material(NamedTuple):
    """Columns of ``params`` per particle; ``friction`` is the column called strength."""

    mu: Tensor
    kappa: Tensor
    friction: Tensor
    cohesion: Tensor
    hardening: Tensor
    shear_damage: Tensor
    density: Tensor
    exponent: Tensor


class Options(NamedTuple):
    """How the map is computed: exponent k, regularisation epsilon, implicit alpha or not."""

    k: float
    epsilon: float
    implicit: bool


def yield_surface(m: Material, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Tips p0 and -beta p0, centre, half-width in p and half-height in q, all [Pa]."""
    beta = m.cohesion.clamp(max=COHESION_MAX)
    x = (m.hardening * (-alpha).clamp(min=0.0)).clamp(max=5.0)
    p0 = m.kappa * (P0_FLOOR + torch.sinh(x)).clamp(max=P0_CAP)
    half = 0.5 * (1.0 + beta) * p0
    height = m.friction * half / (1.0 + 2.0 * beta).sqrt()
    return p0, -beta * p0, 0.5 * (1.0 - beta) * p0, half, height


def normalized(m: Material, alpha: Tensor, p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """(u, w): pressure and shear in units of the surface, clamped."""
    _, _, center, half, height = yield_surface(m, alpha)
    u = ((p - center) / half).clamp(-1e4, 1e4)
    w = (q / torch.maximum(height, 1e-8 * m.kappa)).clamp(max=1e6)
    return u, w


def project(
    m: Material, o: Options, alpha: Tensor, p: Tensor, q: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(crossing pressure, returned pressure, deviator factor): equations.md section 5, 4 to 7."""
    p0, tip, middle, half, height = yield_surface(m, alpha)
    u, w = normalized(m, alpha, p, q)
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


def alpha_step(m: Material, log_j: Tensor, n: Tensor, cross: Tensor, r: Tensor) -> Tensor:
    """Change of alpha: ln(J_trial / J_cross) plus shear damage, limited per step."""
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


def solve_alpha(
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
        return x - alpha - alpha_step(m, log_j, n, cross, r)

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
