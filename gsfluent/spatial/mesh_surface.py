"""Points on the coloured surface of a mesh file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.colors import linear_to_srgb, srgb_to_linear
from gsfluent.errors import InputError
from gsfluent.spatial.mesh_file import in_metres, picture_of, read_parts

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

GREY = 0.6
"""Colour of a surface that has none."""
R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of an additive sequence that keeps points of a plane apart (Roberts 2018): the inverse of
the plastic number, the root of x^3 = x + 1, and its square."""


@dataclasses.dataclass(frozen=True)
class SurfacePoints:
    """Points spread evenly over a coloured surface."""

    points: Array  # [N, 3], units of the file
    normals: Array  # outward unit normals, smooth where the file has smooth ones [N, 3]
    colors: Array  # RGB in 0..1 [N, 3]
    area: float  # of the surface [square units of the file]
    colored: bool  # whether the file has any colours


def surface_points(path: str | Path, count: int, *, seed: int = 0) -> SurfacePoints:
    """Spread points over the surface of a mesh file, with its colours.

    A triangle gets points in proportion to its area; they are stratified along the surface, so that
    none lie much closer together than the others. Colours come from the texture (bilinear), the
    vertices, the faces or the material, in that order; grey without.

    Args:
        path: Any file that trimesh reads.
        count: How many points, about.
        seed: Seed of their places.

    Raises:
        InputError: The file cannot be read, or holds no triangles.
    """
    parts = read_parts(path)
    linear = in_metres(path)  # glTF keeps all colours but those of pictures linear
    areas = [part.area_faces for part in parts]
    total = float(sum(a.sum() for a in areas))
    if not total > 0.0:
        raise InputError(f"{path}: its triangles have no area", "give a mesh with a surface")
    rng = np.random.default_rng(seed)
    made = []
    for part, area in zip(parts, areas, strict=True):
        share = float(area.sum()) / total
        if share > 0.0:
            made.append(_spread(part, area, max(1, round(count * share)), linear, rng))
    points, normals, colors = (np.concatenate([one[i] for one in made]) for i in range(3))
    return SurfacePoints(points, normals, colors, total, any(one[3] for one in made))


def _spread(
    part: trimesh.Trimesh, area: Array, count: int, linear: bool, rng: np.random.Generator
) -> tuple[Array, Array, Array, bool]:
    """Points, normals and colours of one mesh, and whether it has colours."""
    # equal steps along the summed area: every triangle has its share to within one point
    ends = np.cumsum(area)
    steps = (np.arange(count) + rng.random(count)) / count * ends[-1]
    face = np.minimum(np.searchsorted(ends, steps), len(area) - 1)
    # within a triangle points are kept apart; folding keeps them inside
    order = np.arange(count)
    u = (0.5 + R2[0] * order + rng.random()) % 1.0
    v = (0.5 + R2[1] * order + rng.random()) % 1.0
    over = u + v > 1.0
    u[over], v[over] = 1.0 - u[over], 1.0 - v[over]
    weight = np.stack([1.0 - u - v, u, v], axis=1)
    corners = part.faces[face]

    def mixed(values: Any) -> Array:
        picked = np.asarray(values, dtype=np.float64)[corners]
        return np.asarray(np.einsum("nk,nkc->nc", weight, picked))

    flat = np.asarray(part.face_normals, dtype=np.float64)[face]
    smooth = mixed(part.vertex_normals)
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    # across a sharp edge a mean of its sides faces nowhere
    usable = (np.einsum("nc,nc->n", smooth, flat) > 0.7 * length[:, 0]) & (length[:, 0] > 0.0)
    normals = np.where(usable[:, None], smooth / np.maximum(length, 1e-12), flat)
    colors = _colors(part, face, mixed, linear)
    grey = np.full((count, 3), GREY)
    return mixed(part.vertices), normals, grey if colors is None else colors, colors is not None


def _colors(part: trimesh.Trimesh, face: Array, mixed: Any, linear: bool) -> Array | None:
    """RGB [N, 3] in 0..1 of points given by face and a mean over corners, or None."""
    visual: Any = part.visual
    if visual is None or not visual.defined:
        return None
    shown = linear_to_srgb if linear else np.asarray
    if visual.kind == "vertex":
        return np.asarray(shown(mixed(_unit(visual.vertex_colors))))
    if visual.kind == "face":
        return np.asarray(shown(_unit(visual.face_colors)[face]))
    material = getattr(visual, "material", None)
    picture = picture_of(part)
    if picture is not None and visual.uv is not None and len(visual.uv) == len(part.vertices):
        found = _looked_up(np.asarray(picture.convert("RGB")), mixed(visual.uv))
        factor = getattr(material, "baseColorFactor", None)
        if factor is None:
            return found
        return np.asarray(linear_to_srgb(srgb_to_linear(found) * _unit(factor)))
    painted = getattr(visual, "vertex_attributes", {}).get("color")
    if painted is not None and len(painted) == len(part.vertices):
        return np.asarray(shown(mixed(_unit(painted))))
    main = getattr(material, "main_color", None)
    if main is None:
        return None
    return np.broadcast_to(shown(_unit(main)), (len(face), 3)).copy()


def _unit(color: Any) -> Array:
    """RGB in 0..1 of colours in bytes or in 0..1."""
    values = np.asarray(color)
    scale = 255.0 if values.dtype.kind in "iu" else 1.0
    return np.asarray(values[..., :3], dtype=np.float64) / scale


def _looked_up(picture: NDArray[np.uint8], uv: Array) -> Array:
    """Bilinear samples of a texture [H, W, 3] that repeats, v up, in 0..1 [N, 3]."""
    height, width = picture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - left)[:, None], (y - top)[:, None]

    def texel(i: int, j: int) -> Array:
        return picture[(top + j) % height, (left + i) % width].astype(np.float64)

    upper = (1.0 - a) * texel(0, 0) + a * texel(1, 0)
    lower = (1.0 - a) * texel(0, 1) + a * texel(1, 1)
    return np.asarray(((1.0 - b) * upper + b * lower) / 255.0)
