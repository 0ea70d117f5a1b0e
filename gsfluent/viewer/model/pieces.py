"""Numbers for fragments that stay with them, and which broken matter still clings to which."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np
import torch
from torch import Tensor

from gsfluent.pipeline.matter.debris import REACH, clinging
from gsfluent.results.frames import SavedFrame

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
        order in which they are met, the largest first. Loose points have no label of their own and
        get that of the piece they hang on.

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
            loose = labels < 0
            found = (_joined(slots, loose, frame), loose | (frame.damage >= 1.0))
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


def _joined(slots: Tensor, loose: Tensor, frame: SavedFrame) -> Tensor:
    """Give loose points the piece they hang on, through other loose points if need be, [P].

    Shortest paths over links between close points: debris that lies on a piece is reached, a spray
    in the air is not.
    """
    reach = REACH * max(float(frame.volumes.double().mean()) ** (1.0 / 3.0), 1e-9)
    place = frame.positions.double().cpu().numpy()
    piece = np.where(loose.cpu().numpy(), -1, slots.cpu().numpy())
    return torch.from_numpy(clinging(place, piece, reach)).to(slots.device)
