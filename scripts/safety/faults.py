"""Flip bits of a run's files, kill it, start it twice, fill its disk: what was noticed and kept.

    python scripts/safety/faults.py --enter          # docs/measured/faults.md; minutes of one core
    python scripts/safety/faults.py --cost --enter   # what digests cost a run
    python scripts/safety/faults.py --flips 50 --kills 5 --doubles 2 --disks 2

The shot, and what is done to it, are those of tests/faults. A flip is made in one file of a run
that is finished or was stopped, and the shot is run again: the run must name the file, do its stage
anew and end with the bits of an undisturbed run. Exit code 1 when anything else happened.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "faults"))

import fault_harm as harm  # noqa: E402
from fault_shot import redone, results, run, stop, write_shot  # noqa: E402

from gsfluent.errors import RunError  # noqa: E402
from gsfluent.figure.markdown import enter  # noqa: E402
from gsfluent.results import digests  # noqa: E402
from gsfluent.results.lock import LOCK  # noqa: E402

PAGE = ROOT / "docs" / "measured" / "faults.md"
HELD = 3  # exit code of a run that found the folder taken


@dataclasses.dataclass
class Series:
    """What became of one kind of fault."""

    name: str
    noticed_as: str  # what counts as noticed
    tried: int = 0
    noticed: int = 0
    same: int = 0  # ended with the bits of the undisturbed run
    lost: int = 0  # finished work that was not taken up
    left: int = 0  # runs that left a half-written file or a lock
    wrong: list[str] = dataclasses.field(default_factory=list)

    def add(self, what: str, *, noticed: bool, same: bool, lost: bool, left: bool) -> None:
        self.tried += 1
        self.noticed += noticed
        self.same += same
        self.lost += lost
        self.left += left
        if not noticed or not same or lost or left:
            self.wrong.append(f"{self.name}: {what}")
            print(self.wrong[-1], flush=True)

    @property
    def row(self) -> str:
        counts = f"{self.tried} | {self.noticed} | {self.same} | {self.lost} | {self.left}"
        return f"| {self.name} | {counts} | {self.noticed_as} |"


class Faults:
    """The undisturbed run and what is done to copies of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shot = write_shot(folder / "shot")
        self.finished, self.stopped = folder / "finished", folder / "stopped"
        run(self.shot, folder / "warm")  # what is loaded late is loaded now
        with timed(digests.Journal, "note") as noting, timed(digests.Journal, "files") as adding:
            start = time.perf_counter()
            run(self.shot, self.finished)
            self.seconds = time.perf_counter() - start
        self.listing = sum(noting) + sum(adding)
        self.wanted = results(self.finished)
        stop(self.shot, self.finished, self.stopped)
        self._number = 0

    def place(self, source: Path | None = None) -> Path:
        """A fresh folder, empty or a copy of a run."""
        self._number += 1
        out = self.folder / f"run{self._number}"
        if source is not None:
            shutil.copytree(source, out)
        return out

    def end(self, out: Path) -> dict[str, bool]:
        """Compare a run with the undisturbed one, and remove it."""
        ends = {
            "same": results(out) == self.wanted,
            "left": any(out.rglob("*.partial*")) or (out / LOCK).exists(),
        }
        shutil.rmtree(out)
        return ends

    # --- the series ---

    def flips(self, count: int) -> Iterator[Series]:
        """Bits of every file of every stage, of a finished run and of a stage at work."""
        done = [p.relative_to(self.finished) for p in self.finished.glob("stages/*/*")]
        work = [p.relative_to(self.stopped) for p in self.stopped.glob("stages/simulate/*")]
        each = -(-count // (len(done) + len(work)))
        for source, paths in ((self.finished, done), (self.stopped, work)):
            kind = "a finished run" if source is self.finished else "a stage at work"
            series = Series(f"flipped bit in {kind}", "file and stage named, stage done anew")
            for name, bit in harm.flips(source, sorted(map(str, paths)), each):
                out, stage = self.place(source), Path(name).parts[1]
                harm.flip(out / name, bit)
                values = run(self.shot, out)
                said = next(s.get("redone", "") for s in values["stages"] if s["name"] == stage)
                told = f"{stage} was done anew" in values["reason"]
                series.add(
                    f"bit {bit} of {name}",
                    noticed=Path(name).name in said and told,
                    lost=redone(values) != [stage],
                    **self.end(out),
                )
            yield series

    def kills(self, count: int) -> Series:
        """At files, before and after they get their names, and at any moment in between."""
        series = Series("kill", "ended by the signal")
        with timed(os, "replace") as renames:
            start = time.process_time()
            run(self.shot, self.place())
            seconds = time.process_time() - start
        chance = random.Random(1)
        for number in range(count):
            out, before = self.place(), number % 2 == 0
            at = 1 + number * len(renames) // count
            moment = chance.uniform(0.05, 0.8) * seconds if number % 5 == 4 else 0.0

            def dying(
                out: Path = out, at: int = at, before: bool = before, moment: float = moment
            ) -> int:
                if moment:
                    harm.die_after(moment)
                else:
                    harm.die_at(at, before=before)
                return self._run(out)

            end = harm.in_child(dying)
            what = f"after {moment} s" if moment else f"{'before' if before else 'after'} file {at}"
            series.add(what, noticed=os.WIFSIGNALED(end), **self._go_on(out))
        return series

    def doubles(self, count: int) -> Series:
        """Two at once in an empty folder, and in that of a stopped run."""
        series = Series("double start", "one refused, or it began when the other had ended")
        for number in range(count):
            out = self.place(self.stopped if number % 2 else None)
            ends = harm.at_once(lambda out=out: self._run(out), 2, self.folder / "gate")
            fine = sorted(ends) in ([0, HELD], [0, 0])
            series.add(f"exit codes {ends}", noticed=fine, lost=False, **self.end(out))
        return series

    def disks(self, count: int) -> Series:
        """Disks that fill up early, late and in between; each is given more room afterwards."""
        series = Series("full disk", "error that speaks of space")
        # a link beside a file takes no room, and the state is gone in the end
        whole = sum({p.stat().st_ino: p.stat().st_size for p in files(self.finished)}.values())
        for number in range(count):
            size, place = whole * (number + 1) // (count + 1), self.place()
            with harm.disk_of(place, size) as grow:
                out, said = place / "out", ""
                try:
                    run(self.shot, out)
                except (RunError, OSError) as error:
                    said = str(error)
                half = any(out.rglob("*.partial*"))
                grow(20 * whole)
                ends = self._go_on(out)
                ends["left"] |= half
                series.add(f"{size} bytes: {said}", noticed="space" in said.lower(), **ends)
            place.rmdir()
        return series

    def _run(self, out: Path) -> int:
        try:
            return 0 if run(self.shot, out)["verdict"] == "clean" else 1
        except RunError as error:
            return HELD if "another run" in error.what else 1

    def _go_on(self, out: Path) -> dict[str, bool]:
        """Run again; whether what was finished or saved is done twice, and how it ends."""
        whole = [
            record.parent.name
            for record in out.glob("stages/*/stage.json")
            if digests.read_record(record)[0].get("complete")
        ]
        first = out / "stages" / "simulate" / "frame_0001.npz"
        saved = first.stat().st_mtime_ns if first.with_name("state.pt").is_file() else None
        values = run(self.shot, out)
        again = [s["name"] for s in values["stages"] if s["name"] in whole and not s["resumed"]]
        lost = bool(again or redone(values)) or saved not in (None, first.stat().st_mtime_ns)
        return {"lost": lost, **self.end(out)}


def files(out: Path) -> list[Path]:
    return [path for path in out.rglob("*") if path.is_file()]


@contextlib.contextmanager
def timed(owner: Any, name: str) -> Iterator[list[float]]:
    """While the block runs, collect the seconds of each call of a function."""
    spent: list[float] = []
    call: Callable[..., Any] = getattr(owner, name)

    def timing(*args: Any, **options: Any) -> Any:
        start = time.perf_counter()
        try:
            return call(*args, **options)
        finally:
            spent.append(time.perf_counter() - start)

    with mock.patch.object(owner, name, timing):
        yield spent


def page(series: list[Series], faults: Faults, seconds: float) -> str:
    """The table and what it was made of."""
    head = "| fault | tried | noticed | same bits | work lost | left over | noticed means |"
    size = sum(path.stat().st_size for path in files(faults.finished)) / 1e3
    return "\n".join(
        [
            f"{seconds / 60:.0f} minutes. The undisturbed run took {faults.seconds:.1f} s for "
            f"{size:.0f} kB; {100 * faults.listing / faults.seconds:.2f} % of it went into digests "
            "and their list, which is forced to disk line by line.",
            "",
            head,
            "| --- | --- | --- | --- | --- | --- | --- |",
            *(one.row for one in series),
        ]
    )


def cost(folder: Path) -> str:
    """What believing nothing costs a run of a few seconds of film, as a table."""
    film = {"fps": 24, "seconds": 1.0, "size": [320, 240], "what": ["mp4"]}
    changes = {"fill": {"resolution": 40}, "solve": {"cells": 20}, "output": film}
    shot = write_shot(folder / "shot", **changes)
    run(shot, folder / "warm")
    with (
        timed(digests, "file_digest") as hashing,
        timed(digests.Journal, "note") as noting,
    ):
        start = time.perf_counter()
        run(shot, folder / "run")
        seconds = time.perf_counter() - start
    size = sum(path.stat().st_size for path in files(folder / "run")) / 1e6
    rows = {"all": seconds, "digests": sum(hashing), "list": sum(noting) - sum(hashing)}
    return "\n".join(
        [
            f"{len(noting)} files of together {size:.1f} MB.",
            "",
            "| part of the run | s | share [%] |",
            "| --- | --- | --- |",
            *(f"| {name} | {s:.3f} | {100 * s / seconds:.2f} |" for name, s in rows.items()),
        ]
    )


def enter_part(name: str, part: str) -> None:
    PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), name, part), encoding="utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flips", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--doubles", type=int, default=20)
    parser.add_argument("--disks", type=int, default=10)
    parser.add_argument("--cost", action="store_true", help="measure what digests cost, only")
    parser.add_argument("--enter", action="store_true", help="write the table into docs/measured")
    options = parser.parse_args()
    torch.set_num_threads(1)  # what is forked after OpenMP has threads waits for them for ever
    start = time.monotonic()
    with (
        tempfile.TemporaryDirectory() as folder,
        # the page of a run takes longer than these runs, and is made of run.json alone
        mock.patch("gsfluent.run.shot.write_report", lambda out, values: None),
    ):
        if options.cost:
            print(part := cost(Path(folder)))
            if options.enter:
                enter_part("cost", part)
            return 0
        faults = Faults(Path(folder))
        series = [
            *faults.flips(options.flips),
            faults.kills(options.kills),
            faults.doubles(options.doubles),
            faults.disks(options.disks),
        ]
        table = page(series, faults, time.monotonic() - start)
    print(table)
    if options.enter:
        enter_part("faults", table)
    return 1 if any(one.wrong for one in series) else 0


if __name__ == "__main__":
    sys.exit(main())
