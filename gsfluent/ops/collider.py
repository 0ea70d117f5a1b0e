"""Rigid colliders as rows of numbers: collider_row, collider_distance, advance_colliders.

:func:`gsfluent.ops.grid_update` and the solver push matter out of them. The physics is
``csrc/core/collider/collider.h``; the columns are documented in ``csrc/core/collider/shape.h``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes

COLLIDER_COLUMNS = 32
COLUMNS_BEFORE = 16
SDF_ALIGN = 64
"""Distance grids start at multiples of this in their common buffer."""

TYPES = {"nothing": -1, "plane": 0, "sphere": 1, "box": 2, "capsule": 3, "cylinder": 4, "sdf": 5,
         "face": 6}  # fmt: skip
MODES = {"sticky": 0, "slip": 1, "separate": 2}

# Columns, as in csrc/core/collider/shape.h.
TYPE, MODE, FRICTION, POINT, NORMAL, RADIUS, VELOCITY, RESTITUTION = 0, 1, 2, 3, 6, 9, 10, 13
MASS, SWEEP, ORIENTATION, ANGULAR_VELOCITY, INERTIA, EXTENT, OFFSET = 14, 15, 16, 20, 23, 26, 29
ONLY_CUT, STIFFER = 30, 31
STIFFEST = 3.0
"""Largest ``stiffer``: with springs four times as stiff no step makes energy."""


def collider_row(
    kind: str,
    *,
    point: Sequence[float] = (0.0, 0.0, 0.0),
    normal: Sequence[float] = (0.0, 0.0, 1.0),
    radius: float = 0.0,
    extent: Sequence[float] = (0.0, 0.0, 0.0),
    mode: str = "separate",
    friction: float = 0.0,
    restitution: float = 0.0,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    orientation: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    mass: float = 0.0,
    inertia: Sequence[float] = (0.0, 0.0, 0.0),
    sweep: bool = False,
    offset: int = 0,
    only_cut: int = 0,
    stiffer: float = 0.0,
) -> Tensor:
    """One collider as a row.

    Args:
        kind: ``plane`` (the half space behind it, or the round bar behind its disc of ``radius``),
            ``sphere``, ``box``, ``capsule`` and ``cylinder`` (axis along z of the body frame),
            ``sdf`` (signed distances on a grid), ``face`` (the half space under a rectangle in the
            plane z = 0 of the body frame, nothing beyond its rim), ``nothing`` (an empty row).
        point: Plane point or centre [m]; the collider turns about it.
        normal: Plane: normal out of it. ``sdf``: position of the first value in the body frame [m].
        radius: Of sphere, capsule, cylinder, disc [m]; ``sdf``: distance between values [m].
        extent: Box, face: half edges (of a face the third is its depth); capsule and cylinder: half
            length as third number [m]; ``sdf``: number of values along x, y, z, each 2 to 4096.
        mode: ``sticky``, ``slip`` (no normal motion) or ``separate`` (may leave; friction and
            restitution on approach).
        friction: Coulomb coefficient, >= 0.
        restitution: In [0, 1].
        velocity: Of the point [m/s].
        angular_velocity: [rad/s].
        orientation: Quaternion w, x, y, z from the body frame to the world.
        mass: 0: it moves as told. Positive: it takes the impulse of what it hits [kg].
        inertia: Principal moments in the body frame [kg m^2]; 0 does not turn by impulse.
        sweep: Also hit what lies on its way during a step; for bodies that move more than about
            half their thickness per step.
        offset: ``sdf``: index of the first value in the buffer, a multiple of 64.
        only_cut: 0, or bit number + 1 of ``cut``: acts only on fields that have this bit
            (:func:`gsfluent.ops.blade_sides`).
        stiffer: In [0, 3]: where it pushes points, its springs are ``1 + stiffer`` times as stiff
            as their matter. A slow press sinks in less by it; a body that lands bounces less.

    Returns:
        float64 [32]. Stack rows and cast them to the dtype of the grid for
        :func:`gsfluent.ops.grid_update`.

    Raises:
        ValueError: An unknown ``kind`` or ``mode``, or numbers that are no collider.
    """
    op = "collider_row"
    if kind not in TYPES:
        raise ValueError(f"{op}: kind must be one of {', '.join(TYPES)}, got {kind!r}")
    if mode not in MODES:
        raise ValueError(f"{op}: mode must be one of {', '.join(MODES)}, got {mode!r}")
    if offset % SDF_ALIGN:
        raise ValueError(f"{op}: offset must be a multiple of {SDF_ALIGN}, got {offset}")
    row = torch.zeros(COLLIDER_COLUMNS, dtype=torch.float64)
    row[TYPE], row[MODE], row[FRICTION] = TYPES[kind], MODES[mode], friction
    row[RADIUS], row[RESTITUTION], row[MASS], row[SWEEP] = radius, restitution, mass, float(sweep)
    row[OFFSET], row[ONLY_CUT], row[STIFFER] = offset // SDF_ALIGN, only_cut, stiffer
    for name, column, value, count in (
        ("point", POINT, point, 3),
        ("normal", NORMAL, normal, 3),
        ("velocity", VELOCITY, velocity, 3),
        ("orientation", ORIENTATION, orientation, 4),
        ("angular_velocity", ANGULAR_VELOCITY, angular_velocity, 3),
        ("inertia", INERTIA, inertia, 3),
        ("extent", EXTENT, extent, 3),
    ):
        if len(value) != count:
            raise ValueError(f"{op}: {name} must have {count} numbers, got {len(value)}")
        row[column : column + count] = torch.tensor([float(v) for v in value], dtype=torch.float64)
    values = math.prod(int(v) for v in extent) + offset if kind == "sdf" else 0
    check_colliders(op, row[None], values)
    return row


def pad_colliders(colliders: Tensor) -> Tensor:
    """Rows [M, 16] of the older layout as rows [M, 32]; rows [M, 32] unchanged."""
    if colliders.ndim == 2 and colliders.shape[1] == COLUMNS_BEFORE:
        padded = torch.nn.functional.pad(colliders, (0, COLLIDER_COLUMNS - COLUMNS_BEFORE))
        padded[:, MASS:COLUMNS_BEFORE] = 0.0  # had no meaning
        return padded
    return colliders


def check_colliders(op: str, rows: Tensor, sdf_count: int) -> None:
    """Refuse rows that are no collider; the same conditions as ``collider_valid`` of the core."""
    rows = rows.cpu()  # one copy instead of a launch per condition
    kind, mode, radius, extent = (
        rows[:, TYPE],
        rows[:, MODE],
        rows[:, RADIUS],
        rows[:, EXTENT:OFFSET],
    )
    count, offset = extent.double().prod(dim=1), rows[:, OFFSET].double()
    whole = ((extent >= 2) & (extent <= 4096) & (extent == extent.floor())).all(dim=1)
    whole &= (offset >= 0) & (offset == offset.floor()) & (SDF_ALIGN * offset + count <= sdf_count)
    shape = torch.stack(
        [
            (kind == 0) & (rows[:, NORMAL:RADIUS].norm(dim=1) > 0) & (rows[:, MASS] == 0),
            (kind == 1) & (radius > 0),
            (kind == 2) & (extent > 0).all(dim=1),
            (kind == 3) & (radius > 0),
            (kind == 4) & (radius > 0) & (extent[:, 2] > 0),
            (kind == 5) & (radius > 0) & whole,
            (kind == 6) & (extent > 0).all(dim=1),
        ]
    ).any(dim=0)
    right = shape & ((mode == 0) | (mode == 1) | (mode == 2))
    right &= (rows[:, ONLY_CUT] >= 0) & (rows[:, ONLY_CUT] <= 30)
    right &= (rows[:, FRICTION] >= 0) & (rows[:, MASS] >= 0) & (radius >= 0)
    right &= (rows[:, RESTITUTION] >= 0) & (rows[:, RESTITUTION] <= 1)
    right &= (rows[:, STIFFER] >= 0) & (rows[:, STIFFER] <= STIFFEST)
    right &= (rows[:, INERTIA:OFFSET] >= 0).all(dim=1)
    right |= kind == -1
    right &= torch.isfinite(rows).all(dim=1)
    if not bool(right.all()):
        i = int((~right).nonzero()[0])
        got = [round(v, 6) for v in rows[i].tolist()]
        raise ValueError(
            f"{op}: colliders row {i} must be finite, with type 0 (plane: normal not zero, no "
            "mass), 1 (sphere: radius > 0), 2 (box: half edges > 0), 3 (capsule: radius > 0), "
            "4 (cylinder: radius and half length > 0), 5 (sdf: spacing > 0, its values inside the "
            "buffer), 6 (face: half edges > 0) or -1 (nothing), mode 0, 1, 2, friction >= 0, mass "
            f"and inertia >= 0, restitution in [0, 1] and stiffer in [0, 3], got {got}"
        )


def check_rows(op: str, colliders: Tensor, sdf: Tensor | None, like: Tensor) -> Tensor:
    """Shapes, dtypes and devices; on the CPU also the numbers. Returns rows of 32 columns."""
    rows = pad_colliders(colliders) if isinstance(colliders, Tensor) else colliders
    check_tensor(op, "colliders", rows, shape=(None, COLLIDER_COLUMNS), like=like)
    if sdf is not None:
        check_tensor(op, "sdf", sdf, shape=(None,), dtype=torch.float32)
        if sdf.device != like.device:
            raise ValueError(f"{op}: sdf must be on {like.device}, got {sdf.device}")
    if rows.device.type == "cpu":
        check_colliders(op, rows, 0 if sdf is None else sdf.shape[0])
    return rows


def collider_distance(
    position: Tensor, colliders: Tensor, sdf: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Signed distance of points from colliders, as the grid nodes see it.

    Args:
        position: Points [m], shape [N, 3], float32 or float64.
        colliders: Rows, shape [M, 32] (or [M, 16]).
        sdf: Values of all distance grids [m], float32 [S].

    Returns:
        ``distance`` [N, M] in m, negative inside, and the unit ``normal`` [N, M, 3] out of the
        collider. Exact for analytic shapes; trilinear inside a distance grid and a lower bound
        outside it. NaN for a point that is not finite and, on CUDA, for a row that is no collider.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape or device; on the CPU also a row that is no collider.
    """
    op = "collider_distance"
    check_tensor(op, "position", position, shape=(None, 3))
    rows = check_rows(op, colliders, sdf, position)
    distance, normal = torch.ops.gsfluent.collider_distance(position.detach(), rows, sdf)
    return distance, normal


def advance_colliders(
    colliders: Tensor,
    dt: float,
    *,
    impulse: Tensor | None = None,
    torque: Tensor | None = None,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
) -> Tensor:
    """Move colliders over a time step.

    Position and orientation follow velocity and angular velocity. A collider with mass first loses
    the impulse and torque that it gave to the bodies (momentum is exchanged exactly), falls with
    ``gravity`` and then turns freely with its angular momentum. Keep the rows in float64: one step
    is a small change of a large number.

    Args:
        colliders: Rows, shape [M, 32].
        dt: Time step [s].
        impulse: What :func:`gsfluent.ops.grid_update` returned [N s], float64 [M, 3].
        torque: About each collider's point [N m s], float64 [M, 3].
        gravity: Acceleration of colliders with mass [m/s^2], three numbers.

    Returns:
        The rows after the step, [M, 32].

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape or device.
    """
    op = "advance_colliders"
    check_tensor(op, "colliders", colliders, shape=(None, COLLIDER_COLUMNS))
    if len(gravity) != 3:
        raise ValueError(f"{op}: gravity must have three numbers, got {len(gravity)}")
    if not abs(float(dt)) < math.inf:
        raise ValueError(f"{op}: dt must be a finite number, got {dt}")
    given = colliders.new_zeros((colliders.shape[0], 6), dtype=torch.float64)
    for name, value, start in (("impulse", impulse, 0), ("torque", torque, 3)):
        if value is None:
            continue
        shape = (colliders.shape[0], 3)
        check_tensor(op, name, value, shape=shape, dtype=torch.float64)
        if value.device != colliders.device:
            raise ValueError(f"{op}: {name} must be on {colliders.device}, got {value.device}")
        given[:, start : start + 3] = value
    return torch.ops.gsfluent.advance_colliders(
        colliders.detach(), given, float(dt), *(float(g) for g in gravity)
    )


fakes(
    collider_distance=lambda x, rows, sdf: (
        x.new_empty((len(x), len(rows))),
        x.new_empty((len(x), len(rows), 3)),
    ),
    advance_colliders=lambda colliders, *rest: torch.empty_like(colliders),
)
