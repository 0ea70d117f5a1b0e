"""Solids whose inside is known: six classes of cut object, each seed another object of its class.

The colours come from the procedural presets, the shapes from here. A method is given what a user
has, the surface and a photograph or two of a cut (:meth:`KnownInterior.exemplars`), and is judged
on planes it has not seen (:mod:`gsfluent.lab.truth.interiors_judge`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from gsfluent.errors import InputError
from gsfluent.pipeline.texture.presets.procedural import procedural_texture
from gsfluent.pipeline.texture.volume.domain import SHELL, InteriorDomain

if TYPE_CHECKING:
    from gsfluent.data import Solid

MARGIN = 2.0
"""Empty voxels between the solid and the edge of its cube."""


@dataclass(frozen=True)
class KnownInterior:
    """One object of a class, with its true inside."""

    name: str  # class
    seed: int  # which object of the class
    domain: InteriorDomain  # what a method is given: voxels, depth, and the colours of the surface
    rgb: np.ndarray  # true colours, float32 [X, Y, Z, 3] in 0..1; zero outside
    labels: np.ndarray  # true inclusions (seeds), int32 [X, Y, Z]
    # keyword arguments of exemplar_texture that a user would choose for this material (guide,
    # directional)
    settings: dict[str, Any] = field(default_factory=dict)
    # slice axis ("x", "y", "z") to index of the photographed slice
    cuts: dict[str, int] = field(default_factory=dict)

    def exemplars(self) -> dict[str, np.ndarray]:
        """Photographs of the cuts, one pixel per voxel, as a person would take them.

        Returns:
            Slice axis to float32 [H, W, 4]; alpha is the silhouette. The pictures are upright
            (:func:`upright`): z is up in cuts across x and y, y is up in a cut across z.
        """
        pictures = {}
        for name, index in self.cuts.items():
            axis = "xyz".index(name)
            color = np.take(self.rgb, index, axis)
            alpha = np.take(self.domain.inside, index, axis)[..., None].astype(np.float32)
            pictures[name] = upright(np.concatenate([color, alpha], -1))
        return pictures

    def solid(self) -> Solid:
        """The object as the stages know it: a splat per voxel of the shell, nothing inside."""
        import torch

        from gsfluent.data import SURFACE, Gaussians, Solid

        domain = self.domain
        index = torch.from_numpy(np.argwhere(domain.shell))
        colors = torch.from_numpy(self.rgb[domain.shell])
        means = (index + 0.5).float() * domain.voxel
        scales = torch.full_like(means, 0.5 * domain.voxel)
        splats = Gaussians.from_colors(means, scales, colors, opacities=0.95, label=SURFACE)
        return Solid(
            gaussians=splats,
            occupancy=torch.from_numpy(domain.inside),
            depth=torch.from_numpy(domain.depth * np.float32(domain.voxel)),
            origin=torch.zeros(3),
            voxel=domain.voxel,
        )


def upright(plane: np.ndarray) -> np.ndarray:
    """Turn a slice [U, V, ...] of a volume (U before V among x, y, z) into a picture.

    Columns of the picture run along U; its rows run against V, so that V is up.
    """
    return np.ascontiguousarray(np.swapaxes(plane, 0, 1)[::-1])


Shape = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""Implicit function of points [n, 3] in -1..1, negative inside, jittered by the generator."""


def _ellipsoid(radii: tuple[float, float, float], spread: float) -> Shape:
    def shape(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        own = np.array(radii) * (1 - spread * rng.random(3))
        return _norm(points / own) - 1.0

    return shape


def _bumpy_ball(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A ball with six broad bumps."""
    radius = _norm(points)
    direction = points / np.maximum(radius, 1e-6)[:, None]
    bump = np.zeros(len(points))
    for _ in range(6):
        center = rng.standard_normal(3)
        center /= np.linalg.norm(center)
        bump += rng.uniform(0.04, 0.10) * np.exp(4.0 * (direction @ center - 1.0))
    return radius - 0.80 - bump


def _loaf(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A tin loaf, long in x: flat bottom and sides below, a dome on top."""
    length, width, height = np.array([0.98, 0.66, 0.62]) * (1 - 0.06 * rng.random(3))
    x, y, z = (points / [length, width, height]).T
    dome = np.where(z > 0, z * 0.95, z)
    power = np.where(z > 0, 2.4, 6.0)
    body = (np.abs(x) ** 6 + np.abs(y) ** power + np.abs(dome) ** power) ** (1.0 / power)
    return body - 1.0


def _block(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A sawn block with rounded edges, its grain along z."""
    half = np.array([0.66, 0.62, 0.96]) * (1 - 0.08 * rng.random(3))
    rounding = 0.12
    q = np.abs(points) - (half - rounding)
    return _norm(np.maximum(q, 0)) + np.minimum(q.max(1), 0) - rounding


def _disc(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A round cake, half as high as wide."""
    radius, half = np.array([0.95, 0.50]) * (1 - 0.06 * rng.random(2))
    rounding = 0.08
    q = np.stack([np.hypot(points[:, 0], points[:, 1]) - radius, np.abs(points[:, 2]) - half], 1)
    q += rounding
    return _norm(np.maximum(q, 0)) + np.minimum(q.max(1), 0) - rounding


def _norm(vectors: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.linalg.norm(vectors, axis=1)
    return result


@dataclass(frozen=True)
class _Class:
    shape: Shape
    cuts: str
    settings: dict[str, Any]


_CLASSES = {
    "watermelon": _Class(_ellipsoid((0.90, 0.88, 0.98), 0.05), "x", {}),
    # the segments stand around the axis: one cut across it shows them all
    "orange": _Class(_ellipsoid((0.97, 0.97, 0.94), 0.03), "z", {"guide": "axis"}),
    "bread": _Class(_loaf, "x", {}),
    "wood": _Class(_block, "xyz", {"guide": "axis", "directional": True}),
    "marble": _Class(_bumpy_ball, "x", {"guide": "none"}),
    "cake": _Class(_disc, "xy", {"directional": True}),
}

KNOWN_INTERIORS = tuple(_CLASSES)
"""Names that :func:`known_interior` takes."""


def known_interior(name: str, size: int = 64, seed: int = 0) -> KnownInterior:
    """Make one object of a class.

    Args:
        name: One of :data:`KNOWN_INTERIORS`.
        size: Edge of the cube of voxels, at least 24 (48 to 256 are sensible).
        seed: Which object: another seed has another shape and another inside of the same kind.

    Returns:
        The object.

    Raises:
        InputError: Unknown name, or fewer than 24 voxels.
    """
    if name not in _CLASSES:
        raise InputError(
            f"known interior must be one of {', '.join(KNOWN_INTERIORS)}, got {name!r}",
            hint="choose one of these",
        )
    if size < 24:
        raise InputError(f"known interior: {size} voxels are too few", hint="use at least 24")
    from scipy import ndimage

    kind = _CLASSES[name]
    inside = _voxels(kind.shape, size, KNOWN_INTERIORS.index(name), seed)
    distance = ndimage.distance_transform_edt(inside)
    depth = np.where(inside, distance - 0.5, 0.0).astype(np.float32)
    shell = inside & (depth <= SHELL)
    empty = np.zeros((size, size, size, 3), np.float32)
    up = np.array([0.0, 0.0, 1.0])
    bare = InteriorDomain(inside, depth, shell, empty, up, 1.0 / size, np.zeros(3))
    truth = procedural_texture(bare, name, seed)
    nearest = ndimage.distance_transform_edt(~shell, return_distances=False, return_indices=True)
    skin = truth.rgb[tuple(nearest)]
    domain = InteriorDomain(inside, depth, shell, skin, up, 1.0 / size, np.zeros(3))
    middle = {cut: size // 2 for cut in kind.cuts}
    return KnownInterior(name, seed, domain, truth.rgb, truth.labels, dict(kind.settings), middle)


def _voxels(shape: Shape, size: int, place: int, seed: int) -> np.ndarray:
    """Occupied voxels, bool [size, size, size], slab by slab."""
    half = size / 2
    axis = ((np.arange(size) + 0.5 - half) / (half - MARGIN)).astype(np.float32)
    y, z = (v.reshape(-1) for v in np.meshgrid(axis, axis, indexing="ij"))
    inside = np.zeros((size, size, size), bool)
    for k, x in enumerate(axis):
        # a fresh generator for every slab: the same jitter everywhere
        rng = np.random.default_rng([place, seed])
        points = np.stack([np.full_like(y, x), y, z], 1)
        inside[k] = (shape(points, rng) < 0).reshape(size, size)
    return inside
