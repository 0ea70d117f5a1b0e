"""One brittle impact as it lies on the grid, as it is watched, and by its steps: same outcome?"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gsfluent.lab.problems.contact.contact import SPACING, YOUNG, bodies
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import ball, parameters, rotation

RADIUS, FINE = 4.0, 8.0  # of the balls [dx]
SPEED = 0.1  # of each [P-wave speed]
NACC = 1
SEEDS = range(8)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Of an impact: share of the kinetic energy that is lost, and of the matter that broke."""

    lost: float
    broken: float


@functools.cache  # as it lies, at rest and by usual steps it is asked for by every problem
def brittle_impact(
    seed: int,
    *,
    shifted: bool = False,
    turned: bool = False,
    boost: float = 0.0,
    cfl: float = 0.5,
    radius: float = RADIUS,
    touch: bool = False,
) -> Outcome:
    """Two brittle balls head on, weaker here and there as the seed says.

    Args:
        seed: Of the weakness, and of the place, the turn and the observer's direction.
        shifted: Whether all is shifted by part of a cell.
        turned: Whether all is turned, lattice and motion.
        boost: Speed of the observer [P-wave speed].
        cfl: Courant number, at most 0.5. Below, points keep what shorter steps would lose.
        radius: Of the balls [dx].
        touch: Whether points of the balls push each other, and not nodes.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    points = ball([0.0, 0.0, 0.0], radius, SPACING)
    alpha = -0.02 * (0.85 + 0.3 * draw(2 * len(points)))
    place, axis, seen = draw(3), draw(3) - 0.5, draw(3) - 0.5
    turn = rotation(axis.tolist(), math.pi * float(draw(1))) if turned else torch.eye(3).double()
    away = (radius + 0.75) * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    parts = [(points + side * away) @ turn.T + (place if shifted else 0.0) for side in (-1.0, 1.0)]
    frame = boost * seen / seen.norm()
    ahead = turn[:, 0]
    world = bodies(
        parts, [SPEED * ahead + frame, -SPEED * ahead + frame], law=NACC, alpha=alpha, cfl=cfl,
        flip=1.0 - 2.0 * cfl, params=parameters(YOUNG, 0.2, 1.0, c2=1.85, c3=0.3, c4=10.0, c5=0.05),
        dtype=torch.float64, surface=0.5 if touch else None, touch=touch,
    )  # fmt: skip
    mass = world.scene.mass.cpu()

    def energy() -> float:
        v = world.velocity.double().cpu() - frame
        inner = 0.25 * (world.affine.double().cpu() ** 2).sum(dim=(1, 2))
        return float(0.5 * (mass * ((v * v).sum(dim=1) + inner)).sum()) + world.elastic()

    start = energy()
    world.run(1.0 / SPEED + 6.0 * radius * (2.0 * SPEED) ** -0.2 + 10.0)
    broken = float((mass * (world.alpha.cpu() >= 0.0)).sum() / mass.sum())
    return Outcome(1.0 - energy() / start, broken)


def mean(outcomes: list[Outcome]) -> tuple[Outcome, Outcome]:
    """Mean and standard deviation of outcomes."""
    rows = torch.tensor([[o.lost, o.broken] for o in outcomes], dtype=torch.float64)
    return Outcome(*rows.mean(dim=0).tolist()), Outcome(*rows.std(dim=0).tolist())


def compared(
    what: str,
    other: list[Outcome],
    plain: list[Outcome],
    tolerance: float,
    source: str,
    radius: float = RADIUS,
) -> Iterator[Result]:
    """Rows of the means of two sets of impacts."""
    (one, band), (two, _) = mean(plain), mean(other)
    for name, a, b, scatter in (
        ("energy lost", one.lost, two.lost, band.lost),
        ("broken share", one.broken, two.broken, band.broken),
    ):
        yield compare(
            f"{name}, {what}", b / a, 1.0, tolerance=tolerance, source=source,
            note=f"mean of {len(plain)} seeds {a:.3f}, from seed to seed {scatter:.3f}; R = "
            f"{radius:g} dx, 0.1 c each",
        )  # fmt: skip


@problem(tier="fast")
def brittle_observer() -> Iterator[Result]:
    """Two brittle balls seen by an observer who moves at half of the speed of sound."""
    plain = [brittle_impact(seed) for seed in SEEDS]
    moved = [brittle_impact(seed, boost=0.5) for seed in SEEDS]
    yield from compared("to a moving observer / at rest", moved, plain, 0.03, "Galilei")


_PLACES = (("shifted", False), ("turned and shifted", True))
"""Where else the balls lie: by part of a cell, and whether turned, too."""


@functools.cache
def _placed(radius: float, touch: bool) -> tuple[list[Outcome], dict[str, list[Outcome]]]:
    """Impacts as they lie, and those that lie elsewhere."""
    impact = functools.partial(brittle_impact, radius=radius, touch=touch)
    moved = {
        name: [impact(seed, shifted=True, turned=turned) for seed in SEEDS]
        for name, turned in _PLACES
    }
    return [impact(seed) for seed in SEEDS], moved


def _off(radius: float, touch: bool, name: str) -> tuple[float, float]:
    """Mean loss and broken share there over those as they lie, less 1."""
    plain, moved = _placed(radius, touch)
    (one, _), (two, _) = mean(plain), mean(moved[name])
    return two.lost / one.lost - 1.0, two.broken / one.broken - 1.0


@problem(tier="fast")
def brittle_placement() -> Iterator[Result]:
    """Two brittle balls that push by points, shifted by part of a cell and turned: energy lost."""
    plain, moved = _placed(RADIUS, True)
    for name, _ in _PLACES:
        rows = compared(
            f"{name} / as they lie, points push", moved[name], plain, 0.05,
            "space has no places; the grid has",
        )  # fmt: skip
        energy = next(rows)
        lost, broken = (1.0 + off for off in _off(RADIUS, False, name))
        note = f"where nodes push {lost:.3f}, and {broken:.3f} of what broke"
        yield dataclasses.replace(energy, note=f"{energy.note}; {note}")


@problem(tier="slow")
def brittle_placement_points() -> Iterator[Result]:
    """The same on twice the cells, also what broke: there 4 cells are too few."""
    plain, moved = _placed(FINE, True)
    for name, _ in _PLACES:
        yield from compared(
            f"{name} / as they lie, points push", moved[name], plain, 0.05,
            "space has no places; the grid has", FINE,
        )  # fmt: skip
        coarse, fine = (_off(radius, True, name)[1] for radius in (RADIUS, FINE))
        yield compare(
            f"what it breaks more or less, {name}, {FINE:g} cells over {RADIUS:g}",
            abs(fine / coarse), tolerance=0.5, source="falls with dx",
            note=f"{coarse:+.3f} and {fine:+.3f}",
        )  # fmt: skip


@problem(tier="fast")
def brittle_steps() -> Iterator[Result]:
    """Two brittle balls by steps half as long."""
    plain = [brittle_impact(seed) for seed in SEEDS]
    short = [brittle_impact(seed, cfl=0.25) for seed in SEEDS]
    yield from compared("at CFL 0.25 / at 0.5", short, plain, 0.05, "loss is no matter of steps")
