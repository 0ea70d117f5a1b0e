"""A process that reads changed files, each in a child with limits of time and memory.

It loads everything once and forks for each file, so a file costs milliseconds and a crash ends a
child only. It runs without threads of its own, so that forking is safe. Started by
:class:`Reading`; the other half of this file is what runs inside.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import IO, Any

HERE = Path(__file__).resolve().parent
CPU_SECONDS, WALL_SECONDS = 5.0, 40.0
ALLOWED = {"unpacked_bytes": 1 << 24, "pixels": 1 << 20, "label_pixels": 1 << 22,
           "painted_pixels": 1 << 25, "json_bytes": 1 << 22}  # fmt: skip
"""Limits of :mod:`gsfluent.io.checked.limits` while fuzzing, small so that memory is, too."""
MEMORY = 4 * ALLOWED["unpacked_bytes"] + (128 << 20)
"""Address space a child may add: four times what is allowed, and as much as libraries take."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What became of one file: ``read``, ``refused``, or a finding."""

    kind: str
    text: str

    @property
    def fine(self) -> bool:
        return self.kind in ("read", "refused")


class Reading:
    """The process, from outside."""

    def __init__(self) -> None:
        limits = {f"GSFLUENT_MAX_{name.upper()}": str(size) for name, size in ALLOWED.items()}
        alone = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        rooms = (HERE.parents[1], HERE, HERE.parent / "io", HERE.parent / "viewer")
        path = os.pathsep.join(map(str, rooms))
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(HERE / "fuzz_server.py")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | limits | alone | {"MALLOC_ARENA_MAX": "1", "PYTHONPATH": path},
        )  # fmt: skip
        self.parts: dict[str, list[bytes]] = {}
        for name, parts in self._answer().items():
            self.parts[name] = [base64.b64decode(part) for part in parts]

    def read(self, name: str, parts: list[bytes]) -> Verdict:
        """Put the parts of a reader's file together and read it."""
        assert self._process.stdin is not None
        packed = [base64.b64encode(part).decode() for part in parts]
        self._process.stdin.write(json.dumps([name, packed]) + "\n")
        self._process.stdin.flush()
        return Verdict(*self._answer())

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the reading process ended with {self._process.wait()}")
        return json.loads(line)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


# --- inside ---


def serve(folder: Path) -> None:
    """Answer until there are no more questions."""
    import fuzz_readers
    from PIL import Image, features  # noqa: F401 - loaded once, not by every child

    Image.init()
    answers = sys.stdout
    sys.stdout = sys.stderr
    made = {name: fuzz_readers.prepare(name, folder / name) for name in fuzz_readers.READERS}
    for name in made:  # what is loaded late is loaded now
        with contextlib.suppress(Exception):
            fuzz_readers.READERS[name].read(folder / name)
    _say(answers, {n: [base64.b64encode(p).decode() for p in parts] for n, (parts, _) in
                   made.items()})  # fmt: skip
    for line in sys.stdin:
        name, packed = json.loads(line)
        if name in fuzz_readers.WRONG:
            _say(answers, _forked(lambda: fuzz_readers.WRONG[name](folder), folder))  # noqa: B023
            continue
        reader, place = fuzz_readers.READERS[name], folder / name
        data = made[name][1]([base64.b64decode(part) for part in packed])
        (place / reader.target).write_bytes(data)
        _say(answers, _forked(lambda: reader.read(place), place))  # noqa: B023 - called at once


def _say(stream: IO[str], value: Any) -> None:
    stream.write(json.dumps(value) + "\n")
    stream.flush()


def _forked(read: Any, place: Path) -> list[str]:
    """Read in a child."""
    take, give = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(take)
        verdict = _limited(read, place)
        os.write(give, json.dumps(verdict)[:60000].encode())
        os._exit(0)
    os.close(give)
    end = time.monotonic() + WALL_SECONDS
    while (done := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            os.close(take)
            return ["hang", f"over {WALL_SECONDS:g} s"]
        time.sleep(0.0005)
    with open(take, "rb") as stream:
        text = stream.read()
    if os.WIFSIGNALED(done[1]):
        number = os.WTERMSIG(done[1])
        kind = "hang" if number == signal.SIGPROF else "crash"
        return [kind, signal.Signals(number).name]
    return json.loads(text) if text else ["crash", f"exit code {os.WEXITSTATUS(done[1])}"]


def _limited(read: Any, place: Path) -> list[str]:
    """Read under limits; the verdict and what was said."""
    from gsfluent.errors import InputError, RunError

    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, now + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # what libraries say about damaged files
    try:
        result = read()
    except (InputError, RunError) as error:
        if not error.hint:
            return ["no hint", str(error)]
        named = any(path.name in str(error) for path in place.rglob("*")) or str(place) in str(
            error
        )
        return ["refused", str(error)] if named else ["no file named", str(error)]
    except MemoryError:
        return ["memory", traceback.format_exc()[-1500:]]
    except Exception:
        return ["exception", traceback.format_exc()[-1500:]]
    wrong = not_finite(result)
    return ["not finite", wrong] if wrong else ["read", ""]


def not_finite(value: Any, where: str = "") -> str:
    """Where in a result NaN or infinity stands, "" when nowhere."""
    import numpy as np
    import torch

    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    if isinstance(value, np.ndarray):
        bad = value.dtype.kind == "f" and not np.isfinite(value).all()
        return f"{where}: {value.dtype} {list(value.shape)}" if bad else ""
    if isinstance(value, float):
        return "" if math.isfinite(value) else where
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = [(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)]
    elif isinstance(value, dict):
        pairs = [(str(key), item) for key, item in value.items()]
    elif isinstance(value, list | tuple):
        pairs = [(str(index), item) for index, item in enumerate(value)]
    else:
        return ""
    return next((bad for name, item in pairs if (bad := not_finite(item, f"{where}.{name}"))), "")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        serve(Path(made))
