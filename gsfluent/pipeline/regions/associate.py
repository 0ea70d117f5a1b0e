"""One part in all views: instances of single photographs linked through the skin they share.

A class-agnostic segmenter (Segment Anything) numbers its masks anew in every photograph and may cut
a part in two or join two parts. Two voxels of the skin a little apart belong together when the
photographs that show both mostly put them into one mask; agglomeration by the mean of that between
two clusters (average linkage) finds the parts, and every mask then gets the number of the part that
it mostly covers.
"""

from __future__ import annotations

import dataclasses
import heapq

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.segmentation.masks import Segmentation
from gsfluent.pipeline.regions.vote import Skin, view_votes
from gsfluent.progress import Progress

_AGREE = 0.5  # share of the photographs that must put two clusters into one mask
_COVER = 0.6  # share of a mask that must lie on one part for it to vote
_SMALL = 0.002  # of the skin: smaller parts are crumbs between masks
_NEAR = 3.0  # least distance [voxels] at which voxels are compared
_FAR, _LEAST_FAR = 0.15, 6.0  # largest, as a share of the object and in voxels
_SEEN = 0.05  # votes of a view from which it shows a voxel
_DOUBT = 1.0  # photographs of doubt: a border seen once is joined after one seen often


def associate(
    skin: Skin, segmentation: Segmentation, progress: Progress | None = None
) -> Segmentation:
    """Link the instances of all views.

    Args:
        skin: The solid's skin.
        segmentation: Instances per view (``linked`` False).
        progress: Optional callback.

    Returns:
        The segmentation with parts named ``part 1`` (the largest), ``part 2``, ...; masks that
        cover no part well, and pixels without a mask, have no vote (-1).

    Raises:
        InputError: No photograph shows the solid.
    """
    if segmentation.linked:
        return segmentation
    shown, weight = _instances(skin, segmentation, progress)
    if not (shown > 0).any():
        raise InputError(
            f"{segmentation.source}: no mask lies on the object",
            "check that the masks belong to the photographs that the splat was made from",
        )
    part = _parts(skin, shown)
    views = []
    for row, view in enumerate(segmentation.views):
        table = _covered(shown[row], weight[row], part, int(view.labels.max(initial=0)))
        mapped = table[view.labels.clip(min=0)]
        views.append(dataclasses.replace(view, labels=mapped.astype(np.int32)))
    names = {number: f"part {number}" for number in range(1, int(part.max()) + 1)}
    return dataclasses.replace(segmentation, views=tuple(views), names=names, linked=True)


def _instances(
    skin: Skin, segmentation: Segmentation, progress: Progress | None
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Mask that each view puts each skin voxel into, [V, S] (0: not shown), and its votes."""
    shown = np.zeros((len(segmentation.views), len(skin)), np.int32)
    weight = np.zeros(shown.shape, np.float32)
    for row, (labels, votes) in enumerate(view_votes(skin, segmentation, progress)):
        if not len(labels):
            continue
        weight[row] = votes.max(axis=1)
        shown[row] = np.where(weight[row] > _SEEN, labels[votes.argmax(axis=1)], 0)
    return shown, weight


def _parts(skin: Skin, shown: NDArray[np.int32]) -> NDArray[np.int64]:
    """Part of each skin voxel from 1, the largest first; 0 where no mask shows it."""
    block = _blocks(skin)
    count = int(block.max()) + 1
    first, second = _pairs(skin, block)
    same, both = np.zeros(len(first)), np.zeros(len(first))
    for row in shown:
        a, b = row[first], row[second]
        seen = (a > 0) & (b > 0)
        both += seen
        same += seen & (a == b)
    one = np.minimum(block[first], block[second])
    other = np.maximum(block[first], block[second])
    keep = (both > 0) & (one != other)
    pair, place = np.unique(one[keep] * count + other[keep], return_inverse=True)
    cluster = _agglomerated(
        count,
        pair // count,
        pair % count,
        np.bincount(place, weights=same[keep], minlength=len(pair)).astype(np.float64),
        np.bincount(place, weights=both[keep], minlength=len(pair)).astype(np.float64),
    )[block]
    seen_at_all = (shown > 0).any(axis=0)
    sizes = np.bincount(cluster[seen_at_all], minlength=count)
    large = np.flatnonzero(sizes >= max(4.0, _SMALL * len(skin)))
    if not large.size:
        large = np.array([int(sizes.argmax())])
    order = large[np.argsort(-sizes[large], kind="stable")]  # ties: the first block's
    number = np.zeros(count, np.int64)
    number[order] = np.arange(1, len(order) + 1)
    return np.where(seen_at_all, number[cluster], 0)


def _blocks(skin: Skin) -> NDArray[np.int64]:
    """Cube of 2 x 2 x 2 voxels that each skin voxel lies in, numbered in order, [S]."""
    corner = skin.index // 2
    size = corner.max(axis=0) + 1
    flat = (corner[:, 0] * size[1] + corner[:, 1]) * size[2] + corner[:, 2]
    return np.unique(flat, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _pairs(skin: Skin, block: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Voxels some way apart on the same side of the surface, one of each block.

    Not next to each other: borders of masks wander by pixels from photograph to photograph, so that
    hardly any one of them runs between two given neighbours.
    """
    from scipy.spatial import cKDTree

    chosen = np.unique(block, return_index=True)[1]
    index, normals = skin.index[chosen], skin.normals[chosen]
    far = max(_LEAST_FAR, _FAR * float(np.ptp(skin.index, axis=0).max()))
    pair = cKDTree(index).query_pairs(far, output_type="ndarray")
    step = index[pair[:, 0]] - index[pair[:, 1]]
    keep = (step**2).sum(axis=1) >= _NEAR**2
    keep &= (normals[pair[:, 0]] * normals[pair[:, 1]]).sum(axis=1) > 0.0
    pair = chosen[pair[keep]]
    return pair[:, 0].astype(np.int64), pair[:, 1].astype(np.int64)


def _agglomerated(
    count: int,
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    same: NDArray[np.float64],
    both: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Join clusters with the highest mean agreement between them until it falls below half.

    Returns:
        For each of ``count`` blocks the lowest block of its cluster.
    """
    border: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]
    for a, b, s, n in zip(
        first.tolist(), second.tolist(), same.tolist(), both.tolist(), strict=True
    ):
        border[a][b] = border[b][a] = (s, n)
    heap = [
        (-s / (n + _DOUBT), a, b, s, n)
        for a, b, s, n in zip(
            first.tolist(), second.tolist(), same.tolist(), both.tolist(), strict=True
        )
        if s >= _AGREE * n
    ]
    heapq.heapify(heap)
    owner = list(range(count))
    while heap:
        _, a, b, s, n = heapq.heappop(heap)
        if border[a].get(b) != (s, n):
            continue  # one of them has grown since
        a, b = min(a, b), max(a, b)
        del border[a][b], border[b][a]
        owner[b] = a
        for c, (s2, n2) in border[b].items():
            s1, n1 = border[a].get(c, (0.0, 0.0))
            s, n = s1 + s2, n1 + n2
            del border[c][b]
            border[a][c] = border[c][a] = (s, n)
            if s >= _AGREE * n:
                heapq.heappush(heap, (-s / (n + _DOUBT), min(a, c), max(a, c), s, n))
        border[b] = {}
    root = np.array(owner)
    while (root != root[root]).any():
        root = root[root]
    return root


def _covered(
    shown: NDArray[np.int32], weight: NDArray[np.float32], part: NDArray[np.int64], top: int
) -> NDArray[np.int64]:
    """Part that each mask of one view lies on, [top + 1]; -1 where it lies on none in the main."""
    on = (shown > 0) & (part > 0)
    overlap = np.zeros((top + 1, int(part.max()) + 1))
    np.add.at(overlap, (shown[on], part[on]), weight[on])
    total = overlap.sum(axis=1)
    best = overlap.argmax(axis=1)
    good = overlap.max(axis=1) >= _COVER * np.maximum(total, 1e-12)
    table = np.where((total > 0) & good, best, -1)
    table[0] = -1
    return table
