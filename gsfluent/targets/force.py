"""The force of a press over its way."""

from __future__ import annotations

from collections.abc import Sequence as Listing
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.targets.target import Motion, Setting, joined, positive


class Force:
    """Force over displacement of a collider that moves steadily.

    Args:
        displacement: Way of the collider [m], ascending from 0, [T].
        force: Of the matter on it against its motion [N], [T]; each is compared with the mean
            between its place and the one before.
        collider: Name of the collider; the first that moves when absent.
        sigma: Standard deviation [N]; a hundredth of the largest force when absent.
        speed: Of the collider [m/s].

    Raises:
        InputError: Lists of different lengths, a way that does not ascend, or a force that is not
            finite.
    """

    step = 1e-4

    def __init__(
        self,
        displacement: Listing[float],
        force: Listing[float],
        *,
        speed: float,
        collider: str | None = None,
        sigma: float | None = None,
    ) -> None:
        where = "targets.Force"
        way, push = np.asarray(displacement, np.float64), np.asarray(force, np.float64)
        if way.shape != push.shape or way.ndim != 1 or len(way) < 3:
            raise InputError(
                f"{where}: {way.shape} places and {push.shape} forces", "give a list of each, T > 2"
            )
        if not np.isfinite([way, push]).all() or (np.diff(way) <= 0).any():
            raise InputError(f"{where}: places must ascend and all be finite", "mend the table")
        self.force, self.collider = torch.from_numpy(push), collider
        self.times = [float(v) for v in (way - way[0]) / positive(where, "speed", speed)]
        largest = float(np.abs(push).max()) or 1.0
        self.sigma = positive(where, "sigma", 0.01 * largest if sigma is None else sigma)

    def observe(self, setting: Setting) -> _Pressed:
        """See :class:`gsfluent.targets.target.Target`."""
        return _Pressed(self, setting)


class _Pressed:
    def __init__(self, target: Force, setting: Setting) -> None:
        self.target = target
        moving = setting.velocity.norm(dim=1) > 0.0
        names = [n for n, moves in zip(setting.colliders, moving.tolist(), strict=True) if moves]
        wanted = target.collider or next(iter(names), None)
        if wanted not in names:
            raise InputError(
                f"targets.Force: no moving collider {wanted or ''}", f"moving: {', '.join(names)}"
            )
        self.row = setting.colliders.index(wanted)
        velocity = setting.velocity[self.row].double()
        self.way = velocity / velocity.norm()

    def pair(self, motion: Motion) -> None:
        """Nothing."""

    def residuals(self, motion: Motion, frames: int, pairs: Any) -> tuple[Tensor, Tensor]:
        """See :class:`gsfluent.targets.target.Observer`."""
        given = motion.impulse[:frames, self.row].double() @ self.way
        span = torch.tensor(self.target.times[:frames], dtype=torch.float64).diff()
        gap = (given.diff() / span - self.target.force[1:frames]) / self.target.sigma
        if not len(gap):
            return torch.zeros(0), torch.zeros(0).long()
        return joined(list(gap[:, None]), list(range(1, frames)))
