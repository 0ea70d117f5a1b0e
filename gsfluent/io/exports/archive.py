"""A capture in a zip: what belongs to captures is unpacked once, beside the zip."""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from gsfluent.errors import InputError, RunError
from gsfluent.io.atomic import write_json
from gsfluent.io.checked.files import read_json, regular_file
from gsfluent.io.checked.limits import unpacked_limit, within
from gsfluent.io.images import IMAGE_SUFFIXES

_KEPT = (*IMAGE_SUFFIXES, ".bin", ".txt", ".json", ".ply")
_MARK = ".unpacked.json"
_AGAIN = "export or zip it again"


def unpacked(path: Path) -> Path:
    """The folder that holds what is in a zip; it is made on the first call.

    It has the name of the zip and ``_unpacked``. Only files of captures come out of it
    (photographs, ``.bin``, ``.txt``, ``.json``, ``.ply``), only into that folder.

    Raises:
        InputError: Missing, no zip, damaged, a name that leads out of the folder, above the limit
            of unpacked bytes, or a folder of that name from elsewhere.
        RunError: The folder cannot be written.
    """
    size = regular_file(path, "zip")
    folder = path.with_name(f"{path.stem}_unpacked")
    state = {"bytes": size, "changed": path.stat().st_mtime_ns}
    if folder.exists():
        mark = folder / _MARK
        if mark.is_file() and read_json(mark) == state:
            return folder
        raise InputError(
            f"{folder}: is not from {path.name} as it is now", "remove it, or name it itself"
        )
    try:
        made = Path(tempfile.mkdtemp(prefix=".unpacking-", dir=path.parent))
    except OSError as error:
        raise RunError(
            f"{path.parent}: cannot be written ({error.strerror})",
            hint="unpack the zip elsewhere and name that folder",
        ) from error
    try:
        _extract(path, made, size)
        write_json(made / _MARK, state)
        made.replace(folder)
    except OSError as error:
        raise RunError(f"{path}: cannot be unpacked ({error})", hint="free some space") from error
    finally:
        shutil.rmtree(made, ignore_errors=True)
    return folder


def _extract(path: Path, folder: Path, size: int) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            items = [item for item in archive.infolist() if _wanted(path, item)]
            within(
                "unpacked_bytes", sum(item.file_size for item in items), path, unpacked_limit(size)
            )
            for item in items:
                target = folder / item.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(item) as source, open(target, "wb") as stream:
                    shutil.copyfileobj(source, stream)
    except InputError:
        raise
    except (
        zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, LookupError,
        NotADirectoryError, IsADirectoryError, FileExistsError, json.JSONDecodeError,
    ) as error:  # fmt: skip
        raise InputError(f"{path}: the zip is damaged ({error})", _AGAIN) from error


def _wanted(path: Path, item: zipfile.ZipInfo) -> bool:
    """Whether a member is a file of a capture.

    Raises:
        InputError: Its name leads out of the folder.
    """
    name = PurePosixPath(item.filename)
    if name.is_absolute() or ".." in name.parts or "\\" in item.filename or "\0" in item.filename:
        raise InputError(f"{path}: {item.filename!r} leads out of the folder", "unpack it yourself")
    if item.is_dir() or name.suffix.lower() not in _KEPT or name.parts[0] == "__MACOSX":
        return False
    if not item.filename or len(item.filename) > 200 or name.name.startswith("."):
        return False
    return True
