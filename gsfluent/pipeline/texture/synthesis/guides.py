"""Where in the object a photograph was taken, and what patches are matched by besides their look.

Every pixel of a photograph and every voxel get the same coordinates: depth below the surface,
distance to the object's axis, azimuth, height along the axis. A photograph whose outline fits a
section of the object is laid into the object, and its pixels then take the object's own depth
(a cut through a block is deeper in the picture than in the block); one that does not fit is
scaled, deepest point to deepest point.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent._lazy import cv2
from gsfluent.colors import rgb_to_lab100
from gsfluent.pipeline.texture.photo.exemplar import Exemplar
from gsfluent.pipeline.texture.synthesis.levels import Lattice, ObjectFields, trilinear

logger = logging.getLogger(__name__)

GUIDES = ("auto", "depth", "axis", "height", "none")

_BINS, _SPOT = 32, 16  # depth ranges of the profile; pixels of a spot
_SLOPE = 3.0  # guide per Lab / 100 that the mean colour changes
_SLOPES = (0.4, 24.0)  # least and largest guide per largest depth
_FIT = 0.88  # overlap of outline and section from which a photograph is laid into the object


@dataclass(frozen=True)
class PlacedPhoto:
    """A photograph with its place in the object; lengths in voxels of the solid.

    Attributes:
        photo: The photograph, upright.
        axis: Object axis it is a cut across, 0, 1 or 2.
        pitch: Size of a pixel.
        depth: Depth of each pixel below the surface [U, V]; U runs along the first axis of the cut
            (picture columns), V along the second (picture rows, upwards).
        local: Place of each pixel in the object's frame, [U, V, 3].
        fitted: True when the outline fits a section of the object.
    """

    photo: Exemplar
    axis: int
    pitch: float
    depth: np.ndarray
    local: np.ndarray
    fitted: bool

    @property
    def image(self) -> np.ndarray:
        """Colours [U, V, 3]."""
        return upright(self.photo.image)

    @property
    def mask(self) -> np.ndarray:
        """Object pixels [U, V]."""
        return upright(self.photo.mask)

    def at(self, pitch: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Image, mask, depth and place with pixels of ``pitch`` voxels of the solid."""
        factor = self.pitch / pitch
        image, mask, depth, local = self.image, self.mask, self.depth, self.local
        if abs(factor - 1.0) < 2e-2:
            return image, mask, depth, local
        small = upright(self.photo.resized(factor).image)
        size = small.shape[1::-1]
        method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
        share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        fine = share > 0.5 if (share > 0.5).any() else share >= share.max()
        weight = np.maximum(cv2.resize(mask.astype(np.float32), size, interpolation=method), 1e-3)
        below = cv2.resize(depth * mask, size, interpolation=method) / weight
        where = cv2.resize(local, size, interpolation=method)
        return small, fine, np.where(fine, below, 0.0), where


def upright(picture: np.ndarray) -> np.ndarray:
    """A picture [H, W, ...] as an array [U, V, ...]: columns along U, rows against V."""
    return np.ascontiguousarray(np.swapaxes(picture[::-1], 0, 1))


def _section(fields: ObjectFields, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Inside and depth of the middle section across an axis, its corner, and where it is."""
    rows, columns = (i for i in range(3) if i != axis)
    middle = 0.5 * float(fields.low[axis] + fields.high[axis])
    corner = fields.low.copy()
    shape = np.ceil(fields.high - fields.low).astype(int)
    # the slice of voxels that holds the middle, not a mixture of two
    middle = np.floor(middle - fields.low[axis]) + fields.low[axis] + 0.5
    corner[axis], shape[axis] = middle - 0.5, 1
    lattice = Lattice(
        (float(corner[0]), float(corner[1]), float(corner[2])),
        1.0,
        (int(shape[0]), int(shape[1]), int(shape[2])),
        fields.rotation,
        fields.center,
    )
    share, depth = lattice.sample(fields.fields[:2])
    inside = (share > 0.5).squeeze(axis).cpu().numpy()
    below = (depth / share.clamp(min=1e-3)).squeeze(axis).cpu().numpy() * inside
    return inside, below, corner[[rows, columns]], float(middle)


def place_photo(
    photo: Exemplar,
    fields: ObjectFields,
    axis: int,
    guided: bool,
    scale: float,
    depth_scale: float | None,
) -> PlacedPhoto:
    """Find out where a photograph belongs.

    Args:
        photo: The photograph.
        fields: The object.
        axis: Object axis it is a cut across.
        guided: Structure follows the object; else the photograph shows a piece of material.
        scale: Size of the photographed structure relative to the automatic choice.
        depth_scale: Depth of the photograph's deepest point in units of the object's largest
            depth; None lays it into the object when it fits, else deepest to deepest.

    Returns:
        The photograph with pitch, depth and place of its pixels.
    """
    mask = upright(photo.mask)
    own_depth = upright(photo.depth)
    inside, below, corner, middle = _section(fields, axis)
    rows, columns = (i for i in range(3) if i != axis)
    u, v = np.nonzero(mask)
    low, high = np.array([u.min(), v.min()]), np.array([u.max(), v.max()]) + 1.0
    a, b = np.nonzero(inside)
    if len(a) == 0:  # a middle section without matter (a ring): the bounding box stands for it
        start = np.array([0.0, 0.0])
        stop = np.array([fields.high[i] - fields.low[i] for i in (rows, columns)])
    else:
        start, stop = np.array([a.min(), b.min()]), np.array([a.max(), b.max()]) + 1.0
    stretch = (stop - start) / (high - low)
    isotropic = float(np.sqrt(stretch[0] * stretch[1]))
    grid = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in mask.shape), indexing="ij"), -1)
    place = (grid - 0.5 * (low + high)) * stretch + 0.5 * (start + stop)
    index = np.floor(place).astype(int)
    within = ((index >= 0) & (index < inside.shape)).all(-1)
    index = np.clip(index, 0, np.array(inside.shape) - 1)
    hit = within & inside[index[..., 0], index[..., 1]]
    overlap = float((hit & mask).sum() / max((hit | mask).sum(), 1))
    even = float(stretch.max() / stretch.min())
    fits = photo.silhouette and overlap > _FIT and even < 1.25
    fitted = guided and depth_scale is None and fits
    deepest = fields.max_depth * (1.0 if depth_scale is None else depth_scale)
    if fitted:
        flat = torch.from_numpy(below)[None, :, :, None].float()
        points = torch.from_numpy(np.concatenate([place, np.full_like(place[..., :1], 0.5)], -1))
        depth = trilinear(flat, points.float())[0].numpy()
        # outlines never agree to the pixel: just outside the section is just below the surface
        depth = np.maximum(depth, 0.5 * np.minimum(own_depth * isotropic, 1.0))
    else:
        depth = own_depth * (deepest / max(photo.max_depth, 1.0))
    depth = np.where(mask, depth, 0.0).astype(np.float32)
    local = np.zeros((*mask.shape, 3), np.float32)
    local[..., rows] = place[..., 0] + corner[0]
    local[..., columns] = place[..., 1] + corner[1]
    local[..., axis] = middle
    if fits:
        pitch = isotropic
    elif guided:
        pitch = deepest / max(photo.max_depth, 1.0)
    else:
        pitch = float((fields.high - fields.low).max()) / max(photo.mask.shape)
    return PlacedPhoto(photo, axis, pitch * scale, depth, local, fitted)


class DepthGuide:
    """Depth, stretched where the photographs' colours change with it.

    Layers below the skin must meet their like to the voxel; in a core of one material depth says
    nothing, and holding on to it would repeat the photograph's spots at their depth, all around.

    Args:
        photos: Photographs, placed.
        largest: Largest depth of the object [voxels].
    """

    def __init__(self, photos: Sequence[PlacedPhoto], largest: float) -> None:
        self.largest = max(largest, 1e-6)
        depth = np.concatenate([p.depth[p.mask] for p in photos]) / self.largest
        image = np.concatenate([p.image[p.mask] for p in photos]).astype(np.float32)
        color = rgb_to_lab100(torch.from_numpy(image)).numpy()
        order = np.argsort(depth, kind="stable")
        # bins fine near the skin, where layers are thin, and none without pixels
        edges = np.unique((len(order) * np.linspace(0, 1, _BINS + 1)).astype(int))
        bins = [order[i:j] for i, j in itertools.pairwise(edges) if j > i]
        place = np.array([depth[b].mean() for b in bins])
        mean = np.stack([color[b].mean(0) for b in bins])
        # neighbouring pixels are alike: a spot counts as one sample
        noise = np.array([color[b].var(0).sum() * _SPOT / max(len(b), _SPOT) for b in bins])
        step = ((mean[1:] - mean[:-1]) ** 2).sum(1) - 2.0 * (noise[1:] + noise[:-1])
        gap = np.maximum(np.diff(place), 1e-4)
        slope = np.clip(_SLOPE * np.sqrt(np.maximum(step, 0.0)) / gap, *_SLOPES)
        self.place = np.concatenate([[0.0], 0.5 * (place[1:] + place[:-1]), [1.5]])
        rates = np.concatenate([slope[:1], slope, slope[-1:]])
        values = np.diff(self.place) * 0.5 * (rates[1:] + rates[:-1])
        self.value = np.concatenate([[0.0], values.cumsum()])

    def __call__(self, depth: Tensor) -> Tensor:
        """Guide values of depths [voxels of the solid]."""
        knots = torch.from_numpy(self.place).to(depth)
        values = torch.from_numpy(self.value).to(depth)
        at = (depth / self.largest).clamp(0.0, 1.5)
        right = torch.searchsorted(knots, at.contiguous()).clamp(1, len(knots) - 1)
        low, high = knots[right - 1], knots[right]
        share = (at - low) / (high - low).clamp(min=1e-9)
        return values[right - 1] + share * (values[right] - values[right - 1])


def explained(value: np.ndarray, color: np.ndarray) -> float:
    """Share of the colours' variance [n, 3] that a coordinate [n] explains (correlation ratio)."""
    if len(value) == 0 or float(np.ptp(value)) <= 0:
        return 0.0
    order = np.argsort(value, kind="stable")
    total = float(((color - color.mean(0)) ** 2).sum())
    within = sum(float(((c - c.mean(0)) ** 2).sum()) for c in np.array_split(color[order], 24))
    return 1.0 - within / max(total, 1e-9)
