"""How fast the bodies of a run were met by something, and how much of each broke.

Kept beside the frames, so that a run that is taken up again knows what came before.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from gsfluent.io import write_json
from gsfluent.ops.collider import NORMAL, TYPE, TYPES, VELOCITY
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.simulate.groups import LANDING
from gsfluent.pipeline.simulate.stage import SimulationFrame
from gsfluent.scene.scene import Scene
from gsfluent.stages.breaking import breaking_rows

FILE = "strikes.json"
WHOLE = 1e-3
"""Share of a body's mass that may break while the body still counts as unbroken."""
_FELT = 0.05
"""Least change of velocity [approach speed] within a frame that shows that two things touched."""
_UNTOUCHED = 1e-5
"""Change of velocity [approach speed] within a frame that is only rounding."""
_LEAST = 1e-3
"""Least approach speed of a strike [m/s], where gravity sets none."""


class Strikes:
    """Watches the frames of a run.

    A strike lies between two frames. Its speed is taken before it: that of the centres of mass
    relative to each other, which a contact has not slowed yet; against a plane along its normal,
    with what the rest of the fall adds. Turning is left out.

    Args:
        scene: What is simulated.
        matter: Its material points.
        folder: Where :data:`FILE` is kept; what it says of frames to come is dropped.
    """

    def __init__(self, scene: Scene, matter: Matter, folder: Path) -> None:
        self.scene, self.matter, self.path = scene, matter, folder / FILE
        self.gravity = torch.tensor(scene.gravity, dtype=torch.float64)
        # what falls no further than a cell has been put down, not dropped
        self.least = max(_LEAST, math.sqrt(2.0 * float(self.gravity.norm()) * matter.dx))
        self.rows: list[dict[str, Any]] = []
        self.met: list[dict[str, Any]] = []
        self.broken = [0.0] * len(scene.bodies)
        with suppress(OSError, ValueError, KeyError, TypeError):
            kept = json.loads(self.path.read_text(encoding="utf-8"))
            self.rows, self.met, self.broken = kept["rows"], kept["met"], kept["broken"]

    def see(self, frame: SimulationFrame) -> None:
        """Take in the next frame."""
        # a run may have stopped between writing this file and its own state
        self.rows = [row for row in self.rows if row["index"] < frame.index]
        self.met = [strike for strike in self.met if strike["frame"] < frame.index]
        row = self._row(frame)
        if self.rows and self.rows[-1]["index"] == frame.index - 1:
            self.met += self._between(self.rows[-1], row)
        self.rows.append(row)
        shares = [body["broken"] for body in row["bodies"]]
        self.broken = [max(pair) for pair in zip(self.broken, shares, strict=True)]

    def keep(self, ended: bool = False) -> None:
        """Write what is known so far, to go on from here or from where this was called before.

        Args:
            ended: Nothing goes on from here: only the last row is kept, however often this was
                called.

        Raises:
            RunError: The disk is full.
        """
        if ended:
            self.rows = self.rows[-1:]
        write_json(self.path, {"rows": self.rows, "met": self.met, "broken": self.broken})
        self.rows = self.rows[-1:]

    def unbroken(self) -> list[dict[str, Any]]:
        """Brittle bodies that were struck, in a run in which none of them broke; else nothing.

        Returns:
            By body: ``body``, ``material`` (its weakest), ``met`` (by what it was struck
            fastest), ``speed`` [m/s], ``speed_needed``
            (:func:`gsfluent.stages.breaking.breaks_from`) [m/s] and ``hint``.
        """
        brittle = {
            number: body
            for number, body in enumerate(self.scene.bodies)
            if math.isfinite(body.breaking_speed)
        }
        dx = self.matter.dx
        if any(self.broken[number] >= WHOLE for number in brittle):
            return []
        found = []
        for number, body in brittle.items():
            strikes = [strike for strike in self.met if strike["body"] == number]
            if not strikes:
                continue
            hardest = max(strikes, key=lambda strike: float(strike["speed"]))
            rows = breaking_rows(body, hardest["speed"], float(self.gravity.norm()), dx)
            finite = [row for row in rows if row["breaks_from"] is not None]
            weakest = min(finite, key=lambda row: float(row["breaks_from"]))
            found.append(
                {
                    "body": body.name,
                    "material": weakest["material"],
                    "met": hardest["with"],
                    "speed": hardest["speed"],
                    "speed_needed": weakest["breaks_from"],
                    "hint": weakest["hint"],
                }
            )
        return found

    def _row(self, frame: SimulationFrame) -> dict[str, Any]:
        """What of a frame the search for strikes needs."""
        p, brittle = frame.particles, self.matter.brittle
        bodies: list[dict[str, Any]] = []
        lows, highs = [], []
        for body, (start, end) in zip(self.scene.bodies, self.matter.ranges, strict=True):
            mass = p.mass[start:end].double()
            total = mass.sum()
            moved = p.velocity[start:end].double().nan_to_num()
            velocity = (mass[:, None] * moved).sum(dim=0) / total
            if body.held and body.start > frame.time:  # it waits to be fired
                velocity = velocity.new_tensor(body.velocity)
            place = p.position[start:end].double().nan_to_num()
            lows.append(place.amin(dim=0))
            highs.append(place.amax(dim=0))
            lost = (mass * (frame.broken & brittle)[start:end]).sum() / total
            bodies.append({"velocity": velocity.tolist(), "broken": float(lost)})
        gaps = self._gaps(frame, torch.stack(lows), torch.stack(highs))
        for row, mine, low, high in zip(bodies, gaps, lows, highs, strict=True):
            row |= {"gaps": mine, "low": low.tolist(), "high": high.tolist()}
        things = [
            {
                "velocity": thing[VELOCITY : VELOCITY + 3],
                "normal": thing[NORMAL : NORMAL + 3] if thing[TYPE] == TYPES["plane"] else None,
                "there": thing[TYPE] >= 0,
            }
            for thing in frame.colliders.tolist()
        ]
        return {"index": frame.index, "time": frame.time, "bodies": bodies, "things": things}

    def _gaps(
        self, frame: SimulationFrame, low: torch.Tensor, high: torch.Tensor
    ) -> list[list[float | None]]:
        """Distance from each body's box to each rigid thing [m]; None for what is not there."""
        rows = frame.colliders
        found: list[list[float | None]] = [[] for _ in self.scene.bodies]
        for number in range(rows.shape[0]):
            there = int(rows[number, TYPE]) >= 0
            gaps = (
                frame.rigid.gaps(rows[number : number + 1], low, high)
                if there
                else [None] * len(low)
            )
            for mine, gap in zip(found, gaps, strict=True):
                mine.append(gap)
        return found

    def _between(self, before: dict[str, Any], after: dict[str, Any]) -> list[dict[str, Any]]:
        """The strikes between two frames: ``frame``, ``body``, ``with`` and ``speed`` [m/s]."""
        found = []
        for number, body in enumerate(self.scene.bodies):
            if not math.isfinite(body.breaking_speed):
                continue
            speeds = self._by_things(number, before, after)
            speeds |= self._by_bodies(number, before, after)
            found += [
                {"frame": after["index"], "body": number, "with": name, "speed": speed}
                for name, speed in speeds.items()
                if speed > self.least
            ]
        return found

    def _by_things(
        self, number: int, before: dict[str, Any], after: dict[str, Any]
    ) -> dict[str, float]:
        """Speeds at which rigid things came to a body and were felt."""
        dt = after["time"] - before["time"]
        mine, then = before["bodies"][number], after["bodies"][number]
        change = self._change(mine, then, dt)
        speeds = {}
        colliders = {collider.name: collider for collider in self.scene.colliders}
        for i, thing in enumerate(before["things"]):
            now, name = after["things"][i], self._names[i]
            if not now["there"] or (name in colliders and colliders[name].kind == "grip"):
                continue
            velocity = thing["velocity"]
            if not thing["there"]:  # it came to be in between
                velocity = colliders[name].velocity
            relative = torch.tensor(mine["velocity"]).double() - torch.tensor(velocity).double()
            gap = max(0.0, mine["gaps"][i] if thing["there"] else then["gaps"][i])
            felt = change
            if thing["normal"] is not None:
                normal = torch.tensor(thing["normal"], dtype=torch.float64)
                into = max(0.0, -float(relative @ normal))
                pull = max(0.0, -float(self.gravity @ normal))
                # what the fall adds until it is there, or until the frame ends
                speed = min(math.sqrt(into**2 + 2.0 * pull * gap), into + pull * dt)
            else:
                speed = float(relative.norm())
                collider = colliders.get(name)
                if collider is not None and collider.mass is not None and thing["there"]:
                    # a light bullet is felt in the bullet
                    felt = max(felt, self._change(thing, now, dt, falls=collider.mass > 0.0))
                felt -= float(self.gravity.norm()) * dt  # a body that lies there feels its support
            near = LANDING * self.matter.dx + speed * dt
            if gap <= near and felt > _FELT * speed:
                speeds[name] = speed
        return speeds

    def _by_bodies(
        self, number: int, before: dict[str, Any], after: dict[str, Any]
    ) -> dict[str, float]:
        """Speeds at which other bodies came to a body and were felt."""
        dt = after["time"] - before["time"]
        mine, then = before["bodies"][number], after["bodies"][number]
        change, speeds = self._change(mine, then, dt), {}
        low, high = torch.tensor(mine["low"]), torch.tensor(mine["high"])
        for other, body in enumerate(self.scene.bodies):
            if other == number:
                continue
            theirs = before["bodies"][other]
            if body.held and body.start >= after["time"]:
                continue
            velocity = torch.tensor(mine["velocity"]) - torch.tensor(theirs["velocity"])
            speed = float(velocity.norm())
            apart = torch.maximum(
                low - torch.tensor(theirs["high"]), torch.tensor(theirs["low"]) - high
            )
            gap = float(apart.clamp(min=0.0).norm())
            answer = self._change(theirs, after["bodies"][other], dt)
            felt = max(change, answer) - float(self.gravity.norm()) * dt
            met = min(change, answer) > _UNTOUCHED * speed  # one that flies on met nothing
            if met and gap <= LANDING * self.matter.dx + speed * dt and felt > _FELT * speed:
                speeds[body.name] = speed
        return speeds

    @property
    def _names(self) -> list[str]:
        """Names of the rigid things, in the order of their rows."""
        floor = [] if self.scene.floor is None else ["floor"]
        return [*floor, *(collider.name for collider in self.scene.colliders)]

    def _change(
        self, before: dict[str, Any], after: dict[str, Any], dt: float, *, falls: bool = True
    ) -> float:
        """Change of velocity beyond that of a free fall [m/s]."""
        old, new = (torch.tensor(row["velocity"], dtype=torch.float64) for row in (before, after))
        return float((new - old - (self.gravity * dt if falls else 0.0)).norm())
