"""The same splats in the same order in every frame, for players that upload them once.

A transition splat that is not born yet, or has died, is there with opacity zero, where and how it
first or last was.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Gaussians
from gsfluent.io.axes import nearest_axes
from gsfluent.pipeline.export_frames import NOBODY, Moment, Reel
from gsfluent.pipeline.stage import Progress, report_progress


class Constant:
    """The frames of a reel with a constant number and order of splats.

    Iterating gives :class:`Moment`; rows are sorted by id. Axes keep their names and quaternions
    their sign from frame to frame, so that a player may interpolate.

    Args:
        reel: The chosen frames; read twice.
        progress: Called per frame of the first reading.
    """

    def __init__(self, reel: Reel, progress: Progress | None = None) -> None:
        self.reel = reel
        ids = torch.zeros(0, dtype=torch.int64)
        first: list[Gaussians] = []
        for place, moment in enumerate(reel):
            new = ~torch.isin(moment.saved.ids.cpu(), ids)
            if bool(new.any()):
                ids = torch.cat([ids, moment.saved.ids.cpu()[new]])
                first.append(_plain(moment.gaussians.to("cpu").select(new)))
            report_progress(progress, place + 1, len(reel), "which splats there are")
        order = torch.argsort(ids)
        self.ids = ids[order]
        self.born = Gaussians.cat(first).select(order)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.reel)

    def __iter__(self) -> Iterator[Moment]:
        """The frames."""
        now = self.born
        count = now.count
        for moment in self.reel:
            saved = moment.saved
            rows = torch.searchsorted(self.ids, saved.ids.cpu())
            here = _least_turned(_plain(moment.gaussians.to("cpu")), now.quats[rows])
            fields = {
                name: getattr(now, name).index_copy(0, rows, getattr(here, name))
                for name in ("means", "quats", "scales", "sh")
            }
            opacities = torch.zeros(count).index_copy(0, rows, here.opacities)
            now = Gaussians(opacities=opacities, **fields)
            yield Moment(
                replace(
                    saved,
                    gaussians=now,
                    ids=self.ids,
                    groups=_spread(saved.groups, rows, count),
                    anchor=_spread(saved.anchor, rows, count),
                ),
                _spread(moment.fragment, rows, count),
                _spread(moment.material, rows, count),
            )


def _plain(gaussians: Gaussians) -> Gaussians:
    """Without labels and normals, which need not be there in every frame."""
    return gaussians.replace(labels=None, normals=None)


def _least_turned(gaussians: Gaussians, wanted: Tensor) -> Gaussians:
    """The same splats with their axes named as they were in the frame before."""
    quats, scales = nearest_axes(
        geometry.normalize_quaternions(gaussians.quats).double().numpy(),
        gaussians.scales.numpy(),
        geometry.normalize_quaternions(wanted).double().numpy(),
    )
    return gaussians.replace(quats=torch.from_numpy(quats).float(), scales=torch.from_numpy(scales))


def _spread(values: Tensor, rows: Tensor, count: int) -> Tensor:
    whole = torch.full((count,), NOBODY, dtype=values.dtype)
    whole[rows] = values.cpu()
    return whole
