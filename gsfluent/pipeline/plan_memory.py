"""How much memory a stage takes at most, from the size of its work.

Bytes per unit of the features of :mod:`gsfluent.pipeline.plan_work`. On the CPU that is resident
memory, that of the loaded program included (``start``); on a GPU what the stage has allocated.
"""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["BYTES", "memory_of"]

BYTES: dict[str, dict[str, dict[str, float]]] = {
    "cpu": {
        "reconstruct": {"start": 412e6, "source_pixels": 4.3, "splats_most": 1000.0},
        "isolate": {"start": 407e6, "splats": 264.0},
        "fill": {"start": 410e6, "voxels_most": 283.0, "inner_most": 2820.0},
        "texture": {"start": 567e6, "volume_most": 496.0},
        "simulate": {"start": 535e6, "gaussians": 1050.0, "points": 5300.0, "blocks_most": 6000.0},
        "render": {"start": 450e6, "gaussians": 688.0, "pixels": 674.0},
        "export": {"start": 450e6, "gaussians": 688.0},
    },
    "cuda": {
        "reconstruct": {"start": 20e6, "source_pixels": 16.0, "splats_most": 1000.0},
        "isolate": {"splats": 264.0},
        "fill": {"start": 20e6, "voxels_most": 100.0, "inner_most": 1000.0},
        "texture": {"start": 20e6, "volume_most": 200.0},
        "simulate": {"start": 20e6, "gaussians": 1050.0, "points": 1000.0, "blocks_most": 9000.0},
        "render": {"start": 20e6, "gaussians": 688.0, "pixels": 300.0},
        "export": {"start": 20e6, "gaussians": 688.0},
    },
}
"""``cpu``: fitted to six gallery shots, each in a process of its own (scripts/study/shots/plan.py
--fit-memory); residuals are 5 % in the median, 20 % at most. What those shots are too small to show
is counted from the tensors: training state of a splat (``splats_most``), the solver's buffers of a
block (``blocks_most``, gsfluent/ops/solver_buffers.py). ``cuda``: counted from tensors, and taken
only until the probe has measured the machine."""


def memory_of(
    stage: str,
    features: Mapping[str, float],
    device: str,
    measured: Mapping[str, float] | None = None,
) -> int:
    """Most memory of a stage [bytes].

    Args:
        stage: Stage, as in ``run.json``.
        features: Amounts of work.
        device: ``cpu`` or ``cuda``.
        measured: Bytes per unit that were measured on this machine, instead of :data:`BYTES`.
    """
    rows = measured or BYTES[device].get(stage, {})
    return int(sum(value * features.get(name, 0.0) for name, value in rows.items()))
