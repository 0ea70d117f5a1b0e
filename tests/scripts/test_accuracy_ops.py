"""scripts/accuracy/ops.py: runs at a tiny size, keeps the rest of its page, fails when it must."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from loaded_scripts import load_script


@pytest.fixture
def accuracy() -> ModuleType:
    return load_script("accuracy/ops")


def test_every_op_is_within_its_bar_and_the_page_keeps_both_parts(
    accuracy: ModuleType, tmp_path: Path
) -> None:
    page, figures = tmp_path / "accuracy.md", tmp_path / "a.json"
    page.write_text("# Title\n\n<!-- cuda: begin -->\nfrom the GPU\n<!-- cuda: end -->\n")
    arguments = ["--quick", "--json", str(figures), "--markdown", str(page)]
    assert accuracy.main(arguments) == 0
    result = json.loads(figures.read_text())
    ops = {row["op"].split(",")[0] for row in result["rows"]}
    expected = (
        "build_blocks p2g grid_update g2p return_mapping polar_clamped mvee mvee_lens rasterize "
        "ssim photometric_loss adam_step"
    )
    assert ops == set(expected.split())
    wrt = {row["result"] for row in result["rows"] if row["op"].startswith("rasterize")}
    assert {"image", "alpha", "depth", "normal", "d/d means", "d/d quats", "d/d sh"} <= wrt
    text = page.read_text()
    assert "from the GPU" in text and text.count("<!-- cpu: begin -->") == 1
    # Entering a GPU's figures replaces that part only.
    figures.write_text(json.dumps({**result, "device": "cuda", "name": "some GPU"}))
    assert accuracy.main(["--table", str(figures), "--markdown", str(page)]) == 0
    after = page.read_text()
    assert "from the GPU" not in after and "cuda: some GPU" in after
    assert after.startswith("# Title") and after.count("<!-- cpu: begin -->") == 1


def judged(accuracy: ModuleType, call: Any, x: torch.Tensor, jumps: str) -> dict[str, Any]:
    case = accuracy.Case("op", {"x": x}, call, reference=object(), jumps=jumps)
    (row,) = accuracy.rows_of(case, "cpu", torch.float32)
    return row


def test_wrong_values_fail_and_only_decisions_within_rounding_are_excused(
    accuracy: ModuleType,
) -> None:
    x = torch.linspace(0.1, 0.9, 4000)

    def off(op: Any, p: dict[str, Any]) -> dict[str, torch.Tensor]:
        return {"y": p["x"] * (1.001 if op is accuracy.ops else 1.0)}

    row = judged(accuracy, off, x, "some decision")
    assert not row["passed"] and row["excused"] == 0 and row["beyond"] > 0

    def cut(op: Any, p: dict[str, Any]) -> dict[str, torch.Tensor]:
        # Decided the other way at 0.5 itself, as rounding would.
        above = p["x"] > 0.5 if op is accuracy.ops else p["x"] >= 0.5
        return {"y": above.to(p["x"].dtype)}

    x[7] = 0.5
    row = judged(accuracy, cut, x, "a cut")
    assert row["passed"] and (row["beyond"], row["excused"]) == (1, 1)
    assert row["largest"] == 1.0 and row["largest_decided"] == 0.0
    assert not judged(accuracy, cut, x, "")["passed"]  # nothing decides: nothing is excused
    x[:10] = 0.5
    assert not judged(accuracy, cut, x, "a cut")["passed"]  # too many to be rounding
    assert "nan" not in accuracy.table({"device": "cpu", "name": "", "torch": "", "rows": [row]})


def test_a_missed_bar_is_an_exit_code(accuracy: ModuleType, tmp_path: Path) -> None:
    x = torch.ones(3)
    row = judged(accuracy, lambda op, p: {"y": p["x"] * float("nan")}, x, "")
    figures = tmp_path / "a.json"
    figures.write_text(
        json.dumps({"device": "cpu", "name": "", "torch": "", "rows": [{**row, "largest": 1.0}]})
    )
    assert not row["passed"]
    assert accuracy.main(["--table", str(figures)]) == 1
