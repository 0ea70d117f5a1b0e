"""Which law an object or part has: each is fitted to the first frames, and foretells the others.

Frames that no search has seen judge (docs/theory/fit.md). Of laws that foretell them alike the one
with fewer numbers is taken, by the criterion of Schwarz (1978).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsfluent.errors import InputError, RunError
from gsfluent.materials.laws import PARAMETERS, READS
from gsfluent.materials.material import Material, nearest
from gsfluent.pipeline.fit.parameters import VECTORS, Unknowns, flat, places
from gsfluent.pipeline.fit.task import Runner, Task, run_task, unknowns_of
from gsfluent.progress import Progress, report_progress
from gsfluent.scene.scene import Body, Part, Scene
from gsfluent.targets.target import Target

NUMBERS: dict[str, tuple[str, ...]] = {
    "elastic": ("young_modulus", "poisson_ratio"),
    "corotated": ("young_modulus", "poisson_ratio"),
    "von_mises": ("young_modulus", "poisson_ratio", "yield_stress"),
    "drucker_prager": ("young_modulus", "friction_angle"),
    "fluid": ("bulk_modulus", "viscosity"),
}
"""Laws that may be tried, and the numbers that each learns."""
STIFF, RATIO, SOFT = 1e5, 0.3, 1e-2
"""Where nothing is known: Young's modulus [Pa], Poisson's ratio, yield stress over modulus."""
ANGLE, THICK = 30.0, 10.0
"""Likewise: friction angle [degrees], viscosity [Pa s]."""
SEEN = (0.25, 0.5, 0.7)
"""Of the frames, stage by stage: the last 30 % judge."""
ALIKE = 1.05
"""Laws whose errors on those frames are within this ratio foretell alike."""
PASSES = 2
"""How often at most each place is visited."""
MOST = 12


@dataclasses.dataclass(frozen=True)
class Chosen:
    """What was taken.

    Attributes:
        laws: By place, ``OBJECT`` or ``OBJECT/PART``.
        scene: With these laws, and the numbers that the searches started from.
        unknowns: Its numbers.
        start: Free coordinates that were found on the first frames.
        report: By place ``taken``; ``alike``, the other laws that foretell as well; ``tried``: by
            law ``held_out``, ``seen``, ``bic`` and ``values``.
    """

    laws: dict[str, str]
    scene: Scene
    unknowns: Unknowns
    start: list[float]
    report: dict[str, Any]


def known_laws(laws: Sequence[str]) -> tuple[str, ...]:
    """Laws that may be tried.

    Raises:
        InputError: One that may not.
    """
    for law in laws:
        if law not in NUMBERS:
            raise InputError(f"fit: law {law!r} cannot be tried", nearest(law, NUMBERS))
    return tuple(dict.fromkeys(laws))


def under_law(material: Material, law: str) -> Material:
    """The same matter under another law; what it does not say begins at plain numbers."""
    if material.law == law:
        return material
    young = material.young_modulus
    if young is None:
        young = material.bulk_modulus if material.bulk_modulus is not None else STIFF
    begin = {
        "young_modulus": young, "poisson_ratio": RATIO, "bulk_modulus": young,
        "yield_stress": SOFT * young, "friction_angle": ANGLE, "viscosity": THICK,
    }  # fmt: skip
    more = {k: begin[k] for k in NUMBERS[law] if getattr(material, k) is None}
    if "poisson_ratio" in READS[law] and material.poisson_ratio is None:
        more["poisson_ratio"] = RATIO
    return material.override(law=law, **more)


def plain(material: Material) -> dict[str, Any]:
    """Law and numbers, as a shot has them."""
    read = {name: getattr(material, name) for name in READS[material.law] if name != "density"}
    return {"law": material.law, **{k: v for k, v in read.items() if v is not None}}


def with_laws(scene: Scene, laws: Mapping[str, str]) -> Scene:
    """A scene whose objects and parts have these laws; parts that are not named keep theirs."""
    made = Scene.__new__(Scene)
    made.__dict__.update(scene.__dict__)
    made.bodies = [_relaid(body, laws) for body in scene.bodies]
    return made


def _relaid(body: Body, laws: Mapping[str, str]) -> Body:
    material = under_law(body.material, laws.get(body.name, body.material.law))
    if material is body.material and not any(f"{body.name}/{p.name}" in laws for p in body.parts):
        return body
    parts = []
    for part in body.parts:
        own = part.material(body.material)  # what is around it is no longer what it starts from
        own = under_law(own, laws.get(f"{body.name}/{part.name}", own.law))
        kept = {k: v for k, v in part.overrides.items() if k not in (*PARAMETERS, "law")}
        parts.append(Part(part.name, part.where, {**kept, "material": own, **plain(own)}))
    return dataclasses.replace(body, material=material, parts=tuple(parts))


def learn_under(scene: Scene, learn: Mapping[str, Any], place: str) -> dict[str, dict[str, Any]]:
    """What is learnt: velocities, the numbers of the laws, and what else was asked for.

    Args:
        scene: With its laws.
        learn: Bounds by key.
        place: Whose law is tried; numbers of other places come along while there is room.
    """
    made = places(scene)
    asked: dict[str, dict[str, Any]] = {}
    count = 0
    for name in (place, *(n for n in made if n != place)):
        law = made[name].law
        mine: dict[str, Any] = {}
        for key, bounds in learn.items():
            of, _, field = key.partition(".")
            if of == name and field in (*VECTORS, *READS[law]):
                mine[field] = bounds
        for field in NUMBERS.get(law, ()):
            mine.setdefault(field, True)
        size = sum(3 if field in VECTORS else 1 for field in mine)
        if count + size > MOST:
            mine = {k: v for k, v in mine.items() if k in VECTORS and count + 3 <= MOST}
            size = 3 * len(mine)
        count += size
        if mine:
            asked[name] = mine
    return asked


def pick(judged: Mapping[str, Mapping[str, float]]) -> tuple[str, list[str]]:
    """The law that foretells best, and the others that do so as well.

    Args:
        judged: By law ``held_out`` (in standard deviations; below 1 all are noise) and ``bic``.

    Raises:
        RunError: None can be run.
    """
    size = {law: max(1.0, facts["held_out"]) for law, facts in judged.items()}
    best = min(size.values())
    if not math.isfinite(best):
        raise RunError("fit: no law can be run", "nothing", "start from other numbers")
    alike = [law for law in judged if size[law] <= ALIKE * best]
    taken = min(alike, key=lambda law: judged[law]["bic"])
    return taken, [law for law in alike if law != taken]


def choose_laws(
    scene: Scene,
    target: Target,
    learn: Mapping[str, Mapping[str, Any]] | Sequence[str],
    laws: Sequence[str],
    *,
    starts: int,
    seed: int,
    dx: float,
    grids: int,
    offset: bool,
    runner: Runner,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Chosen:
    """Try every law for every object and part, one place after the other.

    Args:
        scene: The start.
        target: What was seen.
        learn: What is learnt beside the numbers of the laws; of these the bounds.
        laws: Which to try.
        starts: Of each law.
        seed: Of the starts.
        dx: Of the coarser grid [m].
        grids: 1 or 2.
        offset: Learn the offset of the floor.
        runner: Does the searches of a place, all at once.
        device: Where the solver runs.
        progress: Told after each place.

    Raises:
        InputError: Too few frames, or what is to be learnt cannot be.
        RunError: No law can be run.
    """
    if len(target.times) < 6:
        raise InputError(
            f"fit: {len(target.times)} frames cannot judge a law", "give six or more, or a law"
        )
    wanted, every = flat(learn), list(places(scene))
    taken = {n: m.law if m.law in NUMBERS else laws[0] for n, m in places(scene).items()}
    values: dict[str, Any] = {}
    report: dict[str, Any] = {}
    searched: dict[tuple[str, ...], tuple[Task, dict[str, Any]]] = {}
    visits = every * (PASSES if len(every) > 1 else 1)
    for number, place in enumerate(visits, 1):
        tasks: list[tuple[tuple[str, ...], Task]] = []
        keys: dict[str, tuple[str, ...]] = {}
        for law in laws:
            made = with_laws(scene, {**taken, place: law})
            asked = learn_under(made, wanted, place)
            unknowns = unknowns_of(made, asked, grids=grids, offset=offset)
            label = repr(sorted(places(made).items()))
            # laws of all places together, as an earlier visit may have tried them
            key = keys[law] = (label, *sorted(p.key for p in unknowns.parameters))
            if key in searched:
                continue
            for begin in unknowns.starts(starts, seed):
                at = _kept(unknowns, begin, values, place)
                one = Task(made, target, unknowns, at, dx, SEEN, grids, True, label, device)
                tasks.append((key, one))
        done = zip(tasks, runner(run_task, [task for _, task in tasks]), strict=True)
        for (key, task), found in done:
            if key not in searched or found["cost"] < searched[key][1]["cost"]:
                searched[key] = (task, found)
        best = {law: searched[key] for law, key in keys.items()}
        judged = {law: _facts(*pair, len(target.times)) for law, pair in best.items()}
        law, alike = pick(judged)
        taken[place], report[place] = law, {"taken": law, "alike": alike, "tried": judged}
        values |= judged[law]["values"]
        task, found = best[law]
        report_progress(progress, number, len(visits) + 1, f"{place}: {law}")
    return Chosen(taken, task.scene, task.unknowns, found["free"], report)


def _kept(unknowns: Unknowns, begin: Any, values: Mapping[str, Any], place: str) -> list[float]:
    """A start in which what is known of other places, and of the motion, stays."""
    at = np.array(begin)
    for p, part in zip(unknowns.parameters, unknowns.slices().values(), strict=True):
        if p.key in values and (p.object != place or p.name in VECTORS):
            at[part] = p.free(np.ravel(values[p.key]).tolist())
    return [float(v) for v in at]


def _facts(task: Task, found: Mapping[str, Any], frames: int) -> dict[str, Any]:
    """How well a law foretells; residuals of a frame go together, so frames count, not points."""
    unknowns = task.unknowns
    held, seen = found.get("held_out", math.inf), found.get("seen", math.inf)
    count = max(2, round(SEEN[-1] * frames))
    bic = count * 2.0 * math.log(max(1.0, seen)) + len(unknowns) * math.log(count)
    values = unknowns.values(np.asarray(found["free"]))
    return {"held_out": held, "seen": seen, "bic": bic, "values": values}
