"""Pieces as closed meshes cut from the rest solid, each of which only moves rigidly."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Solid
from gsfluent.errors import InputError, need
from gsfluent.export.frames import upright
from gsfluent.export.job import Job
from gsfluent.io.rigid import RigidMesh, save_rigid_glb
from gsfluent.io.solid import load_solid
from gsfluent.io.usd import open_usd
from gsfluent.pipeline.cracks.sites import matter_colors, skin_colors_at
from gsfluent.pipeline.partition.mesh import PieceMesh, Surfaces
from gsfluent.pipeline.partition.splits import Split
from gsfluent.pipeline.partition.tree import Partition
from gsfluent.results.frames import load_frame
from gsfluent.results.partition import SavedBody, SavedPartition, load_partition
from gsfluent.results.record import shot_of

NOBODY = -1
"""Owner of dust, which is no piece."""
_LINE = 1e-6  # second singular value of a shape, by the first, below which it has no attitude


def pieces_glb(job: Job) -> str:
    """``pieces.glb``: a node per piece, with an animation.

    Raises:
        InputError: The run has no partition, or light is to be baked in.
    """
    save_rigid_glb(job.folder / "pieces.glb", rigid_pieces(job, "y"), _times(job))
    return "pieces.glb"


def pieces_usd(job: Job) -> str:
    """``pieces.usdc`` (or ``.usda``, ``.usdz``): a mesh per piece, with time samples.

    Raises:
        InputError: The run has no partition, light is to be baked in, no usd-core, or an up axis
            that USD has not.
    """
    need("pxr", "usd", "pieces-usd: a USD file")  # better said before the work
    name, up = f"pieces.{job.options.usd_ending}", job.sequence.up
    meshes = rigid_pieces(job, up)
    with open_usd(job.folder / name, fps=job.fps, up=up) as stage:
        stage.rigid([float(index + 1) for index in job.sequence.indices], meshes)
    return name


def _times(job: Job) -> list[float]:
    """Of the chosen frames [s], from the first one on."""
    return [(index - job.sequence.indices[0]) / job.fps for index in job.sequence.indices]


def rigid_pieces(job: Job, up: str) -> list[RigidMesh]:
    """All pieces that there are in the chosen frames, with their motion.

    Args:
        job: The export.
        up: Axis that points up.

    Raises:
        InputError: See :func:`pieces_glb`.
        RunError: A file of the run is damaged.
    """
    if job.options.relit:
        raise InputError(
            "--relit: pieces turn, so light cannot be baked into their meshes",
            "export them without, and light them where they go",
        )
    saved = load_partition(job.sequence.folder)
    if saved is None:
        raise _no_partition(job.out)
    indices = job.sequence.indices
    pieces = [
        piece
        for body in saved.bodies
        for piece in body_pieces(saved, body, _solid(job.out, body.name))
        if any(piece.first <= index < piece.end for index in indices)
    ]
    if not pieces:
        raise InputError(
            f"{job.out}: no object of this run has pieces", "liquids and grains have none"
        )
    fits: list[list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = [[] for _ in pieces]
    rest = saved.rest.double().numpy()
    firm = np.array(saved.carries.numpy(), bool)
    firm[saved.crumbs.numpy()] = False
    for place, index in enumerate(indices):
        frame = load_frame(job.sequence.folder, index)
        now, units = frame.positions.double().numpy(), frame.fragments.numpy()
        for piece, poses in zip(pieces, fits, strict=True):
            rows = _leading(piece.rows, firm, units)
            before = poses[-1][0] if poses else np.eye(3)
            # before it is born and after its end it goes with the points that it has
            poses.append(rigid_fit(rest[rows], now[rows], before))
        job.report(place + 1, len(indices), "pieces")
    turn = upright(up).rotation.numpy()
    return [
        _moving(piece, f"piece_{number:03d}_{_word(piece.body)}", poses, indices, turn)
        for number, (piece, poses) in enumerate(zip(pieces, fits, strict=True))
    ]


def _no_partition(out: Path) -> InputError:
    try:
        method = shot_of(out).output.cracks
    except InputError:
        method = "chunks"
    if method != "chunks":
        return InputError(
            f"{out}: this run has no pieces cut from its solids (output.cracks: {method})",
            "set output.cracks: chunks and run again, or use --to meshes",
        )
    return InputError(
        f"{out}: this run did not save how its solids were split",
        "run its simulation again with this version, or use --to meshes",
    )


def _solid(out: Path, name: str) -> Solid:
    path = out / "stages" / "texture" / f"{name}.ply"
    if not path.is_file():
        raise InputError(
            f"{path}: the solid of {name} is missing, so no pieces can be cut from it",
            "run the shot again; only this stage is redone",
        )
    return load_solid(path)


def _word(name: str) -> str:
    return re.sub(r"\W", "_", name, flags=re.ASCII)


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of a body, from when it is there to when it splits."""

    body: str  # Name of the body
    first: int  # First frame in which it is there, from 0
    end: int  # First frame in which it is not any more
    rows: Tensor  # Material points that belong to it, int64 [S]
    mesh: PieceMesh  # At rest
    colors: NDArray[np.float32]  # Of its vertices, display values, [V, 3]
    step: float  # Edge of the lattice of its vertices [m]


def body_pieces(saved: SavedPartition, body: SavedBody, solid: Solid) -> Iterator[Piece]:
    """The pieces of one body over the whole run, by their first frames.

    Args:
        saved: How it was split.
        body: Which.
        solid: Its solid.
    """
    mine = (saved.body == body.number).nonzero()[:, 0]
    partition = Partition(
        solid, body.frame, saved.rest[mine], body.spacing, body.number, body.amplitude
    )
    owner, region = saved.body.long().clone(), saved.regions
    parents: list[tuple[int, Split]] = []
    stages = [(0, owner)]
    gone: dict[int, int] = {}
    for split in saved.splits:
        count = int(split.rank.max())
        ids = [split.region, *range(region, region + count)]
        region += count
        if int(saved.body[split.rows[0]]) != body.number:
            continue
        if count:
            done = partition.split(
                split.region, saved.rest[split.rows], split.rank, ids, split.dust
            )
            owner = partition.assign(owner, done, saved.rest, split.rows, split.rank)
        owner = owner.clone()  # dust has no mesh
        owner[split.rows[split.rank == split.dust]] = NOBODY
        if count == 0:  # all of a region
            gone[split.region] = split.frame
            continue
        parents.append((split.frame, done))
        stages.append((split.frame, owner))
    surfaces = Surfaces(partition)
    colors = _colors(partition, solid, surfaces)
    leaves: dict[int, list[int]] = {n: [n] for n in (body.number, *_born(parents))}
    found = []
    # from the last split back: what is one piece now, and until when
    end = dict.fromkeys(leaves, np.iinfo(np.int64).max)
    for (frame, done), (_, after) in zip(reversed(parents), reversed(stages), strict=False):
        for number in done.ids:
            found.append((frame, end[number], number, leaves.pop(number), after))
            del end[number]
        first = done.ids[0]
        leaves[first] = [n for _, _, _, held, _ in found[-len(done.ids) :] for n in held]
        end[first] = frame
    found.append((0, end[body.number], body.number, leaves[body.number], stages[0][1]))
    for first, last, number, held, where in sorted(found, key=lambda f: (f[0], f[2])):
        mesh = surfaces.mesh(held)
        rows = ((where == number) & saved.carries).nonzero()[:, 0]
        last = min(last, gone.get(number, last))
        # several splits in one frame: what was between them is in no frame
        if first < last and len(mesh.faces) and len(rows):
            yield Piece(body.name, first, last, rows, mesh, colors[mesh.source], surfaces.step)


def _born(parents: list[tuple[int, Split]]) -> list[int]:
    return [number for _, done in parents for number in done.ids[1:]]


def _colors(partition: Partition, solid: Solid, surfaces: Surfaces) -> NDArray[np.float32]:
    """Display colours of all vertices: of the skin on the skin, of the matter elsewhere."""
    means = partition.own(surfaces.vertices).to(torch.float32)
    place = (means - solid.origin.to(means)) / solid.voxel
    found = matter_colors(solid, place, means).clone()
    skin = surfaces.on_skin.nonzero()[:, 0]
    shown = skin_colors_at(solid, means[skin])
    if shown is not None:
        found[skin] = shown.to(found)
    return found.clamp(0.0, 1.0).cpu().numpy().astype(np.float32)


def _leading(rows: Tensor, firm: NDArray[np.bool_], units: NDArray[np.int32]) -> NDArray[np.int64]:
    """Points by which a piece moves: firm ones of what most of them hang together with."""
    mine = rows.numpy()
    held = mine[firm[mine] & (units[mine] >= 0)]
    if len(held) == 0:
        return mine
    names, many = np.unique(units[held], return_counts=True)
    return held[units[held] == names[many.argmax()]]


def rigid_fit(
    rest: NDArray[np.float64], now: NDArray[np.float64], before: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The rigid motion nearest to that of some points (Kabsch 1976).

    Args:
        rest: Where they were, [N, 3].
        now: Where they are, [N, 3].
        before: Rotation for what has no attitude, one point or a line, [3, 3].

    Returns:
        Rotation [3, 3] and translation [3].
    """
    one, two = rest.mean(axis=0), now.mean(axis=0)
    u, size, v = np.linalg.svd((now - two).T @ (rest - one))
    turn = before
    if size[1] > _LINE * size[0]:
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return turn, two - turn @ one


def _moving(
    piece: Piece,
    name: str,
    poses: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    indices: list[int],
    turn: NDArray[np.float64],
) -> RigidMesh:
    """A piece around its middle, in the axes of a file."""
    mesh = piece.mesh
    # on the lattice of the vertices, so that single precision holds both without rounding
    middle = np.round(mesh.vertices.mean(axis=0) / piece.step) * piece.step
    rotation = np.stack([turn @ r @ turn.T for r, _ in poses])
    quats = geometry.matrix_to_quaternion(torch.from_numpy(rotation)).numpy().copy()
    for k in range(1, len(quats)):
        if quats[k] @ quats[k - 1] < 0.0:  # the short way, for whoever goes in between
            quats[k] = -quats[k]
    return RigidMesh(
        name=name,
        vertices=((mesh.vertices - middle) @ turn.T).astype(np.float32),
        faces=mesh.faces,
        colors=piece.colors,
        normals=mesh.normals() @ turn.T,
        corner_normals=mesh.corner_normals() @ turn.T,
        translation=np.stack([turn @ (r @ middle + t) for r, t in poses]),
        rotation=quats,
        shown=np.array([piece.first <= index < piece.end for index in indices]),
    )
