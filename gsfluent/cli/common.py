"""What every verb has: ``--json``, ``--device``, ``--seed``."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from gsfluent.errors import InputError
from gsfluent.progress import Progress, Reporter, heartbeat, reporter

_log = logging.getLogger(__name__)

_FIRST = 2.5
"""The same at the start [s], before which Python and the command line have loaded."""
_LONGEST = 4.5
"""Silence that a verb breaks [s]; a run, which knows more to say, does so a little before."""

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
On = Annotated[str, tyro.conf.arg(metavar="local|slurm|ray[=HOST:PORT]")]


@dataclass(kw_only=True)
class Verb:
    """Base of the verbs."""

    json: bool = False
    """One JSON object on stdout, logs on stderr."""
    device: Annotated[str, tyro.conf.arg(metavar="auto|cpu|cuda[:i]")] = "auto"
    """Where the heavy work runs."""
    seed: int = 0
    """Seed of everything random."""
    allow_outside: bool = False
    """Let a capture name files outside its folder."""

    serves: ClassVar[bool] = False
    """Whether it waits for people: then silence is no news."""

    def execute(self) -> dict[str, Any]:
        """Do the work and return what ``--json`` prints."""
        raise NotImplementedError

    def heard(self) -> dict[str, Any]:
        """:meth:`execute`, which is never silent for five seconds.

        Returns:
            What it returns.
        """
        if self.serves:
            return self._inside()
        name, begun = type(self).__name__.lower(), time.monotonic()

        def says() -> str:
            return f"{name}: at work, {time.monotonic() - begun:.0f} s since the start"

        if "torch" not in sys.modules:  # while it loads no other thread says anything
            _log.info("%s: loading", name)
        with heartbeat("gsfluent", says, _LONGEST, first=_FIRST) as watched:
            vars(self)["_watched"] = watched  # no option of the command line
            return self._inside()

    def _inside(self) -> dict[str, Any]:
        """:meth:`execute`, where captures may name what ``--allow-outside`` lets them."""
        from gsfluent.io.checked.inside import allow_outside  # loads torch, which takes a while

        with allow_outside(self.allow_outside):
            return self.execute()

    def text(self, result: dict[str, Any]) -> str | None:
        """What a person reads; None for one line per key of the result."""
        return None

    def torch_device(self) -> Any:
        """The chosen device, with the generators seeded.

        Raises:
            InputError: No such device here.
        """
        return choose_device(self.device, seed=self.seed)

    def given(self, *names: str) -> dict[str, Any]:
        """Those of its options that are set."""
        return {n: value for n in names if (value := getattr(self, n)) is not None}

    @contextmanager
    def reporter(self) -> Iterator[Reporter]:
        """Progress of several tasks, drawn as this process and ``--json`` allow."""
        with reporter(quiet=self.json) as report:
            watched: Callable[[Reporter], Reporter] | None = vars(self).get("_watched")
            yield report if watched is None else watched(report)

    @contextmanager
    def progress(self, name: str) -> Iterator[Progress]:
        """Progress of one task."""
        with self.reporter() as report:
            yield report.task(name)


def choose_device(name: str, *, seed: int = 0) -> Any:
    """Turn ``auto|cpu|cuda[:i]`` into a torch device.

    Raises:
        InputError: Not such a name, or a device this machine or install does not have.
    """
    import torch

    from gsfluent._load import NO_CUDA_KERNELS, has_cuda

    torch.manual_seed(seed)
    if name == "auto":
        if NO_CUDA_KERNELS and torch.cuda.is_available():
            _log.warning("the CPU works, not the GPU: %s", NO_CUDA_KERNELS)
        return torch.device("cuda" if has_cuda() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise InputError(f"--device {name}", "give auto, cpu, cuda or cuda:0, cuda:1, ...")
    if device.type == "cuda":
        if NO_CUDA_KERNELS:
            what, _, hint = NO_CUDA_KERNELS.rpartition("; ")
            raise InputError(f"--device {name}: {what}", f"{hint}, or use cpu")
        count = torch.cuda.device_count()
        if count == 0 or (device.index or 0) >= count:
            raise InputError(f"--device {name}: torch sees {count} GPUs", "use auto or cpu")
    return device


def existing(path: Path, argument: str, *, folder: bool | None = None) -> Path:
    """Return ``path`` when it is there and of the right kind.

    Raises:
        InputError: Missing, or a file for a folder, or the other way round.
    """
    if not path.exists():
        raise InputError(f"{argument}: {path} does not exist", "check the path")
    if folder is not None and path.is_dir() != folder:
        kind = "folder" if folder else "file"
        raise InputError(f"{argument}: {path} is not a {kind}", f"give a {kind}")
    return path


def parse_size(text: str) -> tuple[int, int]:
    """``1280x720`` to (1280, 720), both even.

    Raises:
        InputError: Not two positive even numbers.
    """
    parts = text.lower().replace(",", "x").split("x")
    try:
        width, height = (int(p) for p in parts)
    except ValueError:
        raise InputError(f"--size {text}", "give WIDTHxHEIGHT, for example 1280x720") from None
    if width < 16 or height < 16 or width % 2 or height % 2:
        raise InputError(
            f"--size {text}", "give even numbers of at least 16 (video needs even sides)"
        )
    return width, height
