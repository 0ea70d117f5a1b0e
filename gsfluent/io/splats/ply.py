"""The PLY container: a header naming elements and properties, then rows in ASCII or binary.

This file knows nothing of Gaussians. Layout: Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.checked.files import regular_file

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 1 << 20
"""A longer header is no PLY header; stops the search for its end in some other large file."""
_WORD = 128
"""Letters of a number in an ASCII file; a column takes as many for each of its rows."""


@dataclasses.dataclass
class _Element:
    """One element of the header: its rows, its scalar properties, its list properties."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]]  # name, type, type of the list length or None

    @property
    def has_lists(self) -> bool:
        return any(length is not None for _, _, length in self.properties)


def read_ply(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the elements of a PLY file as structured arrays, one per element.

    List properties (faces of a mesh) are read over and left out of the arrays.

    Args:
        path: ASCII or binary (either byte order) PLY file.

    Returns:
        Element name -> structured array with one field per scalar property.

    Raises:
        InputError: The file is missing, not a PLY, truncated, or holds text where numbers belong.
    """
    path = Path(path)
    size = regular_file(path)
    try:
        with open(path, "rb") as stream:
            order, elements = _read_header(path, stream)
            data: dict[str, NDArray[Any]] = {}
            body = stream if order != "=" else io.BytesIO(stream.read())
            for element in elements:
                if order == "=":
                    data[element.name] = _read_ascii(path, body, element)
                else:
                    data[element.name] = _read_binary(path, body, element, order, size)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror})", "check the path and its permissions"
        ) from error
    return data


def write_ply(
    path: str | Path, data: dict[str, NDArray[Any]], comments: tuple[str, ...] = ()
) -> None:
    """Write structured arrays as the elements of a binary little-endian PLY, atomically.

    Raises:
        RunError: The disk is full or the folder cannot be written.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    for name, rows in data.items():
        lines.append(f"element {name} {len(rows)}")
        for field in rows.dtype.names or ():
            lines.append(f"property {_NAMES[rows.dtype[field].str[1:]]} {field}")
    header = "\n".join([*lines, "end_header"]) + "\n"
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        for rows in data.values():
            stream.write(
                np.ascontiguousarray(
                    rows.astype(rows.dtype.newbyteorder("<"), copy=False)
                ).tobytes()
            )


def _read_header(path: Path, stream: Any) -> tuple[str, list[_Element]]:
    """Parse up to ``end_header``; return the byte order and the elements."""
    hint = "check that the file is a complete .ply"
    if stream.readline(16).strip() != b"ply":
        if path.stat().st_size == 0:
            raise InputError(f"{path}: not a PLY file (it is empty)", "copy or export it again")
        raise InputError(
            f"{path}: not a PLY file (it does not begin with 'ply')", "pass a 3DGS .ply file"
        )
    order, elements = "", list[_Element]()
    while True:
        raw = stream.readline(4096)
        if not raw or stream.tell() > _HEADER_LIMIT:
            raise InputError(f"{path}: the PLY header has no end_header", hint)
        words = raw.decode("ascii", errors="replace").split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "end_header":
            break
        try:
            if words[0] == "format":
                order = _ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                length = _TYPES[words[2]]
                if length.startswith("f"):
                    raise ValueError("a list has a whole number of entries")
                elements[-1].properties.append((words[4], _TYPES[words[3]], length))
            elif words[0] == "property":
                elements[-1].properties.append((words[2], _TYPES[words[1]], None))
            else:
                raise KeyError(words[0])
            if elements and elements[-1].count < 0:
                raise ValueError("negative count")
        except (KeyError, IndexError, ValueError) as error:
            line = " ".join(words)[:80]
            raise InputError(
                f"{path}: the PLY header line {line!r} is not understood", hint
            ) from error
    if not order:
        raise InputError(f"{path}: the PLY header names no format", hint)
    for element in elements:
        names = [name for name, _, _ in element.properties]
        if len(set(names)) != len(names):
            raise InputError(f"{path}: element {element.name} names a property twice", hint)
        if not names and element.count:
            raise InputError(
                f"{path}: element {element.name} promises {element.count} rows of no property", hint
            )
    return order, elements


def _scalar_dtype(element: _Element, order: str) -> np.dtype[Any]:
    return np.dtype(
        [(name, order + kind) for name, kind, length in element.properties if length is None]
    )


def _truncated(path: Path, element: _Element, got: int) -> InputError:
    return InputError(
        f"{path}: the file ends inside element {element.name}: it promises {element.count} rows, "
        f"got {got}",
        "the file is truncated; copy or export it again",
    )


def _read_binary(path: Path, stream: Any, element: _Element, order: str, size: int) -> NDArray[Any]:
    """Read one binary element; rows with lists one by one, all others in one go."""
    dtype = _scalar_dtype(element, order)
    if not element.has_lists:
        available = size - stream.tell()
        if element.count * dtype.itemsize > available:
            raise _truncated(path, element, available // max(dtype.itemsize, 1))
        rows = np.frombuffer(
            stream.read(element.count * dtype.itemsize), dtype=dtype, count=element.count
        )
        return rows.astype(dtype.newbyteorder("="))
    if element.count > size - stream.tell():  # every row takes at least one byte
        raise _truncated(path, element, 0)
    rows = np.zeros(element.count, dtype=dtype.newbyteorder("="))
    for row in range(element.count):
        for name, kind, length in element.properties:
            repeat = 1
            if length is not None:
                repeat = int(_read_values(path, stream, element, order + length, 1, row, size)[0])
            values = _read_values(path, stream, element, order + kind, repeat, row, size)
            if length is None:
                rows[name][row] = values[0]
    return rows


def _read_values(
    path: Path, stream: Any, element: _Element, kind: str, count: int, row: int, most: int
) -> NDArray[Any]:
    if count < 0:
        raise InputError(
            f"{path}: element {element.name}, row {row}: a list of {count} entries",
            "export it again",
        )
    width = np.dtype(kind).itemsize * count
    raw = stream.read(min(width, most))
    if len(raw) < width:
        raise _truncated(path, element, row)
    return np.frombuffer(raw, dtype=kind)


def _read_ascii(path: Path, stream: Any, element: _Element) -> NDArray[Any]:
    """Read one ASCII element, one row per line."""
    dtype = _scalar_dtype(element, "=")
    names = [name for name, _, _ in element.properties]
    lines: list[list[bytes]] = []
    longest = 0
    while len(lines) < element.count:
        raw = stream.readline()
        if not raw:
            raise _truncated(path, element, len(lines))
        words = raw.split()
        if words:
            lines.append(words)
            longest = max(longest, *map(len, words))
    if longest > _WORD:
        raise InputError(
            f"{path}: element {element.name} has a word of {longest} letters", "export it again"
        )
    try:
        if element.has_lists:
            lines = [_scalar_words(words, element) for words in lines]
        if any(len(words) < len(dtype.names or ()) for words in lines):
            raise ValueError("a line has too few numbers")
        rows = np.zeros(element.count, dtype=dtype)
        scalars = [name for name in names if name in (dtype.names or ())]
        for column, name in enumerate(scalars):
            rows[name] = np.array([words[column] for words in lines], dtype="S").astype(dtype[name])
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(
            f"{path}: element {element.name} holds text that is not a number ({error})",
            "export it again",
        ) from error
    return rows


def _scalar_words(words: list[bytes], element: _Element) -> list[bytes]:
    """Drop the list properties from one line of words."""
    kept: list[bytes] = []
    place = 0
    for _, _, length in element.properties:
        if length is None:
            kept.append(words[place])
            place += 1
        else:
            entries = int(words[place])
            if entries < 0:
                raise ValueError(f"a list of {entries} entries")
            place += 1 + entries
    return kept
