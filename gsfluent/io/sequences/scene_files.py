"""Moving points and meshes of USD stages and VTK files, by the libraries of their makers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError, need
from gsfluent.io.checked.files import read_json, read_text, regular_file
from gsfluent.io.checked.inside import inside
from gsfluent.io.sequences.sequence import Sequence, checked, stacked

VTK_ENDINGS = (".vtk", ".vtp", ".vtu")


def read_usd(path: Path, fps: float) -> Sequence:
    """Read all meshes, points and point instancers of a stage at its time samples.

    Times are those of the file; of a stage without samples that is one frame.

    Raises:
        InputError: The stage cannot be opened, or holds no points.
        MissingPackage: usd-core is not installed.
    """
    need("pxr", "usd", "a USD sequence")
    from pxr import Tf, Usd, UsdGeom

    regular_file(path)
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise InputError(f"{path}: cannot be opened as a USD stage", "export it again") from error
    prims = [
        prim
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.PointBased) or prim.IsA(UsdGeom.PointInstancer)
    ]
    if not prims:
        raise InputError(f"{path}: holds no meshes or points", "export them with their animation")
    codes = sorted({t for prim in prims for t in _samples(prim, UsdGeom)})
    rate = stage.GetTimeCodesPerSecond() or fps
    faces: list[NDArray[np.int64]] = []
    frames: list[NDArray[Any]] = []
    for code in codes or [Usd.TimeCode.EarliestTime().GetValue()]:
        cache = UsdGeom.XformCache(code)
        parts, count = [], 0
        for prim in prims:
            attribute = _attribute(prim, UsdGeom)
            points = np.asarray(attribute.Get(code) or np.zeros((0, 3)), np.float64).reshape(-1, 3)
            matrix = np.asarray(cache.GetLocalToWorldTransform(prim))  # row vectors
            parts.append(points @ matrix[:3, :3] + matrix[3, :3])
            if not frames and prim.IsA(UsdGeom.Mesh):
                faces.append(_triangles(UsdGeom.Mesh(prim), code) + count)
            count += len(points)
        frames.append(np.concatenate(parts))
    times = np.asarray(codes or [0.0]) / rate
    joined = np.concatenate(faces) if faces else None
    return checked(path, stacked(path, frames), times - times[0], joined)


def _attribute(prim: Any, geometry: Any) -> Any:
    if prim.IsA(geometry.PointInstancer):
        return geometry.PointInstancer(prim).GetPositionsAttr()
    return geometry.PointBased(prim).GetPointsAttr()


def _samples(prim: Any, geometry: Any) -> list[float]:
    """Time codes at which points, or a transform above them, are given."""
    found = list(_attribute(prim, geometry).GetTimeSamples())
    while prim and not prim.IsPseudoRoot():
        if xform := geometry.Xformable(prim):
            found += xform.GetTimeSamples()
        prim = prim.GetParent()
    return found


def _triangles(mesh: Any, code: float) -> NDArray[np.int64]:
    """Polygons as fans of triangles."""
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(code) or [], np.int64)
    corners = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(code) or [], np.int64)
    starts = np.cumsum(counts) - counts
    fans = [
        np.stack([np.full(n - 2, s), np.arange(s + 1, s + n - 1), np.arange(s + 2, s + n)], axis=1)
        for s, n in zip(starts, counts, strict=True)
        if n > 2
    ]
    return corners[np.concatenate(fans)] if fans else np.zeros((0, 3), np.int64)


def read_vtk_series(path: Path, fps: float | None) -> Sequence:
    """Read the files that a ``.vtk.series`` or ``.pvd`` names, with their times.

    Raises:
        InputError: Not such a file, or one it names is missing.
    """
    if path.suffix == ".series":
        values = read_json(path)
        try:
            listed = [(float(row["time"]), str(row["name"])) for row in values["files"]]
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(f"{path}: no series of VTK ({error})", "export it again") from error
    else:
        pattern = r"<DataSet\b[^>]*>"
        rows = re.findall(pattern, read_text(path))
        found = [
            (re.search(r'timestep="([^"]+)"', r), re.search(r'file="([^"]+)"', r)) for r in rows
        ]
        listed = [(float(t[1]), f[1]) for t, f in found if t is not None and f is not None]
    if not listed:
        raise InputError(f"{path}: names no files", "export it again")
    listed.sort()
    files = [inside(path.parent, name, path) for _, name in listed]
    return read_vtk_files(path, files, [time for time, _ in listed], fps)


def read_vtk_files(
    where: Path, files: list[Path], times: list[float] | None, fps: float | None
) -> Sequence:
    """Read VTK data sets, one a frame.

    Raises:
        InputError: One cannot be read or has no points.
        MissingPackage: vtk is not installed.
    """
    read = [_read_vtk(path) for path in files]
    positions = stacked(where, [points for points, _ in read])
    return checked(where, positions, times, read[0][1], fps)


def _read_vtk(path: Path) -> tuple[NDArray[Any], NDArray[np.int64] | None]:
    """Points and triangles of a data set."""
    need("vtkmodules", "dev", "a VTK sequence")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    regular_file(path)
    kinds: dict[str, Any] = {".vtp": vtkXMLPolyDataReader, ".vtu": vtkXMLUnstructuredGridReader}
    reader = kinds.get(path.suffix.lower(), vtkGenericDataObjectReader)()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    if data is None or not hasattr(data, "GetPoints") or data.GetNumberOfPoints() == 0:
        raise InputError(f"{path}: no VTK file with points", "export polydata or a grid")
    points = vtk_to_numpy(data.GetPoints().GetData())
    if data.IsA("vtkUnstructuredGrid"):
        return points, None  # its surface would be numbered anew
    triangles = vtkTriangleFilter()
    triangles.SetInputData(data)
    triangles.PassVertsOff()
    triangles.PassLinesOff()
    triangles.Update()
    cells = triangles.GetOutput().GetPolys()
    if cells.GetNumberOfCells() == 0:
        return points, None
    return points, vtk_to_numpy(cells.GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
