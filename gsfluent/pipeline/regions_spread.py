"""From votes to a label per voxel: decided on the skin, spread over gaps, carried inwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .regions_vote import Skin

if TYPE_CHECKING:
    from gsfluent.data import Solid

__all__ = ["UNSEEN", "carry_inwards", "decide", "nearest_skin"]

UNSEEN = -1
_POOL = 0.25  # weight of a neighbour's votes: single voxels are noise, rows of them are not
_LEAST = 0.02  # of the mean votes of a voxel: below, it was not seen


def decide(
    skin: Skin, votes: NDArray[np.float32], *, margin: float = 0.1, reach: int = 3
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Choose each skin voxel's label.

    The label with the most votes wins where it leads by ``margin`` of all votes; where none does,
    the neighbours decide. What no photograph shows stays unseen, but for gaps of up to ``reach``
    voxels.

    Args:
        skin: The voxels.
        votes: Votes [S, L]; column 0 is "no part".
        margin: Lead of the winner as a share of the votes.
        reach: How far labels spread over what was not seen [voxels].

    Returns:
        Column per voxel, :data:`UNSEEN` where unseen, int64 [S], and the winner's share of the
        voxel's own votes, float32 [S] (0 where it got none).
    """
    pooled = votes + _POOL * (skin.neighbours @ votes)
    total = pooled.sum(axis=1)
    seen = total > _LEAST * float(total[total > 0].mean()) if total.any() else total > 0
    order = np.sort(pooled, axis=1)
    lead = order[:, -1] - (order[:, -2] if votes.shape[1] > 1 else 0.0)
    label = np.where(seen & (lead >= margin * total), pooled.argmax(axis=1), UNSEEN)
    for wanted, steps in ((seen, len(skin)), (np.ones(len(skin), bool), reach)):
        for _ in range(steps):
            label, changed = _grown(skin, label, wanted, votes.shape[1])
            if not changed:
                break
    own = votes.sum(axis=1)
    won = votes[np.arange(len(skin)), label.clip(min=0)]
    share = np.where((own > 0) & (label != UNSEEN), won / np.maximum(own, 1e-12), 0.0)
    return label, share.astype(np.float32)


def _grown(
    skin: Skin, label: NDArray[np.int64], wanted: NDArray[np.bool_], count: int
) -> tuple[NDArray[np.int64], bool]:
    """Let undecided voxels next to decided ones join the most frequent label around them."""
    known = label != UNSEEN
    open_ = np.flatnonzero(~known & wanted)
    if not open_.size:
        return label, False
    present = np.zeros((len(skin), count), np.float32)
    present[np.flatnonzero(known), label[known]] = 1.0
    around = skin.neighbours[open_] @ present
    found = around.sum(axis=1) > 0
    result = label.copy()
    result[open_[found]] = around[found].argmax(axis=1)
    return result, bool(found.any())


def nearest_skin(solid: Solid, skin: Skin) -> NDArray[np.int64]:
    """Row of the nearest skin for every voxel of matter, int64 [X, Y, Z], -1 outside.

    Nearest to the surface as found between voxels: far inside, where much skin is about equally
    near, distances to voxel centres would decide by rounding. The ball around a voxel that touches
    its nearest skin lies in the body, so the straight way there is the shortest way inside it, too:
    labels never jump over a gap.
    """
    from scipy.spatial import cKDTree

    occupied = solid.occupancy.cpu().numpy()
    row = np.full(occupied.shape, -1, dtype=np.int64)
    centers = solid.voxel_centers().cpu().numpy()
    row[occupied] = cKDTree(skin.surface).query(centers)[1]
    row[tuple(skin.index.T)] = np.arange(len(skin))
    return row


def carry_inwards(label: NDArray[np.int64], nearest: NDArray[np.int64]) -> NDArray[np.int32]:
    """Give every voxel of matter the label of the skin nearest to it.

    Args:
        label: Label per skin voxel [S], :data:`UNSEEN` where unseen.
        nearest: What :func:`nearest_skin` found [X, Y, Z].

    Returns:
        Label per voxel, int32 [X, Y, Z]; 0 outside and below unseen skin.
    """
    return np.where(nearest >= 0, label[nearest.clip(min=0)].clip(min=0), 0).astype(np.int32)
