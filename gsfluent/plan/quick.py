"""A second's look at a machine: what work costs on a reference machine, at the pace of this one.

The probe (:mod:`gsfluent.plan.probe`) measures every stage and takes a quarter of a minute, which
nobody wants before a first film. Three short pieces of the real work say how fast a machine moves
points, draws splats and goes through arrays; every cost of the reference goes with one of them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from gsfluent import materials
from gsfluent._lazy import ndimage
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.plan.cost import CostModel
from gsfluent.plan.probe_parts import measured_ball

REFERENCE = {
    "cpu": Path(__file__).with_name("reference.json"),
    "cuda": Path(__file__).with_name("reference_cuda.json"),
}
"""Costs that the probe has measured on one machine, and the pieces as that machine did them."""
STAGE_PIECES = {
    "reconstruct": "draw", "isolate": "arrays", "fill": "arrays", "texture": "arrays",
    "simulate": "solve", "render": "draw", "export": "arrays",
}  # fmt: skip
"""Which piece of work a stage goes with; what is paid once goes with ``arrays`` everywhere."""
_TRIES = 3  # the best of them counts: others at work make a piece slower, nothing makes it faster
_CELLS = 12
_CALLS = 500  # small ones: on a GPU they are what most stages wait for
_SPLATS, _SIZE, _VOXELS, _NUMBERS = 30_000, (384, 288), 48, 300_000


def quick_model(device: torch.device | str) -> CostModel | None:
    """A model of this machine in a second or two; None on a kind of device without a reference.

    It counts as not measured: the probe is better, and finished runs correct it.
    """
    device = torch.device(device)
    if device.type not in REFERENCE:
        return None
    known = json.loads(REFERENCE[device.type].read_text(encoding="utf-8"))
    start = time.perf_counter()
    here = pieces(device)
    pace = {name: took / known["pieces"][name] for name, took in here.items()}
    model = CostModel.unmeasured(device)
    model.seconds = {
        stage: {
            feature: cost * pace["arrays" if feature == "start" else STAGE_PIECES[stage]]
            for feature, cost in costs.items()
        }
        for stage, costs in known["seconds"].items()
    }
    model.probe_seconds = time.perf_counter() - start
    return model


def pieces(device: torch.device | str) -> dict[str, float]:
    """Seconds of three pieces of work on a device: ``solve``, ``draw`` and ``arrays``."""
    device = torch.device(device)
    brittle = materials.get("fruit.watermelon").override(variation=0.0)
    generator = torch.Generator().manual_seed(0)
    means = 0.5 * torch.randn(_SPLATS, 3, generator=generator)
    splats = Gaussians.from_colors(means, torch.full((_SPLATS,), 0.01), means.abs().clamp(max=1.0))
    splats = splats.to(device)
    width, height = _SIZE
    camera = Camera.look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0), width=width, height=height)
    numbers = torch.rand(_NUMBERS, generator=generator).to(device)
    solid = (torch.rand(_VOXELS, _VOXELS, _VOXELS, generator=generator) < 0.999).numpy()

    def arrays() -> None:
        torch.sort(numbers)
        if device.type == "cpu":
            ndimage.distance_transform_edt(solid)
            return
        for _ in range(_CALLS):
            numbers[:1024].abs()
        torch.cuda.synchronize(device)

    return {
        "solve": min(measured_ball(brittle, _CELLS, device).seconds for _ in range(_TRIES)),
        "draw": _best(lambda: float(draw(splats, camera).alpha[0, 0])),  # read: it is there
        "arrays": _best(arrays),
    }


def _best(work: Callable[[], Any]) -> float:
    found = []
    for _ in range(_TRIES):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)
