"""What a frame shows beside its colours, by the same rasterizer: depth, flow, labels."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.draw import draw
from gsfluent.export.frames import NOBODY, Moment
from gsfluent.results.frames import SavedFrame

NOTHING, LOOSE, RIGID = 0, 1, 2
"""Labels of a pixel without matter, of chips, dust and drops, of rigid things; then pieces."""

_CHANNELS = 32  # of one call of the rasterizer
_COVERED = 0.5
_NEAR = 0.01  # as films are drawn [m]


@dataclasses.dataclass(frozen=True, eq=False)
class Channels:
    """One frame; where nothing covers at least half of a pixel all three are 0."""

    depth: np.ndarray  # Expected camera z [m], float16 [H, W]
    flow: np.ndarray  # To where the matter is in the next frame [px], float16 [H, W, 2]
    labels: np.ndarray  # Which piece, int32 [H, W]


class Pieces:
    """Labels of the pieces of a clip: the same number in every frame in which one is whole."""

    def __init__(self) -> None:
        self.label: dict[int, int] = {}  # By the number of the fragment
        self.body: dict[int, int] = {}  # Body in the scene, by label

    def of(self, moment: Moment) -> Tensor:
        """The label of every splat of a frame, int64 [N]."""
        fragment, anchor = moment.fragment.long(), moment.saved.anchor.long()
        labels = torch.where(anchor < 0, RIGID, LOOSE)
        for number in torch.unique(fragment[fragment != NOBODY]).tolist():
            label = self.label.setdefault(number, RIGID + 1 + len(self.label))
            mine = fragment == number
            labels[mine] = label
            if label not in self.body:
                first = anchor[mine & (anchor >= 0)][0]
                self.body[label] = int(moment.saved.body[first])
        return labels


def channels_of(
    moment: Moment, camera: Camera, after: tuple[SavedFrame, Camera] | None, pieces: Pieces
) -> Channels:
    """Draw depth, flow and labels of a frame.

    Args:
        moment: The frame.
        camera: That of its picture.
        after: The next frame and its camera; None for the last, whose flow is 0.
        pieces: Labels of the clip, which learns those that are new.
    """
    splats, groups = moment.gaussians, moment.saved.groups
    options = {"groups": groups, "near": _NEAR}
    moved = splats.means.new_zeros(splats.count, 2)
    if after is not None:
        moved = _moved(moment.saved, camera, *after)
    seen = draw(splats, camera, colors=moved, depth=True, **options)
    assert seen.depth is not None  # asked for
    covered = seen.alpha >= _COVERED
    flow = torch.where(covered[..., None], seen.image / seen.alpha.clamp(min=1e-6)[..., None], 0.0)
    labels, share = torch.zeros_like(covered, dtype=torch.int64), torch.zeros_like(seen.alpha)
    of_splat = pieces.of(moment)
    found = torch.unique(of_splat)
    for some in found.split(_CHANNELS):
        one = (of_splat[:, None] == some).to(splats.means)
        weight, which = draw(splats, camera, colors=one, **options).image.max(dim=-1)
        labels = torch.where(weight > share, some[which], labels)
        share = torch.maximum(share, weight)
    labels = torch.where(covered, labels, NOTHING)
    depth = torch.where(covered, seen.depth, 0.0)
    return Channels(
        depth.cpu().numpy().astype(np.float16),
        flow.cpu().numpy().astype(np.float16),
        labels.cpu().numpy().astype(np.int32),
    )


def _moved(now: SavedFrame, camera: Camera, then: SavedFrame, next_camera: Camera) -> Tensor:
    """How far every splat moves in the picture until the next frame [px], [N, 2].

    A splat that the next frame has not, since its crack has closed or opened, goes with its point.
    """
    means = now.gaussians.means.double()
    order = torch.argsort(then.ids)
    at = torch.searchsorted(then.ids[order], now.ids).clamp(max=len(order) - 1)
    row = order[at]
    there = then.gaussians.means.double()[row]
    anchor = now.anchor.long()
    follows = means
    if now.velocity.numel():
        step = now.velocity.double()[anchor.clamp(min=0)] * (then.time - now.time)
        follows = torch.where((anchor >= 0)[:, None], means + step, means)
    there = torch.where((then.ids[row] == now.ids)[:, None], there, follows)
    device = means.device
    (here_px, here_z) = camera.to(device).project(means)
    (there_px, there_z) = next_camera.to(device).project(there)
    seen = (here_z > _NEAR) & (there_z > _NEAR)
    return torch.where(seen[:, None], there_px - here_px, 0.0).to(now.gaussians.means)
