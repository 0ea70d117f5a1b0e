"""Splats by the library gaussforge: ``.ksplat`` and ``.sog`` out, ``.spz`` of version 4 in.

Needs gaussforge (``pip install "gsfluent[formats]"``); it takes and gives ``.ply`` in memory.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError, need
from gsfluent.io.atomic import atomic_path
from gsfluent.io.splats.load import load_splats, save_splats

_CONVERT = """
import sys, gaussforge
made = gaussforge.GaussForge().convert(sys.stdin.buffer.read(), sys.argv[1], "ply")
if not made.get("data"):
    sys.exit(str(made.get("error", "it is damaged")))
with open(sys.argv[2], "wb") as file:
    file.write(made["data"])
"""
# in a process of its own: it talks on stdout, and what a hostile file makes of it ends there

DEGREES = {".ksplat": 2, ".sog": 3}
"""What is written, by the end of the name, and its highest SH degree."""


def save_forged(gaussians: Gaussians, path: str | Path) -> None:
    """Write splats as ``.ksplat`` or ``.sog``, atomically; normals and labels are left out.

    A ``.ksplat`` has level 0: numbers as they are, colours and opacities in 8 bits. A ``.sog``
    has code books for scales and colours, found by clustering.

    Args:
        gaussians: What to write, in any axes; SH above :data:`DEGREES` is left out.
        path: Output file.

    Raises:
        InputError: Another ending, no gaussforge, or values no splat can have.
        RunError: The disk is full.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in DEGREES:
        raise InputError(f"{path}: not a name of these", f"end it with {' or '.join(DEGREES)}")
    need("gaussforge", "formats", f"export: a {kind} file")
    from gaussforge import GaussForge

    degree = min(gaussians.sh_degree, DEGREES[kind])
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "splats.ply"
        save_splats(gaussians.with_sh_degree(degree).replace(labels=None), plain)
        made = GaussForge().convert(plain.read_bytes(), "ply", kind[1:])
    if not made.get("data"):
        said = made.get("error", "no reason given")
        raise InputError(f"{path}: gaussforge cannot write it ({said})", "export a .ply")
    with atomic_path(path) as part:
        part.write_bytes(made["data"])


def load_forged(packed: bytes, kind: str, path: str | Path) -> Gaussians:
    """Splats of a file that gaussforge reads, in the axes that it gives them.

    Args:
        packed: The file.
        kind: Its format, as gaussforge calls it.
        path: Its name, for errors.

    Raises:
        InputError: No gaussforge, a damaged file, or values no splat can have.
    """
    need("gaussforge", "formats", f"{path}: this version")
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "splats.ply"
        done = subprocess.run(
            [sys.executable, "-c", _CONVERT, kind, str(plain)], input=packed, capture_output=True
        )
        if done.returncode != 0:
            said = done.stderr.decode(errors="replace").strip().splitlines() or ["it crashed"]
            raise InputError(f"{path}: cannot be read ({said[-1]})", "export the splat again")
        return load_splats(plain)
