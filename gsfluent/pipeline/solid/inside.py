"""Which voxels are inside: ray vote, surface trimming, leak report.

A bare flood fill from outside is never used to decide: one missing splat and the whole object is
"outside" (measured IoU 0.13-0.38, against 0.75-0.85 for votes; docs/theory/solid.md). It is used
only
to *report* leaks.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.spatial.voxels import distance_transform, grown

logger = logging.getLogger(__name__)

DIRECTIONS = np.array(
    [d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], dtype=int
)  # 26


@dataclass(frozen=True)
class Vote:
    """Result of :func:`cast_votes`."""

    score: np.ndarray  # fraction of the counted directions that hit the surface, float32 [X, Y, Z]
    # unit vector of the side that was left out because nothing was seen there, or None.
    open_side: tuple[float, float, float] | None
    open_fraction: float  # fraction of the inner voxels that look out through that side


def _blocked(hit: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """True where some ``hit[x + k * direction]``, k >= 1, is set: one sweep from the far end."""
    flips = tuple(i for i in range(3) if direction[i] < 0)
    lead = int(np.flatnonzero(direction)[0])
    order = [lead] + [i for i in range(3) if i != lead]
    source = np.flip(hit, flips).transpose(order)
    shift = np.abs(direction)[order]
    out = np.zeros(source.shape, dtype=bool)
    _, ny, nz = source.shape
    for i in range(source.shape[0] - 2, -1, -1):
        ahead = source[i + 1] | out[i + 1]
        out[i, : ny - shift[1], : nz - shift[2]] = ahead[shift[1] :, shift[2] :]
    return np.flip(out.transpose(np.argsort(order)), flips)


def blocked_by_doubling(hit: Tensor, direction: np.ndarray) -> Tensor:
    """As :func:`_blocked`, for a GPU: log2(n) shifts of the whole grid instead of a sweep.

    After k rounds the first 2^k voxels along the direction are known.
    """
    step = [int(value) for value in direction]
    seen, reach = _shifted(hit, step), 1
    while reach < max(hit.shape):
        seen = seen | _shifted(seen, [reach * value for value in step])
        reach *= 2
    return seen


def _shifted(field: Tensor, step: list[int]) -> Tensor:
    """``field[x + step]``, False beyond the grid."""
    out = torch.zeros_like(field)
    if any(abs(value) >= size for value, size in zip(step, field.shape, strict=True)):
        return out
    to, source = [], []
    for value, size in zip(step, field.shape, strict=True):
        to.append(slice(max(0, -value), size - max(0, value)))
        source.append(slice(max(0, value), size - max(0, -value)))
    out[tuple(to)] = field[tuple(source)]
    return out


def cast_votes(
    shell: np.ndarray,
    *,
    rays: int = 26,
    down: np.ndarray | None = None,
    close_open_side: bool = True,
    device: torch.device | None = None,
) -> Vote:
    """Let every voxel look for the surface along 6 or 26 lattice directions.

    Things photographed on a table have no underside. When most inner voxels look out through one
    side and hardly any through the others, that side is left out of the vote, which closes the hole
    flat at its rim.

    Args:
        shell: Surface voxels, bool [X, Y, Z].
        rays: 6 (axes) or 26 (axes and diagonals; narrower crevices stay open).
        down: Known downward direction [3]; None finds the open side by itself.
        close_open_side: False never leaves a side out.
        device: Where to look along the rays.

    Returns:
        The vote; a voxel is inside when its score is high.
    """
    axes = np.abs(DIRECTIONS).sum(1) == 1
    chosen = DIRECTIONS[axes] if rays == 6 else DIRECTIONS
    if device is None or device.type == "cpu":
        flags = np.stack([_blocked(shell, d) for d in chosen])
    else:
        hit = torch.from_numpy(shell).to(device)
        flags = torch.stack([blocked_by_doubling(hit, d) for d in chosen]).cpu().numpy()
    unit = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    count = flags.sum(0, dtype=np.uint8)
    plain = count.astype(np.float32) / len(chosen)
    if not close_open_side:
        return Vote(plain, None, 0.0)
    # inner voxels: most directions are blocked, up to one open half-space of directions
    inner = (plain >= 0.6) & ~shell
    total = int(inner.sum())
    if total == 0:
        return Vote(plain, None, 0.0)
    free = 1.0 - flags[:, inner].mean(1)
    if down is not None:
        side = np.asarray(down, dtype=float) / max(float(np.linalg.norm(down)), 1e-12)
        weight = np.clip(unit @ side, 0.0, None) ** 2
        fraction = float((free * weight).sum() / weight.sum())
        if fraction < 0.03:
            return Vote(plain, None, fraction)
    else:
        # the mean open direction; opposite openings (a ring) cancel and are left alone
        pull = (free**2) @ unit
        if float(np.linalg.norm(pull)) < 1e-3:
            return Vote(plain, None, 0.0)
        side = pull / np.linalg.norm(pull)
        fraction = float(free[unit @ side > 0.7].mean())
        if fraction < 0.05 or free[unit @ side < 0.0].mean() > 0.5 * fraction:
            return Vote(plain, None, fraction)
        if np.abs(side).max() > 0.94:  # within 20 degrees of a grid axis
            side = np.where(np.abs(side) > 0.94, np.sign(side), 0.0)
    counted = unit @ side < 0.5
    score = flags[counted].mean(0, dtype=np.float32)
    return Vote(score, (float(side[0]), float(side[1]), float(side[2])), fraction)


def trim_outer_flank(
    solid: np.ndarray,
    shell: np.ndarray,
    density: np.ndarray,
    device: torch.device | None = None,
) -> np.ndarray:
    """Remove the outer half of the shell: the boundary then runs through the splat centres.

    A shell voxel belongs to the outer flank when the density still rises towards the inside of the
    object. A sheet one or two voxels thick may be all flank: a voxel goes only when some voxel
    behind it, within four steps inward, stays. ``device`` says where distances are computed.
    """
    from scipy import ndimage

    blurred = ndimage.gaussian_filter(solid.astype(np.float32), 1.5)
    inward = np.stack(np.gradient(blurred))
    inward /= np.maximum(np.linalg.norm(inward, axis=0), 1e-9)
    slope = np.stack(np.gradient(ndimage.gaussian_filter(density, 0.5)))
    rising = (inward * slope).sum(0) > 1e-3 * density
    flank = solid & shell & rising
    kept = solid & ~flank
    index = np.argwhere(flank)
    direction = inward[(slice(None), *index.T)].T
    backed = np.zeros(len(index), bool)
    for step in range(1, 5):
        behind = np.rint(index + step * direction).astype(int)
        backed |= kept[tuple(np.clip(behind, 0, np.array(solid.shape) - 1).T)]
    loose = np.zeros(solid.shape, bool)
    loose[tuple(index[backed].T)] = True
    # only what can be peeled from outside: a second layer of splats below the skin is no boundary
    loose &= distance_transform(solid, device) <= 3.0
    peeled = ndimage.binary_propagation(~solid, mask=~solid | loose)
    result: np.ndarray = ndimage.binary_fill_holes(~peeled)
    return result


def smooth_boundary(solid: np.ndarray) -> np.ndarray:
    """Take off hairs and fill pits of a voxel or so; thin parts of some size stay as they are.

    Trained splats are rough at the voxel scale. The bulk (what survives an opening) is smoothed;
    sheets that the opening removes are put back unless they are crumbs.
    """
    from scipy import ndimage

    cross = ndimage.generate_binary_structure(3, 1)
    bulk = ndimage.binary_opening(solid, cross)
    # a flat sheet one voxel thick has 0.38 at its middle after this blur, a hair 0.16
    flat = ndimage.gaussian_filter(solid.astype(np.float32), 1.0) >= 0.33
    sheet = solid & ~bulk
    flat = ndimage.binary_dilation(flat & sheet, np.ones((3, 3, 3)), iterations=2, mask=sheet)
    thin, _ = ndimage.label(flat, np.ones((3, 3, 3)))
    sizes = np.bincount(thin.ravel())
    sizes[0] = 0
    kept = (sizes >= max(27, 0.002 * float(solid.sum())))[thin]
    smooth = ndimage.gaussian_filter(bulk.astype(np.float32), 1.0) >= 0.5
    result: np.ndarray = ndimage.binary_fill_holes(smooth | kept)
    return result


def keep_components(solid: np.ndarray, *, relative: float = 0.02) -> tuple[np.ndarray, int]:
    """Keep the largest 26-connected component and those of ``relative`` its size.

    Scraps of trained splats fill 0.3 % at most; the hands of a toy robot, which hang free, 6 %.
    What has no matter is carried by the rest, and hovers beside it.
    """
    from scipy import ndimage

    labels, count = ndimage.label(solid, structure=np.ones((3, 3, 3)))
    if count <= 1:
        return solid, 0
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    wanted = sizes >= relative * sizes.max()
    return wanted[labels], int(count - wanted.sum())


def find_leaks(
    shell: np.ndarray, inside: np.ndarray, origin: np.ndarray, voxel: float, most: int = 16
) -> dict[str, Any]:
    """Openings through which a flood from outside would enter the object, and where they are.

    Args:
        shell: Surface voxels that hold water back, bool [X, Y, Z].
        inside: Voxels decided to be inside.
        origin: Corner of voxel (0, 0, 0) [3], world units.
        voxel: Edge of a voxel, world units.
        most: Openings listed, the largest first.

    Returns:
        ``leaks`` (separate openings), ``leaking_voxels`` (inner voxels that the flood would
        reach) and ``leak_list``: ``center`` [world units] and ``area`` [square world units] of
        each.
    """
    from scipy import ndimage

    cross = ndimage.generate_binary_structure(3, 1)
    open_space = np.pad(~shell, 1, constant_values=True)
    labels, _ = ndimage.label(open_space, structure=cross)
    flooded = (labels == labels[0, 0, 0])[1:-1, 1:-1, 1:-1]
    wet = flooded & inside & ~shell
    if not wet.any():
        return {"leaks": 0, "leaking_voxels": 0, "leak_list": []}
    # an opening: wet inner voxels that touch open space outside the object
    mouth = wet & ndimage.binary_dilation(~inside & ~shell, cross)
    # patches of one mouth a voxel or two apart are one opening
    merged = grown(mouth, 1)
    label, openings = ndimage.label(merged, structure=np.ones((3, 3, 3)))
    index = np.argwhere(mouth)
    owner = label[tuple(index.T)]
    sizes = np.bincount(owner, minlength=openings + 1)
    largest = [int(i) for i in np.argsort(-sizes) if sizes[i] > 0][:most]
    listed = [
        {
            "center": (origin + (index[owner == i].mean(0) + 0.5) * voxel).tolist(),
            "area": float(sizes[i] * voxel**2),
        }
        for i in largest
    ]
    return {"leaks": int(openings), "leaking_voxels": int(wet.sum()), "leak_list": listed}
