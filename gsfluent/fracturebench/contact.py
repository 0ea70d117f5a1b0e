"""Elastic bodies that touch and part."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .registry import case
from .run import Measure, Run
from .scene import Scene
from .shapes import box, elastic, free, wave_speed

__all__ = ["pull_apart"]


def _judge_apart(scene: Scene, run: Run) -> Iterator[Measure]:
    second = scene.body == 1
    mass = scene.mass[second]
    kept = float((mass * run.v[-1][second, 0]).sum() / mass.sum()) / float(scene.facts["speed"])
    yield Measure(
        "speed kept by a block that leaves another", kept, 1.0, abs(kept - 1.0), 1e-3, "",
        "free flight",
    )  # fmt: skip


@case(kind="contact", dx=0.01, ladder=(0.02, 0.01, 0.005), judge=_judge_apart)
def pull_apart(dx: float, per_cell: int) -> Scene:
    """Two touching blocks that leave each other at a hundredth of the wave speed."""
    edge = 0.04
    left = box([-edge, 0.0, 0.0], [edge] * 3, dx, per_cell)
    right = box([0.0, 0.0, 0.0], [edge] * 3, dx, per_cell)
    material = elastic(1e5, 0.2, 1000.0)
    body = np.repeat([0.0, 1.0], [left.shape[0], right.shape[0]])
    speed = 0.01 * wave_speed(material)
    velocity = np.zeros((body.shape[0], 3))
    velocity[:, 0] = np.where(body == 1, speed, -speed)
    times = np.linspace(0.0, 0.3 * edge / speed, 5)[1:]
    return free(
        "pull_apart", np.concatenate([left, right]), velocity, dx, per_cell, times, material,
        body=body, facts={"speed": speed},
    )  # fmt: skip
