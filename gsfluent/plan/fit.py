"""Costs per unit of work from measured samples: non-negative least squares of relative errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["Sample", "fit"]


class Sample(NamedTuple):
    """One measurement."""

    stage: str  # Stage it belongs to
    features: Mapping[str, float]  # Amounts of work
    seconds: float  # What it took [s]


def fit(
    samples: Sequence[Sample], features: Sequence[str], known: Mapping[str, float] | None = None
) -> tuple[dict[str, float], float]:
    """Fit ``seconds = sum of cost * feature`` with costs of zero or more.

    Every sample counts by its relative error, so that a short measurement says as much as a long
    one. Fewer samples than features are fine: what they do not tell apart gets the smallest costs
    (a tiny ridge in units of what each feature adds to the samples).

    Args:
        samples: Measurements.
        features: Features whose costs are sought.
        known: Costs that are known already; their share is taken off first.

    Returns:
        Cost of each feature [s per unit], and the largest relative error at the samples.

    Raises:
        ValueError: No samples, or one that took no time.
    """
    from scipy.optimize import nnls

    given = dict(known or {})
    if not samples or any(not sample.seconds > 0.0 for sample in samples):
        raise ValueError(f"fit: samples must take time, got {[s.seconds for s in samples]}")
    took = np.array([sample.seconds for sample in samples])
    base = np.array([sum(c * s.features.get(n, 0.0) for n, c in given.items()) for s in samples])
    table = np.array([[s.features.get(name, 0.0) for name in features] for s in samples])
    rows = table / took[:, None]
    scale = rows.max(axis=0)
    scale[scale == 0.0] = 1.0
    wanted = np.clip(took - base, 0.0, None) / took
    ridge = 1e-3 * np.eye(len(features))
    costs, _ = nnls(np.vstack([rows / scale, ridge]), np.append(wanted, np.zeros(len(features))))
    costs = costs / scale
    errors = np.abs(table @ costs + base - took) / took
    return dict(zip(features, costs.tolist(), strict=True)), float(errors.max())
