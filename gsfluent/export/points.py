"""Material points as files of other programs: VTK, PLY points, density volumes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.export.frames import Moment
from gsfluent.export.job import Job, span
from gsfluent.io.splats.ply import write_ply
from gsfluent.io.vtk import save_series, save_vti, save_vtk_points

_LARGEST_GRID = 400**3


def point_fields(moment: Moment) -> dict[str, NDArray[np.generic]]:
    """What is known of each material point, as plain arrays; velocity is [P, 3], the rest [P]."""
    saved = moment.saved
    names = {"damage": saved.damage, "volume": saved.volumes, "fragment": saved.fragments}
    names |= {"material": saved.material, "body": saved.body, "velocity": saved.velocity}
    return {name: value.cpu().numpy() for name, value in names.items()}


def vtk(job: Job) -> str:
    """``particles/particles_0001.vtk`` and a ``.vtk.series`` that ParaView plays."""

    def write(path: Path, moment: Moment) -> None:
        saved = moment.saved
        title = f"gsfluent frame {moment.number}, time {saved.time:.6g} s"
        save_vtk_points(path, saved.positions.cpu().numpy(), point_fields(moment), title)

    names = job.write_each("vtk", "particles", "particles_{:04d}.vtk", write)
    save_series(job.folder / "particles" / "particles.vtk.series", names, job.sequence.times())
    return span("particles", names)


def points(job: Job) -> str:
    """``points/points_0001.ply``: a point cloud with attributes, for Houdini and Blender."""

    def write(path: Path, moment: Moment) -> None:
        where = moment.saved.positions.cpu().numpy()
        fields = point_fields(moment)
        velocity = fields.pop("velocity")
        columns = dict(zip(("x", "y", "z"), where.T, strict=True))
        columns |= dict(zip(("vx", "vy", "vz"), velocity.T, strict=True)) | fields
        kinds = {n: "<f4" if v.dtype.kind == "f" else "<i4" for n, v in columns.items()}
        rows = np.zeros(len(where), dtype=list(kinds.items()))
        for name, value in columns.items():
            rows[name] = value
        write_ply(path, {"vertex": rows}, (f"gsfluent, time {moment.saved.time:.6g} s",))

    return span("points", job.write_each("points", "points", "points_{:04d}.ply", write))


def vti(job: Job) -> str:
    """``density/density_0001.vti`` and ``density.pvd``: the filled share of space, and damage.

    The box is cut to the matter of each frame.

    Raises:
        InputError: There are no material points.
    """

    def write(path: Path, moment: Moment) -> None:
        saved = moment.saved
        where = saved.positions.double().cpu().numpy()
        volumes = saved.volumes.double().cpu().numpy()
        if len(where) == 0:
            raise InputError(f"{job.out}: no material points", "export a run that has some")
        step = grid_step(where, volumes)
        density, damage, origin = deposit(where, volumes, saved.damage.cpu().numpy(), step)
        fields = {"density": density, "damage": damage}
        save_vti(path, fields, origin=origin.tolist(), spacing=step)

    names = job.write_each("vti", "density", "density_{:04d}.vti", write)
    save_series(job.folder / "density" / "density.pvd", names, job.sequence.times())
    return span("density", names)


def grid_step(where: NDArray[np.float64], volumes: NDArray[np.float64]) -> float:
    """Edge of a grid's cells [m]: the mean spacing of the points, wider for matter far spread."""
    step = float(np.cbrt(np.median(volumes)))
    extent = np.ptp(where, axis=0) + 4.0 * step
    return max(step, float(np.cbrt(extent.prod() / _LARGEST_GRID)))


def deposit(
    where: NDArray[np.float64],
    volumes: NDArray[np.float64],
    values: NDArray[np.floating],
    step: float,
    margin: int = 2,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Spread points over a grid with trilinear weights.

    Args:
        where: [P, 3] in metres.
        volumes: [P] in cubic metres.
        values: [P], averaged over what lies at a grid point.
        step: Distance of grid points [m].
        margin: Empty grid points around the matter.

    Returns:
        Share of space that is filled [X, Y, Z] (1 in full matter; times ``step**3`` it sums to the
        volume of the points), the average of ``values`` there, and the position of [0, 0, 0].
    """
    origin = where.min(axis=0) - margin * step
    shape = np.floor((where.max(axis=0) - origin) / step).astype(int) + margin + 2
    local = (where - origin) / step
    base = np.floor(local).astype(np.int64)
    part = local - base
    size = int(shape.prod())
    filled, carried = np.zeros(size), np.zeros(size)
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(np.array(corner) == 1, part, 1.0 - part).prod(axis=1) * volumes
        at = np.ravel_multi_index(tuple((base + corner).T), tuple(shape))
        filled += np.bincount(at, weight, minlength=size)
        carried += np.bincount(at, weight * values, minlength=size)
    average = np.divide(carried, filled, out=np.zeros(size), where=filled > 0.0)
    density = (filled / step**3).astype(np.float32).reshape(shape)
    return density, average.astype(np.float32).reshape(shape), origin
