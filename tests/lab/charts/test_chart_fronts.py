"""Fronts against brute force, and one method's front against another's."""

from __future__ import annotations

import dataclasses
import math
import random

import pytest

from gsfluent.lab.charts.front import cheapest, compare, counted, front, verdict
from gsfluent.lab.charts.record import Record


def record(
    time: float, error: float, method: str = "gsfluent", case: str = "bar", failed: str = ""
) -> Record:
    return Record(
        case, "elastic", method, f"{time} {error}", {"dx": 0.1}, "cpu", "m", 10, 20, 1.0, [time],
        time, 1.0, error, failed=failed,
    )  # fmt: skip


def test_no_run_of_a_front_is_beaten_and_every_other_one_is() -> None:
    draw = random.Random(4)
    runs = [record(draw.choice([1, 2, 3, 4, 5]), 10 ** draw.uniform(-8, 0)) for _ in range(200)]
    kept = front(runs)

    def beaten(r: Record) -> bool:
        return any(
            o.wall_per_simulated <= r.wall_per_simulated
            and counted(o) <= counted(r)
            and (o.wall_per_simulated < r.wall_per_simulated or counted(o) < counted(r))
            for o in runs
        )

    assert kept and not any(beaten(r) for r in kept)
    rest = [r for r in runs if r not in kept]
    twins = {(r.wall_per_simulated, counted(r)) for r in kept}
    assert all(beaten(r) or (r.wall_per_simulated, counted(r)) in twins for r in rest)
    assert [r.wall_per_simulated for r in kept] == sorted({r.wall_per_simulated for r in kept})


def test_broken_runs_and_no_answers_are_on_no_front() -> None:
    runs = [
        record(1.0, math.inf, failed="it broke"), record(1.0, 1.0), record(2.0, 0.5),
        record(0.1, 0.2, failed="late"),
    ]  # fmt: skip
    assert front(runs) == [runs[2]]
    assert front(runs[:2]) == []


def test_below_rounding_the_cheaper_run_counts() -> None:
    runs = [record(1.0, 1e-8), record(5.0, 1e-15)]
    assert front(runs) == runs[:1]
    assert cheapest(runs, 1e-15) == runs[0]


def test_every_level_of_the_peer_is_set_against_our_cheapest_run() -> None:
    ours = [record(1.0, 0.3), record(4.0, 0.05), record(9.0, 0.02)]
    peer = [record(100.0, 0.1, "peer"), record(10.0, 0.4, "peer"), record(800.0, 0.01, "peer"),
            record(900.0, 0.3, "peer")]  # fmt: skip
    rows = compare([*ours, *peer], "gsfluent", "peer")["bar"]
    assert [(r.peer.error, r.ratio) for r in rows] == [
        (0.4, pytest.approx(10.0)),
        (0.1, pytest.approx(25.0)),
        (0.01, None),  # we reach no such error
    ]
    said = verdict([*ours, *peer])
    assert not said.below_left and "not reached" in said.text()
    better = [*ours, record(700.0, 0.01)]
    said = verdict([*better, *peer])
    assert said.below_left and "1.14 to 25" in said.text()


def test_a_dearer_run_of_ours_is_not_below_left() -> None:
    said = verdict([record(10.0, 0.1), record(5.0, 0.1, "peer")])
    assert not said.below_left and said.rows[0].ratio == pytest.approx(0.5)
    assert "not at: bar, peer at 0.1: 0.5 times" in said.text()


def test_a_peer_without_levels_is_named_and_nothing_is_claimed() -> None:
    said = verdict([record(1.0, 0.1), record(1.0, 1.5, "peer")])
    assert said.rows == () and not said.below_left
    assert said.absent == (("bar", "peer", "smallest error 1.5"),)
    said = verdict([record(1.0, 0.1), record(1.0, math.inf, "peer", failed="exploded")])
    assert "exploded" in said.absent[0][2]
    only_theirs = dataclasses.replace(record(1.0, 0.1, "peer"), case="beam")
    assert compare([record(1.0, 0.1), only_theirs], "gsfluent", "peer") == {}
