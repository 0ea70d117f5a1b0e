"""The ladder of settings: a base over the node spacings, and one knob changed at a time.

Not the full product: every knob is turned on two rungs of the base ladder, which shows where on
the chart it moves a run. What is changed by no knob stands at gsfluent's defaults.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from gsfluent.errors import InputError
from gsfluent.fracturebench.registry import Case, cases
from gsfluent.fracturebench.scene import Scene

CASES = (
    "bar", "bar_wave", "beam", "spin", "two_material_bar", "drop", "collide", "oblique",
    "pull_apart", "shatter",
)  # fmt: skip
"""What is charted by default: a case for each kind of motion, one panel each. Others by name."""
OURS, TEXTBOOK = "gsfluent", "textbook"
DEMO_COURANT = 0.09
"""c dt / dx at which the demos of PhysGaussian run: median of its six configurations, 0.366, 0.110,
0.367, 0.028, 0.070 and 0.013 (their p-wave speed, their dt, their dx)."""
DENSE = 64
"""Gaussians a cell of a well trained splat on a solver's grid."""
KNOBS = {
    "dx": "node spacing",
    "cfl": "Courant number",
    "ppc": "points per cell",
    "dtype": "float32 or float64",
    "engine": "resident solver or composed operators",
    "fields": "a velocity field per body, or one for all",
    "gaussians": "Gaussians carried by material points, or each is one",
    "dt": "automatic time step, or a fixed one as in PhysGaussian's demos",
    "return_map": "implicit or explicit alpha, centre of the yield surface",
    "law": "what breaks does so by NACC or by a phase field",
    "free": "measures that trade nothing",
    "adaptive": "flight in closed form, sleep",
    "textbook": "the textbook solver over the node spacings",
    "storage": "textbook: strain or F",
    "transfer": "textbook: APIC, PIC or FLIP",
}
"""What may be named in ``--only``."""
OFF_GRID = {"flight": "flight on the grid", "rest": "no sleep"}
"""Cases of :mod:`gsfluent.lab.charts.off_grid`, and what their measure is called when it is off."""
_OFF: dict[str, dict[str, Any]] = {
    "flight": {"free_flight": False, "piece_flight": False},
    "rest": {"sleep": False},
}
_OFF_RUNGS = (0.025, 0.0167)
_COARSER = {"collide": 0.025, "oblique": 0.025, "pull_apart": 0.04}
"""Where the coarsest rung is far better than any peer: grids on which few cells make a body."""
_FINER = (1.5, 2.0, 3.0, 4.0)
_MOST_POINTS = 4.5e5
_MOST_NUMBERS = 1.2e7
"""Times x points that are kept of one run on a GPU: 0.6 GB of positions and velocities."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One point of the chart before it is run."""

    case: str  # name of the case
    dx: float  # node spacing [m]
    ppc: int = 8  # points per cell of the scene that is judged
    method: str = OURS  # gsfluent or textbook
    knob: str = "dx"  # what was turned, of KNOBS
    variant: str = ""  # how, in words; empty for the base
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of run_case
    trades: bool = True  # whether the knob may move the error

    def key(self, device: str) -> str:
        """As :attr:`gsfluent.lab.charts.record.Record.key`."""
        return "|".join(
            (self.case, self.method, self.variant, f"{self.dx:.5g}", device.split(":")[0])
        )


def work(setting: Setting) -> float:
    """Points times steps up to a factor of the case: what a run's time goes with."""
    points = int(setting.options.get("carried_by", setting.ppc))
    courant = float(setting.options.get("courant", setting.options.get("cfl", 0.5)))
    return points / setting.dx**3 / (courant * setting.dx)


def rungs(case: Case, device: str, quick: bool = False) -> list[float]:
    """Node spacings of a case from coarse to fine; a GPU goes on where a CPU stops.

    A GPU's rungs end at 4.5e5 points, or where a run would keep more than 1.2e7 positions; those of
    fracture are the CPU's, since no grid is finer than that of the ensemble they are judged by.
    """
    steps = sorted(case.ladder, reverse=True)
    if quick:
        return steps[:2]
    if not device.startswith("cuda") or case.kind == "fracture":
        return steps
    found = list(steps)
    coarse: Scene = case.build(steps[-1], 8)
    for factor in _FINER:
        points = coarse.count * factor**3
        if points > _MOST_POINTS or points * coarse.times.shape[0] > _MOST_NUMBERS:
            break
        found.append(steps[-1] / factor)
    return found


def ladder(
    names: Sequence[str] = (),
    *,
    device: str = "cpu",
    only: Iterable[str] = (),
    quick: bool = False,
    textbook: bool = True,
) -> list[Setting]:
    """All settings, ladders over all rungs first, so that a budget cuts knobs and not cases.

    Without names all cases and all knobs of :data:`KNOBS`; the base ladder is that of ``dx``.

    Raises:
        InputError: An unknown case or knob.
    """
    known = {c.name: c for c in cases()}
    if missing := [n for n in names if n not in known and n not in OFF_GRID]:
        there = ", ".join([*known, *OFF_GRID])
        raise InputError(f"--cases: no case {missing[0]!r}", f"there are {there}")
    wanted = set(only) or set(KNOBS)
    if wrong := sorted(wanted - set(KNOBS)):
        raise InputError(f"--only: no knob {wrong[0]!r}", f"there are {', '.join(KNOBS)}")
    given = names or (("bar", "pull_apart") if quick else (*CASES, *OFF_GRID))
    chosen = [known[n] for n in dict.fromkeys(given) if n in known]
    off_grid = [n for n in dict.fromkeys(given) if n in OFF_GRID]
    found: list[Setting] = []
    steps = {case.name: rungs(case, device, quick) for case in chosen}
    for case in chosen:
        found += [Setting(case.name, dx) for dx in steps[case.name]]
    for case in chosen if not quick else ():
        found += _cheap(case, steps[case.name])
    references = [_textbook(case, steps[case.name], device, quick) for case in chosen if textbook]
    found += [s for made in references for s in made if s.knob == "textbook"]
    for case in chosen:
        turned = _two(steps[case.name], case.kind)
        # on a GPU most of a run is its set-up, and the finer rung says the same
        for dx in turned[-1:] if device.startswith("cuda") else turned:
            found += _knobs(case, dx, device, quick)
    for name in off_grid:
        for dx in _OFF_RUNGS[:1] if quick else _OFF_RUNGS:
            words, off = OFF_GRID[name], _OFF[name]
            found.append(Setting(name, dx, knob="adaptive"))
            found.append(Setting(name, dx, knob="adaptive", variant=words, options=off))
    found += [s for made in references for s in made if s.knob != "textbook"]
    return [s for s in found if s.knob in wanted]


def _cheap(case: Case, steps: Sequence[float]) -> Iterator[Setting]:
    """Settings that cost little, over all rungs: long steps, few points, and both."""
    coarser = [_COARSER[case.name]] if case.name in _COARSER else []
    for dx in coarser:
        yield Setting(case.name, dx)
    for dx in [*coarser, *steps]:
        yield Setting(case.name, dx, knob="cfl", variant="CFL 0.8", options={"cfl": 0.8})
        if case.kind != "fracture":
            both = {"cfl": 0.8}
            yield Setting(case.name, dx, 1, OURS, "ppc", "1 per cell, CFL 0.8", both)


def _two(steps: Sequence[float], kind: str) -> list[float]:
    """The two rungs on which knobs are turned; of fracture (ensembles) the coarse ones."""
    if kind == "fracture":
        return list(steps[:2])
    if len(steps) < 4:
        return sorted({steps[0], steps[-1]}, reverse=True)
    return [steps[len(steps) // 2 - 1], steps[min(len(steps) - 2, len(steps) // 2 + 1)]]


def _knobs(case: Case, dx: float, device: str, quick: bool) -> Iterator[Setting]:
    scene: Scene = case.build(max(case.ladder), 8)  # for its bodies and laws

    def turned(
        knob: str, variant: str, ppc: int = 8, trades: bool = True, **options: Any
    ) -> Setting:
        return Setting(case.name, dx, ppc, OURS, knob, variant, options, trades)

    yield turned("cfl", "CFL 0.25", cfl=0.25)
    yield turned("dtype", "float64", dtype="float64")
    yield turned("free", "shuffled points", trades=False, shuffle=1)
    if quick:
        return
    yield turned("cfl", "CFL 0.1", cfl=0.1)
    yield turned("ppc", "1 per cell", 1)
    yield turned("ppc", "27 per cell", 27)
    yield turned("dt", f"fixed dt, c dt/dx {DEMO_COURANT}", courant=DEMO_COURANT)
    yield turned("engine", "composed operators", engine="ops")
    if case.kind != "fracture":  # there splats part (docs/theory/cracks.md)
        yield turned("gaussians", f"{DENSE} per cell ride on 8", DENSE, carried_by=8)
        yield turned("gaussians", f"{DENSE} per cell", DENSE)
    if device.startswith("cpu"):
        yield turned("free", "one thread", trades=False, threads=1)
    yield turned("free", "a call for every step", trades=False, single_steps=True)
    if int(scene.body.max()) > 0:
        yield turned("fields", "one field", fields=False)
    if any(m["law"] == "nacc" for m in scene.materials):
        yield turned("return_map", "explicit alpha", implicit=False)
        yield turned("return_map", "fixed centre", k=math.inf)
        yield turned("law", "phase field", law="phase_field")


def _textbook(case: Case, steps: Sequence[float], device: str, quick: bool) -> list[Setting]:
    def variant(dx: float, knob: str, words: str, **options: Any) -> Setting:
        return Setting(case.name, dx, 8, TEXTBOOK, knob, words, options)

    base: dict[str, Any] = {"transfer": "apic", "storage": "F"}
    if quick:
        return [variant(steps[0], "textbook", "APIC, F", **base)]
    # plain PyTorch takes 3 ms a step on a GPU and 7 us a point and step on a CPU: few rungs
    coarse = steps[: 2 if case.kind == "fracture" else 3]
    found = [variant(dx, "textbook", "APIC, F", **base) for dx in coarse]
    if device.startswith("cuda"):
        return found[-1:]
    at = coarse[0] if case.kind == "fracture" else coarse[min(1, len(coarse) - 1)]
    return [
        *found,
        variant(at, "transfer", "PIC, F", **base | {"transfer": "pic"}),
        variant(at, "transfer", "FLIP 0.99, F", **base | {"transfer": "flip"}),
        variant(at, "storage", "APIC, strain", **base | {"storage": "strain"}),
    ]
