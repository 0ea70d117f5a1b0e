"""Fragments as closed triangle meshes: one watertight, coloured surface per piece and frame.

The matter of a piece is blurred to a density, and its surface is the level that encloses just the
volume of its points (marching cubes, Lewiner et al. 2003).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.colors import srgb_to_linear
from gsfluent.data import Gaussians
from gsfluent.errors import InputError, need
from gsfluent.export.frames import Moment, upright
from gsfluent.export.job import Job, span
from gsfluent.export.points import deposit
from gsfluent.io import atomic_path
from gsfluent.pipeline.matter.debris import REACH, clinging
from gsfluent.pipeline.solid.colors import surface_colors

if TYPE_CHECKING:
    import trimesh

FORMATS = ("ply", "obj", "glb")
DEBRIS = -1

_CELL = 0.5  # point spacings: edge of the grid's cells
BLUR = 1.0
"""Point spacings over which the matter of fragments is blurred: below, the points show as bumps;
above, edges go round."""

_DEBRIS_BLUR = 0.75  # share of it for debris: parts of a few points each would melt together
_APART = 2.0  # point spacings between heaps whose surfaces do not meet
_REACHES = 3.0  # blurs around the matter that are looked at
_NEAR = 1e-4  # a grid value this near to the level would make triangles without area
_FINE_GRID = 2_000_000  # cells above which a volume is counted well enough cell by cell
_CLOSE = 0.005  # relative error of the volume that needs no better level
_TRIES = 6


@dataclass(frozen=True, eq=False)
class Piece:
    """The surface of one fragment in one frame."""

    fragment: int  # Its number, -1 for all debris together
    vertices: NDArray[np.float64]  # [V, 3] in metres
    faces: NDArray[np.int64]  # [F, 3], normals out
    colors: NDArray[np.float32]  # [V, 3] in 0..1, display values
    volume: float  # Volume of the points that make it up [m^3]

    @property
    def name(self) -> str:
        """Identifier of the piece, the same in every frame."""
        return "debris" if self.fragment == DEBRIS else f"fragment_{self.fragment}"

    def mesh(self, *, linear: bool = False) -> trimesh.Trimesh:
        """As a mesh: display colours and the property ``fragment``, or colours as linear light."""
        import trimesh

        rgba = np.full((len(self.vertices), 4), 255, np.uint8)
        rgba[:, :3] = np.round((srgb_to_linear(self.colors) if linear else self.colors) * 255.0)
        number = np.full(len(self.vertices), self.fragment, np.int32)
        return trimesh.Trimesh(
            self.vertices,
            self.faces,
            vertex_colors=rgba,
            vertex_attributes={} if linear else {"fragment": number},
            process=False,
        )


def meshes(job: Job) -> str:
    """``meshes/frame_0001.ply`` (or ``.obj``, ``.glb``): every fragment as a closed surface.

    Raises:
        InputError: scikit-image is not installed, another ending, or no material points.
    """
    ending = job.options.mesh_ending
    if ending not in FORMATS:
        raise InputError(f"--mesh-ending {ending}", f"choose from {', '.join(FORMATS)}")
    if not 0.5 <= job.options.mesh_blur <= 5.0:
        raise InputError(f"--mesh-blur {job.options.mesh_blur:g}", "give 0.5 to 5 point spacings")
    need(
        "skimage.measure", "mesh", "meshes: a surface"
    )  # missing is better said before the first frame

    def write(path: Path, moment: Moment) -> None:
        pieces = fragment_meshes(moment, job.options.mesh_blur)
        if ending == "glb":
            turn = upright("y").rotation.numpy()  # by the format's definition
            pieces = (replace(piece, vertices=piece.vertices @ turn.T) for piece in pieces)
        save_pieces(path, list(pieces))

    if ending == "glb":
        job = replace(job, sequence=job.sequence.turned("z"))
    return span("meshes", job.write_each("meshes", "meshes", f"frame_{{:04d}}.{ending}", write))


def save_pieces(path: Path, pieces: list[Piece]) -> None:
    """Write the surfaces of one frame into one file, atomically.

    A ``.ply`` is one mesh with the property ``fragment`` per vertex; the others hold one object per
    fragment.

    Raises:
        InputError: No piece.
        RunError: The disk is full.
    """
    import trimesh

    if not pieces:
        raise InputError(
            f"{path}: no matter to draw a surface around", "export a run that has some"
        )
    kind = path.suffix.lower().lstrip(".")
    parts = {piece.name: piece.mesh(linear=kind == "glb") for piece in pieces}  # glTF is linear
    with atomic_path(path) as part:
        if kind == "ply":
            trimesh.util.concatenate(list(parts.values())).export(part, file_type="ply")
        elif kind == "glb":
            scene = trimesh.Scene()
            for name, mesh in parts.items():
                scene.add_geometry(mesh, node_name=name, geom_name=name)
            scene.export(part, file_type="glb")
        else:
            part.write_text(_obj(pieces), encoding="ascii")


def _obj(pieces: list[Piece]) -> str:
    """Wavefront OBJ with one object per piece and colours behind the coordinates."""
    lines, first = ["# gsfluent"], 1
    for piece in pieces:
        lines.append(f"o {piece.name}")
        for (x, y, z), (r, g, b) in zip(piece.vertices, piece.colors, strict=True):
            lines.append(f"v {x:.7g} {y:.7g} {z:.7g} {r:.4f} {g:.4f} {b:.4f}")
        lines += [f"f {a} {b} {c}" for a, b, c in (piece.faces + first).tolist()]
        first += len(piece.vertices)
    return "\n".join(lines) + "\n"


def fragment_meshes(moment: Moment, blur: float = BLUR) -> Iterator[Piece]:
    """Surfaces of the pieces of a frame, in the order of their numbers, debris first.

    Broken points belong to the piece they hang on, through other broken points if need be; what
    flies alone is debris.

    Args:
        moment: The frame.
        blur: Point spacings over which fragments are smoothed.

    Raises:
        InputError: scikit-image is not installed.
    """
    saved = moment.saved
    where = saved.positions.double().cpu().numpy()
    if len(where) == 0:
        return
    volumes = saved.volumes.double().cpu().numpy()
    spacing = float(np.cbrt(np.median(volumes)))
    piece = clinging(where, saved.fragments.cpu().numpy().astype(np.int64), REACH * spacing)
    anchor = saved.anchor.cpu().numpy()
    splats = np.where(anchor >= 0, piece[np.maximum(anchor, 0)], DEBRIS - 1)
    for number in np.unique(piece).tolist():
        mine = piece == number
        width = blur * (_DEBRIS_BLUR if number == DEBRIS else 1.0)
        vertices, faces = surface(where[mine], volumes[mine], spacing, width)
        rows = np.flatnonzero(splats == number)
        colors = _colors(moment.gaussians, rows, vertices, _CELL * spacing)
        yield Piece(number, vertices, faces, colors, float(volumes[mine].sum()))


def surface(
    where: NDArray[np.float64], volumes: NDArray[np.float64], spacing: float, blur: float = BLUR
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The closed surface around points that encloses their volume.

    Heaps that lie apart get surfaces of their own, each of its own volume; a point alone is a ball.

    Args:
        where: [P, 3] in metres.
        volumes: [P] in cubic metres.
        spacing: Distance of neighbouring points in full matter [m].
        blur: Standard deviation of the smoothing [spacings].

    Returns:
        Vertices [V, 3] and faces [F, 3]; watertight, normals out, the volume within about half a
        percent of the points'.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    count = len(where)
    pairs = cKDTree(where).query_pairs(_APART * spacing, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(count, count))
    _, heap = connected_components(graph, directed=False)
    order = np.argsort(heap, kind="stable")
    parts = []
    for rows in np.split(order, np.flatnonzero(np.diff(heap[order])) + 1):
        if len(rows) == 1:
            parts.append(_ball(where[rows[0]], float(volumes[rows[0]])))
        else:
            parts.append(_heap(where[rows], volumes[rows], spacing, blur))
    first = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _ball(center: NDArray[np.float64], volume: float) -> tuple[Any, Any]:
    """A ball of 42 corners around one point."""
    corners, faces = _unit_ball()
    return center + corners * np.cbrt(volume), faces


@functools.cache
def _unit_ball() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    return np.asarray(ball.vertices) / np.cbrt(ball.volume), np.asarray(ball.faces, np.int64)


def _heap(
    where: NDArray[np.float64], volumes: NDArray[np.float64], spacing: float, blur: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The surface around points that hang together."""
    from scipy.ndimage import gaussian_filter

    measure = need("skimage.measure", "mesh", "meshes: a surface")
    cell = _CELL * spacing
    margin = 1 + int(np.ceil(_REACHES * blur / _CELL))
    filled, _, origin = deposit(where, volumes, np.zeros(len(where)), cell, margin)
    density = gaussian_filter(filled.astype(np.float64), blur / _CELL, mode="constant")
    # the blur may not have faded out at the rim, and an open rim is an open mesh
    for axis in range(3):
        np.moveaxis(density, axis, 0)[[0, -1]] = 0.0
    samples, per_cell = _samples(density)
    wanted, near = float(volumes.sum()), _NEAR * float(density.max())
    cells = per_cell * wanted / cell**3
    best: tuple[float, NDArray[np.float64], NDArray[np.int64]] | None = None
    for _ in range(_TRIES):
        level = float(samples[-int(np.clip(round(cells), 1, len(samples) - 1))])
        shifted = level + np.where(density < level, -near, near)
        values = np.where(np.abs(density - level) < near, shifted, density)
        corners, faces, _, _ = measure.marching_cubes(
            values, level=level, gradient_direction="ascent"
        )
        vertices = origin + corners.astype(np.float64) * cell
        got = _volume(vertices, faces)
        if got < 0:
            faces, got = faces[:, ::-1], -got
        off = abs(got / wanted - 1.0)
        if best is None or off < best[0]:
            best = (off, vertices, faces.astype(np.int64))
        if off < _CLOSE:
            break
        cells *= wanted / max(got, 0.1 * wanted)
    assert best is not None
    return best[1], best[2]


def _samples(density: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Sorted values that tell how much space lies above which level, and how many make a cell."""
    per_cell = 1
    if density.size < _FINE_GRID:
        per_cell = 8
        for axis in range(3):  # halfway values too
            rows = np.moveaxis(density, axis, 0)
            finer = np.repeat(rows, 2, axis=0)[:-1]
            finer[1::2] = 0.5 * (rows[1:] + rows[:-1])
            density = np.moveaxis(finer, 0, axis)
    return np.sort(density[density > 0.0]), per_cell


def _volume(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Signed volume by the divergence theorem, around the first vertex against cancellation."""
    a, b, c = (vertices[faces[:, corner]] - vertices[0] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def _colors(
    gaussians: Gaussians, rows: NDArray[np.int64], points: NDArray[np.float64], width: float
) -> NDArray[np.float32]:
    """Colours of the surface from the piece's own splats, or from all where it has none."""
    import torch

    plain = gaussians.replace(labels=None, normals=None)
    if len(rows):
        plain = plain.select(torch.from_numpy(rows).to(plain.device))
    return surface_colors(plain, points, width)
