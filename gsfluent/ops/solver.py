"""The resident solver: a simulation whose state stays on the device from step to step.

:class:`Solver` advances many explicit MLS-MPM steps per call without a look from the host: the
time step, the search for active blocks, the re-sorting of particles and the stopping time are
decided on the device (``csrc/core/solver/clock.h``). The composable operators
(:func:`gsfluent.ops.p2g` and its siblings) are the differentiable face of the same mathematics and
the reference it is tested against.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Wang et al. 2020 and Fei et al. 2021
(block-sorted GPU transfers); fixed-point sums: docs/theory/solver-sums.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.errors import GsfluentError, InputError
from gsfluent.ops import solver_buffers as layout
from gsfluent.ops import solver_points as points
from gsfluent.ops.blocks import check_dx
from gsfluent.ops.collider import RESTITUTION, check_colliders, pad_colliders
from gsfluent.ops.plasticity import LAWS, check_params, compiled_apart
from gsfluent.ops.solver_ranks import MOST_RANKS, Parts, check_devices
from gsfluent.ops.solver_state import (
    DAMAGE_FIELD,
    DAMAGE_QUIET,
    MORE_LAWS,
    VISCOUS,
    VISCOUS_ANY,
    SolverState,
    sum_bits,
)
from gsfluent.ops.viscous import check_viscous

ELASTIC, NACC, PHASE = LAWS["elastic"], LAWS["nacc"], LAWS["phase_field"]
CFL_MOST = 0.5
"""Largest Courant number at which colliders may push points: from 0.6 on energy was made."""
RADIUS_MOST = 0.5
"""Largest contact radius [dx]: ``kSpringReach`` of ``csrc/core/collider/spring.h``."""
_MANY = 500_000
"""Points from which a step without work takes a GPU longer than the host to look at the clock."""
_REASONS = {
    1: (
        "a speed, a wave speed or a strain is not finite",
        "start from finite values, or lower cfl",
    ),
    2: ("a point moved further than a cell in one step", "lower dt, or let the step be automatic"),
    3: (
        f"more than {layout.SITE_FIELDS} bodies share one block of 4 cells",
        "give bodies that touch fewer field numbers, or lower dx",
    ),
    4: (
        f"a point is further than {4 * layout.BLOCK_RANGE} cells from the origin",
        "remove points that fly away, or raise dx",
    ),
    5: ("the time step is too small for the present time to resolve", "look at the stiffest law"),
    6: (
        f"more than {layout.MAX_HOME} points in one block of 4 cells",
        "take fewer points per cell, or lower dx",
    ),
}


def _no_restitution(op: str, contact: float, colliders: Tensor | None) -> None:
    """Refuse what would make energy: see docs/theory/contact.md."""
    rows = None if colliders is None else pad_colliders(colliders)
    bounces = rows is not None and bool((rows[:, RESTITUTION] > 0).any())
    if contact != 0.0 or bounces:
        raise ValueError(
            f"{op}: restitution of {'a collider' if bounces else 'contact'} must be 0: at nodes it "
            "makes energy (docs/theory/contact.md); bodies bounce by their elasticity"
        )


class SolverError(GsfluentError, RuntimeError):
    """The solver stopped before the time it was asked for.

    Args:
        reason: Number in ``SolverReason`` (``csrc/core/solver/state.h``).
        time: Simulated time at which it stopped [s].
        step: Steps so far.
    """

    def __init__(self, reason: int, time: float, step: int) -> None:
        what, hint = _REASONS.get(reason, (f"reason {reason}", "report this"))
        self.reason, self.time, self.step = reason, time, step
        super().__init__(f"solver: t = {time:.6g} s, step {step}: {what}\n  hint: {hint}")


class Solver(SolverState):
    """Material points that live on a device and move in time.

    Args:
        position: Positions [m], [N, 3], float32 or float64 (the dtype of the whole state). They are
            kept relative to their cell: distance from the origin costs no digits inside.
        velocity: Velocities [m/s], [N, 3].
        mass: Masses [kg], [N].
        volume: Volumes at rest [m^3], [N].
        dx: Node spacing [m].
        law: Law of each material row, int32 [M].
        params: Parameters of each row, [M, 8]; columns of :func:`gsfluent.ops.return_mapping`,
            with the density [kg/m^3] in column 6.
        material: Row of each point, int32 [N]; default: row 0.
        strain: Strain ``b - I``, [N, 6]; default: none.
        alpha: Log plastic volume ratio (NACC) or history (phase field, -1 when fresh), [N];
            default: zero.
        peak: Largest alpha so far, [N]; default: ``alpha``. Phase-field points: d - 0.95, or -1
            where undamaged, the default. Points of other laws read -1.
        affine: APIC matrix C [1/s], [N, 3, 3]; default: zero.
        deformation: Total deformation gradient, [N, 3, 3]; given, it is tracked.
        body: Velocity field of each point, int32 [N]; points of different fields feel each other by
            contact only. Default: one field.
        parent: Body of each field, int32 [K], where blades cut; with ``cut``. Fields of one body
            move as one, except on opposite sides of a blade. Default: each field is its own body.
        cut: Sides of each field, int32 [K]; see :func:`gsfluent.ops.blade_sides`.
        radius: Contact radius of each point [m], [N]: colliders push points that are nearer than it
            (mode ``separate``, no mass, no sweep; docs/theory/colliders.md, "At a point"). Half the
            cube root of the volume makes a body rest where its points end; a negative one lets a
            point in as deep. Default: colliders hold nodes.
        rebound: Share of a push, [N], that is left while a point parts from it; default: 1.
        viscous: Viscosity of each point, [N, 9] (:func:`gsfluent.ops.viscous_step`), for laws 0 and
            1; others have none. Default: nothing relaxes and all yields at once, at no cost.
        objects: Object of each field, int32 [K], with ``radius``: points of different objects push
            each other (docs/theory/contact.md, "At a point"); fields of one object touch at nodes.
            Default: all fields do.
        gravity: Acceleration [m/s^2].
        colliders: Rows of :func:`gsfluent.ops.grid_update`, [K, columns].
        sdf: Values of all distance grids that ``colliders`` name, float32 [M].
        friction: Coulomb friction between fields.
        restitution: 0. Given back at nodes in every step of a lasting contact, it makes energy
            (docs/theory/contact.md); bodies bounce by their elasticity. Likewise that of colliders.
        contact_gap: Distance of the centroids, in cells, up to which fields touch.
        cfl: Courant number of the automatic time step.
        gradient_limit: Largest ``dt |grad v|`` of unbroken matter.
        dt: Fixed time step [s]; default: automatic.
        k: Exponent of the dynamic centre (NACC).
        epsilon: Its regularisation.
        implicit: Whether alpha is solved implicitly.
        irreversible: Whether broken points lose their cohesion for good.
        flip: Share of their own velocity and affine matrix, less what the nodes would give back by
            themselves, that points keep in a step (FLIP; the rest is APIC), in [0, 1); rates of
            strain keep its root. With ``1 - 2 cfl`` shorter steps lose as much in the same time as
            those of ``cfl`` 0.5 (docs/theory/mpm.md). 0 costs nothing. Not beside law
            ``phase_field``.
        frame: Velocity of the grid [m/s], which changes no law of motion but what the grid loses.
            With colliders 0. Default: without them that of the matter, each body by its mass, so
            that what happens does not depend on who watches (docs/theory/mpm.md). Positions and
            velocities are given and read as they are for the observer.
        ranks: Parts that the scene is cut into at every build and that step side by side, telling
            each other what they share (docs/theory/ranks.md): the same bits for any number. In
            lockstep on one device, which is slower than 1; the rehearsal for several. 1 to 64.
        devices: CUDA devices of one host, as in ``["cuda:0", "cuda:1"]``: one rank on each. That of
            ``position`` and the others is among them, or these lie in host memory, where they need
            not fit into a device, and what is read of the state goes there. Default: all ranks
            where the points lie.

    Raises:
        TypeError: Wrong type or dtype.
        ValueError: Wrong shape, device or range; values that are not finite; no particles.
    """

    def __init__(
        self,
        position: Tensor,
        velocity: Tensor,
        mass: Tensor,
        volume: Tensor,
        *,
        dx: float,
        law: Tensor,
        params: Tensor,
        material: Tensor | None = None,
        strain: Tensor | None = None,
        alpha: Tensor | None = None,
        peak: Tensor | None = None,
        affine: Tensor | None = None,
        deformation: Tensor | None = None,
        body: Tensor | None = None,
        parent: Tensor | None = None,
        cut: Tensor | None = None,
        radius: Tensor | None = None,
        rebound: Tensor | None = None,
        viscous: Tensor | None = None,
        objects: Tensor | None = None,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        colliders: Tensor | None = None,
        sdf: Tensor | None = None,
        friction: float = 0.3,
        restitution: float = 0.0,
        contact_gap: float = 1.0,
        cfl: float = 0.5,
        gradient_limit: float = 0.3,
        dt: float | None = None,
        k: float = 2.0,
        epsilon: float = 0.1,
        implicit: bool = True,
        irreversible: bool = True,
        flip: float = 0.0,
        frame: Sequence[float] | None = None,
        ranks: int = 1,
        devices: Sequence[str | torch.device] | None = None,
    ) -> None:
        op = "Solver"
        check_tensor(op, "position", position, shape=(None, 3))
        n = position.shape[0]
        if not 0 < n <= layout.MAX_PARTICLES:
            raise ValueError(f"{op}: position must have 1 to {layout.MAX_PARTICLES} rows, got {n}")
        like = velocity
        check_tensor(op, "velocity", velocity, shape=(n, 3))
        for name, value in (("mass", mass), ("volume", volume)):
            check_tensor(op, name, value, shape=(n,), like=like)
        good = [((value > 0) & torch.isfinite(value)).all() for value in (mass, volume)]
        if not all(fine := torch.stack(good).tolist()):  # the device is asked once
            raise ValueError(f"{op}: {'volume' if fine[0] else 'mass'} must be positive and finite")
        optional = (
            ("strain", strain, (n, 6)), ("alpha", alpha, (n,)), ("peak", peak, (n,)),
            ("affine", affine, (n, 3, 3)), ("deformation", deformation, (n, 3, 3)),
        )  # fmt: skip
        for name, given, shape in optional:
            if given is not None:
                check_tensor(op, name, given, shape=shape, like=like)
        check_tensor(op, "law", law, shape=(None,), dtype=torch.int32)
        check_tensor(op, "params", params, shape=(law.shape[0], 8))
        self.dx = check_dx(op, dx)
        self._surface(radius, rebound, like, self.dx, cfl)
        self.outside, self.dtype, self.count = velocity.device, velocity.dtype, n
        self.devices = [] if devices is None else check_devices(devices, self.outside)
        self.device = self.devices[0] if self.devices and not velocity.is_cuda else self.outside
        self.gravity = tuple(float(g) for g in gravity)
        if len(self.gravity) != 3 or not all(math.isfinite(g) for g in self.gravity):
            raise ValueError(f"{op}: gravity must be three finite numbers, got {gravity}")
        if not 0.0 < cfl <= 1.0:
            raise ValueError(f"{op}: cfl must lie in (0, 1], got {cfl}")
        if dt is not None and not (math.isfinite(dt) and dt > 0.0):
            raise ValueError(f"{op}: dt must be positive, got {dt}")
        for name, number, least, most in (
            ("friction", friction, 0.0, math.inf), ("contact_gap", contact_gap, 0.0, math.inf),
            ("k", k, 0.0, math.inf), ("epsilon", epsilon, 0.0, 0.999),
            ("gradient_limit", gradient_limit, 1e-6, math.inf),
        ):  # fmt: skip
            if not least <= number <= most:
                raise ValueError(f"{op}: {name} must lie in [{least:g}, {most:g}], got {number}")
        self._params, self._law = params.to(self.device, self.dtype), law.to(self.device)
        check_params(op, self._law, self._params)
        laws = set(law.tolist())
        self._law_set = 0 if laws <= {ELASTIC} else 1 if laws <= {ELASTIC, NACC} else 2
        if bool(compiled_apart(self._law, self._params).any()):
            self._law_set = MORE_LAWS
        if PHASE in laws:
            self._law_set = DAMAGE_FIELD
            if not laws <= {ELASTIC, NACC, PHASE}:
                raise ValueError(
                    f"{op}: law phase_field (9) works beside laws 0 and 1 only, got "
                    f"{sorted(laws)}; step it by p2g, grid_update, g2p, damage_solve and "
                    "return_mapping"
                )
            codes = {int(c) >> 2 for c in self._params[self._law == PHASE, 5].tolist()}
            if len(codes) > 1:
                raise ValueError(f"{op}: at1 and at2 in one simulation; give all matter one")
        self._thickens(viscous, like, laws)
        self.flip = self._flip(flip)
        self.ranks = self._ranks(ranks)
        self.irreversible, self.implicit, self.k, self.epsilon = irreversible, implicit, k, epsilon
        _no_restitution(op, restitution, colliders)
        self.friction, self.restitution, self.contact_gap = friction, restitution, contact_gap
        self._fixed = dt

        if not bool((self._params[:, 6] > 0).all()):
            raise ValueError(f"{op}: density (params column 6) must be positive")
        row, rows, row_law = self._rows(material, mass, volume)
        b = layout.empty_buffers(self.device, self.dtype)
        b.law, b.rows = row_law, rows
        if self._law_set == DAMAGE_FIELD and self.device.type == "cuda":
            b.damage_scale = self._damage_scale(row_law, rows)
        if colliders is not None and colliders.shape[0] > 0:
            check_colliders(op, pad_colliders(colliders), 0 if sdf is None else sdf.shape[0])
            b.colliders = pad_colliders(colliders).to(self._params, copy=True).contiguous()
            b.collider_state = pad_colliders(colliders).to(self.device, torch.float64).clone()
            shape = (colliders.shape[0], layout.IMPULSE_SUMS)
            b.impulse_units = torch.zeros(shape, dtype=torch.int64, device=self.device)
            b.impulse = torch.zeros(shape, dtype=torch.float64, device=self.device)
            if sdf is not None:
                check_tensor(op, "sdf", sdf, shape=(None,), dtype=torch.float32)
                b.sdf = sdf.to(self.device).contiguous()
        if radius is not None:
            both = radius, torch.ones_like(radius) if rebound is None else rebound
            b.radius = torch.stack(both, dim=1).to(self.device)
            if self.device.type == "cuda":  # on a CPU the kernels have them
                b.spring_rows = b.impulse.new_zeros(len(rows) + 2, 2)
        self._whole, self._parts = b, None
        self.frame = self._frame(velocity, mass, body, frame, b.colliders.numel() > 0)
        more = {name: value for name, value, _ in optional if value is not None}
        if viscous is not None:
            more["viscous"] = viscous
        self._alpha = None if self._law_set > 0 else alpha
        self._hold(self._law_set > 0, flip, more.keys())
        self.fields = self._fields(body)
        if objects is not None:
            if radius is None:
                raise InputError(
                    f"{op}: objects push each other's points by their radius, which is missing",
                    hint="give radius too, or leave out objects: fields then touch at nodes",
                )
            b.object = self._per_field("objects", objects)
        if parent is not None or cut is not None:
            b.parent, b.cut = self._per_field("parent", parent), self._per_field("cut", cut)
        if self.ranks > 1 and self.device.type == "cuda":
            self._parts = Parts(b, self.devices, self.fields, self._widths, *self._settings())
        self._load(points.Given(position, velocity, mass, row, body, more, self.frame, self.dx))
        heaviest = float(mass.max())
        bits = sum_bits(n)
        self._write(
            cfl=cfl, gradient_limit=gradient_limit, dt_scale=1.0, dt_fixed=dt or 0.0,
            dt_most=math.sqrt(cfl * self.dx / max(math.hypot(*self.gravity), 1e-12)),
            mass_unit=math.ldexp(1.0, math.frexp(heaviest)[1] + 1 - bits), unit_bits=bits,
            # rounds on a GPU leave the damage field out until a point is near its threshold
            quiet=int(self._whole.damage_scale.numel() > 0),
        )  # fmt: skip

    def _hold(self, breaks: bool, flip: float, given: Iterable[str]) -> None:
        """Say what is to be held of each point."""
        held = layout.ON_DEVICE if self.device.type == "cuda" else layout.ON_CPU
        unused = {"deformation", "viscous"} - set(given) | (set() if flip > 0.0 else {"own"})
        unused |= set() if breaks else {"alpha", "peak"}
        self._widths = {name: width for name, width in held.items() if name not in unused}
        self._widths |= layout.SCRATCH

    def _fields(self, body: Tensor | None) -> int:
        """The number of velocity fields, checked."""
        if body is None:
            return 1
        check_tensor("Solver", "body", body, shape=(self.count,), dtype=torch.int32)
        low, high = int(body.min()), int(body.max())
        if low < 0 or high >= layout.MAX_FIELDS:
            raise ValueError(
                f"Solver: body must lie in 0 to {layout.MAX_FIELDS - 1}, got {low} to {high}"
            )
        return high + 1

    def _per_field(self, name: str, given: Tensor | None) -> Tensor:
        """A whole number of each field, checked, where the state is."""
        rows = check_tensor("Solver", name, given, shape=(self.fields,), dtype=torch.int32)
        return rows.to(self.device).contiguous()

    def _thickens(self, viscous: Tensor | None, like: Tensor, laws: set[int]) -> None:
        """Choose the kernel of viscous solids; refuse what it does not know."""
        if viscous is None:
            return
        if self._law_set in (MORE_LAWS, DAMAGE_FIELD):
            raise InputError(
                f"Solver: viscous works beside laws 0 to 4 without plastic viscosity, got "
                f"{sorted(laws)}",
                hint="step them by p2g, grid_update, g2p, return_mapping and viscous_step",
            )
        check_viscous("Solver", viscous, like)
        self._law_set = VISCOUS if laws <= {ELASTIC, NACC} else VISCOUS_ANY

    def _flip(self, share: float) -> float:
        """The share of their own motion that points keep, checked."""
        if not 0.0 <= share < 1.0:
            raise InputError(
                f"Solver: flip must lie in [0, 1), got {share}",
                hint="1 - 2 cfl keeps what is lost in a time; 0 is APIC",
            )
        if share > 0.0 and self._law_set == DAMAGE_FIELD:
            raise InputError(
                f"Solver: flip: phase_field matter does not know it yet, got {share:g}",
                hint="leave it out there: points are moved by APIC alone",
            )
        return float(share)

    def _ranks(self, ranks: int) -> int:
        """The number of ranks, checked, and that every part of the scene knows of them."""
        if self.devices:
            if ranks not in (1, len(self.devices)):
                raise InputError(
                    f"Solver: {ranks} ranks on {len(self.devices)} devices",
                    hint="leave out ranks: there is one on each device",
                )
            ranks = len(self.devices)
        if type(ranks) is not int or not 1 <= ranks <= MOST_RANKS:
            raise InputError(
                f"Solver: ranks must be a whole number of 1 to {MOST_RANKS}, got {ranks!r}",
                hint="1 steps the whole scene at once",
            )
        self.devices = self.devices or [self.device] * ranks
        unknown = {
            f"device {self.device.type}": self.device.type not in ("cpu", "cuda"),
            "law phase_field (9)": self._law_set == DAMAGE_FIELD,
        }
        found = [name for name, used in unknown.items() if used]
        if ranks > 1 and found:
            raise InputError(
                f"Solver: {ranks} ranks do not know {' and '.join(found)} yet",
                hint="leave out ranks and devices, or what they do not know",
            )
        return ranks

    @staticmethod
    def _surface(radius: Any, rebound: Any, like: Tensor, dx: float, cfl: float) -> None:
        """Refuse contact radii that are too large or no numbers, and shares that are none."""
        if radius is None:
            return
        kept = torch.ones_like(radius) if rebound is None else rebound
        for name, value in (("radius", radius), ("rebound", kept)):
            check_tensor("Solver", name, value, shape=(like.shape[0],), like=like)
        if not bool((torch.isfinite(radius) & (kept >= 0) & (kept <= 1)).all()):
            raise ValueError("Solver: radius must be finite, and rebound a share of 0 to 1")
        if cfl > CFL_MOST:
            raise InputError(
                f"Solver: cfl must be at most {CFL_MOST:g} where points are pushed, got {cfl:g}",
                hint="longer steps make energy there (docs/theory/colliders.md)",
            )
        if not bool((radius <= RADIUS_MOST * dx).all()):
            raise InputError(
                f"Solver: radius must be at most {RADIUS_MOST:g} dx, got "
                f"{float(radius.max()):.6g} m at dx = {dx:g} m",
                hint="half the cube root of a point's volume is usual; sample more points per cell",
            )

    def _settings(self) -> tuple[list[int], list[float]]:
        laws = DAMAGE_QUIET if self.clock()["quiet"] else self._law_set
        ints = [self.fields, int(self.implicit), int(self.irreversible), laws,
                self.ranks, self.count]  # fmt: skip
        floats = [
            self.dx, *self.gravity, self.friction, self.restitution, self.contact_gap, self.k,
            self.epsilon, self.flip,
        ]  # fmt: skip
        return ints, floats

    # --- moving ---

    def set_colliders(self, colliders: Tensor) -> None:
        """Replace the rows of the colliders, as many as there were; impulses go on adding up.

        Args:
            colliders: Rows of :func:`gsfluent.ops.grid_update`, [K, columns].

        Raises:
            ValueError: Another number of rows, or rows that are no collider.
        """
        _no_restitution("Solver.set_colliders", 0.0, colliders)
        rows, have = pad_colliders(colliders), self._whole.colliders
        if rows.shape != have.shape:
            raise ValueError(
                f"Solver.set_colliders: colliders must have shape {list(have.shape)}, "
                f"got {list(rows.shape)}"
            )
        if rows.numel():
            check_colliders("Solver.set_colliders", rows, self._whole.sdf.shape[0])
            have.copy_(rows)
            self._whole.collider_state.copy_(rows)

    def advance(self, until: float | None = None, *, steps: int | None = None) -> None:
        """Advance to a time, by a number of steps, or to whichever comes first.

        The last step is shortened so that a time is met exactly. With a fixed ``dt`` the number of
        steps is ``until`` divided by it, rounded.

        Args:
            until: Time to reach [s].
            steps: Number of steps at most.

        Raises:
            ValueError: Neither is given, or one is not a number.
            SolverError: The state went bad, or a point left its window; the state is that of the
                step that failed (take :meth:`snapshot` before to go back).
        """
        if until is None and steps is None:
            raise ValueError("Solver.advance: give until, steps or both")
        if until is not None and not math.isfinite(until):
            raise ValueError(f"Solver.advance: until must be finite, got {until}")
        if steps is not None and steps < 0:
            raise ValueError(f"Solver.advance: steps must not be negative, got {steps}")
        now = self.clock()
        if self._fixed is not None and until is not None:
            whole = max(0, round((until - now["time"]) / self._fixed))
            steps = whole if steps is None else min(whole, steps)
            until = None
        if steps == 0 or (until is not None and until <= now["time"]):
            return
        left, goal = -1 if steps is None else steps, 1e300 if until is None else until
        # Every call starts from new blocks, so that nothing depends on what was built before it.
        self._write(until=goal, steps_left=left, done=0, grow=0, reason=0, lost=0, leaving=0,
                    rebuild=1)  # fmt: skip
        ints, floats = self._settings()
        with torch.no_grad():
            if self._parts is None:
                torch.ops.gsfluent.solver_prime(self._whole.listed(), ints, floats)
            else:
                self._parts.prime()
            while True:
                now = self.clock()
                if now["reason"]:
                    self._write(done=1, rebuild=1)
                    raise SolverError(int(now["reason"]), now["time"], int(now["step"]))
                if now["done"]:
                    return
                if now["grow"]:
                    self._grow(now)
                    ints, floats = self._settings()
                rounds, steps = self._rounds(now), self.steps_per_round
                if self._parts is None:
                    torch.ops.gsfluent.solver_run(self._whole.listed(), ints, floats, rounds, steps)
                else:
                    self._parts.run(rounds, steps)

    steps_per_round = 8
    """Steps between two chances to build blocks on a GPU."""

    def _rounds(self, now: dict[str, float]) -> int:
        """How many rounds to enqueue before the clock is looked at again."""
        left = now["steps_left"] if now["steps_left"] >= 0 else math.inf
        if now["dt"] > 0.0:
            left = min(left, (now["until"] - now["time"]) / now["dt"])
        left = min(left, 4096.0)
        built = min(now["builds"] / max(now["step"], 1.0), 1.0)  # rounds end early for new blocks
        each = 1.0 / self.steps_per_round
        if self.count > _MANY:  # rounds with nothing to do take longer than another look
            return max(1, math.floor(left * (each + 0.5 * built)))
        return math.ceil(left * (each + 0.6 * built)) + 1

    def _grow(self, now: dict[str, float]) -> None:
        """Make room for more blocks, or let the damage field be solved; every value is kept."""
        b = self._whole
        quiet = int(now["quiet"] and int(b.damage_counts[0]) == 0)
        homes, slots = b.home_start0.shape[0], b.slot_next.shape[0]
        if now["wanted_homes"] > homes or now["wanted_slots"] > slots:  # else a rank wants more
            homes = max(int(1.5 * now["wanted_homes"]) + 64, homes)
            slots = max(int(1.5 * now["wanted_slots"]) + 64, slots)
            b.reserve_blocks(homes, slots, self.fields)
        if self._parts is not None:
            self._parts.grow()
        self._write(grow=0, rebuild=1, quiet=quiet)

    def rank_counts(self) -> list[dict[str, int]]:
        """What each rank holds since the last build of blocks.

        Returns:
            Of each rank: ``points``, ``homes``, ``slots`` (blocks of nodes), and ``shared``: slots
            that other ranks hold too and hear of in every step.

        Raises:
            InputError: Before the first step; of one rank on a GPU.
        """
        if self._parts is not None and self.clock()["slots"] > 0:
            return self._parts.counts()
        if self.device.type != "cpu" or self.clock()["slots"] == 0:
            raise InputError(
                "Solver.rank_counts: nothing is cut before a step, nor for one rank on a GPU",
                hint="advance the solver first",
            )
        rows = torch.ops.gsfluent.solver_ranks(self._whole.listed(), *self._settings())
        names = ("points", "homes", "slots", "shared")
        return [dict(zip(names, row, strict=True)) for row in rows.tolist()]

    # --- going back ---

    _MOVING = ("clock", "impulse", "colliders", "collider_state",
               "home_coord0", "home_start0", "home_count0", "home_coord1", "home_start1",
               "home_count1")  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Copy everything that changes, for :meth:`restore`."""
        names = (*self._MOVING, *(self._widths.keys() - layout.SCRATCH.keys()))
        return {
            f"{index} {name}": getattr(b, name).clone()
            for index, b in enumerate(self._all_buffers())
            for name in names
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go back to a :meth:`snapshot` of this solver."""
        buffers = self._all_buffers()
        for key, value in saved.items():
            index, name = key.split()
            b = buffers[int(index)]
            target = getattr(b, name)
            if target.shape == value.shape:
                target.copy_(value)
            elif name in self._widths:  # room for points has grown since
                room = target.numel() // self._widths[name]
                setattr(b, name, layout.more_room(value, self._widths[name], room))
            else:  # that for blocks
                target.zero_()
                target[: value.shape[0]] = value
        for b in buffers:
            for name in ("sums", "moments", "push", "press", "impulse_units"):
                getattr(b, name).zero_()
        self._write(rebuild=1, done=1, grow=0, reason=0, touched=0, lost=0, leaving=0)

    def _all_buffers(self) -> list[layout.Buffers]:
        """Those of all, and of each rank on CUDA."""
        return [self._whole, *(self._parts.parts if self._parts else [])]
