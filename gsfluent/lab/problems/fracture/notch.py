"""Single-edge notch tension: how fast a crack runs."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator

import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import nacc, parameters, sheet, wave_speed
from gsfluent.lab.world.walls import between_planes
from gsfluent.pipeline.matter.crack_band import crack_band

YOUNG, POISSON, DENSITY = 1e9, 0.2, 1000.0
WIDTH, HEIGHT, NOTCH = 1.0, 0.5, 0.2


def rayleigh_speed(shear_wave: float, poisson: float) -> float:
    """Speed of a Rayleigh wave [m/s], by Viktorov's fit (within half a percent)."""
    return shear_wave * (0.862 + 1.14 * poisson) / (1.0 + poisson)


@dataclasses.dataclass(frozen=True)
class Run:
    """A crack on its way through a strip."""

    fastest: float  # largest speed over a tenth of the width, over the Rayleigh speed
    mean: float  # speed between 0.3 and 0.8 of the width, over the Rayleigh speed
    spread: float  # largest distance of a broken point from the line of the notch [dx]


def run_crack(cells: int, *, pull: float = 1e-4, crossings: float = 7.0) -> Run:
    """Pull a notched strip apart at constant speed and follow the tip of its crack.

    Args:
        cells: Cells per metre; softening follows
        :func:`gsfluent.pipeline.matter.crack_band.crack_band`.
        pull: Speed of each grip over the speed of a pressure wave. Above about 2e-4 the whole strip
            reaches its strength before the crack has passed: that is no crack speed any more.
        crossings: Duration in travel times along the width.
    """
    dx, softening = 1.0 / cells, 0.005
    row = nacc(
        YOUNG, POISSON, DENSITY, friction=2.0, cohesion=0.1, hardening=math.asinh(0.005) / softening
    )
    row, alpha = crack_band(
        row, torch.tensor(-softening, dtype=torch.float64), dx=dx, reference=1.0 / 32.0
    )
    c = wave_speed(row)
    limit = rayleigh_speed(math.sqrt(float(row[0]) / DENSITY), POISSON)
    points = sheet([0.0, -0.5 * HEIGHT], [WIDTH, HEIGHT], dx)
    points = points[(points[:, 0] > NOTCH) | (points[:, 1].abs() > 1.01 * dx)]
    x, y = points[:, 0], points[:, 1]
    grip = y.abs() > 0.5 * HEIGHT - 2.0 * dx
    speed = (pull * c * y[grip].sign()).to(torch.float32)
    velocity = torch.zeros_like(points)
    velocity[:, 1] = 2.0 * pull * c * y / HEIGHT

    def hold(world: World, _dt: float) -> None:
        v = world.velocity.clone()
        v[grip, 1] = speed.to(v)
        world.velocity = v

    volume = 0.25 * dx**3
    world = World(
        points, velocity, volume=volume, dx=dx, law=torch.tensor([0, 1]),
        params=torch.stack([parameters(YOUNG, POISSON, DENSITY), row]),
        material=(y.abs() < 0.125).int(), alpha=torch.full_like(x, float(alpha)),
        colliders=between_planes(dx), dtype=torch.float32, force=hold,
    )  # fmt: skip
    trace: list[tuple[float, float]] = []

    def watch(w: World) -> None:
        broken = (w.alpha >= 0.0).cpu() & (x > NOTCH)
        trace.append((w.time, float(x[broken].max()) if bool(broken.any()) else NOTCH))

    world.run(seconds=crossings * WIDTH / c, each=watch)

    def arrival(place: float) -> float:
        return next((t for t, tip in trace if tip >= place), math.inf)

    def over(low: float, high: float) -> float:
        begin, end = arrival(low), arrival(high)
        if not math.isfinite(end):
            return 0.0
        return (high - low) / (end - begin) / limit if end > begin else math.inf

    places = [0.25 + 0.1 * i for i in range(6)]
    broken = (world.alpha >= 0.0).cpu() & (x > NOTCH)
    return Run(
        fastest=max(over(a, b) for a, b in itertools.pairwise(places)),
        mean=over(0.3, 0.75),
        spread=float(y[broken].abs().max()) / dx if bool(broken.any()) else math.nan,
    )


@problem(tier="fast")
def single_edge_notch() -> Iterator[Result]:
    """Single-edge notch: the crack is slower than a Rayleigh wave, and as fast on both grids."""
    cells = (32, 48)
    runs = [run_crack(n) for n in cells]
    source = "Freund 1990, Dynamic Fracture Mechanics; Viktorov's c_R"
    for n, run in zip(cells, runs, strict=True):
        # a crack that never ran has speed 0 and must not pass
        error = run.fastest if run.mean > 0.0 else math.inf
        yield compare(
            f"fastest crack over c_R, {n} cells", run.fastest, 1.0, error=error, tolerance=1.0,
            source=source, note=f"mean {run.mean:.2f} c_R, within {run.spread:.2f} dx of the line",
        )  # fmt: skip
    change = abs(runs[-1].mean - runs[0].mean) / max(runs[0].mean, 1e-9)
    yield compare(
        "change of the mean speed between the grids", change, tolerance=0.2,
        source="crack-band scaling",
    )  # fmt: skip
