"""The grips of a scene: rows grown from its points, and what each gives to the matter."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Particles
from gsfluent.errors import InputError
from gsfluent.ops import collider as columns
from gsfluent.scene.scene import Collider, Scene

Reactions = dict[str, dict[str, list[float]]]


def grip_row(
    c: Collider, scene: Scene, particles: Particles, dx: float, offset: int
) -> tuple[Tensor, Tensor]:
    """Row and values of a grip (:func:`gsfluent.ops.grip_rows`), on the CPU.

    Raises:
        InputError: There are no points in its box.
    """
    assert c.box is not None
    position = particles.position.double().cpu()
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in c.box)
    names = [body.name for body in scene.bodies]
    of = torch.tensor([names.index(name) for name in c.of])
    inside = ((position >= low) & (position <= high)).all(dim=1)
    inside &= torch.isin(particles.body.cpu().long(), of)
    if not bool(inside.any()):
        raise InputError(
            f"grip {c.name!r}: there is no matter of {', '.join(c.of)} in its box "
            f"{[list(corner) for corner in c.box]}",
            hint="move the box, make it larger, or choose finer cells",
        )
    about = None if c.centred else torch.tensor([c.point], dtype=torch.float64)
    row, values = ops.grip_rows(
        position, particles.mass.cpu(), inside.long() - 1, dx=dx, about=about, offset=offset,
        velocity=torch.tensor([c.velocity], dtype=torch.float64),
        angular_velocity=torch.tensor([c.angular_velocity], dtype=torch.float64),
    )  # fmt: skip
    return row[0], values


def reactions(
    names: list[str], start: Tensor, now: Tensor, given: Tensor, seconds: float
) -> Reactions:
    """What grips do in a span of time, and how far they are on their way.

    Args:
        names: Of the grips.
        start: Their rows at the start, [G, 32].
        now: Their rows now.
        given: Impulse [N s] and torque about each point [N m s] in the span, [G, 6].
        seconds: Length of the span.

    Returns:
        By name: ``force`` on the matter [N] and ``moment`` about the grip's point [N m], means over
        the span; ``displacement`` of the point [m]; ``turn``, a rotation vector [degrees].
    """
    mean = given / seconds if seconds > 0.0 else torch.zeros_like(given)
    found: Reactions = {}
    for name, first, row, push in zip(names, start.cpu(), now.cpu(), mean.cpu(), strict=True):
        q = row[columns.ORIENTATION : columns.ANGULAR_VELOCITY]
        sine = float(q[1:].norm())
        angle = math.degrees(2.0 * math.atan2(sine, float(q[0])))
        point = slice(columns.POINT, columns.NORMAL)
        found[name] = {
            "force": push[:3].tolist(),
            "moment": push[3:].tolist(),
            "displacement": (row[point] - first[point]).tolist(),
            "turn": (angle / sine * q[1:] if sine > 0.0 else q[1:]).tolist(),
        }
    return found


def strongest(frames: list[Reactions], times: list[float]) -> list[dict[str, Any]]:
    """The largest force and moment of every grip, and when."""
    found = []
    for name in frames[0] if frames else ():
        row: dict[str, Any] = {"name": name}
        for what in ("force", "moment"):
            sizes = [math.hypot(*frame[name][what]) for frame in frames]
            at = max(range(len(sizes)), key=sizes.__getitem__)
            row |= {what: sizes[at], f"{what}_at": times[at]}
        found.append(row)
    return found
