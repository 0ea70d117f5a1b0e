"""What came out of a sweep: a line a shot, and the posters side by side."""

from __future__ import annotations

import csv
import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsfluent.figure.page import Page, shown
from gsfluent.io import atomic_path
from gsfluent.sweep.engine import Outcome


def lines_of(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """The lines of the table, all with the same columns: what differs, then what came out."""
    lines = []
    for outcome in outcomes:
        value = outcome.value
        differs = {f"vary.{name}": _cell(item) for name, item in value["changes"].items()}
        head = {"id": outcome.id, **{k: value[k] for k in ("index", "object", "seed")}, **differs}
        ends = {k: value[k] for k in ("verdict", "reason")} | {"tries": outcome.tries}
        lines.append(head | ends | value["figures"])
    columns = dict.fromkeys(name for line in lines for name in line)
    return [{name: line.get(name) for name in columns} for line in lines]


def _cell(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool) else json.dumps(value)


def write_table(out: Path, outcomes: Sequence[Outcome]) -> list[Path]:
    """Write ``table.csv``, and ``table.parquet`` where pyarrow is installed.

    Args:
        out: Folder of the sweep.
        outcomes: Shots that are done.

    Raises:
        RunError: The disk is full.
    """
    lines = lines_of(outcomes)
    written = [out / "table.csv"]
    with atomic_path(written[0]) as part, part.open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(lines[0]) if lines else ["id"])
        table.writeheader()
        table.writerows(lines)
    if lines and importlib.util.find_spec("pyarrow"):
        import pyarrow
        import pyarrow.parquet

        written.append(out / "table.parquet")
        with atomic_path(written[-1]) as part:
            pyarrow.parquet.write_table(pyarrow.Table.from_pylist(_alike(lines)), part)
    return written


def _alike(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lines whose columns hold one kind of value each, which parquet wants; text where they mix."""
    mixed = set()
    for name in lines[0]:
        kinds = {type(line[name]) for line in lines if line[name] is not None}
        if len(kinds) > 1 and not kinds <= {int, float}:
            mixed.add(name)
    return [
        {
            name: str(item) if name in mixed and item is not None else item
            for name, item in line.items()
        }
        for line in lines
    ]


def write_sheet(out: Path, outcomes: Sequence[Outcome], failures: Sequence[dict[str, Any]]) -> Path:
    """Write ``sheet.html``: posters with what differs, each leading to its film; no script.

    Args:
        out: Folder of the sweep.
        outcomes: Shots that are done.
        failures: The last try of each that failed.
    """
    page = Page(f"Sweep {out.name}", f"{len(outcomes)} shots done, {len(failures)} failed")
    pictures = []
    for outcome in outcomes:
        folder = f"shots/{outcome.id}"
        if (out / folder / "poster.png").is_file():
            pictures.append(
                (f"{folder}/poster.png", f"{folder}/video.mp4", caption_of(outcome.value))
            )
    page.sheet(pictures)
    without = [o for o in outcomes if not (out / "shots" / o.id / "poster.png").is_file()]
    if without:
        page.heading("Without a film")
        page.table(
            ["shot", "what differs", "reason"],
            [[o.id, caption_of(o.value), o.value["reason"]] for o in without],
        )
    if failures:
        page.heading("Failed").table(
            ["shot", "kind", "message"], [[f["id"], f["kind"], f["message"]] for f in failures]
        )
    return page.write(out / "sheet.html")


def caption_of(value: dict[str, Any]) -> str:
    """What differs of a shot, and its verdict, in a few words."""
    words = [f"{name.rpartition('.')[2]} {shown(_cell(v))}" for name, v in value["changes"].items()]
    pieces = value["figures"].get("pieces_over_1_percent")
    words.append(f"seed {value['seed']}")
    words += [] if pieces is None else [f"{pieces} pieces"]
    return ", ".join([*words, value["verdict"]])
