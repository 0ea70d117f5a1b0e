"""The state of a simulation; saving it at a frame and taking it up again."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent.data import Particles
from gsfluent.errors import InputError
from gsfluent.io.atomic import write_tensors
from gsfluent.ops.solver_state import UNBROKEN
from gsfluent.pipeline.matter.points import Matter

VERSION = 8
_MOVING = ("velocity", "affine", "strain", "alpha", "deformation", "viscous")
_POINTS = (
    "position", "peak", "loose", "field", "cut", "group", "asleep", "calm", "unit", "ever",
    "lowest", "alpha_seen", "time_seen",
)  # fmt: skip
_WHOLE = ("impulse", "colliders", "work", "dissipated", "cut_links")
_SAVED = {"loose": "stray"}
"""Names in the file that are not those of the fields: files outlive names."""


def at_rows(values: Tensor, rows: Tensor | None) -> Tensor:
    """The values of some points, int64 [M]; of all for None."""
    return values if rows is None else values[rows]


def kinetic_energy(mass: Tensor, velocity: Tensor, affine: Tensor, dx: float) -> Tensor:
    """Kinetic energy of some points with its APIC part [J], float64 []; masses are [M]."""
    squared = (velocity.double() ** 2).sum(dim=1)
    squared = squared + 0.25 * dx * dx * (affine.double() ** 2).sum(dim=(1, 2))
    return 0.5 * (mass.double() * squared).sum()


class State(NamedTuple):
    """Everything that changes in a simulation. Tensors are never written in place.

    Attributes:
        particles: All points as of ``time``; positions rounded to their dtype.
        position: Positions [m], float64 [N, 3]: what the next step starts from.
        peak: Largest alpha each brittle point had since it was welded last, [N]; nothing else
            undoes a break. :data:`gsfluent.ops.solver_state.UNBROKEN` for points of other laws.
        time: Simulated time [s].
        step: Grid steps so far.
        landed: Which bodies have ended their first flight.
        impulse: Sum of collider impulses on the bodies [N s], float64 [3].
        colliders: Rows of the rigid colliders as of ``time``, float64 [M, 32].
        work: Most energy that colliders can have given to the bodies [J], float64 [].
        loose: Debris that left the grid, bool [N]: chips, whose ``unit`` is their lowest row, and
            dust (see :mod:`gsfluent.pipeline.simulate.debris`).
        field: Velocity field of each point, int32 [N]: its body, or its piece of a broken one.
        cut: Sides of blades each point lies on, int32 [N] (:func:`gsfluent.ops.blade_sides`).
        group: First row of the group that moves without the grid and holds the point, int32 [N];
            -1 for points on the grid and for bodies in their first flight.
        asleep: Whether that group rests (else it flies), bool [N].
        calm: Frames in a row during which the point hardly moved, int16 [N].
        calm_at: Where it was when these were last counted [m], float64 [N, 3].
        dissipated: Kinetic energy of vibration and of creep that went when groups left the grid
            [J], float64 [].
        unit: What each point hung together with when that was last looked at, int64 [N]: the first
            row of its body, the label of its piece, the lowest row of its chip; -1 for powder.
        ever: Points that ever broke, welded or not, bool [N].
        lowest: Least alpha each point ever had, [N].
        alpha_seen: Alpha when it was last noted to have moved, [N]; see
            :mod:`gsfluent.pipeline.matter.weld`.
        time_seen: When that was [s], float64 [N].
        cut_links: Links at rest that are cut for good, bool [L], in the order of
            :func:`gsfluent.pipeline.matter.fragments.rest_links`.
        given: Impulse [N s] and torque about its point [N m s] that each grip gave, [G, 6].
        pushed: How many of the scene's impulses have been given.
        enthalpy: Heat of each point [J/kg], float64 [N] (:func:`gsfluent.ops.temperature`); None
            where nothing has a temperature.
        level: Its step from solid (0) to liquid, int8 [N]; None likewise.
    """

    particles: Particles
    position: Tensor
    peak: Tensor
    time: float
    step: int
    landed: tuple[bool, ...]
    impulse: Tensor
    colliders: Tensor
    work: Tensor
    loose: Tensor
    field: Tensor
    cut: Tensor
    group: Tensor
    asleep: Tensor
    calm: Tensor
    calm_at: Tensor
    dissipated: Tensor
    unit: Tensor
    ever: Tensor
    lowest: Tensor
    alpha_seen: Tensor
    time_seen: Tensor
    cut_links: Tensor
    given: Tensor
    pushed: int = 0
    enthalpy: Tensor | None = None
    level: Tensor | None = None

    @staticmethod
    def start(
        matter: Matter,
        colliders: Tensor,
        landed: tuple[bool, ...],
        links: int = 0,
        grips: int = 0,
    ) -> State:
        """The state at time 0, with so many links at rest and so many grips."""
        p = matter.particles
        none = torch.zeros(p.count, dtype=torch.bool, device=p.device)
        zero = torch.zeros((), dtype=torch.float64, device=p.device)
        return State(
            particles=p,
            position=p.position.to(torch.float64),
            peak=torch.where(matter.brittle, p.alpha, UNBROKEN),
            time=0.0,
            step=0,
            landed=landed,
            impulse=torch.zeros(3, dtype=torch.float64, device=p.device),
            colliders=colliders,
            work=zero,
            loose=none,
            field=p.body,
            cut=torch.zeros_like(p.body),
            group=torch.full_like(p.body, -1),
            asleep=none,
            calm=torch.zeros(p.count, dtype=torch.int16, device=p.device),
            calm_at=p.position.to(torch.float64),
            dissipated=zero,
            unit=torch.tensor([a for a, _ in matter.ranges], device=p.device)[p.body.long()],
            ever=matter.brittle & (p.alpha >= 0),
            lowest=p.alpha,
            alpha_seen=p.alpha,
            time_seen=torch.zeros(p.count, dtype=torch.float64, device=p.device),
            cut_links=torch.zeros(links, dtype=torch.bool, device=p.device),
            given=torch.zeros(grips, 6, dtype=torch.float64, device=p.device),
        )

    def adopting(self, before: State) -> State:
        """Follow positions that somebody changed in ``particles`` since ``before``."""
        now, then = self.particles.position, before.particles.position
        if now is then or self.position is not before.position:
            return self
        changed = (now != then).any(dim=1, keepdim=True)
        return self._replace(position=torch.where(changed, now.to(self.position), self.position))


def save_state(path: str | Path, state: State, matter: Matter, extra: dict[str, Any]) -> None:
    """Write a state atomically: tensors, numbers and strings only.

    Args:
        path: File to write.
        state: State at a frame.
        matter: The points, of which a fingerprint is stored.
        extra: Counters and records, of plain types.
    """
    moving = {name: getattr(state.particles, name) for name in _MOVING}
    if moving["viscous"] is None:  # a state in which nothing relaxes is that of versions before
        del moving["viscous"]
    values: dict[str, Any] = {
        "version": VERSION,
        "fingerprint": _fingerprint(matter),
        "particles": {name: v if v is None else v.cpu() for name, v in moving.items()},
        "tensors": {
            _SAVED.get(name, name): getattr(state, name).cpu()
            for name in (*_POINTS, "calm_at", *_WHOLE)
        },
        # a state without grips is that of versions before
        **({"given": state.given.cpu()} if state.given.numel() else {}),
        **{name: value.cpu() for name, value in _heat(state).items()},
        "time": state.time,
        "step": state.step,
        "landed": list(state.landed),
        "kicked": state.pushed,
        "extra": extra,
    }
    write_tensors(path, values)


def _heat(state: State) -> dict[str, Tensor]:
    """What a state has of heat, by the names of the fields; nothing where there is none."""
    if state.enthalpy is None or state.level is None:
        return {}
    return {"enthalpy": state.enthalpy, "level": state.level}


def load_state(path: str | Path, matter: Matter) -> tuple[State, dict[str, Any]]:
    """Read what :func:`save_state` wrote.

    Raises:
        InputError: No such file, a damaged one, or one of another scene.
    """
    try:
        values = torch.load(path, map_location=matter.particles.device, weights_only=True)
    except FileNotFoundError:
        raise InputError(f"resume: no file {path}", hint="start without resume") from None
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"resume: {path} cannot be read ({error})", hint="start without resume"
        ) from error
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise InputError(f"resume: {path} is no state of this version", hint="start without resume")
    mine = _fingerprint(matter)
    theirs = values["fingerprint"]
    if len(theirs) != len(mine) or not all(
        math.isclose(a, b, rel_tol=1e-9) for a, b in zip(theirs, mine, strict=True)
    ):
        raise InputError(
            f"resume: {path} belongs to another scene, quality or seed",
            hint="resume with the settings it was made with, or start without resume",
        )
    tensors = {name: values["tensors"][_SAVED.get(name, name)] for name in _POINTS + _WHOLE}
    tensors["calm_at"] = values["tensors"].get("calm_at", tensors["position"])  # before: not kept
    rounded = tensors["position"].to(matter.particles.dtype)
    state = State(
        particles=matter.particles.replace(position=rounded, **values["particles"]),
        time=float(values["time"]),
        step=int(values["step"]),
        landed=tuple(bool(v) for v in values["landed"]),
        pushed=int(values["kicked"]),
        given=values.get("given", rounded.new_zeros(0, 6, dtype=torch.float64)),
        enthalpy=values.get("enthalpy"),
        level=values.get("level"),
        **tensors,
    )
    return state, values["extra"]


def _fingerprint(matter: Matter) -> list[float]:
    """Numbers that differ between scenes, qualities and seeds."""
    p = matter.particles
    parts = [p.position, p.velocity, p.alpha, p.mass, p.volume, matter.params]
    parts += [] if p.viscous is None else [p.viscous]
    sums = [float(v.cpu().double().sum()) for v in parts]
    return [float(p.count), matter.dx, *sums]
