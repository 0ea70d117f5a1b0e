"""Health of a running simulation: checks, checkpoints, roll-backs, and the momentum ledger."""

from __future__ import annotations

import collections
import copy
import dataclasses
import logging
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.damage import DamageField
from gsfluent.ops.reference.phase_field import BROKEN
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.engine import Unhealthy
from gsfluent.pipeline.simulate.step import Stepper

_log = logging.getLogger(__name__)

CHECK_EVERY = 128
"""Grid steps between two checks."""
VOLUME_RATIO = (0.02, 50.0)
"""Bounds of the volume ratio J; the return map's own guard keeps J inside [0.05, 20]."""
ENERGY_SLACK = 0.05
"""How far mechanical energy may rise above its start, in units of the largest kinetic plus elastic
energy so far. Contact and breaking only take energy away."""
ROUNDING = 1e-7
"""Of gravity's energy: places are rounded, and what is held still has no other energy."""
LIFT = 0.3
"""How far the weight may be lifted [cells]: what settles on a floor has no other energy to measure
that with. Wet tissue carries its load by less than its stress, so that its strain holds more than
was put in: a melon that begins to stand rises by 0.04, 0.10 and 0.22 cells at 22, 30 and 40."""
RING = 2
THINNEST = 0.1
"""Least thickness of a body [point spacings]; half a spacing is all that one layer has."""
MEAN_RATIO = (0.25, 4.0)
"""Bounds of the mean volume ratio of a body that does not flow."""
SUNK = 0.01
"""Share of a body's mass that may lie a cell below the floor."""
LEAST_POINTS = 20
LEAST_SCALE = 2.0**-12
"""Factor on the time step at which a run is given up."""
RECOVERY = 10
"""Good checks after which a halved time step is doubled again."""
CAUSES = {
    "numbers": (
        "a step too long for the stiffest part, or a force from outside",
        "lower cfl, check the material's stiffness and the step_hook",
    ),
    "speed": (
        "points thrown further than a cell in one step, by a violent contact or a stiff part",
        "lower cfl, or soften the stiffest material",
    ),
    "volume": (
        "matter squeezed or stretched beyond what its law can hold",
        "lower the speed of impact, use a stiffer material or a finer quality",
    ),
    "energy": (
        "a step too long for the contact or the stiffest part, or a force from outside",
        "lower cfl, check the step_hook",
    ),
    "crowded": (
        "more pieces meet in one place than the grid keeps apart",
        "use a finer quality, or separate_fragments=False",
    ),
    "far": ("matter left the range of the grid", "add a floor, or end the run earlier"),
    "crushed": (
        "a load far beyond what the material carries: gravity, a press, a collider",
        "lower the load, or take a stiffer material",
    ),
    "step": (
        "a stiffness or a speed that asks for vanishing steps",
        "soften the stiffest material",
    ),
}
"""Likely cause of each kind of trouble, and what to change."""


def region(matter: Matter, state: State, wrong: Tensor, names: Sequence[str]) -> str:
    """Say where points are: centre and box, and the body most of them belong to.

    Args:
        matter: The points.
        state: A state with finite positions.
        wrong: The points, bool [N].
        names: Names of the bodies.
    """
    rows = wrong & torch.isfinite(state.position).all(dim=1)
    if not bool(rows.any()):
        return ""
    at = state.position[rows]
    low, high = torch.aminmax(at, dim=0)
    most = int(torch.mode(matter.particles.body[rows]).values)
    return (
        f"{int(rows.sum())} points of {names[most]!r} around {_metres(at.mean(dim=0))}, "
        f"box {_metres(low)} to {_metres(high)}"
    )


def _metres(place: Tensor) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in place.tolist()) + ") m"


class Watch:
    """Decides whether a state is sound, keeps the last good ones, and rolls back.

    Args:
        matter: The points.
        gravity: Acceleration [m/s^2].
        start: Figures at time 0.
        max_rollbacks: Roll-backs in a row, without getting past the trouble, before giving up.
        names: Names of the bodies.
    """

    def __init__(
        self,
        matter: Matter,
        gravity: tuple[float, float, float],
        start: Figures,
        *,
        max_rollbacks: int = 6,
        names: Sequence[str] = (),
    ) -> None:
        self.matter, self.gravity = matter, gravity
        self.names = names or [str(i) for i in range(len(matter.ranges))]
        self.energy = start.total
        self.scale = start.kinetic + start.elastic
        self.max_rollbacks = max_rollbacks
        self.rollbacks = 0
        self.in_a_row = 0
        self.good_in_a_row = 0
        self.trouble_time = -math.inf
        self.reasons: list[str] = []
        self.kind = ""
        self._ring: collections.deque[State] = collections.deque(maxlen=RING)
        self._measured: tuple[State, Figures] | None = None

    def keep(self, state: State, *, only: bool = False) -> None:
        """Remember a good state; ``only`` forgets the others (a frame has been handed out)."""
        if only:
            self._ring.clear()
        self._ring.append(state)

    def check(self, state: State, stepper: Stepper) -> Unhealthy | None:
        """Return what is wrong with a state, or None; a good state is kept."""
        trouble = self._judge(state)
        if trouble is not None:
            return trouble
        self.keep(state)
        if state.time > self.trouble_time:  # past what went wrong, not only on the way there again
            self.in_a_row = 0
        self.good_in_a_row += 1
        if stepper.dt_scale < 1.0 and self.good_in_a_row >= RECOVERY:
            stepper.dt_scale = min(1.0, 2.0 * stepper.dt_scale)
            stepper.reset()  # a new engine, with the new step
            self.good_in_a_row = 0
        return None

    def figures(self, state: State) -> Figures:
        """Measure a state, once."""
        if self._measured is None or self._measured[0] is not state:
            self._measured = state, figures_of(self.matter, state, self.gravity)
        return self._measured[1]

    def _judge(self, state: State) -> Unhealthy | None:
        now = self.figures(state)
        p = state.particles
        if now.non_finite:
            finite = torch.isfinite(p.velocity).all(dim=1) & torch.isfinite(p.strain).all(dim=1)
            return Unhealthy(f"{now.non_finite} points are not finite", ~finite)
        ratio = _volume_ratio(state)
        wrong = (ratio < VOLUME_RATIO[0]) | (ratio > VOLUME_RATIO[1])
        if bool(wrong.any()):
            low, high = torch.aminmax(ratio)
            what = f"volume ratio between {float(low):.3g} and {float(high):.3g}"
            return Unhealthy(what, wrong, "volume")
        # Height at which gravity's energy is counted is arbitrary, so only its change matters.
        given = self.energy + float(state.work)
        self.scale = max(self.scale, min(now.kinetic + now.elastic, max(given - now.gravity, 0.0)))
        excess = now.total - given
        weight = math.hypot(*self.gravity) * float(self.matter.particles.mass.double().sum())
        slack = ENERGY_SLACK * self.scale + ROUNDING * abs(now.gravity)
        if not excess <= slack + LIFT * weight * self.matter.dx + 1e-9:
            speed = p.velocity.norm(dim=1)
            return Unhealthy(
                f"energy rose by {excess:.3g} J over the {given:.3g} J it had and was given",
                speed >= 0.5 * speed.max(),
                "energy",
            )
        return None

    def implausible(self, state: State, waits: Sequence[bool], floor: float | None) -> str:
        """What no matter can do, at a frame, in words; empty when there is nothing of the kind.

        No smaller step mends it: every step was sound, and the outcome is not.

        Args:
            state: The state at a frame.
            waits: Which bodies wait to be fired or poured yet.
            floor: Height of the floor [m]; None without one.
        """
        flows = self.matter.of_law("fluid", "drucker_prager", "rigid", points=state.particles)
        ratio = _volume_ratio(state)
        for number, (a, b) in enumerate(self.matter.ranges):
            kept = a + (~state.loose[a:b]).nonzero()[:, 0]
            if waits[number] or kept.numel() < LEAST_POINTS:
                continue
            wrong = self._sunk(state, kept, floor)
            if not wrong and not bool(flows[kept].any()):
                wrong = self._crushed(state, kept, self.matter.spacing[number])
                mean = float(ratio[kept].mean())
                if not wrong and not MEAN_RATIO[0] < mean < MEAN_RATIO[1]:
                    wrong = f"has {mean:.3g} of its volume"
            if wrong:
                self.kind = "crushed"
                self.reasons.append(f"t = {state.time:.6g} s: {self.names[number]!r} {wrong}")
                return self.reasons[-1]
        return ""

    def _sunk(self, state: State, kept: Tensor, floor: float | None) -> str:
        """Whether what began above the floor lies below it."""
        if floor is None:
            return ""
        p = self.matter.particles
        deep = (p.position[kept, 2] >= floor - 0.5 * self.matter.dx) & (
            state.position[kept, 2] < floor - self.matter.dx
        )
        mass = p.mass[kept].double()
        share = float((mass * deep).sum() / mass.sum())
        return f"lies below the floor, with {share:.0%} of its mass" if share > SUNK else ""

    def _crushed(self, state: State, kept: Tensor, spacing: float) -> str:
        """Whether all of a body lies in one plane, thinner than a layer of points."""
        now, rest = _thickness(state.position[kept]), _thickness(self.matter.rest[kept])
        if now >= THINNEST * min(spacing, rest):
            return ""
        return f"is {now:.2g} m thick, and was {rest:.2g} m"

    def roll_back(self, trouble: Unhealthy, state: State, stepper: Stepper) -> State | None:
        """Return the state to go on from with half the time step, or None to give up.

        Too many fields in one place are no matter of the step: then fewer fields may meet.
        """
        self.good_in_a_row = 0
        time = max(state.time, trouble.time)
        where = f"t = {time:.6g} s, step {state.step}: {trouble.reason}"
        if trouble.wrong is not None:
            # Where the points were when all was well: a bad state may have them anywhere.
            wrong = stepper.spread(trouble.wrong, state)
            found = region(self.matter, self._ring[-1], wrong, self.names)
            where += f" ({found})" if found else ""
        self.reasons.append(where)
        self.kind = trouble.kind
        self.trouble_time = max(self.trouble_time, time)
        if self.in_a_row >= self.max_rollbacks or stepper.dt_scale <= LEAST_SCALE:
            return None
        self.rollbacks += 1
        self.in_a_row += 1
        # Each further failure in a row goes one checkpoint further back.
        if self.in_a_row > 1 and len(self._ring) > 1:
            self._ring.pop()
        stepper.reset()
        if trouble.kind == "crowded" and stepper.field_limit > 2:
            self._ring[-1] = stepper.relieve(self._ring[-1])
            how = f"at most {stepper.field_limit} pieces apart in one place"
        else:
            stepper.dt_scale *= 0.5
            how = f"{stepper.dt_scale:.3g} of the time step"
        back = self._ring[-1]
        self.reasons[-1] += f"; went back to t = {back.time:.6g} s and on with {how}"
        _log.warning("rolled back: %s", self.reasons[-1])
        return back

    def verdict(self, frame: int) -> str:
        """Words for giving up: frame, time, region, likely cause, what to change."""
        cause, hint = CAUSES[self.kind]
        return f"frame {frame}: {self.reasons[-1]}; likely cause: {cause}; hint: {hint}"

    def twin(self) -> Watch:
        """A watch of its own that knows what this one knows."""
        other = copy.copy(self)
        other.reasons, other._ring = list(self.reasons), self._ring.copy()
        return other

    _KEPT = (
        "energy", "scale", "rollbacks", "in_a_row", "good_in_a_row", "trouble_time", "reasons",
    )  # fmt: skip

    def state(self) -> dict[str, float | int | list[str]]:
        """Return what a resumed run needs; it stays as it is when this goes on."""
        return {name: copy.copy(getattr(self, name)) for name in self._KEPT}

    def restore(self, values: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        for name in self._KEPT:
            setattr(self, name, values[name])
        self.reasons = list(self.reasons)


class Ledger:
    """Momentum balance: ``P(t) = P(0) + M g t + impulses of the colliders``, in float64.

    Args:
        matter: The points at time 0.
        gravity: Acceleration [m/s^2].
        start: Figures at time 0.
        held: Time [s] until which each body waits, outside gravity's reach.
    """

    def __init__(
        self,
        matter: Matter,
        gravity: tuple[float, float, float],
        start: Figures,
        held: Sequence[float] = (),
    ) -> None:
        self.held = [
            (float(matter.particles.mass[a:b].to(torch.float64).sum()), time)
            for (a, b), time in zip(matter.ranges, held, strict=False)
            if time > 0.0
        ]
        self.mass = float(matter.particles.mass.to(torch.float64).sum())
        self.start = torch.tensor(start.momentum, dtype=torch.float64)
        self.gravity = torch.tensor(gravity, dtype=torch.float64)
        self.worst = 0.0
        # Two bodies thrown at each other have no momentum together, but a scale of it.
        self.scale = max(float(self.start.norm()), (2.0 * self.mass * start.kinetic) ** 0.5)

    def change(
        self, mass: float, momentum: Tensor, time: float, waits: Sequence[tuple[float, float]]
    ) -> None:
        """Enter matter that comes or leaves.

        Args:
            mass: What comes [kg]; negative for what leaves.
            momentum: Of what comes [N s], [3]; likewise.
            time: Now [s].
            waits: Mass and time of what waits at first.
        """
        self.start = self.start + momentum - self.gravity * (mass * time)
        for weight, until in self.held:  # what waits no longer is a constant
            self.start = self.start - self.gravity * (weight * until if until <= time else 0.0)
        self.held = [(weight, until) for weight, until in self.held if until > time]
        self.held += waits
        self.start = self.start + self.gravity * (sum(weight for weight, _ in waits) * time)
        self.mass += mass

    def wait(self, waits: Sequence[tuple[float, float]], time: float) -> None:
        """Enter when matter that is there already [kg] comes under gravity's reach [s]."""
        waits = [(weight, until) for weight, until in waits if until > time]
        self.held += waits
        self.start = self.start + self.gravity * (sum(weight for weight, _ in waits) * time)

    def error(self, state: State, now: Figures) -> float:
        """Return the relative error of the balance at this moment.

        It is relative to the largest momentum or impulse that the run has seen so far.
        """
        waited = sum(mass * min(time, state.time) for mass, time in self.held)
        pull = self.gravity * (self.mass * state.time - waited)
        push = state.impulse.cpu()
        momentum = torch.tensor(now.momentum, dtype=torch.float64)
        self.scale = max(self.scale, *(float(v.norm()) for v in (momentum, pull, push)))
        residual = float((momentum - self.start - pull - push).norm())
        error = residual / self.scale if self.scale > 0 else 0.0
        self.worst = max(self.worst, error)
        return error


def _thickness(points: Tensor) -> float:
    """Least extent [m] of a plate of the same least variance, ``sqrt(12 lambda)``."""
    apart = points.double() - points.double().mean(dim=0)
    least = torch.linalg.eigvalsh((apart.T @ apart / len(points)).cpu())[0]
    return math.sqrt(12.0 * max(float(least), 0.0))


def _volume_ratio(state: State) -> Tensor:
    """Elastic volume ratio J of all points, float64 [N]."""
    strain = state.particles.strain.to(torch.float64)
    xx, yy, zz, xy, xz, yz = (strain + strain.new_tensor([1, 1, 1, 0, 0, 0])).unbind(-1)
    squared = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return squared.clamp(min=0.0).sqrt()


@dataclasses.dataclass(frozen=True)
class Figures:
    """Energies [J] and momenta of all bodies together.

    Args:
        kinetic: Kinetic energy.
        elastic: Stored elastic energy.
        gravity: Potential energy against height 0 along gravity.
        momentum: Linear momentum [N s].
        angular_momentum: Angular momentum about the origin [N m s].
        damaged_fraction: Share of the mass that ever broke.
        alpha_max: Largest alpha so far.
        non_finite: Points with a value that is not finite.
        surface: Energy of the cracks of phase-field matter.
    """

    kinetic: float
    elastic: float
    gravity: float
    momentum: tuple[float, float, float]
    angular_momentum: tuple[float, float, float]
    damaged_fraction: float
    alpha_max: float
    non_finite: int
    surface: float = 0.0

    @property
    def total(self) -> float:
        """Mechanical energy [J]."""
        return self.kinetic + self.elastic + self.gravity


def figures_of(matter: Matter, state: State, gravity: tuple[float, float, float]) -> Figures:
    """Measure one state; see :class:`Figures`."""
    p, position, strain, peak = state.particles, state.position, state.particles.strain, state.peak
    particles = matter.particles
    wide = torch.float64
    x, v, c = position.to(wide), p.velocity.to(wide), p.affine.to(wide)
    mass, volume = particles.mass.to(wide), particles.volume.to(wide)
    second = 0.25 * matter.dx**2
    kinetic = 0.5 * (mass * ((v**2).sum(dim=1) + second * (c**2).sum(dim=(1, 2)))).sum()
    surface = torch.zeros((), dtype=wide, device=x.device)
    if matter.has_field:
        surface = _crack_energy(matter, state)
    density = matter.stored(p, peak)
    elastic = (density.to(wide) * volume).sum()
    pull = torch.tensor(gravity, dtype=wide, device=x.device)
    potential = -(mass * (x @ pull)).sum()
    momentum = (mass[:, None] * v).sum(dim=0)
    skew = torch.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]])
    turning = (mass[:, None] * (torch.linalg.cross(x, v) + second * skew.T)).sum(dim=0)
    damaged = (mass * state.ever).sum() / mass.sum()
    finite = torch.isfinite(x).all(dim=1) & torch.isfinite(v).all(dim=1)
    finite &= torch.isfinite(strain).all(dim=1) & torch.isfinite(peak)
    values = torch.cat(
        [
            torch.stack([kinetic, elastic, potential]),
            momentum,
            turning,
            torch.stack([damaged, peak.max().to(wide), (~finite).sum().to(wide), surface]),
        ]
    ).tolist()
    kinetic, elastic, height, px, py, pz, lx, ly, lz, damaged, most, bad, cost = values
    return Figures(
        kinetic, elastic, height, (px, py, pz), (lx, ly, lz), damaged, most, int(bad), cost
    )


def _crack_energy(matter: Matter, state: State) -> Tensor:
    """What the cracks of phase-field matter cost [J], float64 []."""
    p = state.particles
    if not bool((state.peak > -BROKEN).any()):
        return torch.zeros((), dtype=torch.float64, device=p.device)
    position = state.position.to(p.velocity)
    _, field = torch.unique(state.field, return_inverse=True)
    cracks = DamageField(matter.law, matter.params, matter.particles.material)
    return cracks.energy(
        p.alpha, state.peak, position, matter.particles.volume, dx=matter.dx,
        blocks=ops.build_blocks(position, matter.dx), body=field.to(torch.int32),
    )  # fmt: skip
