"""How much memory a stage takes at most, from the size of its work.

Bytes per unit of the features of :mod:`gsfluent.pipeline.plan_work`. On the CPU that is resident
memory, on top of that of a process that has loaded the program; on a GPU what the stage has
allocated there.
"""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["BYTES", "memory_of"]

BYTES: dict[str, dict[str, dict[str, float]]] = {
    "cpu": {
        "reconstruct": {"start": 60e6, "source_pixels": 1.0},
        "isolate": {"start": 60e6, "splats": 500.0},
        "fill": {"start": 60e6, "voxels": 300.0, "inner": 500.0},
        "texture": {"start": 60e6, "volume": 300.0},
        "simulate": {"start": 60e6, "gaussians": 700.0, "points": 500.0, "blocks_most": 6000.0},
        "render": {"start": 60e6, "gaussians": 600.0, "pixels": 100.0},
        "export": {"start": 60e6},
    },
    "cuda": {
        "reconstruct": {"start": 20e6, "source_pixels": 4.0},
        "isolate": {"splats": 500.0},
        "fill": {"start": 20e6, "voxels": 100.0, "inner": 500.0},
        "texture": {"start": 20e6, "volume": 100.0},
        "simulate": {"start": 20e6, "gaussians": 700.0, "points": 500.0, "blocks_most": 6000.0},
        "render": {"start": 20e6, "gaussians": 600.0, "pixels": 100.0},
        "export": {"start": 20e6},
    },
}


def memory_of(stage: str, features: Mapping[str, float], device: str, base: int) -> int:
    """Most memory of a stage [bytes].

    Args:
        stage: Stage, as in ``run.json``.
        features: Amounts of work.
        device: ``cpu`` or ``cuda``.
        base: Resident memory of the process before any work; counts on the CPU only.
    """
    rows = BYTES[device].get(stage, {})
    size = sum(value * features.get(name, 0.0) for name, value in rows.items())
    return int(size) + (base if device == "cpu" else 0)
