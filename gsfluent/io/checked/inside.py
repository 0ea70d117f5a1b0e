"""Names in a file that lead to other files: they stay in its folder unless the user says so."""

from __future__ import annotations

import contextlib
import contextvars
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath

from gsfluent.errors import InputError, short

_allowed = contextvars.ContextVar("gsfluent_allow_outside", default=False)


@contextlib.contextmanager
def allow_outside(yes: bool = True) -> Iterator[None]:
    """Let captures that are read in this block name files outside their folders."""
    token = _allowed.set(yes)
    try:
        yield
    finally:
        _allowed.reset(token)


def inside(folder: Path, name: str, where: object) -> Path:
    """The file that ``name`` means in ``folder``, ``.`` and ``..`` taken out.

    Links in the folder are followed: who made the folder on this machine made them.

    Args:
        folder: Of the file that names it.
        name: Relative, or anything inside :func:`allow_outside`.
        where: What names it, for the message.

    Raises:
        InputError: Absolute, or it leaves the folder; or it is no name at all.
    """
    if not name or "\0" in name or len(name) > 4096:
        raise InputError(f"{where}: {short(name)} is no name of a file", "correct the name")
    normal = os.path.normpath(name)
    leaves = PurePosixPath(normal).parts[:1] == ("..",) or PureWindowsPath(name).parts[:1] == (
        "..",
    )
    if (leaves or os.path.isabs(name) or PureWindowsPath(name).drive) and not _allowed.get():
        raise InputError(
            f"{where}: {short(name)} lies outside the folder {folder}",
            "move the file there, or give --allow-outside if you trust the capture",
        )
    return Path(os.path.normpath(folder / name))
