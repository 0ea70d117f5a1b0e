"""Ensemble statistics: how to compare fracture, which has no pointwise truth.

Where a body breaks depends on the smallest things, such as where its points lie between the nodes
of a grid. Eight runs of the same scene, moved by a part of a node spacing (walls and all, so that
nothing physical changes), give different pieces. So a method is judged by figures of which the
run-to-run spread is known: momentum history, lost energy, distribution of the mass over pieces, and
share of neighbours that parted. The spread of the reference's own runs is the band. Inside it no
method is better than another: :func:`distance` clips the error there and says so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from .pieces import REACH, neighbours, parted, piece_masses
from .registry import Case
from .run import Run
from .scene import Floats, Scene, SceneError

MEASURES = (
    "momentum history",
    "dissipated energy",
    "mass over pieces, KS",
    "pairs parted for good",
)
_STEADY = 0.1
"""Share of the samples, at the end, in all of which what has parted for good is apart."""


def jitter(scene: Scene, seed: int) -> Scene:
    """The same scene somewhere else: moved by less than a node spacing on each axis.

    Points and colliders move together, so that only their place on a method's grid changes. Seed 0
    does not move it.

    Args:
        scene: The scene.
        seed: Of the shift, from 0.

    Raises:
        SceneError: The seed is negative.
    """
    if seed < 0:
        raise SceneError(f"{scene.name}: seeds count from 0, got {seed}")
    if seed == 0:
        return scene
    shift = np.random.default_rng(seed).random(3) * scene.dx
    walls = tuple(
        {**wall, "point": [float(p + s) for p, s in zip(wall["point"], shift, strict=True)]}
        for wall in scene.colliders
    )
    facts = {**scene.facts, "shift": shift.tolist()}
    return dataclasses.replace(scene, x=scene.x + shift, colliders=walls, facts=facts)


def spacing(scene: Scene) -> float:
    """Mean distance of neighbouring points at rest [m]: the cube root of a point's volume."""
    return float(np.cbrt(np.median(scene.volume)))


def stored_energy(scene: Scene, stress: Floats) -> Floats:
    """Elastic energy of each point by its stress, of small strains [J], [T, N].

    ``V (p^2 / (2 kappa) + s : s / (4 mu))`` with the deviator s.
    """
    young = np.array([float(m["young_modulus"]) for m in scene.materials])
    nu = np.array([float(m["poisson_ratio"]) for m in scene.materials])
    mu = (young / (2.0 * (1.0 + nu)))[scene.material]
    kappa = (young / (3.0 * (1.0 - 2.0 * nu)))[scene.material]
    p = stress[..., :3].mean(axis=-1)
    normal = stress[..., :3] - p[..., None]
    square = (normal**2).sum(axis=-1) + 2.0 * (stress[..., 3:] ** 2).sum(axis=-1)
    return np.asarray(scene.volume * (0.5 * p * p / kappa + 0.25 * square / mu))


def lost_energy(scene: Scene, run: Run) -> Floats:
    """Energy that is neither kinetic, nor of weight, nor (by the stresses, if any) stored [J], [T].

    Counted from the start of the scene; without stresses what is stored counts as lost until it
    comes back.
    """
    mass, g = scene.mass, np.asarray(scene.gravity)

    def total(x: Floats, v: Floats) -> float:
        return float(0.5 * (mass * (v * v).sum(axis=1)).sum() - mass @ (x @ g))

    start = total(scene.x, scene.v)
    left = np.array([total(x, v) for x, v in zip(run.x, run.v, strict=True)])
    if run.stress is not None:
        left = left + stored_energy(scene, run.stress).sum(axis=1)
    return start - left


@dataclasses.dataclass(frozen=True)
class Figures:
    """What is compared of one run; no figure depends on the number of points."""

    momentum: Floats  # total momentum over that of the start, [T, 3]
    lost: Floats  # lost energy over the kinetic energy of the start, [T]
    pieces: Floats  # masses of the pieces at the end as shares of the whole, rising, [F]
    parted: float  # share of the neighbour pairs at rest that have parted for good

    def plain(self) -> dict[str, Any]:
        """As plain values for JSON, with six digits; pieces of equal mass are counted."""
        masses, counts = np.unique(np.round(self.pieces, 7), return_counts=True)
        return {
            "momentum": [[float(f"{v:.6g}") for v in row] for row in self.momentum],
            "lost": [float(f"{v:.6g}") for v in self.lost],
            "pieces": [[float(m), int(c)] for m, c in zip(masses, counts, strict=True)],
            "parted": float(f"{self.parted:.6g}"),
        }

    @classmethod
    def of_plain(cls, plain: dict[str, Any]) -> Figures:
        """Read what :meth:`plain` gave."""
        rows = np.array(plain["pieces"], dtype=np.float64).reshape(-1, 2)
        pieces = np.repeat(rows[:, 0], rows[:, 1].astype(np.int64))
        return cls(
            np.array(plain["momentum"], dtype=np.float64),
            np.array(plain["lost"], dtype=np.float64),
            pieces / pieces.sum(),  # they were rounded
            float(plain["parted"]),
        )


def figures(scene: Scene, run: Run) -> Figures:
    """The figures of a run.

    Raises:
        SceneError: The run does not answer the scene, broke off, or the scene starts at rest.
    """
    run.matched(scene)
    if not run.finite:
        raise SceneError(f"{run.method}, {scene.name}: the run broke off; it has no statistics")
    mass = scene.mass
    start = np.linalg.norm(mass @ scene.v)
    energy = 0.5 * float((mass * (scene.v**2).sum(axis=1)).sum())
    if not start > 0.0:
        raise SceneError(f"{scene.name}: statistics need a scene that starts with momentum")
    pairs = neighbours(scene.x, REACH * spacing(scene))
    if pairs.shape[0] == 0:
        raise SceneError(f"{scene.name}: no two points are neighbours")
    steady = max(1, round(_STEADY * run.times.shape[0]))
    gone = np.ones(pairs.shape[0], dtype=bool)
    for x in run.x[-steady:]:
        gone &= parted(scene.x, x, pairs)
    return Figures(
        np.einsum("n,tni->ti", mass, run.v) / start,
        lost_energy(scene, run) / energy,
        piece_masses(mass, pairs[~gone]),
        float(gone.mean()),
    )


def mass_ks(first: Floats, second: Floats) -> float:
    """Kolmogorov-Smirnov distance of two distributions of mass over the masses of pieces, 0 to 1.

    ``F(m)`` is the share of the whole mass in pieces no heavier than m, which is what sieves weigh.

    Args:
        first: Masses of pieces [any unit, the same for both], [F].
        second: The same of the other, [G].
    """
    places = np.union1d(first, second)

    def below(masses: Floats) -> Floats:
        ordered = np.sort(masses)
        sums = np.concatenate([[0.0], np.cumsum(ordered)]) / ordered.sum()
        return sums[np.searchsorted(ordered, places, side="right")]

    return float(np.abs(below(first) - below(second)).max())


@dataclasses.dataclass(frozen=True)
class Member:
    """One run of an ensemble with its figures."""

    scene: Scene
    run: Run
    figures: Figures


def ensemble(
    case: Case, dx: float, per_cell: int, seeds: Iterable[int], run_case: Callable[[Scene], Run]
) -> list[Member]:
    """Run a case once for every seed.

    Raises:
        SceneError: A run broke off.
    """
    base = case.build(dx, per_cell)
    members = []
    for seed in seeds:
        scene = jitter(base, seed)
        run = run_case(scene)
        found = figures(scene, run)
        # what only the figures needed is large and goes
        members.append(Member(scene, dataclasses.replace(run, damage=None, stress=None), found))
    return members


def _apart(one: Figures, others: Sequence[Figures]) -> Floats:
    """Distance of one run from the mean of others in each of MEASURES, [4]."""
    momentum = np.mean([o.momentum for o in others], axis=0)
    lost = np.mean([o.lost for o in others], axis=0)
    if one.momentum.shape != momentum.shape:
        raise SceneError(
            f"figures over {one.momentum.shape[0]} times cannot be compared with "
            f"{momentum.shape[0]}: take the times of the case"
        )
    return np.array(
        [
            np.sqrt(((one.momentum - momentum) ** 2).sum(axis=1).mean()),
            # while waves still run to and fro, energy is stored, and not every method says how much
            np.sqrt(((one.lost - lost) ** 2)[lost.shape[0] // 2 :].mean()),
            mass_ks(one.pieces, np.concatenate([o.pieces for o in others])),
            abs(one.parted - np.mean([o.parted for o in others])),
        ]
    )


@dataclasses.dataclass(frozen=True)
class Distance:
    """How far a method is from the reference in one measure."""

    value: float  # median over the runs of the method of the distance to the reference's mean
    # run-to-run band: the largest distance of a run of the reference from the mean of its other
    # runs
    band: float

    @property
    def within(self) -> bool:
        """Whether it is inside the band, where nothing can be told from the reference."""
        return self.value <= self.band

    @property
    def error(self) -> float:
        """The error that may be claimed: never less than the band."""
        return max(self.value, self.band)

    def __str__(self) -> str:
        """What may be said of it."""
        if self.within:
            return f"within the band ({self.band:.3g})"
        return f"{self.value:.3g} (band {self.band:.3g})"


def distance(
    reference: Sequence[Figures | Member], other: Sequence[Figures | Member]
) -> dict[str, Distance]:
    """Distance of an ensemble from the reference's, with the run-to-run band, per measure.

    The two are like for like: a run against the mean of several. That of the reference leaves the
    run itself out of the mean.

    Args:
        reference: Runs of the reference setting, at least three.
        other: Runs of the method, one or more.

    Raises:
        SceneError: Too few runs, or of other times.
    """
    ours = [m.figures if isinstance(m, Member) else m for m in reference]
    theirs = [m.figures if isinstance(m, Member) else m for m in other]
    if len(ours) < 3 or not theirs:
        raise SceneError(
            f"a band needs three runs of the reference and one of the method, got {len(ours)} "
            f"and {len(theirs)}"
        )
    spread = [_apart(one, ours[:i] + ours[i + 1 :]) for i, one in enumerate(ours)]
    values = np.median([_apart(one, ours) for one in theirs], axis=0)
    bands = np.max(spread, axis=0)
    return {
        name: Distance(float(v), float(b))
        for name, v, b in zip(MEASURES, values, bands, strict=True)
    }
