"""Heat of material points: conduction along the lattice they were sampled on, melting, freezing.

The state is the enthalpy of each point; temperature and liquid share follow from it, so that a
front of melting needs no tracking. Plain PyTorch. Equations: docs/theory/heat.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent._check import check_tensor

HEAT_COLUMNS = (
    "conductivity", "liquid_conductivity", "heat_capacity", "liquid_heat_capacity",
    "melting_point", "melting_range", "latent_heat",
)  # fmt: skip
"""Columns of ``rows``: W/(m K) and J/(kg K), each solid and liquid; degrees C; K; J/kg."""
SAFE = 0.9
"""Length of an inner step over the longest one that is stable."""


def _rows(op: str, rows: Tensor, material: Tensor | None, count: int) -> tuple[Tensor, ...]:
    """Columns of ``rows`` of every point, [N] each."""
    check_tensor(op, "rows", rows, shape=("M", len(HEAT_COLUMNS)))
    wrong = ~torch.isfinite(rows) | (rows <= 0.0)
    wrong[:, 4] = ~torch.isfinite(rows[:, 4])
    wrong[:, 5:] = ~torch.isfinite(rows[:, 5:]) | (rows[:, 5:] < 0.0)
    if bool(wrong.any()):
        row, column = (int(i) for i in wrong.nonzero()[0])
        raise ValueError(
            f"{op}: rows[{row}] {HEAT_COLUMNS[column]} must be finite and "
            f"{'not negative' if column > 4 else 'positive'}, got {float(rows[row, column]):g}"
        )
    if material is None:
        if rows.shape[0] not in (1, count):
            raise ValueError(f"{op}: without material, rows must be 1 or {count}")
        return rows.expand(count, -1).unbind(dim=1)
    check_tensor(op, "material", material, shape=(count,), dtype=torch.int32)
    if material.numel() and not 0 <= int(material.min()) <= int(material.max()) < rows.shape[0]:
        raise ValueError(f"{op}: material must hold rows 0 to {rows.shape[0] - 1}")
    return rows[material.long()].unbind(dim=1)


def temperature(
    enthalpy: Tensor, *, rows: Tensor, material: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Temperature and liquid share of points.

    Args:
        enthalpy: Heat above that of the solid at its melting point [J/kg], [N].
        rows: Thermal parameters, [M, 7], see :data:`HEAT_COLUMNS`.
        material: Row of each point, int32 [N]; default: row 0, or row i of N.

    Returns:
        Temperature [degrees C], [N], and share of the liquid, 0 to 1, [N].

    Raises:
        ValueError: A shape, parameter or row is wrong.

    Gradient: enthalpy and rows. Source: Voller and Cross 1981 (enthalpy method).
    """
    check_tensor("temperature", "enthalpy", enthalpy, shape=("N",))
    _, _, solid, liquid, point, span, latent = _rows(
        "temperature", rows, material, enthalpy.shape[0]
    )
    safe = torch.where(latent > 0.0, latent, 1.0)
    share = torch.where(latent > 0.0, enthalpy / safe, (enthalpy > 0.0).to(enthalpy))
    share = share.clamp(0.0, 1.0)
    below, above = enthalpy.clamp(max=0.0) / solid, (enthalpy - latent).clamp(min=0.0) / liquid
    return point + below + torch.where(latent > 0.0, share * span, 0.0) + above, share


def enthalpy(
    temperature: Tensor, *, rows: Tensor, material: Tensor | None = None, share: float = 0.0
) -> Tensor:
    """Enthalpy of points at a temperature [J/kg], [N]: the inverse of :func:`temperature`.

    Args:
        temperature: [degrees C], [N].
        rows: See :func:`temperature`.
        material: See :func:`temperature`.
        share: Share of the liquid of what is exactly at a melting point without a range.

    Raises:
        ValueError: A shape, parameter or row is wrong.
    """
    check_tensor("enthalpy", "temperature", temperature, shape=("N",))
    _, _, solid, liquid, point, span, latent = _rows(
        "enthalpy", rows, material, temperature.shape[0]
    )
    melts = latent > 0.0
    wide = torch.where(melts, span, 0.0)
    over = temperature - point
    inside = torch.where(wide > 0.0, over / torch.where(wide > 0.0, wide, 1.0), over.sign())
    inside = torch.where((wide == 0.0) & (over == 0.0), share, inside.clamp(0.0, 1.0))
    return over.clamp(max=0.0) * solid + inside * latent + (over - wide).clamp(min=0.0) * liquid


def lattice_cells(points: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Cells of points that lie one in each cell of a lattice along the axes.

    Args:
        points: Positions at rest in the axes of the lattice [m], [N, 3]; each may be off the middle
            of its cell by less than half of the spacing, a quarter by the sampling of solids.
        spacing: Edge of a cell [m].

    Returns:
        Numbers of the cells, int64 [N, 3], and how far each point is off its middle [m], float64
        [N, 3].

    Raises:
        ValueError: A wrong shape or spacing.
    """
    check_tensor("lattice_cells", "points", points, shape=("N", 3))
    if not (math.isfinite(spacing) and spacing > 0.0):
        raise ValueError(f"lattice_cells: spacing must be positive, got {spacing}")
    turns = points.double() / spacing
    angle = 2.0 * math.pi * turns
    middle = torch.atan2(angle.sin().mean(dim=0), angle.cos().mean(dim=0)) / (2.0 * math.pi)
    cell = torch.round(turns - middle)
    return cell.long(), spacing * (turns - middle - cell)


def lattice_links(points: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Neighbours of points that lie one in each cell of a lattice along the axes.

    Args:
        points: As for :func:`lattice_cells`.
        spacing: Edge of a cell [m].

    Returns:
        Pairs of points whose cells share a face, int64 [L, 2], and the faces of each cell that have
        no other behind them, int64 [N].

    Raises:
        ValueError: A wrong shape or spacing, or two points in one cell.
    """
    cell, _ = lattice_cells(points, spacing)
    cell = cell - cell.amin(dim=0) + 1
    size = cell.amax(dim=0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = torch.argsort(key)
    ordered = key[order]
    if bool((ordered[1:] == ordered[:-1]).any()):
        raise ValueError("lattice_links: two points lie in one cell of the lattice")
    found = []
    for step in (int(size[1] * size[2]), int(size[2]), 1):
        at = torch.searchsorted(ordered, key + step).clamp(max=len(key) - 1)
        rows = (ordered[at] == key + step).nonzero()[:, 0]
        found.append(torch.stack([rows, order[at[rows]]], dim=1))
    links = torch.cat(found)
    return links, 6 - torch.bincount(links.reshape(-1), minlength=len(key))


class _Ends:
    """Sums over the links that end at each point, in the order of the links.

    A GPU adds into one place in any order; there each point picks its own addends.
    """

    def __init__(self, links: Tensor, count: int) -> None:
        self.a, self.b = links.unbind(dim=1)
        self.count, self.addends = count, None
        if links.is_cuda and count:
            ends = torch.cat([self.a, self.b])
            degree = torch.bincount(ends, minlength=count)
            place = torch.arange(int(degree.max()), device=links.device)[:, None]
            listed = torch.argsort(ends, stable=True)
            listed = torch.cat([listed, listed.new_full((len(place) + 1,), len(ends))])
            slot = degree.cumsum(0) - degree + place
            self.addends = torch.where(place < degree, listed[slot], len(ends))

    def sums(self, at_a: Tensor, at_b: Tensor) -> Tensor:
        """Of what each link gives to its first and to its second end, [N]."""
        if self.addends is None:
            total = at_a.new_zeros(self.count).index_add(0, self.a, at_a)
            return total.index_add(0, self.b, at_b)
        return torch.cat([at_a, at_b, at_a.new_zeros(1)])[self.addends].sum(dim=0)


class _Sides(NamedTuple):
    """Conductivity of the half of each point that faces something warmer, or colder, [N]."""

    warm: Tensor
    cold: Tensor

    def facing(self, at: Tensor, warmer: Tensor) -> Tensor:
        """That of some points, [K], which face something warmer or not, bool [K]."""
        return torch.where(warmer, self.warm[at], self.cold[at])


def conduct(
    enthalpy: Tensor,
    *,
    mass: Tensor,
    links: Tensor,
    spacing: float,
    rows: Tensor,
    dt: float,
    material: Tensor | None = None,
    wall: tuple[Tensor, Tensor] | None = None,
    air: tuple[Tensor, float, float] | None = None,
    share: Tensor | None = None,
) -> Tensor:
    """Enthalpy of points after heat has flowed for a time.

    Between two points flows ``k spacing (T_j - T_i)`` [W], k the harmonic mean of both; what one
    gives the other takes. A point that melts at one temperature is liquid towards what is
    warmer. A wall that touches a face is half a spacing away. Explicit steps of
    a stable length, as many as ``dt`` takes.

    Args:
        enthalpy: [J/kg], [N], see :func:`temperature`.
        mass: Masses [kg], [N].
        links: Pairs that heat flows between, int64 [L, 2], as :func:`lattice_links` finds them.
        spacing: Distance of linked points [m].
        rows: Thermal parameters, [M, 7].
        dt: Time [s].
        material: Row of each point, int32 [N].
        wall: Points a face of which lies on something held at a temperature, int64 [W], and that
            temperature [degrees C], [W].
        air: Open faces of each point, [N]; temperature of the air [degrees C]; and coefficient of
            heat transfer [W/(m^2 K)].
        share: Share of a face that each link goes through, [L]; default: all of it.

    Returns:
        The enthalpy after ``dt``, [N].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, parameter, row or time is wrong.

    Determinism: sums are in the order of the links, on both devices.
    Gradient: enthalpy, mass, rows, and the temperature of the wall.
    """
    op = "conduct"
    check_tensor(op, "enthalpy", enthalpy, shape=("N",))
    count = enthalpy.shape[0]
    check_tensor(op, "mass", mass, shape=(count,), like=enthalpy)
    check_tensor(op, "links", links, shape=("L", 2), dtype=torch.int64)
    if not (math.isfinite(dt) and dt >= 0.0 and spacing > 0.0):
        raise ValueError(f"{op}: dt must not be negative and spacing positive, got {dt}, {spacing}")
    solid_k, liquid_k, solid_c, liquid_c, _, span, _ = _rows(op, rows, material, count)
    ends, (a, b) = _Ends(links, count), links.unbind(dim=1)
    if share is not None:
        check_tensor(op, "share", share, shape=(len(links),), like=enthalpy)
    with torch.no_grad():
        most = torch.maximum(solid_k, liquid_k) * spacing
        part = torch.ones_like(most[a]) if share is None else share
        through = ends.sums(part * most[b], part * most[a])
        through = torch.maximum(through, ends.sums(part, part) * most)
        if wall is not None:
            through = through.index_add(0, wall[0], 2.0 * most[wall[0]])
        if air is not None:
            through = through + air[0] * spacing**2 * air[2]
        rate = float((through / (mass * torch.minimum(solid_c, liquid_c))).max())
    steps = max(1, math.ceil(dt * rate / SAFE))
    for _ in range(steps):
        warm, liquid = temperature(enthalpy, rows=rows, material=material)
        mean = solid_k + liquid * (liquid_k - solid_k)
        sides = _Sides(
            torch.where((span == 0.0) & (liquid > 0.0) & (liquid < 1.0), liquid_k, mean),
            torch.where((span == 0.0) & (liquid > 0.0) & (liquid < 1.0), solid_k, mean),
        )
        drop = warm[b] - warm[a]
        k_a, k_b = sides.facing(a, drop > 0.0), sides.facing(b, drop < 0.0)
        flow = 2.0 * k_a * k_b / (k_a + k_b) * spacing * drop
        if share is not None:
            flow = share * flow
        power = ends.sums(flow, -flow)
        if wall is not None:
            at, held = wall
            drop = held - warm[at]
            power = power.index_add(0, at, 2.0 * sides.facing(at, drop > 0.0) * spacing * drop)
        if air is not None:
            faces, around, coefficient = air
            if coefficient > 0.0:
                k = torch.where(warm < around, sides.warm, sides.cold)
                series = 1.0 / (1.0 / coefficient + 0.5 * spacing / k)
                power = power + faces * spacing**2 * series * (around - warm)
        enthalpy = enthalpy + dt / steps * power / mass
    return enthalpy
