"""NumPy files: what their headers declare is checked before it is allocated.

``numpy.load`` allocates what a header says, and a member of a compressed archive may say anything;
it also lets the errors of zip, zlib and the tokenizer through.
"""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.limits import unpacked_limit, within

_HEADER = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DAMAGE = (
    OSError, ValueError, LookupError, EOFError, RuntimeError, OverflowError, TypeError, SyntaxError,
    zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError,
)  # fmt: skip
"""What damaged archives raise; an unknown method and an encrypted member are RuntimeErrors."""


def read_npy(path: str | Path, hint: str = "save it again with numpy.save") -> NDArray[Any]:
    """Read a ``.npy`` file of numbers, truth values or text.

    Raises:
        InputError: Missing, no such file, damaged, or it declares more than it holds.
    """
    size = regular_file(path)
    try:
        with open(path, "rb") as stream:
            return _read(stream, size, str(path))
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: the NumPy file is damaged ({error})", hint) from error


def read_npz(
    path: str | Path,
    names: Collection[str] | None = None,
    hint: str = "save it again with numpy.savez",
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an ``.npz`` file.

    Args:
        path: The file.
        names: Only these; all when None.
        hint: What to do when it is damaged.

    Returns:
        Name -> array, in the order of the file.

    Raises:
        InputError: Missing, no such file, damaged, one of ``names`` is not there, or the arrays
            together are above the limit.
    """
    most, found = unpacked_limit(regular_file(path)), dict[str, NDArray[Any]]()
    try:
        with open(path, "rb") as stream, zipfile.ZipFile(stream) as archive:
            members = {item.filename.removesuffix(".npy"): item for item in archive.infolist()}
            chosen = {name: members[name] for name in (members if names is None else names)}
            within("unpacked_bytes", sum(i.file_size for i in chosen.values()), path, most)
            for name, item in chosen.items():
                if item.compress_type not in _METHODS:
                    raise ValueError(f"{name} is packed by method {item.compress_type}")
                with archive.open(item) as member:
                    found[name] = _read(member, item.file_size, f"{path}: {name}")
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: the NumPy file is damaged ({error})", hint) from error
    return found


def _read(stream: Any, size: int, where: str) -> NDArray[Any]:
    """One array of a stream of ``size`` bytes."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADER:
        raise ValueError(f"version {version} of the format")
    # the length of the header stands before it; numpy refuses to parse more than 10 000 letters
    shape, fortran, dtype = _HEADER[version](stream)
    if dtype.kind not in "biufcSU":
        raise ValueError(f"{where} holds {dtype}, not numbers")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or dtype.itemsize * max(count, 1) > max(size, dtype.itemsize):
        raise ValueError(f"{where} declares {list(shape)} of {dtype} in {size} bytes")
    raw = bytearray(count * dtype.itemsize)
    got = 0
    with memoryview(raw) as view:
        while got < len(raw) and (part := stream.readinto(view[got:])):
            got += part
    if got < len(raw):
        raise EOFError(f"{where} ends after {got} of {len(raw)} bytes")
    if stream.read(1):  # also makes an archive compare the check sum
        raise ValueError(f"{where} goes on after its last number")
    flat = np.frombuffer(raw, dtype=dtype, count=count)
    whole = flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
    return whole if whole.dtype.isnative else whole.astype(whole.dtype.newbyteorder("="))
