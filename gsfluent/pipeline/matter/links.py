"""What hangs together: each material point and its nearest neighbours at rest, and who has parted.

Two neighbours of one piece hang together; those of different pieces do not. Where matter is broken
or loose, neighbours have parted once they are half as far again from each
other as at rest, and hang together again only below a smaller ratio, so that nothing toggles from
frame to frame. An *opening*, where faces show, is a pair that has parted and moved apart.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.matter.fragments import STRETCH_LIMIT
from gsfluent.pipeline.matter.points import Matter
from gsfluent.spatial.neighbours import nearest_rows

NEIGHBOURS = 12
"""Points that are watched around each point, itself among them."""
PARTED = 1.5
"""Neighbours that are broken or loose have parted at this many times their distance at rest."""
OPEN = 1.1
"""An opening begins at this many times the distance at rest."""
BACK = 0.93
"""What has parted or opened stays so down to this share of the ratio at which it did."""
FULL = 1.3
"""Ratio from which an opening is as visible as it gets."""


class Hanging(NamedTuple):
    """How points hang together with their neighbours (columns of :attr:`Links.near`).

    Attributes:
        parted: Pairs that do not hang together, bool [N, K].
        opened: Of these, the ones with a gap between, bool [N, K].
        ratio: Distance now over distance at rest, [N, K]; 1 for a point and itself.
    """

    parted: Tensor
    opened: Tensor
    ratio: Tensor

    def state(self) -> dict[str, Any]:
        """Numbers of the parted and opened pairs: what the next frame depends on."""
        return {
            name: getattr(self, name).flatten().nonzero()[:, 0].cpu()
            for name in ("parted", "opened")
        }


class Links:
    """Neighbours at rest.

    Args:
        matter: The material points.
    """

    def __init__(self, matter: Matter) -> None:
        rest = self.rest = matter.rest
        count, device = rest.shape[0], rest.device
        self.near = torch.arange(count, device=device)[:, None].repeat(1, NEIGHBOURS)
        self.spacing = torch.ones(count, dtype=rest.dtype, device=device)
        for (a, b), spacing in zip(matter.ranges, matter.spacing, strict=True):
            k = min(NEIGHBOURS, b - a)
            if k == 0:
                continue
            found = nearest_rows(rest[a:b], rest[a:b], k, 1.5 * spacing)[1]
            self.near[a:b, :k] = found + a
            self.spacing[a:b] = spacing
        self._measure(torch.zeros_like(self.near, dtype=torch.bool))

    def _measure(self, void: Tensor) -> None:
        self._apart = (self.rest[self.near] - self.rest[:, None]).norm(dim=2)
        self._void = void

    def rewired(self, near: Tensor, void: Tensor) -> Links:
        """The same points with other neighbours.

        Args:
            near: As :attr:`near`, int64 [N, K].
            void: Columns that count for nothing, as there are not so many neighbours, bool [N, K].
        """
        other = copy.copy(self)
        other.near = near
        other._measure(void)
        return other

    def look(
        self,
        position: Tensor,
        fragments: Tensor,
        before: Hanging | None = None,
        *,
        broken: Tensor | None = None,
    ) -> Hanging:
        """See what hangs together now.

        Args:
            position: Points now [m], [N', 3] with N' >= N; those that joined later come last.
            fragments: Piece of each, int32 [N'], -1 for none.
            before: The last look, if there was one.
            broken: Broken points, bool [N'].
        """
        states = ops.link_states(
            position, self._apart, self.near, fragments, none=self._void,
            together=STRETCH_LIMIT, loose=PARTED, open=OPEN, back=BACK, broken=broken,
            before=None if before is None else (before.parted, before.opened),
        )  # fmt: skip
        return Hanging(*states)

    def restored(self, state: dict[str, Any]) -> Hanging:
        """The last look of another run, from :meth:`Hanging.state`."""
        flags = []
        for name in ("parted", "opened"):
            flag = torch.zeros(self.near.numel(), dtype=torch.bool, device=self.near.device)
            flag[state[name].to(flag.device)] = True
            flags.append(flag.view_as(self.near))
        return Hanging(flags[0], flags[1], torch.ones_like(self._apart))
