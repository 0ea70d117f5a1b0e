"""Cut-outs: which pixels of a photograph show the cut face."""

from __future__ import annotations

import numpy as np

from gsfluent._lazy import cv2, ndimage
from gsfluent.colors import rgb_to_lab
from gsfluent.spatial.voxels import distance_transform

CUTOUTS = ("auto", "ground", "grabcut", "none")

_GROUND = 14.0
"""Lab distance up to which a pixel counts as ground."""
_PAINTED = 3.0
"""The same for a ground of one exact colour."""


def cut_out(image: np.ndarray, method: str = "auto") -> tuple[np.ndarray, bool, str]:
    """Object mask of a photograph without alpha channel, whether it is an outline, and a sentence.

    ``ground``: what is connected to the border and has its colour is taken away; the colour is that
    of the border if it is even, else that of the corners if at least three of them agree (tight
    crops). ``grabcut``: iterated graph cuts (Rother et al. 2004) from a box, kept only when the
    result is one compact piece that differs from its surroundings. ``auto`` tries them in this
    order and takes the whole picture as material when neither finds an object.
    """
    whole = np.ones(image.shape[:2], bool)
    if method == "none":
        return whole, False, "cut-out switched off: the whole photograph is taken as material"
    reason = ""
    if method in ("auto", "ground"):
        mask, reason = _by_ground(image)
        if mask is not None:
            return mask, True, reason
        # an even patch of material has no object in it; graph cuts would invent one
        if method == "ground" or "apart" in reason:
            return whole, False, f"{reason}: the whole photograph is taken as material"
    mask, found = _by_graph_cut(image)
    if mask is not None:
        return mask, True, found
    reason = f"{reason}; {found}" if reason else found
    return whole, False, f"{reason}: the whole photograph is taken as material"


def _by_ground(image: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Mask by the colour of border or corners, or None and why not."""
    lab = rgb_to_lab(image)
    border = np.concatenate([lab[:2].reshape(-1, 3), lab[-2:].reshape(-1, 3)])
    border = np.concatenate([border, lab[:, :2].reshape(-1, 3), lab[:, -2:].reshape(-1, 3)])
    ground, source = np.median(border, axis=0), "border"
    spread = np.linalg.norm(border - ground, axis=1)
    if (spread < 10.0).mean() < 0.8:
        corner = _corner_color(lab)
        if corner is None:
            return None, "border not even"
        ground, source = corner, "corner"
    # a painted ground is exact: then dark flesh on black is not eaten into
    exact = float((np.linalg.norm(border - ground, axis=1) < 0.5).mean()) > 0.5
    near = np.linalg.norm(lab - ground, axis=2) < (_PAINTED if exact else _GROUND)
    labels, _ = ndimage.label(near)
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    mask = largest_piece(~np.isin(labels, edge[edge > 0]))
    share = float(mask.mean())
    # an even patch of material also has an even border: then nothing compact is left standing
    if not 0.08 < share < (0.97 if source == "border" else 0.9):
        return None, f"no object apart from the {source} colour"
    return mask, f"mask from the {source} colour ({100 * share:.0f} % of the picture)"


def _corner_color(lab: np.ndarray) -> np.ndarray | None:
    """Colour on which at least three of four even corners agree."""
    edge = max(3, round(0.03 * min(lab.shape[:2])))
    patches = [lab[s, t].reshape(-1, 3) for s in _ends(edge) for t in _ends(edge)]
    middles = np.stack([np.median(p, axis=0) for p in patches])
    even = [np.linalg.norm(p - m, axis=1).mean() < 5 for p, m in zip(patches, middles, strict=True)]
    for middle in middles:
        alike = (np.linalg.norm(middles - middle, axis=1) < 8.0) & even
        if alike.sum() >= 3:
            return np.asarray(middles[alike].mean(0))
    return None


def _ends(edge: int) -> tuple[slice, slice]:
    return slice(None, edge), slice(-edge, None)


def _by_graph_cut(image: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Mask by GrabCut, or None and why not."""
    height, width = image.shape[:2]
    factor = min(1.0, 320.0 / max(height, width))
    size = (max(16, round(width * factor)), max(16, round(height * factor)))
    small = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) * 255).astype(np.uint8)
    state = np.full(small.shape[:2], cv2.GC_PR_FGD, np.uint8)
    edge = max(2, round(0.03 * min(size)))
    for rows in _ends(edge):
        state[rows] = cv2.GC_BGD
    for columns in _ends(edge):
        state[:, columns] = cv2.GC_BGD
    cv2.setRNGSeed(0)
    back, front = np.zeros((1, 65)), np.zeros((1, 65))
    try:
        cv2.grabCut(small, state, (0, 0, 1, 1), back, front, 5, cv2.GC_INIT_WITH_MASK)
    except cv2.error:
        return None, "graph cuts failed"
    mask = largest_piece((state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD))
    share = float(mask.mean())
    if not 0.08 < share < 0.9:
        return None, "graph cuts find no object"
    outline = np.concatenate(
        [mask[edge], mask[-edge - 1], mask[:, edge], mask[:, -edge - 1]]
    ).mean()
    hull = cv2.convexHull(np.argwhere(mask).astype(np.float32))
    solidity = float(mask.sum()) / max(cv2.contourArea(hull), 1.0)
    lab = rgb_to_lab(small.astype(np.float32) / 255.0)
    reach = max(3, round(0.04 * np.sqrt(mask.sum())))
    inner = mask & ~ndimage.binary_erosion(mask, iterations=reach)
    outer = ~mask & ndimage.binary_dilation(mask, iterations=reach)
    contrast = float(np.linalg.norm(np.median(lab[inner], 0) - np.median(lab[outer], 0)))
    if outline > 0.3 or solidity < 0.85 or contrast < 12.0:
        return None, (
            f"graph cuts find no plain object (at the picture's edge {100 * outline:.0f} %, "
            f"convex {100 * solidity:.0f} %, contrast {contrast:.0f})"
        )
    big = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return largest_piece(big > 0.5), f"mask by graph cuts ({100 * share:.0f} % of the picture)"


def strip_ground(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Take pure black or white that touches the edge of an alpha mask out of it.

    Cut-outs exported with a coarse alpha keep corners of their ground.
    """
    padded = np.pad(mask, 1)
    ring = mask & ~ndimage.binary_erosion(padded)[1:-1, 1:-1]
    for flat in (image.max(2) < 0.04, image.min(2) > 0.97):
        flat = flat & mask
        if (flat & ring).sum() < 0.1 * ring.sum():
            continue
        labels, _ = ndimage.label(flat)
        touching = np.unique(labels[ring & flat])
        mask = mask & ~np.isin(labels, touching[touching > 0])
    return largest_piece(mask)


def largest_piece(mask: np.ndarray) -> np.ndarray:
    """Largest component with its holes filled."""
    labels, count = ndimage.label(ndimage.binary_opening(mask, iterations=1))
    if count == 0:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return ndimage.binary_fill_holes(labels == sizes.argmax())


def trim_rim(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Take leftovers of the surroundings off the rim of a cut-out; a sentence when there were any.

    A leftover is a piece of the rim (a twelfth of the largest depth) as thick as a fortieth of it
    whose colour differs from the colour most of the rim has at that depth: ground that a tight crop
    kept, and skin seen from the side beyond the cut. Layers that go all round stay.
    """
    depth = distance_transform(np.pad(mask, 1))[1:-1, 1:-1]
    largest = float(depth.max())
    reach = 0.12 * largest
    band = mask & (depth <= reach)
    if reach < 4.0:
        return mask, None
    lab = rgb_to_lab(cv2.GaussianBlur(image, (0, 0), max(0.8, 0.01 * largest)))
    odd = np.zeros(mask.shape, bool)
    for low in np.linspace(0.0, reach, 5)[:-1]:
        ring = band & (depth > low) & (depth <= low + reach / 4)
        chroma = lab[ring][:, 1:]
        middle = np.median(chroma, axis=0)
        off = np.linalg.norm(chroma - middle, axis=1)
        # a rim of many colours (stripes, crust) has no colour of its own to differ from
        odd[ring] = off > max(14.0, 5.0 * float(np.median(off)))
    thick = max(1, round(0.0125 * largest))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * thick + 1,) * 2)
    odd = cv2.morphologyEx(odd.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    odd = cv2.dilate(odd.astype(np.uint8), kernel) > 0
    share = float((odd & mask).sum()) / float(mask.sum())
    if share < 0.002 or share > 0.1:
        return mask, None
    # the outline closes over the gap without keeping the steps the leftovers leave
    wide = max(3, round(0.06 * largest))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wide + 1,) * 2)
    kept = np.pad((mask & ~odd).astype(np.uint8), wide)
    smooth = cv2.morphologyEx(kept, cv2.MORPH_OPEN, kernel)[wide:-wide, wide:-wide]
    trimmed = largest_piece(smooth > 0)
    gone = 1.0 - float(trimmed.sum()) / float(mask.sum())
    if not 0.0 < gone < 0.15:
        return mask, None
    return trimmed, f"rim: {100 * gone:.1f} % of the cut-out unlike the rest of its rim taken off"
