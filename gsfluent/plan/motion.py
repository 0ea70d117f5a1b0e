"""How a scene will move, in closed form: who is on the grid when, how fast, how far debris flies.

Nothing is simulated. Bodies and rigid things fly as boxes on parabolas until their boxes come as
near as the solver lets them (:data:`gsfluent.pipeline.simulate.groups.LANDING`); from then
on a
body is on the grid, and keeps the speed it came with. That is enough for the time step, the number
of steps and the time that the grid is used at all; docs/theory/plan.md compares both with runs.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.pipeline.simulate.engine import CFL
from gsfluent.pipeline.simulate.groups import LANDING
from gsfluent.scene.scene import Blade, Body, Collider, Scene

_TICKS = 400
"""Moments at which the boxes are compared."""
_STRIKE = 0.05
"""Least closing speed [units of sqrt(g dx)] that counts as a strike, not as lying there."""
SPREAD = 0.13
"""Growth of the number of active blocks after a strike that breaks: in units of the blocks of the
whole body, per length (cube root of its volume) that its matter could have flown. Of shots that
shatter, at 20 and 64 cells: 0.12 and 0.18 watermelon, 0.14 melons, 0.02 apple, 0 skull; what is
loose leaves the grid."""
_DRAG = 0.5
"""Half the drag coefficient of a ball in matter that it shatters: the swept matter takes its own
share of momentum."""


@dataclasses.dataclass
class Mover:
    """A body, or a rigid thing, as a box that flies."""

    name: str  # Its name
    low: Tensor  # Lowest corner at ``start`` [m], float64 [3]
    high: Tensor  # Highest corner
    velocity: Tensor  # From ``start`` on [m/s], float64 [3]
    falls: bool  # Whether gravity acts on it
    start: float = 0.0  # When it begins to move [s]
    held: bool = False  # Whether it waits in its place before that; else it comes flying
    body: int | None = None  # Number of its body; None for a rigid thing
    since: float = 0.0  # When it is there at all [s]
    until: float = math.inf  # Until when
    lands: float = math.inf  # Time at which it touches something; infinite when it does not
    strikes: float = math.inf  # Time of its first strike; infinite without one
    speed: float = 0.0  # With which it strikes, relative to what it meets [m/s]
    parts: bool = False  # Whether it is an edge, which parts what it passes and pushes nothing
    told: bool = False  # Whether it moves as told, and nothing stops it
    driven: bool = False  # Whether something that nothing stops has touched it
    size: float = 0.0  # Cube root of its volume [m]

    def box(self, time: float, gravity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Corners [m] and velocity [m/s] at a time."""
        t = min(time, self.lands) - self.start
        t = max(t, 0.0) if self.held else t
        pull = gravity if self.falls else torch.zeros(3, dtype=torch.float64)
        moved = t * self.velocity + 0.5 * t * t * pull
        waits = self.held and time < self.start
        speed = torch.zeros(3, dtype=torch.float64) if waits else self.velocity + t * pull
        return self.low + moved, self.high + moved, speed


@dataclasses.dataclass(frozen=True)
class Outlook:
    """What is to come."""

    movers: tuple[Mover, ...]  # Bodies and rigid things
    grid_from: float  # When the grid is needed first [s]; the end when never
    grid_seconds: float  # Simulated time in which it is needed [s]
    points: float  # Material points on it, mean over that time
    blocks: float  # Active blocks, mean over that time
    blocks_most: float  # Most of them
    substeps: int  # Steps
    dt: float  # Time step with everything intact [s]
    wave: float  # Fastest wave [m/s]
    speed: float  # Speed of what moves fastest on the grid [m/s], mean
    struck: float  # Time of the first strike [s]
    strike_speed: float  # Fastest closing speed [m/s]
    # Whether something strikes fast enough to break what it strikes, or cuts or tears it.
    shatters: bool


def foresee(
    scene: Scene,
    dx: float,
    seconds: float,
    frames: int,
    counts: list[int],
    *,
    cfl: float = CFL,
    blocks: list[float] | None = None,
) -> Outlook:
    """Foresee a scene.

    Args:
        scene: The scene.
        dx: Grid spacing [m].
        seconds: Simulated time [s].
        frames: Frames; the last step before each is shortened.
        counts: Material points of each body.
        cfl: Courant number.
        blocks: Active blocks of each body while it is whole; :func:`intact_blocks` when absent.
    """
    gravity = torch.tensor(scene.gravity, dtype=torch.float64)
    whole = [intact_blocks(body, dx) for body in scene.bodies] if blocks is None else blocks
    limits = [limit_of(body) for body in scene.bodies]
    bodies = [_body(number, body, gravity) for number, body in enumerate(scene.bodies)]
    things = [_thing(thing) for thing in scene.colliders]
    things += [_edge(blade) for blade in scene.blades]
    _meet(bodies, things, scene, dx, seconds, gravity)
    # what pulls and cannot be stopped tears at any speed
    limits = [
        0.0 if m.driven and math.isfinite(n) else n for m, n in zip(bodies, limits, strict=True)
    ]
    wave = max((_fastest(body) for body in scene.bodies), default=0.0)
    landed = [mover.lands for mover in bodies]
    start = min([*landed, seconds])
    left = seconds - start
    ticks = [start + left * (i + 0.5) / _TICKS for i in range(_TICKS)]
    steps = speed_sum = point_sum = block_sum = most = 0.0
    for time in ticks if left > 0.0 else []:
        speed = _speed(bodies, things, scene, gravity, time)
        present = sum(n for n, t in zip(counts, landed, strict=True) if t <= time)
        stored = sum(
            count * (1.0 + (SPREAD * _flown(mover, time) if limit <= mover.speed else 0.0))
            for mover, count, limit in zip(bodies, whole, limits, strict=True)
            if mover.lands <= time
        )
        # every point has its block in the end
        stored = min(stored, 2.0 * present)
        rate = (wave + speed) / (cfl * dx)
        steps += rate * left / _TICKS
        speed_sum += rate * speed
        point_sum += rate * present
        block_sum += rate * stored
        most = max(most, stored)
    weight = steps * _TICKS / left if left > 0.0 else 1.0
    begun = frames * left / seconds if seconds > 0 else 0.0
    cuts = any(m.parts and min(seconds, m.until) > max(start, m.since) for m in things)
    strikes = [m for m in bodies if math.isfinite(m.strikes)]
    return Outlook(
        movers=(*bodies, *things),
        grid_from=start,
        grid_seconds=left,
        points=point_sum / weight,
        blocks=block_sum / weight,
        blocks_most=most,
        substeps=math.ceil(steps + 0.5 * begun) if left > 0.0 else 0,
        dt=cfl * dx / wave if wave > 0 else math.inf,
        wave=wave,
        speed=speed_sum / weight,
        struck=min((m.strikes for m in strikes), default=math.inf),
        strike_speed=max((m.speed for m in strikes), default=0.0),
        shatters=cuts
        or any(m.speed >= n > 0.0 or m.driven for m, n in zip(bodies, limits, strict=True)),
    )


def intact_blocks(body: Body, dx: float) -> float:
    """Active blocks of 4^3 cells that a whole body touches."""
    if body.solid is None:
        if body.length > 0.0:
            across, along = body.radius / (4 * dx), body.length / (4 * dx)
            return (2.0 * across + 2.0) ** 2 * (along + 2.0)
        return (2.0 * body.radius / (4 * dx) + 2.0) ** 3
    solid = body.solid
    index = solid.occupancy.nonzero()
    places = body.frame.apply(solid.voxel_centers(index).to(torch.float64).cpu())
    return float(ops.build_blocks(places.float().contiguous(), dx).coords.shape[0])


def limit_of(body: Body) -> float:
    """Least speed [m/s] of a strike that takes a body apart; infinite for what holds together."""
    laws = {material.law for material in body.materials}
    return 0.0 if laws & {"fluid", "drucker_prager"} else body.breaking_speed


def _fastest(body: Body) -> float:
    return max(material.wave_speed for material in body.materials)


def _body(number: int, body: Body, gravity: Tensor) -> Mover:
    low, high = body.bounds()
    velocity = torch.tensor(body.velocity, dtype=torch.float64)
    return Mover(
        body.name, low, high, velocity, True, body.start, body.held, number,
        size=body.volume ** (1 / 3),
    )  # fmt: skip


def _thing(thing: Collider) -> Mover:
    at = torch.tensor(thing.point, dtype=torch.float64)
    if thing.box is not None:
        low, high = torch.tensor(thing.box, dtype=torch.float64)
        at, reach = 0.5 * (low + high), 0.5 * (high - low)
    elif thing.kind == "box":
        reach = torch.tensor([0.5 * math.hypot(*thing.size)] * 3, dtype=torch.float64)
        if thing.orientation == (1.0, 0.0, 0.0, 0.0):
            reach = 0.5 * torch.tensor(thing.size, dtype=torch.float64)
    else:
        side = thing.radius + 0.5 * thing.length
        reach = torch.full((3,), side, dtype=torch.float64)
    velocity = torch.tensor(thing.velocity, dtype=torch.float64)
    free = thing.mass is not None
    since = max(thing.appears, thing.start if free else 0.0)
    return Mover(
        thing.name, at - reach, at + reach, velocity, free and thing.mass != 0.0, thing.start,
        True, None, since, thing.vanishes, told=thing.mass is None,
    )  # fmt: skip


def _edge(blade: Blade) -> Mover:
    path = torch.tensor(blade.path, dtype=torch.float64)
    reach = 0.5 * blade.width * torch.tensor(blade.edge, dtype=torch.float64).abs()
    length = float((path[1:] - path[:-1]).norm(dim=1).sum())
    way = (path[-1] - path[0]) / max(float((path[-1] - path[0]).norm()), 1e-12)
    end = blade.start + length / blade.speed
    return Mover(
        blade.name, path[0] - reach, path[0] + reach, blade.speed * way, False, blade.start,
        True, None, blade.start, end, parts=True,
    )  # fmt: skip


def _meet(
    bodies: list[Mover],
    things: list[Mover],
    scene: Scene,
    dx: float,
    seconds: float,
    gravity: Tensor,
) -> None:
    """Find out when bodies land and what strikes them."""
    near = LANDING * dx
    least = _STRIKE * math.sqrt(float(gravity.norm()) * dx)
    for tick in range(_TICKS + 1):
        time = seconds * tick / _TICKS
        now = [mover.box(time, gravity) for mover in bodies]
        around = [
            thing.box(time, gravity) if thing.since <= time < thing.until else None
            for thing in things
        ]
        for i, mover in enumerate(bodies):
            if mover.held and time < mover.start:
                continue
            low, _, velocity = now[i]
            found: list[float] = []
            if scene.floor is not None and float(low[2]) - scene.floor < near:
                # on the grid it falls the rest of the way
                rest = max(0.0, float(low[2]) - scene.floor)
                pull = max(0.0, -float(gravity[2]))
                found.append(math.hypot(min(0.0, float(velocity[2])), math.sqrt(2 * pull * rest)))
            for j, other in enumerate(bodies):
                if j != i and not (other.held and time < other.start):
                    found += _closing(now[i], now[j], near)
            for thing, box in zip(things, around, strict=True):
                touch = [] if box is None else _closing(now[i], box, near)
                found += [0.0 for _ in touch] if thing.parts else touch
                mover.driven |= bool(touch) and thing.told
            if not found:
                continue
            moment = time
            if not math.isfinite(mover.lands):
                moment = mover.lands = _sooner(mover, scene, time, seconds / _TICKS, near, gravity)
            closing = max(found)
            if closing > least and closing > mover.speed:
                mover.strikes, mover.speed = min(mover.strikes, moment), closing


def _sooner(
    mover: Mover, scene: Scene, time: float, tick: float, near: float, gravity: Tensor
) -> float:
    """The exact time of a landing on the floor within the last tick; else its end."""
    if scene.floor is None or time <= 0.0:
        return time
    low, high = max(0.0, time - tick), time
    if float(mover.box(high, gravity)[0][2]) - scene.floor >= near:
        return time
    for _ in range(30):
        middle = 0.5 * (low + high)
        if float(mover.box(middle, gravity)[0][2]) - scene.floor < near:
            high = middle
        else:
            low = middle
    return high


def _closing(
    a: tuple[Tensor, Tensor, Tensor], b: tuple[Tensor, Tensor, Tensor], near: float
) -> list[float]:
    """Speed at which two boxes come together, when they are near; else nothing."""
    gap = torch.maximum(a[0] - b[1], b[0] - a[1]).clamp(min=0.0)
    return [float((a[2] - b[2]).norm())] if float(gap.norm()) < near else []


def _flown(mover: Mover, time: float) -> float:
    """How many body lengths the matter of a struck body could have flown by then."""
    if time <= mover.strikes:
        return 0.0
    return mover.speed * (time - mover.strikes) / max(mover.size, 1e-9)


def _speed(
    bodies: list[Mover], things: list[Mover], scene: Scene, gravity: Tensor, time: float
) -> float:
    """Speed of what moves fastest on the grid [m/s]."""
    found = [0.0]
    for mover in bodies:
        if mover.lands <= time:
            found.append(float(mover.box(mover.lands, gravity)[2].norm()))
    for thing in things:
        if not thing.since <= time < thing.until:
            continue
        speed = float(thing.velocity.norm())
        kept = 1.0
        collider = next((c for c in scene.colliders if c.name == thing.name), None)
        if collider is not None and collider.mass is not None and collider.mass > 0.0:
            hit = [m for m in bodies if m.strikes <= time and m.speed >= 0.5 * speed > 0.0]
            kept = min((_kept(collider, m, scene) for m in hit), default=1.0)
        found.append(kept * speed)
    return max(found)


def _kept(ball: Collider, target: Mover, scene: Scene) -> float:
    """Share of its speed that a rigid ball keeps when it goes through a body."""
    body = scene.bodies[target.body or 0]
    row = body.material.parameters()
    density = float(row[..., 6].mean())
    path = float((target.high - target.low).mean())
    swept = density * math.pi * ball.radius**2 * min(path, 2.0 * path)
    through = math.exp(-_DRAG * swept / max(ball.mass or 0.0, 1e-12))
    together = (ball.mass or 0.0) / ((ball.mass or 0.0) + density * body.volume)
    return max(through, together)
