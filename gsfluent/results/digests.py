"""Digests of a stage's files: written down as the files appear, compared before they are believed.

While a stage is at work, :class:`Journal` keeps a list beside its files. When it has finished, its
record (``stage.json``) holds the digests of all of them, and one of itself.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsfluent.errors import RunError
from gsfluent.io.atomic import atomic_path, to_json

RECORD = "stage.json"
"""Name of the record of a stage in its folder."""
WRITTEN = "written.txt"
"""Name of the list of what an unfinished stage has written."""
_CHUNK = 1 << 22
"""Bytes that are read and hashed in one go. Around each the thread waits for Python's lock, beside
a busy one up to 5 ms at a time; larger ones leave the cache."""


def update(digest: Any, path: Path) -> None:
    """Feed a file to a hash."""
    with path.open("rb", buffering=0) as stream:
        room = memoryview(bytearray(min(_CHUNK, os.fstat(stream.fileno()).st_size + 1)))
        while count := stream.readinto(room):
            digest.update(room[:count])


def file_digest(path: Path) -> str:
    """BLAKE2b of a file, 32 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=16)
    update(digest, path)
    return digest.hexdigest()


def _check(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def differing(folder: Path, files: Mapping[str, str]) -> list[str]:
    """Names of the files that are missing or differ from their digests."""
    return [name for name, known in files.items() if not _is(folder / name, [known])]


def _is(path: Path, known: Iterable[str]) -> bool:
    return path.is_file() and file_digest(path) in known


def write_record(path: Path, values: Mapping[str, Any]) -> None:
    """Write the record of a stage, with a digest of itself, atomically.

    Raises:
        RunError: The disk is full.
    """
    text = _sealed(values)
    with atomic_path(path) as part:
        part.write_text(text, encoding="utf-8")


def read_record(path: Path) -> tuple[dict[str, Any], str]:
    """Read the record of a stage.

    Returns:
        It, and what is wrong with it in words; an empty one where it is missing or not believed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}, f"{path.name} is missing"
    except (OSError, ValueError) as error:
        return {}, f"{path.name} cannot be read ({error})"
    try:
        values = json.loads(text)
        known = dict(values).pop("digest", None)
        body = {key: value for key, value in values.items() if key != "digest"}
        if known is None:
            return {}, f"{path.name} has no digests, so nothing says that it is true"
        if _sealed(body) == text:
            return body, ""
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    return {}, f"{path.name} differs from what was written"


def _sealed(values: Mapping[str, Any]) -> str:
    """The text of a record; every byte of it is under its digest."""
    return to_json({**values, "digest": _check(to_json(values))})


class Journal:
    """The list of the files that a stage at work has written, and of their digests.

    The line of a file is added before the file appears: a file on disk always has its line, and a
    kill in between leaves a line too many. So the last two digests of a name are good, and the
    file of the last line may be missing. Each line ends with a digest of itself.

    Args:
        folder: Folder of the stage.
        home: Files written elsewhere than below this folder are none of its business.
    """

    def __init__(self, folder: Path, home: Path) -> None:
        self.path = folder / WRITTEN
        self._folder, self._home = folder.absolute(), home.absolute()
        self._noted: dict[str, list[str]] = {}
        self._last = ""

    def note(self, temporary: Path, path: Path) -> None:
        """Add the line of a file that is about to get its name.

        Raises:
            OSError: The disk is full; the list is as before.
        """
        path = path.absolute()
        if path.name.startswith(".") or not path.is_relative_to(self._home):
            return
        name = Path(os.path.relpath(path, self._folder)).as_posix()
        known = file_digest(temporary)
        _append(self.path, _line(name, known))
        self._take(name, known)

    def _take(self, name: str, known: str) -> None:
        self._noted[name] = [*self._noted.get(name, ())[-1:], known]
        self._last = name

    def read(self) -> str:
        """Read the list that an earlier process left; returns what is wrong, or nothing.

        It is cut down to the files that are there, so that it can be gone on with.
        """
        try:
            *lines, torn = self.path.read_text(encoding="utf-8").split("\n")
        except FileNotFoundError:
            return f"{WRITTEN} is missing"
        except ValueError:
            return f"{WRITTEN} differs from what was written"
        # a line that was being added when the process was killed has no file yet
        lines += [torn] if _parsed(torn) or _parsed(torn[:-1]) else []
        for line in lines:
            found = _parsed(line)
            if found is None:
                return f"{WRITTEN} differs from what was written"
            self._take(*found)
        files = {}
        for name, known in self._noted.items():
            path = self._folder / name
            if not path.is_file():
                if name and name != self._last:
                    return f"{name} is missing"
                continue
            files[name] = file_digest(path)
            if files[name] not in known:
                return f"{name} differs from its digest"
        self.keep(files)
        return ""

    def keep(self, files: Mapping[str, str]) -> None:
        """Begin anew with files that are there.

        Raises:
            RunError: The disk is full.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._noted = {name: [known] for name, known in files.items()}
        # the last line is of no file: none of these may be missing from now on
        self._last = ""
        text = "".join(_line(*item) for item in [*files.items(), ("", "0" * 32)])
        with atomic_path(self.path) as part:
            part.write_text(text, encoding="utf-8")

    def files(self, without: Iterable[str] = ()) -> dict[str, str]:
        """Digests by name of what was noted and of whatever else lies in the folder.

        Args:
            without: Names to leave out.
        """
        inside = {
            path.relative_to(self._folder).as_posix()
            for path in self._folder.rglob("*")
            if path.is_file() and not path.name.startswith(".")
        }
        noted = {name for name in self._noted if name and (self._folder / name).is_file()}
        names = sorted((inside | noted) - {RECORD, WRITTEN, *without})
        return {
            name: self._noted[name][-1] if name in noted else file_digest(self._folder / name)
            for name in names
        }

    def remove(self) -> None:
        """Remove the list: the record of the finished stage has taken its place."""
        self.path.unlink(missing_ok=True)


def _line(name: str, known: str) -> str:
    text = f"{known} {json.dumps(name)}"
    return f"{text} {_check(text)}\n"


def _parsed(line: str) -> tuple[str, str] | None:
    """Name and digest of a line; None for one that is not whole."""
    text, _, check = line.rpartition(" ")
    if not text or check != _check(text):
        return None
    known, _, name = text.partition(" ")
    return str(json.loads(name)), known


def _append(path: Path, line: str) -> None:
    """Add a line to a file, all of it or nothing."""
    data = line.encode()
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        size = os.fstat(handle).st_size
        try:
            if os.write(handle, data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            os.fsync(handle)
        except OSError:
            os.ftruncate(handle, size)
            raise
    finally:
        os.close(handle)


def require_intact(folder: Path) -> None:
    """Compare the files of a finished stage with its record, before they are read.

    A stage at work, and one whose record has no digests, has nothing to be compared with.

    Raises:
        RunError: A file is missing or differs, or the record itself does.
    """
    record, wrong = read_record(folder / RECORD)
    if not record:
        if wrong.endswith("what was written"):
            raise _changed(folder, wrong)
        return
    lost = differing(folder, record.get("files") or {})
    if lost:
        raise _changed(folder, f"{lost[0]} is missing or differs from its digest")


def _changed(folder: Path, wrong: str) -> RunError:
    return RunError(
        f"{folder}: {wrong}",
        "what the other stages left",
        "run the shot again; it does this stage anew",
    )
