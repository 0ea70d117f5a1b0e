"""From records to a figure, a table and a page; nothing is run here."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError
from gsfluent.figure.page import Page, markdown_table
from gsfluent.figure.pareto import Dot, Panel, Rates, draw
from gsfluent.figure.style import save_png, to_svg
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.front import Verdict, cases, counted, front, methods, verdict
from gsfluent.lab.charts.record import Record, read

OURS = "gsfluent"
_BASES = ("dx", "textbook", "adaptive")
"""Knobs whose runs are a method's base."""
_XLABEL = "wall ms per simulated ms"


@dataclasses.dataclass(frozen=True)
class Chart:
    """Records of one device, ready to be drawn."""

    records: tuple[Record, ...]  # all of them
    device: str  # cpu or cuda
    verdict: Verdict  # our front against every peer's

    @property
    def machine(self) -> str:
        """Where our runs were made."""
        ours = [r.machine for r in self.records if r.method == OURS] or [
            r.machine for r in self.records
        ]
        return max(set(ours), key=ours.count)

    @property
    def machines(self) -> list[str]:
        """All machines, ours first; more than one and times cannot be compared."""
        return list(dict.fromkeys([self.machine, *(r.machine for r in self.records)]))

    def figure(self, path: Path) -> Path:
        """Write the PNG."""
        with draw(self._panels(), self._rates(), title=self.title, xlabel=_XLABEL) as figure:
            return save_png(figure, path)

    @property
    def title(self) -> str:
        """One line above figure and page."""
        return f"Error against time: {self.machine}"

    def page(self, path: Path) -> Path:
        """Write the HTML page."""
        commits = ", ".join(dict.fromkeys(r.commit for r in self.records if r.method == OURS))
        page = Page(self.title, f"{len(self.records)} runs; commit {commits}")
        page.text(self.verdict.text(), kind="good" if self.verdict.below_left else "warn")
        for words in self.warnings():
            page.text(words, kind="warn")
        with draw(self._panels(), self._rates(), xlabel=_XLABEL) as figure:
            page.svg(to_svg(figure), "Every run a dot; a method's best as a staircase.")
        for heading, head, rows in self.tables():
            page.heading(heading).table(head, rows)
        return page.write(path)

    def markdown(self, path: Path) -> Path:
        """Write the tables as a Markdown page."""
        with atomic_path(path) as temporary:
            temporary.write_text(f"# {self.title}\n\n{self.text()}\n", encoding="utf-8")
        return path

    def text(self, names: Iterable[str] = ()) -> str:
        """Verdict and tables in Markdown, all or those of these headings."""
        parts = [self.verdict.text(), *self.warnings()]
        chosen = set(names)
        for heading, head, rows in self.tables():
            if chosen and heading not in chosen:
                continue
            parts.append(f"**{heading}**\n\n{markdown_table(head, rows).rstrip()}")
        return "\n\n".join(parts)

    def warnings(self) -> list[str]:
        """What a reader must know before comparing."""
        found = []
        if len(self.machines) > 1:
            found.append(f"Times were taken on different machines: {'; '.join(self.machines)}.")
        ours = cases(r for r in self.records if r.method == OURS)
        if theirs := [c for c in cases(self.records) if ours and c not in ours]:
            found.append(f"Run by peers only, and not drawn: {', '.join(theirs)}.")
        commits = list(dict.fromkeys(r.commit for r in self.records if r.method == OURS))
        if len(commits) > 1:
            found.append(f"gsfluent's runs are of several commits: {', '.join(commits)}.")
        found += [f"{m} on {c}: on no level ({why})." for c, m, why in self.verdict.absent]
        return found

    # --- tables ---

    def tables(self) -> list[tuple[str, list[str], list[list[Any]]]]:
        """Heading, head and rows of every table."""
        found = [
            ("Against each peer", *self._summary()),
            ("Fronts", *self._fronts()),
            ("At every error level that a peer reaches", *self._levels()),
            ("What each knob does", *self._knobs()),
            ("Measures that trade nothing", *self._free()),
            ("Every run", *self._all()),
        ]
        return [t for t in found if t[2]]

    def _summary(self) -> tuple[list[str], list[list[Any]]]:
        head = ["case", "peer", "levels", "its least error", "our least error",
                "least times cheaper", "median", "most", "not reached"]  # fmt: skip
        rows = []
        for case, peer in dict.fromkeys((v.case, v.peer.method) for v in self.verdict.rows):
            mine = [v for v in self.verdict.rows if (v.case, v.peer.method) == (case, peer)]
            ratios = [v.ratio for v in mine if v.ratio is not None]
            least = min((counted(r) for r in _of(self.records, case, OURS) if r.ok), default=None)
            rows.append([
                case, peer, len(mine), min(counted(v.peer) for v in mine), least,
                *((min(ratios), statistics.median(ratios), max(ratios)) if ratios
                  else ("n/a", "n/a", "n/a")),
                len(mine) - len(ratios),
            ])  # fmt: skip
        return head, rows

    def _fronts(self) -> tuple[list[str], list[list[Any]]]:
        head = ["case", "method", "setting", "points", "steps", "ms per simulated ms", "error"]
        rows = []
        for case in cases(self.records):
            for method in methods(self.records, OURS):
                rows += [
                    [case, method, _words(r), r.points, r.steps, r.wall_per_simulated, r.error]
                    for r in front(_of(self.records, case, method))
                ]
        return head, rows

    def _levels(self) -> tuple[list[str], list[list[Any]]]:
        head = ["case", "peer", "its setting", "its error", "its ms per ms", "ours", "our error",
                "our ms per ms", "times cheaper"]  # fmt: skip
        rows = [
            [
                v.case, v.peer.method, _words(v.peer), v.peer.error, v.peer.wall_per_simulated,
                "n/a" if v.ours is None else _words(v.ours),
                "n/a" if v.ours is None else v.ours.error,
                "n/a" if v.ours is None else v.ours.wall_per_simulated,
                "n/a" if v.ratio is None else v.ratio,
            ]
            for v in self.verdict.rows
        ]  # fmt: skip
        return head, rows

    def _knobs(self) -> tuple[list[str], list[list[Any]]]:
        head = ["method", "setting", "runs", "median error over the base's", "from", "to",
                "median time over the base's", "broke off"]  # fmt: skip
        rows = []
        turned = [
            r for r in self.records
            if r.settings.get("knob", "dx") not in _BASES and r.settings.get("trades", True)
        ]  # fmt: skip
        for method, variant in dict.fromkeys((r.method, r.variant) for r in turned):
            mine = [r for r in turned if (r.method, r.variant) == (method, variant)]
            pairs = [(r, b) for r in mine if r.ok and (b := _base(self.records, r)) and b.ok]
            errors = [counted(r) / counted(b) for r, b in pairs]
            times = [r.wall_per_simulated / b.wall_per_simulated for r, b in pairs]
            if pairs:
                rows.append([
                    method, variant, len(mine), statistics.median(errors), min(errors),
                    max(errors), statistics.median(times), len([r for r in mine if r.failed]),
                ])  # fmt: skip
        return head, rows

    def _free(self) -> tuple[list[str], list[list[Any]]]:
        head = ["case", "dx", "measure", "error with", "error without", "ms per ms with", "without"]
        rows = []
        for r in self.records:
            if r.settings.get("trades", True) or not r.ok:
                continue
            base = _base(self.records, r)
            if base is not None:
                rows.append([r.case, r.settings["dx"], f"not: {r.variant}", base.error, r.error,
                             base.wall_per_simulated, r.wall_per_simulated])  # fmt: skip
        return head, rows

    def _all(self) -> tuple[list[str], list[list[Any]]]:
        head = ["case", "method", "setting", "dx", "points", "steps", "ms per simulated ms",
                "ns per point and step", "error", "broke off"]  # fmt: skip
        rows = [
            [r.case, r.method, r.variant or "-", r.settings.get("dx"), r.points, r.steps,
             r.wall_per_simulated, r.ns_per_point_step, r.error, r.failed]
            for r in self.records if r.kind != "machine"
        ]  # fmt: skip
        return head, rows

    # --- figure ---

    def _panels(self) -> list[Panel]:
        """Of the cases that gsfluent ran; of all if it ran none."""
        ours = cases(r for r in self.records if r.method == OURS)
        return [self._panel(case) for case in ours or cases(self.records)]

    def _panel(self, case: str) -> Panel:
        mine = [r for r in self.records if r.case == case]
        names = methods(mine, OURS)
        measure = next((r.measures[0]["quantity"] for r in mine if r.measures), "")
        fronts = {m: [_dot(r) for r in front(_of(mine, case, m))] for m in names}
        return Panel(case, [_dot(r) for r in mine], fronts, note=measure, band=_band(mine))

    def _rates(self) -> Rates | None:
        runs = [
            r for r in self.records
            if r.ok and r.kind != "machine" and math.isfinite(r.ns_per_point_step)
        ]  # fmt: skip
        if not runs:
            return None
        names = methods(runs, OURS)
        floor = next((r for r in self.records if r.kind == "machine"), None)
        words = ""
        if floor is not None:
            words = (
                f"{floor.settings['bytes_per_point_step']:.0f} bytes at "
                f"{floor.settings['gigabytes_per_second']:.0f} GB/s"
            )
        return Rates(
            {m: [float(r.points) for r in runs if r.method == m] for m in names},
            {m: [r.ns_per_point_step for r in runs if r.method == m] for m in names},
            None if floor is None else floor.ns_per_point_step,
            words,
        )


def gathered(paths: Iterable[Path]) -> list[Record]:
    """Records of several files; of equal keys the last one counts.

    Raises:
        InputError: A file cannot be read, or none holds a record.
    """
    found: dict[str, Record] = {}
    for path in paths:
        for record in read(path):
            found.pop(record.key, None)
            found[record.key] = record
    if not found:
        raise InputError("no records", "give files of `gsfluent chart` that hold at least one run")
    return list(found.values())


def of_records(records: Sequence[Record]) -> list[Chart]:
    """One chart per kind of device, since times of different devices do not compare."""
    kinds = dict.fromkeys(r.device.split(":")[0] for r in records)
    charts = []
    for kind in kinds:
        mine = tuple(r for r in records if r.device.split(":")[0] == kind)
        if any(r.kind != "machine" for r in mine):
            charts.append(Chart(mine, kind, verdict(mine, OURS)))
    return charts


def _of(records: Iterable[Record], case: str, method: str) -> list[Record]:
    return [r for r in records if r.case == case and r.method == method]


def _words(record: Record) -> str:
    dx = record.settings.get("dx")
    rung = f"dx {float(dx):.3g}" if isinstance(dx, int | float) else ""
    return ", ".join(part for part in (rung, record.variant) if part)


def _dot(record: Record) -> Dot:
    return Dot(
        record.method, record.wall_per_simulated, counted(record), _words(record),
        failed=bool(record.failed) or not math.isfinite(record.error),
        free=not record.settings.get("trades", True),
    )  # fmt: skip


def _band(records: Iterable[Record]) -> float | None:
    """The run-to-run spread of a fracture case, as its records give it."""
    found = [r.settings.get("band") for r in records]
    numbers = [float(b) for b in found if isinstance(b, int | float)]
    return max(numbers, default=None)


def _base(records: Iterable[Record], record: Record) -> Record | None:
    """The run of the same case, method and rung at the defaults."""
    dx = record.settings.get("dx")
    same = (r for r in records if (r.case, r.method) == (record.case, record.method))
    return next(
        (r for r in same if r.settings.get("knob") in _BASES and r.settings.get("dx") == dx), None
    )
