"""Judge the runs of all.py and add them to a file of records, a JSON line each.

python scripts/peers/collect.py out/peers -o docs/measured/data/peers_cpu.jsonl [--machine NAME]
python scripts/peers/collect.py --markdown docs/measured/peers.md

Runs in gsfluent's environment. A run whose record is there is not added again. --machine names
where the runs were made if that is not here.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from gsfluent.figure.markdown import enter  # noqa: E402
from gsfluent.fracturebench.registry import find  # noqa: E402
from gsfluent.fracturebench.run import Run  # noqa: E402
from gsfluent.fracturebench.scene import Scene, SceneError  # noqa: E402
from gsfluent.lab.charts.record import Record, append, machine, of_run, read  # noqa: E402

DATA = ROOT / "docs" / "measured" / "data"


def record(folder: Path, path: Path, where: str | None) -> Record:
    """The record of one run of a folder of all.py."""
    run = Run.load(path)
    dx = float(run.settings["dx"])
    scene = Scene.load(folder / "scenes" / f"{run.scene}-{dx:.5g}.npz")
    settings = dict(run.settings)
    walls = settings.pop("walls", [run.wall_seconds])
    variant = f"{settings.pop('variant')}, c dt/dx {settings['courant']:.3g}"
    # the judge sees one run; its repeats differ in nothing but their time
    runs = [
        Run(run.scene, run.method, run.times, run.x, run.v, float(wall), run.steps, settings,
            run.device, run.failed)
        for wall in walls
    ]  # fmt: skip
    name = machine(run.device) if where is None else where
    return of_run(
        find(run.scene), scene, runs, variant=variant, machine=name,
        commit=str(settings.get("version", "")),
    )  # fmt: skip


def collect(folder: Path, out: Path, where: str | None = None) -> list[Record]:
    """Judge what is new in a folder and append it; return what was appended."""
    known = {r.key for r in read(out)} if out.is_file() else set()
    fresh = []
    for path in sorted(folder.glob("*/*.npz")):
        if path.parent.name == "scenes":
            continue
        try:
            made = record(folder, path, where)
        except SceneError as error:
            sys.stderr.write(f"collect: {error}\n")
            continue
        if made.key not in known:
            append(out, made)
            known.add(made.key)
            fresh.append(made)
    return fresh


def front(records: Sequence[Record]) -> list[Record]:
    """Those that no other beats in both error and time, by rising time."""
    out: list[Record] = []
    for r in sorted((r for r in records if r.ok), key=lambda r: (r.wall_per_simulated, r.error)):
        if not out or r.error < out[-1].error:
            out.append(r)
    return out


def table(records: Sequence[Record]) -> str:
    """Markdown: the front of every peer on every case, and what it could not do."""
    lines = [
        "| case | peer | runs | front: error at wall ms per simulated ms (dx in mm, c dt/dx) | "
        "could not |",
        "| --- | --- | --- | --- | --- |",
    ]
    for case in sorted({r.case for r in records}):
        for method in sorted({r.method for r in records if r.case == case}):
            own = [r for r in records if r.case == case and r.method == method]
            best = [
                f"{r.error:.3g} at {r.wall_per_simulated:.3g} "
                f"({1e3 * r.settings['dx']:.3g}, {r.settings['courant']:.2g})"
                for r in front(own)
            ]
            why: dict[str, int] = {}
            for r in own:
                if r.failed:
                    why[reason(r)] = why.get(reason(r), 0) + 1
            not_done = "; ".join(f"{text} ({count})" for text, count in why.items())
            lines.append(f"| {case} | {method} | {len(own)} | {'; '.join(best)} | {not_done} |")
    return "\n".join(lines)


def reason(record: Record) -> str:
    """Why a run failed, without the time at which it did."""
    return record.failed.split(" before t = ")[0]


def page(markdown: Path) -> None:
    """Enter the tables of the records that are there into a page."""
    text = markdown.read_text(encoding="utf-8")
    for device in ("cpu", "cuda"):
        data = DATA / f"peers_{device}.jsonl"
        if data.is_file():
            records = read(data)
            names = sorted({r.machine for r in records})
            part = f"Machine: {'; '.join(names)}. {len(records)} runs.\n\n{table(records)}"
            text = enter(text, f"peers {device}", part)
    markdown.write_text(text, encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", help="what all.py was given with -o")
    parser.add_argument("-o", "--out", type=Path, help="file of records, added to")
    parser.add_argument("--machine", help="where the runs were made; default: this machine")
    parser.add_argument("--markdown", type=Path, help="enter the recorded lines into this page")
    options = parser.parse_args(arguments)
    if options.markdown is None and (options.folder is None or options.out is None):
        parser.error("give a folder and -o, or --markdown")
    if options.folder is not None and options.out is not None:
        fresh = collect(options.folder, options.out, options.machine)
        bad = sum(not r.ok for r in fresh)
        errors = [r.error for r in fresh if r.ok]
        best = f", smallest error {np.min(errors):.4f}" if errors else ""
        sys.stdout.write(f"{len(fresh)} records added, {bad} of them failed{best}\n")
    if options.markdown is not None:
        page(options.markdown)
    return 0


if __name__ == "__main__":
    sys.exit(main())
