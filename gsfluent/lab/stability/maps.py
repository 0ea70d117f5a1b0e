"""Stability maps: where in a plane of two settings a run first breaks a law, one JSON line a point.

A map is two axes, one or more variants (the first is gsfluent as it comes) and a function that runs
one point and says what it broke and when (:mod:`gsfluent.lab.world.invariants`). The maps
themselves are in the files beside this one, gathered in ``run.py``; what is drawn from the lines,
in ``report.py``.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError
from gsfluent.lab.world.invariants import KINDS, Violation

Value = float | str
KIND_WORDS = {**KINDS, "order": "two numberings of the same points parted by 1e-4 dx"}
LETTERS = {
    "finite": "N", "energy": "E", "momentum": "M", "volume": "J", "path": "P", "stopped": "X",
    "order": "O",
}  # fmt: skip
"""How the kinds of violation are lettered on a map."""


@dataclasses.dataclass(frozen=True)
class Axis:
    """One axis of a map."""

    name: str  # short name, a key of the tables
    label: str  # words with the unit
    values: tuple[Value, ...]  # numbers in rising order, or words
    default: Value  # where gsfluent stands by default, or the ordinary scene; one of values
    setting: bool = True  # whether it is a choice of the method; False for a property of the scene
    # smallest and largest value for which the default is meant to hold; None: all
    span: tuple[float, float] | None = None
    log: bool = True  # whether numbers are spaced by factors

    def __post_init__(self) -> None:
        if self.default not in self.values:
            raise ValueError(f"axis {self.name}: default {self.default!r} is none of its values")

    @property
    def words(self) -> bool:
        """Whether its values are words."""
        return isinstance(self.values[0], str)

    def within(self, value: Value) -> bool:
        """Whether the default settings are meant to hold at a value of this axis."""
        if isinstance(value, str) or self.span is None:
            return True
        return self.span[0] <= value <= self.span[1]

    def coarse(self) -> tuple[Value, ...]:
        """Three of its values: the default, the ends, or the middle where these are two."""
        if self.words:
            return self.values[:3]
        ends = {self.values[0], self.default, self.values[-1]}
        if len(ends) == 2:
            ends.add(self.values[len(self.values) // 2])
        return tuple(v for v in self.values if v in ends)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a point is run: ``cpu`` or ``cuda``."""

    device: str = "cpu"

    @property
    def every(self) -> int:
        """Steps between two looks: a look costs a GPU far more than a step."""
        return 8 if self.device == "cpu" else 40


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one point gave."""

    steps: int  # steps it was run for at most
    violation: Violation | None  # the first one; None when it held
    points: int  # material points


@dataclasses.dataclass(frozen=True)
class Map:
    """A plane of two settings."""

    name: str  # of the map, its lines and its picture
    title: str  # what is drawn
    x: Axis  # horizontal axis
    y: Axis  # vertical axis
    variants: tuple[str, ...]  # one panel each; the first is gsfluent as it comes
    run: Callable[[Any, Any, str, Place], Outcome]  # run(x, y, variant, place) -> outcome
    test: str  # name of the test of its boundary
    note: str = ""  # what to see
    gpu: bool = False  # whether it belongs to the subset that is run on a GPU
    # words of the horizontal axis of variants for which it is another quantity
    x_labels: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Point:
    """One point of one map, run: a line of ``stability.jsonl``."""

    map: str  # name of the map
    variant: str  # panel
    x: Value  # where
    y: Value  # where
    limit: int  # steps it was run for at most
    points: int  # material points
    seconds: float  # wall time
    device: str  # cpu or cuda
    machine: str  # processor and cores, or the GPU
    commit: str  # of gsfluent
    date: str  # ISO 8601, UTC
    step: int | None = None  # steps to the first violation; None when it held
    kind: str = ""  # of the violation, or empty
    value: float | None = None  # what was found, None where that is not a number
    note: str = ""  # why a solver stopped

    @property
    def holds(self) -> bool:
        """Whether nothing was broken."""
        return self.step is None

    def line(self) -> str:
        """One line of strict JSON without what is empty."""
        plain = {k: v for k, v in dataclasses.asdict(self).items() if v not in (None, "")}
        return json.dumps(plain, allow_nan=False, separators=(",", ":")) + "\n"

    @property
    def key(self) -> str:
        """What makes it the same point."""
        return key_of(self.map, self.variant, self.x, self.y, self.device)


def key_of(name: str, variant: str, x: Value, y: Value, device: str) -> str:
    """What makes a point of a map the same point, before it is run and after."""
    return f"{name}|{variant}|{_text(x)}|{_text(y)}|{device}"


def _text(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.8g}"


_NAMES = tuple(f.name for f in dataclasses.fields(Point))
_MUST = _NAMES[: _NAMES.index("device") + 1]


def read(path: str | Path) -> list[Point]:
    """The points of a file; of equal ones the last counts, a cut-off line is skipped.

    Raises:
        InputError: The file cannot be read or holds something else.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})", "give a .jsonl of points") from error
    found: dict[str, Point] = {}
    for number, line in enumerate(lines, 1):
        try:
            data = json.loads(line)
        except ValueError:
            if not line.strip() or not line.endswith("}"):
                continue  # cut off when the run was stopped
            data = None
        if not isinstance(data, dict) or any(name not in data for name in _MUST):
            raise InputError(
                f"{path}, line {number}: not a point of a stability map",
                "give the file that `gsfluent stability` wrote, or another name",
            )
        given = dict.fromkeys(("machine", "commit", "date"), "")
        point = Point(**(given | {name: data[name] for name in _NAMES if name in data}))
        found[point.key] = point
    return list(found.values())
