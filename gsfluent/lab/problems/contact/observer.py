"""One impact as different observers and different steps see it: what is lost must not differ."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsfluent.lab.problems.contact.contact import SPACING, YOUNG, bodies
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import ball, parameters


def lost(
    radius: float, boost: float = 0.0, cfl: float = 0.5, seed: int = 0, whole: float = 0.5
) -> tuple[float, int]:
    """Head-on balls, 0.1 c each, in a random direction and place: share of the energy lost.

    Args:
        radius: Of the balls [dx].
        boost: Speed at which the observer moves, in a random direction [c].
        cfl: Courant number, at most ``whole``. Below, points keep what shorter steps would lose.
        seed: Of place, directions and points.
        whole: Courant number of steps by which points keep nothing.

    Returns:
        Loss of kinetic and elastic energy, and the steps taken.
    """
    speed, poisson = 0.1, 0.2
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(2, 3, generator=generator, dtype=torch.float64)
    along, seen = torch.nn.functional.normalize(draw - 0.5, dim=1)
    points = ball([0.0, 0.0, 0.0], radius, SPACING)
    apart = (radius + 0.75) * along
    parts = [points - apart + draw[0], points + apart + draw[0]]
    frame = boost * seen
    world = bodies(
        parts, [speed * along + frame, -speed * along + frame], cfl=cfl,
        flip=1.0 - cfl / whole, params=parameters(YOUNG, poisson, 1.0),
    )  # fmt: skip
    mass = world.scene.mass.cpu()

    def energy() -> float:
        v = world.velocity.double().cpu() - frame
        inner = 0.125 * (mass * (world.affine.double().cpu() ** 2).sum(dim=(1, 2))).sum()
        return float(0.5 * (mass * (v * v).sum(dim=1)).sum() + inner) + world.elastic()

    start = energy()
    world.run(1.0 / speed + 6.0 * radius * (2.0 * speed) ** -0.2 + 10.0)
    return 1.0 - energy() / start, world.steps


@problem(tier="fast")
def moving_observer() -> Result:
    """The impact of two elastic balls seen by an observer who moves at the speed of sound."""
    rest, steps = lost(4.0)
    moved, more = lost(4.0, boost=1.0)
    return compare(
        "energy lost / lost to one at rest", moved / rest, 1.0, tolerance=0.03,
        source="Galilei", note=f"R = 4 dx, 0.1 c each; {rest:.3f} of it is lost; {steps} and "
        f"{more} steps",
    )  # fmt: skip


@problem(tier="slow")
def smaller_steps() -> Iterator[Result]:
    """The impact of two elastic balls by steps half as long, from two lengths on."""
    for whole in (0.5, 0.25):
        long, short = (
            sum(lost(6.0, cfl=cfl, seed=seed, whole=whole)[0] for seed in range(3))
            for cfl in (whole, 0.5 * whole)
        )
        yield compare(
            f"energy lost at CFL {0.5 * whole:g} / at {whole:g}", short / long, 1.0,
            tolerance=0.05, source="loss is no matter of steps",
            note="R = 6 dx, 0.1 c each, mean of 3 placements; points keep half of what a step "
            "takes (docs/theory/mpm.md)",
        )  # fmt: skip
