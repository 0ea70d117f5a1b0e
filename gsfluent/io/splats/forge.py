"""The library gaussforge, which turns a ``.ply`` into ``.ksplat`` or ``.sog``, and ``.spz`` 4 back.

Needs gaussforge (``pip install "gsfluent[formats]"``). It runs in a process of its own: it talks on
stdout, and what a hostile file makes of it ends there.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from gsfluent.errors import InputError, need

PATIENCE = 600
"""Seconds that a conversion may take: a hostile file must not hang a run."""

_CONVERT = """
import sys, gaussforge
made = gaussforge.GaussForge().convert(sys.stdin.buffer.read(), *sys.argv[1:3])
if not made.get("data"):
    sys.exit(str(made.get("error", "it is damaged")))
with open(sys.argv[3], "wb") as file:
    file.write(made["data"])
"""


def converted(data: bytes, kind: str, wanted: str, path: str | Path) -> bytes:
    """A file in another format.

    Args:
        data: The file.
        kind: Its format, as gaussforge calls it.
        wanted: That of the other.
        path: Name of the one that a user knows, for errors.

    Raises:
        InputError: No gaussforge, or it cannot.
    """
    need("gaussforge", "formats", f"{path}: its format")
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made"
        try:
            done = subprocess.run(
                [sys.executable, "-c", _CONVERT, kind, wanted, str(made)],
                input=data, capture_output=True, timeout=PATIENCE,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise InputError(
                f"{path}: gaussforge has worked on it for {PATIENCE} s", "use a .ply instead"
            ) from None
        if done.returncode != 0:
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["it crashed"]
            raise InputError(
                f"{path}: gaussforge cannot convert it ({said[-1]})", "use a .ply instead"
            )
        return made.read_bytes()
