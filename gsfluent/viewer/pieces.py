"""Numbers for fragments that stay with them, and which broken matter still clings to which."""

from __future__ import annotations

import threading
from collections import OrderedDict

import torch
from torch import Tensor

from gsfluent.pipeline.neighbours import nearest
from gsfluent.pipeline.run_frames import SavedFrame

_REACH = 6.0  # point spacings within which broken matter belongs to the piece beside it
_KEPT = 64  # frames whose assignment is remembered


class Pieces:
    """Fragments of a film. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._slots: dict[int, int] = {}
        self._frames: OrderedDict[int, tuple[Tensor, Tensor]] = OrderedDict()

    def of(self, frame: SavedFrame) -> tuple[Tensor, Tensor]:
        """Pieces of the points of a frame.

        Labels of fragments are rows of material points; here they become 0, 1, 2 and so on in the
        order in which they are met, the largest first. Broken points have no label of their own and
        get that of the nearest whole one, if it is near.

        Returns:
            Piece of each point, -1 for debris on its own, int64 [P]; and whether the point itself
            is broken, bool [P].
        """
        with self._lock:
            if frame.index in self._frames:
                self._frames.move_to_end(frame.index)
                return self._frames[frame.index]
            labels = frame.fragments.long()
            slots = self._numbered(labels)
            broken = labels < 0
            found = (_joined(slots, broken, frame), broken)
            self._frames[frame.index] = found
            if len(self._frames) > _KEPT:
                self._frames.popitem(last=False)
            return found

    def _numbered(self, labels: Tensor) -> Tensor:
        found, inverse, sizes = labels.unique(return_inverse=True, return_counts=True)
        for row in sizes.argsort(descending=True).tolist():
            label = int(found[row])
            if label >= 0 and label not in self._slots:
                self._slots[label] = len(self._slots)
        slots = [self._slots.get(label, -1) for label in found.tolist()]
        return torch.tensor(slots, device=labels.device)[inverse]


def _joined(slots: Tensor, broken: Tensor, frame: SavedFrame) -> Tensor:
    """Give broken points the piece of the nearest whole point within reach, [P]."""
    if not bool(broken.any()) or bool(broken.all()):
        return slots
    spacing = max(float(frame.volumes.double().mean()) ** (1.0 / 3.0), 1e-9)
    whole = frame.positions[~broken]
    queries = frame.positions[broken].double().cpu().numpy()
    distance, row = nearest(whole, queries, 1, _REACH * spacing)
    joined = slots[~broken][torch.from_numpy(row[:, 0]).to(slots.device)]
    near = torch.from_numpy(distance[:, 0] <= _REACH * spacing).to(slots.device)
    result = slots.clone()
    result[broken] = torch.where(near, joined, -1)
    return result
