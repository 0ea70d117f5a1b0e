"""Verbs of the lab: chart."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gsfluent.cli.common import Out, Verb, existing
from gsfluent.errors import InputError

Words = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")]


@dataclass(kw_only=True)
class Chart(Verb):
    """Draw error against time: a ladder of settings over scenes with known answers.

    Examples:
      gsfluent chart -o chart                             # all cases; a broken run goes on
      gsfluent chart --quick                              # two cases, half a minute
      gsfluent chart --cases bar spin --only dx cfl ppc   # some cases, some knobs
      gsfluent chart --draw chart/chart.jsonl peers.jsonl # only draw what was recorded

    Writes chart.jsonl (a line per run), chart.png, chart.html and chart.md. docs/chart.md says how
    to read them.
    """

    out: Out = Path("chart")
    """Folder of the results; runs whose lines are there are not done again."""
    cases: Words = ()
    """Cases; all by default."""
    only: Words = ()
    """Knobs to turn; all by default: dx is the base ladder."""
    quick: bool = False
    """A small ladder, for a look or for CI."""
    repeat: int = 3
    """Timed runs of each setting; their median counts."""
    budget: float | None = None
    """Seconds in all; runs expected to pass them are left out. Default: 660 on a CPU, 110 on a
    GPU; 0 for none."""
    draw: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE.jsonl ...")] = ()
    """Draw these records, ours and peers', and run nothing."""

    def execute(self) -> dict[str, Any]:
        """Run what is missing and draw all of it."""
        from gsfluent.charts.draw import gathered, of_records

        if self.repeat < 1:
            raise InputError(f"--repeat {self.repeat}", "give at least 1")
        if self.budget is not None and self.budget < 0:
            raise InputError(f"--budget {self.budget}", "give seconds, or 0 for no limit")
        result: dict[str, Any] = {}
        if self.draw:
            records = gathered(existing(path, "--draw", folder=False) for path in self.draw)
        else:
            records = self._run(result)
        for chart in of_records(records):
            name = f"chart_{chart.device}" if len({r.device for r in records}) > 1 else "chart"
            chart.figure(self.out / f"{name}.png")
            chart.page(self.out / f"{name}.html")
            chart.markdown(self.out / f"{name}.md")
            result[name] = {
                "figure": self.out / f"{name}.png",
                "page": self.out / f"{name}.html",
                "tables": self.out / f"{name}.md",
                "runs": len(chart.records),
                "failed": sum(bool(r.failed) for r in chart.records),
                "verdict": chart.verdict.text(),
            }
        return result

    def _run(self, result: dict[str, Any]) -> Any:
        from gsfluent.charts.chart import run
        from gsfluent.charts.ladder import ladder

        device = self.torch_device()
        place = str(device)
        settings = ladder(self.cases, device=place, only=self.only, quick=self.quick)
        budget = {"cpu": 660.0, "cuda": 110.0}[device.type] if self.budget is None else self.budget
        lines = self.out / "chart.jsonl"
        with self.progress("chart") as progress:
            done = run(
                settings, lines, device=place, repeat=1 if self.quick else self.repeat,
                budget=budget or None, progress=progress,
            )  # fmt: skip
        result |= {"lines": lines, "seconds": done.seconds, "run now": done.fresh}
        if done.left_out:
            result["left out (--budget)"] = [
                f"{s.case} {s.method} dx {s.dx:.3g} {s.variant}".rstrip() for s in done.left_out
            ]
        return done.records
