"""Functions that tests hand to processes of a sweep; they import no torch, so they start fast."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from gsfluent.sweep.engine import map
from gsfluent.sweep.folder import SweepFolder


def square(item: int, folder: Path) -> int:
    (folder / "number.txt").write_text(str(item * item))
    return item * item


def slow_square(item: int, folder: Path) -> int:
    time.sleep(0.05)
    return square(item, folder)


def odd_ones_fail(item: int, folder: Path) -> int:
    print("looked at", item, flush=True)
    if item % 2:
        raise ValueError(f"{item} is odd")
    return item


def dies_once(item: Path, folder: Path) -> str:
    """Kill this process, unless that has been done before; the folder shows what a kill leaves."""
    print("about to", flush=True)
    if not item.exists():
        item.touch()
        (folder / "half.txt").write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)
    return (folder / "half.txt").read_text()


class AcceleratorError(RuntimeError):
    """Named as torch's."""


def gpu_fails_once(item: Path, folder: Path) -> int:
    if not item.exists():
        item.touch()
        raise AcceleratorError("CUDA error: an illegal memory access was encountered")
    return 7


def touches_and_waits(item: Path, folder: Path) -> None:
    item.touch()
    time.sleep(600)


def waits_to_go(item: Path, folder: Path) -> int:
    (item / "begun").touch()
    while not (item / "go").exists():
        time.sleep(0.01)
    return os.getpid()


def never_ends(item: int, folder: Path) -> None:
    print("waiting", flush=True)
    time.sleep(600)


def its_card(item: int, folder: Path) -> str:
    time.sleep(0.3)
    return os.environ["CUDA_VISIBLE_DEVICES"]


def names(count: int) -> list[str]:
    return [f"n{i}" for i in range(count)]


def drive(folder: str, count: int, on: str = "local") -> None:
    """A driver of its own, to be killed."""
    # not of __main__, which is another module elsewhere
    from sweep_tasks import slow_square

    map(slow_square, range(count), folder, ids=names(count), jobs=2, tries=99, on=on)


def all_squares(folder: Path, count: int) -> None:
    """Every task is there once, whole, and nothing of an unfinished one with it."""
    place = SweepFolder(folder)
    assert place.done() == set(names(count))
    for i, name in enumerate(names(count)):
        row = place.row(name)
        assert row is not None and (row["id"], row["value"]) == (name, i * i)
        assert (place.shots / name / "number.txt").read_text() == str(i * i)


if __name__ == "__main__":
    drive(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
