"""Lines of a study: the law by which their matter breaks, how they are read and shown."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsfluent import materials
from gsfluent.figure.markdown import enter
from gsfluent.io.atomic import atomic_path
from gsfluent.materials import Material

Row = dict[str, Any]
NAMES = {"nacc": "cam_clay", "rankine": "rankine"}
"""Laws by which brittle matter breaks, and the yield surface of each."""
FIRST = "nacc"
"""Law of records that name none: there was no other."""


def add_law(parser: argparse.ArgumentParser) -> None:
    """Let a study be asked for a law."""
    parser.add_argument(
        "--law", choices=[*NAMES], default="", help="by which matter breaks; default: its preset's"
    )


def preset_of(name: str, law: str = "") -> Material:
    """A preset that breaks by a law.

    Args:
        name: Of the preset.
        law: Of :data:`NAMES`, or none: that of the preset. What breaks by none of them stays.
    """
    material = materials.get(name)
    if not law or material.law != "nacc" or law_of(material) == law:
        return material
    return material.override(surface=NAMES[law])


def law_of(material: Material) -> str:
    """Name of the law by which a material breaks."""
    return "rankine" if material.surface == "rankine" else material.law


def read(path: Path) -> list[Row]:
    """Lines of a file, none if it is not there; one that was cut off is left out."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            rows.append({"law": FIRST, **json.loads(line)})
        except json.JSONDecodeError:
            sys.stderr.write(f"{path}: a line was cut off and is left out\n")
    return rows


def append(path: Path, row: Row) -> None:
    """Add a line to a file; one that was cut off before it stays a line of its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        if file.tell():
            file.seek(-1, 2)
        whole = not file.tell() or file.read() == b"\n"
        file.write(("" if whole else "\n").encode() + json.dumps(row).encode() + b"\n")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def put(page: Path, name: str, text: str) -> None:
    """Enter a text into a page, between the marks of that name."""
    whole = enter(page.read_text(encoding="utf-8"), name, text)
    with atomic_path(page) as file:
        file.write_text(whole, encoding="utf-8")


def numbers(text: str) -> tuple[int, ...]:
    """Read ``20,40``."""
    return tuple(sorted(int(n) for n in text.split(",") if n))
