"""Sums of the resident solver on a GPU, in whole numbers: 32 bits in a window, 64 between windows.

The definition of what p2g of ``csrc/cuda/solver`` adds up, and of what may lie
between that and the exact sums. The units come from the clock of a :class:`gsfluent.ops.Solver`;
docs/theory/solver-sums.md has the proof that nothing overflows. ``scripts/study/solver.py`` and a
test use it.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from gsfluent.ops.reference.tensors import to_matrix

WINDOW_BITS = 30
"""The words of all points of a home fit into 2^30 units of its window."""
MOMENTUM_SHARE = 0.43
"""Of its bound, that one point gives to one node at most: more than (3/4)^3, the largest weight."""
MASS_SHARE = 0.43
"""The same for masses; of first moments, in cells, a point gives less."""
ROUNDED_UP = 1.000002
"""Factor on a float32 bound, so that it is never below what it stands for."""


def power_above(x: float) -> float:
    """Power of two above ``x`` > 0, at most twice it."""
    return math.ldexp(1.0, math.frexp(x)[1])


def window_unit(bound: float, share: float, count: int) -> float:
    """Unit of a window to which ``count`` points give at most ``share bound`` each.

    :func:`node_sums` takes the unit of the step where that is the coarser one.
    """
    return math.ldexp(power_above(max(bound, 1e-25) * share * count), -WINDOW_BITS)


@dataclasses.dataclass(frozen=True)
class Transfer:
    """What points give to nodes in one step; a quantity's last index is momentum x, y, z, mass.

    Attributes:
        weight: B-spline weights, float32 [N, 27].
        given: Momentum [kg m/s] and mass [kg] before the weight, float32 [N, 27, 4].
        bound: Largest momentum a point can give to a node before its weight [kg m/s], [N].
        node: Nodes, int64 [N, 27, 3].
        home: Block of each point, numbered, int64 [N].
    """

    weight: Tensor
    given: Tensor
    bound: Tensor
    node: Tensor
    home: Tensor


def transfer(
    position: Tensor,
    velocity: Tensor,
    affine: Tensor,
    stress: Tensor,
    mass: Tensor,
    volume: Tensor,
    *,
    dx: float,
    dt: float,
) -> Transfer:
    """Weights and momenta of one step (MLS-MPM, Hu et al. 2018; APIC, Jiang et al. 2015).

    Args:
        position: Positions [m], float64 [N, 3].
        velocity: Velocities [m/s], float32 [N, 3].
        affine: APIC matrix C [1/s], [N, 3, 3].
        stress: Kirchhoff stress [Pa], [N, 6].
        mass: Masses [kg], [N].
        volume: Volumes at rest [m^3], [N].
        dx: Node spacing [m].
        dt: Step [s].
    """
    scale = dt * volume * 4.0 / dx**2
    slope = mass[:, None, None] * affine - scale[:, None, None] * to_matrix(stress)
    u = position / dx - 0.5
    cell = torch.floor(u).long()
    o = (u - cell).to(velocity.dtype)
    w = torch.stack([0.5 * (1 - o) ** 2, 0.75 - (o - 0.5) ** 2, 0.5 * o**2], dim=-1)
    axis = torch.arange(3)
    step = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(27, 3)
    weight = w[:, 0, step[:, 0]] * w[:, 1, step[:, 1]] * w[:, 2, step[:, 2]]
    lever = dx * (step - (o + 0.5)[:, None])
    momentum = (mass[:, None] * velocity)[:, None] + lever @ slope.mT
    bound = mass[:, None] * velocity.abs() + 1.5 * dx * slope.abs().sum(dim=2)
    _, home = torch.unique(cell >> 2, dim=0, return_inverse=True)
    return Transfer(
        weight=weight,
        given=torch.cat([momentum, mass[:, None, None].expand(-1, 27, 1)], dim=2),
        bound=bound.amax(dim=1),
        node=cell[:, None] + step,
        home=home,
    )


@dataclasses.dataclass(frozen=True)
class NodeSums:
    """Sums of momentum and mass at the nodes that were reached, float64 [nodes, 4].

    Attributes:
        fixed: As the GPU takes them.
        exact: In float64.
        slack: Largest difference that rounding can make, by docs/theory/solver-sums.md.
        node: Which row each point's nodes are, int64 [N, 27].
    """

    fixed: Tensor
    exact: Tensor
    slack: Tensor
    node: Tensor

    def gathered(self, weight: Tensor, sums: Tensor) -> Tensor:
        """Velocity that each point takes from nodes with these sums, [N, 3]."""
        mass = sums[:, 3:].clamp(min=1e-300)
        velocity = torch.where(sums[:, 3:] > 1e-30, sums[:, :3] / mass, 0.0)
        return (weight[..., None].to(sums.dtype) * velocity[self.node]).sum(dim=1)


def node_sums(
    t: Transfer, momentum_unit: float, mass_unit: float, part: Tensor | None = None
) -> NodeSums:
    """Sums of one step in the units of its clock.

    Args:
        t: What the points give.
        momentum_unit: Of the clock [kg m/s], a power of two.
        mass_unit: Of the clock [kg], a power of two.
        part: Which of the CTAs that share a home takes the point, int64 [N]; one takes all when
            None. It changes no sum.

    Raises:
        OverflowError: A sum leaves its word.
    """
    homes = int(t.home.max()) + 1
    count = torch.bincount(t.home, minlength=homes).tolist()
    zero = t.bound.new_zeros(homes)
    bound = zero.scatter_reduce(0, t.home, t.bound, "amax").tolist()
    heaviest = zero.scatter_reduce(0, t.home, t.given[:, 0, 3], "amax").tolist()
    units = t.bound.new_tensor(
        [
            [window_unit(b * ROUNDED_UP, MOMENTUM_SHARE, n)] * 3
            + [window_unit(m * ROUNDED_UP, MASS_SHARE, n)]
            for b, m, n in zip(bound, heaviest, count, strict=True)
        ],
        dtype=torch.float64,
    )
    step_units = units.new_tensor([momentum_unit] * 3 + [mass_unit])
    units = torch.maximum(units, step_units)  # so that the hand-over below is exact
    # One row for every node of every window.
    taker = t.home if part is None else t.home + homes * part
    place = torch.cat([taker[:, None, None].expand(-1, 27, 1), t.node], dim=2).view(-1, 4)
    windows, owner = torch.unique(place, dim=0, return_inverse=True)
    scaled = t.given * (1.0 / units).to(t.given)[t.home][:, None]
    words = torch.round(t.weight[..., None] * scaled).long().view(-1, 4)
    tile = words.new_zeros(windows.shape[0], 4).index_add_(0, owner, words)
    if int(tile.abs().max()) >= 2**31:
        raise OverflowError("node_sums: a sum of a window leaves 32 bits")
    nodes, at = torch.unique(windows[:, 1:], dim=0, return_inverse=True)
    ratio = units[windows[:, 0] % homes] / step_units
    whole = words.new_zeros(nodes.shape[0], 4)
    whole.index_add_(0, at, tile * ratio.long())
    if int(whole.abs().max()) >= 2**62:
        raise OverflowError("node_sums: a sum of a node leaves 63 bits")
    real = (t.weight[..., None].double() * t.given.double()).view(-1, 4)
    exact = units.new_zeros(nodes.shape[0], 4).index_add_(0, at[owner], real)
    # Half a unit and the float32 rounding of every addend.
    slack = torch.zeros_like(exact)
    slack.index_add_(0, at[owner], 0.5 * units[place[:, 0] % homes] + 2.0**-21 * real.abs())
    return NodeSums(
        fixed=whole.double() * step_units, exact=exact, slack=slack, node=at[owner].view(-1, 27)
    )
