"""Rows of the material table for matter that softens, melts and freezes.

What is liquid to a share f has the stiffness and strength of the solid times 1 - f, in steps; what
is almost all liquid is one. The step is a row of the table, so that no law and no kernel knows of
temperatures.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.materials import LAWS, Material
from gsfluent.materials.heat import Thermal, thermal
from gsfluent.pipeline.matter.points import Matter
from gsfluent.scene.scene import Scene

LEVELS = 10
"""Steps from solid to liquid; the last one is a liquid."""
SOFTENED: dict[str, tuple[int, ...]] = {
    "elastic": (0, 1),
    "corotated": (0, 1),
    "nacc": (0, 1),
    "von_mises": (0, 1, 2, 4, 5),
}
"""Laws of what can melt, and the columns of their rows that are stresses."""
TAIT = 7.0
"""Exponent of the melt's pressure."""


def thermal_of(name: str, material: Material) -> Thermal:
    """Thermal numbers of a body's material, by the name of its preset.

    Args:
        name: Of the body.
        material: Its material.

    Raises:
        InputError: No numbers are known of it, or its law or viscosity cannot melt.
    """
    if material.law not in SOFTENED:
        raise InputError(
            f"{name!r} has a temperature, but law {material.law!r} cannot melt",
            hint=f"use law {', '.join(SOFTENED)}, or leave out the temperature",
        )
    try:
        known = thermal(material.name)
    except InputError as error:
        raise InputError(
            f"{name!r} has a temperature, but nothing is known of the heat of {material.name!r}",
            hint=error.hint,
        ) from None
    if material.viscous:
        raise InputError(
            f"{name!r} has a temperature, but viscous matter cannot melt",
            hint="leave out the temperature, or relaxation_share, relaxation_time and yield_time",
        )
    return known


def thawing(scene: Scene, matter: Matter) -> Matter:
    """Matter with rows for what softens and melts; the same where nothing has a temperature.

    Raises:
        InputError: A body's temperature, and no thermal numbers for it or a law that cannot melt.
    """
    warm = [n for n, body in enumerate(scene.bodies) if body.temperature is not None]
    if not warm:
        return matter
    ladder = torch.full_like(matter.particles.material, -1)
    laws, params, count = [matter.law], [matter.params], matter.law.shape[0]
    for number in warm:
        body = scene.bodies[number]
        for material in body.materials:
            melt = thermal_of(body.name, dataclasses.replace(material, name=body.material.name))
        a, b = matter.ranges[number]
        base, place = torch.unique(matter.particles.material[a:b].long(), return_inverse=True)
        rungs, law = _rungs(matter.law[base], matter.params[base], melt.viscosity)
        ladder[a:b] = (count + LEVELS * place).to(ladder)
        laws.append(law)
        params.append(rungs)
        count += law.shape[0]
    return dataclasses.replace(
        matter, law=torch.cat(laws), params=torch.cat(params).contiguous(), ladder=ladder
    )


def _rungs(law: Tensor, params: Tensor, viscosity: float) -> tuple[Tensor, Tensor]:
    """Rows [R * LEVELS, 8] and laws of the steps above those of solids, [R, 8] and [R]."""
    stress = torch.zeros(len(LAWS), params.shape[1], dtype=torch.bool, device=params.device)
    for name, columns in SOFTENED.items():
        stress[LAWS[name], list(columns)] = True
    soft = stress[law.long()]
    rungs = []
    for level in range(1, LEVELS):
        rungs.append(torch.where(soft, params * (1.0 - level / LEVELS), params))
    melt = torch.zeros_like(params)
    melt[:, 1] = rungs[-1][:, 1]  # as the last solid, so that no pressure jumps
    melt[:, 2], melt[:, 6], melt[:, 7] = viscosity, params[:, 6], TAIT
    laws = [law] * (LEVELS - 1) + [torch.full_like(law, LAWS["fluid"])]
    table = torch.stack([*rungs, melt], dim=1).reshape(-1, params.shape[1])
    return table, torch.stack(laws, dim=1).reshape(-1)


def at_level(matter: Matter, level: Tensor) -> Tensor:
    """Row of each point at its step from solid (0) to liquid, int32 [N]."""
    assert matter.ladder is not None
    solid = (level <= 0) | (matter.ladder < 0)
    return torch.where(solid, matter.particles.material, matter.ladder + level.int() - 1)
