"""Structure of a cut face: what a photograph shows in one place only, and how a solid gets it.

Patch synthesis makes material, not a particular star in a particular place. For a photograph cut
across (or along) the object's axis the two are taken apart: what is unlike the rest at its depth
is structure (carpels, seeds, segments, pith) and is swept about the axis as it is; the rest is
material and goes to the synthesis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsfluent._lazy import cv2, ndimage
from gsfluent.colors import lab_to_rgb, rgb_to_lab
from gsfluent.errors import InputError
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, Exemplars, each
from gsfluent.pipeline.texture.sweep import Sweep, outline
from gsfluent.pipeline.texture.volume.domain import (
    InteriorDomain,
    InteriorTexture,
    nearest_in,
    smoothstep,
)

_BINS = 32
_NEAR = 16.0  # Lab distance within which the next depth of an inner half is the same material


@dataclass(frozen=True)
class Structure:
    """What is particular about a photograph.

    Attributes:
        photo: The photograph.
        share: How much of a pixel is structure, float32 [H, W] in 0..1.
        core: True when the outer half of the depth has none: a core, which ends before the poles.
    """

    photo: Exemplar
    share: np.ndarray
    core: bool

    @property
    def amount(self) -> float:
        """Share of the face."""
        return float(self.share[self.photo.mask].mean())


def split_structure(photo: Exemplar) -> tuple[Exemplar, Structure]:
    """Take material and structure of a cut face with an outline apart.

    Structure is what differs from the median colour at its depth, at a scale coarser than grain (a
    fiftieth of the largest depth), by more than three times what is usual in this photograph and by
    more than five units of Lab; single grains do not count. Its place is painted over with the
    median colour of its depth and with the grain mirrored from beside it.
    """
    mask, largest = photo.mask, max(photo.max_depth, 1e-6)
    width = max(0.7, 0.02 * largest)
    lab = rgb_to_lab(photo.image)
    smooth = np.stack([ndimage.gaussian_filter(lab[..., c], width) for c in range(3)], -1)
    which = np.clip((photo.depth / largest * _BINS).astype(int), 0, _BINS - 1)
    plain = mask.copy()
    off = np.zeros(mask.shape)
    for _ in range(2):  # the second time without what the first found
        middle = _medians(smooth, which, plain, mask)
        # an edge between layers is not exactly at one depth: what lies between neighbours counts
        off = np.minimum(
            _from_segment(smooth, middle[np.maximum(which - 1, 0)], middle[which]),
            _from_segment(smooth, middle[which], middle[np.minimum(which + 1, _BINS - 1)]),
        )
        usual = float(np.median(off[plain])) if plain.any() else 0.0
        least = max(5.0, 3.0 * usual)
        plain = mask & (off < least)
    share = np.where(mask, smoothstep((off - least) / least), 0.0)
    # the skin is where photographs end; its colour comes from the object
    share *= smoothstep((photo.depth / largest - 0.03) / 0.03)
    labels, count = ndimage.label(share > 0.05, np.ones((3, 3)))
    if count:
        pixels = ndimage.sum_labels(share, labels, np.arange(count + 1))
        share = np.where(pixels[labels] > 4e-4 * mask.sum(), share, 0.0)
    outer = mask & (photo.depth < 0.5 * largest) & (photo.depth > 0.1 * largest)
    core = bool(outer.any() and share[outer].mean() < 0.04)
    structure = Structure(photo, share.astype(np.float32), core)
    return _painted(photo, share > 0.05, middle[which], width), structure


def _from_segment(color: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Distance of colours [..., 3] from the straight line between two others."""
    way = stop - start
    length = np.maximum((way**2).sum(-1), 1e-9)
    share = (((color - start) * way).sum(-1) / length).clip(0.0, 1.0)
    return np.asarray(np.linalg.norm(color - start - share[..., None] * way, axis=-1))


def _medians(
    smooth: np.ndarray, which: np.ndarray, plain: np.ndarray, mask: np.ndarray
) -> np.ndarray:
    """Median colour per depth range [_BINS, 3].

    In the inner half, where ranges get small and a cavity can be most of one, only pixels like the
    range outside it count; a range with hardly any takes its neighbour's colour.
    """
    rows = np.zeros((_BINS, 3))
    last = half = np.median(smooth[mask], axis=0)
    for k in range(_BINS):
        ring = smooth[plain & (which == k)]
        if k >= _BINS // 2 and len(ring):
            half = last if k == _BINS // 2 else half
            near = np.linalg.norm(ring - last, axis=1) < _NEAR
            near &= np.linalg.norm(ring - half, axis=1) < 1.5 * _NEAR
            ring = ring[near] if near.mean() > 0.15 else ring[:0]
        if len(ring) >= 8:
            last = np.median(ring, axis=0)
        rows[k] = last
    return rows


def _painted(photo: Exemplar, hole: np.ndarray, middle: np.ndarray, width: float) -> Exemplar:
    """The photograph with ``hole`` painted in given Lab colours and the grain from beside it."""
    if not hole.any():
        return photo
    reach = max(1, round(width))
    hole = ndimage.binary_dilation(hole, iterations=reach)
    good = photo.mask & ~hole
    if not good.any():
        return photo
    nearest = np.stack(nearest_in(good))
    here = np.indices(hole.shape)
    # two pixels of distance from the edge of the hole, where its blur begins
    mirror = np.clip(2 * nearest - here, 0, np.array(hole.shape)[:, None, None] - 1)
    source = np.where(good[tuple(mirror)], mirror, nearest)
    blurred = [ndimage.gaussian_filter(photo.image[..., c], width) for c in range(3)]
    grain = photo.image - np.stack(blurred, -1)
    soft = ndimage.gaussian_filter(hole.astype(np.float32), 0.5 * width)[..., None]
    soft = np.where(hole[..., None], np.maximum(soft, 0.5), soft)
    filled = lab_to_rgb(middle.astype(np.float32)) + grain[tuple(source)]
    image = photo.image + np.minimum(2 * soft, 1.0) * (filled - photo.image)
    return replace(photo, image=image.clip(0.0, 1.0).astype(np.float32))


def impose_structure(
    domain: InteriorDomain, rgb: np.ndarray, structure: Structure, cut: str = "across"
) -> tuple[np.ndarray, dict[str, Any]]:
    """Sweep a structure cut ``across`` or ``along`` the object's axis into a synthesised solid.

    Returns:
        Colours float32 [X, Y, Z, 3], and a report: ``cut``; ``swept``, the share of the solid that
        is structure; ``core``, whether it closes above and below the middle.
    """
    inside = domain.inside
    share = structure.share
    mask = structure.photo.mask
    heavy = share * mask if structure.core and share.any() else mask
    center = np.array(ndimage.center_of_mass(heavy.astype(float)))
    core = _core_radius(structure, center) if structure.core and cut == "across" else None
    sweep = Sweep(inside, domain.axis, cut, core)
    # the photograph at about the pitch of the voxels, so that nothing finer is picked at random
    factor = min(1.0, 1.2 * np.sqrt(float(inside.sum(0).astype(bool).sum()) / float(mask.sum())))
    photo = structure.photo.resized(factor)
    both = np.concatenate([photo.image, _resized(share, photo.mask.shape)[..., None]], -1)
    values = sweep.colors(both, photo.mask, center * factor)
    weight = values[:, 3:] * smoothstep((1.0 - sweep.tip) / 0.25)[:, None]
    # the grain of the synthesis stays: nothing runs unchanged along the axis
    norm = ndimage.gaussian_filter(inside.astype(np.float32), 1.2) + 1e-6
    masked = rgb * inside[..., None]
    smooth = [ndimage.gaussian_filter(masked[..., c], 1.2) / norm for c in range(3)]
    done = rgb.copy()
    done[inside] += weight * (values[:, :3] - np.stack(smooth, -1)[inside])
    report = {"cut": cut, "swept": float(weight.mean()), "core": core is not None}
    return done.clip(0.0, 1.0).astype(np.float32), report


def take_apart(exemplars: Exemplars) -> tuple[Exemplars, Structure]:
    """Material of all exemplars, and the structure of the first.

    Raises:
        InputError: There is none, or a photograph has no outline.
    """
    found: list[Structure] = []

    def material(photo: Exemplar) -> Exemplar:
        if not photo.silhouette:
            raise InputError(
                f"texture: cut needs a photograph with an outline ({photo.note})",
                hint="cut the object out (RGBA), or leave cut out",
            )
        plain, structure = split_structure(photo)
        found.append(structure)
        return plain

    plain = each(exemplars, material)
    if not found:
        raise InputError("texture: cut needs an exemplar", hint="give a photograph of the cut")
    return plain, found[0]


def with_structure(
    domain: InteriorDomain, texture: InteriorTexture, structure: Structure, cut: str
) -> InteriorTexture:
    """The texture with the structure swept into it (:func:`impose_structure`)."""
    rgb, report = impose_structure(domain, texture.rgb, structure, cut)
    return replace(texture, rgb=rgb, report={**texture.report, **report})


def _core_radius(structure: Structure, center: np.ndarray) -> float:
    """Radius that holds four fifths of the structure, relative to the photograph's own."""
    rows, columns = np.indices(structure.share.shape)
    radius = np.hypot(rows - center[0], columns - center[1])
    order = np.argsort(radius, axis=None)
    share = np.cumsum(structure.share.reshape(-1)[order])
    if share[-1] <= 0:
        return 0.3
    inner = float(radius.reshape(-1)[order][np.searchsorted(share, 0.8 * share[-1])])
    return inner / float(outline(structure.photo.mask, center).mean())


def _resized(share: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A plane in 0..1 at another size."""
    method = cv2.INTER_AREA if shape[0] < share.shape[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(share, (shape[1], shape[0]), interpolation=method), np.float32)
