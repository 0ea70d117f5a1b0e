"""Splats of a simulation as files of other programs: PLY sequence, SPZ, .splat, GLB, USD."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Gaussians
from gsfluent.errors import InputError, need
from gsfluent.export.frames import NOBODY, FrameSequence, Moment
from gsfluent.export.job import Job, span
from gsfluent.io.axes import nearest_axes
from gsfluent.io.gltf import save_glb
from gsfluent.io.splats.load import save_forged, save_splats
from gsfluent.io.splats.splat import save_splat
from gsfluent.io.splats.spz import save_spz
from gsfluent.io.usd import open_usd
from gsfluent.progress import Progress, report_progress

_USD_PARTS = ("splats", "particles", "meshes")


def _sequence(
    job: Job, kind: str, name: str, save: Callable[[Gaussians, Path], Any], up: str | None = None
) -> str:
    """One file per frame, in a folder called like the format."""
    if up is not None:
        job = replace(job, sequence=job.sequence.turned(up))
    frames = Constant(job.sequence, job.progress) if job.options.constant else None

    def write(path: Path, moment: Moment) -> None:
        save(moment.gaussians, path)

    return span(kind, job.write_each(kind, kind, name, write, frames=frames))


def ply_sequence(job: Job) -> str:
    """``frames/frame_0001.ply``: the INRIA layout, or SuperSplat's compressed one."""
    options = job.options

    def write(path: Path, moment: Moment) -> None:
        extra = None
        if options.attributes:
            extra = {
                "fragment": moment.fragment.cpu().numpy(),
                "material": moment.material.cpu().numpy(),
            }
        save_splats(
            bare(moment.gaussians),
            path,
            compressed=options.compressed,
            keep_order=options.constant,
            extra=extra,
        )

    # not in one folder: a player would take both for one sequence
    folder = "frames_compressed" if options.compressed else "frames"
    name = "frame_{:04d}.compressed.ply" if options.compressed else "frame_{:04d}.ply"
    frames = Constant(job.sequence, job.progress) if options.constant else None
    return span(folder, job.write_each("ply-seq", folder, name, write, frames=frames))


def bare(gaussians: Gaussians) -> Gaussians:
    """The splats without our own label column."""
    return gaussians.replace(labels=None)


def spz_sequence(job: Job) -> str:
    """``spz/frame_0001.spz``, +y up as the format has it."""
    save = functools.partial(save_spz, version=job.options.spz_version)
    return _sequence(job, "spz", "frame_{:04d}.spz", save, up="y")


def splat_sequence(job: Job) -> str:
    """``splat/frame_0001.splat``."""
    return _sequence(job, "splat", "frame_{:04d}.splat", save_splat)


def ksplat_sequence(job: Job) -> str:
    """``ksplat/frame_0001.ksplat``."""
    return _forged(job, "ksplat")


def sog_sequence(job: Job) -> str:
    """``sog/frame_0001.sog``."""
    return _forged(job, "sog")


def _forged(job: Job, kind: str) -> str:
    need("gaussforge", "formats", f"--to {kind}")  # before the first frame is made
    return _sequence(job, kind, f"frame_{{:04d}}.{kind}", save_forged)


def glb_sequence(job: Job) -> str:
    """``glb/frame_0001.glb``, +y up as the format has it."""
    return _sequence(job, "glb", "frame_{:04d}.glb", save_glb, up="y")


def usd(job: Job) -> str:
    """``scene.usdc`` (or ``.usdz``): all frames as time samples.

    Raises:
        InputError: An unknown part, or an up axis that USD has not.
    """
    parts = job.options.usd_parts
    for part in parts:
        if part not in _USD_PARTS:
            raise InputError(f"--usd-parts {part}", f"choose from {', '.join(_USD_PARTS)}")
    name = f"scene.{job.options.usd_ending}"
    # many readers cannot follow a changing number of splats
    frames: Iterable[Moment] = job.sequence
    if job.options.constant or "splats" in parts:
        frames = Constant(job.sequence, job.progress)
    with open_usd(job.folder / name, fps=job.fps, up=job.sequence.up) as stage:
        for place, moment in enumerate(frames):
            saved, code = moment.saved, float(moment.number)
            if "splats" in parts:
                stage.splats(code, moment.gaussians)
            if "particles" in parts and saved.positions.shape[0]:
                properties = {
                    "damage": saved.damage.cpu().numpy(),
                    "fragment": saved.fragments.cpu().numpy(),
                    "material": saved.material.cpu().numpy(),
                    "body": saved.body.cpu().numpy(),
                }
                stage.points(
                    code,
                    saved.positions.cpu().numpy(),
                    saved.volumes.cpu().numpy(),
                    saved.velocity.cpu().numpy(),
                    properties,
                )
            if "meshes" in parts:
                from gsfluent.export.meshes import fragment_meshes

                for piece in fragment_meshes(moment, job.options.mesh_blur):
                    stage.mesh(code, piece.name, piece.vertices, piece.faces, piece.colors)
            job.report(place + 1, len(job.sequence), "usd")
    return name


class Constant:
    """The frames of a sequence with a constant number and order of splats.

    Iterating gives :class:`Moment`; rows are sorted by id. Axes keep their names and quaternions
    their sign from frame to frame, so that a player may interpolate.
    """

    def __init__(self, sequence: FrameSequence, progress: Progress | None = None) -> None:
        self.sequence = sequence
        ids = torch.zeros(0, dtype=torch.int64)
        first: list[Gaussians] = []
        for place, moment in enumerate(sequence):
            new = ~torch.isin(moment.saved.ids.cpu(), ids)
            if bool(new.any()):
                ids = torch.cat([ids, moment.saved.ids.cpu()[new]])
                first.append(_plain(moment.gaussians.to("cpu").select(new)))
            report_progress(progress, place + 1, len(sequence), "which splats there are")
        order = torch.argsort(ids)
        self.ids = ids[order]
        self.born = Gaussians.cat(first).select(order)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.sequence)

    def __iter__(self) -> Iterator[Moment]:
        """The frames."""
        now = self.born
        count = now.count
        for moment in self.sequence:
            saved = moment.saved
            rows = torch.searchsorted(self.ids, saved.ids.cpu())
            here = _least_turned(_plain(moment.gaussians.to("cpu")), now.quats[rows])
            fields = {
                name: getattr(now, name).index_copy(0, rows, getattr(here, name))
                for name in ("means", "quats", "scales", "sh")
            }
            opacities = torch.zeros(count).index_copy(0, rows, here.opacities)
            now = Gaussians(opacities=opacities, **fields)
            yield Moment(
                replace(
                    saved,
                    gaussians=now,
                    ids=self.ids,
                    groups=_spread(saved.groups, rows, count),
                    anchor=_spread(saved.anchor, rows, count),
                ),
                _spread(moment.fragment, rows, count),
                _spread(moment.material, rows, count),
            )


def _plain(gaussians: Gaussians) -> Gaussians:
    """Without labels and normals, which need not be there in every frame."""
    return gaussians.replace(labels=None, normals=None)


def _least_turned(gaussians: Gaussians, wanted: Tensor) -> Gaussians:
    """The same splats with their axes named as they were in the frame before."""
    quats, scales = nearest_axes(
        geometry.normalize_quaternions(gaussians.quats).double().numpy(),
        gaussians.scales.numpy(),
        geometry.normalize_quaternions(wanted).double().numpy(),
    )
    return gaussians.replace(quats=torch.from_numpy(quats).float(), scales=torch.from_numpy(scales))


def _spread(values: Tensor, rows: Tensor, count: int) -> Tensor:
    whole = torch.full((count,), NOBODY, dtype=values.dtype)
    whole[rows] = values.cpu()
    return whole
