"""Taylor bars by finite elements: an independent answer for the same law.

Axisymmetric four-node elements with one point of integration that move with the metal, float64:
Jaumann rate, radial return, viscous control of hourglass modes (Flanagan and Belytschko 1981) and
artificial viscosity (Wilkins 1980). Nothing here is shared with the solver.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Flow = Callable[[Numbers, Numbers, Numbers], Numbers]

HOURGLASS, LINEAR, QUADRATIC = 0.05, 0.06, 1.5
"""Shares of viscosity: of hourglass modes, of the wave speed and of the rate of a compression."""
MODE = np.array([1.0, -1.0, 1.0, -1.0])
BISECTIONS = 45


@dataclasses.dataclass(frozen=True)
class Metal:
    """A metal: stiffness [Pa], density [kg/m^3], yield stress [Pa].

    Args:
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: [kg/m^3].
        flow: Yield stress [Pa] of plastic strain, its rate [1/s] and plastic work [J/m^3].
    """

    young: float
    poisson: float
    density: float
    flow: Flow

    @property
    def bulk(self) -> float:
        """Bulk modulus [Pa]."""
        return self.young / (3.0 * (1.0 - 2.0 * self.poisson))

    @property
    def shear(self) -> float:
        """Shear modulus [Pa]."""
        return self.young / (2.0 * (1.0 + self.poisson))

    @property
    def wave(self) -> float:
        """P-wave speed [m/s]."""
        return math.sqrt((self.bulk + 4.0 / 3.0 * self.shear) / self.density)


class Mesh:
    """Elements of a bar whose corners are ``x``: area, mean radius and slopes of the shapes."""

    def __init__(self, x: Numbers, corners: NDArray[np.int64]) -> None:
        self.r, self.z = x[corners, 0], x[corners, 1]
        r, z = self.r, self.z
        self.across = np.stack([z[:, 1] - z[:, 3], z[:, 2] - z[:, 0]], axis=1)
        self.along = np.stack([r[:, 3] - r[:, 1], r[:, 0] - r[:, 2]], axis=1)
        self.area = 0.5 * (
            (r[:, 2] - r[:, 0]) * (z[:, 3] - z[:, 1]) - (r[:, 3] - r[:, 1]) * (z[:, 2] - z[:, 0])
        )
        half = 0.5 / self.area[:, None]
        self.slope_r = half * np.concatenate([self.across, -self.across], axis=1)
        self.slope_z = half * np.concatenate([self.along, -self.along], axis=1)
        self.middle = r.mean(axis=1)
        diagonal = np.maximum(
            np.hypot(r[:, 2] - r[:, 0], z[:, 2] - z[:, 0]),
            np.hypot(r[:, 3] - r[:, 1], z[:, 3] - z[:, 1]),
        )
        self.width = self.area / diagonal


class Bar:
    """A bar that hits a rigid wall at z = 0 without friction.

    Args:
        metal: What it is made of.
        radius: [m].
        length: [m].
        speed: Of the impact [m/s].
        across: Elements across the radius.

    Attributes:
        x: Corners (r, z) [m], [across + 1, along + 1, 2].
        v: Their velocities [m/s], likewise.
        strain: Plastic strain of the elements.
    """

    def __init__(
        self, metal: Metal, radius: float, length: float, speed: float, across: int = 8
    ) -> None:
        self.metal, self.length = metal, length
        along = round(length / radius * across)
        r, z = np.linspace(0.0, radius, across + 1), np.linspace(0.0, length, along + 1)
        self._x = np.stack(np.meshgrid(r, z, indexing="ij"), axis=-1).reshape(-1, 2)
        self._shape = (across + 1, along + 1, 2)
        node = np.arange(len(self._x)).reshape(self._shape[:2])
        self._corners = np.stack(
            [node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]], axis=-1
        ).reshape(-1, 4)
        mesh, count = Mesh(self._x, self._corners), len(self._corners)
        lean = radius / across / 12.0  # the inner corners of an element of a ring get less
        inner, outer = (
            0.5 * metal.density * mesh.area * (0.5 * mesh.middle + s * lean) for s in (-1, 1)
        )
        self._mass = self._sum(np.stack([inner, outer, outer, inner], axis=1))
        self._v = np.zeros_like(self._x)
        self._v[:, 1] = -speed
        self._v[node[:, 0], 1] = 0.0
        self._axis = node[0]
        self._deviator = np.zeros((4, count))  # rr, zz, around, rz
        self._pressure, self._work = np.zeros(count), np.zeros(count)
        self.strain, self.time = np.zeros(count), 0.0

    @property
    def x(self) -> Numbers:
        """Corners (r, z) [m]."""
        return self._x.reshape(self._shape)

    @property
    def v(self) -> Numbers:
        """Velocities of the corners [m/s]."""
        return self._v.reshape(self._shape)

    def energy(self) -> float:
        """Kinetic energy of the whole bar [J]."""
        return float(math.pi * (self._mass * (self._v**2).sum(axis=1)).sum())

    def momentum(self) -> float:
        """Along the axis [N s]."""
        return float(2.0 * math.pi * (self._mass * self._v[:, 1]).sum())

    def _sum(self, values: Numbers) -> Numbers:
        """What elements give to their corners, added up."""
        total: Numbers = np.bincount(self._corners.ravel(), values.ravel(), len(self._x)).astype(
            np.float64
        )
        return total

    def run(self, seconds: float, cfl: float = 0.5) -> None:
        """Move it on.

        Raises:
            FloatingPointError: An element turned inside out.
        """
        end = self.time + seconds
        while self.time < end:
            mesh = Mesh(self._x, self._corners)
            if not (mesh.area > 0.0).all():
                raise FloatingPointError(f"an element is inside out at {self.time:.3g} s")
            dt = min(cfl * float(mesh.width.min()) / self.metal.wave, end - self.time)
            self._step(mesh, dt)
            self.time = end if dt == end - self.time else self.time + dt

    def _step(self, mesh: Mesh, dt: float) -> None:
        metal = self.metal
        vr, vz = self._v[self._corners, 0], self._v[self._corners, 1]
        rr, zz = (mesh.slope_r * vr).sum(axis=1), (mesh.slope_z * vz).sum(axis=1)
        rz, zr = (mesh.slope_z * vr).sum(axis=1), (mesh.slope_r * vz).sum(axis=1)
        around = vr.mean(axis=1) / mesh.middle
        grows = rr + zz + around
        self._stress(np.stack([rr, zz, around, 0.5 * (rz + zr)]), 0.5 * (rz - zr), grows, dt)
        size = np.sqrt(mesh.area)
        damp = metal.density * size * (LINEAR * metal.wave - QUADRATIC * size * grows) * grows
        mean = np.where(grows < 0.0, damp, 0.0) - self._pressure
        srr, szz, sat, srz = self._deviator + np.stack([mean, mean, mean, 0.0 * mean])
        ring = (mesh.area * mesh.middle)[:, None]
        fr = ring * (srr[:, None] * mesh.slope_r + srz[:, None] * mesh.slope_z)
        fr += (0.25 * mesh.area * sat)[:, None]
        fz = ring * (szz[:, None] * mesh.slope_z + srz[:, None] * mesh.slope_r)
        mode = MODE - (MODE * mesh.r).sum(axis=1)[:, None] * mesh.slope_r
        mode -= (MODE * mesh.z).sum(axis=1)[:, None] * mesh.slope_z
        stiff = (0.25 * HOURGLASS * metal.density * metal.wave * size * mesh.middle)[:, None] * mode
        fr += stiff * (mode * vr).sum(axis=1)[:, None]
        fz += stiff * (mode * vz).sum(axis=1)[:, None]
        force = np.stack([self._sum(fr), self._sum(fz)], axis=1)
        self._v = self._v - dt * force / self._mass[:, None]
        self._v[self._axis, 0] = 0.0
        below = self._x[:, 1] + dt * self._v[:, 1] < 0.0
        self._v[below, 1] = -self._x[below, 1] / dt
        self._x = self._x + dt * self._v

    def _stress(self, rate: Numbers, spin: Numbers, grows: Numbers, dt: float) -> None:
        """Deviator, pressure, strain and plastic work after a step of this rate of strain."""
        shear = self.metal.shear
        self._pressure = self._pressure - self.metal.bulk * grows * dt
        rr, zz, _, rz = self._deviator
        off = rate - np.stack([grows, grows, grows, 0.0 * grows]) / 3.0
        turned = np.stack([2.0 * rz, -2.0 * rz, 0.0 * rz, zz - rr]) * spin
        trial = self._deviator + dt * (2.0 * shear * off + turned)
        q = np.sqrt(1.5 * (trial[:3] ** 2).sum(axis=0) + 3.0 * trial[3] ** 2)
        yields = q > self.metal.flow(self.strain, 0.0 * q, self._work)
        low, high = np.zeros(int(yields.sum())), q[yields] / (3.0 * shear)
        for _ in range(BISECTIONS):
            slip = 0.5 * (low + high)
            left = q[yields] - 3.0 * shear * slip
            now = self.metal.flow(self.strain[yields] + slip, slip / dt, self._work[yields])
            low, high = np.where(left > now, slip, low), np.where(left > now, high, slip)
        slip = np.zeros_like(q)
        slip[yields] = 0.5 * (low + high)
        after = q - 3.0 * shear * slip
        self._deviator = trial * (after / np.maximum(q, 1e-300))
        self.strain, self._work = self.strain + slip, self._work + after * slip

    def measures(self) -> tuple[float, float, float]:
        """Length on the axis, radius of the foot and at a fifth of the first length [m]."""
        x, height = self.x, 0.2 * self.length
        side = x[-1]
        above = int(np.argmax(side[:, 1] > height))
        low, high = side[above - 1], side[above]
        share = (height - low[1]) / (high[1] - low[1])
        return float(x[0, -1, 1]), float(x[-1, 0, 0]), float(low[0] + share * (high[0] - low[0]))
