"""A prepared object one can poke while it is simulated: throw it, shoot at it, cut it.

Each poke is an event of a shot with ``at`` = now, entered into the running simulation
(:mod:`gsfluent.pipeline.simulate.grow`), so there is one physics for both, and what happened here
can be written down as a shot. A session is driven frame by frame from one thread;
:class:`gsfluent.live.player.LivePlayer` drives it beside a viewer.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from gsfluent.errors import InputError
from gsfluent.live.scene import live_cells
from gsfluent.pipeline.cracks.stage import Repair
from gsfluent.pipeline.matter.carry import Carry
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.debris import reach_of
from gsfluent.pipeline.simulate.grow import copy_of, grow, shrink
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import QUALITY, Simulate, frame_of
from gsfluent.results.frames import SavedFrame
from gsfluent.scene.parts import number, unit, vector
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import saved

_log = logging.getLogger(__name__)

POKES = ("throw", "bullet", "blade", "press", "pour")
"""Events that can come while the simulation runs."""
SETTLE = 3.0
"""Simulated seconds after which an object that does not come to rest counts as prepared [s]."""
CRACKS = "mvee"
"""How cracks get splats: fine faces (``gap``) cost as much as the simulation does, and make many
times as many splats."""
MOST_LOOSE = 24
"""Bullets and jets at a time; the oldest leaves for a new one."""


class LiveSession:
    """A scene that is simulated while somebody pokes it.

    What stands on the floor sleeps from time 0 until it is poked, and costs nothing; what does not
    (a thing in the air, a heap) can be let come to rest by :meth:`settle`. The same pokes at the
    same simulated times give the same frames on one device, and the same as a shot with these
    events.

    Args:
        scene: Solids, colliders, floor; it is not changed.
        quality: ``live`` (cells by device and size, see :func:`live_cells`), or one of
            :data:`gsfluent.pipeline.simulate.stage.QUALITY`.
        device: Where to compute.
        fps: Frames per simulated second at normal speed.
        slow: Slow motion: a frame is ``1 / (fps * slow)`` simulated seconds.
        seed: Seed of points and weakness.
        dx: Grid spacing [m]; overrides ``quality``.
        cracks: Method of :class:`gsfluent.pipeline.Repair`.
        options: Further arguments of :class:`gsfluent.pipeline.Simulate`.

    Raises:
        InputError: A scene without a solid, an unknown quality or a number out of range.

    Attributes:
        pokes: The events since :meth:`reset`, as a shot file has them.
        dropped: Material points that left because they were far away.
        failure: Why the simulation cannot go on; empty while it can.
        index: Number of the last frame since the start of the session's clock.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        quality: str = "live",
        device: torch.device | str = "cpu",
        fps: float = 30.0,
        slow: float = 1.0,
        seed: int = 0,
        dx: float | None = None,
        cracks: str = CRACKS,
        **options: Any,
    ) -> None:
        if not any(body.solid is not None for body in scene.bodies):
            raise InputError("live: there is no object to poke", hint="give a solid or a run")
        number("live: fps", fps, low=1.0, high=1e4)
        if quality == "live":
            cells = live_cells(scene, torch.device(device))
        elif quality in QUALITY:
            cells = QUALITY[quality]
        else:
            known = ", ".join(("live", *QUALITY))
            raise InputError(f"live: unknown quality {quality!r}", hint=f"known: {known}")
        self.device, self.seed, self.quality = torch.device(device), seed, quality
        self.cells, self.dx = cells, grid_spacing(scene, cells)
        if dx is not None:
            self.cells = max(1, round(cells * self.dx / number("live: dx", dx, low=1e-9)))
            self.dx = dx
        self.fps = fps
        self._simulate = Simulate(
            dx=self.dx,
            seed=seed,
            device=device,
            **({"standing": True} | options),
        )
        start = copy_of(scene)
        self._first = self._simulate.run_of(start, fps)
        self.solids = len(scene.bodies)
        self.cracks = cracks
        self._history = Repair(cracks).begin(Carry.bind(start, self._first.matter))
        self._reach = reach_of(self._first.matter)
        self._prepared = self._first.twin(), 0, (0, 0.0)
        self.dropped = 0
        self.slow = 1.0
        self._restart(0, self._first, (0, 0.0))
        self.set_slow(slow)

    def _restart(self, index: int, run: Run, base: tuple[int, float]) -> None:
        self.index, self._base, self.failure = index, base, ""
        self.run = run.twin()
        self._history.restore({})
        self.pokes: list[dict[str, Any]] = []
        self._frame: SavedFrame | None = None
        self._rest: tuple[State, bool] | None = None

    # --- time ---

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.run.state.time

    @property
    def scene(self) -> Scene:
        """The scene now, with what the pokes brought."""
        return self.run.scene

    @property
    def interval(self) -> float:
        """Simulated time between two frames [s]."""
        return 1.0 / (self.fps * self.slow)

    def set_slow(self, slow: float) -> None:
        """Slow motion from the next frame on: 4 shows what happens at a quarter of its speed.

        Raises:
            InputError: Not between 0.05 and 10000.
        """
        slow = number("live: slow motion", slow, low=0.05, high=1e4)
        if slow != self.slow:
            self.slow = slow
            self._base = (self.index, self.time)

    @property
    def at_rest(self) -> bool:
        """Whether nothing can happen without a poke: all matter sleeps, nothing moves."""
        state = self.run.state
        if self._rest is None or self._rest[0] is not state:
            self._rest = state, self._rests(state)
        return self._rest[1]

    def _rests(self, state: State) -> bool:
        run = self.run
        if not all(state.landed) or run.impulses.next_change(state) < math.inf:
            return False
        stepper = run.stepper
        changes = min(stepper.rigid.next_change(state.time), stepper.blades.next_change(state.time))
        if changes < math.inf or stepper.blades.speed(state.time) > 0.0:
            return False
        if stepper.rigid.count and stepper.rigid.moving(state.colliders).shape[0]:
            return False
        if not bool((state.asleep | state.loose).all()):
            return False
        return not bool((state.particles.velocity[state.loose].abs() > 1e-6).any())

    def settle(self, seconds: float = SETTLE) -> bool:
        """Let everything come to rest and remember it for :meth:`reset`; frames are not kept.

        Args:
            seconds: Simulated time after which it is left as it is [s].

        Returns:
            Whether all is at rest.
        """
        end = self.time + number("live: seconds", seconds, low=0.0)
        while not self.at_rest and self.time < end and not self.failure:
            self._advance()
        rest = self.at_rest
        if not self.failure:
            self._prepared = self.run.twin(), self.index, self._base
        return rest

    def reset(self, *, start: bool = False) -> None:
        """Go back to the prepared object, and to its time; nothing has been poked.

        Args:
            start: Back to time 0 instead, before it came to rest.
        """
        if start:
            self._restart(0, self._first, (0, 0.0))
            return
        run, index, base = self._prepared
        self._restart(index, run, base)
        if self.interval != 1.0 / (self.fps * self.slow):
            self._base = (self.index, self.time)

    def step(self) -> SavedFrame | None:
        """Simulate up to the next frame; None when the simulation cannot go on."""
        return self.frame() if self._advance() else None

    def advance(self, seconds: float) -> list[SavedFrame]:
        """Simulate for a while.

        Args:
            seconds: Simulated time [s]; as many whole frames as fit.

        Returns:
            The frames; fewer when the simulation cannot go on (see :attr:`failure`).

        Raises:
            InputError: Not a number, or negative.
        """
        count = round(number("live: seconds", seconds, low=0.0) / self.interval)
        frames = []
        for _ in range(count):
            frame = self.step()
            if frame is None:
                break
            frames.append(frame)
        return frames

    def frame(self) -> SavedFrame:
        """This moment as a frame of a run."""
        if self._frame is None:
            with torch.no_grad():
                whole = frame_of(self.run, self.index, self._history, self.time)
                self._frame = saved(whole, self.scene)
                del self.run.per_frame[:]
        return self._frame

    def _advance(self) -> bool:
        if self.failure:
            return False
        first, begin = self._base
        until = begin + (self.index + 1 - first) / (self.fps * self.slow)
        with torch.no_grad():
            if not self.run.advance_to(self.index + 1, None, until):
                self.failure = self.run.failure
                _log.warning("live: %s", self.failure)
                return False
            self.index += 1
            self._frame = None
            self._forget_far()
        del self.run.watch.reasons[:-4]
        return True

    def _forget_far(self) -> None:
        """Let bullets and jets go that are out of reach of everything."""
        state, matter = self.run.state, self.run.matter
        loose = range(self.solids, len(matter.ranges))
        if not loose:
            return
        end = matter.ranges[self.solids - 1][1]
        middle = state.position[:end].median(dim=0).values
        gone = []
        for body in loose:
            a, b = matter.ranges[body]
            near = (state.position[a:b] - middle).norm(dim=1).min()
            if float(near) > self._reach:
                gone.append(body)
        self._drop(gone)

    def _drop(self, gone: Sequence[int]) -> None:
        if gone:
            ranges = self.run.matter.ranges
            self.dropped += sum(ranges[body][1] - ranges[body][0] for body in gone)
            shrink(self.run, gone, solids=self.solids)

    # --- pokes ---

    def poke(self, event: Mapping[str, Any]) -> dict[str, Any]:
        """Let something happen now.

        Args:
            event: An event as a shot file has it; ``at`` is set to now.

        Returns:
            The event with its time.

        Raises:
            InputError: A bad event, one that cannot come later, or the simulation has failed.
        """
        if self.failure:
            raise InputError(f"live: the simulation has failed: {self.failure}", hint="reset()")
        kind = event.get("type")
        if kind not in POKES:
            raise InputError(f"live: {kind!r} is no poke", hint=f"one of {', '.join(POKES)}")
        now = dict(event) | {"at": self.time}
        scene = self._with(now)
        if len(scene.bodies) - self.solids > MOST_LOOSE:
            self._drop([self.solids])
            scene = self._with(now)
        if kind == "bullet":
            self._muzzle_is_free(vector("bullet from", now["from"]), float(now.get("radius", 8e-3)))
        with torch.no_grad():
            grow(self.run, scene, seed=self.seed)
        self._frame = self._rest = None
        self.pokes.append(now)
        return now

    def _with(self, event: Mapping[str, Any]) -> Scene:
        scene = copy_of(self.scene)
        scene.add_event(event)
        if event["type"] == "throw" and event["at"] == 0.0:  # what stands here stands already
            scene = copy_of(self.scene)
            rest = (0.0, 0.0, 0.0)
            scene.impulse(event["velocity"], event.get("spin", rest), event.get("object"), 0.0)
        return scene

    def throw(
        self,
        velocity: Sequence[float],
        spin: Sequence[float] = (0.0, 0.0, 0.0),
        object: str | None = None,
    ) -> dict[str, Any]:
        """Push the object: ``velocity`` [m/s] and ``spin`` [rad/s] are added to its motion."""
        event: dict[str, Any] = {"type": "throw", "velocity": list(vector("velocity", velocity))}
        event["spin"] = list(vector("spin", spin))
        return self.poke(event | ({} if object is None else {"object": object}))

    def shoot(
        self,
        origin: Sequence[float],
        direction: Sequence[float],
        speed: float = 60.0,
        radius: float = 0.008,
        density: float = 7800.0,
        *,
        rigid: bool = False,
    ) -> dict[str, Any]:
        """Fire a ball.

        Args:
            origin: Where it starts [m].
            direction: Where it flies; any length but 0.
            speed: [m/s].
            radius: [m].
            density: [kg/m^3].
            rigid: Rigid instead of elastic, see :meth:`gsfluent.Scene.bullet`.
        """
        start, way = vector("shoot from", origin), unit("shoot direction", direction)
        speed = number("shoot speed", speed, low=1e-3, high=1e4)
        toward = [a + b for a, b in zip(start, way, strict=True)]
        return self.poke(
            {
                "type": "bullet",
                "from": list(start),
                "toward": toward,
                "speed": speed,
                "radius": radius,
                "density": density,
                "rigid": rigid,
            }
        )

    def cut(
        self,
        path: Sequence[Sequence[float]],
        speed: float = 2.0,
        *,
        width: float | None = None,
        edge: Sequence[float] | None = None,
        thickness: float = 0.0,
    ) -> dict[str, Any]:
        """Draw a blade along a path; see :meth:`gsfluent.Scene.blade`.

        Args:
            path: Where the middle of its edge goes [m].
            speed: Along the path [m/s].
            width: Length of the edge [m]; default: across all there is.
            edge: Direction of the edge.
            thickness: How far it pushes the sides apart [m].
        """
        event: dict[str, Any] = {"type": "blade", "path": path, "speed": speed}
        event |= {"width": 3.0 * self.bounds()[1] if width is None else width}
        event |= (
            {"thickness": thickness} if edge is None else {"edge": edge, "thickness": thickness}
        )
        return self.poke(event)

    def cut_plane(
        self, normal: Sequence[float], point: Sequence[float] | None = None, speed: float = 2.0
    ) -> dict[str, Any]:
        """Cut everything along a plane, from above where it is upright.

        Args:
            normal: Of the plane.
            point: In the plane [m]; default: the middle of the matter.
            speed: Of the blade [m/s].
        """
        out = torch.tensor(unit("cut normal", normal), dtype=torch.float64)
        middle, radius = self.bounds()
        at = middle if point is None else vector("cut point", point)
        down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
        way = down - (down @ out) * out
        if float(way.norm()) < 0.2:  # nearly level: it comes from the side
            side = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
            way = side - (side @ out) * out
        way = way / way.norm()
        center = torch.tensor(at, dtype=torch.float64)
        path = [(center + s * 1.1 * radius * way).tolist() for s in (-1.0, 1.0)]
        edge = torch.linalg.cross(out, way)
        return self.cut(path, speed, width=2.4 * radius, edge=edge.tolist())

    def bounds(self) -> tuple[tuple[float, float, float], float]:
        """Middle of the solids' matter [m] and the radius around it that holds nine tenths."""
        end = self.run.matter.ranges[self.solids - 1][1]
        place = self.run.state.position[:end]
        middle = place.median(dim=0).values
        far = (place - middle).norm(dim=1)
        x, y, z = middle.tolist()
        kept = far[:: max(1, far.shape[0] // 100_000)]
        return (x, y, z), 1.1 * float(torch.quantile(kept, 0.9))

    def _muzzle_is_free(self, start: tuple[float, float, float], radius: float) -> None:
        place = self.run.state.position
        gap = (place - torch.tensor(start, dtype=place.dtype, device=place.device)).norm(dim=1)
        if float(gap.min()) < radius + self.dx:
            raise InputError("live: the bullet would start inside the matter", hint="step back")

    # --- figures ---

    def report(self) -> dict[str, Any]:
        """Plain figures: verdict, particles, cells, steps, what sleeps, what was dropped."""
        report = self.run.report()
        names = ("verdict", "reason", "substeps", "composed_steps", "dx", "particles", "rollbacks")
        values = {name: report[name] for name in names}
        values |= {"dropped_points": self.dropped, "pokes": len(self.pokes)}
        return values | {"momentum_error": report["momentum_error"]}
