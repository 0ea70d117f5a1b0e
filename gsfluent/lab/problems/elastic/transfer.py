"""What the transfers between points and grid must keep: straight flight, affine flow, spin."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import ball, box, parameters, rotation

BENCH = "GaussianBench A1a"
"""Ball of GaussianBench A1a: radius 0.05 m, 552 points 0.01 m apart, E 1e5, nu 0.3, rho 1000."""


def largest(value: Tensor) -> float:
    """Largest absolute entry."""
    return float(value.abs().max())


@problem(tier="fast")
def projectile() -> Iterator[Result]:
    """Free flight of an elastic ball: the exact path of the integrator, in both precisions."""
    start, speed, gravity = [0.3, -0.2, 0.5], [1.0, 0.5, 4.0], [0.0, 0.0, -9.81]
    points = ball(start, 0.05, 0.01)
    v, g = torch.tensor(speed, dtype=torch.float64), torch.tensor(gravity, dtype=torch.float64)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        world = World(
            points, speed, volume=1e-6, dx=0.02, law=0, params=parameters(1e5, 0.3, 1000.0),
            gravity=gravity, dt=5e-4, dtype=dtype, frame=(0.0, 0.0, 0.0),
        ).run(steps=100)  # fmt: skip
        t = world.time
        flight = v * t + 0.5 * g * t * (t + world.dt)
        error = largest(world.position.double().cpu() - points - flight) / float(v.norm() * t)
        name = str(dtype).removeprefix("torch.")
        yield compare(
            f"largest distance from the path over the distance flown, {name}", error,
            tolerance=tolerance, source="x0 + v t + g t (t + dt) / 2, exact for symplectic Euler",
            note=f"{world.steps} steps",
        )  # fmt: skip


@problem(tier="fast")
def patch_test() -> Iterator[Result]:
    """Affine motion and uniform stress pass unchanged through the grid, free faces included."""
    points = box([0.013, 0.027, 0.041], [0.16, 0.16, 0.16], 0.01)
    # a point hears of a free face three cells away
    inner = ((points > points.amin(0) + 0.061) & (points < points.amax(0) - 0.061)).all(dim=1)
    rate = torch.tensor([[0.3, -1.0, 0.2], [0.5, 0.1, -0.7], [0.9, 0.4, -0.6]], dtype=torch.float64)
    drift = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
    affine = rate.expand(points.shape[0], 3, 3)
    soft, stiff = parameters(1e-9, 0.3, 1000.0), parameters(1e5, 0.3, 1000.0)
    given: dict[str, Any] = {"volume": 1e-6, "dx": 0.02, "law": 0, "dt": 1e-3}
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        name = str(dtype).removeprefix("torch.")
        world = World(
            points, drift + points @ rate.T, affine=affine, params=soft, dtype=dtype, **given
        ).run(steps=1)
        fastest = largest(drift + points @ rate.T)
        error = largest(world.affine.double().cpu() - rate) * 0.02 / fastest
        yield compare(
            f"affine velocity: C - L over |v| / dx, {name}", error, tolerance=tolerance,
            source="v = v0 + L x gives C = L", note="all points, one step",
        )  # fmt: skip
        strain = torch.tensor([0.01, -0.02, 0.015, 0.01, -0.005, 0.02], dtype=torch.float64)
        world = World(points, drift, strain=strain, params=stiff, dtype=dtype, **given)
        scale = 4.0 * largest(world.stress) / (1000.0 * 0.02) * 1e-3  # of the summands
        world.run(steps=1)
        error = largest(world.velocity.double().cpu()[inner] - drift) / scale
        yield compare(
            f"uniform stress: push on inner points, {name}", error, tolerance=tolerance,
            source="div tau = 0; over 4 dt |tau| / (rho dx)", note="lattice off the nodes",
        )  # fmt: skip


@problem(tier="fast")
def covariance_transport() -> Iterator[Result]:
    """Deformation tracked through an affine flow: F and F S F^T against the exact product."""
    points = ball([0.02, -0.01, 0.03], 0.05, 0.01)
    rate = torch.tensor([[0.8, -2.0, 0.3], [1.5, 0.2, -0.9], [0.4, 1.1, -1.2]], dtype=torch.float64)
    one, dt, steps = torch.eye(3, dtype=torch.float64), 2e-3, 200

    def stir(world: World, dt: float) -> None:
        flow = rate.to(world.position)
        world.velocity = world.position @ flow.T
        world.affine = flow.expand(world.position.shape[0], 3, 3).contiguous()

    step = one + dt * rate
    exact = torch.linalg.matrix_power(step, steps)
    spread = torch.diag(torch.tensor([1.0, 0.3, 0.05], dtype=torch.float64))
    wanted = exact @ spread @ exact.T
    for dtype, tolerance in ((torch.float64, 1e-11), (torch.float32, 1e-4)):
        world = World(
            points, [0.0, 0.0, 0.0], volume=1e-6, dx=0.02, law=0,
            params=parameters(1e-16, 0.3, 1000.0), dt=dt, deformation=True, dtype=dtype, force=stir,
        ).run(steps=steps)  # fmt: skip
        assert world.deformation is not None
        f = world.deformation.double().cpu()
        error = largest(f @ spread @ f.mT - wanted) / largest(wanted)
        name = str(dtype).removeprefix("torch.")
        yield compare(
            f"F S F^T over its size, {name}", error, tolerance=tolerance,
            source=f"(I + dt L)^{steps}, affine flow; GaussianBench C1 allows 1e-3",
            note=f"stretch up to {float(torch.linalg.matrix_norm(exact, ord=2)):.2f}",
        )  # fmt: skip


class Spin:
    """A ball turning about its centre, and how far its sums have drifted so far."""

    def __init__(
        self, dtype: torch.dtype, *, young: float = 1e5, dx: float = 0.02, cfl: float = 0.5
    ):
        points = ball([0.0, 0.0, 0.0], 0.05, 0.01)
        turn = torch.zeros(3, 3, dtype=torch.float64)
        turn[0, 1], turn[1, 0] = -4.0, 4.0
        velocity = points @ turn.T
        self.world = World(
            points, velocity, affine=turn.expand(points.shape[0], 3, 3), volume=1e-6,
            dx=dx, law=0, params=parameters(young, 0.3, 1000.0), cfl=cfl, dtype=dtype,
        )  # fmt: skip
        self.momentum, self.angular = self.world.momentum(), self.world.angular_momentum()
        self.orbit, self.kinetic = self._orbit(), self.world.kinetic()
        self.content = 1e-3 * float(velocity.norm(dim=1).sum())
        self.linear_drift = self.angular_drift = self.orbit_drift = 0.0

    def _orbit(self) -> Tensor:
        """Spin about the centre without the affine part, as GaussianBench takes it."""
        arm = self.world.position.double() - self.world.center()
        v = self.world.velocity.double()
        return 1e-3 * torch.linalg.cross(arm, v - v.mean(0)).sum(0)

    def run(self, seconds: float, looks: int) -> Spin:
        """Turn on, looking at the sums a number of times; keeps the largest drift of each."""
        for _ in range(looks):
            self.world.run(seconds / looks)
            linear = float((self.world.momentum() - self.momentum).norm()) / self.content
            angular = (self.world.angular_momentum() - self.angular).norm() / self.angular.norm()
            orbit = (self._orbit() - self.orbit).norm() / self.orbit.norm()
            self.linear_drift = max(self.linear_drift, linear)
            self.angular_drift = max(self.angular_drift, float(angular))
            self.orbit_drift = max(self.orbit_drift, float(orbit))
        return self

    def energy(self) -> float:
        """Elastic energy over the kinetic energy at the start."""
        return self.world.elastic() / self.kinetic


def spin_results(seconds: float, young: float) -> Iterator[Result]:
    """Angular momentum of a turning ball in both precisions, and the energy rounding puts in."""
    runs = {}
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        spin = runs[dtype] = Spin(dtype, young=young, dx=2.0**-6).run(seconds, 20)
        kind = str(dtype).removeprefix("torch.")
        yield compare(
            f"drift of angular momentum, {kind}", spin.angular_drift, tolerance=tolerance,
            source="free body", note=f"E {young:g}, {seconds:g} s, {spin.world.steps} steps",
        )  # fmt: skip
    ratio = runs[torch.float32].energy() / runs[torch.float64].energy()
    yield compare(
        "elastic energy, float32 over float64", ratio, 1.0, error=max(0.0, ratio - 1.0),
        tolerance=0.1, source="rounding must not strain the body (solver.md 3, row 6)",
        note=f"U / K {runs[torch.float64].energy():.1e} by rotation itself",
    )  # fmt: skip


@problem(tier="fast")
def spinning_ball() -> Iterator[Result]:
    """Stiff ball in rotation for 0.3 s (1100 steps): angular momentum and spurious energy."""
    return spin_results(0.3, 1e6)


@problem(tier="fast")
def spinning_ball_long() -> Iterator[Result]:
    """Ball of GaussianBench A1a in rotation for 10 s (15 000 steps)."""
    return spin_results(10.0, 1e5)


@problem(tier="slow")
def spinning_ball_stiff() -> Iterator[Result]:
    """Stiff ball in rotation for 10 s (47 000 steps): rounding goes by the step."""
    return spin_results(10.0, 1e6)


def free_results(dtype: torch.dtype, dx: float, cfl: float) -> Iterator[Result]:
    """Drifts of the free ball over 10 s, looked at 200 times."""
    spin = Spin(dtype, dx=dx, cfl=cfl).run(10.0, 200)
    kind = str(dtype).removeprefix("torch.")
    note = f"{spin.world.steps} steps, dx {dx:g}, CFL {cfl:g}, e = b - I, {spin.world.engine}"
    yield compare(
        f"drift of linear momentum over sum m |v|, {kind}", spin.linear_drift, tolerance=1e-6,
        source=BENCH, note=note,
    )  # fmt: skip
    yield compare(
        f"drift of spin without affine part, {kind}", spin.orbit_drift, tolerance=1e-3,
        source=BENCH, note=note,
    )  # fmt: skip


@problem(tier="fast")
def free_ball() -> Iterator[Result]:
    """Free ball turning for 10 s (GaussianBench A1a) in float64: both drifts."""
    return free_results(torch.float64, 0.02, 0.5)


@problem(tier="slow")
def free_ball_single() -> Iterator[Result]:
    """Free ball turning for 10 s (GaussianBench A1a) in float32, at the edge of its digits.

    In steady rotation all points have the same affine velocity, whose products with dx and mass are
    rounded the same way in every step: 1e-8 a step with dx 0.02, next to nothing with a power of
    two. What is left is a random walk of the roundings of velocities, at nodes and points: over
    552 points and 10 000 steps 5e-7, root mean square over nine step lengths.
    """
    return free_results(torch.float32, 2.0**-6, 0.8)


@problem(tier="fast")
def far_from_origin() -> Iterator[Result]:
    """Turning ball a thousand of its extents away from the origin, in float32."""
    points, away = ball([0.0, 0.0, 0.0], 0.05, 0.01), 100.0
    turn = torch.zeros(3, 3, dtype=torch.float64)
    turn[0, 1], turn[1, 0] = -20.0, 20.0
    ends = []
    for dtype, shift in ((torch.float64, 0.0), (torch.float32, away)):
        world = World(
            points + shift, points @ turn.T, affine=turn.expand(points.shape[0], 3, 3), volume=1e-6,
            dx=0.02, law=0, params=parameters(1e5, 0.3, 1000.0), dt=4e-4, dtype=dtype,
        ).run(steps=200)  # fmt: skip
        ends.append(world.position.double().cpu() - shift)
    error = largest(ends[1] - ends[0]) / 0.02
    yield compare(
        "largest distance from the float64 run at the origin [dx]", error, tolerance=1e-3,
        unit="dx", source="solver.md 4, rows 20 and 21",
        note=f"{away / 0.1:g} extents away, 200 steps, turned by {20.0 * 0.08:.1f} rad",
    )  # fmt: skip
    # points that creep: less than half a unit in the last place per step
    speed = 0.25 * away * torch.finfo(torch.float32).eps / 4e-4
    world = World(
        points + away, [speed, 0.0, 0.0], volume=1e-6, dx=0.02, law=0,
        params=parameters(1e5, 0.3, 1000.0), dt=4e-4, dtype=torch.float32,
    ).run(steps=200)  # fmt: skip
    moved = float(world.center()[0]) - away
    yield compare(
        "distance crept at a quarter of a rounding per step", moved, speed * 200 * 4e-4,
        tolerance=0.01, unit="m", source="solver.md 4, row 21",
    )  # fmt: skip


@problem(tier="fast")
def turned_frame() -> Result:
    """A bouncing, strained body gives the same energies in a frame turned about the grid."""
    points = ball([0.0, 0.0, 0.0], 0.05, 0.005)
    pull = torch.tensor([[3.0, 0.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    energies = []
    for angle in (0.0, 0.7):
        turn = rotation([1.0, 2.0, 0.5], angle)
        rate = turn @ pull @ turn.T
        x = points @ turn.T
        world = World(
            x, x @ rate.T, affine=rate.expand(x.shape[0], 3, 3), volume=1.25e-7, dx=0.01, law=0,
            params=parameters(1e5, 0.3, 1000.0),
        ).run(0.02)  # fmt: skip
        energies.append((world.kinetic(), world.elastic()))
    whole = sum(energies[0])
    error = max(abs(a - b) for a, b in zip(*energies, strict=True)) / whole
    share = energies[0][1] / whole
    return compare(
        "difference of kinetic and elastic energy, turned by 0.7 rad", error, tolerance=0.02,
        source="space has no direction; the grid has",
        note=f"elastic share {share:.2f}, {math.ceil(0.1 / 0.01)} cells across",
    )  # fmt: skip
