"""A finished simulation in other programs' formats: 3DGS .ply sequence, VTK point sequence, mp4."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.errors import InputError
from gsfluent.io import atomic_path, save_splats
from gsfluent.pipeline.run_frames import SavedFrame, count_frames, load_frame
from gsfluent.pipeline.stage import Progress, report_progress

FORMATS = ("mp4", "ply-seq", "vtk")


def export(
    out: Path, kinds: list[str], *, device: torch.device, progress: Progress | None = None
) -> dict[str, Any]:
    """Write formats, also the video again.

    Args:
        out: Folder of a run.
        kinds: Some of :data:`FORMATS`.
        device: Where the video is rendered.
        progress: Called per frame.

    Returns:
        Format to what was written, relative to ``out``.

    Raises:
        InputError: An unknown format, or no simulated frames.
        RunError: The disk is full.
    """
    kinds = [kind.strip() for kind in kinds]
    for kind in kinds:
        if kind not in FORMATS:
            raise InputError(
                f"--to {kind}: gsfluent cannot write that", f"choose from {', '.join(FORMATS)}"
            )
    written = write_exports(out, [kind for kind in kinds if kind != "mp4"], progress=progress)
    if "mp4" in kinds:
        from gsfluent.pipeline.run_show import render_again

        render_again(out, to=out / "video.mp4", device=device, progress=progress)
        written["video"] = "video.mp4"
    return written


def write_exports(
    out: Path, kinds: list[str], *, progress: Progress | None = None
) -> dict[str, Any]:
    """Write the formats that need no rendering; see :func:`export`."""
    folder = out / "stages" / "simulate"
    count = count_frames(folder)
    if count == 0:
        raise InputError(f"{out}: no simulated frames", "run the shot first: gsfluent run")
    written: dict[str, Any] = {}
    for kind in kinds:
        where, name, write = _WRITERS[kind]
        (out / where).mkdir(exist_ok=True)
        for index in range(count):
            write(out / where / name.format(index + 1), load_frame(folder, index))
            report_progress(progress, index + 1, count, kind)
        written[kind] = f"{where}/{name.format(1)} to {name.format(count)}"
    return written


def write_ply_frame(path: Path, frame: SavedFrame) -> None:
    """One frame as a standard INRIA 3DGS .ply, scene coordinates in metres."""
    save_splats(frame.gaussians, path)


def write_vtk_frame(path: Path, frame: SavedFrame) -> None:
    """The material points of one frame as legacy binary VTK, with damage, volume and fragment."""
    points = frame.positions.cpu().numpy().astype(">f4")
    count = points.shape[0]
    fields: list[tuple[str, str, np.ndarray]] = [
        ("damage", "float", frame.damage.cpu().numpy().astype(">f4")),
        ("volume", "float", frame.volumes.cpu().numpy().astype(">f4")),
        ("fragment", "int", frame.fragments.cpu().numpy().astype(">i4")),
    ]
    vertices = np.empty((count, 2), dtype=">i4")
    vertices[:, 0], vertices[:, 1] = 1, np.arange(count)
    with atomic_path(path) as part, part.open("wb") as stream:
        title = f"gsfluent frame {frame.index + 1}, time {frame.time:.6g} s"
        kind_of_file = f"# vtk DataFile Version 3.0\n{title}\nBINARY\nDATASET POLYDATA\n"
        stream.write(f"{kind_of_file}POINTS {count} float\n".encode())
        stream.write(points.tobytes())
        stream.write(f"\nVERTICES {count} {2 * count}\n".encode())
        stream.write(vertices.tobytes())
        stream.write(f"\nPOINT_DATA {count}\n".encode())
        for name, kind, values in fields:
            stream.write(f"SCALARS {name} {kind} 1\nLOOKUP_TABLE default\n".encode())
            stream.write(values.tobytes() + b"\n")


_Writer = Callable[[Path, SavedFrame], None]
_WRITERS: dict[str, tuple[str, str, _Writer]] = {
    "ply-seq": ("frames", "frame_{:04d}.ply", write_ply_frame),
    "vtk": ("particles", "particles_{:04d}.vtk", write_vtk_frame),
}
