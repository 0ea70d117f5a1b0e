"""A shot that would take weeks is refused before it begins, unless it is allowed to."""

from __future__ import annotations

from pathlib import Path

import pytest
from fault_shot import write_shot

from gsfluent.config import load_shot
from gsfluent.errors import InputError
from gsfluent.plan.plan import plan_shot
from gsfluent.run.shot import run_shot

TINY = {"scale": None, "size": 1e-9, "events": [{"type": "throw", "velocity": [0, 0, 1]}]}


def tiny(folder: Path, **solve: float) -> Path:
    output = {"fps": 20, "seconds": 2.0, "size": [32, 32], "what": ["mp4"]}
    return write_shot(folder, **TINY, solve={"cells": 8, **solve}, output=output)


def test_a_shot_of_a_nanometre_is_refused_with_what_makes_it_long(tmp_path: Path) -> None:
    shot = load_shot(tiny(tmp_path))
    plan = plan_shot(shot)
    assert plan["substeps"] > 1e9 and "hours, more than solve.max_hours: 24" in plan["refused"]
    assert any(plan["refused"] in warning for warning in plan["warnings"])
    with pytest.raises(InputError, match="e-09 m long") as caught:
        run_shot(shot, tmp_path / "out")
    assert "size" in caught.value.hint and "solve.max_hours: " in caught.value.hint
    assert not (tmp_path / "out" / "stages").exists()


def test_it_is_planned_without_a_word_when_it_may_take_that_long(tmp_path: Path) -> None:
    plan = plan_shot(load_shot(tiny(tmp_path, max_hours=1e9)))
    assert plan["refused"] == plan["hint"] == ""
    assert not any("refuses" in warning for warning in plan["warnings"])
