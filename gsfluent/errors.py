"""The exceptions a user of gsfluent meets; every text says what, where and how to mend it."""

from __future__ import annotations

import importlib
import reprlib
from collections.abc import Iterable
from types import ModuleType

EXTRAS = {
    "poses": ("pycolmap",),
    "mesh": ("scikit-image",),
    "viewer": ("viser",),
    "usd": ("usd-core",),
    "inpaint": ("transformers", "accelerate"),
    "figures": ("matplotlib",),
    "slurm": ("submitit",),
    "ray": ("ray",),
    "s3": ("s3fs",),
    "formats": ("gaussforge",),
}
"""Packages that gsfluent does without until they are asked for: extra -> names on the index."""


class GsfluentError(Exception):
    """Base class of gsfluent's own errors."""

    exit_code = 1


class InputError(GsfluentError, ValueError):
    """Something that came in is wrong: a file, a key, a tensor's contents.

    Args:
        what: What is wrong, naming the argument, key or file and what came.
        hint: What the user can do about it (one sentence).
    """

    exit_code = 2

    def __init__(self, what: str, hint: str = "") -> None:
        self.what = what
        self.hint = hint
        super().__init__(f"{what}\n  hint: {hint}" if hint else what)


class _Short(reprlib.Repr):
    """``repr`` of what a file held, however large or nested it is."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = 6
        self.maxstring = self.maxother = 120

    def repr_int(self, x: int, level: int) -> str:
        """A whole number; Python refuses to print those of thousands of digits."""
        if x.bit_length() < 200:
            return str(x)
        return f"{'-' if x < 0 else ''}2^{x.bit_length() - 1} or more"


def short(value: object, *, bare: bool = False) -> str:
    """What a message shows of a value that came in: its ``repr``, cut.

    Args:
        value: Anything.
        bare: Of text: itself, without quotes.
    """
    if isinstance(value, str) and bare:
        return value if len(value) <= 400 else f"{value[:200]}...{value[-100:]}"
    return _Short().repr(value)


def check_choice(what: str, value: object, allowed: Iterable[object], hint: str = "") -> None:
    """Raise :class:`InputError` unless ``value`` is one of ``allowed``; ``what`` names it."""
    names = list(allowed)
    if value not in names:
        listed = ", ".join(str(name) for name in names if name != "")
        raise InputError(f"{what} must be one of {listed}, got {short(value)}", hint)


class MissingPackage(InputError):
    """A package of an extra is asked for and not installed."""


def need(module: str, extra: str, what: str) -> ModuleType:
    """Import a package that only an extra installs.

    Args:
        module: Its module.
        extra: The extra of gsfluent that brings it.
        what: Who needs it, the first words of the message.

    Raises:
        MissingPackage: It cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingPackage(
            f"{what} needs {package}, which is not installed ({error})",
            f'pip install "gsfluent[{extra}]"',
        ) from error


class RunError(GsfluentError, RuntimeError):
    """A stage failed while running.

    Args:
        what: What failed and where.
        kept: What was kept on disk.
        hint: How to resume or what to change.
    """

    exit_code = 1

    def __init__(self, what: str, kept: str = "", hint: str = "") -> None:
        self.what = what
        self.kept = kept
        self.hint = hint
        lines = [what]
        if kept:
            lines.append(f"  kept: {kept}")
        if hint:
            lines.append(f"  hint: {hint}")
        super().__init__("\n".join(lines))
