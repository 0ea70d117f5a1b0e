"""``solve.error`` in a run and ``chart SHOT.yaml --error`` on the small ball of these tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from ball_shot import write_shot

from gsfluent.cli import main
from gsfluent.config import load_shot
from gsfluent.plan.plan import plan_shot

SOFT = {
    "objects": {"ball": {"material": "rubber", "young_modulus": 2e4}},
    "events": [{"type": "throw", "velocity": [0, 0, -2.0]}],
    "output": {"fps": 20, "seconds": 0.25, "size": [64, 48], "what": ["mp4"]},
}


@pytest.fixture(scope="module")
def done(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run whose shot asks for an error."""
    folder = tmp_path_factory.mktemp("chosen")
    shot = write_shot(folder / "shot.yaml", ball, solve={"error": "40%"}, **SOFT)
    assert main(["run", str(shot), "-o", str(folder / "out"), "--device", "cpu"]) == 0
    return folder


def record(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "out" / "run.json").read_text())
    return found


def test_a_run_takes_the_cells_that_meet_its_error(done: Path) -> None:
    pytest.importorskip("matplotlib")
    values = record(done)
    choice = values["choice"]
    assert choice["met"] and choice["bound"] == 0.4 and choice["sure"] >= 0.9
    extent = values["simulation"]["dx"] * choice["chosen"]["cells"]
    assert extent == pytest.approx(2.0, rel=0.1)  # the ball is 2 m long
    assert values["shot"]["solve"]["error"] == 0.4  # what was asked for, not what came of it
    for name in ("chart.json", "chart.png"):
        assert (done / "out" / name).is_file()
    page = (done / "out" / "report.html").read_text()
    assert "The setting, chosen by error" in page and choice["reason"].split(";")[0] in page


def test_a_second_run_does_not_choose_again(done: Path) -> None:
    assert main(["run", str(done / "shot.yaml"), "-o", str(done / "out"), "--device", "cpu"]) == 0
    values = record(done)
    resumed = {stage["name"]: stage["resumed"] for stage in values["stages"]}
    assert resumed["choose"] and resumed["simulate"]
    assert values["choice"]["met"]


def test_the_verb_takes_the_solids_of_the_run(
    done: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["chart", str(done / "shot.yaml"), "--error", "60%", "-o", str(done / "out")]
    assert main([*words, "--quick", "--json", "--device", "cpu"]) == 2  # at most 50 %
    words[3] = "45%"
    capsys.readouterr()
    assert main([*words, "--quick", "--json", "--device", "cpu"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["solid"] == f"the stages in {done / 'out'}"
    assert result["probe"]["cells"] == [8, 10, 12]
    assert json.loads((done / "out" / "chart.json").read_text())["bound"] == 0.45


def test_a_plan_says_that_the_cells_are_not_chosen_yet(done: Path) -> None:
    plan = plan_shot(load_shot(done / "shot.yaml"), device=torch.device("cpu"), model=None)
    assert any("solve.error chooses the cells" in warning for warning in plan["warnings"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--error", "3%"], "a bound without a shot"),
        (["SHOT"], "a shot without a bound"),
        (["SHOT", "--error", "three"], "be a share such as 3%"),
        (["SHOT", "--error", "3%", "--of", "rendering"], "do nothing with a shot"),
        (["nowhere.yaml", "--error", "3%"], "nowhere.yaml does not exist"),
        (["--of", "rendering", "--only", "dx"], "belong to --of simulation"),
    ],
)
def test_words_that_do_not_go_together_are_refused(
    shot: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(shot) if word == "SHOT" else word for word in words]
    assert main(["chart", *given]) == 2
    assert message in capsys.readouterr().err
