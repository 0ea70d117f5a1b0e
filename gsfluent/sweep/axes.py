"""What differs between the shots of a sweep: keys, the values they take, and how they are drawn."""

from __future__ import annotations

import copy
import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsfluent.config.read import Place, mapping, nearest, number, plain, refuse_unknown, several_of
from gsfluent.errors import InputError, check_choice, short

SAMPLES = ("grid", "random", "sobol", "latin")
"""How values are drawn: all combinations, or points of the unit cube."""
SEED = "seed"
"""The key that is not of the shot: the seed of what moves."""
MOST = 10**7

_KINDS = ("grid", "range", "uniform", "log_uniform", "cases")


@dataclasses.dataclass(frozen=True)
class Axis:
    """One thing that differs."""

    name: str  # A key of the shot by its path, or any name for ``cases``
    values: tuple[Any, ...] = ()  # What it takes; empty for a range of numbers
    low: float = 0.0  # Of a range of numbers
    high: float = 0.0
    log: bool = False  # Whether the logarithm is even
    cases: bool = False  # Whether values are keys that change together

    def at(self, place: float) -> Any:
        """The value at a place in 0..1."""
        if self.values:
            return self.values[min(int(place * len(self.values)), len(self.values) - 1)]
        if self.log:
            return math.exp(math.log(self.low) + place * math.log(self.high / self.low))
        return self.low + place * (self.high - self.low)

    def changes(self, value: Any) -> dict[str, Any]:
        """Keys of the shot, and what a value sets them to."""
        return dict(value) if self.cases else {self.name: value}


def read_axes(value: Any, place: Place) -> tuple[Axis, ...]:
    """Read ``vary:``.

    Raises:
        InputError: An unknown kind, or values out of range.
    """
    named = mapping(value, place).items()
    axes = tuple(_axis(name, item, place.inside(name)) for name, item in named)
    if not axes:
        raise place.error("name what differs", value, "for example seed: {range: [0, 10]}")
    return axes


def _axis(name: str, value: Any, place: Place) -> Axis:
    if isinstance(value, list):
        value = {"grid": value}
    given = mapping(value, place)
    refuse_unknown(given, _KINDS, place)
    if len(given) != 1:
        raise place.error(f"be one of {', '.join(_KINDS)}", value, f"{name}: {{grid: [1, 2]}}")
    ((kind, item),) = given.items()
    inside = place.inside(kind)
    if kind == "grid":
        return Axis(name, several_of(lambda v, _: v, 1, MOST)(item, inside))
    if kind == "range":
        ends = several_of(number(-(2.0**53), 2.0**53), 2, 3)(item, inside)
        if any(end != int(end) for end in ends) or (len(ends) == 3 and ends[2] == 0):
            raise inside.error("be [first, end] or [first, end, step] in whole numbers", item)
        found = range(*(int(end) for end in ends))
        if not 0 < len(found) <= MOST:
            raise inside.error("hold a number", item)
        return Axis(name, tuple(found))
    if kind == "cases":
        cases = several_of(mapping, 1, MOST)(item, inside)
        for case in cases:
            if set(case) != set(cases[0]) or not case:
                raise inside.error("change the same keys in every case", sorted(case))
        return Axis(name, cases, cases=True)
    low, high = several_of(number(), 2, 2)(item, inside)
    if not low < high or (kind == "log_uniform" and low <= 0.0):
        raise inside.error("be two numbers, the smaller one first", item)
    return Axis(name, (), low, high, kind == "log_uniform")


def draw(
    axes: Sequence[Axis], sample: str, count: int | None, seed: int
) -> list[tuple[dict[str, Any], int | None]]:
    """What each shot changes.

    A draw hangs on seed and index alone, so that a larger count keeps what it had; ``latin``
    does not.

    Args:
        axes: What differs.
        sample: Of :data:`SAMPLES`.
        count: How many; of a grid all when None.
        seed: Of the draws.

    Returns:
        For each shot its keys with their values, and its seed, None for the usual one.

    Raises:
        InputError: A grid of a range of numbers, no count where one is needed, or too many.
    """
    check_choice("sample", sample, SAMPLES)
    if count is not None and not 1 <= count <= MOST:
        raise InputError(f"count: {count}", f"give 1 to {MOST}")
    rows = _grid(axes, count) if sample == "grid" else _points(axes, sample, count, seed)
    found = []
    for row in rows:
        changes: dict[str, Any] = {}
        for axis, value in zip(axes, row, strict=True):
            for key, item in axis.changes(value).items():
                if key in changes:
                    raise InputError(f"vary: {key} is changed twice", "leave one of them out")
                changes[key] = item
        own = changes.pop(SEED, None)
        if own is not None and (isinstance(own, bool) or not isinstance(own, int) or own < 0):
            raise InputError(f"vary.seed: {short(own)} is no seed", "give whole numbers from 0")
        found.append((changes, own))
    return found


def _grid(axes: Sequence[Axis], count: int | None) -> list[list[Any]]:
    for axis in axes:
        if not axis.values:
            raise InputError(
                f"vary.{axis.name}: a grid has no range of numbers", "sample: sobol, or list them"
            )
    total = math.prod(len(axis.values) for axis in axes)
    if (count or total) > MOST:
        raise InputError(f"sweep: {total} shots", f"at most {MOST}; give a count, or draw them")
    rows = []
    for index in range(min(count or total, total)):
        row = []
        for axis in reversed(axes):  # the last key changes fastest
            index, place = divmod(index, len(axis.values))
            row.append(axis.values[place])
        rows.append(row[::-1])
    return rows


def _points(axes: Sequence[Axis], sample: str, count: int | None, seed: int) -> list[list[Any]]:
    if count is None:
        raise InputError(f"sample: {sample} needs a count", "add count: 100")
    size = len(axes)
    if sample == "random":
        places = np.stack([np.random.default_rng([seed, i]).random(size) for i in range(count)])
    else:
        from scipy.stats import qmc

        design = qmc.LatinHypercube if sample == "latin" else qmc.Sobol
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a count that is no power of two
            places = design(size, seed=seed).random(count)
    return [[axis.at(float(u)) for axis, u in zip(axes, row, strict=True)] for row in places]


def changed(shot: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A shot with other values under some keys.

    Args:
        shot: As in a shot file.
        changes: Values by path: ``solve.cells``, ``events.0.height``, ``events.drop.height``.

    Raises:
        InputError: A path that leads nowhere; what it sets is judged by whoever reads the shot.
    """
    values: dict[str, Any] = copy.deepcopy(dict(shot))
    for path, value in changes.items():
        *sections, last = path.split(".")
        at: Any = values
        for number_, part in enumerate(sections):
            at = _inside(at, part, ".".join(sections[: number_ + 1]))
        if isinstance(at, list):
            at[_place(at, last, path)] = plain(value)
        elif isinstance(at, dict):
            at[last] = plain(value)
        else:
            raise _nowhere(path, at)
    return values


def _inside(at: Any, part: str, path: str) -> Any:
    if isinstance(at, list):
        return at[_place(at, part, path)]
    if not isinstance(at, dict):
        raise _nowhere(path, at)
    if at.get(part) is None:
        at[part] = {}
    return at[part]


def _place(items: list[Any], word: str, path: str) -> int:
    """Which entry of a list a part of a path means: by number, or by its name or type."""
    if word.isdigit() and int(word) < len(items):
        return int(word)
    named = [
        [item.get("name"), item.get("type")] if isinstance(item, dict) else [] for item in items
    ]
    found = [index for index, names in enumerate(named) if word in names]
    if len(found) != 1:
        known = [str(name) for names in named for name in names if name is not None]
        many = f"{len(found)} entries are called" if found else "there is no entry"
        raise InputError(
            f"vary.{path}: {many} {word!r}", f"number them from 0, or {nearest(word, known)}"
        )
    return found[0]


def _nowhere(path: str, at: Any) -> InputError:
    return InputError(
        f"vary.{path}: leads through {short(at)}, which has no keys", "check the path"
    )
