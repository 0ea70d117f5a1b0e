"""Liquid: the collapse of a water column, and a tank that comes to rest."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, sheet
from gsfluent.lab.world.walls import between_planes, wall

FLUID = 4
GRAVITY = 9.81


def water(sound: float) -> Tensor:
    """Row of an inviscid liquid whose speed of sound at rest is ``sound`` [m/s], [8]."""
    row = torch.zeros(8, dtype=torch.float64)
    row[1], row[6], row[7] = 1000.0 * sound**2, 1000.0, 7.0
    return row


def hydrostatic(depth: Tensor, row: Tensor) -> Tensor:
    """Strain of a liquid under ``depth`` [m] of itself, [N, 6]."""
    bulk, density, gamma = float(row[1]), float(row[6]), float(row[7])
    ratio = (1.0 + gamma * density * GRAVITY * depth / bulk) ** (-1.0 / gamma)
    strain = torch.zeros(depth.shape[0], 6, dtype=torch.float64)
    strain[:, :3] = (ratio ** (2.0 / 3.0) - 1.0)[:, None]
    return strain


def dam_front(cells: int, *, until: float, bed: str) -> list[tuple[float, float]]:
    """Front of a water column twice as high as wide after the gate is gone.

    Returns:
        Pairs of ``t sqrt(2 g / a)`` and ``z / a``, one per step; the front is where the last two
        square cells of liquid begin, so that a splash of few points is none.
    """
    base = 1.0
    dx = base / cells
    points = sheet([0.0, 0.0], [base, 2.0 * base], dx)
    row = water(10.0 * math.sqrt(2.0 * GRAVITY * base))
    volume = 0.25 * dx**3
    world = World(
        points, [0.0, 0.0, 0.0], volume=volume, dx=dx, law=FLUID, params=row,
        colliders=[*between_planes(dx), wall(0), wall(1, mode=bed)], gravity=(0.0, -GRAVITY, 0.0),
        dtype=torch.float32, strain=hydrostatic(2.0 * base - points[:, 1], row),
    )  # fmt: skip
    scale = math.sqrt(2.0 * GRAVITY / base)
    trace: list[tuple[float, float]] = []

    def watch(w: World) -> None:
        front = float(torch.topk(w.position[:, 0], 8).values[-1])
        trace.append((w.time * scale, front / base))

    world.run(seconds=until / scale, each=watch)
    return trace


def martin_moyce(data: Path) -> list[tuple[float, float]]:
    """Measured fronts for n^2 = 2, both widths: pairs of ``t sqrt(2 g / a)`` and ``z / a``."""
    rows: list[tuple[float, float]] = []
    for path in sorted((data / "reference" / "dam_break").glob("martin_moyce_*n2_2*.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            rows.extend((float(t), float(z)) for t, z in list(csv.reader(file))[1:])
    return sorted(rows)


@problem(tier="fast")
def dam_break(data: Path | None = None) -> list[Result]:
    """Dam break: front of a collapsing column against Martin and Moyce 1952.

    Args:
        data: Folder with ``reference/dam_break``; default is the environment's GSFLUENT_DATA,
            else ``shared/data`` beside the checkout.

    Raises:
        FileNotFoundError: The measured fronts are not there.
    """
    beside = Path(__file__).resolve().parents[5] / "shared" / "data"
    root = data or Path(os.environ.get("GSFLUENT_DATA", beside))
    measured = [pair for pair in martin_moyce(root) if pair[0] <= 3.4]
    if not measured:
        raise FileNotFoundError(
            f"dam_break: no measured fronts under {root}; set GSFLUENT_DATA to the data folder"
        )
    source = "Martin and Moyce 1952, fig. 3, n^2 = 2, a = 1.125 and 2.25 in"

    def judged(bed: str, kind: str) -> Result:
        trace = dam_front(12, until=3.4, bed=bed)
        fronts = [next((z for t, z in trace if t >= time), math.nan) for time, _ in measured]
        errors = [front / place - 1.0 for front, (_, place) in zip(fronts, measured, strict=True)]
        return compare(
            f"front, {kind}: largest relative error", max(errors, key=abs), tolerance=0.1,
            source=source, note=f"mean {sum(errors) / len(errors):+.3f}",
        )  # fmt: skip

    return [judged("sticky", "no-slip bed"), judged("slip", "slip bed")]


@problem(tier="fast")
def liquid_at_rest() -> list[Result]:
    """Tank at rest: a step of water comes to a level surface with hydrostatic pressure under it.

    Half of a tank 1 m wide is filled to 0.625 m, half to 0.375 m; four seconds with damping, then
    means over 0.7 s without.
    """
    cells = 12
    dx, depth = 1.0 / cells, 0.5
    points = torch.cat([sheet([0.0, 0.0], [0.5, 0.625], dx), sheet([0.5, 0.0], [0.5, 0.375], dx)])
    row = water(8.0 * math.sqrt(GRAVITY * depth))
    volume = 0.25 * dx**3
    damping = [2.0]

    def damp(world: World, dt: float) -> None:
        world.velocity = world.velocity * (1.0 - damping[0] * dt)

    world = World(
        points, [0.0, 0.0, 0.0], volume=volume, dx=dx, law=FLUID,
        params=row, colliders=[*between_planes(dx), wall(0), wall(0, 1.0, -1), wall(1)],
        gravity=(0.0, -GRAVITY, 0.0), dtype=torch.float32, force=damp,
    )  # fmt: skip
    world.run(seconds=4.0)
    damping[0] = 0.0
    layers = int(depth / dx) - 1
    tops: list[Tensor] = []
    pressures: list[Tensor] = []

    def watch(w: World) -> None:
        x, y = w.position[:, 0].double().cpu(), w.position[:, 1].double().cpu()
        pressure = -w.stress[:, :3].double().mean(dim=1).cpu()
        column = (x / dx).long().clamp(0, cells - 1)
        layer = (y / dx).long().clamp(0, layers)
        tops.append(torch.zeros(cells, dtype=torch.float64).scatter_reduce(0, column, y, "amax"))
        total = torch.zeros(layers + 1, dtype=torch.float64).index_add(0, layer, pressure)
        pressures.append(total / torch.bincount(layer, minlength=layers + 1))

    world.run(seconds=0.7, each=watch)
    top = torch.stack(tops).mean(dim=0)
    height = (torch.arange(layers, dtype=torch.float64) + 0.5) * dx
    scale = float(row[6]) * GRAVITY * depth
    off = torch.stack(pressures).mean(dim=0)[:layers] / scale - (depth - height) / depth
    level = float((top - top.mean()).abs().max()) / dx
    inside, beside = float(off[2:].abs().max()), float(off[:2].abs().max())
    surface = float(top.mean()) + 0.25 * dx
    source = "hydrostatics"
    return [
        compare("unevenness of the surface", level, tolerance=1.0, unit="dx", source=source),
        compare(
            "height of the surface", surface, depth, error=abs(surface - depth) / depth,
            tolerance=0.02, unit="m", source="volume is kept",
        ),
        compare("pressure over rho g H, two cells up", inside, tolerance=0.05, source=source),
        compare("pressure over rho g H at the floor", beside, tolerance=0.1, source=source),
    ]  # fmt: skip


class Column(NamedTuple):
    """Pressure in a column of water at rest, off hydrostatics; all over rho g H."""

    own: float  # scatter of the points' own in the lowest cell
    noise: float  # scatter of the average in the lowest cell
    fixed: float  # the same, averaged over 1/8 m
    inside: float  # scatter of the average over the rest below the surface
    off: float  # mean of the average in the lowest cell
    slope: float  # of the average over depth, less 1


def water_column(cells: int, seed: int = 0) -> Column:
    """A column 1 m high and four cells wide, of points off their lattice, after 0.6 s.

    Means over ten states, without damping. The average is that of :func:`ops.kernel_average` over
    two cells, where nothing else is said.

    Args:
        cells: Height in cells.
        seed: Of the places of the points.
    """
    dx = 1.0 / cells
    generator = torch.Generator().manual_seed(seed)
    points = box([0.0, 0.0, 0.0], [4.0 * dx, 1.0, 4.0 * dx], 0.5 * dx)
    shift = torch.rand(points.shape, generator=generator, dtype=torch.float64) - 0.5
    points = points + 0.25 * dx * shift
    row = water(10.0 * math.sqrt(GRAVITY))
    world = World(
        points, [0.0, 0.0, 0.0], volume=0.125 * dx**3, dx=dx, law=FLUID, params=row,
        colliders=[*between_planes(dx, axes=(0, 2), width=4.0 * dx), wall(1)],
        gravity=(0.0, -GRAVITY, 0.0), dtype=torch.float32,
        strain=hydrostatic(1.0 - points[:, 1], row),
    )  # fmt: skip
    world.run(seconds=0.6)
    scale = float(row[6]) * GRAVITY
    found = []
    for _ in range(10):
        world.run(steps=37)
        place = world.position.double()
        depth = 1.0 - place[:, 1]
        own = -world.stress[:, :3].double().mean(dim=1) / scale
        mean, fixed = (
            ops.kernel_average(own, position=place, mass=world.scene.mass.double(), length=length)
            for length in (2.0 * dx, 0.125)
        )
        lowest = depth > 1.0 - dx
        rest = (depth < 1.0 - 2.0 * dx) & (depth > 0.1)
        off = mean - depth
        lever = depth[rest] - depth[rest].mean()
        found.append(
            torch.stack([
                (own - depth)[lowest].std(), off[lowest].std(),
                (fixed - depth)[lowest].std(), off[rest].std(), off[lowest].mean(), 
                (lever * off[rest]).sum() / (lever**2).sum(),
            ])
        )  # fmt: skip
    return Column(*torch.stack(found).mean(dim=0).tolist())


@problem(tier="fast")
def hydrostatic_column() -> list[Result]:
    """Column of water at rest: scatter and slope of its pressure, as points and as an average."""
    coarse, middle, fine = (
        Column(*torch.tensor([water_column(cells, seed) for seed in range(3)]).mean(0).tolist())
        for cells in (8, 16, 32)
    )
    each = "8, 16, 32 cells: {:.4f}, {:.4f}, {:.4f}"
    own = each.format(coarse.own, middle.own, fine.own)
    noise = each.format(coarse.noise, middle.noise, fine.noise)
    inside = each.format(coarse.inside, middle.inside, fine.inside)
    source = "hydrostatics"
    return [
        compare(
            "noise of the averaged pressure at the floor, 16 cells", middle.noise, tolerance=0.02,
            source=source, note=f"{noise}; the points' own, which nodes do not feel "
            f"(docs/theory/liquids.md), {own}",
        ),
        compare(
            "the same averaged over 1/8 m, 32 cells over 16", fine.fixed / middle.fixed,
            tolerance=0.5, source="falls with dx", note=each.format(
                coarse.fixed, middle.fixed, fine.fixed),
        ),
        compare(
            "noise of the averaged pressure above, 16 cells", middle.inside, tolerance=0.02,
            source=source, note=inside,
        ),
        compare("slope over depth, 16 cells", 1.0 + middle.slope, 1.0, tolerance=0.02,
                source=source),
        compare(
            "mean pressure of the lowest cell, too much, 16 cells", middle.off, tolerance=0.05,
            source=source, note=each.format(coarse.off, middle.off, fine.off)
            + "; the floor's nodes have points on one side only",
        ),
    ]  # fmt: skip
