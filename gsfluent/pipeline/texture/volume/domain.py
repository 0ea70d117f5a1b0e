"""The region to be textured and the volume that texturing makes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import numpy as np

from gsfluent.data import Solid
from gsfluent.errors import InputError
from gsfluent.spatial.voxels import nearest_empty

Options = TypeVar("Options")

SHELL = 1.6
"""Depth [voxels] down to which the colour is that of the surface splats."""
BLEND = 3.0
"""Depth [voxels] at which the interior colour has fully taken over."""


@dataclass(frozen=True)
class InteriorDomain:
    """Voxels to be textured; everything in voxel units of one grid.

    Attributes:
        inside: Matter, bool [X, Y, Z].
        depth: Distance below the surface [voxels], float32 [X, Y, Z]; 0 outside.
        shell: Voxels whose colour the surface splats give, bool [X, Y, Z].
        skin: Colour of the nearest surface for every inside voxel, float32 [X, Y, Z, 3].
        axis: Unit vector [3] of the object's own axis (up), for layered and grained materials.
        voxel: Edge of a voxel, world units.
        origin: Corner of voxel (0, 0, 0), world units [3].
    """

    inside: np.ndarray
    depth: np.ndarray
    shell: np.ndarray
    skin: np.ndarray
    axis: np.ndarray
    voxel: float
    origin: np.ndarray

    @property
    def max_depth(self) -> float:
        """Largest depth [voxels]."""
        return float(self.depth.max())

    @staticmethod
    def from_solid(solid: Solid, axis: np.ndarray | None = None) -> InteriorDomain:
        """Build the domain of a filled solid.

        Args:
            solid: The solid.
            axis: The object's own axis in world coordinates; None takes scene "up", else +z.
        """
        # brings the compiled renderer with it, which texturing itself does without
        from gsfluent.pipeline.solid.colors import skin_colors

        inside = solid.occupancy.cpu().numpy()
        depth = (solid.depth.float().cpu().numpy() / solid.voxel).astype(np.float32)
        shell = inside & (depth <= SHELL)
        origin = np.asarray([float(v) for v in solid.origin])
        index = np.argwhere(shell)
        color = np.zeros((*inside.shape, 3), np.float32)
        points = origin + (index + 0.5) * solid.voxel
        color[shell] = skin_colors(solid, points)
        skin = color[nearest_in(shell)]
        if axis is None and solid.frame is not None:
            # rows of the rotation are the scene axes seen from the world
            axis = solid.frame.rotation.cpu().numpy()[2]
        direction = np.array([0.0, 0.0, 1.0]) if axis is None else np.asarray(axis, dtype=float)
        direction = direction / max(float(np.linalg.norm(direction)), 1e-12)
        return InteriorDomain(inside, depth, shell, skin, direction, solid.voxel, origin)


@dataclass(frozen=True)
class InteriorTexture:
    """Colour of every inside voxel.

    Attributes:
        rgb: float32 [X, Y, Z, 3] in 0..1; undefined outside.
        labels: int32 [X, Y, Z]; 0 is the matrix, k > 0 the k-th inclusion (seed, stone, ...).
        report: What the method measured.
    """

    rgb: np.ndarray
    labels: np.ndarray
    report: dict[str, Any] = field(default_factory=dict)

    def sample(self, position: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """Trilinear colour [M, 3] at positions [M, 3] in voxel units, from inside voxels only."""
        base = np.floor(position - 0.5).astype(int)
        fraction = position - 0.5 - base
        total = np.zeros((position.shape[0], 3))
        weight = np.zeros(position.shape[0])
        size = np.array(inside.shape)
        for corner in np.ndindex(2, 2, 2):
            index = base + corner
            share = np.where(np.array(corner, bool), fraction, 1 - fraction).prod(1)
            share = share * ((index >= 0) & (index < size)).all(1)
            clipped = tuple(np.clip(index, 0, size - 1).T)
            share = share * inside[clipped]
            total += share[:, None] * self.rgb[clipped]
            weight += share
        return (total / np.maximum(weight, 1e-9)[:, None]).astype(np.float32)


def axis_frame(axis: np.ndarray) -> np.ndarray:
    """Rotation [3, 3] that turns ``axis`` onto +z."""
    z = axis / max(float(np.linalg.norm(axis)), 1e-12)
    helper = np.array([1.0, 0, 0]) if abs(z[0]) < 0.8 else np.array([0, 1.0, 0])
    x = helper - (helper @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def options_of(kind: type[Options], name: str, value: Any) -> Options:
    """Options of a stage from themselves, a mapping as a shot file gives it, or None: defaults.

    Raises:
        InputError: A name is unknown, or a value is wrong.
    """
    if isinstance(value, kind):
        return value
    known = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    wrong = sorted(set(value or {}) - known)
    if wrong:
        hint = f"known are {', '.join(sorted(known))}"
        raise InputError(f"texture: {name} knows no {', '.join(wrong)}", hint)
    return kind(**(value or {}))


def nearest_in(mask: np.ndarray) -> tuple[np.ndarray, ...]:
    """Index of the nearest cell of a mask for every cell; at least one must be in it."""
    return tuple(nearest_empty(~mask)[1])


def block_mean(field: np.ndarray, factor: int, dimensions: int) -> np.ndarray:
    """Means, float32, over blocks of ``factor`` along the first axes; the rest is zero."""
    pads = [(0, -s % factor) for s in field.shape[:dimensions]]
    padded = np.pad(field.astype(np.float32), pads + [(0, 0)] * (field.ndim - dimensions))
    split = [n for s in padded.shape[:dimensions] for n in (s // factor, factor)]
    blocks = padded.reshape(*split, *padded.shape[dimensions:])
    return np.asarray(blocks.mean(tuple(range(1, 2 * dimensions, 2))))


def gradient(field: np.ndarray) -> np.ndarray:
    """Gradient [D, ...] of a field [...]; 0 along axes of a single cell."""
    parts = [
        np.gradient(field, axis=k) if field.shape[k] > 1 else np.zeros_like(field)
        for k in range(field.ndim)
    ]
    return np.stack(parts)


def smoothstep(x: np.ndarray) -> np.ndarray:
    """Cubic step from 0 at x <= 0 to 1 at x >= 1."""
    t = np.clip(x, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend_skin(domain: InteriorDomain, rgb: np.ndarray) -> np.ndarray:
    """Fade from the surface colour to the interior colour over the outermost voxels.

    Without it the skin reads as a sticker on the cut face. A wall of a few voxels has an inside,
    too, and fades sooner.
    """
    end = min(BLEND, max(1.0, 0.6 * domain.max_depth))
    weight = smoothstep((domain.depth - 0.5) / (end - 0.5))[..., None]
    mixed = domain.skin * (1.0 - weight) + rgb * weight
    return np.where(domain.inside[..., None], mixed, 0.0).astype(np.float32)
