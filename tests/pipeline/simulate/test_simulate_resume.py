"""A run that was interrupted goes on as if it had not been, whatever is off the grid just then."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_scenes import near_miss, resting

from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

FIELDS = ("position", "velocity", "affine", "strain", "alpha", "deformation")


def pressed() -> Scene:
    """A ball under a plate that has not finished its stroke."""
    scene = resting(False)
    scene.press(speed=0.1, stroke=0.03, at=0.05)
    return scene


@pytest.mark.parametrize(
    ("make", "fps", "seconds", "stop", "off_grid"),
    [
        (lambda: resting(True), 10, 2.0, 17, "asleep"),
        (near_miss, 40, 0.3, 8, "flying"),
        (near_miss, 40, 0.1, 0, "first flight"),
        (pressed, 20, 0.5, 4, "nothing"),
    ],
)
def test_resumed_frames_are_the_same_bits(
    make: Callable[[], Scene], fps: float, seconds: float, stop: int, off_grid: str, tmp_path: Path
) -> None:
    saved = tmp_path / "state.pt"
    wanted: list[Any] = []
    whole = Simulate(dx=0.02)(make(), fps=fps, seconds=seconds)
    for frame in whole:
        wanted.append(frame)
        if frame.index == stop:
            whole.save(saved)
            state = whole.run.state
            groups = bool((state.group >= 0).any())
            assert groups == (off_grid in ("asleep", "flying"))
            assert bool(state.asleep.any()) == (off_grid == "asleep")
            assert all(state.landed) == (off_grid not in ("first flight", "asleep"))
    again = Simulate(dx=0.02)(make(), fps=fps, seconds=seconds, resume=saved)
    frames = list(again)
    assert [f.index for f in frames] == list(range(stop + 1, len(wanted)))
    for got, want in zip(frames, wanted[stop + 1 :], strict=True):
        for name in FIELDS:
            assert torch.equal(getattr(got.particles, name), getattr(want.particles, name)), name
        assert torch.equal(got.fragments, want.fragments)
        assert torch.equal(got.colliders, want.colliders)
    one, two = whole.report, again.report
    one.pop("seconds"), two.pop("seconds")
    one.pop("particle_steps_per_second"), two.pop("particle_steps_per_second")
    assert one == two
    if off_grid == "asleep":
        assert one["wakes"] == 1
