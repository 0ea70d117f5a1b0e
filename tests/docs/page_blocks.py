"""The blocks of a page, and the Python among them run as a reader would: in order, from nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def blocks_of(page: Path, kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def run_blocks(page: Path, folder: Path) -> str:
    """What the Python blocks of a page print, run one after the other by a new interpreter."""
    return run_python("\n".join(blocks_of(page, "python")), folder, page.name)


def run_python(text: str, folder: Path, name: str) -> str:
    """What a program prints that a new interpreter runs in a folder."""
    done = subprocess.run(
        [sys.executable, "-c", text],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{name}:\n{text}\n{done.stderr}"
    return done.stdout
