"""Triangle meshes in files: which files hold one, what belongs to them, and their coloured surface.

Read by trimesh: OBJ, GLB and glTF, STL, PLY and more.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.colors import linear_to_srgb, srgb_to_linear
from gsfluent.errors import InputError

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

ENDINGS = (".obj", ".stl", ".glb", ".gltf", ".off", ".vtk", ".dae", ".3mf")
"""File endings of meshes; a ``.ply`` is one when it has faces."""

GREY = 0.6
"""Colour of a surface that has none."""

_Y_UP = (".glb", ".gltf", ".obj", ".dae")
"""Formats whose files stand along +y: glTF and COLLADA by their specification, OBJ by custom."""


@dataclasses.dataclass(frozen=True)
class SurfacePoints:
    """Points spread evenly over a coloured surface."""

    points: Array  # [N, 3], units of the file
    normals: Array  # outward unit normals, smooth where the file has smooth ones [N, 3]
    colors: Array  # RGB in 0..1 [N, 3]
    area: float  # of the surface [square units of the file]
    colored: bool  # whether the file has any colours


def is_mesh(path: str | Path) -> bool:
    """Whether a file holds a triangle mesh rather than splats or points."""
    path = Path(path)
    if path.suffix.lower() in ENDINGS:
        return True
    if path.suffix.lower() != ".ply" or not os.path.isfile(path):
        return False
    with open(path, "rb") as stream:
        head = stream.read(4096).split(b"end_header")[0]
    found = re.search(rb"element\s+face\s+(\d+)", head)
    return found is not None and int(found.group(1)) > 0


def up_axes(path: str | Path) -> list[tuple[Array, bool]]:
    """Upward axes that a mesh file may mean, likeliest first, and whether its format says so."""
    suffix = Path(path).suffix.lower()
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    ordered = (y, z) if suffix in _Y_UP else (z, y)
    said = suffix in (".glb", ".gltf", ".dae")
    return [(ordered[0], said), (ordered[1], False)]


def in_metres(path: str | Path) -> bool:
    """Whether the format fixes the metre as its unit."""
    return Path(path).suffix.lower() in (".glb", ".gltf")


def mesh_files(path: str | Path) -> list[Path]:
    """The file and those it names that exist: buffers, materials, textures."""
    path = Path(path)
    found = [path]
    if path.suffix.lower() == ".gltf":
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            named = [*document.get("buffers", ()), *document.get("images", ())]
            found += [path.parent / item["uri"] for item in named if "uri" in item]
        except (OSError, ValueError, TypeError, AttributeError):
            return found  # whoever reads it says what is wrong
    elif path.suffix.lower() == ".obj":
        for name in _words(path, "mtllib"):
            library = path.parent / name
            found.append(library)
            pictures = [*_words(library, "map_Kd"), *_words(library, "map_Ka")]
            found += [library.parent / picture.split(" ")[-1] for picture in pictures]
    return [file for file in dict.fromkeys(found) if _is_file(file)]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a picture written out as text is no file name
        return False


def _words(path: Path, key: str) -> list[str]:
    """What stands behind a key word at the start of lines of a text file."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return [found.strip() for found in re.findall(rf"^\s*{key}\s+(.+)$", text, re.MULTILINE)]


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
    parts = _parts(Path(path))
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


def _parts(path: Path) -> list[trimesh.Trimesh]:
    """The meshes of a file where they stand in its scene."""
    import trimesh

    try:
        scene = trimesh.load_scene(str(path), process=False)
        parts = scene.dump()
    except Exception as error:  # readers of many formats, each with errors of its own
        raise InputError(
            f"{path}: cannot be read as a mesh ({error})",
            "give a file that trimesh reads: obj, glb, stl, ply",
        ) from error
    found = [p for p in parts if isinstance(p, trimesh.Trimesh) and len(p.faces)]
    if not found:
        raise InputError(f"{path}: holds no triangles", "give a triangle mesh")
    return found


def _spread(
    part: trimesh.Trimesh, area: Array, count: int, linear: bool, rng: np.random.Generator
) -> tuple[Array, Array, Array, bool]:
    """Points, normals and colours of one mesh, and whether it has colours."""
    # equal steps along the summed area: every triangle has its share to within one point
    ends = np.cumsum(area)
    steps = (np.arange(count) + rng.random(count)) / count * ends[-1]
    face = np.minimum(np.searchsorted(ends, steps), len(area) - 1)
    # Within a triangle an additive sequence of two irrational steps keeps points apart
    # (Roberts 2018, the R2 sequence); folding keeps it inside.
    order = np.arange(count)
    u = (0.5 + 0.7548776662466927 * order + rng.random()) % 1.0
    v = (0.5 + 0.5698402909980532 * order + rng.random()) % 1.0
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
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
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
