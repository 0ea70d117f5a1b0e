"""Problems with known answers: run them all, and enter the table into docs/measured/accuracy.md.

    python scripts/accuracy/battery.py --tier fast         # a minute on one core
    python scripts/accuracy/battery.py --json b.json --markdown docs/measured/accuracy.md  # all
    python scripts/accuracy/battery.py --device cuda --json g.json

With --json the figures of every problem are kept as soon as it ends, and a second run computes only
what is missing there (--fresh computes all anew). Exit code 1 when a tolerance is missed or a
problem fails to run; with --known PAGE not for misses that the page's table has already.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import platform
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import torch

from gsfluent import has_cuda
from gsfluent.figure.markdown import enter
from gsfluent.lab.world import registry
from gsfluent.lab.world.driver import running_on
from gsfluent.lab.world.registry import Problem, Result

HEADING = "## Problems with known answers"


def compute(item: Problem) -> dict[str, Any]:
    """Figures of one problem; one that raises gives a row that says so."""
    start = time.process_time()
    try:
        results = registry.run(item)
        error = "" if results else "returned no result"
    except Exception as failure:  # a broken problem must not lose the others' figures
        traceback.print_exc(file=sys.stderr)
        results, error = [], f"{type(failure).__name__}: {failure}"
    return {
        "name": item.name,
        "tier": item.tier,
        "summary": item.summary,
        "error": error,
        "seconds": time.process_time() - start,
        "results": [dataclasses.asdict(r) for r in results],
    }


def load(path: Path | None) -> dict[str, Any]:
    if path is None or not path.exists():
        return {}
    return json.loads(path.read_text())


def save(path: Path | None, record: dict[str, Any]) -> None:
    if path is None:
        return
    temporary = path.with_suffix(path.suffix + ".tmp")
    temporary.write_text(json.dumps(record, indent=1) + "\n")
    temporary.replace(path)


def number(value: float) -> str:
    if not math.isfinite(value):
        return str(value)
    if value == 0.0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.5g}"
    return f"{value:.2e}"


def table(record: dict[str, Any]) -> str:
    """The figures as a Markdown table, misses in bold."""
    items = [record["problems"][name] for name in sorted(record["problems"])]
    missed = sum(not Result(**r).passed for i in items for r in i["results"])
    broken = sum(bool(i["error"]) for i in items)
    count = sum(len(i["results"]) for i in items)
    verdict = f"{count} figures of {len(items)} problems"
    verdict += "; all within their tolerances" if not missed + broken else ""
    verdict += f"; **{missed} missed**" if missed else ""
    verdict += f"; **{broken} did not run**" if broken else ""
    lines = [
        f"{record['device']} ({record['name']}, torch {record['torch']}): {verdict}.",
        "",
        "| problem | figure | value | reference | error | tolerance | | source | CPU s |",
        "|" + " --- |" * 9,
    ]
    for item in items:
        if item["error"]:
            error = f"**did not run**: {cell(item['error'])}"
            lines.append(
                f"| {item['name']} | {cell(item['summary'])} | | | | | {error} | "
                f"| {item['seconds']:.1f} |"
            )
        for r in item["results"]:
            result = Result(**r)
            unit = f" {result.unit}" if result.unit else ""
            note = f"; {result.note}" if result.note else ""
            lines.append(
                f"| {result.name} | {cell(result.quantity)} | {number(result.value)}{unit} "
                f"| {number(result.reference)}{unit} | {number(result.error)} "
                f"| {number(result.tolerance)} | {'pass' if result.passed else '**MISS**'} "
                f"| {cell(result.source + note)} | {result.seconds:.1f} |"
            )
    return "\n".join(line.replace("\n", " ") for line in lines)


def cell(text: str) -> str:
    """Text that does not end a cell of the table."""
    return text.replace("|", "\\|")


def admitted(page: Path | None) -> set[tuple[str, str]]:
    """Problems and figures that a page's table calls missed."""
    if page is None:
        return set()
    rows = [line.split(" | ") for line in page.read_text().splitlines() if "**MISS**" in line]
    return {(row[0].removeprefix("| "), row[1]) for row in rows if len(row) > 2}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tier", choices=["fast", "slow", "all"], default="all")
    parser.add_argument("--only", help="problems whose name contains this")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--json", type=Path, help="keep the figures here, and take up from here")
    parser.add_argument("--fresh", action="store_true", help="compute again what --json holds")
    parser.add_argument("--markdown", type=Path, help="enter the table into this page")
    parser.add_argument("--known", type=Path, help="page whose misses are no news")
    options = parser.parse_args(arguments)
    if options.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no GPU, or gsfluent was built without its CUDA kernels")
    registry.discover()
    chosen = registry.problems(options.tier, options.only)
    if not chosen:
        parser.error(f"no problem of tier {options.tier} has {options.only!r} in its name")
    record = load(options.json)
    if record and record.get("device") != options.device:
        parser.error(f"--json {options.json} holds figures of {record.get('device')}")
    if not record:
        name = torch.cuda.get_device_name() if options.device == "cuda" else platform.machine()
        record = {"device": options.device, "name": name, "torch": torch.__version__}
        record["problems"] = {}
    with running_on(options.device):
        for item in chosen:
            done = record["problems"].get(item.name)
            if done and not done["error"] and not options.fresh:
                continue
            sys.stderr.write(f"{item.name} ... ")
            sys.stderr.flush()
            record["problems"][item.name] = compute(item)
            sys.stderr.write(f"{record['problems'][item.name]['seconds']:.1f} s\n")
            save(options.json, record)
    text = table(record)
    sys.stdout.write(text + "\n")
    if options.markdown:
        page = options.markdown
        before = page.read_text() if page.exists() else "# Accuracy\n"
        page.write_text(enter(before, "battery", text, HEADING))
    items, known = record["problems"].values(), admitted(options.known)
    missed = (Result(**r) for i in items for r in i["results"])
    news = [r for r in missed if not r.passed and (r.name, cell(r.quantity)) not in known]
    return int(bool(news) or any(i["error"] for i in items))


if __name__ == "__main__":
    sys.exit(main())
