"""Draw the recorded charts and enter their tables into docs/measured/chart.md; nothing is run.

    python scripts/pictures/chart.py                  # docs/images, docs/measured
    python scripts/pictures/chart.py --device cpu

Reads docs/measured/data/chart_cpu.jsonl and chart_cuda.jsonl (`gsfluent chart`) and, where they
are, peers_cpu.jsonl and peers_cuda.jsonl (scripts/peers/collect.py).
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Sequence
from pathlib import Path

from gsfluent.errors import GsfluentError
from gsfluent.figure.markdown import enter
from gsfluent.fracturebench.registry import find
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.draw import Chart, gathered, of_records
from gsfluent.lab.charts.ladder import CASES, KNOBS, OFF_GRID

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "chart.md"
HEADINGS = {
    "cases": "The cases", "knobs": "The knobs", "measures": "What trades nothing",
    "cpu": "Two cores", "cuda": "H100",
}  # fmt: skip
MOST_BYTES = 300_000
TABLES = (
    "Against each peer", "Fronts", "What each knob does", "Measures that trade nothing",
)  # fmt: skip


def load(device: str, data: Path) -> Chart | None:
    """The recorded chart of a device, or None if there are no lines of gsfluent's."""
    ours = data / f"chart_{device}.jsonl"
    if not ours.is_file():
        return None
    files = [ours, *(p for p in (data / f"peers_{device}.jsonl",) if p.is_file())]
    return next((c for c in of_records(gathered(files)) if c.device == device), None)


def cases() -> str:
    """What is charted, case by case."""
    rows = [f"| {name} | {find(name).summary} |" for name in CASES]
    stage = "`pipeline.Simulate`, and beside it the same with"
    rows += [f"| {name} | {stage} {off} |" for name, off in OFF_GRID.items()]
    return "\n".join(["| case | what it is |", "| --- | --- |", *rows])


def knobs() -> str:
    """What is turned."""
    rows = [f"| {name} | {what} |" for name, what in KNOBS.items()]
    return "\n".join(["| knob | what it turns |", "| --- | --- |", *rows])


def measures() -> str:
    """What only saves time, by the tests that compare runs with it and without it."""
    rows = []
    for path in sorted((ROOT / "tests").rglob("test_trades_nothing*.py")):
        device = "GPU" if path.stem.endswith("cuda") else "CPU"
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                said = (ast.get_docstring(node) or "").split("\n\n")[0].replace("``", "`")
                rows.append(f"| {device} | `{node.name}` | {' '.join(said.split())} |")
    return "\n".join(["| on | test | what is compared |", "| --- | --- | --- |", *rows])


def small(path: Path) -> None:
    """Bring a PNG below the size that docs allow, with fewer colours."""
    from PIL import Image

    for colors in (128, 48):
        if path.stat().st_size <= MOST_BYTES:
            return
        with Image.open(path) as picture, atomic_path(path) as temporary:
            picture.convert("RGB").quantize(colors).save(temporary, optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw and enter what there is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), action="append")
    parser.add_argument("--data", type=Path, default=ROOT / "docs" / "measured" / "data")
    parser.add_argument("--images", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument("--markdown", type=Path, default=PAGE)
    given = parser.parse_args(arguments)
    text = given.markdown.read_text(encoding="utf-8")
    for name, part in (("cases", cases()), ("knobs", knobs()), ("measures", measures())):
        text = enter(text, f"chart {name}", part, f"## {HEADINGS[name]}")
    with atomic_path(given.markdown) as temporary:
        temporary.write_text(text, encoding="utf-8")
    done = 0
    for device in given.device or ("cpu", "cuda"):
        try:
            chart = load(device, given.data)
        except GsfluentError as error:
            sys.stderr.write(f"{error}\n")
            return 2
        if chart is None:
            sys.stderr.write(f"no {given.data}/chart_{device}.jsonl; left out\n")
            continue
        picture = chart.figure(given.images / f"chart_{device}.png")
        small(picture)
        text = given.markdown.read_text(encoding="utf-8")
        alt = f"Error against time, {HEADINGS[device]}"
        part = f"![{alt}](../images/{picture.name})\n\n{chart.machine}.\n\n{chart.text(TABLES)}"
        text = enter(text, f"chart {device}", part, f"## {HEADINGS[device]}")
        with atomic_path(given.markdown) as temporary:
            temporary.write_text(text, encoding="utf-8")
        done += 1
        print(f"{device}: {len(chart.records)} runs; {chart.verdict.text()}")
    return 0 if done else 2


if __name__ == "__main__":
    raise SystemExit(main())
