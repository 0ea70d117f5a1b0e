"""Plan every shot of the gallery, run it, and put plan and fact side by side.

    python scripts/study/shots/plan.py                    # all shots, resumable, on the GPU if any
    python scripts/study/shots/plan.py bread_torn cake_cut --device cpu -o plan_out
    python scripts/study/shots/plan.py --page             # only the page, from the lines there are
    python scripts/study/shots/plan.py --fit-memory       # coefficients of plan_memory.py, printed

Each shot runs in a process of its own, as a user's does, with a calibration of its own below -o:
the probe first, then the shots in order, each planned before it runs with what the earlier ones
have taught. A line per run goes to plan.jsonl; a shot that has one is not run again. The table has
three plans: by the probe alone; as it was made, in order; and by a model taught by the other shots
(all but the one in question), which needs no further runs.
"""

from __future__ import annotations

import argparse
import copy
import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from gallery import SCENES, commit, machine, shot_of

from gsfluent.cli.common import choose_device
from gsfluent.errors import GsfluentError
from gsfluent.figure.markdown import enter
from gsfluent.plan.cost import Cost, CostModel
from gsfluent.plan.fact import actual_work
from gsfluent.plan.fit import Sample, fit
from gsfluent.plan.plan import cost_model, plan_shot

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "plan.md"
LINES = ROOT / "docs" / "measured" / "data" / "plan.jsonl"
BAR = 0.25


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a file; none when it is missing."""
    if not path.is_file():
        return []
    return [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines() if text]


def run(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Plan and run one shot; return its line."""
    device = choose_device(options.device)
    shot = shot_of(name, options.quality)
    cache, out = options.out / "cache", options.out / name
    os.environ["XDG_CACHE_HOME"] = str(cache.resolve())
    model = cost_model(device)
    probed = copy.deepcopy(model)
    probed.ratios, probed.memory_ratios = {}, {}
    plan = plan_shot(shot, device=device, model=model)
    alone = plan_shot(shot, device=device, model=probed)
    path = options.out / f"{name}.yaml"
    text = shot_text(name, options.quality)
    path.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "gsfluent", "run", str(path), "-o", str(out), "--force"]
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(
        [*command, "--device", str(device), "--json"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    (options.out / f"{name}.log").write_text(done.stderr, encoding="utf-8")
    if done.returncode != 0:
        raise SystemExit(f"{name}: the run failed: {done.stderr[-2000:]}")
    values = json.loads((out / "run.json").read_text(encoding="utf-8"))
    section = values["plan"]
    kept = ("seconds", "probe_seconds", "machine")
    simulation = values["simulation"]
    return {
        "scene": name,
        "machine": machine(device),
        "device": device.type,
        "commit": commit(),
        "taught": max((len(r) for r in model.ratios.values()), default=0),
        "probe": {name: getattr(model, name) for name in kept},
        "alone": alone["stages"],
        "plan": plan["stages"],
        "actual": {
            s["name"]: {"seconds": s["seconds"], "cpu_seconds": s["cpu_seconds"],
                        "memory_bytes": section["actual"]["stages"][s["name"]]["memory_bytes"]}
            for s in values["stages"] if s["name"] in section["actual"]["stages"]
        },
        "work_planned": plan["work"],
        "work_actual": actual_work(plan["work"], values),
        "counts": {
            name: [plan[name], simulation[fact]]
            for name, fact in (("particles", "particles"), ("substeps", "substeps"),
                               ("active_blocks", "active_blocks_mean"), ("dx", "dx"))
        },
    }  # fmt: skip


def shot_text(name: str, quality: str | None) -> str:
    """The shot as YAML with absolute paths, so that it can lie anywhere."""
    import yaml

    return str(yaml.safe_dump(shot_of(name, quality).resolved(), sort_keys=False))


def taught(line: dict[str, Any], others: list[dict[str, Any]]) -> dict[str, Cost]:
    """What a model says to a shot that has learned from other shots, by stage."""
    probe = line["probe"]
    model = CostModel(probe["machine"], probe["seconds"])
    for other in others:
        for name, fact in other["actual"].items():
            said = model.stage(name, other["work_actual"][name], corrected=False)
            model.learn(name, said, Cost(fact["seconds"], fact["memory_bytes"]))
    return {name: model.stage(name, line["work_planned"][name]) for name in line["actual"]}


def latest(lines: list[dict[str, Any]], device: str) -> list[dict[str, Any]]:
    """The last line of each scene on a kind of device, in the order of the gallery."""
    found = {line["scene"]: line for line in lines if line["device"] == device}
    return [found[name] for name in SCENES if name in found]


def off(said: float, took: float) -> str:
    """Deviation of a plan from the fact, marked where it is above the bar."""
    value = said / took - 1.0
    return f"{value:+.0%}" if abs(value) <= BAR else f"**{value:+.0%}**"


def totals(rows: dict[str, Any], names: Any) -> tuple[float, float]:
    """Seconds in all and most bytes of rows by stage."""
    chosen = [rows[name] for name in names]
    seconds = [r.seconds if isinstance(r, Cost) else r["seconds"] for r in chosen]
    sizes = [r.bytes if isinstance(r, Cost) else r["memory_bytes"] for r in chosen]
    return sum(seconds), max(sizes)


def tables(lines: list[dict[str, Any]]) -> str:
    """The page's tables, one pair per kind of device."""
    parts = []
    for device in ("cpu", "cuda"):
        mine = latest(lines, device)
        if not mine:
            continue
        head = mine[-1]
        parts.append(
            f"**{head['machine']}** (`{device}`; the probe took "
            f"{head['probe']['probe_seconds']:.0f} s). Plan over fact, minus one; bold above "
            f"{BAR:.0%}.\n"
        )
        parts.append(
            "| shot | took | probe alone | as planned, in order | taught by the others | memory "
            "| as planned | taught by the others | particles | steps | blocks |\n"
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
        )
        worst = [0.0, 0.0]
        for line in mine:
            names = list(line["actual"])
            others = [other for other in mine if other is not line]
            took, size = totals(line["actual"], names)
            alone, planned = totals(line["alone"], names), totals(line["plan"], names)
            learned = totals(taught(line, others), names)
            worst[0] = max(worst[0], abs(learned[0] / took - 1.0))
            worst[1] = max(worst[1], abs(learned[1] / size - 1.0))
            counts = line["counts"]
            cells = [
                line["scene"], f"{took:.1f} s", off(alone[0], took), off(planned[0], took),
                off(learned[0], took), f"{size / 2**20:.0f} MiB", off(planned[1], size),
                off(learned[1], size),
                *(off(*counts[name]) for name in ("particles", "substeps", "active_blocks")),
            ]  # fmt: skip
            parts.append(f"| {' | '.join(cells)} |")
        parts.append(
            f"\nTaught by the others, the worst shot is {worst[0]:.0%} off in time and "
            f"{worst[1]:.0%} in memory.\n"
        )
        parts.append(stage_table(mine))
    return "\n".join(parts) if parts else "no lines yet"


def stage_table(mine: list[dict[str, Any]]) -> str:
    """Seconds of each stage, plan taught by the others over fact."""
    stages = [name for name in mine[0]["actual"] if name != "isolate"]
    rows = [
        f"| shot | {' | '.join(stages)} |",
        f"| --- | {' | '.join('---' for _ in stages)} |",
    ]
    for line in mine:
        learned = taught(line, [other for other in mine if other is not line])
        cells = []
        for name in stages:
            took = line["actual"][name]["seconds"]
            cells.append(f"{learned[name].seconds:.1f} / {took:.1f} s")
        rows.append(f"| {line['scene']} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def fit_memory(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Bytes per unit of work of every stage, from what runs have taken."""
    from gsfluent.plan.cost import BYTES

    found: dict[str, Any] = {}
    for device, stages in BYTES.items():
        mine = latest(lines, device)
        found[device] = {}
        for stage, row in stages.items():
            samples = [
                Sample(
                    stage,
                    line["work_actual"][stage],
                    line["actual"][stage]["memory_bytes"],
                )
                for line in mine
                if stage in line["actual"]
            ]
            samples = [sample for sample in samples if sample.seconds > 0.0]
            if samples:
                values, error = fit(samples, list(row))
                found[device][stage] = values | {"worst": error}
    return found


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SCENES)}")
    parser.add_argument("-o", "--out", type=Path, default=Path("plan_out"))
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument(
        "--quality", choices=("preview", "shot", "hero"), help="the shot's own if absent"
    )
    parser.add_argument("--lines", type=Path, help="where the lines are; default: -o/plan.jsonl")
    parser.add_argument("--page", action="store_true", help="only write docs/measured/plan.md")
    parser.add_argument("--fit-memory", action="store_true", help="print fitted coefficients")
    parser.add_argument("--keep", action="store_true", help="also record the lines in docs/")
    options = parser.parse_args()
    unknown = set(options.names) - set(SCENES)
    if unknown:
        parser.error(f"no scene {', '.join(sorted(unknown))}; choose of {', '.join(SCENES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    os.environ.setdefault("GSFLUENT_DATA", str(ROOT.parent / "shared" / "data"))
    path = options.lines or options.out / "plan.jsonl"
    if options.fit_memory:
        sys.stdout.write(json.dumps(fit_memory(read(LINES) + read(path)), indent=1) + "\n")
        return 0
    kind = "" if options.page else choose_device(options.device).type
    failed = 0
    for name in [] if options.page else options.names or list(SCENES):
        if any(line["scene"] == name and line["device"] == kind for line in read(path)):
            logging.info("%s: has a line in %s", name, path)
            continue
        if not SCENES[name].drawn and not Path(os.environ["GSFLUENT_DATA"], "captures").is_dir():
            logging.info("%s: left out, no data folder; set GSFLUENT_DATA", name)
            continue
        options.out.mkdir(parents=True, exist_ok=True)
        try:
            line = run(name, options)
        except (SystemExit, GsfluentError) as error:  # the others' lines are worth having
            failed += 1
            logging.info("%s", error)
            continue
        for target in [path, LINES] if options.keep else [path]:
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")
        took, _ = totals(line["actual"], line["actual"])
        logging.info(
            "%s: took %.1f s, planned %.1f s", name, took, totals(line["plan"], line["actual"])[0]
        )
    if options.page or options.keep:
        text = tables(read(LINES))
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "plan", text), encoding="utf-8")
    else:
        sys.stdout.write(tables(read(path)) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
