"""Run a scene of FractureBench by the textbook solver: fixed-centre NACC, one field, F storage.

python scripts/peers/textbook_nacc.py --scene S.npz --out R.npz

The reference that stands for what others ship (gsfluent.lab.textbook.solver, in gsfluent's
environment):
APIC on quadratic B-splines, absolute float32 positions, deformation gradients, the return map of
CD-MPM with its lagging hardening. It is plain torch, so its times say nothing about its makers'.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import peerlib
from peerlib import Floats, Scene


class Engine:
    """One scene in it."""

    def __init__(self, peer: Textbook, scene: Scene, variant: str, device: str) -> None:
        import torch

        self.torch, self.steps, self.device = torch, 0, device
        self.solver = peer.solver(scene, peer.variant(), device=device, dtype=torch.float32)

    def advance(self, count: int, dt: float) -> None:
        for _ in range(count):
            self.solver.advance(dt)
        self.steps += count
        if self.device == "cuda":
            self.torch.cuda.synchronize()

    def state(self) -> tuple[Floats, Floats]:
        x, v = self.solver.position, self.solver.velocity
        return np.asarray(x.double().cpu()), np.asarray(v.double().cpu())


class Textbook:
    name = "textbook"
    shipped = "textbook"
    needs = "gsfluent"
    install = "It is part of gsfluent: run it in gsfluent's environment"
    variants: Mapping[str, Sequence[str]] = {"cpu": ("textbook",), "cuda": ("textbook",)}
    courant: Sequence[float] = (0.37, 0.7, 0.1)
    solver: Any = None
    variant: Any = None

    def load(self, folder: Path | None) -> str:
        from gsfluent.lab.charts.record import commit
        from gsfluent.lab.textbook import solver as textbook

        self.solver, self.variant = textbook.Textbook, textbook.Variant
        return f"gsfluent {commit()}"

    def start(self, scene: Scene, variant: str, device: str) -> Engine:
        return Engine(self, scene, variant, device)


if __name__ == "__main__":
    sys.exit(peerlib.main(Textbook(), __doc__ or ""))
