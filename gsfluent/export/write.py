"""A finished simulation in other programs' formats; docs/guide/export.md says which reads what."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsfluent.config.read import nearest
from gsfluent.errors import InputError
from gsfluent.export.frames import DeltaSequence, FrameSequence
from gsfluent.export.job import ExportOptions, Job
from gsfluent.export.relit import relight_of
from gsfluent.progress import Progress
from gsfluent.results.digests import require_intact


@dataclass(frozen=True)
class Format:
    """One thing that can be written."""

    what: str  # Files and who reads them, in one line
    writer: str  # ``module.function`` beside this: takes a :class:`Job`, says what was written
    splats_only: bool = False  # Needs splats and nothing else, so it can be made of a ``.gsd`` file
    key: str = ""  # Name in the report


FORMATS: dict[str, Format] = {
    "mp4": Format("H.264 video", "pictures.mp4", key="video"),
    "gif": Format("animated GIF", "pictures.gif"),
    "webp": Format("animated WebP, also with alpha", "pictures.webp"),
    "png": Format("PNG sequence, also with alpha", "pictures.png"),
    "ply-seq": Format(
        "3DGS .ply per frame: SuperSplat, Blender, Houdini, Unity",
        "splats.ply_sequence",
        splats_only=True,
    ),
    "spz": Format(".spz per frame: phones, web viewers", "splats.spz_sequence", splats_only=True),
    "splat": Format(
        ".splat per frame: the first web viewers", "splats.splat_sequence", splats_only=True
    ),
    "ksplat": Format(
        ".ksplat per frame: GaussianSplats3D (three.js)", "splats.ksplat_sequence", splats_only=True
    ),
    "sog": Format(
        ".sog per frame: SuperSplat, PlayCanvas, small", "splats.sog_sequence", splats_only=True
    ),
    "glb": Format(
        "glTF with KHR_gaussian_splatting per frame", "splats.glb_sequence", splats_only=True
    ),
    "delta": Format(
        "one small .gsd file: gsfluent.io.DeltaReader, gsfluent export",
        "delta.delta",
        splats_only=True,
    ),
    "usd": Format("one USD file with time samples: Houdini, usdview", "splats.usd"),
    "vtk": Format("material points per frame: ParaView, VisIt", "points.vtk"),
    "points": Format("material points as .ply: Houdini, Blender", "points.points"),
    "meshes": Format("a closed surface per fragment: Houdini, Blender, games", "meshes.meshes"),
    "pieces-glb": Format(
        "glTF, a rigid closed mesh per piece, animated: Blender, games", "pieces.pieces_glb"
    ),
    "pieces-usd": Format("the same as USD: Houdini, usdview", "pieces.pieces_usd"),
    "vti": Format("density and damage volume per frame: ParaView", "points.vti"),
}


_OTHERS: dict[tuple[str, ...], str] = {
    ("vdb", "nvdb", "openvdb"): "there is no library for it on PyPI; vti is the same volume",
    ("abc", "alembic", "fbx"): "use usd, or meshes and points",
    ("obj", "stl"): "use meshes, with --mesh-ending obj",
    ("sogs",): "use sog, which is its successor in one file",
    ("gltf",): "use glb for splats, pieces-glb for meshes",
    ("pieces",): "use pieces-glb or pieces-usd",
    ("ply",): "use ply-seq for splats, points for material points, meshes for fragments",
    ("avi", "mov", "mkv", "video"): "use mp4",
    ("jpg", "jpeg", "pictures.frames"): "use png",
}


def export(
    out: Path,
    kinds: list[str],
    *,
    device: torch.device,
    to: Path | None = None,
    options: ExportOptions | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write a finished simulation in some formats.

    Args:
        out: Folder of the run, or a ``.gsd`` file of one.
        kinds: Some of :data:`FORMATS`.
        device: Where pictures are rendered and light is baked.
        to: Folder to write to; by default ``out``, or one named like the file.
        options: How.
        progress: Called per frame.

    Returns:
        Format to what was written, relative to ``to``.

    Raises:
        InputError: An unknown format or option, an extra that is not installed, or no frames.
        RunError: The disk is full.
    """
    options = options or ExportOptions()
    kinds = [kind.strip() for kind in kinds if kind.strip()]
    for kind in kinds:
        if kind not in FORMATS:
            raise InputError(f"--to {kind}: gsfluent cannot write that", _instead(kind))
    if not kinds:
        raise InputError("--to names no format", f"choose from {', '.join(FORMATS)}")
    sequence: FrameSequence
    if out.is_file():
        sequence = DeltaSequence(out, frames=options.frames, sh=options.sh, up=options.up)
        for kind in kinds:
            if options.relit or not FORMATS[kind].splats_only:
                what = "--relit" if options.relit else f"--to {kind}"
                raise InputError(f"{what}: {out} holds splats only", "export from the run")
        to = to or out.with_suffix("")
    else:
        require_intact(out / "stages" / "simulate")
        sequence = FrameSequence(
            out,
            frames=options.frames,
            sh=options.sh,
            relight=relight_of(out, options) if options.relit else None,
            up=options.up,
            device=device if options.relit else None,
        )
    job = Job(out, to or out, sequence, options, options.fps or sequence.rate(), device, progress)
    return _write(job, kinds)


def write_exports(
    out: Path, kinds: list[str], *, progress: Progress | None = None
) -> dict[str, Any]:
    """Write the formats that need no rendering, with the usual options; see :func:`export`."""
    sequence = FrameSequence(out)
    rate, cpu = sequence.rate(), torch.device("cpu")
    return _write(Job(out, out, sequence, ExportOptions(), rate, cpu, progress), kinds)


def _instead(kind: str) -> str:
    """What to ask for in place of a format there is not."""
    for names, hint in _OTHERS.items():
        if kind.lower() in names:
            return hint
    return nearest(kind, FORMATS)


def _write(job: Job, kinds: list[str]) -> dict[str, Any]:
    job.folder.mkdir(parents=True, exist_ok=True)
    written: dict[str, Any] = {}
    for kind in kinds:
        module, _, function = FORMATS[kind].writer.partition(".")
        write = getattr(importlib.import_module(f"gsfluent.export.{module}"), function)
        written[FORMATS[kind].key or kind] = write(job)
    return written
