"""The textbook solver on a GPU: the CPU's motion, and sums that are the same in every run."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gsfluent.lab.problems.fracture import brittle
from gsfluent.lab.textbook.solver import Textbook, Variant

pytestmark = pytest.mark.cuda


def ends(device: str, dtype: torch.dtype, **options: Any) -> Textbook:
    scene = brittle.drop(0.1)
    variant = Variant(**{"storage": "strain", "return_map": "dynamic_implicit", **options})
    solver = Textbook(scene, variant, device=device, dtype=dtype, dt=brittle.step(scene))
    return solver.run(steps=60)  # it reaches the floor after some 45: half of it is broken by then


@pytest.mark.parametrize("storage", ["F", "strain"])
def test_the_gpu_moves_as_the_cpu(storage: Any) -> None:
    cpu, gpu = (ends(d, torch.float64, storage=storage) for d in ("cpu", "cuda"))
    assert float((cpu.alpha >= 0.0).double().mean()) > 0.2  # it breaks
    assert float((gpu.position.cpu() - cpu.position).abs().max()) / brittle.DX < 1e-9
    assert float((gpu.alpha.cpu() - cpu.alpha).abs().max()) < 1e-9


@pytest.mark.parametrize("sums", ["sorted", "fixed"])
def test_runs_are_repeated_bit_for_bit(sums: Any) -> None:
    one, other = (ends("cuda", torch.float32, sums=sums, return_map="fixed_explicit")
                  for _ in range(2))  # fmt: skip
    assert torch.equal(one.position, other.position) and torch.equal(one.alpha, other.alpha)


def test_an_unguarded_division_is_told_from_the_return_map() -> None:
    scene = brittle.drop(0.08, per_cell=1, shift=0.0)
    solver = Textbook(scene, Variant(guarded=False), device="cuda", dt=brittle.step(scene))
    with pytest.raises(FloatingPointError):
        solver.run(steps=1)
    assert solver.birth is not None and solver.birth.stage == "g2p" and solver.birth.massless
