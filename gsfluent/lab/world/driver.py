"""World: one scene of material points, run by the solver, with the sums a problem asks for."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.world.resident import Resident, why_not
from gsfluent.lab.world.stepper import Scene, Stepper, automatic_dt

Force = Callable[["World", float], None]

_place: list[torch.device] = []
_engine: list[Literal["solver", "ops"] | None] = []


@contextlib.contextmanager
def running_on(
    device: str | torch.device, engine: Literal["solver", "ops"] | None = None
) -> Iterator[None]:
    """Choose where, and by what, every World built inside the block runs that does not say.

    Args:
        device: Where its tensors are.
        engine: ``"ops"`` to keep the resident solver out.
    """
    _place.append(torch.device(device))
    _engine.append(engine)
    try:
        yield
    finally:
        _place.pop()
        _engine.pop()


def place() -> torch.device:
    """Where :func:`running_on` says, the CPU outside it."""
    return _place[-1] if _place else torch.device("cpu")


class World:
    """A scene in motion.

    Args:
        position: [m], [N, 3].
        velocity: [m/s], [N, 3], or three numbers for all points.
        volume: Initial volume [m^3], [N] or one number.
        mass: [kg], [N] or one number; default: the volume times the density of the row.
        dx: Node spacing [m].
        law: Constitutive law of every row of ``params``: int32 [M], or one number.
        params: [M, 8] or [8], see :func:`gsfluent.ops.return_mapping`.
        material: Row of each point, int32 [N]; None means row 0.
        body: Velocity field of each point, int32 [N]; None puts all into one field.
        alpha: [N], default zero. NACC material starts intact at a negative alpha.
        strain: e = b - I as xx, yy, zz, xy, xz, yz, [N, 6], default zero.
        affine: APIC matrices C [1/s], [N, 3, 3], default zero.
        deformation: Also track the deformation gradient.
        gravity: [m/s^2], three numbers.
        colliders: Rows of :func:`gsfluent.ops.grid_update`.
        friction: Coulomb coefficient between bodies.
        restitution: Of contact between bodies.
        contact_gap: Distance of mass centroids [dx] below which bodies touch.
        cfl: Share of ``dx / (wave speed + speed)`` that a step takes.
        dt: Fixed time step [s] in place of the automatic one.
        dtype: Precision, float64 or float32.
        force: ``force(world, dt)``, called before every step; adds to ``world.velocity``.
        period: Length of the domain on each axis [m], a whole number of ``dx`` from 0, or None
            where it is not periodic.
        device: Where to run; default that of :func:`running_on`, else of ``position``.
        engine: ``"solver"``: :class:`gsfluent.ops.Solver`, the state stays on the device;
            ``"ops"``: p2g, grid_update, g2p and return_mapping step by step. None: the solver
            where it can do the job, which is without ``force`` and ``period``.
        irreversible: Broken NACC material does not regain its cohesion.
        frame: Velocity of the solver's grid [m/s]; None: the solver's choice. ``"ops"`` has none.
        surface: Contact radius of the points in cube roots of their volume: colliders push points
            that are nearer (docs/theory/colliders.md). None: they hold nodes.
        viscous: Viscosity of each point, [N, 9], or [9] for all: :func:`gsfluent.ops.viscous_step`.
        touch: With ``surface``, points of different bodies push each other
            (docs/theory/contact.md); else bodies touch at nodes. The solver only.
        flip: Share of their own motion that points keep in a step (:class:`gsfluent.ops.Solver`).
        **return_map: ``k``, ``epsilon``, ``implicit`` of :func:`gsfluent.ops.return_mapping`.

    Raises:
        ValueError: A shape, range, law or parameter is wrong.
    """

    time: float  # simulated [s]; these are read from the stepper
    steps: int  # taken
    position: Tensor  # [m], [N, 3]
    strain: Tensor  # elastic strain e = b - I, [N, 6]
    alpha: Tensor  # log plastic volume ratio (NACC) or the scalar state of the law, [N]
    peak: Tensor  # largest alpha so far, [N]
    stress: Tensor  # Kirchhoff stress [Pa], [N, 6]
    deformation: Tensor | None  # gradient since the start, [N, 3, 3], if tracked
    impulse: Tensor  # given to the bodies by each collider so far [N s], float64 [K, 3]
    info: Tensor  # sums over the steps: plastic, guarded, inverted, invalid points, int64 [4]

    def __init__(
        self,
        position: Tensor,
        velocity: Tensor | Sequence[float],
        *,
        volume: Tensor | float,
        mass: Tensor | float | None = None,
        dx: float,
        law: Tensor | int,
        params: Tensor,
        material: Tensor | None = None,
        body: Tensor | None = None,
        alpha: Tensor | None = None,
        strain: Tensor | None = None,
        affine: Tensor | None = None,
        deformation: bool = False,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        colliders: Tensor | Sequence[Tensor] | None = None,
        friction: float = 0.0,
        restitution: float = 0.0,
        contact_gap: float = 1.0,
        cfl: float = 0.5,
        dt: float | None = None,
        dtype: torch.dtype = torch.float64,
        force: Force | None = None,
        period: Sequence[float | None] = (None, None, None),
        device: str | torch.device | None = None,
        engine: Literal["solver", "ops"] | None = None,
        irreversible: bool = True,
        frame: Sequence[float] | None = None,
        surface: float | None = None,
        viscous: Tensor | None = None,
        touch: bool = False,
        flip: float = 0.0,
        **return_map: Any,
    ):
        if dt is not None and not 0.0 < dt < math.inf:
            raise ValueError(f"World: dt must be positive, got {dt}")
        if not 0.0 < cfl <= 2.0:
            raise ValueError(f"World: cfl must be in (0, 2], got {cfl}")
        if any(p is not None and abs(p / dx - round(p / dx)) > 1e-9 for p in period):
            raise ValueError(f"World: period must be a whole number of dx = {dx}, got {period}")
        if device is None:
            device = _place[-1] if _place else position.device
        device = torch.device(device)
        count = position.shape[0]

        def number(value: Tensor | Sequence[float] | float | None, *shape: int) -> Tensor:
            if value is None:
                return torch.zeros(shape, dtype=dtype, device=device)
            data = torch.as_tensor(value, dtype=dtype, device=device)
            return data.expand(shape).contiguous().clone()

        def index(value: Tensor | int, *shape: int) -> Tensor:
            data = torch.as_tensor(value, dtype=torch.int32, device=device)
            return data.expand(shape).contiguous()

        rows = params.reshape(-1, 8).to(device, dtype).contiguous()
        if mass is None:
            which = slice(0, 1) if material is None else material.cpu().long()
            density = params.reshape(-1, 8)[which, 6].double().cpu()
            mass = density * torch.as_tensor(volume, dtype=torch.float64).cpu()
        walls = None if colliders is None else torch.stack([*colliders]).to(device, dtype)
        if touch and (surface is None or engine == "ops"):
            raise ValueError("World: touch needs surface, and the solver")
        self.scene = Scene(
            mass=number(mass, count),
            volume=number(volume, count),
            dx=float(dx),
            law=index(law, rows.shape[0]),
            params=rows,
            material=index(0 if material is None else material, count),
            body=None if body is None else index(body, count),
            fields=1 if body is None else int(body.max()) + 1,
            gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
            colliders=walls,
            friction=friction,
            restitution=restitution,
            contact_gap=contact_gap,
            cfl=cfl,
            fixed_dt=dt,
            period=(period[0], period[1], period[2]),
            irreversible=irreversible,
            return_map=return_map,
            frame=None if frame is None else (frame[0], frame[1], frame[2]),
            viscous=None if viscous is None else number(viscous, count, 9),
            objects=None if body is None or not touch else each_its_own(body),
            flip=flip,
            radius=None if surface is None else surface * number(volume, count) ** (1.0 / 3.0),
        )
        one = torch.eye(3, dtype=dtype, device=device).expand(count, 3, 3).contiguous()
        obstacle = why_not(self.scene, force is not None)
        if engine not in ("solver", "ops", None):
            raise ValueError(f"World: engine must be 'solver', 'ops' or None, got {engine!r}")
        if engine == "solver" and obstacle:
            raise ValueError(f"World: engine 'solver' cannot run this: {obstacle}")
        if engine is None and _engine:
            engine = _engine[-1]
        self.engine: str = "ops" if engine == "ops" or obstacle else "solver"
        """What runs it, ``"solver"`` or ``"ops"``."""
        wide = torch.float64 if self.engine == "solver" else dtype  # it keeps cell and offset
        self.stepper: Stepper | Resident = (Resident if self.engine == "solver" else Stepper)(
            self.scene,
            torch.as_tensor(position, dtype=wide, device=device).clone().contiguous(),
            number(velocity, count, 3),
            number(affine, count, 3, 3),
            number(strain, count, 6),
            number(alpha, count),
            one if deformation else None,
        )
        self.force = force
        self.dt = automatic_dt(self.scene, self.strain, self.velocity, self.affine)
        """The latest time step [s]; before the first one, its size."""

    def run(
        self,
        seconds: float | None = None,
        steps: int | None = None,
        each: Callable[[World], None] | None = None,
    ) -> World:
        """Advance by a time, to the end of it exactly, or by a number of steps.

        Args:
            seconds: Time to advance by [s]. The last steps are shortened to end on it.
            steps: Steps to advance by, at the fixed or automatic time step.
            each: Called after every step.

        Returns:
            The world itself.

        Raises:
            ValueError: Not exactly one of ``seconds`` and ``steps``.
            FloatingPointError: A number is not finite, or a point left the grid.
        """
        if (seconds is None) == (steps is None):
            raise ValueError("World.run: give either seconds or steps")
        end = self.time + (seconds or 0.0)
        if isinstance(self.stepper, Resident):
            self.stepper.run(end if steps is None else None, steps, self._told(each))
            self.dt = self.stepper.solver.dt or self.dt
            return self
        first = self.steps
        while self.time < end if steps is None else self.steps - first < steps:
            dt = self.stepper.limit()
            if steps is None:
                left = end - self.time
                if dt * (1.0 + 1e-9) >= left:
                    dt = left
                elif dt < left < 2.0 * dt and self.scene.fixed_dt is None:
                    dt = 0.5 * left  # two even steps rather than a whole one and a sliver
            if self.force is not None:
                self.force(self, dt)
            self.stepper.advance(dt)
            self.dt = dt
            if steps is None and dt == left:
                self.stepper.time = end
            if each is not None:
                each(self)
        return self

    def _told(self, each: Callable[[World], None] | None) -> Callable[[float], None] | None:
        if each is None:
            return None

        def tell(dt: float) -> None:
            self.dt = dt
            each(self)

        return tell

    def __getattr__(self, name: str) -> Any:
        if name == "stepper":  # not made yet
            raise AttributeError(name)
        return getattr(self.stepper, name)

    def _stepwise(self, what: str) -> Stepper:
        if isinstance(self.stepper, Resident):
            raise ValueError(
                f"World: {what} can be set only while the state is outside the solver; "
                "set it in a force, or build the world with engine='ops'"
            )
        return self.stepper

    @property
    def velocity(self) -> Tensor:
        """Velocities [m/s], [N, 3]; may be set."""
        return self.stepper.velocity

    @velocity.setter
    def velocity(self, value: Tensor) -> None:
        self._stepwise("velocity").velocity = value

    @property
    def affine(self) -> Tensor:
        """APIC matrices C [1/s], [N, 3, 3]; may be set."""
        return self.stepper.affine

    @affine.setter
    def affine(self, value: Tensor) -> None:
        self._stepwise("affine").affine = value

    def shift(self, way: Tensor) -> None:
        """Move the points over the grid by a way [m], [3]; colliders stay. Only in a force."""
        self._stepwise("position").shift(way)

    def kinetic(self, of: Tensor | None = None) -> float:
        """Kinetic energy [J] with the part in the affine velocities, of all points or a mask."""
        scene = self.scene
        each = (self.velocity.double() ** 2).sum(1)
        each = each + 0.25 * scene.dx**2 * (self.affine.double() ** 2).sum((1, 2))
        return float(0.5 * _of(scene.mass.double() * each, of).sum())

    def elastic(self, of: Tensor | None = None) -> float:
        """Stored elastic energy [J], of all points or of a mask."""
        scene = self.scene
        density = ops.elastic_energy(
            self.strain.double(), law=scene.law, params=scene.params.double(),
            material=scene.material,
        )  # fmt: skip
        return float(_of(scene.volume.double() * density, of).sum())

    def momentum(self, of: Tensor | None = None) -> Tensor:
        """Momentum [kg m/s], float64 [3], of all points or of a mask."""
        return _of(self.scene.mass.double()[:, None] * self.velocity.double(), of).sum(0)

    def center(self, of: Tensor | None = None) -> Tensor:
        """Centre of mass [m], float64 [3], of all points or of a mask."""
        mass = _of(self.scene.mass.double(), of)
        return (mass[:, None] * _of(self.position.double(), of)).sum(0) / mass.sum()

    def angular_momentum(self, about: Tensor | None = None, of: Tensor | None = None) -> Tensor:
        """Angular momentum [kg m^2/s] with the spin of the affine velocities, float64 [3].

        Args:
            about: Point it is taken about [m], default the origin.
            of: Mask of the points that count.
        """
        scene = self.scene
        arm = self.position.double()
        if about is not None:
            arm = arm - about.to(arm)
        orbit = torch.linalg.cross(arm, self.velocity.double())
        c = self.affine.double()
        curl = torch.stack(
            [c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], dim=1
        )
        each = scene.mass.double()[:, None] * (orbit + 0.25 * scene.dx**2 * curl)
        return _of(each, of).sum(0)


def each_its_own(body: Tensor) -> Tensor:
    """Objects [K] of fields that are bodies of their own."""
    return torch.arange(int(body.max()) + 1, dtype=torch.int32, device=body.device)


def _of(values: Tensor, mask: Tensor | None) -> Tensor:
    return values if mask is None else values[mask]
