"""What an engine is: the time step seen from outside, its options, points and counters."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple, Protocol

from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.ops.solver import CFL_MOST
from gsfluent.scene.scene import Scene

CFL = 0.5
SPRINGY = ("elastic", "corotated", "yeoh", "ogden", "von_mises")
"""Laws of matter that neither breaks nor flows apart."""


class Unhealthy(Exception):
    """The state cannot be advanced.

    Args:
        reason: What is wrong.
        wrong: Points at fault, bool [N], if they are known.
        kind: ``numbers``, ``speed``, ``volume``, ``energy``, ``crowded``, ``far`` or ``step``.
        time: When, if that is later than the state that was to be advanced [s].
    """

    def __init__(
        self,
        reason: str,
        wrong: Tensor | None = None,
        kind: str = "numbers",
        time: float = -math.inf,
    ) -> None:
        super().__init__(reason)
        self.reason, self.wrong, self.kind, self.time = reason, wrong, kind, time


@dataclasses.dataclass
class Counters:
    """What the solver did and what it left out."""

    steps: int = 0
    particle_steps: int = 0
    flight_seconds: float = 0.0
    flight_body_steps: int = 0
    composed_steps: int = 0
    """Steps of the composed operators."""
    law_kernel_steps: int = 0
    """Steps of kernels made for the laws of the scene alone."""
    undamaged_steps: int = 0
    """Steps in which no point had a damage variable, because none can break."""
    block_steps: int = 0
    """Blocks that were stored, summed over steps."""
    box_steps: int = 0
    """Blocks of the bounding box of the points on the grid, likewise."""
    contact_block_steps: int = 0
    """Stored blocks that took part in the contact pass, likewise."""
    contact_steps: int = 0
    contact_nodes: int = 0
    shared_sites: int = 0
    """Most blocks in which several fields met, in any step looked at."""
    block_builds: int = 0
    blocks_max: int = 0
    dt_min: float = float("inf")
    dt_max: float = 0.0
    plastic: int = 0
    guarded: int = 0
    inverted: int = 0
    point_seconds: float = 0.0
    """Simulated seconds of all points together."""
    sleeping_point_seconds: float = 0.0
    flying_point_seconds: float = 0.0
    """Pieces and bodies that went back to flight; first flights are counted apart."""
    naps: int = 0
    wakes: int = 0
    piece_flights: int = 0
    fields_max: int = 1


@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """How the matter is moved: what stage, stepper and engine all read.

    Args:
        cfl: Courant number of the automatic time step, in (0, 1]. Below 0.5 points keep part of
            their own motion (FLIP), so that shorter steps lose no more in the same time; the
            resident solver only, and not beside phase-field matter.
        free_flight: Move bodies that touch nothing in closed form instead of on the grid.
        piece_flight: Do so again with bodies and pieces that touch nothing any more.
        sleep: Take off the grid what rests, until something comes near.
        separate_fragments: Give the pieces of a broken body velocity fields of their own, so that
            they do not weld again where they touch.
        resident: Use the resident solver wherever it knows the colliders; otherwise the composed
            operators, step by step.
        irreversible: Broken points stay without cohesion when they are pressed together again.
        law_kernels: Use kernels made for elastic and brittle matter where there is no other.
        contact_proximity: Leave out contact where no two bodies or pieces are near each other;
            False is for comparison: the composed operators then look for contact at every node.
        deterministic: Refuse what cannot give the same bits from the same input on the same
            device: the composed operators on a GPU, whose sums have no order.
        standing: Let what stands still on the floor at time 0 sleep, without a strain, until
            something comes near; else its weight begins to act then.
        surface: Let plain separating colliders and other bodies push the points, so that bodies lie
            on floors and on each other and not up to 1.5 cells above them (docs/theory/colliders.md
            and contact.md, "At a point"). Pieces of one body touch at nodes. The resident solver
            only; the composed operators hold nodes. None: see :meth:`decided`.
        inertia: Share out the mass of elastic bodies so that thin ones turn and twist as fast as
            they should (:func:`gsfluent.ops.inertial_shares`). Points near surfaces are lighter.
        all_devices: Step scenes of many points on all GPUs of this machine, with the bits of one
            (docs/theory/ranks.md); the resident solver on a GPU only.
        return_map: Options of :func:`gsfluent.ops.return_mapping` (``k``, ``epsilon``,
            ``implicit``).
        max_rollbacks: Roll-backs in a row before the run is given up.

    Raises:
        InputError: ``cfl`` outside its range.
    """

    cfl: float = CFL
    free_flight: bool = True
    piece_flight: bool = True
    sleep: bool = True
    separate_fragments: bool = True
    resident: bool = True
    irreversible: bool = True
    law_kernels: bool = True
    contact_proximity: bool = True
    deterministic: bool = False
    standing: bool = False
    surface: bool | None = None
    inertia: bool = True
    all_devices: bool = False
    return_map: Mapping[str, float | bool] = dataclasses.field(default_factory=dict)
    max_rollbacks: int = 6

    @property
    def flip(self) -> float:
        """Share of their own motion that points keep where the solver can (docs/theory/mpm.md)."""
        return max(0.0, 1.0 - self.cfl / CFL)

    @property
    def contact(self) -> str:
        """What floors and other bodies push once decided, ``"points"`` or ``"nodes"``."""
        return "points" if self.surface else "nodes"

    def decided(self, scene: Scene) -> SolverOptions:
        """The same with ``surface`` chosen for a scene, where it is None.

        Points are pushed where all matter is elastic or a metal, and ``cfl`` is at most 0.5. How
        far brittle presets rebound and break was fitted where nodes are held, and liquids and
        grains gain nothing.
        """
        if self.surface is not None:
            return self
        springy = all(
            body.temperature is None and all(one.law in SPRINGY for one in body.materials)
            for body in scene.bodies
        )
        return dataclasses.replace(self, surface=springy and self.cfl <= CFL_MOST)

    def __post_init__(self) -> None:
        if not 0.0 < self.cfl <= 1.0:
            raise InputError(f"simulate: cfl must lie in (0, 1], got {self.cfl}", hint="use 0.5")
        if self.surface and self.cfl > CFL_MOST:
            raise InputError(
                f"simulate: cfl must be at most {CFL_MOST:g} with surface=True, got {self.cfl:g}",
                hint="longer steps make energy where points are pushed",
            )


class Points(NamedTuple):
    """Moving part of the points of an engine; rows are those it was built with."""

    position: Tensor
    velocity: Tensor
    affine: Tensor
    strain: Tensor
    alpha: Tensor
    peak: Tensor
    deformation: Tensor | None
    viscous: Tensor | None = None


class Engine(Protocol):
    """Points on the grid from a moment on.

    Attributes:
        time: Time reached [s].
        colliders: Rows of the colliders as of ``time``, float64 [M, 32].
        impulse: Impulse of all colliders on the points since the start [N s], float64 [3].
        work: Most energy that colliders can have given since the start [J], float64 [].
        given: Impulse and torque of each grip since the start [N s, N m s], float64 [G, 6].
        cut: Sides of blades its points lie on, int32 [M].
        blocks: Blocks of the grid in use.
    """

    time: float
    colliders: Tensor
    impulse: Tensor
    work: Tensor
    given: Tensor
    cut: Tensor

    @property
    def blocks(self) -> int:
        """See above."""

    def advance(self, until: float, steps: int) -> int:
        """Advance to a time, but by no more than so many steps; return how many were taken."""

    def read(self) -> Points:
        """The points now."""
