"""How much a file may ask for before anything is allocated. All limits stand here.

A limit holds for what a file *declares*, so a file of a kilobyte that unpacks to terabytes costs a
look at its header. Each can be raised for a process by its environment variable.
"""

from __future__ import annotations

import os

from gsfluent.errors import InputError

LIMITS: dict[str, tuple[int, str]] = {
    "pixels": (100_000_000, "pixels of one picture, mask or label map"),
    "unpacked_bytes": (1 << 29, "bytes of all arrays of one file"),
    "json_bytes": (1 << 27, "bytes of one JSON or CSV file"),
    "yaml_bytes": (1 << 20, "bytes of one YAML file"),
    "yaml_values": (100_000, "values of one YAML file, aliases written out"),
    "label_pixels": (2_000_000_000, "pixels of all label maps of one segmentation"),
    "painted_pixels": (3_000_000_000, "pixels that the masks of one photograph cover together"),
}
"""Name -> (value, of what). The variable is ``GSFLUENT_MAX_`` and the name in capitals."""

EXPANSION = 50
"""An honest file of large arrays is large itself: so many times its bytes are always allowed."""

DEPTH = 100
"""How deep YAML may nest."""


def limit(name: str) -> int:
    """The limit in force: the environment's, else that of :data:`LIMITS`.

    Raises:
        InputError: The environment's is no positive number.
    """
    variable = _variable(name)
    given = os.environ.get(variable)
    if given is None:
        return LIMITS[name][0]
    try:
        value = int(float(given))
    except (ValueError, OverflowError):
        value = 0
    if value < 1:
        raise InputError(f"{variable} must be a positive number, got {given!r}", "such as 4e9")
    return value


def within(name: str, got: int, where: object, most: int | None = None) -> None:
    """Raise unless ``got`` keeps to a limit.

    Args:
        name: Of the limit.
        got: What the file declares.
        where: The file, and the place in it.
        most: Another number than the limit, see :func:`unpacked_limit`.

    Raises:
        InputError: It does not; the message has the limit and the variable that raises it.
    """
    most = limit(name) if most is None else most
    if got > most:
        raise InputError(
            f"{where}: {_count(got)} {LIMITS[name][1]} are above the limit of {_count(most)}",
            f"if the file is to be trusted, set {_variable(name)} to as many",
        )


def unpacked_limit(file_bytes: int) -> int:
    """Bytes that a file of ``file_bytes`` may unpack to."""
    return max(limit("unpacked_bytes"), EXPANSION * file_bytes)


def _variable(name: str) -> str:
    return f"GSFLUENT_MAX_{name.upper()}"


def _count(number: int) -> str:
    return str(number) if number.bit_length() < 64 else f"more than 2^{number.bit_length() - 1}"
