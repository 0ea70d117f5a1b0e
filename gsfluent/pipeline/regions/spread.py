"""From votes to a label per voxel: decided on the skin, spread over gaps, carried inwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsfluent.data import Solid
from gsfluent.pipeline.regions.vote import Skin

UNSEEN = -1
_POOL = 0.25  # weight of a neighbour's votes: single voxels are noise, rows of them are not
_NEAREST = 8  # skin voxels that label a voxel inside
_SOFT = 0.3  # voxels farther than the nearest at which one counts 1/e
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


def label_field(
    skin: Skin, votes: NDArray[np.float32], label: NDArray[np.int64]
) -> NDArray[np.float32]:
    """How much of each skin voxel every label has: the votes where they agree with the decision.

    The inside is labelled from this: a border runs between the centres of two voxels, and votes say
    where. What the neighbours decided, and what nobody saw, is one label (or unseen) alone.

    Returns:
        Shares [S, L + 1], the last column for unseen.
    """
    pooled = votes + _POOL * (skin.neighbours @ votes)
    total = pooled.sum(axis=1)
    field = np.zeros((len(skin), votes.shape[1] + 1), np.float32)
    agree = (total > 0) & (pooled.argmax(axis=1) == label)
    field[agree, :-1] = pooled[agree] / total[agree, None]
    field[~agree, label[~agree]] = 1.0  # UNSEEN is the last column
    return field


def nearest_skin(solid: Solid, skin: Skin) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The skin nearest to every voxel of matter.

    Nearest to the surface as found between voxels: far inside, where much skin is about equally
    near, distances to voxel centres would decide by rounding. The ball around a voxel that touches
    its nearest skin lies in the body, so the straight way there is the shortest way inside it, too:
    labels never jump over a gap.

    Returns:
        Rows of the skin [M, k] for the occupied voxels in row-major order, and weights [M, k] that
        fall with what each is farther than the nearest.
    """
    from scipy.spatial import cKDTree

    count = min(_NEAREST, len(skin))
    distance, row = cKDTree(skin.surface).query(solid.voxel_centers().cpu().numpy(), k=count)
    distance, row = distance.reshape(-1, count), row.reshape(-1, count)
    weight = np.exp((distance[:, :1] - distance) / (_SOFT * solid.voxel))
    return row.astype(np.int64), weight.astype(np.float32)


def carry_inwards(
    solid: Solid,
    field: NDArray[np.float32],
    nearest: tuple[NDArray[np.int64], NDArray[np.float32]],
) -> NDArray[np.int64]:
    """Give every voxel of matter the label that has most of the skin nearest to it.

    Args:
        solid: The solid.
        field: What :func:`label_field` made, [S, L + 1].
        nearest: What :func:`nearest_skin` found.

    Returns:
        Column of the votes per voxel, int64 [X, Y, Z]; 0 outside and below unseen skin.
    """
    row, weight = nearest
    total = np.zeros((len(row), field.shape[1]), np.float32)
    for k in range(row.shape[1]):
        total += weight[:, k, None] * field[row[:, k]]
    best = total.argmax(axis=1)
    occupied = solid.occupancy.cpu().numpy()
    result = np.zeros(occupied.shape, np.int64)
    result[occupied] = np.where(best == field.shape[1] - 1, 0, best)
    return result
