"""Splats in PlayCanvas' ``.sog``: a zip of pictures whose pixels are splats, version 2; read only.

``means_l`` and ``means_u`` are the low and high byte of positions between limits, on the scale
``sign(x) log(1 + |x|)``; scales and colours are places in code books; ``quats`` has three
components in 8 bits and in alpha which one is left out; ``shN_labels`` names a row of the palette
``shN_centroids``, 64 of them per line. Layout: "The SOG Format", PlayCanvas developer site.
"""

from __future__ import annotations

import json
import logging
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.limits import limit, unpacked_limit, within
from gsfluent.io.checked.pictures import opened_image
from gsfluent.io.splats.compressed import float_tensor

_log = logging.getLogger(__name__)
_AGAIN = "export it again, or convert it to .ply with splat-transform (npm)"
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_PALETTE_WIDTH = 64
_PLACES = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # what is kept of wxyz


def load_sog(path: str | Path) -> Gaussians:
    """Read a ``.sog``, as float32 on the CPU.

    Raises:
        InputError: Missing, damaged, of another version, above a limit, or values that no splat
            can have.
    """
    most = unpacked_limit(regular_file(path))
    try:
        with zipfile.ZipFile(path) as archive:
            items = {item.filename: item for item in archive.infolist()}
            within("unpacked_bytes", sum(item.file_size for item in items.values()), path, most)
            if any(item.compress_type not in _METHODS for item in items.values()):
                raise ValueError("packed by an unknown method")
            within("json_bytes", items["meta.json"].file_size, path)
            meta = json.loads(archive.read("meta.json"))
            if not isinstance(meta, dict) or meta.get("version") != 2:
                raise InputError(f"{path}: is not version 2 of the format", _AGAIN)
            return _decode(path, meta, archive).validated(str(path))
    except (
        OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, OverflowError,
        RecursionError, AttributeError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: the .sog is damaged ({error})", _AGAIN) from error


def _decode(path: str | Path, meta: dict[str, Any], archive: zipfile.ZipFile) -> Gaussians:
    count = int(meta["count"])
    if not 0 < count <= limit("pixels"):
        raise ValueError(f"count {count}")

    def pixels(key: str, which: int = 0, rows: int = count) -> NDArray[np.uint8]:
        """RGBA of the first pixels of a picture, [rows, 4]."""
        name = str(meta[key]["files"][which])
        with opened_image(f"{path}: {name}", _AGAIN, data=archive.read(name)) as image:
            found = np.asarray(image.convert("RGBA")).reshape(-1, 4)[:rows]
        if len(found) < rows:
            raise ValueError(f"{name} has {len(found)} of {rows} pixels")
        return found

    low, high = (np.array(meta["means"][key], dtype=np.float64) for key in ("mins", "maxs"))
    level = pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]
    bent = low.reshape(1, 3) + level / 65535.0 * (high - low).reshape(1, 3)
    with np.errstate(over="ignore"):
        means = np.sign(bent) * np.expm1(np.abs(bent))
        scales = np.exp(_book(meta["scales"])[pixels("scales")[:, :3]])
    color = pixels("sh0")
    sh = _book(meta["sh0"])[color[:, :3]][:, None]
    if "shN" in meta and not {*meta["shN"]["files"]} <= {*archive.namelist()}:
        _log.warning("%s: %s are not in it; colours are the same from all sides", path,
                     " and ".join(map(str, meta["shN"]["files"])))  # fmt: skip
    elif "shN" in meta:
        sh = np.concatenate([sh, _palette(meta["shN"], pixels)], axis=1)
    return Gaussians(
        means=float_tensor(means),
        quats=float_tensor(_quaternions(pixels("quats"))),
        scales=float_tensor(scales),
        opacities=float_tensor(color[:, 3] / 255.0),
        sh=float_tensor(sh),
    )


def _book(part: dict[str, Any]) -> NDArray[np.float64]:
    """The code book of a property, 256 numbers."""
    book = np.array(part["codebook"], dtype=np.float64)
    if book.shape != (256,):
        raise ValueError(f"a code book of {book.shape}")
    return book


def _palette(part: dict[str, Any], pixels: Any) -> NDArray[np.float64]:
    """SH rest of each splat [N, K - 1, 3]."""
    entries, bands = int(part["count"]), int(part["bands"])
    if not 1 <= bands <= 3 or not 0 < entries <= 65536:
        raise ValueError(f"a palette of {entries} rows of {bands} bands")
    width = (bands + 1) ** 2 - 1
    lines = -(-entries // _PALETTE_WIDTH)
    table = pixels("shN", 0, lines * _PALETTE_WIDTH * width)[:, :3].reshape(-1, width, 3)
    label = pixels("shN", 1).astype(np.int64)
    return _book(part)[table[label[:, 0] + 256 * label[:, 1]]]


def _quaternions(rgba: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Unit quaternions ``wxyz`` [N, 4]."""
    left_out = rgba[:, 3].astype(np.int64) - 252
    if (left_out < 0).any():
        raise ValueError("a quaternion without its mark")
    small = (rgba[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    quats = np.zeros((len(rgba), 4))
    np.put_along_axis(quats, _PLACES[left_out], small, axis=1)
    missing = np.sqrt(np.clip(1.0 - (small**2).sum(axis=1), 0.0, None))
    np.put_along_axis(quats, left_out[:, None], missing[:, None], axis=1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
