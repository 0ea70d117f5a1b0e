"""The stage that learns numbers of materials from motion: starts, two grids, bands, words."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.fit.laws import NUMBERS, choose_laws, known_laws
from gsfluent.pipeline.fit.parameters import (
    FINER,
    LIMITS,
    OFFSET,
    VECTORS,
    Parameter,
    Unknowns,
    flat,
)
from gsfluent.pipeline.fit.points import FieldTask, divided, run_field
from gsfluent.pipeline.fit.solve import SHARES
from gsfluent.pipeline.fit.task import (
    EXTRAPOLATION,
    Runner,
    Task,
    one_by_one,
    run_task,
    unknowns_of,
)
from gsfluent.pipeline.fit.together import together
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress
from gsfluent.scene.scene import Scene
from gsfluent.targets.target import Target

Array = NDArray[np.float64]

LEFT = EXTRAPOLATION[1]
"""Of what the finer grid moves a number by, the part that may be left: a standard deviation. How
far the change goes on is learnt as one share for all; that of a number is its own, and off by as
much as was believed of it beforehand."""
NUISANCE = (OFFSET, FINER)
"""What is learnt of the grid, not of the scene."""
CORRELATED = 0.9
PRIOR_SHARE = 0.5
STILL = 0.01


@dataclasses.dataclass(frozen=True)
class Found:
    """What was learnt.

    Attributes:
        values: By key, a number or three.
        sd: Standard deviations: of ``log`` numbers in decades, else in their unit.
        correlation: Pairs of numbers beyond 0.9, with it.
        unidentified: Key -> words; these values are bounds or beliefs, not findings.
        scene: The scene with what was learnt.
        report: All of it as plain values, for ``fit.json``.
        laws: The law taken for each object and part, where laws were tried.
    """

    values: dict[str, Any]
    sd: dict[str, Any]
    correlation: dict[tuple[str, str], float]
    unidentified: dict[str, str]
    scene: Scene
    report: dict[str, Any]
    laws: dict[str, str] = dataclasses.field(default_factory=dict)


class Fit(Stage):
    """Learns numbers of materials, velocities and spins from motion.

    Levenberg-Marquardt on forward differences of the resident solver, in stages of time, from
    several starts, on two grids (docs/theory/fit.md). Bodies that break cannot be learnt.

    Args:
        learn: What: ``{"melon": {"young_modulus": (1e4, 1e7), "velocity": True}}``, or a list of
            ``melon.young_modulus``; of a part ``melon/rind.young_modulus``.
        laws: Tried for every object and part; what foretells frames that no search has seen is
            taken, with its numbers (:mod:`gsfluent.pipeline.fit.laws`).
        per: ``part``; or ``point``: one object's law may be another at every place, and its parts
            are found (:mod:`gsfluent.pipeline.fit.points`). They are regions of the solid of the
            scene that comes back.
        nodes: Of ``point``: along each axis.
        starts: How many; the first is the scene as it is.
        cells: Cells along the longest side of the largest body.
        grids: 2 to see on a grid twice as fine what the first does wrong, and take it out; or 1.
        offset: Learn how much higher than the floor the grid holds matter up, too.
        seed: Of the starts.
        runner: Does the searches; when absent one after the other, or on a GPU as one run.
        device: Where the solver runs, in float64; pictures and algebra are done on the CPU.

    Raises:
        InputError: A number out of range, or an unknown law.
    """

    name = "fit"

    def __init__(
        self,
        learn: Mapping[str, Mapping[str, Any]] | Sequence[str] = (),
        *,
        laws: Sequence[str] = (),
        per: str = "part",
        nodes: int = 3,
        starts: int = 4,
        cells: int = 8,
        grids: int = 2,
        offset: bool = True,
        seed: int = 0,
        runner: Runner | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(seed=seed)
        for name, value, low, high in (
            ("starts", starts, 1, 64), ("cells", cells, 4, 256), ("grids", grids, 1, 2),
        ):  # fmt: skip
            if not low <= value <= high:
                raise InputError(f"fit: {name} is {value}", f"give a number from {low} to {high}")
        self.learn, self.starts, self.cells, self.grids = learn, starts, cells, grids
        self.laws, self.per, self.nodes = known_laws(laws), per, nodes
        if per not in ("part", "point") or (per == "point" and len(self.laws) < 2):
            raise InputError(
                f"fit: {len(self.laws)} laws per {per}", "give part, or point with two laws or more"
            )
        if not 2 <= nodes <= 8:
            raise InputError(f"fit: nodes is {nodes}", "give a number from 2 to 8")
        self.offset, self.device = offset, str(torch.device(device))
        plain = together if self.device.startswith("cuda") else one_by_one
        self.runner: Runner = plain if runner is None else runner

    def forward(self, scene: Scene, target: Target, *, progress: Progress | None = None) -> Found:
        """Learn.

        Args:
            scene: The start: geometry, density, gravity and floor are believed.
            target: What was seen, from :mod:`gsfluent.targets`.
            progress: Told after each search.

        Raises:
            InputError: What is to be learnt cannot be, or the target does not meet the scene.
            RunError: No start can be run.
        """
        dx = grid_spacing(scene, self.cells)
        if self.laws and self.per == "point":
            return self._per_point(scene, target, dx, progress)
        if self.laws:
            chosen = choose_laws(
                scene, target, self.learn, self.laws, starts=self.starts, seed=self.seed, dx=dx,
                runner=self.runner, progress=progress, grids=self.grids, offset=self.offset,
                device=self.device,
            )  # fmt: skip
            found = self._last(chosen.scene, target, chosen.unknowns, chosen.start, dx)
            made = conclude(chosen.scene, chosen.unknowns, found, [])
            return dataclasses.replace(
                made, laws=chosen.laws, report={**made.report, "laws": chosen.report}
            )
        unknowns = unknowns_of(scene, self.learn, grids=self.grids, offset=self.offset)
        total = 1 + (self.starts if self.starts > 1 else 0)
        begin, tries = unknowns.start.tolist(), list[dict[str, Any]]()
        if self.starts > 1:
            # of all starts two stages; the best goes on
            starts = unknowns.starts(self.starts, self.seed)
            tries = self.runner(
                run_task,
                [Task(scene, target, unknowns, s.tolist(), dx, SHARES[:2], self.grids,
                      device=self.device) for s in starts],
            )  # fmt: skip
            report_progress(progress, self.starts, total, "starts")
            good = [t for t in tries if np.isfinite(t["cost"])]
            if not good:
                raise RunError("fit: no start can be run", "nothing", "start from other numbers")
            begin = min(good, key=lambda t: t["cost"])["free"]
        found = self._last(scene, target, unknowns, begin, dx)
        report_progress(progress, total, total, f"{self.cells} cells")
        return conclude(scene, unknowns, found, tries)

    def _per_point(
        self, scene: Scene, target: Target, dx: float, progress: Progress | None
    ) -> Found:
        """Where which law holds; then the numbers of the regions by a search of their own."""
        asked = flat(self.learn)
        field = FieldTask(
            scene, target, self.laws, asked, dx, self.grids, self.offset, self.nodes, self.device
        )  # fmt: skip
        mixed = self.runner(run_field, [field])[0]
        report_progress(progress, 1, 2, "laws per point")
        made = divided(scene, self.laws, mixed["values"], self.nodes)
        body, first = made.bodies[0], made.bodies[0].material.law
        labels = {first: body.name, **{p.name: f"{body.name}/{p.name}" for p in body.parts}}
        learn = [key for key in asked if key.partition(".")[2] in VECTORS]
        learn += [f"{label}.{name}" for law, label in labels.items() for name in NUMBERS[law]]
        unknowns = unknowns_of(made, learn, grids=self.grids, offset=self.offset)
        begin = unknowns.start.copy()
        for p, part in zip(unknowns.parameters, unknowns.slices().values(), strict=True):
            value = mixed["values"].get(p.key, mixed["values"].get(f"{body.name}.{p.name}"))
            if value is not None:
                begin[part] = p.free(np.ravel(value).tolist())
        # moduli that were shared begin wrong: all frames at once would trade them for yield
        found = self._last(made, target, unknowns, begin.tolist(), dx)
        report_progress(progress, 2, 2, f"{self.cells} cells")
        solid = body.solid
        assert solid is not None and solid.regions is not None
        size = np.bincount(solid.regions[solid.occupancy].cpu().numpy(), minlength=len(self.laws))
        share = {law: float(n / size.sum()) for law, n in zip(self.laws, size, strict=True)}
        concluded = conclude(made, unknowns, found, [])
        report = {**concluded.report, "shares": share, "mixed_rms": mixed["rms"]}
        laws = {label: law for law, label in labels.items()}
        return dataclasses.replace(concluded, laws=laws, report=report)

    def _last(
        self, scene: Scene, target: Target, unknowns: Unknowns, begin: list[float], dx: float
    ) -> dict[str, Any]:
        """The search that counts."""
        task = Task(
            scene, target, unknowns, begin, dx, SHARES, self.grids, device=self.device
        )  # fmt: skip
        found: dict[str, Any] = self.runner(run_task, [task])[0]
        if not np.isfinite(found["cost"]):
            raise RunError("fit: the best start cannot be run", "nothing", "use fewer cells")
        return found


def of_the_grid(unknowns: Unknowns, free: Array, information: Any) -> Array:
    """By how much the change to the finer grid has moved each number: linearised, free [P]."""
    part = unknowns.slices().get(FINER)
    if part is None:
        return np.zeros(len(unknowns))
    rows = np.arange(len(unknowns)) != part.start
    normal = np.asarray(information)
    whole = normal + np.diag(1.0 / unknowns.spread**2)
    moved = np.zeros(len(unknowns))
    pull = normal[rows, part.start] * free[part.start]
    moved[rows] = -np.linalg.solve(whole[np.ix_(rows, rows)], pull)
    return moved


def conclude(
    scene: Scene, unknowns: Unknowns, found: Mapping[str, Any], tries: Sequence[Mapping[str, Any]]
) -> Found:
    """Values, bands and words of a search.

    Args:
        scene: As it was.
        unknowns: What was learnt.
        found: The search.
        tries: The starts.
    """
    free = np.asarray(found["free"])
    covariance = np.asarray(found["covariance"])
    grid = of_the_grid(unknowns, free, found["information"])
    went = max(abs(float(unknowns.values(free).get(FINER, 1.0))), 0.5)
    sd = np.sqrt(np.diag(covariance) + (LEFT * grid / went) ** 2)
    slope = np.abs(unknowns.slope(free))
    share = np.clip(np.diag(covariance) / unknowns.spread**2, 0.0, 1.0)
    deviation = np.sqrt(np.diag(covariance))
    related = covariance / np.outer(deviation, deviation)
    labels, values = unknowns.labels(), unknowns.values(free)
    slices = unknowns.slices()
    pairs = {
        (labels[i], labels[j]): float(related[i, j])
        for i in range(len(labels))
        for j in range(i)
        if abs(related[i, j]) > CORRELATED
    }
    spread, unidentified, numbers = {}, {}, {}
    for p in unknowns.parameters:
        part = slices[p.key]
        here = sd[part] * slope[part]
        spread[p.key] = float(here[0]) if p.size == 1 else [float(v) for v in here]
        limit = LIMITS.get(p.kind, np.inf)
        if p.key not in NUISANCE and (here.max() > limit or share[part].max() > PRIOR_SHARE):
            unidentified[p.key] = _bound(p, free[part], sd[part])
        numbers[p.key] = {
            "value": values[p.key],
            "sd": spread[p.key],
            "sd_noise": (deviation[part] * slope[part]).tolist(),
            "grid": (grid[part] * slope[part]).tolist(),
            "prior_share": float(share[part].max()),
        }
    strain = float(found["strain"])
    warnings = []
    if strain < STILL:
        warnings.append(f"no strain exceeds 1 % ({strain:.2%}): stiffness hardly shows")
    learnt = {k: v for k, v in values.items() if k not in unidentified and k not in NUISANCE}
    report = {
        "parameters": numbers,
        "unidentified": unidentified,
        "correlated": [[*pair, value] for pair, value in pairs.items()],
        "least_informed": least_informed(found["information"], labels, unknowns),
        "warnings": warnings,
        "rms": found["rms"],
        "per_frame": found["per_frame"],
        "strain": strain,
        "grids": found["grids"],
        "starts": [
            {"cost": t["cost"], "values": unknowns.values(np.asarray(t["free"]))} for t in tries
        ],
    }
    return Found(values, spread, pairs, unidentified, with_values(scene, learnt), report)


def _bound(p: Parameter, free: Array, sd: Array) -> str:
    """What can be said of a number that was not found."""
    low, high = p.value(free - 1.28 * sd), p.value(free + 1.28 * sd)
    if p.size == 1:
        return f"between {low[0]:.3g} and {high[0]:.3g} in four of five cases"
    return "within " + ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))


def least_informed(information: Any, labels: Sequence[str], unknowns: Unknowns) -> list[str]:
    """Directions of which the motion says less than what was believed before, in words."""
    spread = unknowns.spread
    scaled = np.asarray(information) * np.outer(spread, spread)  # 1: as much as the prior
    size, axes = np.linalg.eigh(scaled)
    words = []
    for amount, axis in zip(size, axes.T, strict=True):
        if amount >= 10.0:
            break
        main = [int(i) for i in np.argsort(-np.abs(axis)) if abs(axis[i]) > 0.3]
        flip = np.sign(axis[main[0]])
        told = [f"{labels[i]} {'up' if flip * axis[i] > 0 else 'down'}" for i in main]
        words.append(f"{' with '.join(told)}: {amount:.2g} times as sure as before")
    return words


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """A scene with other numbers of its bodies and parts."""
    made = Scene.__new__(Scene)
    made.__dict__.update(scene.__dict__)
    made.bodies = []
    for body in scene.bodies:
        mine = _of(values, body.name)
        motion: dict[str, Any] = {
            k: tuple(mine.pop(k)) for k in ("velocity", "angular_velocity") if k in mine
        }
        material = dataclasses.replace(body.material, **mine) if mine else body.material
        parts = tuple(
            dataclasses.replace(part, overrides={**part.overrides, **of_part})
            if (of_part := _of(values, f"{body.name}/{part.name}"))
            else part
            for part in body.parts
        )
        made.bodies.append(dataclasses.replace(body, material=material, parts=parts, **motion))
    return made


def _of(values: Mapping[str, Any], place: str) -> dict[str, Any]:
    """What is said of an object or of a part."""
    split = ((key.partition("."), value) for key, value in values.items())
    return {field: value for (name, _, field), value in split if name == place}
