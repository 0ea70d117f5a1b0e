"""Time: what plays, what is drawn first, how large, and the curves beside it."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from gsfluent.viewer.draw.artist import BUDGETS, Artist
from gsfluent.viewer.model.pace import Pace
from gsfluent.viewer.model.playback import Playback
from gsfluent.viewer.model.plots import plots_of
from gsfluent.viewer.panels.time import first_speed


class Clock:
    """A clock that stands until it is moved."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_playback_runs_at_its_speed_loops_and_stops() -> None:
    clock = Clock()
    play = Playback(clock)
    play.speed = 0.5
    play.play(2)
    assert play.index(10, 20.0) == 2
    clock.now += 0.25  # 0.25 s at half speed and 20 frames/s: 2.5 frames
    assert play.index(10, 20.0) == 4
    play.set_speed(2.0, 4)
    assert play.index(10, 20.0) == 4  # no jump
    clock.now += 0.2  # 8 frames on: 12 of 10
    assert play.index(10, 20.0) == 2
    play.loop = False
    assert play.index(10, 20.0) == 9 and not play.playing


@pytest.mark.parametrize(
    ("fps", "speed"), [(15.0, "1 (real time)"), (40.0, "1/2"), (1000.0, "1/64"), (1e6, "1/256")]
)
def test_slow_motion_is_played_so_that_the_eye_can_follow(fps: float, speed: str) -> None:
    assert first_speed(fps) == speed


def test_pace_learns_a_machine_and_keeps_to_the_budget() -> None:
    pace = Pace()
    rng = np.random.default_rng(0)
    for pixels in rng.uniform(3e4, 8e5, 40):
        pace.measured(int(pixels), 0.03 + 5e-7 * pixels)
    for pixels in (5e4, 1e6):
        assert pace.seconds(pixels) == pytest.approx(0.03 + 5e-7 * pixels, rel=0.1)
    scale = pace.scale(1280, 800, 0.12)
    assert 0.03 + 5e-7 * scale**2 * 1280 * 800 == pytest.approx(0.12, rel=0.1)
    assert pace.scale(1280, 800, 10.0) == 1.0
    assert pace.scale(1280, 800, 0.0) >= 0.2


def test_a_slow_machine_is_not_asked_for_pictures_too_small_to_see() -> None:
    pace = Pace()
    for pixels in (2e4, 4e5) * 30:
        pace.measured(int(pixels), 2.0 + 1e-6 * pixels)
    # 2 s pass whatever the size: a picture twice as long is better than a stamp
    assert pace.scale(1000, 800, 0.1) == 1.0


def test_wishes_never_queue_and_the_last_one_is_drawn() -> None:
    wish, drawn = [0], []
    gate = threading.Event()

    def paint(viewer: int, budget: float) -> bool:
        drawn.append((wish[0], budget))
        gate.wait(5.0)
        return budget > BUDGETS[0]

    artist = Artist(paint)
    try:
        artist.request(7)
        while not drawn:
            time.sleep(0.001)
        for number in range(1, 101):  # while the first is being drawn
            wish[0] = number
            artist.request(7)
        gate.set()
        assert artist.wait_idle(10.0)
    finally:
        gate.set()
        artist.close()
    # one small picture of the last wish, then a sharp one of the same
    assert drawn == [(0, BUDGETS[0]), (100, BUDGETS[0]), (100, BUDGETS[1])]


def test_a_failing_picture_does_not_end_the_page(caplog: pytest.LogCaptureFixture) -> None:
    calls = []

    def paint(viewer: int, budget: float) -> bool:
        calls.append(viewer)
        if len(calls) == 1:
            raise ZeroDivisionError("once")
        return True

    artist = Artist(paint)
    try:
        artist.request(1)
        assert artist.wait_idle(5.0)
        artist.request(1)
        assert artist.wait_idle(5.0)
    finally:
        artist.close()
    assert calls == [1, 1] and "a picture failed" in caplog.text


def test_every_viewer_gets_its_turn_and_leaves() -> None:
    seen = []
    artist = Artist(lambda viewer, budget: (seen.append(viewer), True)[1])
    try:
        for viewer in (1, 2, 3):
            artist.request(viewer)
        assert artist.wait_idle(5.0)
        artist.forget(2)
        seen.clear()
        artist.request()
        assert artist.wait_idle(5.0)
    finally:
        artist.close()
    assert sorted(seen) == [1, 3]


def test_curves_have_units_gaps_and_a_line_at_the_moment() -> None:
    facts = [{"time": 0.1 * i, "kinetic": 2000.0 * i, "momentum": [0, 0, -i]} for i in range(5)]
    facts[2] = {}  # a damaged frame
    plots = {plot.name: plot for plot in plots_of(facts)}
    assert set(plots) == {"Energy", "Momentum"}
    energy = plots["Energy"]
    assert energy.title == "Energy [kJ]"
    np.testing.assert_allclose(energy.values[0], [0, 2, 6, 8])
    time_, kinetic, line = energy.columns(0.35)
    np.testing.assert_allclose(time_, [0, 0.1, 0.3, 0.35, 0.35, 0.4])
    np.testing.assert_allclose(kinetic, [0, 2, 6, 7, 7, 8])
    np.testing.assert_allclose(line, [np.nan] * 3 + [0, 1, np.nan])
    assert plots_of([{}, {"time": 1.0}]) == []


def test_what_broke_is_drawn_where_the_run_has_kept_it() -> None:
    old = [{"time": float(i), "fragments": i, "damaged_fraction": 0.1 * i} for i in range(3)]
    more = {"pieces_over_1_percent": 2, "broken_fraction": 0.25, "loose_fraction": 0.01}
    new = [row | more | {"active_blocks": 2800 + row["fragments"]} for row in old]
    before, after = ({plot.name: plot for plot in plots_of(facts)} for facts in (old, new))
    assert set(before) == {"Fragments", "Broken"} and set(after) == {*before, "Blocks"}
    assert len(before["Fragments"].labels) == len(before["Broken"].labels) == 1
    assert len(after["Fragments"].labels) == 2 and len(after["Broken"].labels) == 3
    assert after["Broken"].title == "Broken [%]"
    shares = dict(zip(after["Broken"].labels, after["Broken"].values, strict=True))
    np.testing.assert_allclose(shares["share of the mass loose"], [1.0] * 3)
    np.testing.assert_allclose(after["Blocks"].values[0], [2800, 2801, 2802])
    assert after["Blocks"].title == "Blocks"
