"""NACC return maps of the textbook solver: fixed and dynamic centre, explicit and implicit alpha.

Fixed centre: Wolper et al. 2019 as released (equations.md 2.3: tip cases, trace of b kept, alpha by
a line through the centre), and the line of GaussianFluent's released code (3.3). Dynamic centre:
GaussianFluent's Eq. 6 with the exact determinant (equations.md 5; epsilon = 0 is the paper's).
Nothing is shared with :func:`gsfluent.ops.return_mapping`, which the tests compare with.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.lab.textbook.laws import Elastic, det, deviator, trace

MAPS = (
    "fixed_explicit",
    "fixed_implicit",
    "released_explicit",
    "dynamic_explicit",
    "dynamic_implicit",
)
"""``released``: GaussianFluent's code, whose line to the centre is nearly vertical."""
EPSILON = 0.1
"""Regularisation of the dynamic centre where alpha is implicit; the explicit map has none."""
ABSOLUTE = 1e-4
"""Tolerance of ziran, claymore and GaussianFluent [Pa], [Pa^2] and [1]."""


class Nacc(NamedTuple):
    """Parameters per point: moduli [Pa], friction M, cohesion beta, hardening xi."""

    mu: Tensor
    kappa: Tensor
    friction: Tensor
    cohesion: Tensor
    hardening: Tensor

    def of(self, rows: Tensor) -> Nacc:
        """Those of some points."""
        return Nacc(*(column[rows] for column in self))


class Trial(NamedTuple):
    """Trial state: b - I, isochoric deviator, log volume ratio, pressure, shear [Pa]."""

    e: Tensor
    d: Tensor
    log_j: Tensor
    p: Tensor
    q: Tensor

    def of(self, rows: Tensor) -> Trial:
        """That of some points."""
        return Trial(*(column[rows] for column in self))


class _Answer(NamedTuple):
    """Plastic, returned to a tip, factor of the deviator, ln J after it, alpha step."""

    plastic: Tensor
    tip: Tensor
    factor: Tensor
    log_j: Tensor
    step: Tensor


def trial(m: Elastic, nacc: Nacc) -> Trial:
    """Trial state of a strain."""
    d = (m.j ** (-2.0 / 3.0))[:, None, None] * deviator(m.e)
    n = (d * d).sum((1, 2)).sqrt()
    return Trial(m.e, d, m.log_j, -0.5 * nacc.kappa * m.j2m1, math.sqrt(1.5) * nacc.mu * n)


# --- fixed centre ---


def _fixed(m: Nacc, t: Trial, alpha: Tensor, absolute: bool, released: bool) -> _Answer:
    beta, kappa, m2 = m.cohesion, m.kappa, m.friction**2
    p0 = kappa * (1e-5 + torch.sinh(m.hardening * (-alpha).clamp(min=0.0)))
    low, centre, half = -beta * p0, 0.5 * (1.0 - beta) * p0, 0.5 * (1.0 + beta) * p0
    lean = 1.0 + 2.0 * beta
    y = lean * t.q**2 + m2 * (t.p - low) * (t.p - p0)
    slack = torch.full_like(p0, ABSOLUTE) if absolute else 1e-6 * m2 * half**2
    edge = ABSOLUTE if absolute else 0.0
    over, under = t.p > p0, t.p < low
    tip, shear = over | under, ~over & ~under & (y >= slack)
    end = torch.where(over, p0, low)
    log_end = 0.5 * torch.log1p(-2.0 * end / kappa)

    # the deviator goes straight down at the trial pressure
    room = (-m2 * (t.p - low) * (t.p - p0) / lean).clamp(min=0.0).sqrt()
    factor = torch.where(tip, 0.0, torch.where(shear, room / t.q, 1.0))

    # alpha: along the line through the centre
    across, up = centre - t.p, -t.q
    length = (across**2 + up**2).sqrt()
    dp = across / length
    dq = up if released else up / length
    a = m2 * dp**2 + lean * dq**2
    b = m2 * dp * (2.0 * centre - p0 - low)
    c = m2 * (centre - low) * (centre - p0)
    root = (b * b - 4.0 * a * c).sqrt()
    one, other = centre + dp * (-b + root) / (2 * a), centre + dp * (-b - root) / (2 * a)
    cross = torch.where((t.p - centre) * (one - centre) > 0, one, other)
    j_cross = (1.0 - 2.0 * cross / kappa).abs().sqrt()
    counted = (p0 > edge) & (t.p > low + edge) & (t.p < p0 - edge)
    counted &= j_cross > ABSOLUTE
    step = torch.where(shear & counted, t.log_j - j_cross.log(), 0.0)
    step = torch.where(tip, t.log_j - log_end, step)
    return _Answer(tip | shear, tip, factor, log_end, step)


# --- dynamic centre ---


def _dynamic(m: Nacc, t: Trial, alpha: Tensor, k: float, epsilon: float) -> _Answer:
    beta, kappa = m.cohesion.clamp(max=1e3), m.kappa
    x = (m.hardening * (-alpha).clamp(min=0.0)).clamp(max=5.0)
    p0 = kappa * (1e-5 + torch.sinh(x)).clamp(max=0.495)
    low, centre, half = -beta * p0, 0.5 * (1.0 - beta) * p0, 0.5 * (1.0 + beta) * p0
    height = m.friction * half / (1.0 + 2.0 * beta).sqrt()
    u = ((t.p - centre) / half).clamp(-1e4, 1e4)
    w = (t.q / torch.maximum(height, 1e-8 * kappa)).clamp(max=1e6)
    target = torch.sign(u) * (1.0 - epsilon) * u.abs().clamp(max=1.0) ** (k + 1.0)
    gap, free = u - target, 1.0 - target**2
    down = target * gap + (gap**2 + w**2 * free).sqrt()
    s = (free / down.clamp(min=1e-30)).clamp(max=1.0)
    cross = centre + half * (target + s * gap)
    inside = torch.minimum(torch.maximum(t.p, low), p0)
    relaxed = torch.minimum(torch.maximum(cross, inside.clamp(max=0)), inside.clamp(min=0))
    on = ((p0 - relaxed) * (relaxed - low)).clamp(min=0.0).sqrt() / half
    w_new = torch.where(relaxed == cross, s * w, on)
    slack = 2e-15 if t.p.dtype == torch.float64 else 1e-6
    plastic = u * u + w * w > 1.0 + slack
    factor = (height * w_new / torch.maximum(t.q, 1e-30 * kappa)).clamp(max=1.0)
    step = (t.log_j - 0.5 * torch.log1p(-2.0 * cross / kappa)).clamp(-0.2, 0.2)
    return _Answer(
        plastic, torch.zeros_like(plastic), torch.where(plastic, factor, 1.0),
        0.5 * torch.log1p(-2.0 * relaxed / kappa), torch.where(plastic, step, 0.0),
    )  # fmt: skip


def _root(change: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """Alpha with ``alpha = start + change(alpha)``, the one of docs/theory/return-mapping.md.

    Secant steps (of one to four times the last, 0.2 in all) walk to a bracket, Anderson and
    Bjoerck's secants close it: where there are several roots, this decides which one is meant.
    """

    def residual(a: Tensor) -> Tensor:
        return a - start - change(a)

    step = change(start)
    far = start + torch.where(step > 0, 0.2, -0.2).to(step.dtype)
    low, f_low, high = start, -step, start + step
    f_high = residual(high)
    small = 4.0 * torch.finfo(start.dtype).eps * (start.abs() + step.abs())
    moving = step.abs() > small
    for _ in range(40):
        walk = moving & (f_low * f_high > 0) & (f_high.abs() > small) & (high != far)
        if not bool(walk.any()):
            break
        rise = f_low - f_high
        ratio = f_high / torch.where(rise == 0, 1.0, rise)
        ratio = torch.where((rise == 0) | (ratio <= 0), 4.0, ratio.clamp(1.0, 4.0))
        ahead = high + (high - low) * ratio
        ahead = torch.where((ahead - start).abs() < 0.2, ahead, far)
        low, f_low = torch.where(walk, high, low), torch.where(walk, f_high, f_low)
        high = torch.where(walk, ahead, high)
        f_high = torch.where(walk, residual(high), f_high)
    past = f_high.abs()
    for turn in range(60):
        open_ = moving & (f_high.abs() > small) & ((high - low).abs() > small)
        if turn % 4 == 0 and not bool(open_.any()):
            break
        fall = f_high - f_low
        guess = high - f_high * (high - low) / torch.where(fall == 0, 1.0, fall)
        halve = (fall == 0) | ~((guess - low) * (guess - high) < 0)
        if turn % 8 == 7:
            halve |= f_high.abs() > 0.1 * past
            past = f_high.abs()
        guess = torch.where(halve, 0.5 * (low + high), guess)
        f = residual(guess)
        crossed = f * f_high < 0
        share = 1.0 - f / torch.where(f_high == 0, 1.0, f_high)
        kept = torch.where(share > 0, share, 0.5) * f_low
        low = torch.where(open_ & crossed, high, low)
        f_low = torch.where(open_, torch.where(crossed, f_high, kept), f_low)
        high, f_high = torch.where(open_, guess, high), torch.where(open_, f, f_high)
    return high


def _isochoric_shift(d: Tensor) -> Tensor:
    """Largest m with det(m I + d) = 1 less one, [N]; d traceless."""
    h = 0.5 * (d * d).sum((1, 2))
    rest = h - det(d)
    y = 2.0 * (h / 3.0).sqrt()
    for _ in range(12):
        slope = (3.0 * y + 6.0) * y + (3.0 - h)
        y = y - ((((y + 3.0) * y + (3.0 - h)) * y - rest) / torch.where(slope > 0, slope, 1.0))
    return y


def return_map(
    kind: str, m: Nacc, measured: Elastic, alpha: Tensor, *, absolute: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Return trial strains to the yield surface.

    Args:
        kind: One of :data:`MAPS`.
        m: Parameters.
        measured: The trial state.
        alpha: Log plastic volume ratio, [N].
        absolute: The fixed centre's tolerances of 1e-4 Pa and Pa^2 in place of scale-free ones.

    Returns:
        e = b - I [N, 3, 3] and alpha after it, and which points yielded [N].

    Raises:
        ValueError: No such map.
    """
    if kind not in MAPS:
        raise ValueError(f"return_map must be one of {', '.join(MAPS)}, got {kind!r}")
    t = trial(measured, m)
    centre, update = kind.split("_")

    def answer(at: Tensor, rows: Tensor | None = None) -> _Answer:
        own, state = (m, t) if rows is None else (m.of(rows), t.of(rows))
        if centre == "dynamic":
            epsilon = EPSILON if update == "implicit" else 0.0
            return _dynamic(own, state, at, 2.0, epsilon)
        return _fixed(own, state, at, absolute, centre == "released")

    if centre == "dynamic":
        alpha = alpha.clamp(-10.0, 0.5)
    first = answer(alpha)
    rows = first.plastic.nonzero()[:, 0]
    if rows.shape[0] == 0:
        return measured.e, alpha, first.plastic
    if update == "implicit":
        new = _root(lambda a: answer(a, rows).step, alpha[rows])
    else:
        new = alpha[rows] + first.step[rows]
    if centre == "dynamic":
        new = new.clamp(-10.0, 0.5)
    got = answer(new if update == "implicit" else alpha[rows], rows)
    one = torch.eye(3, dtype=alpha.dtype, device=alpha.device)
    if centre == "dynamic":
        d = got.factor[:, None, None] * t.d[rows]
        s = torch.expm1(2.0 / 3.0 * got.log_j)
        y = _isochoric_shift(d)
        e = (1.0 + s)[:, None, None] * d + (y + s * (1.0 + y))[:, None, None] * one
    else:
        e_in = t.e[rows]
        mean = trace(e_in) / 3.0
        down = got.factor[:, None, None] * deviator(e_in) + mean[:, None, None] * one
        e = torch.where(
            got.tip[:, None, None], torch.expm1(2.0 / 3.0 * got.log_j)[:, None, None] * one, down
        )
    return measured.e.index_copy(0, rows, e), alpha.index_copy(0, rows, new), first.plastic
