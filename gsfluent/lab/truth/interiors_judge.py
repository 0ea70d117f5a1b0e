"""Judge a texture of a known interior on planes that no method has seen.

PSNR is no use: another object of the class, as good an answer as there is, loses against a blur.
So every figure stands beside its **floor**, the same figure of other draws of the class.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from gsfluent.lab.truth.interiors import KnownInterior
from gsfluent.pipeline.texture.photo import metrics
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture

Plane = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A point on the plane and two unit vectors in it (columns, rows), voxel units."""

_PLACES = ((0.34, 0.60), (0.34, 0.60), (0.22, 0.56))
"""Where the slices lie along x, y and z. Level ones pass through the same sponge in every cake: one
that met the cream in some draws only would make the floor a matter of luck."""
_DISTANCES = ("patch", "patch_coarse", "hist", "profile", "coherence", "coverage")
_PATCHES = 40000
"""With fewer the draw of patches costs more than another object of the class."""
_KEEP_OFF = 3.0
"""Held-out slices stay this far from a photographed one [voxels]."""


def held_out_planes(known: KnownInterior, seed: int = 0) -> list[Plane]:
    """Twelve planes: two off-centre ones across each axis, and six at random angles."""
    index = np.argwhere(known.domain.inside)
    low, high = index.min(0), index.max(0) + 1.0
    middle, extent = 0.5 * (low + high), high - low
    unit = np.eye(3)
    planes: list[Plane] = []
    for axis in range(3):
        columns, rows = (i for i in range(3) if i != axis)
        cut = known.cuts.get("xyz"[axis])
        for place in _PLACES[axis]:
            # through voxel centres: these planes are slices, nothing is interpolated
            point = np.floor(middle) + 0.5
            point[axis] = np.floor(low[axis] + place * extent[axis]) + 0.5
            if cut is not None and abs(point[axis] - cut - 0.5) < _KEEP_OFF:
                point[axis] = cut + 0.5 + _KEEP_OFF
            planes.append((point, unit[columns], unit[rows]))
    rng = np.random.default_rng(seed)
    while len(planes) < 12:
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        # oblique means oblique: no axis within 25 degrees
        if np.abs(normal).max() > np.cos(np.deg2rad(25.0)):
            continue
        u = np.cross(normal, unit[int(np.abs(normal).argmin())])
        u /= np.linalg.norm(u)
        offset = rng.uniform(-0.18, 0.18) * float(extent.min())
        planes.append((middle + offset * normal, u, np.cross(normal, u)))
    return planes


def sample_plane(domain: InteriorDomain, rgb: np.ndarray, plane: Plane) -> metrics.Slice:
    """Colours on a plane (trilinear, one pixel per voxel; rows run against the second vector).

    Returns:
        Image [N, N, 3] and the mask of pixels whose nearest voxel is inside [N, N].
    """
    point, u, v = plane
    size = max(domain.inside.shape)
    across = (np.arange(size) - size // 2)[:, None]
    position = point + (across * u)[None] - (across * v)[:, None]
    flat = position.reshape(-1, 3)
    voxel = np.floor(flat).astype(int)
    within = ((voxel >= 0) & (voxel < domain.inside.shape)).all(1)
    mask = np.zeros(len(flat), bool)
    mask[within] = domain.inside[tuple(voxel[within].T)]
    image = np.zeros((len(flat), 3), np.float32)
    texture = InteriorTexture(rgb, np.zeros(0, np.int32))
    image[mask] = texture.sample(flat[mask], domain.inside)
    return image.reshape(size, size, 3), mask.reshape(size, size)


class Judge:
    """Figures of textures of one known interior, each beside the floor."""

    def __init__(self, known: KnownInterior, others: Sequence[KnownInterior]) -> None:
        self.known = known
        self.others = list(others)
        self.planes = held_out_planes(known)

    @cached_property
    def truth(self) -> list[metrics.Slice]:
        """The held-out planes of the truth."""
        return self.slices(self.known, self.known.rgb)

    @cached_property
    def floor(self) -> dict[str, Any]:
        """Mean figures of the other draws."""
        found = [self._figures(other, other.rgb) for other in self.others]
        return {key: np.mean([f[key] for f in found], 0).tolist() for key in found[0]}

    def slices(self, known: KnownInterior, rgb: np.ndarray) -> list[metrics.Slice]:
        """The held-out planes of a volume."""
        return [sample_plane(known.domain, rgb, plane) for plane in held_out_planes(known)]

    def __call__(self, rgb: np.ndarray) -> dict[str, Any]:
        """Judge a volume.

        Args:
            rgb: Colours [X, Y, Z, 3] in 0..1 on the grid of the solid.

        Returns:
            The figures named in :func:`judge`, ``floor`` (the same of another draw) and ``ratio``
            (figure over floor, where less is better and the floor is not 0).
        """
        return self._beside_the_floor(self._figures(self.known, rgb))

    def _beside_the_floor(self, figures: dict[str, Any]) -> dict[str, Any]:
        keys = [key for key in _DISTANCES if figures[key] is not None]
        ratio = {key: figures[key] / max(self.floor[key], 1e-9) for key in keys}
        return {**figures, "floor": self.floor, "ratio": ratio}

    def photograph(self) -> dict[str, Any]:
        """Figures of the photographs themselves: how well one cut represents the others.

        Figures that need a volume are None. A cut through the middle shows less skin than the
        planes do, which a method makes up for by the depth; but what a method is shown of seeds and
        veins is no better a sample than this.
        """
        truth = self.truth
        own = [(p[..., :3], p[..., 3] > 0.5) for p in self.known.exemplars().values()]
        coherence, coverage = metrics.patch_neighbours(own, truth)
        halves = metrics.half_size(own), metrics.half_size(truth)
        return self._beside_the_floor({
            "patch": metrics.patch_distance(own, truth, samples=_PATCHES),
            "patch_coarse": metrics.patch_distance(*halves, samples=_PATCHES),
            "hist": metrics.lab_histogram_distance(_colors(own), _colors(truth)),
            "profile": None,
            "sharp": metrics.sharpness(own) / max(metrics.sharpness(truth), 1e-9),
            "neighbour": None,
            "radial": None,
            "coherence": coherence,
            "coverage": coverage,
        })  # fmt: skip

    def _figures(self, known: KnownInterior, rgb: np.ndarray) -> dict[str, Any]:
        domain, truth = known.domain, self.truth
        own = self.slices(known, rgb)
        coherence, coverage = metrics.patch_neighbours(own, truth)
        change = metrics.neighbour_change(rgb, domain.inside)
        true_change = metrics.neighbour_change(self.known.rgb, self.known.domain.inside)
        return {
            "patch": metrics.patch_distance(own, truth, samples=_PATCHES),
            "patch_coarse": metrics.patch_distance(
                metrics.half_size(own), metrics.half_size(truth), samples=_PATCHES
            ),
            "hist": metrics.lab_histogram_distance(_colors(own), _colors(truth)),
            "profile": metrics.depth_profile_difference(
                domain, rgb, self.known.domain, self.known.rgb
            ),
            "sharp": metrics.sharpness(own) / max(metrics.sharpness(truth), 1e-9),
            "neighbour": [a / max(b, 1e-9) for a, b in zip(change, true_change, strict=True)],
            "radial": metrics.radial_ratio(domain, rgb)
            / metrics.radial_ratio(self.known.domain, self.known.rgb),
            "coherence": coherence,
            "coverage": coverage,
        }


def crossing_error(known: KnownInterior, rgb: np.ndarray) -> float:
    """Largest difference between slices across x, y and z along the lines where they cross.

    The slices are read from the volume as pictures (:func:`sample_plane`) and compared pixel by
    pixel: 0 says that what is seen in one slice is what is seen in another.
    """
    planes = held_out_planes(known)[:6]
    pictures = [sample_plane(known.domain, rgb, plane) for plane in planes]
    size = max(known.domain.inside.shape)

    def pixel(number: int, voxel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        point, u, v = planes[number]
        column = (voxel + 0.5 - point) @ u + size // 2
        row = size // 2 - (voxel + 0.5 - point) @ v
        return np.rint(row).astype(int), np.rint(column).astype(int)

    worst, pixels = 0.0, 0
    for one in range(6):
        for two in range(one + 1, 6):
            a, b = one // 2, two // 2
            if a == b:
                continue
            line = np.zeros((size, 3))
            line[:, a] = planes[one][0][a] - 0.5
            line[:, b] = planes[two][0][b] - 0.5
            line[:, 3 - a - b] = np.arange(size)
            first, second = pixel(one, line), pixel(two, line)
            seen = np.ones(size, bool)
            for place in (*first, *second):
                seen &= (place >= 0) & (place < size)
            first = (first[0][seen], first[1][seen])
            second = (second[0][seen], second[1][seen])
            both = pictures[one][1][first] & pictures[two][1][second]
            apart = np.abs(pictures[one][0][first] - pictures[two][0][second])[both]
            worst, pixels = max(worst, float(apart.max(initial=0.0))), pixels + int(both.sum())
    return worst if pixels else float("nan")


def _colors(slices: list[metrics.Slice]) -> np.ndarray:
    return np.concatenate([image[mask] for image, mask in slices])


def judge(
    rgb: np.ndarray, known: KnownInterior, other: KnownInterior | Sequence[KnownInterior]
) -> dict[str, Any]:
    """Judge a texture against the truth, beside the floor of other draws of the class.

    To judge several textures of one solid make one :class:`Judge`: it keeps the floor.

    Args:
        rgb: Colours [X, Y, Z, 3] in 0..1 on the grid of ``known``.
        known: The solid.
        other: Another draw of its class (another seed), or several.

    Returns:
        On twelve held-out planes: ``patch`` and ``patch_coarse`` (sliced Wasserstein distance of
        7 x 7 Lab patches, full and half size), ``hist`` (Lab quantile distance), ``coherence`` and
        ``coverage`` (distance to the nearest patch, both ways), ``sharp`` (gradient energy over
        the truth's). In the volume: ``profile`` (depth profile error over the colour range),
        ``neighbour`` (change between slices across x, y, z over the truth's), ``radial`` (change
        along the depth over change across it, over the truth's). ``floor``: the same of the other
        draws; ``ratio``: figure over floor.
    """
    return Judge(known, [other] if isinstance(other, KnownInterior) else other)(rgb)
