"""Runs of the solver side by side: bodies that never meet, of one search or of several.

A GPU is idle with the few thousand points of a run, and a step costs it no more for a hundred runs.
Searches done by :func:`together` wait for each other, and what all of them want to know is one run.
"""

from __future__ import annotations

import contextvars
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Condition
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops import SolverError
from gsfluent.targets.target import Motion

MOST_STEPS = 200_000
MOST_POINTS = 1_000_000
"""Of runs that are done as one."""
MOST_SEARCHES = 64
"""That wait for each other."""
ROW = 32
"""Lanes that stand in a row."""
LEVEL = 2.0**0.5
"""Ratio of neighbouring time steps of searches that wait for each other."""
LONGEST = 1.0
"""The first of these steps [s]."""


class TooFast(Exception):
    """The time step was too long for what these numbers do."""


class Lane(NamedTuple):
    """What moves by itself.

    Attributes:
        fields: Arguments of :class:`gsfluent.ops.Solver`: of points, and rows of materials.
        body: Of each point, or None.
        shown: Points whose motion is shown, the first ones.
        reach: What the next lane has to be away [m], a whole number of blocks.
    """

    fields: dict[str, Tensor]
    body: Tensor | None
    shown: int
    reach: float


class Setup(NamedTuple):
    """What lanes of one run share.

    Attributes:
        dx: Grid spacing [m].
        dt: Longest time step [s]; divided so that frames are met.
        times: Of the frames [s].
        gravity: [m/s^2].
        friction: Of bodies against each other.
        rows: Colliders, [C, W].
        sdf: Of colliders, or None.
        device: Where the solver runs.
    """

    dx: float
    dt: float
    times: tuple[float, ...]
    gravity: tuple[float, float, float]
    friction: float
    rows: Tensor
    sdf: Any
    device: torch.device

    def steps(self) -> int:
        """How many steps a run has."""
        spans = (b - a for a, b in zip((0.0, *self.times), self.times, strict=False))
        return sum(max(1, math.ceil(s / self.dt - 1e-9)) for s in spans if s > 0.0)


def solve(setup: Setup, lanes: Sequence[Lane]) -> list[Motion]:
    """Move lanes in one run; strains come frame by frame.

    Args:
        setup: What they share.
        lanes: One at least; all with bodies, or none.

    Raises:
        TooFast: The step was too long for one of them.
    """
    if setup.steps() > MOST_STEPS:
        raise TooFast
    there, apart = setup.device, max(lane.reach for lane in lanes)
    parts, bodies, shifts = [], [], []
    rows = fields = 0
    for k, lane in enumerate(lanes):
        part = dict(lane.fields)
        shift = part["position"].new_tensor([k % ROW * apart, k // ROW * apart, 0.0])
        part["position"] = part["position"] + shift
        part["material"] = part["material"] + rows
        rows += len(part["law"])
        if lane.body is not None:
            bodies.append(lane.body + fields)
            fields += int(lane.body.max()) + 1
        parts.append(part)
        shifts.append(shift)
    whole = {name: torch.cat([part[name] for part in parts]).to(there) for name in parts[0]}
    held = setup.rows.shape[0] > 0
    solver = ops.Solver(
        dx=setup.dx, body=torch.cat(bodies).to(there) if bodies else None, gravity=setup.gravity,
        colliders=setup.rows.to(there) if held else None,
        sdf=None if setup.sdf is None else setup.sdf.to(there),
        friction=setup.friction, dt=setup.dt, **whole,
    )  # fmt: skip
    places, maps, pushes, now = [], [], [], 0.0
    for time in setup.times:
        span = time - now
        if span > 0.0:
            count = max(1, math.ceil(span / setup.dt - 1e-9))
            solver._write(dt_fixed=span / count)
            try:
                solver.advance(steps=count)
            except (SolverError, ValueError) as error:
                raise TooFast from error
            now = time
        assert solver.deformation is not None  # tracked from the start
        places.append(solver.position.double())
        maps.append(solver.deformation.double().clone())
        pushes.append(solver.impulse.cpu() if held else torch.zeros(0, 3, dtype=torch.float64))
    place, map, push = torch.stack(places), torch.stack(maps), torch.stack(pushes)
    change = map.mT @ map - torch.eye(3, dtype=torch.float64, device=there)  # twice Green's strain
    strain = (0.5 * change.abs()).amax(dim=(2, 3)).cpu()
    place, map = place.cpu(), map.cpu()
    if not bool(torch.isfinite(place).all()):
        raise TooFast
    found, first = [], 0
    for lane, shift in zip(lanes, shifts, strict=True):
        own = slice(first, first + lane.shown)
        found.append(
            Motion(place[:, own] - shift, map[:, own].clone(), push, strain[:, own].amax(dim=1))
        )
        first += len(lane.fields["mass"])
    return found


class _Wish:
    """Lanes that a search wants to see moved, and what became of them."""

    def __init__(self, setup: Setup, lanes: Sequence[Lane]) -> None:
        self.setup, self.lanes = setup, lanes
        self.found: list[Motion] | None = None
        self.error: BaseException | None = None

    @property
    def points(self) -> int:
        return sum(len(lane.fields["mass"]) for lane in self.lanes)

    def kin(self) -> tuple[Any, ...]:
        """Wishes of which this is the same are one run; fewer frames are the first of more."""
        s = self.setup
        rows = s.rows.numpy().tobytes()
        return s.dx, s.dt, s.gravity, s.friction, rows, s.device, self.lanes[0].body is None

    def take(self, motions: Sequence[Motion]) -> None:
        self.found = [_first(motion, len(self.setup.times)) for motion in motions]


def _first(motion: Motion, frames: int) -> Motion:
    """The first frames of a motion whose strain is still told frame by frame."""
    cut = motion._replace(**{k: v[:frames] for k, v in motion._asdict().items()})
    return cut._replace(strain=cut.strain.amax())


class _Lockstep:
    """Searches that wait until all of them want something."""

    def __init__(self) -> None:
        self.turn, self.active, self.waiting = Condition(), 0, list[_Wish]()

    def ask(self, setup: Setup, lanes: Sequence[Lane]) -> list[Motion]:
        """Wait for the others, and get what was asked for.

        Raises:
            TooFast: See :func:`solve`.
        """
        wish = _Wish(setup, lanes)
        with self.turn:
            self.waiting.append(wish)
            self._serve()
            while wish.found is None and wish.error is None:
                self.turn.wait()
        if wish.found is None:
            assert wish.error is not None
            raise wish.error
        return wish.found

    def enter(self, count: int) -> None:
        """Wait for so many more."""
        with self.turn:
            self.active += count

    def leave(self) -> None:
        """Wait no longer for one of them."""
        with self.turn:
            self.active -= 1
            self._serve()

    def _serve(self) -> None:
        if not self.waiting or len(self.waiting) < self.active:
            return
        kin: dict[tuple[Any, ...], list[_Wish]] = {}
        for wish in self.waiting:
            kin.setdefault(wish.kin(), []).append(wish)
        self.waiting = []
        for wishes in kin.values():
            group: list[_Wish] = []
            for wish in wishes:
                if group and sum(w.points for w in group) + wish.points > MOST_POINTS:
                    _grant(group)
                    group = []
                group.append(wish)
            _grant(group)
        self.turn.notify_all()


def _grant(wishes: Sequence[_Wish]) -> None:
    """Do them in one run, or, where that fails, in two."""
    times = max((w.setup.times for w in wishes), key=len)
    try:
        lanes = [lane for w in wishes for lane in w.lanes]
        motions = iter(solve(wishes[0].setup._replace(times=times), lanes))
        for wish in wishes:
            wish.take([next(motions) for _ in wish.lanes])
    except TooFast as error:
        if len(wishes) == 1:
            wishes[0].error = error
            return
        half = len(wishes) // 2
        _grant(wishes[:half])
        _grant(wishes[half:])
    except BaseException as error:  # the searches must not wait for ever
        for wish in wishes:
            wish.error = error


_LOCKSTEP = contextvars.ContextVar[_Lockstep | None]("lockstep", default=None)


def agreed(dt: float) -> float:
    """The step of these [s] that runs take: one of a few where searches wait for each other."""
    if _LOCKSTEP.get() is None:
        return dt
    return LONGEST / LEVEL ** math.ceil(math.log(LONGEST / dt) / math.log(LEVEL) - 1e-9)


def moved(setup: Setup, lanes: Sequence[Lane], *, alone: bool = False) -> list[Motion]:
    """Move lanes: beside those of other searches where there are any.

    Args:
        setup: What they share.
        lanes: One at least.
        alone: Something but a floor stands there: nothing else may.

    Raises:
        TooFast: The step was too long for one of them.
    """
    others = _LOCKSTEP.get()
    if others is not None and not alone:
        return others.ask(setup, lanes)
    return [_first(motion, len(setup.times)) for motion in solve(setup, lanes)]


def together(function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """Call a function for every item, each in a thread; their runs of the solver go side by side.

    Args:
        function: A search, or what does some of them, also by this function.
        items: What it is called with.

    Returns:
        What it returns, in the order of the items.
    """
    every, found = list(items), []
    others = _LOCKSTEP.get()
    lockstep = others or _Lockstep()

    def one(item: Any) -> Any:
        _LOCKSTEP.set(lockstep)  # of this thread, which ends with its items
        try:
            return function(item)
        finally:
            lockstep.leave()

    for first in range(0, len(every), MOST_SEARCHES):
        some = every[first : first + MOST_SEARCHES]
        lockstep.enter(len(some))
        if others is not None:  # this thread wants nothing until they are done
            others.leave()
        try:
            with ThreadPoolExecutor(len(some)) as pool:
                found += [call.result() for call in [pool.submit(one, item) for item in some]]
        finally:
            if others is not None:
                others.enter(1)
    return found
