"""Triangle meshes in files: which files hold one, what belongs to them, and reading them.

Read by trimesh, after a look at what the file declares: trimesh believes it.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

ENDINGS = (".obj", ".stl", ".glb", ".gltf", ".off", ".vtk", ".dae", ".3mf")
"""File endings of meshes; a ``.ply`` is one when it has faces."""

_Y_UP = (".glb", ".gltf", ".obj", ".dae")
"""Formats whose files stand along +y: glTF and COLLADA by their specification, OBJ by custom."""

_FORMATS = "give a file that trimesh reads: obj, glb, stl, ply"


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
    from gsfluent.io.checked.files import is_file  # gsfluent.io asks this file what is a mesh

    path = Path(path)
    found = [path, *(path.parent / name for name in _named(path))]
    return [file for file in dict.fromkeys(found) if is_file(file)]


def _named(path: Path) -> Iterator[str]:
    """Names of the files that a mesh needs, relative to its folder; of a damaged one none."""
    if path.suffix.lower() in (".gltf", ".glb"):
        try:
            document = _gltf(path)
            items = [*document.get("buffers", ()), *document.get("images", ())]
            uris = [item["uri"] for item in items if "uri" in item]
        except (InputError, TypeError, AttributeError, ValueError):
            return  # whoever reads it says what is wrong
        yield from (uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:"))
    elif path.suffix.lower() == ".obj":
        for name in _words(path, "mtllib"):
            yield name
            folder = Path(name).parent
            for key in ("map_Kd", "map_Ka"):
                pictures = _words(path.parent / name, key)
                yield from (str(folder / picture.split(" ")[-1]) for picture in pictures)


def _words(path: Path, key: str) -> list[str]:
    """What stands behind a key word at the start of lines of a text file."""
    from gsfluent.io.checked.files import read_bytes

    try:
        text = read_bytes(path).decode("utf-8", errors="replace")
    except InputError:
        return []
    return [found.strip() for found in re.findall(rf"^\s*{key}\s+(.+)$", text, re.MULTILINE)]


def _gltf(path: Path) -> Any:
    """The JSON of a glTF file, or of the first chunk of a binary one.

    Raises:
        InputError: It cannot be read.
    """
    from gsfluent.io.checked.files import parse_json, read_bytes, read_json

    if path.suffix.lower() == ".gltf":
        return read_json(path)
    data = read_bytes(path)
    size = struct.unpack_from("<I", data, 12)[0] if len(data) >= 20 else 0
    try:
        return parse_json(data[20 : 20 + size].decode("utf-8"), path)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no glTF file ({error})", "export it again") from error


_COMPONENTS = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
"""Bytes of glTF's component types."""
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def _check_declared(path: Path) -> None:
    """Compare what a file declares, and what it names, with the limits.

    Raises:
        InputError: Not a file, of another format, too large, or it names files elsewhere.
    """
    from gsfluent.io.checked.files import regular_file
    from gsfluent.io.checked.inside import inside
    from gsfluent.io.checked.limits import unpacked_limit, within

    size = regular_file(path)
    if path.suffix.lower() not in (*ENDINGS, ".ply"):
        raise InputError(f"{path}: not a mesh by its ending", _FORMATS)
    for name in _named(path):
        place = inside(path.parent, name, path)
        if os.path.exists(place):  # and is no pipe
            size += regular_file(place)
    most = unpacked_limit(size)
    within("unpacked_bytes", size, path, most)
    if path.suffix.lower() in (".gltf", ".glb"):
        try:
            counts = [
                int(a["count"]) * _COMPONENTS[a["componentType"]] * _WIDTHS[a["type"]]
                for a in _gltf(path).get("accessors", ())
            ]
        except (TypeError, KeyError, ValueError, OverflowError, AttributeError) as error:
            raise InputError(f"{path}: its accessors are damaged ({error!r})", _FORMATS) from error
        within("unpacked_bytes", sum(map(abs, counts)), path, most)


def read_parts(path: str | Path) -> list[trimesh.Trimesh]:
    """The meshes of a file where they stand in its scene, unprocessed.

    Raises:
        InputError: The file cannot be read, is larger than allowed, names files outside its
            folder, holds no triangles, or what it holds is not finite.
    """
    import trimesh

    from gsfluent.io.checked.pictures import check_pixels

    path = Path(path)
    _check_declared(path)
    try:
        scene = trimesh.load_scene(str(path), resolver=_beside(path), process=False)
        parts = [p for p in scene.dump() if isinstance(p, trimesh.Trimesh) and len(p.faces)]
        for part in parts:
            picture = picture_of(part)
            if picture is not None:
                check_pixels(picture.width, picture.height, path)
                picture.load()
            glued = getattr(part.visual, "uv", None)
            numbers = [part.vertices, part.area, *([] if glued is None else [glued])]
            if not all(np.isfinite(one).all() for one in numbers):
                raise ValueError("a corner or a texture coordinate that is not finite")
            if glued is not None and (np.ndim(glued) != 2 or np.shape(glued)[1] < 2):
                raise ValueError("texture coordinates of one number")
    except InputError:
        raise
    except Exception as error:  # readers of many formats, each with errors of its own
        raise InputError(f"{path}: cannot be read as a mesh ({error})", _FORMATS) from error
    if not parts:
        raise InputError(f"{path}: holds no triangles", _without_triangles(path))
    return parts


def _without_triangles(path: Path) -> str:
    """What to do about a mesh file that holds none."""
    with open(path, "rb") as stream:
        head = stream.read(4)
    if not head:
        return "the file is empty; copy or export it again"
    if head[:3] == b"ply" and path.suffix.lower() != ".ply":
        return f"it is a PLY file by its first line; rename it {path.stem}.ply"
    return "give a triangle mesh"


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read a file as one triangle mesh, equal vertices merged.

    Raises:
        InputError: As :func:`read_parts`.
    """
    import trimesh

    parts = read_parts(path)
    for part in parts:
        part.process()
    mesh: Any = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # seams of textures are no openings
    whole: trimesh.Trimesh = mesh
    return whole


def _beside(path: str | Path) -> Any:
    """What finds files for trimesh: anywhere, for the names have been looked at."""
    from trimesh.resolvers import FilePathResolver

    resolver = FilePathResolver(str(path))
    resolver.allow_anywhere = True
    return resolver


def picture_of(part: trimesh.Trimesh) -> Any:
    """The texture of a mesh as a picture of Pillow, or None."""
    material = getattr(part.visual, "material", None)
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
