"""Short coarse runs of a shot's own scene, and what of them a viewer sees.

Nobody sees where a material point is. Seen are where each body is, how far it reaches, how fast it
all moves, how much has broken and how large the largest piece is; for what shatters these are
statistics, and the scatter between seeds says how far two runs differ by chance alone.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent.choose.fit import History
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

__all__ = ["ACTIVE", "Probe", "Seen", "distance", "histories", "probe", "window"]

Array = NDArray[np.float64]

REACH = (0.05, 0.95)
"""Shares of a body's points between which its extents are taken: splinters do not count."""
_SHARES = ("broken share", "largest piece")
ACTIVE = 0.05
"""Share of the largest stored and dissipated energy from which something is happening."""


@dataclasses.dataclass(frozen=True)
class Seen:
    """What one run showed."""

    tracks: dict[str, Array]  # Per body centre of mass and extents by frame [m], name to [T, 6]
    kinetic: Array  # Kinetic energy of all matter [J], [T]
    elastic: Array  # Stored energy [J], [T]
    dissipated: Array  # Energy lost, beyond what gravity gave [J], [T]
    momentum: Array  # [N s], [T, 3]
    broken: Array  # Share of the mass that is broken, [T]
    largest: Array  # Share of the mass in the largest piece, [T]
    mass: float  # Of all matter [kg]
    length: float  # Extent of the largest solid along its longest side [m]

    @property
    def frames(self) -> int:
        """Frames seen."""
        return int(self.kinetic.shape[0])


@dataclasses.dataclass(frozen=True)
class Probe:
    """One run at one setting."""

    cells: int  # Cells along the largest solid
    cfl: float  # Courant number
    seed: int  # Of point positions and weakness
    seen: Seen  # What it showed, from time 0
    seconds: float  # Wall time of the steps [s]
    points: int  # Material points
    point_steps: Array  # Points moved on the grid, summed over steps, by frame, [T]
    steps: int  # Steps of the grid
    blocks: float  # Blocks of the grid in use, mean over the steps
    fields: int  # Most velocity fields
    composed: int  # Steps of the composable operators
    failed: str = ""  # Why it broke off, or empty


def probe(
    scene: Scene,
    cells: int,
    *,
    fps: float,
    frames: int,
    options: SolverOptions,
    seed: int,
    device: torch.device | str = "cpu",
    tick: Callable[[], None] | None = None,
) -> Probe:
    """Run a scene without its splats and watch it.

    Args:
        scene: The scene; it is not changed.
        cells: Cells along the largest solid.
        fps: Frames per second.
        frames: How many, from time 0.
        options: How the matter is moved.
        seed: Seed of point positions and weakness.
        device: Where to compute.
        tick: Called after every frame.
    """
    stage = Simulate(
        dx=grid_spacing(scene, cells), seed=seed, device=device, splats=False, repair=False,
        options=options,
    )  # fmt: skip
    with torch.no_grad():
        run = stage.run_of(scene, fps)
        rows: list[dict[str, Array]] = []
        spent: list[int] = []
        for frame in range(frames):
            if not run.advance_to(frame, None):
                break
            run.record(frame)
            rows.append(_tracks(run))
            spent.append(run.stepper.counters.particle_steps)
            if tick is not None:
                tick()
    kept, counters = run.per_frame, run.stepper.counters

    def column(name: str) -> Array:
        return np.array([row[name] for row in kept], dtype=np.float64)

    tracks = {name: np.stack([row[name] for row in rows]) for name in (rows[0] if rows else {})}
    solids = [b for b in scene.bodies if b.solid is not None] or scene.bodies
    length = max(float((high - low).max()) for low, high in (b.bounds() for b in solids))
    seen = Seen(
        tracks=tracks, kinetic=column("kinetic"), elastic=column("elastic"),
        dissipated=column("dissipated"), momentum=column("momentum").reshape(-1, 3),
        broken=column("damaged_fraction"), largest=column("largest_fragment"),
        mass=float(run.matter.particles.mass.sum()), length=length,
    )  # fmt: skip
    return Probe(
        cells=cells, cfl=options.cfl, seed=seed, seen=seen, seconds=run.seconds,
        points=run.matter.particles.count, point_steps=np.array(spent, dtype=np.float64),
        steps=counters.steps, blocks=counters.block_steps / max(counters.steps, 1),
        fields=counters.fields_max, composed=counters.composed_steps, failed=run.failure,
    )  # fmt: skip


def _tracks(run: Run) -> dict[str, Array]:
    """Centre of mass and extents of each body now, [6] in metres."""
    found = {}
    position, mass = run.state.position.to(torch.float64), run.matter.particles.mass
    shares = torch.tensor(REACH, dtype=torch.float64, device=position.device)
    for body, (first, last) in zip(run.scene.bodies, run.matter.ranges, strict=True):
        where, weight = position[first:last], mass[first:last].to(torch.float64)
        centre = (weight[:, None] * where).sum(dim=0) / weight.sum()
        # sorted and interpolated here: torch.quantile refuses more than 16 million values
        ordered, at = where.sort(dim=0).values, shares * (last - first - 1)
        low = at.floor().long()
        high = (low + 1).clamp(max=last - first - 1)
        edge = torch.lerp(ordered[low], ordered[high], (at - low)[:, None])
        found[body.name] = torch.cat([centre, edge[1] - edge[0]]).cpu().numpy()
    return found


def window(seen: Seen, frames: int) -> tuple[int, int]:
    """First and last + 1 frame to look at: from just before something happens, so many frames.

    It happens when the stored and lost energy pass :data:`ACTIVE` of the most they will reach.
    """
    active = seen.elastic + np.maximum(seen.dissipated, 0.0)
    most = float(active.max(initial=0.0))
    first = int((active > ACTIVE * most).argmax()) if most > 0.0 else 0
    first = max(0, first - 1)
    last = min(seen.frames, first + frames)
    return max(0, min(first, last - frames)), last


def histories(
    levels: Sequence[Sequence[Probe]], first: int, last: int, scale: Seen
) -> list[History]:
    """Observables of several levels on the same frames, each in units of its own scale.

    Places and extents are over the object's length, energy over the most there is in ``scale``,
    momentum over that of all mass at the largest kinetic energy; broken matter and the largest
    piece are shares already.

    Args:
        levels: Runs per level, coarse to fine.
        first: First frame.
        last: Last frame + 1.
        scale: A run over the whole shot.
    """
    runs = [probe.seen for level in levels for probe in level]
    sizes = tuple(1.0 / level[0].cells for level in levels)
    length = scale.length
    energy = float((scale.kinetic + scale.elastic).max())
    # of what is pulled apart the momenta cancel: what counts is how much of it there could be
    momentum = math.sqrt(2.0 * scale.mass * float(scale.kinetic.max()))
    chaotic = any(bool((seen.broken[:last] > 0.0).any()) for seen in runs)
    rows: list[tuple[str, Callable[[Seen], Array]]] = []
    for name in runs[0].tracks:
        label = f" of {name}" if len(runs[0].tracks) > 1 else ""
        rows.append((f"centre of mass{label}", _column(name, 0, length)))
        rows.append((f"extents{label}", _column(name, 3, length)))
    if momentum > 0.0:
        rows.append(("momentum", lambda seen: seen.momentum / momentum))
    if energy > 0.0:
        rows.append(("energy", lambda seen: ((seen.kinetic + seen.elastic) / energy)[:, None]))
    if chaotic:
        rows.append((_SHARES[0], lambda seen: seen.broken[:, None]))
        rows.append((_SHARES[1], lambda seen: seen.largest[:, None]))
    return [
        History(
            name=name,
            sizes=sizes,
            values=tuple(np.stack([read(p.seen)[first:last] for p in level]) for level in levels),
            chaotic=chaotic,
            most=1.0 if name in _SHARES else math.inf,
        )
        for name, read in rows
    ]


def _column(name: str, at: int, length: float) -> Callable[[Seen], Array]:
    return lambda seen: seen.tracks[name][:, at : at + 3] / length


def distance(first: Array, second: Array) -> float:
    """Rms distance of two histories [T, K]."""
    gap = first - second
    return math.sqrt(float((gap**2).sum(axis=-1).mean()))
