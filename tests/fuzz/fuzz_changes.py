"""Changes of bytes: what a bad disk does, and what somebody does who means it."""

from __future__ import annotations

import re
import struct
from typing import Any

from hypothesis import strategies as st

_WORDS = (
    b"nan", b"inf", b"-inf", b"NaN", b"Infinity", b"-1", b"0", b"1e999", b"1e300", b"-1e300",
    b"1" + b"0" * 400, b"1" * 5000, b"4294967296", b"9223372036854775808", b"99999999", b"1e-300",
    b"0.5", b"null", b"true", b'"text"', b"[]", b"{}", b"[" * 3000, b'{"a":' * 1500, b"", b" ",
    b"\0", b"\n", b"..", b"../" * 20 + b"etc/passwd", b"/etc/passwd", b"/dev/zero", b"~nobody/x",
    b"a" * 5000, b"a/" * 2500, b"2020-13-45", b"0b_", b"!!int abc", b"!!timestamp x", b"&a [*a]",
    b"[1, 2, [3]]", b"\xff\xfe", b"%", b"list float", b"double", b"uchar",
)  # fmt: skip
_NUMBERS = (0, 1, 2, 127, 128, 255, 256, 65535, 1 << 20, 1 << 24, (1 << 31) - 1, 1 << 31,
            (1 << 32) - 1, 1 << 32, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)  # fmt: skip
_FLOATS = (float("nan"), float("inf"), float("-inf"), 0.0, -1.0, 1e30, -1e38, 1e300, 1e-40)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")

_place = st.integers(0, (1 << 20) - 1)
_change = st.one_of(
    st.tuples(st.just("flip"), _place, st.integers(0, 7)),
    st.tuples(st.just("byte"), _place, st.integers(0, 255)),
    st.tuples(st.just("insert"), _place, st.sampled_from(_WORDS)),
    st.tuples(st.just("number"), _place, st.sampled_from(_WORDS)),
    st.tuples(st.just("int"), _place, st.tuples(st.sampled_from("BHIQ"), st.sampled_from("<>"),
                                                st.sampled_from(_NUMBERS))),
    st.tuples(st.just("float"), _place, st.tuples(st.sampled_from("efd"), st.sampled_from("<>"),
                                                  st.sampled_from(_FLOATS))),
    st.tuples(st.just("cut"), _place, st.integers(1, 64)),
    st.tuples(st.just("end"), _place, st.just(0)),
    st.tuples(st.just("twice"), _place, st.integers(1, 4096)),
)  # fmt: skip

changes = st.lists(st.tuples(_place, _change), min_size=1, max_size=4)
"""One to four changes, each of some part of a file."""


def changed(parts: list[bytes], given: list[Any]) -> list[bytes]:
    """The parts of a file after changes."""
    parts = list(parts)
    for which, change in given:
        index = which % len(parts)
        parts[index] = _changed(parts[index], *change)
    return parts


def _changed(data: bytes, kind: str, place: int, value: Any) -> bytes:
    at = place % (len(data) + 1)
    if kind == "flip" and at < len(data):
        return data[:at] + bytes([data[at] ^ 1 << value]) + data[at + 1 :]
    if kind == "byte":
        return data[:at] + bytes([value]) + data[at + 1 :]
    if kind == "insert":
        return data[:at] + value + data[at:]
    if kind == "number" and (found := list(_NUMBER.finditer(data))):
        hit = found[place % len(found)]
        return data[: hit.start()] + value + data[hit.end() :]
    if kind in ("int", "float"):
        letter, order, number = value
        if kind == "int":
            number &= (1 << 8 * struct.calcsize(letter)) - 1
        elif letter == "e" or (letter == "f" and abs(number) > 3e38):
            number = max(min(number, 6e4), -6e4) if abs(number) < float("inf") else number
        packed = struct.pack(order + letter, number)
        # numbers of a table stand in steps of their size
        at -= at % len(packed) if place % 2 else 0
        return data[:at] + packed + data[at + len(packed) :]
    if kind == "cut":
        return data[:at] + data[at + value :]
    if kind == "end":
        return data[:at]
    if kind == "twice":
        return data[:at] + data[at : at + value] + data[at:]
    return data
