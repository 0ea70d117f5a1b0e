"""A sweep whose results lie in an object store: S3, and what speaks like it, through fsspec.

Object stores cannot rename. The files of a try go to ``shots/ID/TRY/``; then ``done/ID``, its row
and the name of the try, is put on the condition that there is none (``If-None-Match: *``), which
one of many can do. One listing of ``done`` finds a thousand finished tasks. What is at work, and
solids that tasks share, lie in a folder of each machine.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from gsfluent.errors import GsfluentError, InputError, need
from gsfluent.progress import Progress, report_progress
from gsfluent.sweep.claims import SILENCE, beating, has_ended, myself, read_words
from gsfluent.sweep.folder import OWNER, SweepFolder

_SCHEME = re.compile(r"(\w{2,}):/+(.+)")  # a Path has one slash of two
_HINT = "see docs/guide/cluster.md: the bucket, AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL"


def is_store(root: str | Path) -> bool:
    """Whether this names a place in a store, and not a folder."""
    return _SCHEME.fullmatch(str(root)) is not None


def opened(root: str | Path) -> SweepFolder:
    """The folder of a sweep, or its place in a store.

    Args:
        root: A path, or ``s3://BUCKET/PLACE``.

    Raises:
        InputError: Another kind of store.
        MissingPackage: s3fs is not installed.
    """
    found = _SCHEME.fullmatch(str(root))
    if found is None:
        return SweepFolder(Path(root).absolute())
    if found[1] != "s3":
        raise InputError(
            f"{root}: sweeps are kept in folders and at s3://BUCKET/PLACE",
            "other stores that speak S3 are named by AWS_ENDPOINT_URL",
        )
    url = f"s3://{found[2].rstrip('/')}"
    digest = hashlib.blake2b(url.encode(), digest_size=8).hexdigest()
    user = os.getuid() if hasattr(os, "getuid") else 0
    return SweepBucket(Path(tempfile.gettempdir()) / f"gsfluent-{user}-{digest}", url)


def fetch(
    url: str | Path,
    folder: Path,
    ids: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> SweepFolder:
    """Bring finished tasks from a store into a folder, as if they had been done there.

    Args:
        url: The place in the store.
        folder: The folder; what is in it is not brought again.
        ids: Some tasks; all when absent.
        progress: Called per task.

    Raises:
        InputError: Nobody answers there.
    """
    store, here = opened(url), SweepFolder(folder)
    if not isinstance(store, SweepBucket):
        raise InputError(f"{url}: not a place in a store", "give s3://BUCKET/PLACE")
    here.make()
    names = sorted((store.done() if ids is None else set(ids)) - here.done())
    for number, (name, row) in enumerate(store.rows(names).items(), 1):
        work = here.begin(name)
        store.bring(name, str(row["try"]), work)
        here.finish(name, work, {key: value for key, value in row.items() if key != "try"})
        report_progress(progress, number, len(names), name)
    return here


@functools.cache
def _client() -> Any:
    """The connection of this process; it is told of a server by the variables of AWS."""
    return need("s3fs", "s3", "a sweep at s3://").S3FileSystem(use_listings_cache=False)


@contextmanager
def _asking(url: str) -> Iterator[None]:
    """Say all that a client raises as errors of the moment, which another try may not meet."""
    try:
        yield
    except (OSError, GsfluentError):
        raise
    except Exception as error:  # of botocore and aiohttp, which have no class in common
        raise ConnectionError(f"{url}: {type(error).__name__}: {error}") from error


@dataclasses.dataclass(frozen=True)
class SweepBucket(SweepFolder):
    """A place in a store, and beside it a folder of this machine."""

    url: str

    @property
    def address(self) -> str | Path:
        """What other processes open it by."""
        return self.url

    def make(self) -> None:
        """Make the folder; see that the store is there and keeps to a condition.

        Raises:
            InputError: It does not answer, refuses us, or puts what it should not.
        """
        super().make()
        probe = f"claims/.probe-{secrets.token_hex(8)}"
        try:
            twice = [self._create(probe, {}) for _ in range(2)]
            self._remove([probe])
        except OSError as error:
            raise InputError(f"{self.url}: {error}", _HINT) from error
        if twice != [True, False]:
            raise InputError(
                f"{self.url}: its store puts an object over another in spite of If-None-Match",
                "take one that knows the condition, or a folder that the machines share",
            )

    def done(self) -> set[str]:
        """Names of the finished tasks."""
        return {key.rpartition("/")[2] for key in self._find("done")}

    def is_done(self, name: str) -> bool:
        """Whether a task is finished."""
        return self.row(name) is not None

    def row(self, name: str) -> dict[str, Any] | None:
        """The row of a finished task, and the ``try`` that its files are of."""
        return self._read(f"done/{name}")

    def rows(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """The rows of those of some tasks that are finished."""
        return {k.rpartition("/")[2]: v for k, v in self._read_all(f"done/{n}" for n in names)}

    def files(self, name: str) -> Path | None:
        """No files of a finished task lie on this machine."""
        return None

    def bring(self, name: str, try_: str, folder: Path) -> None:
        """Copy the files of a try into a folder."""
        there = f"shots/{name}/{try_}"
        keys = self._find(there)
        targets = [folder / key.removeprefix(f"{there}/") for key in keys]
        for target in targets:
            target.parent.mkdir(parents=True, exist_ok=True)
        with _asking(self.url):
            _client().get([f"{self.url}/{k}" for k in keys], [str(target) for target in targets])

    def leave(self, paths: Sequence[Path]) -> None:
        """Copy files into the place itself, over older ones of their names."""
        with _asking(self.url):
            _client().put([str(path) for path in paths], [f"{self.url}/{p.name}" for p in paths])

    def finish(self, name: str, folder: Path, row: dict[str, Any]) -> bool:
        """Upload a try and name it the task's, if none has the name; its folder goes.

        Raises:
            OSError: It cannot be uploaded.
        """
        (folder / OWNER).unlink(missing_ok=True)
        try_ = folder.name.rpartition(".")[2]
        there = f"shots/{name}/{try_}"
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        with _asking(self.url):
            targets = [f"{self.url}/{there}/{p.relative_to(folder).as_posix()}" for p in files]
            _client().put([str(path) for path in files], targets)
        ours = self._create(f"done/{name}", row | {"try": try_})
        if not ours:  # an answer that was lost on its way is asked for again: it may be we
            ours = (self.row(name) or {}).get("try") == try_
        tries = self._find(f"shots/{name}")
        self._remove(key for key in tries if key.startswith(f"{there}/") is not ours)
        shutil.rmtree(folder, ignore_errors=True)
        if ours:
            self.forgive([name])
        return ours

    def fail(self, name: str, record: dict[str, Any]) -> None:
        """Note a try that went wrong, as in a folder."""
        words = {"id": name, "host": socket.gethostname(), "seconds": time.time(), **record}
        self._put(f"failed/{name}/{secrets.token_hex(4)}", words)

    def failures(self, name: str = "") -> dict[str, list[dict[str, Any]]]:
        """Tries that went wrong, of all tasks or of one, by name, the oldest first."""
        found: dict[str, list[dict[str, Any]]] = {}
        for _, record in self._read_all(self._find(f"failed/{name}".rstrip("/"))):
            found.setdefault(str(record["id"]), []).append(record)
        for records in found.values():
            records.sort(key=lambda record: float(record["seconds"]))
        return found

    def forgive(self, names: Iterable[str]) -> None:
        """Forget the failed tries of tasks."""
        wanted = set(names)
        where = "failed" if len(wanted) != 1 else f"failed/{next(iter(wanted))}"
        self._remove(key for key in self._find(where) if key.split("/")[1] in wanted)

    def held(self, name: str) -> AbstractContextManager[bool]:
        """Hold the claim of a task; whether it is ours."""
        return self._held(f"claims/{name}")

    def free(self, name: str) -> None:
        """Drop the claim of a process that is known to have ended."""
        self._remove([f"claims/{name}"])

    def abandoned(self, names: Iterable[str]) -> list[str]:
        """Those of some tasks that nobody is at work on."""
        some = list(names)
        now = self._clock() if some else 0.0
        return [name for name in some if self._is_stale(f"claims/{name}", now)]

    def tidy(self) -> None:
        """Remove claims of processes of this machine that have ended, and their tries."""
        claims = self._read_all(self._find("claims"))
        self._remove(key for key, words in claims if has_ended(words))
        for left in (self.root / "work").iterdir():
            ended = has_ended(read_words(left / OWNER) or {})
            if ended and self.is_done(left.name.partition(".")[0]):
                shutil.rmtree(left, ignore_errors=True)

    @contextmanager
    def _held(self, key: str) -> Iterator[bool]:
        mine = myself() | {"token": secrets.token_hex(4)}
        if not self._create(key, mine):
            if not self._is_stale(key, self._clock()):
                yield False
                return
            # two may both take it over: that costs time, and ``done`` lets one of them through
            self._put(key, mine)

        def beat() -> None:
            if self._read(key) == mine:
                self._put(key, mine)

        try:
            with beating(beat):
                yield True
        finally:
            with suppress(OSError):  # it is stale in two minutes
                if self._read(key) == mine:
                    self._remove([key])

    def _is_stale(self, key: str, now: float) -> bool:
        with _asking(self.url):
            try:
                heard = _client().info(f"{self.url}/{key}")["LastModified"].timestamp()
            except FileNotFoundError:
                return True
        return now - heard > SILENCE or has_ended(self._read(key) or {})

    def _clock(self) -> float:
        """The time by the clock of the store [s]."""
        key = f"claims/.clock-{secrets.token_hex(4)}"
        self._put(key, {})
        with _asking(self.url):
            now = float(_client().info(f"{self.url}/{key}")["LastModified"].timestamp())
        self._remove([key])
        return now

    def _find(self, folder: str) -> list[str]:
        """Keys of all objects below a folder."""
        with _asking(self.url):
            try:
                found = _client().find(f"{self.url}/{folder}")
            except FileNotFoundError:
                return []
        return [path.removeprefix(self.url.removeprefix("s3://") + "/") for path in found]

    def _create(self, key: str, words: dict[str, Any]) -> bool:
        """Put a JSON object where there is none; False where there is one."""
        path = f"{self.url}/{key}"
        with _asking(self.url):
            try:
                _client().pipe_file(path, json.dumps(words).encode(), mode="create")
            except FileExistsError:
                return False
            except OSError:
                if self._read(key) is None:
                    raise
                return False  # another's put was under way
        return True

    def _put(self, key: str, words: dict[str, Any]) -> None:
        with _asking(self.url):
            _client().pipe_file(f"{self.url}/{key}", json.dumps(words).encode())

    def _read(self, key: str) -> dict[str, Any] | None:
        return dict(self._read_all([key])).get(key)

    def _read_all(self, keys: Iterable[str]) -> list[tuple[str, dict[str, Any]]]:
        """JSON objects by key, without those that are missing."""
        paths = {f"{self.url.removeprefix('s3://')}/{key}": key for key in keys}
        if not paths:
            return []
        with _asking(self.url):
            found = _client().cat(list(paths), on_error="return")
        if not isinstance(found, dict):
            found = {next(iter(paths)): found}
        read = []
        for path, data in found.items():
            if isinstance(data, FileNotFoundError):
                continue
            if isinstance(data, Exception):
                raise ConnectionError(f"{self.url}: {data}") from data
            read.append((paths[path], dict(json.loads(data))))
        return read

    def _remove(self, keys: Iterable[str]) -> None:
        paths = [f"{self.url}/{key}" for key in keys]
        if paths:
            with _asking(self.url), suppress(FileNotFoundError):
                _client().rm(paths)
