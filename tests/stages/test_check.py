"""What a shot cannot have is refused before anything is computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from gsfluent.config import Shot
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io import save_splats
from gsfluent.run.shot import run_shot
from gsfluent.stages.check import check_shot
from gsfluent.stages.simulate import moving_settings, solver_options

BLADE = {"type": "blade", "path": [[0, 0, 1], [0, 0, 0]], "width": 0.3}


@pytest.fixture
def splats(tmp_path: Path) -> Path:
    means = torch.rand(20, 3)
    save_splats(
        Gaussians.from_colors(means, torch.full((20,), 0.1), torch.rand(20, 3)), tmp_path / "a.ply"
    )
    return tmp_path / "a.ply"


def shot(splats: Path, **changes: Any) -> Shot:
    return Shot.from_dict({"splats": str(splats), "events": [BLADE]} | changes, splats.parent)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"events": [BLADE | {"path": [[0, 0, 1], [0, 0, 1]]}]}, "first leg"),
        ({"events": [BLADE | {"edge": [0, 0, 1]}]}, "edge must not lie along the path"),
        ({"events": [BLADE | {"path": [[0, 0, 1], [0, 0, 0], [0, 0, 0]]}]}, "leg"),
        ({"events": [BLADE] * 40}, "40 blades are more than"),
        ({"events": [{"type": "bullet", "from": [0, 0, 1], "toward": [0, 0, 1], "speed": 1}]},
         "'toward' must differ"),
        ({"colliders": [{"type": "mesh", "mesh": "open.obj"}]}, "not closed"),
        ({"light": {"environment": {"image": "open.obj"}}}, "open.obj"),
        ({"output": {"camera": 3}}, "needs a `capture:`"),
    ],
)  # fmt: skip
def test_it_is_refused_before_any_work(
    splats: Path, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    (tmp_path / "open.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    wanted = shot(splats, **changes)
    with pytest.raises(InputError, match=said) as caught:
        run_shot(wanted, tmp_path / "out", plan=False)
    assert caught.value.hint
    assert not (tmp_path / "out" / "stages").exists()
    assert "failed" in (tmp_path / "out" / "run.json").read_text()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"objects": {"a": {"select": {"box": [[0, 0, 0], [1, 1, 1]]}}, "b": {}},
         "events": [{"type": "collide", "objects": ["a", "b"], "speed": 2}]},
        {"events": [{"type": "press", "speed": 0.5, "stroke": 0.1}, {"type": "drop", "height": 1}]},
        {"floor": "none", "output": {"camera": "dolly"}},
    ],
)  # fmt: skip
def test_what_can_be_passes(splats: Path, changes: dict[str, Any]) -> None:
    check_shot(shot(splats, **changes))


def test_all_devices_leave_the_motion_as_it_is(splats: Path) -> None:
    every = shot(splats, solve={"devices": "all"})
    assert solver_options(every).all_devices and not solver_options(shot(splats)).all_devices
    assert moving_settings(every) == moving_settings(shot(splats))
    with pytest.raises(InputError, match=r"solve.devices.*one.*all"):
        shot(splats, solve={"devices": "two"})


def test_points_are_pushed_where_they_can_be(splats: Path) -> None:
    pushed, held = (shot(splats, solve={"contact": name}) for name in ("points", "nodes"))
    assert solver_options(pushed).contact == "points" and solver_options(held).contact == "nodes"
    assert moving_settings(pushed) != moving_settings(shot(splats)) != moving_settings(held)
    for one in (pushed, held):
        check_shot(one)
    with pytest.raises(InputError, match="cfl must be at most"):
        check_shot(shot(splats, solve={"contact": "points", "cfl": 0.8}))
