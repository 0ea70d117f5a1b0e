"""Maps of the time step: how long a step may be, for what matter, at what speed."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsfluent.lab.stability.maps import Axis, Map, Outcome, Place
from gsfluent.lab.stability.scenes import (
    DENSITY,
    DX,
    YOUNG,
    block,
    clusters,
    noise,
    thrown,
    watched,
)
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.shapes import box, parameters, wave_speed
from gsfluent.lab.world.walls import between_planes

STEPS = 300
NUMBERS = (0.1, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5, 2.0)
AUTOMATIC = "automatic step"
FIXED = "fixed step"


def courant_axis(*, automatic: bool = False) -> Axis:
    """The Courant number, of the automatic step or of a fixed one."""
    label = "Courant number (c + v) dt / dx" if automatic else "c dt / dx"
    return Axis("courant", label, NUMBERS, 0.5)


def shaken(
    points: Tensor,
    volume: float,
    courant: float,
    place: Place,
    *,
    poisson: float = 0.3,
    **options: Any,
) -> World:
    """A free elastic body whose points move at random, 1e-3 c, at a fixed step."""
    row = parameters(YOUNG, poisson, DENSITY)
    c = wave_speed(row)
    return World(
        points, 1e-3 * c * noise(len(points)), volume=volume, dx=DX, law=0,
        params=row, dt=courant * DX / c, dtype=torch.float32, device=place.device, **options,
    )  # fmt: skip


# --- speed of the body ---


def speed_point(courant: float, mach: float, variant: str, place: Place) -> Outcome:
    """A ball hits a floor at mach times its wave speed."""
    c = wave_speed(parameters(YOUNG, 0.3, DENSITY))
    if variant == AUTOMATIC:
        world = thrown(mach * c, courant=courant, place=place)
    else:
        world = thrown(mach * c, dt=courant * DX / c, place=place)
    return watched(world, STEPS, place)


SPEED_MAP = Map(
    "speed", "A ball hits a floor", courant_axis(automatic=True),
    Axis("mach", "speed over wave speed, v / c",
         (0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0), 0.1, setting=False,
         span=(0.0, 1.0)),
    (AUTOMATIC, FIXED), speed_point, "test_boundary_courant_number_ball_on_a_floor",
    "A fixed step knows the waves and not the speed. At three times the wave speed matter is "
    "squeezed to the end of the range of J, whatever the step.", gpu=True,
    x_labels={FIXED: "c dt / dx"},
)  # fmt: skip


# --- what the matter is ---


def poisson_point(courant: float, poisson: float, variant: str, place: Place) -> Outcome:
    """A shaken free cube of some Poisson's ratio."""
    return watched(shaken(*block(), courant, place, poisson=poisson), STEPS, place)


POISSON_MAP = Map(
    "poisson", "A free cube, against its Poisson's ratio", courant_axis(),
    Axis("poisson", "Poisson's ratio",
         (0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.48, 0.49, 0.495), 0.3, setting=False, log=False),
    ("gsfluent",), poisson_point, "test_boundary_courant_number_free_cube",
    "c is that of the pressure wave, so nearly incompressible matter takes the same numbers.",
    gpu=True,
)  # fmt: skip


def resolution_point(courant: float, per_cell: float, variant: str, place: Place) -> Outcome:
    """A shaken cube of some number of points per cell, free or held all around."""
    cells = 3.0
    points, volume = block(cells, int(per_cell))
    options: dict[str, Any] = {}
    if variant != "gsfluent":
        points = points - points.amin(0) + 0.5 * volume ** (1.0 / 3.0)
        options["colliders"] = between_planes(DX, (0, 1, 2), cells * DX)
    return watched(shaken(points, volume, courant, place, **options), STEPS, place)


POINTS_PER_CELL_MAP = Map(
    "points_per_cell", "A cube, against its points per cell", courant_axis(),
    Axis("points_per_cell", "points per cell", (1.0, 8.0, 27.0, 64.0), 8.0),
    ("gsfluent", "held between planes"), resolution_point,
    "test_boundary_courant_number_points_per_cell",
    "Held on all sides the cube is bulk matter: no free face, no half-empty cell.",
)  # fmt: skip


def fragment_point(courant: float, size: float, variant: str, place: Place) -> Outcome:
    """Sixty-four shaken clusters of a few points each."""
    return watched(shaken(*clusters(int(size)), courant, place), STEPS, place)


FRAGMENTS_MAP = Map(
    "fragments", "Isolated clusters of points", courant_axis(),
    Axis("size", "points in a cluster", tuple(float(n) for n in range(1, 9)), 8.0,
         setting=False, log=False),
    ("gsfluent",), fragment_point, "test_boundary_courant_number_isolated_fragments",
    "Sixty-four random clusters each. What broke off is the first to blow up: its nodes have "
    "little mass.", gpu=True,
)  # fmt: skip


# --- two materials ---


def ratio_point(stiffer: float, denser: float, variant: str, place: Place) -> Outcome:
    """Two shaken blocks that are one body, of ratios of stiffness and density."""
    points = box([0.0] * 3, [0.6, 0.2, 0.2], 0.5 * DX) + 0.037
    second = points[:, 0] > 0.3 + 0.037
    rows = torch.stack(
        [parameters(YOUNG, 0.3, DENSITY), parameters(YOUNG * stiffer, 0.3, DENSITY * denser)]
    )
    first = wave_speed(rows[0])
    volume = (0.5 * DX) ** 3
    world = World(
        points, 1e-3 * first * noise(len(points)), volume=volume,
        dx=DX, law=torch.zeros(2, dtype=torch.int32), params=rows, material=second.int(),
        dt=None if variant == AUTOMATIC else 0.5 * DX / first, dtype=torch.float32,
        device=place.device,
    )  # fmt: skip
    return watched(world, STEPS, place)


_RATIOS = (1e-3, 1e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1e3, 1e4)
RATIOS_MAP = Map(
    "ratios", "Two materials in one body",
    Axis("stiffness", "stiffness of the second over the first", (1e-4, *_RATIOS), 1.0,
         setting=False),
    Axis("density", "density of the second over the first", _RATIOS[:-1], 1.0, setting=False),
    (AUTOMATIC, "fixed step of the first"), ratio_point,
    "test_boundary_ratios_of_stiffness_and_density",
    "The automatic step is that of the faster material; a step chosen for one of them fails "
    "where the other is faster by 2.", gpu=True,
)  # fmt: skip


def stiffness_point(young: float, speed: float, variant: str, place: Place) -> Outcome:
    """A ball of some stiffness hits a floor at some speed."""
    dt = None if variant == AUTOMATIC else 1e-3
    world = thrown(speed, young=young, dt=dt, courant=None if dt else 0.5, place=place)
    return watched(world, STEPS, place)


STIFFNESS_SPEED_MAP = Map(
    "stiffness_speed", "A ball: squeezed flat, or too stiff",
    Axis("young", "Young's modulus [Pa]", (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8), 1e5,
         setting=False, span=(1e3, 1e8)),
    Axis("speed", "speed [m/s]", (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0), 1.0, setting=False,
         span=(0.0, 1.0)),
    (AUTOMATIC, "fixed step of 1 ms"), stiffness_point, "test_boundary_volume_ratio",
    "The automatic step leaves one boundary, v / c of about 2: the matter is squeezed to a "
    "twentieth. A fixed step adds a second, the wave speed that it was not made for.",
)  # fmt: skip


def gradient_point(limit: float, mach: float, variant: str, place: Place) -> Outcome:
    """A ball hits a floor while ``dt |grad v|`` is bounded by a limit."""
    c = wave_speed(parameters(YOUNG, 0.3, DENSITY))
    return watched(thrown(mach * c, place=place, gradient_limit=limit), STEPS, place)


GRADIENT_LIMIT_MAP = Map(
    "gradient_limit", "Largest dt |grad v| of a step",
    Axis("limit", "limit of dt |grad v|", (0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0), 0.3),
    Axis("mach", "speed over wave speed, v / c", (0.1, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0), 0.5,
         setting=False, span=(0.0, 1.0)),
    ("gsfluent",), gradient_point, "test_boundary_gradient_limit",
    "The limit costs nothing below v / c = 1 and cannot save what is squeezed flat above.",
)  # fmt: skip
