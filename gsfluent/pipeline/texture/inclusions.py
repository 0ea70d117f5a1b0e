"""Seeds, stones, raisins: found in the photograph, placed in the volume by stereology."""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass

import numpy as np

from .photo import Exemplar, rgb_to_lab

__all__ = ["Inclusions", "find_inclusions", "paint_inclusions", "remove_inclusions"]

logger = logging.getLogger(__name__)

_RINGS = np.array([0.0, 0.4, 0.7, 0.95, 1.2, 1.4])  # normalised radii of the colour profile
_SECTION_BIAS = 4.0 / np.pi  # a random section of a ball shows pi/4 of its diameter on average


@dataclass(frozen=True)
class Inclusions:
    """Compact blobs of one photograph.

    Attributes:
        mask: Their pixels with a one-pixel rim, bool [H, W].
        depth: Depth of each blob below the outline [pixels], [K].
        major: Half of the long section axis [pixels], [K].
        minor: Half of the short section axis [pixels], [K].
        radial: Mean |cosine| between long axis and depth gradient (0.64 when random).
        profile: Colour per normalised radius, [6, 3].
    """

    mask: np.ndarray
    depth: np.ndarray
    major: np.ndarray
    minor: np.ndarray
    radial: float
    profile: np.ndarray

    @property
    def count(self) -> int:
        """Number of blobs."""
        return len(self.depth)


def find_inclusions(exemplar: Exemplar, minimum: int = 4) -> Inclusions | None:
    """Find compact blobs whose colour is unusual for their depth.

    Robust z-score of Lab within depth bins; connected components that are small, compact and of
    one colour. Veins, fibres and the core are not compact or not alike and stay texture.

    Args:
        exemplar: Photograph, at most a few hundred pixels wide.
        minimum: Fewer blobs than this are not a population.

    Returns:
        The blobs, or None.
    """
    import cv2
    from scipy import ndimage

    mask = exemplar.mask
    area = int(mask.sum())
    lab = rgb_to_lab(exemplar.image)
    blurred = np.stack([ndimage.gaussian_filter(lab[..., c], 0.7) for c in range(3)], -1)
    score = np.zeros(mask.shape, np.float32)
    depth = exemplar.depth if exemplar.silhouette else np.zeros_like(exemplar.depth)
    edges = np.quantile(depth[mask], np.linspace(0, 1, 11)) if exemplar.silhouette else [0, 1]
    which = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, len(edges) - 2)
    for k in range(len(edges) - 1):
        chosen = mask & (which == k)
        if chosen.sum() < 20:
            continue
        values = blurred[chosen]
        middle = np.median(values, axis=0)
        spread = 1.4826 * np.median(np.abs(values - middle), axis=0) + 2.0
        # dark and light blobs only: hue drifts too much between layers
        score[chosen] = np.abs(values[:, 0] - middle[0]) / spread[0]
    margin = 0.06 * exemplar.max_depth if exemplar.silhouette else 0.0
    candidate = (score > 4.5) & mask & (depth >= margin)
    candidate = ndimage.binary_fill_holes(candidate)
    labels, _ = ndimage.label(candidate, np.ones((3, 3)))
    found: list[tuple[int, float, float, float, float]] = []
    colors: list[np.ndarray] = []
    gradient = np.stack(np.gradient(ndimage.gaussian_filter(exemplar.depth, 1.5)), -1)
    objects = ndimage.find_objects(labels)
    for number, box in enumerate(objects, start=1):
        blob = labels[box] == number
        pixels = int(blob.sum())
        if not max(4, 1e-5 * area) <= pixels <= 0.012 * area:
            continue
        points = np.argwhere(blob).astype(np.float32)
        moments = np.cov(points.T) if pixels > 2 else np.eye(2)
        values, vectors = np.linalg.eigh(moments + np.eye(2) / 12.0)
        # an ellipse's half axes are twice the standard deviations of its area
        minor, major = 2.0 * np.sqrt(values)
        if major > 4.0 * minor or pixels < 0.62 * np.pi * major * minor:
            continue
        middle = np.rint(points.mean(0)).astype(int)
        center = (int(middle[0]) + box[0].start, int(middle[1]) + box[1].start)
        slope = gradient[center]
        length = float(np.linalg.norm(slope))
        cosine = abs(float(vectors[:, 1] @ slope)) / length if length > 1e-6 else 0.64
        found.append((number, float(depth[center]), float(major), float(minor), cosine))
        colors.append(np.median(lab[box][blob], axis=0))
    if len(found) < minimum:
        return None
    palette = np.stack(colors)
    alike = np.linalg.norm(palette - np.median(palette, axis=0), axis=1) < 25.0
    found = [entry for entry, good in zip(found, alike, strict=True) if good]
    if len(found) < minimum:
        return None
    chosen = np.isin(labels, [entry[0] for entry in found])
    table = np.array([entry[1:] for entry in found])
    grown = cv2.dilate(chosen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    profile = _ring_profile(exemplar.image, labels, [entry[0] for entry in found])
    radial = float(np.average(table[:, 3], weights=table[:, 1] - table[:, 2] + 1e-3))
    logger.info("exemplar: %d inclusions (seeds, stones) found", len(found))
    return Inclusions(grown & mask, table[:, 0], table[:, 1], table[:, 2], radial, profile)


def _ring_profile(image: np.ndarray, labels: np.ndarray, numbers: list[int]) -> np.ndarray:
    """Mean colour of the blobs per normalised radius (0 centre, 1 outline)."""
    from scipy import ndimage

    sums = np.zeros((len(_RINGS), 3))
    counts = np.zeros(len(_RINGS))
    boxes = ndimage.find_objects(labels)
    for number in numbers:
        box = boxes[number - 1]
        low = [max(0, s.start - 4) for s in box]
        high = [min(n, s.stop + 4) for s, n in zip(box, labels.shape, strict=True)]
        window = (slice(low[0], high[0]), slice(low[1], high[1]))
        blob = labels[window] == number
        inner = ndimage.distance_transform_edt(blob)
        outer = ndimage.distance_transform_edt(~blob)
        radius = np.where(blob, 1.0 - (inner - 0.5) / max(inner.max(), 1.0), 1.0)
        radius = np.where(blob, radius, 1.0 + (outer - 0.5) / max(inner.max(), 1.0))
        ring = np.abs(radius[..., None] - _RINGS).argmin(-1)
        usable = radius < 1.5
        for k in range(len(_RINGS)):
            pixels = image[window][usable & (ring == k)]
            sums[k] += pixels.sum(0)
            counts[k] += len(pixels)
    profile = sums / np.maximum(counts, 1)[:, None]
    profile[counts == 0] = profile[counts > 0][0]
    return profile.astype(np.float32)


def remove_inclusions(exemplar: Exemplar, inclusions: Inclusions) -> Exemplar:
    """The photograph with its blobs painted over from around them."""
    from dataclasses import replace

    import cv2

    pixels = (exemplar.image * 255).round().astype(np.uint8)
    # seeds have pale rims that belong to them: half a minor axis more on every side
    rim = 3 + 2 * int(0.5 * float(inclusions.minor.mean()))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (rim, rim))
    hole = cv2.dilate(inclusions.mask.astype(np.uint8), kernel)
    clean = cv2.inpaint(pixels, hole, 3, cv2.INPAINT_TELEA).astype(np.float32) / 255.0
    image = np.where(hole[..., None] > 0, clean, exemplar.image).astype(np.float32)
    return replace(exemplar, image=image)


def paint_inclusions(
    rgb: np.ndarray,
    inside: np.ndarray,
    depth: np.ndarray,
    exemplar: Exemplar,
    inclusions: Inclusions,
    pitch: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Place ellipsoids at the density the photograph implies.

    Number per volume = number per area / mean calliper diameter (DeHoff & Rhines 1961), per depth
    range; section sizes are enlarged by 4/pi; centres keep a distance (Poisson disc).

    Args:
        rgb: Volume [X, Y, Z, 3] in 0..1.
        inside: Matter, bool [X, Y, Z].
        depth: Depth below the surface [voxels].
        exemplar: The photograph the blobs came from.
        inclusions: The blobs.
        pitch: Voxels per pixel of that photograph.
        rng: Random generator.

    Returns:
        New colours, labels int32 (1..K inside inclusions), and K.
    """
    from scipy import ndimage

    section = np.sqrt(inclusions.major * inclusions.minor)
    diameter = 2.0 * _SECTION_BIAS * float(section.mean()) * pitch
    centers = _place(inside, depth, exemplar, inclusions, pitch, diameter, rng)
    result = rgb.copy()
    labels = np.zeros(inside.shape, np.int32)
    gradient = np.stack(np.gradient(ndimage.gaussian_filter(depth, 1.5)))
    reach = _RINGS[-1]
    number = 0
    for center in centers:
        k = int(rng.integers(inclusions.count))
        a = _SECTION_BIAS * inclusions.major[k] * pitch
        b = _SECTION_BIAS * inclusions.minor[k] * pitch
        a, b = max(a, 0.9), max(b, 0.7)
        voxel = tuple(np.floor(center).astype(int))
        long = gradient[(slice(None), *voxel)] if inclusions.radial > 0.75 else np.zeros(3)
        long = long + 0.15 * rng.standard_normal(3) * max(float(np.linalg.norm(long)), 0.1)
        long /= max(float(np.linalg.norm(long)), 1e-9)
        low = np.maximum(np.floor(center - reach * a - 1).astype(int), 0)
        high = np.minimum(np.ceil(center + reach * a + 2).astype(int), inside.shape)
        box = tuple(slice(s, t) for s, t in zip(low, high, strict=True))
        grid = np.stack(
            np.meshgrid(*(np.arange(s, t) for s, t in zip(low, high, strict=True)), indexing="ij"),
            -1,
        )
        delta = grid + 0.5 - center
        along = delta @ long
        across = np.sqrt(np.maximum((delta**2).sum(-1) - along**2, 0.0))
        radius = np.sqrt((along / a) ** 2 + (across / b) ** 2)
        color = np.stack(
            [np.interp(radius, _RINGS, inclusions.profile[:, c]) for c in range(3)], -1
        )
        opacity = np.clip((_RINGS[-1] - radius) / 0.15, 0.0, 1.0) * inside[box]
        number += 1
        result[box] += opacity[..., None] * (color - result[box])
        body = (radius <= 1.0) & inside[box] & (labels[box] == 0)
        labels[box][body] = number
    return result.astype(np.float32), labels, number


def _place(
    inside: np.ndarray,
    depth: np.ndarray,
    exemplar: Exemplar,
    inclusions: Inclusions,
    pitch: float,
    diameter: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Centres [K, 3] in voxel units."""
    if exemplar.silhouette:
        low = max(float(inclusions.depth.min()) - 1.0, 0.0)
        edges = np.linspace(low, float(inclusions.depth.max()) + 1.0, 5)
    else:
        edges = np.array([-1.0, np.inf])
    pixel_depth = exemplar.depth if exemplar.silhouette else np.zeros_like(exemplar.depth)
    blob_depth = inclusions.depth if exemplar.silhouette else np.zeros(inclusions.count)
    chosen: list[np.ndarray] = []
    for start, stop in itertools.pairwise(edges):
        pixels = exemplar.mask & (pixel_depth >= start) & (pixel_depth < stop)
        area = float(pixels.sum()) * pitch**2
        seen = int(((blob_depth >= start) & (blob_depth < stop)).sum())
        room = depth / pitch if exemplar.silhouette else np.zeros_like(depth)
        voxels = np.argwhere(inside & (room >= start) & (room < stop) & (depth > 0.6 * diameter))
        if area <= 0 or seen == 0 or len(voxels) == 0:
            continue
        expected = seen / area / diameter * len(voxels)
        count = int(expected) + int(rng.random() < expected % 1.0)
        distance = 0.75 * (len(voxels) / max(expected, 1.0)) ** (1.0 / 3.0)
        distance = max(distance, 0.9 * diameter)
        placed = 0
        for _ in range(30 * count):
            if placed >= count:
                break
            point = voxels[rng.integers(len(voxels))] + rng.random(3)
            if chosen and float(np.min(np.sum((np.stack(chosen) - point) ** 2, 1))) < distance**2:
                distance *= 0.995  # a crowded range gives way slowly
                continue
            chosen.append(point)
            placed += 1
    return np.stack(chosen) if chosen else np.zeros((0, 3))
