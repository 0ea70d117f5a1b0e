"""The verdict on a run in progress: the first step at which it breaks a law it should keep.

Four laws (solver.md, section 4): all numbers are finite; kinetic and stored energy stay within
1.05 times those of the start plus the work done from outside; momentum changes by no more than
what gravity and colliders gave, to 1e-5 of the momentum that the energy could hold; the volume
ratio J of every point stays in [0.05, 20].
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.resident import Resident

KINDS = {
    "finite": "a number is not finite",
    "energy": "K + U above 1.05 of the start + work",
    "momentum": "momentum changed by more than what was given",
    "volume": "J outside [0.05, 20]",
    "path": "the points do not move as their velocities say",
    "stopped": "the solver refused to go on",
}
"""What a run can break, and in what words."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """How far a run may go."""

    energy: float = 1.05  # largest (K + U - work) over that of the start
    # largest change of momentum that nothing gave, of sqrt(2 M (E0 + work)), the momentum that a
    # body of that mass and energy can have at most
    momentum: float = 1e-5
    volume: tuple[float, float] = (0.05, 20.0)  # range of J
    # largest share of its way by which the centre of mass of a free body may lag behind momentum
    # times time; infinity: not looked at
    path: float = math.inf


@dataclasses.dataclass(frozen=True)
class State:
    """Sums of one moment of a run; momenta and centres per group of points."""

    step: int  # steps so far
    time: float  # simulated time [s]
    finite: bool  # whether positions, velocities, affine velocities and strains are numbers
    kinetic: float  # [J], with the part in the affine velocities
    elastic: float  # [J]
    momentum: tuple[tuple[float, ...], ...]  # [kg m/s], one row per group
    moment: tuple[tuple[float, ...], ...]  # sum of mass times position [kg m], one row per group
    volume: tuple[float, float]  # smallest and largest J
    # impulse from outside since the start [N s], one row per group
    given: tuple[tuple[float, ...], ...]
    work: float  # work done from outside since the start [J]
    mass: tuple[float, ...]  # mass of each group [kg]
    # points that the law has pulled back into its range so far, if it counts them
    pulled_back: int = 0
    reset: int = 0  # points that the law has reset because they were not finite, if it counts them
    # velocity that is rounding [m/s]: epsilon of the precision times the wave speed
    floor: float = 0.0


@dataclasses.dataclass(frozen=True)
class Violation:
    """The first law that a run broke."""

    step: int  # steps done when it was broken
    kind: str  # one of KINDS
    value: float  # what was found, in units of its limit's quantity
    limit: float  # what was allowed
    note: str = ""  # more, such as why a solver stopped


class Moving(Protocol):
    """A run that can be advanced, looked at, and set back."""

    def advance(self, steps: int) -> None:
        """Go on by a number of steps; FloatingPointError or ValueError: it cannot."""

    def look(self) -> State:
        """Return the sums of this moment."""

    def save(self) -> Any:
        """Return all that changes."""

    def load(self, saved: Any) -> None:
        """Go back to what :meth:`save` returned."""


def check(first: State, now: State, limits: Limits | None = None) -> Violation | None:
    """Judge a moment of a run against its start.

    Returns:
        What is broken, the most telling first: finite, volume, energy, momentum, path; or None.
    """
    limits = limits or Limits()

    def broken(kind: str, value: float, limit: float) -> Violation:
        return Violation(now.step, kind, value, limit)

    if not now.finite or now.reset > first.reset:
        return broken("finite", float(max(now.reset - first.reset, 1)), 0.0)
    low, high = limits.volume
    if now.volume[0] < low:
        return broken("volume", now.volume[0], low)
    if now.volume[1] > high:
        return broken("volume", now.volume[1], high)
    if now.pulled_back > first.pulled_back:  # the law has put J back to the end of the range
        end = low if now.volume[0] - low < high - now.volume[1] else high
        return broken("volume", end, end)
    mass = sum(now.mass)
    start = first.kinetic + first.elastic
    rounding = 1e-6 * (start + abs(now.work)) + mass * now.floor**2
    most = limits.energy * start + now.work + rounding
    if not now.kinetic + now.elastic <= most:
        return broken("energy", _ratio(now.kinetic + now.elastic, most), 1.0)
    scale = math.sqrt(2.0 * mass * (start + max(now.work, 0.0))) + mass * now.floor
    for before, after, gave in zip(first.momentum, now.momentum, now.given, strict=True):
        change = math.dist(after, [p + g for p, g in zip(before, gave, strict=True)])
        if not change <= limits.momentum * scale:
            return broken("momentum", _ratio(change, scale), limits.momentum)
    if limits.path < math.inf:
        time = now.time - first.time
        for before, after, p in zip(first.moment, now.moment, first.momentum, strict=True):
            way = [v * time for v in p]
            lag = math.dist(after, [a + b for a, b in zip(before, way, strict=True)])
            # on a GPU the order of sums moves the last digits of one state's moment
            if lag > limits.path * math.hypot(*way) + 1e-14 * math.hypot(*before):
                return broken("path", _ratio(lag, math.hypot(*way)), limits.path)
    return None


def _ratio(value: float, scale: float) -> float:
    """How many times the scale; infinite where matter at rest has none."""
    return value / scale if scale > 0.0 else math.inf


def first_violation(
    moving: Moving,
    steps: int,
    *,
    limits: Limits | None = None,
    every: int = 8,
    seen: Callable[[State], None] | None = None,
) -> Violation | None:
    """Run on until a law is broken, or for a number of steps.

    The run is looked at every few steps; where one of them is bad, it is set back to the last good
    look and the first bad step is found by halving. What is broken and whole again between two
    looks is seen only where the law counts it (``pulled_back``, ``reset``).

    Args:
        moving: The run.
        steps: Steps to go at most.
        limits: What is allowed.
        every: Steps between two looks.
        seen: Called with the state at every good look, those of the halving included.

    Returns:
        The first violation, or None when there is none within ``steps``.

    Raises:
        ValueError: ``every`` is not positive.
    """
    first = moving.look()

    def judge() -> Violation | None:
        now = moving.look()
        bad = check(first, now, limits)
        if bad is None and seen is not None and now.step > first.step:
            seen(now)
        return bad

    return search(moving, judge, steps, every=every, begin=first.step)


def search(
    moving: Moving,
    judge: Callable[[], Violation | None],
    steps: int,
    *,
    every: int = 8,
    begin: int = 0,
) -> Violation | None:
    """Run on until a judge finds fault, and find the first step at which it does by halving.

    Returns:
        The violation, with its step; None when there is none within ``steps``.

    Raises:
        ValueError: ``every`` is not positive.
    """
    if every < 1:
        raise ValueError(f"search: every must be at least 1, got {every}")
    if (bad := judge()) is not None:
        return dataclasses.replace(bad, step=begin)
    done = 0
    while done < steps:
        ahead, saved = min(every, steps - done), moving.save()
        bad = _trial(moving, judge, ahead)
        if bad is None:
            done += ahead
            continue
        good = 0
        while ahead - good > 1:
            middle = (good + ahead) // 2
            moving.load(saved)
            found = _trial(moving, judge, middle)
            if found is None:
                good = middle
            else:
                ahead, bad = middle, found
        return dataclasses.replace(bad, step=begin + done + ahead)
    return None


def _trial(moving: Moving, judge: Callable[[], Violation | None], steps: int) -> Violation | None:
    try:
        moving.advance(steps)
    except (FloatingPointError, ValueError) as error:
        why = str(error).splitlines()[0]
        kind = "finite" if "not finite after" in why or "is not finite" in why else "stopped"
        return Violation(0, kind, math.inf, 0.0, why)
    return judge()


def observe(
    *,
    step: int,
    time: float,
    dx: float,
    position: Tensor,
    velocity: Tensor,
    affine: Tensor,
    mass: Tensor,
    volume: Tensor,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    strain: Tensor | None = None,
    deformation: Tensor | None = None,
    group: Tensor | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start: State | None = None,
    impulse: Tensor | None = None,
    impulse_work: float = 0.0,
    pulled_back: int = 0,
    reset: int = 0,
) -> State:
    """Sum up the state of any method; one copy from the device.

    Args:
        step: Steps so far.
        time: Simulated time [s].
        dx: Node spacing [m].
        position: [m], [N, 3].
        velocity: [m/s], [N, 3].
        affine: APIC matrices [1/s], [N, 3, 3]; zero where the method has none.
        mass: [kg], [N].
        volume: At rest [m^3], [N].
        law: Laws of the rows, int32 [M].
        params: Rows of :func:`gsfluent.ops.return_mapping`, [M, 8].
        material: Row of each point, int32 [N].
        strain: e = b - I of the elastic deformation, [N, 6]; or
        deformation: elastic deformation gradients, [N, 3, 3].
        group: Number of the group of each point, [N]: groups that nothing touches keep their
            momentum each; default: one group.
        gravity: [m/s^2].
        start: State of the start, whose work and impulse are zero; None at the start itself.
        impulse: Given by colliders since the start [N s], [K, 3]; with one group only.
        impulse_work: Work of moving colliders since the start [J].
        pulled_back: Points pulled back by the law so far.
        reset: Points reset by the law so far.

    Raises:
        ValueError: Not exactly one of strain and deformation; groups together with colliders.
    """
    if (strain is None) == (deformation is None):
        raise ValueError("observe: give either strain or deformation")
    if deformation is not None:
        f = deformation.double()
        b = f @ f.mT
        strain = torch.stack(
            [b[:, 0, 0] - 1.0, b[:, 1, 1] - 1.0, b[:, 2, 2] - 1.0,
             b[:, 0, 1], b[:, 0, 2], b[:, 1, 2]], dim=1,
        )  # fmt: skip
        ratio = torch.linalg.det(f)
    else:
        assert strain is not None
        ratio = volume_ratio(strain)
    groups = 1 if group is None else int(group.max()) + 1
    pushed = impulse is not None and impulse.shape[0] > 0
    if pushed and groups > 1:
        raise ValueError("observe: colliders do not say which group they pushed; give one group")
    index = torch.zeros(len(mass), dtype=torch.long, device=mass.device)
    index = index if group is None else group.to(mass.device).long()
    m, x, v = mass.double(), position.double(), velocity.double()
    each = (v**2).sum(1) + 0.25 * dx**2 * (affine.double() ** 2).sum((1, 2))
    energy = ops.elastic_energy(strain.double(), law=law, params=params.double(), material=material)
    fine = torch.isfinite(torch.cat([x, v, affine.double().flatten(1), strain.double()], 1)).all()
    rows = torch.cat([m[:, None], m[:, None] * v, m[:, None] * x], dim=1)
    sums = rows.new_zeros(groups, 7).index_add_(0, index, rows)
    extra = torch.stack(
        [fine.double(), 0.5 * (m * each).sum(), (volume.double() * energy).sum(),
         ratio.min(), ratio.max()]
    )  # fmt: skip
    tail = sums.new_zeros(3) if not pushed or impulse is None else impulse.double().sum(0)
    numbers = torch.cat([extra, tail.to(extra), sums.flatten()]).tolist()  # the one copy
    table = [numbers[8 + 7 * g : 15 + 7 * g] for g in range(groups)]
    moments = tuple(tuple(row[4:7]) for row in table)
    elapsed = 0.0 if start is None else time - start.time
    fallen = [[0.0] * 3 for _ in table]
    if start is not None:
        pairs = zip(moments, start.moment, strict=True)
        fallen = [[a - b for a, b in zip(now, was, strict=True)] for now, was in pairs]
    work = impulse_work + sum(
        g * d for row in fallen for g, d in zip(gravity, row, strict=True) if g != 0.0
    )
    return State(
        step=step, time=time, finite=bool(numbers[0]), kinetic=numbers[1], elastic=numbers[2],
        momentum=tuple(tuple(row[1:4]) for row in table), moment=moments,
        volume=(numbers[3], numbers[4]),
        given=tuple(
            tuple(row[0] * g * elapsed + p for g, p in zip(gravity, numbers[5:8], strict=True))
            for row in table
        ),
        work=work, mass=tuple(row[0] for row in table), pulled_back=pulled_back, reset=reset,
        floor=torch.finfo(velocity.dtype).eps * _wave_speed(params),
    )  # fmt: skip


def volume_ratio(strain: Tensor) -> Tensor:
    """J of e = b - I: sqrt(det(I + e)), NaN where that is negative, float64 [N]."""
    xx, yy, zz, xy, xz, yz = strain.double().unbind(-1)
    minors = xx * yy + yy * zz + zz * xx - xy * xy - xz * xz - yz * yz
    det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return (1.0 + xx + yy + zz + minors + det).sqrt()


def _wave_speed(params: Tensor) -> float:
    """Of the rows at rest [m/s], the fastest."""
    rows = params.detach().double().reshape(-1, 8).cpu()
    return float(((rows[:, 1] + 4.0 / 3.0 * rows[:, 0]) / rows[:, 6]).max().sqrt())


class OfWorld:
    """A :class:`gsfluent.lab.world.driver.World` as a run to be watched.

    Args:
        world: The world; how it is advanced (solver or ops) stays its own matter.
        group: As in :func:`observe`.
    """

    def __init__(self, world: World, group: Tensor | None = None) -> None:
        self.world, self.group = world, group
        self._start: State | None = None
        self._start = self.look()

    def advance(self, steps: int) -> None:
        """Go on by a number of steps."""
        self.world.run(steps=steps)

    def look(self) -> State:
        """Sum up this moment."""
        world, scene = self.world, self.world.scene
        info = world.info.tolist()
        impulse, pushed = world.impulse, 0.0
        if scene.colliders is not None and impulse.shape[0]:
            speed = scene.colliders[:, 10:13].double().cpu()
            pushed = float((impulse.double().cpu() * speed).sum())
        return observe(
            step=world.steps, time=world.time, dx=scene.dx, position=world.position,
            velocity=world.velocity, affine=world.affine, mass=scene.mass, volume=scene.volume,
            law=scene.law, params=scene.params, material=scene.material, strain=world.strain,
            group=self.group, gravity=scene.gravity, start=self._start, impulse=impulse,
            impulse_work=pushed, pulled_back=info[1] + info[2], reset=info[3],
        )  # fmt: skip

    def save(self) -> dict[str, Any]:
        """Copy all that changes."""
        stepper = self.world.stepper
        if isinstance(stepper, Resident):
            return stepper.solver.snapshot()
        return _copied(stepper.__dict__)

    def load(self, saved: dict[str, Any]) -> None:
        """Go back."""
        stepper = self.world.stepper
        if isinstance(stepper, Resident):
            stepper.solver.restore(saved)
        else:
            stepper.__dict__.update(_copied(saved))


def _copied(values: dict[str, Any]) -> dict[str, Any]:
    return {k: v.clone() if isinstance(v, Tensor) else v for k, v in values.items()}
