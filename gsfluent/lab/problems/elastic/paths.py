"""One material point along prescribed paths: when does it break?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import nacc

STRAIN, STEPS = 0.6, 600
SLOPE = 6.0 * math.sin(math.pi / 4) / (3.0 - math.sin(math.pi / 4))
"""Friction M of 45 degrees."""
PATHS = ("simple shear", "isotropic tension", "uniaxial tension", "deviatoric stretch")

_EXPECTED = {
    # path: step at which alpha reaches 0 with explicit alpha, for shear damage 0 and 0.3
    "simple shear": (500, 262),
    "isotropic tension": (72, 72),
    "uniaxial tension": (70, 67),
    "deviatoric stretch": (None, 144),
}
_SOURCE = "equations.md 7.4, column D"


def increment(path: str, strain: float) -> Tensor:
    """``dt grad v`` that adds the logarithmic strain (or shear angle) ``strain`` to a point.

    Raises:
        ValueError: An unknown path.
    """
    grow = torch.zeros(1, 3, 3, dtype=torch.float64)
    if path == "simple shear":
        grow[0, 0, 1] = strain
    elif path == "isotropic tension":
        grow[0] = torch.eye(3, dtype=torch.float64) * math.expm1(strain / 3.0)
    elif path == "uniaxial tension":
        grow[0, 0, 0] = math.expm1(strain)
    elif path == "uniaxial compression":
        grow[0, 0, 0] = math.expm1(-strain)
    elif path == "deviatoric stretch":
        side = math.expm1(-0.5 * strain)
        grow[0] = torch.diag(torch.tensor([math.expm1(strain), side, side], dtype=torch.float64))
    else:
        raise ValueError(f"path must be one of {', '.join(PATHS)}, got {path!r}")
    return grow


def breaking_step(
    path: str, *, cohesion: float = 0.6, shear_damage: float = 0.0, **return_map: Any
) -> tuple[int | None, float, float]:
    """Walk a point of watermelon flesh along a path in 600 steps of 0.001.

    Returns:
        Number (from 0) of the step in which alpha reaches 0, or None; alpha at the end; and
        ``q / mu`` at the end.
    """
    row = nacc(
        2000.0, 0.38, 1.0, friction=SLOPE, cohesion=cohesion, hardening=3.0,
        shear_damage=shear_damage,
    )  # fmt: skip
    law, params = torch.ones(1, dtype=torch.int32), row.reshape(1, 8)
    strain = torch.zeros(1, 6, dtype=torch.float64)
    alpha = torch.full((1,), -0.04, dtype=torch.float64)
    grow = increment(path, STRAIN / STEPS)
    broken = None
    for step in range(STEPS):
        strain, alpha, stress, _ = ops.return_mapping(
            strain, alpha, grow, law=law, params=params, **return_map
        )
        if broken is None and float(alpha) >= 0.0:
            broken = step
    spherical = stress[0, :3].mean()
    deviator = (stress[0, :3] - spherical).square().sum() + 2.0 * stress[0, 3:].square().sum()
    return broken, float(alpha), float(torch.sqrt(1.5 * deviator)) / float(row[0])


@problem(tier="fast")
def return_map_paths() -> Iterator[Result]:
    """Step at which one point breaks on five paths."""
    for path, expected in _EXPECTED.items():
        for eta, step in zip((0.0, 0.3), expected, strict=True):
            if step is None:
                continue
            found, _, _ = breaking_step(path, shear_damage=eta, implicit=False)
            value = math.nan if found is None else float(found)
            yield compare(
                f"breaking step, {path}, eta {eta:g}", value, step, error=abs(value - step),
                tolerance=1.0, unit="steps", source=_SOURCE,
            )  # fmt: skip
    # without shear damage a deviatoric stretch ends at the edge of breaking, whatever side
    _, alpha, _ = breaking_step("deviatoric stretch", implicit=False)
    yield compare(
        "alpha after a deviatoric stretch", alpha, -0.001, error=abs(alpha + 0.001),
        tolerance=0.003, source=_SOURCE,
    )  # fmt: skip
    _, alpha, shear = breaking_step("uniaxial compression", implicit=False)
    for quantity, value, reference, bar in (
        ("alpha after uniaxial compression", alpha, -0.119, 0.001),
        ("q / mu after uniaxial compression", shear, 0.70, 0.01),
    ):
        yield compare(
            quantity, value, reference, error=abs(value - reference), tolerance=bar, source=_SOURCE,
        )  # fmt: skip
