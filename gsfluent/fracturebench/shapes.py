"""Lattices and shells of points that stand for bodies, and the plain scene around them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .scene import Floats, Scene


def spacing(dx: float, per_cell: int) -> float:
    """Distance of neighbouring points [m] at so many points per cell (a cube number)."""
    return dx / round(per_cell ** (1.0 / 3.0))


def box(lower: Sequence[float], size: Sequence[float], dx: float, per_cell: int) -> Floats:
    """Points of a cubic lattice at the centres of the cells that fill a box, [N, 3].

    Args:
        lower: Lower corner [m].
        size: Edge lengths [m], rounded to whole numbers of spacings.
        dx: Node spacing [m].
        per_cell: Points per cell: 1, 8, 27 or 64.
    """
    step = spacing(dx, per_cell)
    axes = [
        low + (np.arange(max(1, round(edge / step))) + 0.5) * step
        for low, edge in zip(lower, size, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def ball(radius: float, dx: float, per_cell: int) -> tuple[Floats, Floats]:
    """Points on concentric shells about the origin, [N, 3], and the volume of each [m^3], [N].

    Shells give a smooth surface; what is cut out of a lattice is rough by half a spacing, and two
    such bodies touch with steps. Every shell is a spiral of equal areas (Fibonacci lattice).

    Args:
        radius: [m]; the number of shells is rounded, and their thickness follows from it.
        dx: Node spacing [m].
        per_cell: Points per cell.
    """
    step = spacing(dx, per_cell)
    shells = max(1, round(radius / step))
    step = radius / shells
    points, volumes = [], []
    for shell in range(shells):
        inner, middle = shell * step, (shell + 0.5) * step
        count = max(4, round(4.0 * math.pi * (shell + 0.5) ** 2))
        i = np.arange(count) + 0.5
        # every shell is turned on from the one below, so that no two lie in step
        turn = math.pi * (1.0 + math.sqrt(5.0)) * i + 2.4 * shell
        z = 1.0 - 2.0 * i / count
        flat = np.sqrt(1.0 - z * z)
        points.append(middle * np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1))
        whole = 4.0 / 3.0 * math.pi * ((inner + step) ** 3 - inner**3)
        volumes.append(np.full(count, whole / count))
    return np.concatenate(points), np.concatenate(volumes)


def elastic(young: float, poisson: float, density: float) -> dict[str, Any]:
    """A row of ``materials`` of the elastic law; moduli in Pa, density in kg/m^3."""
    return {
        "law": "elastic", "young_modulus": young, "poisson_ratio": poisson, "density": density,
    }  # fmt: skip


def plane(
    axis: int, at: float = 0.0, side: float = 1.0, kind: str = "slip", friction: float = 0.0
) -> dict[str, Any]:
    """A collider: the half space below (``side`` 1) or above (-1) ``at`` [m] on an axis."""
    point, normal = [0.0] * 3, [0.0] * 3
    point[axis], normal[axis] = at, side
    return {"point": point, "normal": normal, "kind": kind, "friction": friction}


def free(
    name: str,
    points: Floats,
    velocity: Floats | Sequence[float],
    dx: float,
    per_cell: int,
    times: Floats,
    materials: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    *,
    affine: Floats | None = None,
    material: NDArray[Any] | None = None,
    body: NDArray[Any] | None = None,
    volume: Floats | None = None,
    facts: Mapping[str, Any] | None = None,
    **more: Any,
) -> Scene:
    """A scene whose every array that is not given is plain: one material, one body, no walls.

    Args:
        name: Of the case.
        points: [m], [N, 3].
        velocity: [m/s], [N, 3] or three numbers.
        dx: Node spacing [m].
        per_cell: Points per cell; the volume of each unless ``volume`` says so.
        times: [s], [T].
        materials: One row, or several.
        affine: [1/s], [N, 3, 3].
        material: Row of each point, [N].
        body: Of each point, [N].
        volume: [m^3], [N].
        facts: What the judge needs.
        **more: Further fields of :class:`~gsfluent.fracturebench.scene.Scene`.
    """
    n = points.shape[0]
    rows = (materials,) if isinstance(materials, Mapping) else tuple(materials)

    def index(value: NDArray[Any] | None) -> Any:
        return np.zeros(n, np.int32) if value is None else np.asarray(value).astype(np.int32)

    return Scene(
        name=name, dx=float(dx), x=points, v=np.array(np.broadcast_to(velocity, (n, 3)), float),
        volume=np.full(n, dx**3 / per_cell) if volume is None else volume, material=index(material),
        body=index(body), affine=np.zeros((n, 3, 3)) if affine is None else affine, times=times,
        materials=rows, facts=dict(facts or {}), **more,
    )  # fmt: skip
