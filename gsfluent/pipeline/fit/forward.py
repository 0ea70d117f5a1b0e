"""The motion of a scene as a function of numbers: the resident solver in float64.

Points lie on an unshaken lattice, the time step is the same for all runs of a linearisation, and
the solver's sums do not hang on their order: so differences of 1e-4 are clean.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.materials import LAWS, Material
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.fit.parameters import OFFSET, VECTORS
from gsfluent.pipeline.fit.together import MOST_POINTS, Lane, Setup, agreed, moved
from gsfluent.pipeline.matter.points import (
    POINTS_PER_CELL,
    body_frame,
    sample_points,
    select,
    shared_out,
    start_of,
)
from gsfluent.scene.scene import Scene
from gsfluent.targets.target import Motion, Setting

CFL = 0.4
HASTE = 1.3
"""Margin of the time step for waves that matter under pressure carries faster."""


class Matter(NamedTuple):
    """Points and materials of a run.

    Attributes:
        params: Rows of :func:`gsfluent.ops.return_mapping`, [M, 8].
        alpha: Of each row at the start, [M].
        law: int32 [M].
        material: Row of each point, int32 [N copies].
        mass: [kg], [N copies].
        volume: [m^3], [N copies].
        copies: How many points lie at each place; what a place shows is that of the first.
    """

    params: Tensor
    alpha: Tensor
    law: Tensor
    material: Tensor
    mass: Tensor
    volume: Tensor
    copies: int


class Forward:
    """A scene on a grid, to be run again and again.

    Args:
        scene: Bodies of laws that do not break, rigid colliders that stand or move steadily.
        times: Of the frames [s], ascending from 0.
        dx: Grid spacing [m].
        seed: Of the point positions, as far as anything is random.
        device: Where the solver runs; what it shows lies on the CPU.

    Raises:
        InputError: A body breaks, is a bullet or a liquid jet, or a collider is driven.
    """

    def __init__(
        self, scene: Scene, times: list[float], dx: float, seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        self.scene, self.times, self.dx, self.device = scene, times, dx, torch.device(device)
        self.runs = 0
        step = dx / POINTS_PER_CELL ** (1 / 3)
        self._bodies: list[dict[str, Any]] = []
        rows, row, laws = [], 0, []
        places, velocities, affines, masses, volumes = [], [], [], [], []
        self.ranges: list[tuple[int, int]] = []
        done = 0
        for body in scene.bodies:
            if body.solid is None or body.start != 0.0 or body.held:
                raise InputError(
                    f"fit: {body.name!r} is shot or poured", "learn from objects that are there"
                )
            points = sample_points(body.solid, step / body.frame.scale, seed=seed, jitter=0.0)
            # a lattice that meets the faces of voxels takes more on one side than on the other
            middle = body.solid.voxel_centers().double().cpu().mean(dim=0)
            points = points + (middle - points.mean(dim=0))
            count = points.shape[0]
            layers = [body.material, *(part.material(body.material) for part in body.parts)]
            index = torch.zeros(count, dtype=torch.int64)
            for number, part in enumerate(body.parts, 1):
                index[select(part, body, points)] = number
            for material in layers:
                if material.law in ("nacc", "rigid"):
                    raise InputError(
                        f"fit: {body.name!r} has law {material.law}",
                        "give it a law that does not break: elastic, von_mises, fluid, ...",
                    )
                laws.append(LAWS[material.law])
            density = torch.tensor([float(m.parameters()[..., 6].mean()) for m in layers])
            volume = torch.full((count,), body.volume / count, dtype=torch.float64)
            mass = volume * density.double()[index]
            own = torch.tensor([LAWS[m.law] for m in layers])
            mass = shared_out(mass, body, points, volume, own, dx)
            position, velocity, affine = start_of(body, scene, points, mass)
            places.append(position.double())
            velocities.append(velocity.double())
            affines.append(affine.double().expand(count, 3, 3))
            masses.append(mass)
            volumes.append(volume)
            rows.append(index + row)
            self._bodies.append({"body": body, "layers": layers, "first": row})
            self.ranges.append((done, done + count))
            row += len(layers)
            done += count
        self.rest = torch.cat(places)
        self._velocity, self._affine = torch.cat(velocities), torch.cat(affines)
        self._mass, self._volume = torch.cat(masses), torch.cat(volumes)
        self._material = torch.cat(rows).to(torch.int32)
        self._laws = torch.tensor(laws, dtype=torch.int32)
        self.rigid = RigidSet(scene, dx)
        if self.rigid.frees or self.rigid.grips or scene.blades:
            raise InputError(
                "fit: a free collider, a grip or a blade is in the scene",
                "learn from floors and from colliders that stand or move steadily",
            )
        self.floor = scene.floor
        # grains mix less than a liquid: their deformation carries what lies between them better
        # than their neighbours do, 4 mm against 14 in a heap on 16 cells
        self.solid = LAWS["fluid"] not in laws

    def setting(self) -> Setting:
        """What a target may know of the scene."""
        splats = []
        for entry in self._bodies:
            body = entry["body"]
            if body.solid.gaussians.count:
                placed = body.solid.gaussians.to("cpu", torch.float32)
                splats.append(placed.transformed(body_frame(body, self.scene)))
        return Setting(
            rest=self.rest, solid=self.solid, dx=self.dx, floor=self.floor,
            splats=Gaussians.cat(splats) if splats else None, colliders=self.rigid.names,
            velocity=self.rigid.start[:, 10:13],
        )  # fmt: skip

    @property
    def count(self) -> int:
        """Number of points."""
        return self.rest.shape[0]

    def step(self, values: Mapping[str, Any]) -> float:
        """A time step that these numbers can take [s]."""
        wave = max(m.wave_speed for m in self._materials(values))
        speed = float(self.start(values)[1].norm(dim=1).max())
        pull = math.hypot(*self.scene.gravity)
        speed += pull * min(self.times[-1], 1.0)
        speed = max(speed, float(self.rigid.speed(self.rigid.start)))
        return CFL * self.dx / (HASTE * wave + speed)

    @property
    def side_by_side(self) -> int:
        """How many runs are best done as one, of bodies that never meet.

        A GPU is idle with a few thousand points. A floor is the same for all of them; what stands
        anywhere else is not.
        """
        if self.device.type != "cuda" or self.scene.colliders:
            return 1
        return max(1, MOST_POINTS // self.count)

    def run(self, values: Mapping[str, Any], frames: int, dt: float) -> Motion:
        """Move the scene.

        Args:
            values: Numbers by key; what is not named is as in the scene.
            frames: How many of the frames.
            dt: Longest time step [s]; divided so that frames are met.

        Raises:
            TooFast: The step was too long.
        """
        return self.run_all([values], frames, dt)[0]

    def run_all(self, sets: Sequence[Mapping[str, Any]], frames: int, dt: float) -> list[Motion]:
        """Move the scene with each of these sets of numbers, side by side in one run of the solver.

        Args:
            sets: See :meth:`run`.
            frames: How many of the frames.
            dt: Longest time step [s]; divided so that frames are met.

        Raises:
            TooFast: The step was too long for one of them.
        """
        self.runs += len(sets)
        dt = agreed(dt)
        setup = Setup(
            self.dx, dt, tuple(self.times[:frames]), self.scene.gravity, self.scene.friction,
            self.rigid.start, self.rigid.sdf, self.device,
        )  # fmt: skip
        shifts = [self.rest.new_tensor([0.0, 0.0, float(v.get(OFFSET, 0.0)) * self.dx])
                  for v in sets]  # fmt: skip
        lanes = [self._lane(v, dt, shift) for v, shift in zip(sets, shifts, strict=True)]
        made = moved(setup, lanes, alone=bool(self.scene.colliders))
        return [m._replace(position=m.position - s) for m, s in zip(made, shifts, strict=True)]

    def _lane(self, values: Mapping[str, Any], dt: float, shift: Tensor) -> Lane:
        """Points with these numbers as the solver takes them."""
        matter = self._matter(values)
        copies = matter.copies
        position, velocity, affine = self.start(values)
        # a step of the solver kicks first, then drifts: half a kick less makes it second order
        first = next((t for t in self.times if t > 0.0), dt)
        kick = 0.5 * first / max(1, math.ceil(first / dt - 1e-9))
        velocity = velocity - kick * velocity.new_tensor(self.scene.gravity)
        eye = torch.eye(3, dtype=torch.float64)
        fields = {
            "position": (position + shift).repeat(copies, 1),
            "velocity": velocity.repeat(copies, 1), "mass": matter.mass, "volume": matter.volume,
            "law": matter.law, "params": matter.params, "material": matter.material,
            "alpha": matter.alpha[matter.material.long()], "affine": affine.repeat(copies, 1, 1),
            "deformation": eye.repeat(copies * self.count, 1, 1),
        }  # fmt: skip
        body = self._fields()
        body = None if body is None else body.repeat(copies)
        return Lane(fields, body, self.count, self._reach())

    def _reach(self) -> float:
        """A whole number of blocks [m] that bodies side by side never cross."""
        span = self.rest.amax(dim=0) - self.rest.amin(dim=0)
        speed = float(self._velocity.norm(dim=1).max()) + 5.0
        reach = 2.0 * float(span.max()) + 2.0 * speed * self.times[-1] + 16.0 * self.dx
        return 4.0 * self.dx * math.ceil(reach / (4.0 * self.dx))

    def _matter(self, values: Mapping[str, Any]) -> Matter:
        """Points and materials with these numbers."""
        materials = self._materials(values)
        return Matter(
            torch.stack([m.parameters() for m in materials]),
            torch.tensor([float(m.start_alpha) for m in materials], dtype=torch.float64),
            self._laws, self._material, self._mass, self._volume, 1,
        )  # fmt: skip

    def _materials(self, values: Mapping[str, Any]) -> list[Material]:
        """Materials of all layers with these numbers; parts keep their own."""
        found: list[Material] = []
        for entry in self._bodies:
            name = entry["body"].name
            labels = [name, *(f"{name}/{part.name}" for part in entry["body"].parts)]
            for label, layer in zip(labels, entry["layers"], strict=True):
                changes = {
                    field: values[f"{label}.{field}"]
                    for field in layer.reads
                    if f"{label}.{field}" in values
                }
                found.append(dataclasses.replace(layer, **changes) if changes else layer)
        return found

    def start(self, values: Mapping[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, velocities and their gradients at time 0 with these numbers."""
        velocity, affine = self._velocity, self._affine
        for (a, b), entry in zip(self.ranges, self._bodies, strict=True):
            body = entry["body"]
            for name in VECTORS:
                key = f"{body.name}.{name}"
                if key not in values:
                    continue
                more = velocity.new_tensor(values[key]) - velocity.new_tensor(getattr(body, name))
                velocity, affine = velocity.clone(), affine.clone()
                if name == "velocity":
                    velocity[a:b] += more
                    continue
                mass = self._mass[a:b, None]
                arm = self.rest[a:b] - (mass * self.rest[a:b]).sum(dim=0) / mass.sum()
                x, y, z = more.tolist()
                spin = velocity.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
                velocity[a:b] += arm @ spin.T
                affine[a:b] += spin
        return self.rest, velocity, affine

    def _fields(self) -> Tensor | None:
        if len(self.ranges) == 1:
            return None
        sizes = torch.tensor([b - a for a, b in self.ranges])
        return torch.arange(len(sizes)).repeat_interleave(sizes).to(torch.int32)
