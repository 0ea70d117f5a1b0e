"""Judge runs of all methods, keep the figures as JSON lines, and enter one table into the docs.

    python scripts/fracturebench/table.py RUNS ... [--records FILE] [--page FILE]

RUNS are folders of runs on the frozen scenes, by gsfluent or by anyone, or .jsonl files of records
(such as the peers' docs/measured/data/peers_cpu.jsonl), of which those at the frozen resolution
count. A figure of the same case, method and device replaces the one recorded before; of several
variants of a peer the one of least error is shown, of gsfluent that of the default settings.
Without RUNS the table is drawn again from the records.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import frozen

from gsfluent.errors import InputError
from gsfluent.figure.markdown import enter
from gsfluent.fracturebench.registry import cases, find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene, SceneError
from gsfluent.lab.charts.record import Record, of_run, read

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "docs" / "measured" / "data" / "fracturebench.jsonl"
PAGE = ROOT / "docs" / "measured" / "fracturebench.md"


def judge_all(folders: Sequence[Path]) -> tuple[list[Record], list[str]]:
    """Records of all runs under the folders, and what could not be judged."""
    scenes: dict[str, Scene] = {}
    records, bad = [], []
    for path in sorted(p for folder in folders for p in folder.rglob("*.npz")):
        try:
            run = Run.load(path)
            case = find(run.scene)
            if run.scene not in scenes:
                scenes[run.scene] = frozen.build(case)
                if drift := frozen.drift(case, scenes[run.scene]):
                    raise SceneError(f"{run.scene}: not what was frozen: {drift[0]}")
            records.append(
                of_run(
                    case, scenes[run.scene], run,
                    machine=str(run.settings.get("machine", "")) or None,
                    commit=str(run.settings.get("commit") or run.settings.get("version") or ""),
                )
            )  # fmt: skip
        except SceneError as error:
            bad.append(f"{path}: {error}")
    return records, bad


def taken(path: Path) -> list[Record]:
    """Records of a file that answer the frozen scenes."""
    sizes: dict[str, int] = {}
    known = {c.name: c for c in cases()}
    found = []
    for r in read(path):
        case, dx = known.get(r.case), r.settings.get("dx")
        if case is None or not isinstance(dx, int | float):
            continue
        if not math.isclose(dx, case.dx, rel_tol=1e-3) or (r.method == "gsfluent" and r.variant):
            continue
        if r.case not in sizes:
            sizes[r.case] = frozen.build(case).count
        if r.points == sizes[r.case]:
            found.append(r)
    return found


def best(records: Sequence[Record]) -> list[Record]:
    """Of each case, method and device the run of least error, and of these the fastest."""
    found: dict[tuple[str, str, str], Record] = {}
    for r in records:
        key = r.case, r.method, r.device.split(":")[0]
        old = found.get(key)
        rank = (r.error, min(r.wall_seconds, default=math.inf))
        if old is None or rank < (old.error, min(old.wall_seconds, default=math.inf)):
            found[key] = r
    return list(found.values())


def kept(path: Path, new: Sequence[Record]) -> list[Record]:
    """Records of a file with new ones in place of the old, written back whole."""

    def key(r: Record) -> tuple[str, str, str]:
        return r.case, r.method, r.device.split(":")[0]

    known = {key(r): r for r in (read(path) if path.is_file() else [])}
    known |= {key(r): r for r in best(new)}
    rows = [known[k] for k in sorted(known)]
    if new:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        temporary.write_text("".join(r.line() for r in rows), encoding="utf-8")
        temporary.replace(path)
    return rows


def _cell(record: Record | None, tolerance: float) -> str:
    if record is None:
        return ""
    if record.failed or not math.isfinite(record.error):
        return "broke off" if record.failed else "no answer"
    said = f"{record.error:.2g}"
    said = f"**{said}**" if record.error <= tolerance else said
    good = sum(_within(m) for m in record.measures)
    return said if good == len(record.measures) else f"{said} ({good}/{len(record.measures)})"


def _within(measure: Mapping[str, Any]) -> bool:
    return measure["error"] is not None and float(measure["error"]) <= float(measure["tolerance"])


def _seconds(record: Record | None) -> str:
    if record is None or record.failed or not record.wall_seconds:
        return ""
    return f"{sorted(record.wall_seconds)[len(record.wall_seconds) // 2]:.2g}"


def tables(records: Sequence[Record]) -> str:
    """Errors of all methods, their times, and every measure of gsfluent, as Markdown."""
    order = {"elastic": 0, "contact": 1, "fracture": 2}
    names = sorted({r.case for r in records}, key=lambda n: (order[find(n).kind], n))
    columns = sorted(
        {(r.device.split(":")[0], r.method) for r in records},
        key=lambda c: (c[0], not c[1].startswith("gsfluent"), c[1]),
    )
    where = {
        device: sorted({r.machine for r in records if r.device.split(":")[0] == device})
        for device, _ in columns
    }
    found = {(r.case, r.device.split(":")[0], r.method): r for r in records}
    head = " | ".join(f"{method}, {device}" for device, method in columns)
    rule = "|---" * (len(columns) + 2) + "|"
    errors, times = [], []
    for name in names:
        row = [found.get((name, *column)) for column in columns]
        some = next(r for r in row if r is not None)
        first = some.measures[0]
        cells = " | ".join(_cell(r, float(first["tolerance"])) for r in row)
        errors.append(f"| {name} | {first['tolerance']:.3g} | {cells} |")
        times.append(f"| {name} | {some.points} | " + " | ".join(map(_seconds, row)) + " |")
    said = [
        "Error of each method (the first measure of the case), bold within the tolerance; in "
        "brackets how many of all measures are within theirs, where not all are.",
        "\n".join([f"| case | tolerance | {head} |", rule, *errors]),
        "Wall time of the steps [s] for all the simulated time, without a stop. "
        + "; ".join(f"{device}: {', '.join(m)}" for device, m in where.items()) + ".",
        "\n".join([f"| case | points | {head} |", rule, *times]),
        "Every measure of gsfluent:",
        _measures([r for r in records if r.method.startswith("gsfluent")]),
    ]  # fmt: skip
    return "\n\n".join(said)


def fracture_cases(records: Sequence[Record]) -> str:
    """What each fracture case is and how it is judged, from gsfluent's records."""
    lines = [
        "| case | what happens | judged by (reference; tolerance) | source |",
        "|---|---|---|---|",
    ]
    ours = [r for r in records if r.method.startswith("gsfluent")]
    seen = {
        r.case: r for r in sorted(ours, key=lambda r: r.method == "gsfluent")
    }  # by default last
    for case in cases("fracture"):
        if case.name not in seen:
            continue
        measures = seen[case.name].measures
        quantities = "; ".join(
            f"{m['quantity']} ({float(m['reference']):.3g}{' ' + m['unit'] if m['unit'] else ''}; "
            f"{float(m['tolerance']):.2g})"
            for m in measures
        )
        # what stands after the last semicolon of a statistic is its figure, not its source
        sources = list(dict.fromkeys(m["source"].split(";")[0] for m in measures))
        lines.append(f"| `{case.name}` | {case.summary} | {quantities} | {'; '.join(sources)} |")
    return "\n".join(lines)


def _measures(records: Sequence[Record]) -> str:
    lines = [
        "| case | method | device | quantity | value | reference | error | tolerance | within |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in records:
        for m in r.measures:
            value, known, error = (
                math.inf if m[k] is None else float(m[k]) for k in ("value", "reference", "error")
            )
            unit = f" {m['unit']}" if m["unit"] else ""
            within = "yes" if _within(m) else "no"
            lines.append(
                f"| {r.case} | {r.method} | {r.device} | {m['quantity']} | {value:.4g}{unit} | "
                f"{known:.4g}{unit} | {error:.2g} | {m['tolerance']:.3g} | {within} |"
            )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUNS")
    parser.add_argument("--records", type=Path, default=RECORDS, metavar="FILE")
    parser.add_argument("--page", type=Path, default=PAGE, metavar="FILE")
    args = parser.parse_args()
    try:
        if missing := [str(p) for p in args.runs if not p.exists()]:
            raise SceneError(f"no folder or file {', '.join(missing)}")
        new, bad = judge_all([p for p in args.runs if p.is_dir()])
        for path in args.runs:
            new += [] if path.is_dir() else taken(path)
        records = kept(args.records, new)
        if not records:
            raise SceneError(f"no runs given and no records in {args.records}")
        known = {c.name for c in cases()}
        records = [r for r in records if r.case in known]
        text = tables(records)
        page = args.page.read_text(encoding="utf-8") if args.page.is_file() else ""
        page = enter(page, "fracturebench_fracture", fracture_cases(records), "## Fracture cases")
        temporary = args.page.with_name(args.page.name + ".tmp")
        temporary.write_text(enter(page, "fracturebench", text, "## Results"), encoding="utf-8")
        temporary.replace(args.page)
    except (SceneError, InputError, OSError) as error:
        sys.stderr.write(f"table.py: {error}\n")
        return 2
    sys.stdout.write(text + "\n")
    for said in bad:
        sys.stderr.write(f"not judged: {said}\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
