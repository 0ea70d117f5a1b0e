"""Seeds, stones, raisins: found in the photograph, placed in the volume by stereology."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from gsfluent._lazy import cv2, ndimage
from gsfluent.colors import rgb_to_lab
from gsfluent.pipeline.texture.photo.exemplar import Exemplar
from gsfluent.pipeline.texture.synthesis.guides import PlacedPhoto
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, gradient

logger = logging.getLogger(__name__)

_RINGS = np.array([0.0, 0.4, 0.7, 0.95, 1.2, 1.4])  # normalised radii of the colour profile
_PAINTED = np.array([0.0, 0.4, 0.7, 0.97, 1.08, 1.4])  # the same, with the edge where it is sharp
_POPULATION = 4  # fewer blobs than this are none
_SECTION_BIAS = 4.0 / np.pi  # a random section of a ball shows pi/4 of its diameter on average


@dataclass(frozen=True)
class Inclusions:
    """Compact blobs of one photograph.

    Attributes:
        mask: Their pixels with a one-pixel rim, bool [H, W].
        center: Middle of each blob, rows and columns [pixels], [K, 2].
        area: Pixels of each blob, [K].
        depth: Depth of each blob below the outline [pixels], [K].
        major: Half of the long section axis [pixels], [K].
        minor: Half of the short section axis [pixels], [K].
        radial: Mean |cosine| between long axis and depth gradient (0.64 when random).
        profile: Colour per normalised radius, [6, 3].
    """

    mask: np.ndarray
    center: np.ndarray
    area: np.ndarray
    depth: np.ndarray
    major: np.ndarray
    minor: np.ndarray
    radial: float
    profile: np.ndarray

    @property
    def count(self) -> int:
        """Number of blobs."""
        return len(self.depth)


def find_inclusions(exemplar: Exemplar, parts: np.ndarray | None = None) -> Inclusions | None:
    """Find compact blobs whose colour is unusual for their depth, or take those that are given.

    Robust z-score of Lab within depth bins; connected components that are small, compact and of one
    colour. Veins, fibres and the core are not compact or not alike and stay texture. Given
    ``parts``, bool [H, W] or instance numbers int [H, W] (0 is none), are not judged, and may be
    few.
    """
    if parts is None:
        labels, _ = ndimage.label(_unusual(exemplar), np.ones((3, 3)))
    elif parts.dtype == bool:
        labels, _ = ndimage.label(parts & exemplar.mask, np.ones((3, 3)))
    else:
        labels = np.where(exemplar.mask, parts, 0).astype(int)
    given = parts is not None
    lab = rgb_to_lab(exemplar.image)
    area = int(exemplar.mask.sum())
    depth = exemplar.depth if exemplar.silhouette else np.zeros_like(exemplar.depth)
    found: list[tuple[float, ...]] = []
    colors: list[np.ndarray] = []
    slopes = np.stack(np.gradient(ndimage.gaussian_filter(exemplar.depth, 1.5)), -1)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None:
            continue
        blob = labels[box] == number
        pixels = int(blob.sum())
        if not given and not max(4, 1e-5 * area) <= pixels <= 0.012 * area:
            continue
        points = np.argwhere(blob).astype(np.float32)
        moments = np.cov(points.T) if pixels > 2 else np.eye(2)
        values, vectors = np.linalg.eigh(moments + np.eye(2) / 12.0)
        # an ellipse's half axes are twice the standard deviations of its area
        minor, major = 2.0 * np.sqrt(values)
        if not given and (major > 4.0 * minor or pixels < 0.62 * np.pi * major * minor):
            continue
        middle = points.mean(0) + [box[0].start, box[1].start]
        row, column = np.rint(middle).astype(int)
        slope = slopes[row, column]
        length = float(np.linalg.norm(slope))
        cosine = abs(float(vectors[:, 1] @ slope)) / length if length > 1e-6 else 0.64
        found.append(
            (number, float(depth[row, column]), float(major), float(minor), cosine, pixels, *middle)
        )
        colors.append(np.median(lab[box][blob], axis=0))
    if not given and len(found) >= _POPULATION:
        palette = np.stack(colors)
        alike = np.linalg.norm(palette - np.median(palette, axis=0), axis=1) < 25.0
        found = [entry for entry, good in zip(found, alike, strict=True) if good]
    if len(found) < (1 if given else _POPULATION):
        return None
    numbers = [int(entry[0]) for entry in found]
    chosen = np.isin(labels, numbers)
    table = np.array([entry[1:] for entry in found])
    grown = cv2.dilate(chosen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    profile = _ring_profile(exemplar.image, labels, numbers)
    deep, major_axes, minor_axes, cosines, areas = table[:, :5].T
    radial = float(np.average(cosines, weights=major_axes - minor_axes + 1e-3))
    logger.info("exemplar: %d inclusions (seeds, stones) found", len(found))
    mask, middles = grown & exemplar.mask, table[:, 5:7]
    return Inclusions(mask, middles, areas, deep, major_axes, minor_axes, radial, profile)


def _unusual(exemplar: Exemplar) -> np.ndarray:
    """Pixels whose lightness is far from the median of their depth, bool [H, W]."""
    mask = exemplar.mask
    lightness = ndimage.gaussian_filter(rgb_to_lab(exemplar.image)[..., 0], 0.5)
    score = np.zeros(mask.shape, np.float32)
    depth = exemplar.depth if exemplar.silhouette else np.zeros_like(exemplar.depth)
    edges = np.quantile(depth[mask], np.linspace(0, 1, 11)) if exemplar.silhouette else [0, 1]
    which = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, len(edges) - 2)
    for k in range(len(edges) - 1):
        chosen = mask & (which == k)
        if chosen.sum() < 20:
            continue
        values = lightness[chosen]
        middle = np.median(values)
        # dark and light blobs only: hue drifts too much between layers
        score[chosen] = np.abs(values - middle) / (
            1.4826 * np.median(np.abs(values - middle)) + 2.0
        )
    margin = 0.06 * exemplar.max_depth if exemplar.silhouette else 0.0
    return ndimage.binary_fill_holes((score > 4.5) & mask & (depth >= margin))


def _ring_profile(image: np.ndarray, labels: np.ndarray, numbers: list[int]) -> np.ndarray:
    """Mean colour of the blobs per normalised radius (0 centre, 1 outline)."""
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
    for empty in np.flatnonzero(counts == 0).tolist():
        # small blobs have no pixel in some rings: the nearest on the same side of the outline
        beside = (counts > 0) & ((_RINGS > 1.0) == (_RINGS[empty] > 1.0))
        filled = np.flatnonzero(beside if beside.any() else counts > 0)
        profile[empty] = profile[filled[np.abs(_RINGS[filled] - _RINGS[empty]).argmin()]]
    return profile.astype(np.float32)


def remove_inclusions(exemplar: Exemplar, inclusions: Inclusions) -> Exemplar:
    """The photograph with its blobs painted over from around them."""
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
    domain: InteriorDomain,
    placed: PlacedPhoto,
    inclusions: Inclusions,
    anchor: tuple[np.ndarray, np.ndarray, float],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Place ellipsoids at the density the photograph implies.

    The share of the volume is the share of the cut's area (Delesse 1847), per depth range; section
    sizes are enlarged by 4/pi (DeHoff & Rhines 1961); centres keep a distance (Poisson disc) and
    are drawn in the object (``anchor``: its rotation [3, 3], origin [3] and size [voxels]), so that
    another grid gives the same ones.

    Returns:
        New colours [X, Y, Z, 3], labels int32 (1..K inside inclusions), and K.
    """
    inside, pitch = domain.inside, placed.pitch
    result = rgb.copy()
    labels = np.zeros(inside.shape, np.int32)
    slope = gradient(ndimage.gaussian_filter(domain.depth, 1.5))
    reach = _RINGS[-1]
    number = 0
    for center, k, noise in _place(domain, placed, inclusions, anchor, rng):
        a = _SECTION_BIAS * inclusions.major[k] * pitch
        b = _SECTION_BIAS * inclusions.minor[k] * pitch
        a, b = max(a, 0.9), max(b, 0.7)
        voxel = tuple(np.floor(center).astype(int))
        long = slope[(slice(None), *voxel)] if inclusions.radial > 0.75 else np.zeros(3)
        long = long + 0.15 * noise * max(float(np.linalg.norm(long)), 0.1)
        long /= max(float(np.linalg.norm(long)), 1e-9)
        low = np.maximum(np.floor(center - reach * a - 1).astype(int), 0)
        high = np.minimum(np.ceil(center + reach * a + 2).astype(int), inside.shape)
        box = tuple(slice(s, t) for s, t in zip(low, high, strict=True))
        lines = (np.arange(s, t) for s, t in zip(low, high, strict=True))
        delta = np.stack(np.meshgrid(*lines, indexing="ij"), -1) + 0.5 - center
        along = delta @ long
        across = np.sqrt(np.maximum((delta**2).sum(-1) - along**2, 0.0))
        radius = np.sqrt((along / a) ** 2 + (across / b) ** 2)
        tones = inclusions.profile.T
        color = np.stack([np.interp(radius, _PAINTED, tone) for tone in tones], -1)
        opacity = np.clip((_RINGS[-1] - radius) / 0.15, 0.0, 1.0) * inside[box]
        number += 1
        result[box] += opacity[..., None] * (color - result[box])
        body = (radius <= 1.0) & inside[box] & (labels[box] == 0)
        labels[box][body] = number
    return result.astype(np.float32), labels, number


def _place(
    domain: InteriorDomain,
    placed: PlacedPhoto,
    inclusions: Inclusions,
    anchor: tuple[np.ndarray, np.ndarray, float],
    rng: np.random.Generator,
) -> list[tuple[np.ndarray, int, np.ndarray]]:
    """Centres [3] in voxel units, which blob is copied, and a random vector [3] for each."""
    pitch, inside = placed.pitch, domain.inside
    section = np.sqrt(inclusions.major * inclusions.minor)
    diameter = 2.0 * _SECTION_BIAS * float(section.mean()) * pitch
    body = 4.0 / 3.0 * np.pi * (_SECTION_BIAS * pitch) ** 3
    volume = float(np.mean(body * inclusions.major * inclusions.minor**2))
    # the photograph's rows run against the second axis of the cut
    u = np.rint(inclusions.center[:, 1]).astype(int)
    v = placed.mask.shape[1] - 1 - np.rint(inclusions.center[:, 0]).astype(int)
    blob_depth = placed.depth[u, v]
    if placed.photo.silhouette:
        low = max(float(blob_depth.min()) - pitch, 0.0)
        edges = np.linspace(low, float(blob_depth.max()) + pitch, 5)
    else:
        edges = np.array([-1.0, np.inf])
        blob_depth = np.zeros_like(blob_depth)
    wanted = np.zeros(len(edges) - 1)
    distance = np.zeros(len(edges) - 1)
    pixel_depth = placed.depth if placed.photo.silhouette else np.zeros_like(placed.depth)
    room = domain.depth if placed.photo.silhouette else np.zeros_like(domain.depth)
    for k in range(len(wanted)):
        pixels = placed.mask & (pixel_depth >= edges[k]) & (pixel_depth < edges[k + 1])
        here = inside & (room >= edges[k]) & (room < edges[k + 1])
        blobs = (blob_depth >= edges[k]) & (blob_depth < edges[k + 1])
        share = float(inclusions.area[blobs].sum()) / max(int(pixels.sum()), 1)
        wanted[k] = share * float(here.sum()) / volume
        apart = 0.75 * (float(here.sum()) / max(wanted[k], 1.0)) ** (1.0 / 3.0)
        distance[k] = max(apart, 0.9 * diameter)
    chosen: list[tuple[np.ndarray, int, np.ndarray]] = []
    # one seed of four per range would be rounded away: the rests are drawn by lot
    wanted = np.floor(wanted + rng.random(len(wanted)))
    count = np.zeros(len(wanted))
    rotation, origin, size = anchor
    # the ball about the object's bounding box, in which places do not depend on the grid
    half = 0.5 * float(np.linalg.norm(inside.shape)) / size + 0.1
    for _ in range(64):
        place = (rng.random((4096, 3)) - 0.5) * 2.0 * half
        which, noise = rng.random(4096), rng.standard_normal((4096, 3))
        points = origin + (place * size) @ rotation
        voxels = np.floor(points).astype(int)
        usable = ((voxels >= 0) & (voxels < inside.shape)).all(1)
        voxels = np.where(usable[:, None], voxels, 0)
        at = tuple(voxels.T)
        below = np.searchsorted(edges, room[at], side="right") - 1
        usable &= inside[at] & (domain.depth[at] > 0.6 * diameter)
        usable &= (below >= 0) & (below < len(wanted))
        for i in np.flatnonzero(usable):
            k, point = int(below[i]), points[i]
            if count[k] >= wanted[k]:
                continue
            gap = min((float(np.sum((c - point) ** 2)) for c, _, _ in chosen), default=np.inf)
            if gap < distance[k] ** 2:
                distance[k] *= 0.995  # a crowded range gives way slowly
                continue
            chosen.append((point, int(which[i] * inclusions.count), noise[i]))
            count[k] += 1
        if (count >= wanted).all():
            break
    return chosen
