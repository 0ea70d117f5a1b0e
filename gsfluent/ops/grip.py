"""Points that are held or driven along a path: a grip is a sticky collider grown from its points.

The grid has no way to hold a point but by the nodes that carry it. A grip holds every node that has
enough of its mass from the points of the grip, and moves with them as a rigid body; what it gave is
the reaction, :attr:`gsfluent.ops.Solver.impulse` and ``torque``. See docs/theory/colliders.md.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad

from gsfluent._check import check_tensor
from gsfluent.ops.blocks import check_dx
from gsfluent.ops.collider import SDF_ALIGN, collider_row

HELD = 0.082
"""Least share of its mass that a node has from the points of a grip that holds it. What is free
feels a face 0.211 dx behind the outermost held node. A node 0.711 dx out of the face of a grip has
this share: so the face felt is that of the points on average, and never half a cell off."""
_FINE = 2
"""Values of the share per cell and axis."""
_REACH = 3 * _FINE
"""Places of an axis that a point's kernel reaches."""
_CHUNK = 1 << 14


def _spread(position: Tensor, mass: Tensor, low: Tensor, size: list[int], h: float) -> Tensor:
    """Mass by quadratic B-splines of width ``_FINE h`` at places ``(low + i) h``, [size]."""
    total = torch.zeros(size, dtype=torch.float64).flatten()
    step = torch.arange(_REACH)
    stride = torch.tensor([size[1] * size[2], size[2], 1])
    for x, m in zip(position.split(_CHUNK), mass.split(_CHUNK), strict=True):
        place = x / h - low
        first = torch.ceil(place - 0.5 * _REACH).long()
        index = first[:, None] + step[:, None]  # [n, reach, 3]
        r = ((index - place[:, None]) / _FINE).abs()
        weight = torch.where(r < 0.5, 0.75 - r**2, 0.5 * (1.5 - r).clamp(min=0.0) ** 2)
        inside = (index >= 0) & (index < torch.tensor(size))
        weight, flat = weight * inside, index.clamp(min=0) * inside * stride
        at = flat[:, :, None, None, 0] + flat[:, None, :, None, 1] + flat[:, None, None, :, 2]
        w = weight[:, :, None, None, 0] * weight[:, None, :, None, 1] * weight[:, None, None, :, 2]
        total.index_add_(0, at.flatten(), (w * m[:, None, None, None]).flatten())
    return total.reshape(size)


def _share(position: Tensor, mass: Tensor, driven: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """The share of the mass around every place that is driven, and the first place [h], [3]."""
    h = dx / _FINE
    mine = position[driven] / h
    low = torch.floor(mine.amin(dim=0) - 0.5 * _REACH)
    size = (torch.ceil(mine.amax(dim=0) + 0.5 * _REACH) - low + 1).long().tolist()
    held = _spread(position[driven], mass[driven], low, size, h)
    near = ((position / h > low - _REACH) & (position / h < mine.amax(dim=0) + 2 * _REACH)).all(1)
    whole = _spread(position[near], mass[near], low, size, h)
    # beside the matter there is no share: that of the matter near by goes on, as the grip moves
    wide = [avg_pool3d(v[None], 2 * _FINE + 3, 1, _FINE + 1)[0] for v in (held, whole)]
    least = 1e-6 * float(mass[driven].mean())
    share = (held + 1e-6 * wide[0]) / (whole + 1e-6 * wide[1]).clamp(min=1e-6 * least)
    return share, low


def grip_rows(
    position: Tensor,
    mass: Tensor,
    grip: Tensor,
    *,
    dx: float,
    about: Tensor | None = None,
    velocity: Tensor | None = None,
    angular_velocity: Tensor | None = None,
    offset: int = 0,
) -> tuple[Tensor, Tensor]:
    """Rows of colliders that hold points or drive them, for :class:`gsfluent.ops.Solver`.

    Change their columns of velocity later by :meth:`gsfluent.ops.Solver.set_colliders`.

    Args:
        position: Where all points are now [m], [N, 3].
        mass: Their masses [kg], [N].
        grip: Number of the grip of each point, int [N], from 0; -1 for free points.
        dx: Node spacing [m].
        about: What each grip turns about, and moments are about [m], [G, 3]; default: the centre
            of mass of its points.
        velocity: Of that point [m/s], [G, 3]; default: none, the points are held.
        angular_velocity: [rad/s], [G, 3]; default: none.
        offset: Values that stand before these in the common buffer, a multiple of 64.

    Returns:
        Rows float64 [G, 32] for ``colliders``, and values float32 for ``sdf``.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape, no grip, or one without points.
    """
    op = "grip_rows"
    check_tensor(op, "position", position, shape=(None, 3))
    n = position.shape[0]
    check_tensor(op, "mass", mass, shape=(n,))
    if grip.shape != (n,) or grip.is_floating_point():
        raise ValueError(f"{op}: grip must be whole numbers [{n}], got {list(grip.shape)}")
    dx, device = check_dx(op, dx), position.device
    position, mass, grip = position.double().cpu(), mass.double().cpu(), grip.cpu()
    count = int(grip.max()) + 1 if n else 0
    if count <= 0:
        raise ValueError(f"{op}: no point has a grip")
    given = {"about": about, "velocity": velocity, "angular_velocity": angular_velocity}
    for name, value in given.items():
        if value is not None and tuple(value.shape) != (count, 3):
            raise ValueError(f"{op}: {name} must have shape [{count}, 3], got {list(value.shape)}")
    rows, values = [], []
    for number in range(count):
        driven = grip == number
        if not bool(driven.any()):
            raise ValueError(f"{op}: grip {number} has no points")
        m = mass[driven, None]
        middle = (m * position[driven]).sum(dim=0) / m.sum() if about is None else about[number]
        share, low = _share(position, mass, driven, dx)
        spacing = dx / _FINE
        flat = (dx * (HELD - share)).float().flatten()
        corner = low * spacing - middle.double().cpu()
        rows.append(
            collider_row(
                "sdf", mode="sticky", point=middle.tolist(), normal=corner.tolist(),
                radius=spacing, extent=list(share.shape), offset=offset,
                velocity=(0.0, 0.0, 0.0) if velocity is None else velocity[number].tolist(),
                angular_velocity=(0.0, 0.0, 0.0)
                if angular_velocity is None
                else angular_velocity[number].tolist(),
            )
        )  # fmt: skip
        values.append(pad(flat, (0, -flat.shape[0] % SDF_ALIGN)))
        offset += values[-1].shape[0]
    return torch.stack(rows).to(device), torch.cat(values).to(device)
