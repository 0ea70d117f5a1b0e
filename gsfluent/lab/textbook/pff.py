"""PFF-MPM: the damage field as Wolper et al. 2019 solve it, for comparison with ours.

A field c from 1 (whole) to 0 with a mobility M, a length of half a cell that no grid resolves, and
an energy per volume, ``scale``, where an energy per area belongs:

    (1 / dt + M F) c - 4 M l^2 lap c = M + c_old / dt,   F = 1 + 4 l (1 - k) H / scale

The points are its quadrature, its mass is lumped, conjugate gradients solve it, and the change goes
back to the points as in FLIP and only downwards.

Source: Wolper, Fang, Li, Lu, Gao, Jiang 2019 (CD-MPM, SIGGRAPH), sections 4 and 5; written from the
paper's equations. How ours differs: docs/theory/phase-field.md.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsfluent.ops.damage import DamageField, damage_of
from gsfluent.ops.reference.mpm import stencil
from gsfluent.ops.reference.phase_field import BROKEN, RESIDUAL

TOLERANCE = 1e-6
"""Residual of the conjugate gradients, over that at the start."""


def pff_solve(
    whole: Tensor,
    factor: Tensor,
    volume: Tensor,
    position: Tensor,
    *,
    dx: float,
    dt: float,
    mobility: float,
    length: float,
    body: Tensor | None = None,
    tolerance: float = TOLERANCE,
) -> tuple[Tensor, int]:
    """One implicit step of the field.

    Args:
        whole: c of each point, 1 to 0, [N].
        factor: F of each point, [N].
        volume: Of each point [m^3], [N].
        position: Positions [m], [N, 3].
        dx: Node spacing [m].
        dt: Time step [s].
        mobility: M [1/s].
        length: l [m].
        body: Field of each point, int32 [N]; fields are solved apart.
        tolerance: Of the residual.

    Returns:
        ``(c of each point after the step, iterations)``.
    """
    node, weight, gradient = stencil(position, dx)
    if body is not None:
        owner = body.long()[:, None, None].expand(-1, 27, 1)
        node = torch.cat([node, owner], dim=2)
    flat = node.reshape(-1, node.shape[-1])
    used, at = torch.unique(flat, dim=0, return_inverse=True)
    at, count = at.view(weight.shape), used.shape[0]

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(count).index_add(0, at.reshape(-1), values.reshape(-1))

    share = volume[:, None] * weight
    mass = total(share)
    before = total(share * whole[:, None]) / mass.clamp(min=torch.finfo(mass.dtype).tiny)
    diagonal = total(share * (1.0 / dt + mobility * factor)[:, None])
    diagonal = torch.where(diagonal > 0.0, diagonal, 1.0)  # nodes without matter of the law
    right = mobility * mass + total(share * whole[:, None]) / dt
    stiff = 4.0 * mobility * length**2 * volume[:, None]

    def apply(c: Tensor) -> Tensor:
        slope = (gradient * c[at][..., None]).sum(dim=1)  # [N, 3]
        return diagonal * c + total(stiff * (gradient * slope[:, None]).sum(dim=2))

    c = before.clone()
    residual = right - apply(c)
    along = residual / diagonal
    size = (residual * along).sum()
    goal, turns = tolerance**2 * float((right**2 / diagonal).sum()), 0
    while float(size) > goal and turns < count:
        pushed = apply(along)
        step = size / (along * pushed).sum()
        c = c + step * along
        residual = residual - step * pushed
        steep = residual / diagonal
        last, size = size, (residual * steep).sum()
        along = steep + size / last * along
        turns += 1
    change = (weight * (c - before)[at]).sum(dim=1)
    return torch.minimum(whole, (whole + change).clamp(0.0, 1.0)), turns


class PffField(DamageField):
    """That field in place of ours, for a :class:`gsfluent.lab.world.driver.World` of operators.

    Put it where the world has its own before the first step:
    ``world.stepper.cracks = PffField(world.scene, mobility=..., scale=...)``.

    Args:
        scene: Scene of the world; its time step must be fixed.
        mobility: M [1/s]; the authors take 1 to 15 in their units.
        scale: What stands for Gc: the authors take psi at 1 to 2 % of even stretch [J/m^3], so
            that their F hangs on the unit of length.

    Attributes:
        turns: Iterations of the conjugate gradients so far.

    Raises:
        ValueError: The time step is not fixed, or a number is not positive.
    """

    def __init__(self, scene: Any, *, mobility: float, scale: float) -> None:
        super().__init__(scene.law, scene.params, scene.material)
        if not scene.fixed_dt:
            raise ValueError("PffField: the world needs a fixed dt")
        if not (mobility > 0.0 and scale > 0.0):
            raise ValueError(f"PffField: mobility {mobility} and scale {scale} must be positive")
        self.dt, self.mobility, self.scale, self.turns = scene.fixed_dt, mobility, scale, 0

    def step(
        self, alpha: Tensor, peak: Tensor, position: Tensor, volume: Tensor, **grid: Any
    ) -> Tensor:
        """Peak after one step of the field, [N]; arguments as :meth:`DamageField.solve`."""
        dx = float(grid["dx"])
        history = ((alpha + 1.0) * self.threshold).clamp(min=0.0)
        length = 0.5 * dx
        factor = 1.0 + 4.0 * length * (1.0 - RESIDUAL) * history / self.scale
        given = volume if self.points is None else torch.where(self.points, volume, 0.0)
        c, turns = pff_solve(
            1.0 - damage_of(peak), factor, given, position, dx=dx, dt=self.dt,
            mobility=self.mobility, length=length, body=grid.get("body"),
        )  # fmt: skip
        self.turns += turns
        d = 1.0 - c
        return torch.where(d > 0, torch.maximum(peak, d - BROKEN), peak)
