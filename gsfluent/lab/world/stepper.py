"""One MPM step of a :class:`gsfluent.lab.world.driver.World` on the composable ops.

p2g, grid update, g2p and return map, as in docs/theory/mpm.md. A periodic axis is made of images:
points
within reach of one face appear again behind the other, give mass and momentum there, and are
forgotten before the points move. That is exact, since every node near a face receives all it would
receive on a torus.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.damage import DamageField
from gsfluent.ops.plasticity import INSTANT, weakened
from gsfluent.ops.reference import spring

REACH = 3.0
"""Width of the layer that is repeated behind a periodic face [dx]: a point reads nodes up to 1.5
away, and those receive from points up to 1.5 further."""
GRADIENT_LIMIT = 0.3
"""Largest ``dt |grad v|`` of one automatic step."""
LAW_FLUID = 4


@dataclasses.dataclass
class Scene:
    """What does not change while a world runs (see :class:`gsfluent.lab.world.driver.World`)."""

    mass: Tensor
    volume: Tensor
    dx: float
    law: Tensor
    params: Tensor
    material: Tensor
    body: Tensor | None
    fields: int
    gravity: tuple[float, float, float]
    colliders: Tensor | None
    friction: float
    restitution: float
    contact_gap: float
    cfl: float
    fixed_dt: float | None
    period: tuple[float | None, float | None, float | None]
    irreversible: bool
    return_map: dict[str, Any]
    frame: tuple[float, float, float] | None = None
    radius: Tensor | None = None
    viscous: Tensor | None = None  # viscosity of each point, [N, 9]; ops.viscous_step
    objects: Tensor | None = None
    flip: float = 0.0


def wave_speed(strain: Tensor, law: Tensor, params: Tensor) -> Tensor:
    """Fastest wave in the strained material [m/s], [N].

    Solids: acoustic modulus of the neo-Hookean law in a uniaxial state (equations.md 2.1),
    ``kappa (1 + J^2) / 2 + (2 mu / 9) (J^(4/3) + 5 J^(-2/3))``; fluids: ``K J^(-gamma-1)``, at
    least its value at rest.
    """
    xx, yy, zz, xy, xz, yz = strain.unbind(-1)
    xx, yy, zz = xx + 1.0, yy + 1.0, zz + 1.0
    squared = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    squared = squared.clamp(min=1e-4)  # J^2
    third = squared ** (1.0 / 3.0)
    mu, kappa, density = params[:, 0], params[:, 1], params[:, 6]
    solid = 0.5 * kappa * (1.0 + squared) + 2.0 / 9.0 * mu * (third * third + 5.0 / third)
    gamma = torch.where(params[:, 7] > 0, params[:, 7], 7.0)
    fluid = kappa * (squared ** (-0.5 * (gamma + 1.0))).clamp(min=1.0)
    return torch.sqrt(torch.where(law == LAW_FLUID, fluid, solid) / density)


def automatic_dt(scene: Scene, strain: Tensor, velocity: Tensor, affine: Tensor) -> float:
    """Time step [s] of a scene in a state: the fixed one, or cfl * dx / (wave speed + speed).

    Raises:
        FloatingPointError: The state allows none.
    """
    if scene.fixed_dt is not None:
        return scene.fixed_dt
    rows = scene.material.long()
    speed = wave_speed(strain, scene.law[rows], scene.params[rows]).max()
    fastest = float(speed + velocity.norm(dim=1).max())
    dt = scene.cfl * scene.dx / fastest if fastest > 0 else float("inf")
    steepest = float(torch.linalg.matrix_norm(affine).max())
    if steepest > 0:
        dt = max(min(dt, GRADIENT_LIMIT / steepest), 0.25 * dt)
    if not 0.0 < dt < float("inf"):
        raise FloatingPointError(
            f"no time step: fastest wave and point {fastest:.3g} m/s, "
            f"velocity gradient {steepest:.3g} 1/s"
        )
    return dt


class Pushed:
    """What colliders give to the points of a scene in a step, summed about the nodes.

    One collider rubs at a node, as in the solver: all here have the same velocity and friction, or
    are far from each other.
    """

    def __init__(
        self, scene: Scene, position: Tensor, velocity: Tensor, blocks: ops.Blocks, dt: float,
        body: Tensor | None,
    ) -> None:  # fmt: skip
        assert scene.colliders is not None and scene.radius is not None
        where = scene.material.long()
        params = scene.params[where]
        wave = ((params[:, 1] + 4.0 / 3.0 * params[:, 0]) / params[:, 6]).sqrt()
        length = scene.volume ** (1.0 / 3.0)
        longest = scene.fixed_dt or scene.cfl * scene.dx / float(wave.max())
        x = blocks.node_positions(scene.dx, position.dtype)
        none = torch.zeros(len(position), 3, 3, dtype=position.dtype, device=position.device)
        self.parts: list[tuple[Tensor, Tensor]] = []
        held = []
        for row in scene.colliders:
            pushes = spring.springs(row)
            impulse = torch.zeros_like(position)
            if pushes:
                own = row[10:13] + torch.linalg.cross(
                    row[20:23].expand_as(position), position - row[3:6]
                )
                impulse = spring.point_push(
                    row, None, position, scene.radius, params[:, 6] * scene.volume, wave, length,
                    scene.dx, dt, velocity - own, longest,
                )  # fmt: skip
            summed, _ = ops.p2g(
                position, impulse / scene.mass[:, None], none, scene.mass, dx=scene.dx,
                blocks=blocks, body=body, fields=scene.fields,
            )  # fmt: skip
            self.parts.append((row, summed[..., :3]))
            deep = row.clone()
            if pushes and int(row[0]) == 0:
                deep[3:6] -= spring.NODE * scene.dx * row[6:9] / row[6:9].norm()
            elif pushes:
                raise ValueError("World: by 'ops' only planes push points")
            held.append(deep)
        self.holding = torch.stack(held)
        total = torch.stack([j for _, j in self.parts]).sum(0)
        self.momentum = torch.nn.functional.pad(total, (0, 1))
        self._x = x

    def rub(self, velocity: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities after friction, and the impulse of every collider [K, 3]."""
        given = []
        for row, push in self.parts:
            own = row[10:13] + torch.linalg.cross(row[20:23].expand_as(self._x), self._x - row[3:6])
            after = spring.node_friction(velocity, own, push, row[2] * push.norm(dim=-1), mass)
            rubbed = mass[..., None] * (after - velocity)
            given.append((push + rubbed).double().sum(dim=(0, 1, 2)))
            velocity = after
        return velocity, torch.stack(given)


class Stepper:
    """State of the points and the step that advances it; precision is that of the tensors."""

    def __init__(
        self,
        scene: Scene,
        position: Tensor,
        velocity: Tensor,
        affine: Tensor,
        strain: Tensor,
        alpha: Tensor,
        deformation: Tensor | None,
    ):
        self.scene = scene
        self.position, self.velocity, self.affine = position, velocity, affine
        self.gradient = affine  # of the velocity at the nodes, by which the last step strained
        self.strain, self.alpha, self.deformation = strain, alpha, deformation
        self.peak, self.viscous = alpha, scene.viscous
        self.cracks = DamageField(scene.law, scene.params, scene.material)
        if self.cracks.exists and any(scene.period):
            raise ValueError("World: phase_field knows no periodic axes")
        rows = 0 if scene.colliders is None else scene.colliders.shape[0]
        self.impulse = torch.zeros(rows, 3, dtype=torch.float64, device=position.device)
        self.time, self.steps = 0.0, 0
        self.info = torch.zeros(4, dtype=torch.int64, device=position.device)
        self._blocks: ops.Blocks | None = None
        self._travelled = 0.0
        # the stress of the first step belongs to the strain given: a step without motion, of a
        # length that only viscosity reads
        still = torch.zeros_like(affine)
        self.stress = self._thickened(self._map(still, INSTANT)[:3], still, 0.0)[3]

    def _rows(self) -> tuple[Tensor, Tensor, Tensor | None]:
        scene = self.scene
        if self.cracks.exists or (scene.irreversible and bool((self.peak > 0).any())):
            return *weakened(scene.law, scene.params, scene.material, self.peak), None
        return scene.law, scene.params, scene.material

    def _map(self, increment: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        law, params, material = self._rows()
        return ops.return_mapping(
            self.strain, self.alpha, increment,
            law=law, params=params, material=material, dt=dt, **self.scene.return_map,
        )  # fmt: skip

    def _thickened(
        self, returned: tuple[Tensor, Tensor, Tensor], increment: Tensor, dt: float
    ) -> tuple[Tensor | None, Tensor, Tensor, Tensor]:
        """What viscosity makes of a step of the law."""
        scene, viscous = self.scene, self.viscous
        if viscous is None:
            return None, *returned
        return ops.viscous_step(
            viscous, self.strain, self.alpha, increment, returned, law=scene.law,
            params=scene.params, material=scene.material, dt=dt,
        )  # fmt: skip

    def limit(self) -> float:
        """Time step [s]: the fixed one, or the automatic one of the current state."""
        return automatic_dt(self.scene, self.strain, self.velocity, self.affine)

    def shift(self, way: Tensor) -> None:
        """Move the points over the grid by a way [m], [3] or [N, 3]."""
        self.position, self._blocks = self.position + way.to(self.position), None

    def advance(self, dt: float) -> None:
        """Advance by one step of ``dt`` seconds."""
        scene, count = self.scene, self.position.shape[0]
        rows, place = self._images()
        take = (lambda t: t) if rows is None else (lambda t: t[rows])
        body = None if scene.body is None else take(scene.body)
        blocks = self._find_blocks(place, dt, fresh=rows is not None)
        contact = scene.fields > 1
        if self.cracks.exists:
            self.peak = self.cracks.step(
                self.alpha, self.peak, place, scene.volume, dx=scene.dx, blocks=blocks, body=body
            )
        grid, moments = ops.p2g(
            place, take(self.velocity), take(self.affine), take(scene.mass),
            dx=scene.dx, blocks=blocks, dt=dt, stress=take(self.stress),
            volume=take(scene.volume), body=body, fields=scene.fields, contact=contact,
        )  # fmt: skip
        push = None if rows is not None else self._pushed(grid, blocks, dt, body)
        grid_velocity, impulse, _ = ops.grid_update(
            grid if push is None else grid + push.momentum, dx=scene.dx, dt=dt, blocks=blocks,
            gravity=scene.gravity, colliders=scene.colliders if push is None else push.holding,
            moments=moments, friction=scene.friction, restitution=scene.restitution,
            contact_gap=scene.contact_gap,
        )  # fmt: skip
        if push is not None:
            grid_velocity, given = push.rub(grid_velocity, grid[..., 3])
            impulse = impulse + given
        own = self._own(place, take, blocks, body)
        deformation = None if self.deformation is None else take(self.deformation)
        x, v, c, f, skipped = ops.g2p(
            grid_velocity, place, dx=scene.dx, dt=dt, blocks=blocks, body=body,
            deformation=deformation, velocity=take(self.velocity), return_skipped=True,
        )  # fmt: skip
        if int(skipped):
            raise FloatingPointError(
                f"{int(skipped)} points are not finite or left the grid after {self.steps} steps"
            )
        self.position = x[:count]
        self.gradient = c[:count]
        increment = dt * self.gradient
        if own is not None:
            # what moves by v and has another velocity would change its angular momentum
            spin = (-2.0 * dt / scene.dx**2) * torch.linalg.cross(v, own[0])
            turn = torch.linalg.cross(spin[:, :, None], torch.eye(3).to(spin)[None], dim=1)
            v, c = v + own[0], c + own[1] + turn
        self.velocity, self.affine = v[:count], c[:count]
        self.deformation = None if f is None else f[:count]
        *returned, info = self._map(increment, dt)
        after = self._thickened((returned[0], returned[1], returned[2]), increment, dt)
        self.viscous, self.strain, self.alpha, self.stress = after
        self.info += info
        self.peak = self.cracks.grown(self.peak, self.alpha)
        self.impulse += impulse
        self.time += dt
        self.steps += 1

    def _own(
        self, place: Tensor, take: Callable[[Tensor], Tensor], blocks: ops.Blocks,
        body: Tensor | None,
    ) -> tuple[Tensor, Tensor] | None:  # fmt: skip
        """Velocity and affine matrix that points keep of what the transfer alone would take."""
        scene = self.scene
        if scene.flip == 0.0:
            return None
        velocity, affine = take(self.velocity), take(self.affine)
        free, _ = ops.p2g(
            place, velocity, affine, take(scene.mass), dx=scene.dx, blocks=blocks, body=body,
            fields=scene.fields,
        )  # fmt: skip
        momentum, mass = free[..., :3], free[..., 3:]
        nodes = torch.where(mass > 1e-30, momentum / mass.clamp(min=1e-30), 0.0)
        _, v, c, _ = ops.g2p(nodes, place, dx=scene.dx, dt=0.0, blocks=blocks, body=body)
        slow, fast = scene.flip, scene.flip**0.5  # docs/theory/mpm.md
        lost = affine - c
        across = lost.transpose(1, 2)
        shear, spin = 0.5 * (lost + across), 0.5 * (lost - across)
        return slow * (velocity - v), fast * shear + slow * spin

    def _pushed(
        self, grid: Tensor, blocks: ops.Blocks, dt: float, body: Tensor | None
    ) -> Pushed | None:
        scene = self.scene
        if scene.radius is None or scene.colliders is None:
            return None
        return Pushed(scene, self.position, self.velocity, blocks, dt, body)

    def _find_blocks(self, place: Tensor, dt: float, *, fresh: bool) -> ops.Blocks:
        speed = float(self.velocity.abs().max())
        reach = 1.25 * speed * dt + 10.0 * dt * dt
        blocks = self._blocks
        if fresh or blocks is None or blocks.expired(self._travelled + reach, self.scene.dx):
            blocks, self._travelled = ops.build_blocks(place, self.scene.dx), 0.0
        self._blocks, self._travelled = blocks, self._travelled + reach
        return blocks

    def _images(self) -> tuple[Tensor | None, Tensor]:
        """Rows of the points and their images, and where they are; None without periods."""
        period: Sequence[float | None] = self.scene.period
        if not any(period):
            return None, self.position
        place, rows = self.position.clone(), torch.arange(self.position.shape[0])
        rows = rows.to(place.device)
        for axis, length in enumerate(period):
            if length is None:
                continue
            place[:, axis] = torch.remainder(place[:, axis], length)
        self.position = place
        for axis, length in enumerate(period):
            if length is None:
                continue
            layer = REACH * self.scene.dx
            copies, sources = [place], [rows]
            for near, shift in (
                (place[:, axis] < layer, length),
                (place[:, axis] > length - layer, -length),
            ):
                moved = place[near].clone()
                moved[:, axis] += shift
                copies.append(moved)
                sources.append(rows[near])
            place, rows = torch.cat(copies), torch.cat(sources)
        return rows, place
