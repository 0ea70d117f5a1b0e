"""Phase-field matter through the simulation on a GPU: as on the CPU, in pieces, and resumed."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from simulation_scenes import CLAY, dropped

from gsfluent import has_cuda
from gsfluent.pipeline.simulate.stage import Simulate

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not has_cuda(), reason="needs a GPU and gsfluent's CUDA kernels"),
]
DX = 0.03


def test_a_hard_landing_cracks_as_on_the_cpu() -> None:
    found = []
    for device in ("cpu", "cuda"):
        simulation = Simulate(dx=DX, device=device)(dropped(CLAY, 0.6), fps=100, seconds=0.41)
        last = list(simulation)[-1]
        report = simulation.report
        assert report["verdict"] == "clean" and report["momentum_error"] < 1e-5
        assert report["composed_steps"] == 0 < report["substeps"]
        found.append((last, report))
    (here, _), (there, _) = found
    assert there.particles.position.device.type == "cuda"
    assert float(there.broken.float().mean()) > 0.01
    # cracks amplify what float32 rounds: the figures agree, not the points
    surface = there.energy["surface"] / here.energy["surface"]
    assert surface == pytest.approx(1.0, abs=0.15)
    apart = (there.particles.position.cpu() - here.particles.position).norm(dim=1).median()
    assert float(apart) < 0.5 * DX


def test_a_broken_ball_is_saved_and_goes_on(tmp_path: Path) -> None:
    first = Simulate(dx=0.02, device="cuda")(dropped(CLAY, 1.2), fps=100, seconds=0.6)
    wanted, stop = [], 54
    for frame in first:
        wanted.append(frame)
        if frame.index == stop:
            first.save(tmp_path / "state.pt")
    assert max(frame.stats["fragments"] for frame in wanted[stop:]) > 1
    again = Simulate(dx=0.02, device="cuda")(
        dropped(CLAY, 1.2), fps=100, seconds=0.6, resume=tmp_path / "state.pt"
    )
    for got, want in zip(again, wanted[stop + 1 :], strict=True):
        for name in ("position", "velocity", "strain", "alpha"):
            assert torch.equal(getattr(got.particles, name), getattr(want.particles, name)), name
        assert torch.equal(got.fragments, want.fragments)
