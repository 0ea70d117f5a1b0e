"""Maps of rounding: distance from the origin, slow motion, what is stored of the strain."""

from __future__ import annotations

from typing import Any

import torch

from gsfluent import ops
from gsfluent.lab.stability.maps import Axis, Map, Outcome, Place
from gsfluent.lab.stability.scenes import DENSITY, DX, YOUNG, block, noise, refused, watched
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.invariants import Limits, Violation
from gsfluent.lab.world.shapes import parameters, rotation, wave_speed

CELL, ABSOLUTE = "cell and offset", "absolute positions"
DTYPES = {"float32": torch.float32, "float64": torch.float64}

# --- distance from the origin ---


def far(cells: float, mach: float, dtype: torch.dtype, variant: str, place: Place) -> Outcome:
    """A small body that flies slowly, some cells away from the origin."""
    steps, row = 150, parameters(YOUNG, 0.3, DENSITY)
    c = wave_speed(row)
    points, volume = block(2.0)
    velocity = torch.zeros_like(points)
    velocity[:, 0] = mach * c
    velocity = velocity + 0.1 * mach * c * noise(len(points))
    engine: Any = "solver" if variant == CELL else "ops"
    try:
        world = World(
            points + cells * DX, velocity, volume=volume, dx=DX, law=0,
            params=row, dt=0.5 * DX / c, dtype=dtype, engine=engine, device=place.device,
            frame=(0.0, 0.0, 0.0),  # as where something rests; one that moves along loses nothing
        )  # fmt: skip
    except ValueError as error:
        return refused(steps, error)
    return watched(world, steps, place, limits=Limits(path=0.05))


def precision_point(cells: float, name: str, variant: str, place: Place) -> Outcome:
    """Flight at a hundredth of the wave speed."""
    return far(cells, 0.01, DTYPES[name], variant, place)


def creep_point(cells: float, mach: float, variant: str, place: Place) -> Outcome:
    """Flight in float32 at any speed."""
    return far(cells, mach, torch.float32, variant, place)


_DISTANCES = (1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 2.5e5, 3e5, 1e6)
PRECISION_MAP = Map(
    "precision", "A body far from the origin",
    Axis("distance", "distance from the origin [dx]", _DISTANCES, 100.0, setting=False,
         span=(0.0, 2.5e5)),
    Axis("precision", "precision of the state", ("float32", "float64"), "float32"),
    (CELL, ABSOLUTE), precision_point, "test_boundary_distance_from_the_origin",
    "P: the centre of mass lags behind its momentum by 5 %. The solver refuses at 262 000 "
    "cells; up to there distance costs nothing.", gpu=True,
)  # fmt: skip
CREEP_MAP = Map(
    "creep", "A slow body far from the origin, float32",
    Axis("distance", "distance from the origin [dx]", (1.0, 10.0, 100.0, 1e3, 1e4, 1e5), 100.0,
         setting=False),
    Axis("mach", "speed over wave speed, v / c",
         (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1), 1e-2, setting=False,
         span=(1e-5, 1.0)),
    (CELL, ABSOLUTE), creep_point, "test_boundary_speed_below_rounding",
    "A step below half a unit in the last place is lost: with cell and offset that is 6e-8 dx "
    "wherever the body is.",
)  # fmt: skip

# --- storage ---


def storage_point(mach: float, storage: str, variant: str, place: Place) -> Outcome:
    """Points that turn rigidly: whatever energy they store, rounding made it."""
    steps, axes = 2000, 32
    name = "strain" if "strain" in storage else "F"
    dtype = DTYPES[storage.split()[-1]]
    angle = 0.5 * mach  # radius of a cell, c dt / dx = 0.5
    directions = noise(axes, 2).tolist()
    one = torch.eye(3, dtype=torch.float64)
    grow = torch.stack([rotation(d, angle) for d in directions]) - one
    grow = grow.to(place.device, dtype)
    law = torch.zeros(1, dtype=torch.int32, device=place.device)
    row = parameters(YOUNG, 0.3, DENSITY)[None].to(place.device)
    kinetic = 0.5 * DENSITY * (mach * wave_speed(row[0])) ** 2
    strain = torch.zeros(axes, 6, dtype=dtype, device=place.device)
    alpha, own = strain[:, 0].clone(), row.to(dtype)
    gradient = one.to(grow).expand(axes, 3, 3).contiguous()
    step_matrix = one.to(grow) + grow
    look = 50
    for step in range(1, steps + 1):
        if name == "strain":
            strain = ops.return_mapping(strain, alpha, grow, law=law, params=own)[0]
        else:
            gradient = step_matrix @ gradient  # F <- (I + dt grad v) F
        if step % look:
            continue
        if name == "F":
            f = gradient.double()
            b = f @ f.mT - one.to(f)
            strain = b.flatten(1)[:, [0, 4, 8, 1, 2, 5]]
        energy = ops.elastic_energy(strain.double(), law=law, params=row)
        made = float(energy.mean()) / kinetic
        if not made <= 0.05:
            return Outcome(steps, Violation(step, "energy", 1.0 + made, 1.05), axes)
    return Outcome(steps, None, axes)


STORAGE_MAP = Map(
    "storage", "Points that only turn: strain made by rounding",
    Axis("mach", "speed of turning over wave speed",
         (1e-7, 1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 1e-2, 0.1), 1e-2, setting=False,
         span=(1e-6, 1.0)),
    Axis("storage", "what is stored",
         ("strain, float32", "F, float32", "strain, float64", "F, float64"),
         "strain, float32"),
    ("gsfluent",), storage_point, "test_boundary_storage_of_the_strain",
    "The slower the turning, the smaller the energy that rounding has to outgrow; 2000 steps, "
    "looked at every 50.", gpu=True,
)  # fmt: skip
