"""Levenberg-Marquardt on forward differences, in stages of time.

Levenberg 1944, Marquardt 1963; residuals beyond three standard deviations count by their size
alone (Huber 1964). Bands: the inverse of ``J^T W J`` and the prior where the motion fits to its
noise, else the jackknife by frames (Tukey 1958), since what the model gets wrong it gets wrong for
all points of a frame alike; or, where that is more, what such a misfit hides when it lasts.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.parameters import FINER, Unknowns
from gsfluent.pipeline.fit.together import TooFast
from gsfluent.targets.target import Followers, Motion, Observer

Array = NDArray[np.float64]
Tell = Callable[[str], None]
HUBER = 3.0
MOST = 0.5
"""Longest step of a free coordinate."""
DAMPING = (1e-2, 5.0)
"""First damping, and the factor by which it changes."""
CLOSE = 2e-4
"""A step this short, in free coordinates, ends a stage."""
SETTLED = 1e-3
"""A step that lowers the cost by less than this part of it ends a stage."""
ENOUGH = 0.5
"""So little [nats] is no news: it ends a search whose numbers are not the last."""
UNSURE = 0.25
"""Of what a finer grid changes in a frame, the part that is not believed."""
CHANCE = 3.0
"""Deviations that a correlation of noise stays below."""
TELLING, QUIET = 30, 0.05
"""Residuals that a frame needs to tell its own noise, and the least of it, in deviations."""
PATTERNS = (3, 3, 6)
"""Numbers of a shift, a turn and an even strain. What a grid gets wrong it gets wrong for all
points of a body alike, so each of these has a noise of its own, beside that of the rest."""
CORRECTIONS = 4
"""How often at most the change by a finer grid is seen anew, on all frames."""
NEAR = (0.8, 1.02)
"""Of the step that numbers could take, the steps that are not worth a change."""
SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the frames, stage by stage."""


@dataclasses.dataclass
class Fitted:
    """What a search has found.

    Attributes:
        free: Free coordinates.
        cost: Minus the logarithm of the likelihood: half the sum of squares, Huber's beyond three,
            that of the prior, and the logarithms of the deviations that were taken.
        rms: Root of the mean square of the residuals, in standard deviations.
        information: ``J^T W J`` of the motion alone, [P, P].
        covariance: With the prior; of what does not fit the sandwich, [P, P].
        per_frame: Root mean square residual of each frame, in standard deviations.
        runs: Of the solver.
        strain: Largest strain of any point at the last frame.
        count: How many residuals.
    """

    free: Array
    cost: float
    rms: float
    information: Array
    covariance: Array
    per_frame: list[float]
    runs: int
    strain: float
    count: int = 0


@dataclasses.dataclass
class Linear:
    """A motion linearised.

    Attributes:
        dt: Time step of all runs about it [s].
        motion: Its middle.
        pairs: What the target keeps meanwhile.
        residual: In ``scale`` standard deviations, [R].
        frame: Of each residual, [R].
        scale: What does not fit is noise of its size, so that outliers stay outliers; at least 1.
        jacobian: Of the residuals by the free coordinates that may change, [R, P].
    """

    dt: float
    motion: Motion
    pairs: Any
    residual: Array
    frame: NDArray[np.int64]
    scale: float
    jacobian: Array


class Problem:
    """A scene, a target and what is learnt.

    Args:
        forward: The scene on its grid.
        observer: The target, bound to it.
        unknowns: What is learnt.
        step: Difference of the free coordinates.
        fixed: Values that hold besides.
        fine: The target, bound to the points of a finer grid.
    """

    def __init__(
        self, forward: Forward, observer: Observer, unknowns: Unknowns, step: float,
        fixed: dict[str, Any] | None = None, fine: Observer | None = None,
    ) -> None:  # fmt: skip
        self.forward, self.observer, self.unknowns = forward, observer, unknowns
        self.step, self.fixed, self.fine = step, fixed or {}, fine
        self._missed = np.zeros(0)
        self.change: Motion | None = None
        self.trust = np.ones((len(forward.times), 1 + len(PATTERNS)))
        self.modes: dict[int, Array] = {}
        self._moved = np.zeros((len(forward.times), len(PATTERNS)))
        self._last: tuple[Any, Motion] | None = None
        self._dt: float | None = None

    def forget(self) -> None:
        """Keep no run: the same coordinates move otherwise from now on."""
        self._last = None

    def begin(self) -> None:
        """Begin a search, which does not hang on those before."""
        self._dt = None

    def motion(self, free: Array, frames: int, dt: float, *, keep: bool = False) -> Motion:
        """Run these coordinates; of a run that is kept only what the grid changes is done anew."""
        return self.motions([free], frames, dt, keep=keep)[0]

    def motions(
        self, places: Sequence[Array], frames: int, dt: float, *, keep: bool = False
    ) -> list[Motion]:
        """Runs of several coordinates, side by side where that is cheaper."""
        sets = [self.fixed | self.unknowns.values(free) for free in places]
        more = [values.pop(FINER, 0.0) for values in sets]
        known = [self._last is not None and self._last[0] == (v, frames, dt) for v in sets]
        left = [values for values, is_known in zip(sets, known, strict=True) if not is_known]
        group = self.forward.side_by_side
        made = []
        for k in range(0, len(left), group):
            made += self.forward.run_all(left[k : k + group], frames, dt)
        fresh = iter(made)
        found = []
        for values, is_known, part in zip(sets, known, more, strict=True):
            moved = self._last[1] if is_known and self._last else next(fresh)
            if keep:
                self._last = ((values, frames, dt), moved)
            found.append(self._corrected(moved, frames, part))
        return found

    def _corrected(self, moved: Motion, frames: int, more: float) -> Motion:
        """With so much of what the finer grid changes."""
        if self.change is None:
            return moved
        return moved._replace(
            **{k: v + more * getattr(self.change, k)[:frames] for k, v in moved._asdict().items()
               if k != "strain"}
        )  # fmt: skip

    def refine(self, finer: Forward, free: Array, frames: int) -> None:
        """See at these coordinates what a finer grid changes, and how far it is to be trusted."""
        values = self.fixed | self.unknowns.values(free)
        self.change, self._missed = None, np.zeros(0)
        coarse = run_at(self, free, frames)[1]
        values.pop(FINER, None)
        fine = _steady(lambda dt: finer.run(values, frames, dt), finer.step(values))[1]
        follow = Followers("fit", self.forward.rest, finer.setting())
        there = [follow.places(fine, k) for k in range(frames)]
        self.change = Motion(
            torch.stack([place for place, _ in there]) - coarse.position,
            torch.stack([map for _, map in there]) - coarse.deformation,
            fine.impulse - coarse.impulse,
            fine.strain,
        )
        pairs = self.observer.pair(coarse)
        with_it = coarse._replace(
            position=coarse.position + self.change.position,
            deformation=coarse.deformation + self.change.deformation, impulse=fine.impulse,
        )  # fmt: skip
        gap, frame = self._gaps(coarse, frames, pairs)
        there_gap = self._gaps(with_it, frames, pairs)[0]
        shift = there_gap - gap
        self._tell_patterns(with_it, frames, frame)
        sizes = self._sizes(shift, frame, frames)
        sizes[:, 1:] = np.maximum.accumulate(sizes[:, 1:], axis=0)
        self._moved[:frames] = sizes[:, 1:]
        self.trust[:frames] = (1.0 + (UNSURE * sizes) ** 2) ** -0.5
        if self.fine is not None and pairs is None:  # clouds have other neighbours there
            seen = self.fine.residuals(fine, frames, self.fine.pair(fine))[0].double().numpy()
            if len(seen) == len(there_gap):
                self._missed = seen - there_gap

    def reweigh(self, free: Array, frames: int) -> None:
        """Take what a frame was missed by for its noise, where it has enough to tell.

        What the model gets wrong grows after contact; a free flight is foretold to a fraction of
        the noise that was believed, and what it shows of velocities need not suffer from the rest.

        Args:
            free: Where the search has ended.
            frames: How many frames count.
        """
        motion = run_at(self, free, frames)[1]
        gap, frame = self._gaps(motion, frames, self.observer.pair(motion))
        if len(gap) < TELLING * frames:
            return
        sizes = np.maximum(self._sizes(gap, frame, frames), QUIET)
        # three numbers of a frame may be small by chance, and a velocity that follows them would
        # keep them so: patterns are missed by one part of what the finer grid changes of them
        moved = self._moved[:frames]
        told = moved > 1.0
        part = np.where(told, sizes[:, 1:] / np.maximum(moved, 1.0), 0.0)
        part = np.sqrt((part**2).sum(axis=0) / np.maximum(told.sum(axis=0), 1))
        sizes[:, 1:] = np.maximum(sizes[:, :1], np.minimum(part, 1.0) * moved)
        self.trust[:frames] = 1.0 / sizes

    def _tell_patterns(self, motion: Motion, frames: int, frame: NDArray[np.int64]) -> None:
        """Orthonormal patterns of a shift, a turn and a strain in the residuals of each frame."""
        self.modes = {}
        patterns = getattr(self.observer, "patterns", None)
        if patterns is None:
            return
        for k in range(frames):
            if int((frame == k).sum()) >= TELLING:
                made = patterns(motion, k).double().numpy()
                found, size = np.linalg.qr(made)
                if np.abs(np.diag(size)).min() > 1e-6 * np.abs(size).max():
                    self.modes[k] = found

    def _sizes(self, gap: Array, frame: NDArray[np.int64], frames: int) -> Array:
        """Root mean squares of the rest and of the patterns in residuals, [frames, 1 + G]."""
        found = np.zeros((frames, 1 + len(PATTERNS)))
        for k in set(frame.tolist()):
            here = gap[frame == k]
            if k not in self.modes:
                found[k] = np.sqrt(np.mean(here**2))
                continue
            part = self.modes[k].T @ here
            rest = here - self.modes[k] @ part
            each = np.split(part, np.cumsum(PATTERNS)[:-1])
            found[k, 0] = np.sqrt(float(rest @ rest) / (len(rest) - len(part)))
            found[k, 1:] = [np.sqrt(np.mean(one**2)) for one in each]
        return found

    def weighed(self, gap: Array, frame: NDArray[np.int64], power: float = 1.0) -> Array:
        """Residuals in deviations of frames and patterns, or back with the power -1."""
        trust = self.trust**power
        found = gap * trust[frame, 0]
        for k, modes in self.modes.items():
            here = frame == k
            if int(here.sum()) != len(modes):
                continue  # more frames were seen than count here
            part = (np.repeat(trust[k, 1:], PATTERNS) - trust[k, 0]) * (modes.T @ gap[here])
            found[here] += modes @ part
        return found

    def doubt(self, frame: NDArray[np.int64]) -> float:
        """Sum of the logarithms of the deviations of these residuals."""
        found = -float(np.log(self.trust[frame, 0]).sum())
        for k in set(self.modes) & set(frame.tolist()):
            found -= float((PATTERNS * np.log(self.trust[k, 1:] / self.trust[k, 0])).sum())
        return found

    def dt(self, free: Array) -> float:
        """A time step for a linearisation about them: the last one as long as it is near.

        Then a step of the search that was taken is the middle of the next linearisation.
        """
        wanted = self.forward.step(self.fixed | self.unknowns.values(free))
        if self._dt is None or not NEAR[0] * wanted <= self._dt <= NEAR[1] * wanted:
            self._dt = wanted
        return self._dt

    def seen(self, motion: Motion, frames: int, pairs: Any) -> tuple[Array, NDArray[np.int64]]:
        """Residuals and their frames."""
        gap, frame = self._gaps(motion, frames, pairs)
        return self.weighed(gap, frame), frame

    def _gaps(self, motion: Motion, frames: int, pairs: Any) -> tuple[Array, NDArray[np.int64]]:
        """Residuals in standard deviations of the target, and their frames.

        What the finer grid's own points show otherwise than the coarser ones moved as they are is
        added: between a cell's points of a liquid or of sand lie millimetres.
        """
        gap, frame = self.observer.residuals(motion, frames, pairs)
        found = gap.double().numpy()
        same = len(self._missed) == len(found)
        return found + self._missed if same else found, frame.numpy()


def weights(residual: Array) -> Array:
    """Huber's weights."""
    return HUBER / np.maximum(np.abs(residual), HUBER)


def cost_of(residual: Array) -> float:
    """Huber's cost."""
    size = np.abs(residual)
    return float(np.where(size <= HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)).sum())


def search(
    problem: Problem,
    start: Array,
    frames: int,
    *,
    active: NDArray[np.bool_] | None = None,
    rounds: int = 12,
    enough: float = 0.0,
    tell: Tell | None = None,
) -> Fitted:
    """Search from a start on the first frames.

    Args:
        problem: What is searched.
        start: Free coordinates.
        frames: How many frames count.
        active: Coordinates that may change; all when None.
        rounds: Most linearisations.
        enough: A step that lowers the cost by less than this ends it, too.
        tell: Told of each.

    Raises:
        TooFast: The start cannot be run at any step tried.
    """
    unknowns = problem.unknowns
    active = np.ones(len(unknowns), bool) if active is None else active
    rows = np.flatnonzero(active)
    prior = 1.0 / unknowns.spread**2
    problem.begin()
    free, damping, runs = start.copy(), DAMPING[0], problem.forward.runs
    for round_ in range(rounds + 1):
        at = linearise(problem, free, frames, rows)
        residual, scale, jacobian = at.residual, at.scale, at.jacobian
        if len(residual) == 0:
            break
        here = cost_of(residual) + 0.5 * float((prior * (free - unknowns.start) ** 2).sum())
        weight = weights(residual)
        normal = (jacobian * weight[:, None]).T @ jacobian
        slope = jacobian.T @ (weight * residual) + (prior * (free - unknowns.start))[rows]
        whole = normal + np.diag(prior[rows])
        if round_ == rounds:
            break
        moved, better, little = 0.0, False, False
        while damping < 1e8:
            step = -np.linalg.solve(whole + damping * np.diag(np.diag(whole)), slope)
            step *= min(1.0, MOST / max(float(np.abs(step).max()), 1e-300))
            trial = free.copy()
            trial[rows] += step
            try:
                moved_to = problem.motion(trial, frames, at.dt, keep=True)
                found = problem.seen(moved_to, frames, at.pairs)[0] / scale
                there = cost_of(found)
                there += 0.5 * float((prior * (trial - unknowns.start) ** 2).sum())
            except TooFast:
                there = np.inf
            if there < here:
                little = here - there < max(SETTLED * here, enough)
                free, moved, better = trial, float(np.abs(step).max()), True
                damping = max(damping / DAMPING[1], 1e-8)
                break
            if float(np.abs(step).max()) < CLOSE:
                break
            damping *= DAMPING[1]
        if tell is not None:
            tell(f"{frames} frames, cost {min(here, there if better else here):.4g}")
        if not better or little or moved < CLOSE:
            break
    if len(residual) == 0:
        size = len(unknowns)
        return Fitted(free, 0.0, 0.0, np.zeros((size, size)), np.diag(unknowns.spread**2), [],
                      problem.forward.runs - runs, float(at.motion.strain))  # fmt: skip
    raw = problem.weighed(scale * residual, at.frame, -1.0)
    doubt = len(raw) * math.log(scale) + problem.doubt(at.frame)
    return Fitted(
        free=free,
        cost=here + doubt,
        rms=float(np.sqrt(np.mean(raw**2))),
        information=_spread(normal, rows, len(unknowns)),
        covariance=_covariance(jacobian, weight * residual, weight, at.frame, prior, rows),
        per_frame=[
            float(np.sqrt(np.mean(raw[at.frame == k] ** 2))) if (at.frame == k).any() else 0.0
            for k in range(frames)
        ],
        runs=problem.forward.runs - runs,
        strain=float(at.motion.strain),
        count=len(raw),
    )


def linearise(
    problem: Problem, free: Array, frames: int, rows: NDArray[np.int64] | None = None
) -> Linear:
    """Residuals and their Jacobian about these coordinates.

    Args:
        problem: What is searched.
        free: Free coordinates.
        frames: How many frames count.
        rows: Coordinates that may change; all when None.

    Raises:
        TooFast: They cannot be run at any step tried.
    """
    rows = np.arange(len(problem.unknowns)) if rows is None else rows
    dt, motion = run_at(problem, free, frames)
    pairs = problem.observer.pair(motion)
    residual, frame = problem.seen(motion, frames, pairs)
    if len(residual) == 0:
        return Linear(dt, motion, pairs, residual, frame, 1.0, np.zeros((0, len(rows))))
    scale = max(1.0, 1.4826 * float(np.median(np.abs(residual))))
    residual = residual / scale
    jacobian = _jacobian(problem, free, frames, dt, pairs, residual, rows, scale)
    return Linear(dt, motion, pairs, residual, frame, scale, jacobian)


def run_at(problem: Problem, free: Array, frames: int) -> tuple[float, Motion]:
    """Run the middle of a linearisation, at a step that all runs about it can take."""
    return _steady(lambda dt: problem.motion(free, frames, dt, keep=True), problem.dt(free))


def _steady(run: Callable[[float], Motion], dt: float) -> tuple[float, Motion]:
    """Run at this step, or at the longest of its halves that holds."""
    for _ in range(5):
        try:
            return dt, run(dt)
        except TooFast:
            dt *= 0.5
    raise TooFast


def _jacobian(
    problem: Problem, free: Array, frames: int, dt: float, pairs: Any, residual: Array,
    rows: NDArray[np.int64], scale: float,
) -> Array:  # fmt: skip
    """By forward differences; a coordinate whose step fails is stepped back."""

    def ahead(row: int, sign: float) -> Array:
        trial = free.copy()
        trial[row] += sign * problem.step
        return trial

    def column(motion: Motion, sign: float) -> Array:
        found = problem.seen(motion, frames, pairs)[0] / scale
        return (found - residual) / (sign * problem.step)

    try:
        made = problem.motions([ahead(row, 1.0) for row in rows], frames, dt)
        return np.stack([column(motion, 1.0) for motion in made], axis=1)
    except TooFast:
        pass
    columns = []
    for row in rows:
        for sign in (1.0, -1.0):
            try:
                motion = problem.motion(ahead(row, sign), frames, dt)
            except TooFast:
                continue
            columns.append(column(motion, sign))
            break
        else:
            columns.append(np.zeros_like(residual))
    return np.stack(columns, axis=1)


def _spread(part: Array, rows: NDArray[np.int64], size: int) -> Array:
    whole = np.zeros((size, size))
    whole[np.ix_(rows, rows)] = part
    return whole


def _covariance(
    jacobian: Array, score: Array, weight: Array, frame: NDArray[np.int64], prior: Array,
    rows: NDArray[np.int64],
) -> Array:  # fmt: skip
    """Covariance of the free coordinates; see the head of the file."""
    bread = np.linalg.inv((jacobian * weight[:, None]).T @ jacobian + np.diag(prior[rows]))
    without, whole = [], np.linalg.inv(bread)
    one_pattern = np.zeros(len(rows))
    for k in np.unique(frame):
        here = frame == k
        part = jacobian[here]
        left = whole - (part * weight[here, None]).T @ part
        without.append(np.linalg.solve(left, part.T @ score[here]))
        one_pattern += np.linalg.norm(bread @ part.T, axis=1) * np.linalg.norm(score[here])
    gone = np.stack(without) - np.mean(without, axis=0)
    jackknife = (len(gone) - 1) / len(gone) * gone.T @ gone
    alike = lasting(score, frame) * one_pattern**2
    noise = np.diag(bread)
    ratio = np.sqrt(np.maximum(np.maximum(np.diag(jackknife), alike) / noise, 1.0))
    found = np.diag(1.0 / prior)
    found[np.ix_(rows, rows)] = bread * ratio[:, None] * ratio[None, :]
    return found


def lasting(residual: Array, frame: NDArray[np.int64]) -> float:
    """Correlation of residuals with those of the frame before: 0 of noise, near 1 of a wrong model.

    What a residual has in all frames is left out: points that were seen wrong in frame 0 are so in
    every other. Frames with unlike numbers of residuals do not tell, nor does a correlation that
    noise has by chance.
    """
    parts = [residual[frame == k] for k in np.unique(frame)]
    if len(parts) < 3 or len({len(part) for part in parts}) != 1:
        return 0.0
    each = np.stack(parts)
    each = each - each.mean(axis=0)
    size = float(np.linalg.norm(each[1:]) * np.linalg.norm(each[:-1]))
    if size == 0.0:
        return 0.0
    chance = CHANCE / math.sqrt(each[1:].size)
    return max(0.0, float((each[1:] * each[:-1]).sum()) / size - chance)


def contact_frame(problem: Problem, free: Array) -> int:
    """Frames before anything comes within two cells of the floor, at least one."""
    forward = problem.forward
    if forward.floor is None:
        return len(forward.times)
    low = float(forward.rest[:, 2].min()) - forward.floor
    values = problem.fixed | problem.unknowns.values(free)
    speed = float(forward.start(values)[1][:, 2].min())
    pull = forward.scene.gravity[2]
    for k, time in enumerate(forward.times):
        if low + speed * time + 0.5 * pull * time**2 < 2.0 * forward.dx:
            return max(k, 1)
    return len(forward.times)


def in_stages(
    problem: Problem,
    start: Array,
    *,
    finer: Forward | None = None,
    shares: tuple[float, ...] = SHARES,
    settle: bool = True,
    weigh: bool = True,
    tell: Tell | None = None,
) -> Fitted:
    """Velocities on the frames before contact, then all numbers on more and more frames.

    All frames at once get stuck where the first rebound is wrong. With a finer grid each stage is a
    defect correction: what that grid changes is seen at the last values, and the search goes on
    with it on the coarse grid. How far the change goes on, beyond the finer grid, is learnt.

    Args:
        problem: What is searched; with a finer grid its numbers have :data:`FINER`.
        start: Free coordinates.
        finer: The same scene on a finer grid.
        shares: Of the frames, by stage.
        settle: Search the last stage to its end.
        weigh: There let every frame count by what it is missed by.
        tell: Told of each linearisation.
    """
    frames, free = len(problem.forward.times), start
    moving = problem.unknowns.motion_only()
    before = contact_frame(problem, free)
    if moving.any() and before >= 3:
        free = search(problem, free, before, active=moving, rounds=6, enough=ENOUGH,
                      tell=tell).free  # fmt: skip
    runs = problem.forward.runs
    found = None
    counts = sorted({max(2, round(share * frames)) for share in shares})
    for count in counts:
        last = settle and count == counts[-1]
        for number in range(CORRECTIONS if last and (finer or weigh) else 1):
            if finer is not None:
                problem.refine(finer, free, count)
            if weigh and number and found is not None:
                problem.reweigh(free, count)
            found = search(problem, free, count, rounds=12 if last else 5,
                           enough=0.0 if last and weigh else ENOUGH, tell=tell)  # fmt: skip
            moved, free = float(np.abs(found.free - free).max()), found.free
            if (number or not weigh) and moved < 10.0 * CLOSE:
                break
    assert found is not None
    return dataclasses.replace(found, runs=problem.forward.runs - runs)
