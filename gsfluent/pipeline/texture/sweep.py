"""A photographed cut swept about the object's axis.

A cut across the middle of an apple or an orange shows a star or segments that depth alone does not
know about. Every voxel is given a place in the photograph: the same azimuth about the axis, and the
same share of the way from the axis to the surface in its plane. Every cut across the axis then
repeats the photograph, as wide as the solid is there: segments and rings run through to the ends.
A core (carpels) is a spindle instead: it is as wide as photographed in the middle plane and closes
above and below, so that a cut along the axis shows the almonds of an apple's core.

A photograph cut along the axis is turned about it: the same elevation above the middle, the same
share of the way from the core to the surface; the right half of the photograph serves one side of
the object and the left half the other, blended in between.
"""

from __future__ import annotations

import numpy as np

from gsfluent._lazy import ndimage
from gsfluent.errors import check_choice
from gsfluent.pipeline.texture.volume.domain import axis_frame
from gsfluent.pipeline.texture.volume.noise import value_noise
from gsfluent.spatial.voxels import distance_transform

CUTS = ("across", "along")
"""How a photograph was cut, relative to the object's axis."""

_TURNS, _STEPS, _LEVELS = 72, 36, 48
_SPINDLE = 1.5  # height of a core over its width


class Sweep:
    """Places of voxels in a photograph.

    Args:
        inside: Voxels, bool [X, Y, Z].
        axis: The object's axis [3].
        cut: ``across`` or ``along`` it. Cut along, the photograph's upper edge is where the axis
            points.
        core: Radius of a core relative to the photograph's, or None when the structure is none;
            the spindle is one and a half times as high as wide.

    Attributes:
        way: Share of the way from the axis (cut along: the core) to the surface [n], 0..1.
        tip: How far a voxel is towards the tips of the core [n], 0 middle, 1 tip.

    Raises:
        InputError: Unknown cut.
    """

    def __init__(
        self,
        inside: np.ndarray,
        axis: np.ndarray,
        cut: str = "across",
        core: float | None = None,
    ) -> None:
        hint = "across: the photograph was cut across the axis; along: through it"
        check_choice("texture: cut", cut, CUTS, hint)
        self.cut, self.inside = cut, inside
        index = np.argwhere(inside)
        frame = axis_frame(axis)
        middle = _core(inside, index)
        local = (index - middle) @ frame.T
        self.azimuth = np.arctan2(local[:, 1], local[:, 0])
        flat, height = np.hypot(local[:, 0], local[:, 1]), local[:, 2]
        self.elevation = np.arctan2(height, flat)
        self.tip = np.zeros(len(index))
        if cut == "along":
            rise = (np.arange(_STEPS) + 0.5) / _STEPS * np.pi - np.pi / 2
            rays = _rays(frame, rise)
            reach = _reach(inside, np.repeat(middle[None], len(rays), 0), rays)
            row = (self.elevation + np.pi / 2) / np.pi * _STEPS - 0.5
            far = _read(_smooth(reach.reshape(_STEPS, _TURNS)), row, self.azimuth)
            self.way = np.clip(np.linalg.norm(local, axis=1) / far, 0.0, 1.0)
            return
        low, high = float(height.min()), float(height.max())
        levels = np.zeros(1) if core is not None else np.linspace(low + 0.5, high - 0.5, _LEVELS)
        start = np.repeat(middle + levels[:, None] * frame[2], _TURNS, 0)
        rays = np.tile(_rays(frame, np.zeros(1)), (len(levels), 1))
        table = _smooth(_reach(inside, start, rays).reshape(len(levels), _TURNS))
        row = (height - low) / max(high - low, 1e-6) * (len(levels) - 1)
        far = _read(table, row, self.azimuth)
        if core is not None:
            room = _reach(inside, np.stack([middle, middle]), np.stack([frame[2], -frame[2]]))
            half = min(_SPINDLE * core * float(table.mean()), 0.75 * float(room.min()))
            self.tip = np.clip(np.abs(height) / max(half, 1.0), 0.0, 1.0)
            far = far * np.maximum(1.0 - self.tip**2, 1e-2)
        # nothing grows dead straight: away from the middle plane the structure wanders a little
        away = np.abs(height) / max(-low, high)
        points = (local / max(-low, high)).astype(np.float32)
        far = far * (1.0 + 0.25 * away * value_noise(points, 3.0, 1))
        self.azimuth = self.azimuth + 0.5 * away * value_noise(points, 2.0, 2)
        self.way = np.clip(flat / far, 0.0, 1.0)

    def colors(self, image: np.ndarray, mask: np.ndarray, center: np.ndarray) -> np.ndarray:
        """Values float32 [n, C] of a picture [H, W, C] with its core at ``center``."""
        edge = outline(mask, center)
        if self.cut == "across":
            return self._look(image, edge, center, self.azimuth)
        right = self._look(image, edge, center, self.elevation)
        left = self._look(image, edge, center, np.pi - self.elevation)
        # a narrow seam: half-way between two halves that differ there is only a blur of both
        share = np.clip(0.5 + 1.5 * np.cos(self.azimuth), 0.0, 1.0)[:, None]
        return share * right + (1.0 - share) * left

    def _look(
        self, image: np.ndarray, edge: np.ndarray, center: np.ndarray, angle: np.ndarray
    ) -> np.ndarray:
        turn = np.mod(angle / (2 * np.pi) * len(edge), len(edge))
        radius = self.way * np.interp(turn, np.arange(len(edge) + 1), np.append(edge, edge[0]))
        # image rows run down, the second object axis up
        place = [center[0] - radius * np.sin(angle), center[1] + radius * np.cos(angle)]
        channels = [
            ndimage.map_coordinates(image[..., c], place, order=1, mode="nearest")
            for c in range(image.shape[2])
        ]
        return np.stack(channels, 1).astype(np.float32)


def outline(mask: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Distance from a point to the edge of a mask at equal steps of azimuth [pixels].

    Azimuth 0 points along the columns, a quarter turn up the picture.
    """
    angle = 2 * np.pi * np.arange(360) / 360
    reach = float(np.hypot(*mask.shape))
    radius = np.arange(0.0, reach, 0.5)
    place = [
        center[0] - np.sin(angle)[:, None] * radius,
        center[1] + np.cos(angle)[:, None] * radius,
    ]
    hit = ndimage.map_coordinates(mask.astype(np.float32), place, order=1, mode="constant") > 0.5
    last = hit.shape[1] - 1 - hit[:, ::-1].argmax(1)
    far = np.where(hit.any(1), radius[last], 1.0)
    return np.asarray(ndimage.gaussian_filter1d(np.maximum(far, 1.0), 3.0, mode="wrap"))


def _core(inside: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The centroid, or the deepest voxel when the centroid is not well inside (a ring, a bow)."""
    depth = distance_transform(inside)
    middle = index.mean(0)
    if depth[tuple(np.rint(middle).astype(int))] > 0.4 * depth.max():
        return np.asarray(middle)
    return np.asarray(np.unravel_index(int(depth.argmax()), depth.shape), dtype=float)


def _rays(frame: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Unit vectors of all azimuths at each elevation [len(rise) * _TURNS, 3]."""
    turn = 2 * np.pi * np.arange(_TURNS) / _TURNS
    e, a = (v.reshape(-1) for v in np.meshgrid(rise, turn, indexing="ij"))
    local = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    return np.asarray(local @ frame)


def _reach(inside: np.ndarray, start: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Way from each start along its ray to the first point outside [voxels]."""
    steps = np.arange(0.0, float(np.linalg.norm(inside.shape)), 0.5)
    solid = inside.astype(np.float32)
    far = np.zeros(len(rays))
    going = np.ones(len(rays), bool)
    for step in steps:
        place = (start[going] + step * rays[going]).T
        still = ndimage.map_coordinates(solid, place, order=1, mode="constant") > 0.5
        rows = np.flatnonzero(going)
        far[rows[still]] = step + 0.5
        going[rows[~still]] = False
        if not going.any():
            break
    return np.maximum(far, 1.0)


def _smooth(table: np.ndarray) -> np.ndarray:
    return np.asarray(ndimage.gaussian_filter(table, (1.0, 1.0), mode=("nearest", "wrap")))


def _read(table: np.ndarray, row: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Values of a table [rows, _TURNS] at fractional rows and azimuths."""
    wrapped = np.concatenate([table, table[:, :1]], 1)
    turn = np.mod(azimuth / (2 * np.pi) * _TURNS, _TURNS)
    return np.asarray(ndimage.map_coordinates(wrapped, [row, turn], order=1, mode="nearest"))
