"""Conduction, melting and contact of bars of material points, against closed forms."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.driver import place
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box
from gsfluent.materials.heat import thermal
from gsfluent.pipeline.heat.touching import touching

LENGTH = 0.06  # of the bar [m]
DENSITY = 1000.0
CELLS = (6, 12, 24)  # along the bar, two points each


class Bar:
    """A bar of points along x, ``cells`` of a grid long and half of one wide."""

    def __init__(self, cells: int, row: Tensor) -> None:
        self.spacing = 0.5 * LENGTH / cells
        points = box([0.0, 0.0, 0.0], [LENGTH, self.spacing, self.spacing], self.spacing)
        self.links, self.faces = (part.to(place()) for part in
                                  ops.lattice_links(points, self.spacing))  # fmt: skip
        self.x = points[:, 0].double().to(place())
        self.mass = torch.full_like(self.x, DENSITY * self.spacing**3)
        self.rows = row[None].to(self.x)

    def warmed(self, enthalpy: Tensor, seconds: float, held: float | None = None) -> Tensor:
        """Enthalpy after a time; the end at x = 0 lies on a wall held at ``held``."""
        wall = None
        if held is not None:
            at = (self.x < self.spacing).nonzero()[:, 0]
            wall = at, torch.full_like(self.x[at], held)
        return ops.conduct(
            enthalpy, mass=self.mass, links=self.links, spacing=self.spacing, rows=self.rows,
            dt=seconds, wall=wall,
        )  # fmt: skip


def conduction_error(cells: int) -> float:
    """Largest error of a cosine that fades in a bar of ice closed at both ends, over its rest."""
    ice = thermal("ice").row()
    bar = Bar(cells, ice)
    wave = math.pi / LENGTH
    rate = float(ice[0] / (DENSITY * ice[2])) * wave**2
    start = torch.cos(wave * bar.x)
    cold = ops.enthalpy(-10.0 + start, rows=bar.rows)
    after = bar.warmed(cold, 1.0 / rate)
    left = ops.temperature(after, rows=bar.rows)[0] + 10.0
    return float((left - math.exp(-1.0) * start).abs().max()) / math.exp(-1.0)


def stefan_number(warm: float, row: Tensor) -> float:
    """Lambda of Neumann's front ``2 lambda sqrt(a t)`` of a solid at its melting point."""
    stefan = float(row[3]) * warm / float(row[6])
    low, high = 0.0, 3.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        grown = math.sqrt(math.pi) * middle * math.exp(middle**2) * math.erf(middle)
        low, high = (middle, high) if grown < stefan else (low, middle)
    return low


def stefan_front(cells: int) -> float:
    """Front of ice at 0 degrees C that melts on a wall of 20, half of the bar, over Neumann's."""
    ice = thermal("ice").row()
    bar, warm = Bar(cells, ice), 20.0
    number = stefan_number(warm, ice)
    seconds = (0.25 * LENGTH / number) ** 2 / float(ice[1] / (DENSITY * ice[3]))
    start = torch.zeros_like(bar.x)
    after = bar.warmed(start, seconds, held=warm)
    share = ops.temperature(after, rows=bar.rows)[1]
    return float(share.mean()) * LENGTH / (0.5 * LENGTH)


@problem(tier="fast")
def heat_conduction() -> Iterator[Result]:
    """A cosine of temperature fades in a bar: error at 12 cells, and the order of convergence."""
    coarse, middle, fine = (conduction_error(cells) for cells in CELLS)
    source = "Fourier: exp(-a pi^2 t / L^2)"
    yield compare("error of a fading cosine, 12 cells", middle, tolerance=0.01, source=source)
    yield compare(
        "order of conduction, 6 to 24 cells", math.log2(coarse / fine) / 2.0, 2.0, tolerance=0.05,
        source=source, note=f"errors {coarse:.2g}, {middle:.2g}, {fine:.2g}",
    )  # fmt: skip


@problem(tier="fast")
def melting_front() -> Iterator[Result]:
    """Stefan's problem: ice at 0 degrees C on a wall of 20 degrees C, half of a bar melted."""
    for cells in CELLS:
        yield compare(
            f"front of melting ice / Neumann's, {cells} cells", stefan_front(cells), 1.0,
            tolerance=0.03, source="Neumann's solution (Carslaw and Jaeger 1959, 11.2)",
        )  # fmt: skip


def _around(points: Tensor, edge: float) -> Tensor:
    """Points of a bar and of the eight beside it, its own first."""
    steps = sorted(((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)), key=lambda s: s != (0, 0))
    return torch.cat([points + points.new_tensor([0.0, edge * i, edge * j]) for i, j in steps])


def half_bars(cells: int, shift: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float, float]:
    """Cold ice and warm wax that touch: what is between them, before heat has reached their ends.

    The bars go on periodically across.

    Args:
        cells: Length of each bar in cells of two points.
        shift: Of the points of the wax across the bars, in spacings.

    Returns:
        Temperature of the contact over the closed form's, both from the cold side; heat that passed
        over the closed form's; and heat that was lost over what passed.
    """
    half, wide = 0.5 * LENGTH, 4
    spacing = 0.5 * half / cells
    edge = wide * spacing
    parts, links = [], []
    for number, offset in enumerate(((-half, 0.0, 0.0), (0.0, *(spacing * s for s in shift)))):
        points = box(list(offset), [half, edge, edge], spacing)
        links.append(ops.lattice_links(points, spacing)[0] + number * len(points))
        parts.append(points.double())
    count = len(parts[0])
    pairs, share = touching(_around(parts[0], edge), _around(parts[1], edge), spacing)
    own = pairs[:, 0] < count
    links.append(pairs[own] % count + pairs.new_tensor([0, count]))
    part = torch.ones(sum(map(len, links)), dtype=torch.float64)
    part[-len(links[-1]) :] = share[own]
    rows = torch.stack([thermal("ice").row(), thermal("wax").row()]).double()
    material = torch.arange(2, dtype=torch.int32).repeat_interleave(count)
    cold, warm = -20.0, 20.0
    start = torch.where(material == 0, cold, warm).double()
    heat = ops.enthalpy(start, rows=rows, material=material)
    mass = torch.full_like(heat, DENSITY * spacing**3)
    k, c = rows[:, 0], rows[:, 2]
    seconds = float((0.2 * half) ** 2 / (k / (DENSITY * c)).max())
    after = ops.conduct(
        heat.to(place()), mass=mass.to(place()), links=torch.cat(links).to(place()),
        spacing=spacing, rows=rows.to(place()), material=material.to(place()), dt=seconds,
        share=part.to(place()),
    ).cpu()  # fmt: skip
    now = ops.temperature(after, rows=rows, material=material)[0]
    x = torch.cat(parts)[:, 0]
    beside = [now[(x.abs() < spacing) & (material == side)].mean() for side in (0, 1)]
    between = float((k[0] * beside[0] + k[1] * beside[1]) / (k[0] + k[1]))
    effusivity = (k * DENSITY * c).sqrt()
    wanted = float((effusivity[0] * cold + effusivity[1] * warm) / effusivity.sum())
    gained = (mass * (after - heat))[material == 0].sum()
    series = effusivity[0] * effusivity[1] / effusivity.sum()
    passed = float(series) * (warm - cold) * 2.0 * math.sqrt(seconds / math.pi) * edge**2
    lost = float((mass * (after - heat)).sum())
    return (between - cold) / (wanted - cold), float(gained) / passed, abs(lost) / passed


@problem(tier="fast")
def heat_contact() -> Iterator[Result]:
    """Half a bar of ice and half a bar of wax touch, lattices in line and shifted."""
    source = "two half-spaces: weighted by sqrt(k rho c) (Carslaw and Jaeger 1959, 2.15)"
    for how, shift in (("in line", (0.0, 0.0)), ("shifted", (0.5, 0.3))):
        _, coarse, _ = half_bars(12, shift)
        between, passed, lost = half_bars(24, shift)
        yield compare(
            f"temperature of the contact / closed form, {how}, 24 cells", between, 1.0,
            tolerance=0.001, source=source, note="from the cold side",
        )  # fmt: skip
        yield compare(
            f"heat that passed / closed form, {how}, 24 cells", passed, 1.0, tolerance=0.01,
            source=source, note=f"{coarse:.4f} at 12 cells",
        )  # fmt: skip
        yield compare(f"heat lost / passed, {how}", lost, tolerance=1e-12, source="conservation")
