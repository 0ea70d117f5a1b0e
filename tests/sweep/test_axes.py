"""What differs between shots: the values, how they are drawn, and where they go."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import pytest

from gsfluent.config.read import Place
from gsfluent.errors import InputError
from gsfluent.sweep.axes import Axis, changed, draw, read_axes

PLACE = Place("vary", Path())


def axes(**values: Any) -> tuple[Axis, ...]:
    return read_axes(values, PLACE)


def test_a_grid_is_every_combination_the_last_key_fastest() -> None:
    found = draw(axes(a=[1, 2], b={"grid": ["x", "y"]}, seed={"range": [3, 5]}), "grid", None, 0)
    wanted = itertools.product([1, 2], "xy", [3, 4])
    assert found == [({"a": a, "b": b}, seed) for a, b, seed in wanted]
    assert draw(axes(a=[1, 2], b=[3, 4]), "grid", 3, 0) == [
        ({"a": 1, "b": 3}, None), ({"a": 1, "b": 4}, None), ({"a": 2, "b": 3}, None)
    ]  # fmt: skip


def test_cases_change_together() -> None:
    cases = [
        {"splats": "a.ply", "texture.preset": "apple"},
        {"splats": "b.ply", "texture.preset": "x"},
    ]
    found = draw(axes(fruit={"cases": cases}), "grid", None, 0)
    assert [changes for changes, _ in found] == cases


@pytest.mark.parametrize("sample", ["random", "sobol"])
def test_a_larger_count_keeps_earlier_draws(sample: str) -> None:
    vary = axes(a={"uniform": [1, 3]}, b={"log_uniform": [1e5, 1e7]}, c=[1, 2, 3])
    few, many = (draw(vary, sample, count, 7) for count in (5, 40))
    assert many[:5] == few and draw(vary, sample, 5, 8) != few
    assert all(1 <= changes["a"] <= 3 and 1e5 <= changes["b"] <= 1e7 for changes, _ in many)
    assert {changes["c"] for changes, _ in many} == {1, 2, 3}
    # of a logarithm half lies below its middle
    low = sum(changes["b"] < 1e6 for changes, _ in many)
    assert 10 <= low <= 30


def test_latin_puts_one_draw_into_each_part() -> None:
    found = draw(axes(a={"uniform": [0, 10]}), "latin", 10, 0)
    assert sorted(math.floor(changes["a"]) for changes, _ in found) == list(range(10))


@pytest.mark.parametrize(
    ("vary", "sample", "count", "words"),
    [
        ({"a": {"uniform": [0, 1]}}, "grid", None, "no range of numbers"),
        ({"a": [1]}, "sobol", None, "needs a count"),
        ({"a": [1], "x": {"cases": [{"a": 2}]}}, "grid", None, "changed twice"),
        ({"seed": [-1]}, "grid", None, "no seed"),
        ({"a": list(range(4000)), "b": list(range(4000))}, "grid", None, "16000000 shots"),
    ],
)
def test_draws_that_cannot_be(vary: Any, sample: str, count: int | None, words: str) -> None:
    with pytest.raises(InputError, match=words):
        draw(axes(**vary), sample, count, 0)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({}, "name what differs"),
        ({"a": 3}, "section of keys"),
        ({"a": {"gird": [1]}}, "did you mean 'grid'"),
        ({"a": {"grid": [1], "range": [0, 2]}}, "be one of"),
        ({"a": {"grid": []}}, "list of 1 or more"),
        ({"a": {"range": [2, 2]}}, "hold a number"),
        ({"a": {"range": [0.5, 2]}}, "whole numbers"),
        ({"a": {"uniform": [2, 1]}}, "smaller one first"),
        ({"a": {"log_uniform": [0, 1]}}, "smaller one first"),
        ({"a": {"cases": [{"b": 1}, {"c": 1}]}}, "same keys"),
    ],
)
def test_axes_that_cannot_be(value: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_axes(value, PLACE)


def test_a_path_leads_through_sections_and_lists() -> None:
    shot = {"events": [{"type": "drop", "height": 1.0}, {"type": "throw"}], "solve": {"cells": 40}}
    found = changed(
        shot,
        {"events.drop.height": 2.0, "events.1.spin": [1, 2, 3], "solve.cells": 8, "light.a": 1},
    )
    assert found["events"] == [
        {"type": "drop", "height": 2.0},
        {"type": "throw", "spin": [1, 2, 3]},
    ]
    assert found["solve"] == {"cells": 8} and found["light"] == {"a": 1}
    assert shot["solve"] == {"cells": 40}
    for path, words in (
        ("events.press.height", "no entry 'press'"),
        ("events.7.height", "no entry"),
        ("solve.cells.x", "has no keys"),
    ):
        with pytest.raises(InputError, match=words):
            changed(shot, {path: 1})
    twice = {"events": [{"type": "drop"}, {"type": "drop"}]}
    with pytest.raises(InputError, match="2 entries"):
        changed(twice, {"events.drop.height": 1})
