"""Choose settings by error on four shots, then see what the error is: docs/measured/chart_shot.md.

    python scripts/study/shots/choose.py [--device cuda] [-o choose_out] [--only orange_dropped ...]
    python scripts/study/shots/choose.py --write docs/measured/data/choose_cpu.jsonl [--no-times]

Every shot is probed as `gsfluent chart SHOT.yaml --error` does; then the setting it chose is run
over the whole shot with seeds that the probes have not seen, and a finer one with more seeds, whose
mean stands for the truth. One line per shot goes to choose_out/choose.jsonl; what has a line is not
run again. The photographs of the demo objects are drawn where they are missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from gsfluent.choose.choose import Probing, choose_setting, run_probes, summary
from gsfluent.choose.probe import Probe, distance, histories, probe
from gsfluent.choose.seconds import cost_of
from gsfluent.choose.shot import shot_scene
from gsfluent.cli.common import choose_device
from gsfluent.config import Shot, load_shot
from gsfluent.config.yaml_file import read_yaml
from gsfluent.figure.markdown import enter
from gsfluent.lab.charts.record import commit, machine
from gsfluent.pipeline.simulate.engine import CFL
from gsfluent.run.demo import SIZES, photograph_demo
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import solver_options

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "examples"
PAGE = ROOT / "docs" / "measured" / "chart_shot.md"
FRESH = 1000  # first seed of the runs that judge
Line = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Trial:
    """A shot and what is asked of it.

    Attributes:
        drawn: Demo object.
        example: Shot of examples/.
        bound: Largest error.
        changes: Keys of the shot that are replaced.
    """

    drawn: str
    example: str
    bound: float
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)


TRIALS = {
    "orange_dropped": Trial(
        "orange", "milk_poured", 0.1,
        {"objects": {"orange": {"material": "rubber"}},
         "events": [{"type": "drop", "height": 0.4}],
         "output": {"fps": 120, "seconds": 0.5}},
    ),
    "milk_poured": Trial("orange", "milk_poured", 0.4),
    "bread_torn": Trial("bread", "bread_torn", 0.4),
    "watermelon_dropped": Trial("watermelon", "watermelon_dropped", 0.5),
}  # fmt: skip


def shot_of(trial: Trial) -> Shot:
    """The shot, its photographs drawn where they are missing."""
    folder = EXAMPLES / "data" / trial.drawn
    if not (folder / "cut.png").is_file():
        logging.info("photographing %s", trial.drawn)
        photograph_demo(trial.drawn, folder, SIZES["full"])
    path = EXAMPLES / f"{trial.example}.yaml"
    return Shot.from_dict({**read_yaml(path), **trial.changes}, EXAMPLES) if trial.changes else (
        load_shot(path)
    )  # fmt: skip


def runs(
    scene: Scene, shot: Shot, cells: int, cfl: float, seeds: int, first: int, device: Any
) -> list[Probe]:
    """The whole shot at one setting, by seed."""
    frames = round(shot.output.fps * shot.output.seconds)
    found = []
    for number in range(seeds):
        start = time.perf_counter()
        made = probe(
            scene, cells, fps=shot.output.fps, frames=frames, seed=first + number, device=device,
            options=dataclasses.replace(solver_options(shot), cfl=cfl),
        )  # fmt: skip
        spent = time.perf_counter() - start
        logging.info("%d cells, cfl %g, seed %d: %.1f s", cells, cfl, first + number, spent)
        if made.failed:
            raise RuntimeError(f"{cells} cells: {made.failed}")
        found.append(made)
    return found


def judge(name: str, trial: Trial, options: argparse.Namespace, device: Any) -> Line:
    """Choose, run, compare."""
    shot = shot_of(trial)
    scene, _ = shot_scene(shot, options.out / name, device=device, make=True)
    start = time.perf_counter()
    probing = Probing()
    probes = run_probes(scene, shot, probing, device=device)
    probed = time.perf_counter() - start
    seconds, source = cost_of(probes.whole, probes.levels, scene, device)
    choice, fits, growth = choose_setting(probes, trial.bound, seconds)
    result = summary(choice, fits, growth, probes, probing, source)
    settings = [s for s in result["settings"] if s["cfl"] == CFL]
    taken = result["chosen"] or result["enough"]
    if taken is None or taken["seconds"] > 0.2 * options.most:
        # too much to run here: what is said of a setting that can be run is judged instead
        taken = max((s for s in settings if s["seconds"] <= 0.1 * options.most),
                    key=lambda s: s["cells"], default=None)  # fmt: skip
    line: Line = {
        "shot": name, "bound": trial.bound, "met": result["met"], "sure": result["sure"],
        "floor": result["floor"], "floor_of": result["floor_of"], "reason": result["reason"],
        **{k: result[k] for k in ("chosen", "enough", "within", "asymptotic", "probe")},
        "observables": result["observables"],
        "probe_wall": probed, "device": device.type, "machine": machine(str(device)),
        "commit": commit(), "predicted": taken,
    }  # fmt: skip
    finer = [s for s in settings if taken is not None and s["seconds"] <= options.most
             and taken["cells"] < s["cells"] <= 2 * taken["cells"]]  # fmt: skip
    if taken is None or not finer:
        return line
    at = max(finer, key=lambda s: s["cells"])
    reference = at["cells"]
    brittle = result["floor"] > 0.0
    ours = runs(scene, shot, taken["cells"], taken["cfl"], 3 if brittle else 2, FRESH, device)
    truth = runs(scene, shot, reference, CFL, 4 if brittle else 1, 0, device)
    frames = min(p.seen.frames for p in (*ours, *truth))
    shown = histories([ours, truth], probes.first, frames, ours[0].seen)
    actual = {}
    for history in shown:
        mean = history.values[1].mean(axis=0)
        gaps = [distance(run, mean) for run in history.values[0]]
        actual[history.name] = math.sqrt(float(np.mean(np.square(gaps))))
    apart = {
        fit.name: fit.gaps(
            1 / taken["cells"],
            1 / reference,
            growth.mean.get(fit.name, 1.0),
            growth.spread.get(fit.name, 1.0),
        )
        for fit in fits
    }
    worst = max(actual, key=lambda key: actual[key])
    drawn = np.max(list(apart.values()), axis=0)
    return line | {
        "reference": {"cells": reference, "seeds": len(truth), "predicted": at["error"]},
        "gap": [float(v) for v in np.quantile(drawn, [0.05, 0.5, 0.95])],
        "gap_parts": {k: [float(q) for q in np.quantile(v, [0.05, 0.5, 0.95])]
                      for k, v in apart.items()},
        "actual": actual, "actual_worst": worst, "actual_error": actual[worst],
        "actual_seconds": min(p.seconds for p in ours),
    }  # fmt: skip


def table(lines: list[Line], *, times: bool = True) -> str:
    """The table of the page, with or without the wall times."""
    head = (
        "| shot | asked | chosen | sure | run to run | judged at | its error | reference "
        "| distance, predicted (5 % to 95 %) | actual | worst | observables within |"
    )
    head += " seconds predicted | actual | probes |" if times else ""
    rows = [head, "| --- " * (15 if times else 12) + "|"]
    for line in lines:
        chosen, enough, judged = (line[k] for k in ("chosen", "enough", "predicted"))
        words = "none" if chosen is None else _words(chosen)
        if chosen is None and enough is not None:
            words += f"; chance hides more than {_words(enough)}"
        row = f"| {line['shot']} | {line['bound']:.0%} | {words} | {line['sure']:.0%} "
        row += f"| {line['floor']:.1%} "
        if "actual" in line:
            ref, (low, middle, high) = line["reference"], line["gap"]
            within = sum(line["gap_parts"][k][0] <= v <= line["gap_parts"][k][2]
                         for k, v in line["actual"].items() if k in line["gap_parts"])  # fmt: skip
            row += (
                f"| {_words(judged)} | {judged['error']:.1%} | {ref['cells']} cells, "
                f"{ref['seeds']} {'seeds' if ref['seeds'] > 1 else 'seed'} "
                f"| {middle:.1%} ({low:.1%} to {high:.1%}) | {line['actual_error']:.1%} "
                f"| {line['actual_worst']} | {within} of {len(line['actual'])} |"
            )
            if times:
                row += (
                    f" {judged['seconds']:.1f} | {line['actual_seconds']:.1f} "
                    f"| {line['probe_wall']:.0f} s |"
                )
        else:
            row += "| not judged: too dear here " + "| " * (9 if times else 6) + "|"
        rows.append(row)
    return "\n".join(rows) + "\n"


def _words(setting: Line) -> str:
    return f"{setting['cells']} cells, cfl {setting['cfl']:g}"


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--only", nargs="*", default=list(TRIALS), choices=list(TRIALS))
    add("-o", "--out", type=Path, default=Path("choose_out"))
    add("--device", default="auto")
    add("--most", type=float, default=60.0, help="predicted seconds of one run of the reference")
    add("--write", type=Path, nargs="*", default=[], help="only enter these lines in the page")
    add("--no-times", action="store_true", help="with --write: leave out wall times")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        found = [json.loads(s) for p in options.write for s in p.read_text().splitlines()]
        for kind in dict.fromkeys(line["device"] for line in found):
            mine = [line for line in found if line["device"] == kind]
            text = enter(
                text,
                f"choice {kind}",
                table(mine, times=not options.no_times),
                f"### {mine[0]['machine']}",
            )
        PAGE.write_text(text, encoding="utf-8")
        return 0
    device = choose_device(options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    lines = options.out / "choose.jsonl"
    done = set()
    if lines.is_file():
        done = {json.loads(s)["shot"] for s in lines.read_text(encoding="utf-8").splitlines()}
    for name in options.only:
        if name in done:
            continue
        line = judge(name, TRIALS[name], options, device)
        with lines.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")
        sys.stdout.write(table([line]))
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
