"""Extremes of physics: each ends refused with a hint, failed with a cause, or in what can be."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from fault_shot import FRAMES, write_shot

from gsfluent.config import load_shot
from gsfluent.errors import InputError, RunError
from gsfluent.results.frames import count_frames, load_frame
from gsfluent.run.shot import run_shot

REFUSED, FAILED, SOUND = "refused", "failed", "sound"
MOST_HOURS = 0.001  # of a simulation of these tests: what takes longer is refused by the plan
VIEW = {"fps": 20, "seconds": FRAMES / 20, "size": [32, 32], "what": ["mp4"]}


def jelly(**parameters: float) -> dict[str, Any]:
    return {"objects": {"ball": {"material": "jelly", **parameters}}}


def thrown(*velocity: float) -> dict[str, Any]:
    return {"events": [{"type": "throw", "velocity": list(velocity)}]}


def sized(size: float) -> dict[str, Any]:
    return {"scale": None, "size": size}


def filmed(**output: float) -> dict[str, Any]:
    return {"output": VIEW | output}


def boxes(**places: list[list[float]]) -> dict[str, Any]:
    """Objects that take the splats in boxes, the first ones first."""
    return {
        "objects": {
            name: {"material": "jelly", "select": {"box": box}} for name, box in places.items()
        }
    }


# what a case may end in: a plan that measures the machine may refuse what another would do
CASES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "density 1e-9": (jelly(density=1e-9), {REFUSED}),
    "density 1e9": (jelly(density=1e9), {SOUND, FAILED}),
    "modulus 1e-3": (jelly(young_modulus=1e-3), {SOUND, FAILED}),
    "modulus 1e18": (jelly(young_modulus=1e18), {REFUSED}),
    "ratio -1": (jelly(poisson_ratio=-1.0), {REFUSED}),
    "ratio -0.99": (jelly(poisson_ratio=-0.99), {SOUND, FAILED, REFUSED}),
    "ratio 0.495": (jelly(poisson_ratio=0.495), {SOUND, REFUSED}),
    "ratio 0.5": (jelly(poisson_ratio=0.5), {REFUSED}),
    "gravity 0": ({"gravity": [0, 0, 0]}, {SOUND}),
    "gravity up": ({"gravity": [0, 0, 9.81]}, {SOUND}),
    "gravity 1e3": ({"gravity": [0, 0, -1e3]}, {FAILED}),
    "gravity 1e6": ({"gravity": [0, 0, -1e6]}, {FAILED}),
    "gravity 1e30": ({"gravity": [0, 0, -1e30]}, {FAILED, REFUSED}),
    "size 1e-9": (sized(1e-9), {REFUSED}),
    "size 1e9": (sized(1e9), {SOUND, FAILED}),
    "speed 100 down": (thrown(0, 0, -100), {FAILED}),
    "speed 1e4": (thrown(1e4, 0, 0), {SOUND, FAILED, REFUSED}),
    "speed 1e9 down": (thrown(0, 0, -1e9), {FAILED, REFUSED}),
    "speed 1e300": (thrown(1e300, 0, 0), {REFUSED}),
    "fps 0": (filmed(fps=0), {REFUSED}),
    "fps 1": (filmed(fps=1, seconds=1.0), {SOUND, REFUSED}),
    "fps 1e4": (filmed(fps=1e4, seconds=3e-4), {SOUND}),
    "fps 1e6": (filmed(fps=1e6), {REFUSED}),
    "7 000 events": (
        {"events": [{"type": "throw", "velocity": [0, 0, 0.1], "spin": [0, 0, 1],
                     "at": 1e-5 * n} for n in range(7_000)]},
        {REFUSED},
    ),
    "200 events": (
        {"events": [{"type": "throw", "velocity": [0, 0, 1e-3], "at": 1e-4 * n}
                    for n in range(200)]},
        {SOUND, REFUSED},
    ),
    "objects that overlap": (
        boxes(a=[[-2, -2, -2], [0.2, 2, 2]], b=[[-0.2, -2, -2], [2, 2, 2]]), {SOUND, REFUSED}
    ),
    "an object in another": (
        boxes(a=[[-0.5, -1, -1], [0.5, 1, 1]], b=[[-2, -2, -2], [2, 2, 2]]), {SOUND, REFUSED}
    ),
    "an object twice": (boxes(a=[[-2, -2, -2], [2, 2, 2]], b=[[-2, -2, -2], [2, 2, 2]]), {REFUSED}),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _coarse_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans fill what they look at with as few voxels as these runs."""
    monkeypatch.setattr("gsfluent.plan.proxy._VOXELS", 16)


@pytest.mark.parametrize("name", CASES)
def test_an_extreme_ends_refused_failed_or_sound(name: str, finished: Path, tmp_path: Path) -> None:
    changes, ends = CASES[name]
    out = tmp_path / "out"
    if not {"objects", "scale"} & set(changes):  # these make other solids
        shutil.copytree(finished, out)
        shutil.rmtree(out / "stages" / "simulate")
    try:
        path = write_shot(tmp_path / "shot", solve={"cells": 8, "max_hours": MOST_HOURS}, **changes)
        values = run_shot(load_shot(path), out)
    except InputError as error:
        assert error.hint and len(str(error)) < 600
        end = REFUSED
    except RunError as error:
        assert "likely cause" in error.what and "hint:" in error.what and error.hint
        assert '"failed"' in (out / "run.json").read_text()
        end = FAILED
    else:
        assert values["verdict"] in ("clean", "healed")
        check(out)
        end = SOUND
    assert end in ends
    assert not list(tmp_path.rglob("*.partial*"))


def check(out: Path) -> None:
    """By the frames themselves: all points there and finite, not below the floor, not crushed."""
    folder = out / "stages" / "simulate"
    first = load_frame(folder, 0)
    tall = extent(first.positions)
    for index in range(count_frames(folder)):
        frame = load_frame(folder, index)  # refuses NaN and infinity
        assert len(frame.positions) == len(first.positions)
        assert float(frame.positions[:, 2].min()) > -0.2 * float(tall.max())
        assert bool((extent(frame.positions) > 0.2 * tall).all())


def extent(points: torch.Tensor) -> torch.Tensor:
    low, high = points.quantile(0.05, dim=0), points.quantile(0.95, dim=0)
    return high - low
