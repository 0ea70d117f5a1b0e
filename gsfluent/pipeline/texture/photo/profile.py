"""Colour as a function of depth, multi-band noise, and depth-conditional colour transport."""

from __future__ import annotations

import numpy as np

from gsfluent.pipeline.texture.photo.exemplar import Exemplar
from gsfluent.pipeline.texture.volume.domain import InteriorDomain


def depth_profile(exemplar: Exemplar) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour per depth of a photograph.

    Returns:
        Bin depths [B] in pixels of the photograph, and colours [B, 3].
    """
    bins, depth = 48, exemplar.depth[exemplar.mask]
    color = exemplar.image[exemplar.mask]
    # square-root spacing: thin layers (rind) lie close to the outline
    edges = exemplar.max_depth * np.linspace(0.0, 1.0, bins + 1) ** 1.5
    which = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, bins - 1)
    count = np.bincount(which, minlength=bins)
    good = count > 0
    mean = np.stack([np.bincount(which, color[:, c], bins) for c in range(3)], 1)
    position = np.bincount(which, depth, bins)
    return position[good] / count[good], mean[good] / count[good][:, None]


def profile_volume(depth: np.ndarray, position: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Colour [..., 3] at depths [...] of a profile (positions [B], colours [B, 3])."""
    channels = [np.interp(depth, position, color[:, c]) for c in range(3)]
    return np.stack(channels, -1).astype(np.float32)


def match_colors(
    values: np.ndarray,
    depth: np.ndarray,
    reference: np.ndarray,
    reference_depth: np.ndarray,
    *,
    bins: int,
    rng: np.random.Generator,
    rounds: int = 3,
) -> np.ndarray:
    """Move colours [n, 3] to the reference's distribution [m, 3], in overlapping depth ranges.

    Sliced optimal transport (Pitie et al. 2005; Rabin et al. 2011): in each of ``rounds`` the
    colours are projected on three orthogonal directions and their quantiles are matched. Both
    depths are in one unit; ``bins`` of 1 ignore them.
    """
    knots = _depth_knots(reference_depth, bins)
    result = np.zeros_like(values, dtype=np.float64)
    total = np.zeros(len(values))
    for k in range(len(knots)):
        weight = _hat(depth, knots, k)
        chosen = np.flatnonzero(weight > 0)
        source = reference[_hat(reference_depth, knots, k) > 0.25]
        if len(chosen) == 0 or len(source) < 12:
            continue
        moved = _sliced_match(values[chosen].astype(np.float64), source, rng, rounds)
        result[chosen] += weight[chosen, None] * moved
        total[chosen] += weight[chosen]
    untouched = total <= 0
    result[untouched] = values[untouched]
    total[untouched] = 1.0
    return (result / total[:, None]).clip(0.0, 1.0).astype(np.float32)


def _depth_knots(depth: np.ndarray, bins: int) -> np.ndarray:
    if bins <= 1:
        return np.array([0.0])
    # half uniform in depth, half uniform in area: thin layers and broad cores both get knots
    uniform = np.linspace(depth.min(), depth.max(), bins)
    area = np.quantile(depth, np.linspace(0, 1, bins))
    return np.unique(0.5 * (uniform + area))


def _hat(depth: np.ndarray, knots: np.ndarray, k: int) -> np.ndarray:
    """Piecewise linear weight of knot k; constant beyond the first and the last knot."""
    if len(knots) == 1:
        return np.ones(len(depth))
    values = np.zeros(len(knots))
    values[k] = 1.0
    return np.interp(depth, knots, values)


def _sliced_match(
    values: np.ndarray, source: np.ndarray, rng: np.random.Generator, rounds: int
) -> np.ndarray:
    steps = np.linspace(0.0, 1.0, 65)
    subset = values
    for _ in range(rounds):
        basis = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        projected = values @ basis
        target = source @ basis
        if len(values) > 20000:
            subset = projected[rng.integers(0, len(values), 20000)]
        else:
            subset = projected
        for c in range(3):
            have = np.quantile(subset[:, c], steps)
            want = np.quantile(target[:, c], steps)
            # equal quantiles (flat colour) would make the inverse ambiguous
            have = have + 1e-9 * np.arange(len(have))
            projected[:, c] = np.interp(projected[:, c], have, want)
        values = projected @ basis.T
    return values


def surface_profile(domain: InteriorDomain) -> np.ndarray:
    """Interior colour from nothing but the surface: nearest surface colour fading to its mean.

    The fade has the length of a third of the largest depth. It is what can honestly be said about
    an inside that nobody has shown: about the colour of the outside, without its pattern.
    """
    mean = np.median(domain.skin[domain.shell], axis=0)
    fade = 1.0 - np.exp(-3.0 * domain.depth / max(domain.max_depth, 1e-6))
    return (domain.skin + fade[..., None] * (mean - domain.skin)).astype(np.float32)
