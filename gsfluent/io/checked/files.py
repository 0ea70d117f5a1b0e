"""Whole files as bytes, text and JSON; what is no file, or too large, ends in an InputError."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError, short
from gsfluent.io.checked.limits import within

_DIGITS = 400  # of a whole number; a float64 has 309


def regular_file(path: str | Path, noun: str = "file", hint: str = "check the path") -> int:
    """Size in bytes of a file that can be read to its end: no folder, pipe or device.

    Args:
        path: The file.
        noun: What it should be, for the message.
        hint: What to do when it is not there.

    Raises:
        InputError: It is not there, is something else, or its name is none.
    """
    shown = short(str(path), bare=True)
    try:
        found = Path(path).stat()
    except FileNotFoundError as error:
        raise InputError(f"{shown}: no such {noun}", hint) from error
    except OSError as error:
        raise InputError(f"{shown}: cannot be read ({error.strerror})", "check the path") from error
    except ValueError as error:  # a NUL
        raise InputError(f"{shown!r} is no name of a file ({error})", "check the path") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or device"
        raise InputError(f"{shown}: is {kind}, not a file", f"name a {noun}")
    return found.st_size


def is_file(path: Path) -> bool:
    """Whether a name out of a file means a file; a name that no file can have does not."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long; a NUL
        return False


def read_bytes(path: str | Path, noun: str = "file", hint: str = "check the path") -> bytes:
    """All bytes of a file.

    Raises:
        InputError: As :func:`regular_file`, or it cannot be read.
    """
    regular_file(path, noun, hint)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})", "check the file") from error


def read_text(path: str | Path, limit_name: str = "json_bytes", noun: str = "file") -> str:
    """All of a file as UTF-8.

    Raises:
        InputError: As :func:`read_bytes`, above its limit, or no UTF-8.
    """
    within(limit_name, regular_file(path, noun), path)
    try:
        return read_bytes(path, noun).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text ({error})", "save it as UTF-8") from error


def read_json(path: str | Path, hint: str = "export it again", noun: str = "file") -> Any:
    """The value in a JSON file.

    Raises:
        InputError: As :func:`read_text`, no JSON, nested too deeply, or a number of hundreds of
            digits.
    """
    return parse_json(read_text(path, noun=noun), path, hint)


def parse_json(text: str, path: str | Path, hint: str = "export it again") -> Any:
    """The value in a text of JSON that was found in a file.

    Raises:
        InputError: As :func:`read_json`.
    """
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError as error:
        raise InputError(f"{path}: not readable as JSON (nested too deeply)", hint) from error
    except ValueError as error:
        raise InputError(f"{path}: not readable as JSON ({error})", hint) from error


def _whole(digits: str) -> int:
    if len(digits) > _DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)
