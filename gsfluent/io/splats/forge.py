"""Splats written as ``.ksplat`` and ``.sog`` by the library gaussforge, from our own ``.ply``.

Needs gaussforge (``pip install "gsfluent[formats]"``); the two are read without it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError, need
from gsfluent.io.atomic import atomic_path
from gsfluent.io.splats.load import save_splats

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
    if "error" in made:
        raise InputError(f"{path}: gaussforge cannot write it ({made['error']})", "export a .ply")
    with atomic_path(path) as part:
        part.write_bytes(made["data"])
