"""A reconstruction on a GPU that repeats bit by bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from gsfluent import demo, has_cuda
from gsfluent.data import Capture, Gaussians
from gsfluent.io import load_capture
from gsfluent.pipeline.reconstruct.stage import Reconstruct

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
FIELDS = ("means", "quats", "scales", "opacities", "sh")
CASES: dict[str, dict[str, Any]] = {
    "adc": {"sh_degree": 1},
    "absolute": {"recipe": "long", "sh_degree": 1, "exposure": True},
    "mcmc": {"densify": "mcmc", "max_gaussians": 900},
    "target": {"target_psnr": 24.0},
}
"""Each takes other sums: of screen-space gradients, absolute ones, draws, errors under splats."""


def assert_same(one: Gaussians, other: Gaussians) -> None:
    assert one.count == other.count
    for name in FIELDS:
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    assert one.report["history"] == other.report["history"]
    assert one.report["psnr_views"] == other.report["psnr_views"]
    assert one.report["cleaned"] == other.report["cleaned"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("melon")
    demo.make_capture("watermelon", folder, views=16, size=64)
    return load_capture(folder)


@pytest.mark.parametrize("case", list(CASES))
def test_two_runs_are_one(capture: Capture, case: str) -> None:
    settings: dict[str, Any] = {
        "iterations": 220, "image_size": 64, "start_gaussians": 600, "seed": 3,
    }  # fmt: skip
    settings |= CASES[case]
    runs = [Reconstruct(**settings, deterministic=True, device="cuda")(capture) for _ in range(2)]
    assert_same(*runs)
    assert runs[0].report["deterministic"] is True
    fast = Reconstruct(**settings, device="cuda")(capture)
    assert fast.report["deterministic"] is False
    assert fast.report["psnr"] == pytest.approx(runs[0].report["psnr"], abs=1.0)


def test_a_resumed_run_is_the_whole_run(capture: Capture, tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "iterations": 200, "image_size": 64, "start_gaussians": 600, "deterministic": True,
        "device": "cuda",
    }  # fmt: skip
    whole = Reconstruct(**settings)(capture)
    stage = Reconstruct(**settings, checkpoint=tmp_path / "state.pt", checkpoint_every=60)

    def interrupt(done: int, total: int, note: str) -> None:
        if done >= 150:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage(capture, progress=interrupt)
    resumed = stage(capture)
    assert resumed.report["resumed_at"] == 120
    assert_same(whole, resumed)
