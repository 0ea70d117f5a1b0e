"""Verbs of the lab: chart, stability."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from gsfluent.cli.common import On, Out, Verb, existing
from gsfluent.errors import InputError, need

Words = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")]


@dataclass(kw_only=True)
class Chart(Verb):
    """Draw error against time: a ladder of settings over scenes with known answers.

    Examples:
      gsfluent chart -o chart                             # all cases; a broken run goes on
      gsfluent chart --quick                              # two cases, half a minute
      gsfluent chart --cases bar spin --only dx cfl ppc   # some cases, some knobs
      gsfluent chart --draw chart/chart.jsonl peers.jsonl # only draw what was recorded

      gsfluent chart --of rendering --quick               # or reconstruction, texturing
      gsfluent chart shot.yaml --error 3%                 # the cheapest setting for your own shot
      gsfluent chart shot.yaml --error 3% -o out          # of the solids of the run in out

    Writes chart.jsonl (a line per run), chart.png, chart.html and chart.md.
    docs/measured/chart.md says how to read them. With a shot: chart.json and chart.png,
    see docs/guide/lab.md.
    """

    shot: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="SHOT.yaml")] = None
    """Probe this shot and choose, instead of charting scenes with known answers."""
    error: str | None = None
    """Largest error the shot may have, such as 3%."""
    of: Literal["simulation", "rendering", "reconstruction", "texturing"] = "simulation"
    """What is charted: docs/measured/chart_quality.md says what the errors of the others are."""

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
    GPU; 0 for none, as with --jobs or --on."""
    jobs: int = 1
    """Runs at a time; the times of more on one machine are not those of one alone."""
    on: On = "local"
    """Where runs are done, as of `gsfluent sweep`."""
    draw: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE.jsonl ...")] = ()
    """Draw these records, ours and peers', and run nothing."""

    def execute(self) -> dict[str, Any]:
        """Run what is missing and draw all of it."""
        from gsfluent.lab.charts.draw import gathered, of_records

        if self.shot is not None or self.error is not None:
            return self._shot()
        need("matplotlib", "figures", "chart")  # missing is better said before the runs
        if self.repeat < 1:
            raise InputError(f"--repeat {self.repeat}", "give at least 1")
        if self.jobs < 1:
            raise InputError(f"--jobs {self.jobs}", "give at least 1")
        if self.budget is not None and self.budget < 0:
            raise InputError(f"--budget {self.budget}", "give seconds, or 0 for no limit")
        if self.of != "simulation":
            return self._quality()
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

    def _shot(self) -> dict[str, Any]:
        """Choose the cheapest setting of a shot."""
        from gsfluent.choose.choose import QUICK
        from gsfluent.choose.shot import chart_shot, readable
        from gsfluent.config import load_shot
        from gsfluent.config.settings_solve import read_error

        if self.shot is None or self.error is None:
            got = "a bound without a shot" if self.shot is None else "a shot without a bound"
            raise InputError(f"chart: {got}", "for example: gsfluent chart shot.yaml --error 3%")
        if self.cases or self.only or self.draw or self.of != "simulation":
            raise InputError(
                "--cases, --only, --draw and --of do nothing with a shot", "leave them out"
            )
        bound = read_error(self.error, "--error")
        shot = load_shot(existing(self.shot, "SHOT.yaml", folder=False))
        with self.reporter() as progress:
            result = chart_shot(
                shot, bound, self.out, probing=QUICK if self.quick else None,
                device=self.torch_device(), seed=self.seed, reporter=progress,
            )  # fmt: skip
        return result if self.json else readable(result)

    def _quality(self) -> dict[str, Any]:
        """Chart rendering, reconstruction or texturing."""
        from gsfluent.lab.charts.quality import chart_quality, gathered

        if self.cases or self.only:
            raise InputError("--cases and --only belong to --of simulation", "leave them out")
        if self.draw:
            files = [existing(path, "--draw", folder=False) for path in self.draw]
            return gathered(self.of, files, self.out)
        with self.progress("chart") as progress:
            return chart_quality(
                self.of, self.out, device=self.torch_device(), quick=self.quick,
                repeat=1 if self.quick else self.repeat, jobs=self.jobs, on=self.on,
                progress=progress,
            )  # fmt: skip

    def _run(self, result: dict[str, Any]) -> Any:
        from gsfluent.lab.charts.chart import run
        from gsfluent.lab.charts.ladder import ladder

        device = self.torch_device()
        place = str(device)
        settings = ladder(self.cases, device=place, only=self.only, quick=self.quick)
        budget = self.budget
        if budget is None and self.jobs == 1 and self.on == "local":
            budget = {"cpu": 660.0, "cuda": 110.0}[device.type]
        lines = self.out / "chart.jsonl"
        with self.progress("chart") as progress:
            done = run(
                settings, lines, device=place, repeat=1 if self.quick else self.repeat,
                budget=budget or None, jobs=self.jobs, on=self.on, progress=progress,
            )  # fmt: skip
        result |= {"lines": lines, "seconds": done.seconds, "run now": done.fresh}
        if done.left_out:
            result["left out (--budget)"] = [
                f"{s.case} {s.method} dx {s.dx:.3g} {s.variant}".rstrip() for s in done.left_out
            ]
        return done.records


@dataclass(kw_only=True)
class Stability(Verb):
    """Draw where each variant of the method first fails: maps over pairs of settings.

    Examples:
      gsfluent stability -o stability                    # all maps, about five minutes on two cores
      gsfluent stability --quick                         # three by three points of each
      gsfluent stability --maps fragments poisson        # some maps
      gsfluent stability --device cuda                   # those that are worth a GPU
      gsfluent stability --draw stability/stability.jsonl  # only draw what was recorded

    Writes stability.jsonl (a line per point), a PNG per map and stability.html.
    docs/measured/stability.md says what they show.
    """

    out: Out = Path("stability")
    """Folder of the results; points whose lines are there are not run again."""
    maps: Words = ()
    """Maps; all by default, on a GPU those worth it."""
    quick: bool = False
    """Three by three points of each map, for a look or for CI."""
    jobs: int = 1
    """Processes that share the work."""
    on: On = "local"
    """Where points are run, as of `gsfluent sweep`."""
    draw: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE.jsonl ...")] = ()
    """Draw these lines and run nothing."""
    peers: Path | None = None
    """What scripts/peers/failures.py found in other programs, to be drawn with them."""

    def execute(self) -> dict[str, Any]:
        """Run what is missing and draw all of it."""
        from gsfluent.lab.stability.maps import read
        from gsfluent.lab.stability.peers import marks, measured
        from gsfluent.lab.stability.report import verdict, write_all
        from gsfluent.lab.stability.run import chosen, run_maps

        need("matplotlib", "figures", "stability")  # missing is better said before the runs
        programs = measured(existing(self.peers, "--peers", folder=False)) if self.peers else []
        maps = [m for name in self.maps for m in name.split(",") if m]
        if self.draw:
            wanted = chosen(maps)
            files = [existing(path, "--draw", folder=False) for path in self.draw]
            points = [p for path in files for p in read(path)]
            known = {m.name for m in wanted}
            points = [p for p in points if p.map in known]
            if not points:
                raise InputError(
                    "--draw: no point of these maps in the files", "run `gsfluent stability` first"
                )
        else:
            device = self.torch_device()
            wanted = chosen(maps, gpu=device.type == "cuda")
            if device.type == "cuda" and self.jobs > 1:
                raise InputError("--jobs with a GPU", "leave it out: one process feeds it")
            with self.progress("stability") as progress:
                points = run_maps(
                    wanted, self.out / "stability.jsonl", device=device.type, quick=self.quick,
                    jobs=self.jobs, on=self.on, progress=progress,
                )  # fmt: skip
        page = write_all(wanted, points, self.out, marks(wanted, programs))
        drawn = [m for m in wanted if any(p.map == m.name for p in points)]
        return {
            "page": page,
            "maps": len(drawn),
            "points": len(points),
            "held": sum(p.holds for p in points),
            "seconds": round(sum(p.seconds for p in points), 1),
            "not inside with margin": verdict(drawn, points),
        }
