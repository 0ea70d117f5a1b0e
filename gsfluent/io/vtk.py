"""VTK files for ParaView, Houdini and Blender: points (legacy), volumes (XML), and time series.

A ``.vtk.series`` or ``.pvd`` beside the files tells ParaView which file belongs to which time.
Layout: Kitware, "VTK File Formats".
"""

from __future__ import annotations

import base64
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.io.atomic import atomic_path, write_json

_LEGACY = {"f": ("float", ">f4"), "i": ("int", ">i4")}
_XML = {"f": ("Float32", "<f4"), "u": ("UInt8", "u1"), "i": ("Int32", "<i4")}
_BLOCK = 1 << 18  # bytes that are compressed at a time


def save_vtk_points(
    path: str | Path, points: NDArray[Any], fields: Mapping[str, NDArray[Any]], title: str
) -> None:
    """Write points as legacy binary polydata, atomically.

    Args:
        path: ``.vtk``.
        points: [P, 3].
        fields: Name to values [P] (scalars) or [P, 3] (vectors), float or whole numbers.
        title: Second line of the file, at most 255 characters.

    Raises:
        RunError: The disk is full.
    """
    count = len(points)
    vertices = np.empty((count, 2), dtype=">i4")
    vertices[:, 0], vertices[:, 1] = 1, np.arange(count)
    with atomic_path(path) as part, part.open("wb") as stream:
        head = f"# vtk DataFile Version 3.0\n{title[:255]}\nBINARY\nDATASET POLYDATA\n"
        stream.write(f"{head}POINTS {count} float\n".encode())
        stream.write(np.asarray(points).astype(">f4").tobytes())
        stream.write(f"\nVERTICES {count} {2 * count}\n".encode())
        stream.write(vertices.tobytes())
        stream.write(f"\nPOINT_DATA {count}\n".encode())
        for name, values in fields.items():
            kind, dtype = _LEGACY["f" if np.asarray(values).dtype.kind == "f" else "i"]
            if np.ndim(values) == 2:
                stream.write(f"VECTORS {name} {kind}\n".encode())
            else:
                stream.write(f"SCALARS {name} {kind} 1\nLOOKUP_TABLE default\n".encode())
            stream.write(np.asarray(values).astype(dtype).tobytes() + b"\n")


def save_vti(
    path: str | Path,
    fields: Mapping[str, NDArray[Any]],
    *,
    origin: Sequence[float],
    spacing: float,
) -> None:
    """Write a volume as XML image data (zlib), atomically; values lie on the grid's points.

    Args:
        path: ``.vti``.
        fields: Name to values [X, Y, Z], float, uint8 or int32; one shape for all.
        origin: Position of value [0, 0, 0].
        spacing: Distance of neighbours.

    Raises:
        ValueError: No field, or shapes that differ.
        RunError: The disk is full.
    """
    shapes = {np.shape(values) for values in fields.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 3:
        raise ValueError(f"save_vti: fields must share one shape [X, Y, Z], got {sorted(shapes)}")
    extent = " ".join(f"0 {size - 1}" for size in next(iter(shapes)))
    place = " ".join(f"{value:.9g}" for value in origin)
    arrays = []
    for name, values in fields.items():
        kind, dtype = _XML[np.asarray(values).dtype.kind]
        # x runs fastest in the file
        flat = np.asarray(values).astype(dtype).transpose(2, 1, 0)
        arrays.append(
            f'<DataArray type="{kind}" Name="{name}" format="binary">{_encoded(flat)}</DataArray>'
        )
    text = (
        '<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" '
        'header_type="UInt32" compressor="vtkZLibDataCompressor">\n'
        f'<ImageData WholeExtent="{extent}" Origin="{place}" '
        f'Spacing="{spacing:.9g} {spacing:.9g} {spacing:.9g}">\n<Piece Extent="{extent}">\n'
        f'<PointData Scalars="{next(iter(fields))}">\n' + "\n".join(arrays) + "\n</PointData>\n"
        "</Piece>\n</ImageData>\n</VTKFile>\n"
    )
    with atomic_path(path) as part:
        part.write_text(text, encoding="ascii")


def _encoded(values: NDArray[Any]) -> str:
    """Compressed blocks behind a header: number, size and rest of the blocks, their lengths."""
    raw = np.ascontiguousarray(values).tobytes()
    blocks = [zlib.compress(raw[at : at + _BLOCK]) for at in range(0, len(raw), _BLOCK)]
    head = [len(blocks), _BLOCK, len(raw) % _BLOCK, *map(len, blocks)]
    header = np.array(head, dtype="<u4").tobytes()
    return (base64.b64encode(header) + base64.b64encode(b"".join(blocks))).decode("ascii")


def save_series(path: str | Path, files: Sequence[str], times: Sequence[float]) -> None:
    """Write the index of a time series, atomically: ``.pvd`` (XML formats) or ``.series`` (any).

    Args:
        path: Its ending chooses the kind.
        files: Relative to the index.
        times: Simulated times [s].
    """
    path = Path(path)
    if path.suffix != ".pvd":
        entries = [{"name": f, "time": t} for f, t in zip(files, times, strict=True)]
        write_json(path, {"file-series-version": "1.0", "files": entries})
        return
    rows = "\n".join(
        f'<DataSet timestep="{time:.9g}" group="" part="0" file="{os.fspath(file)}"/>'
        for file, time in zip(files, times, strict=True)
    )
    text = f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n{rows}'
    with atomic_path(path) as part:
        part.write_text(text + "\n</Collection>\n</VTKFile>\n", encoding="ascii")
