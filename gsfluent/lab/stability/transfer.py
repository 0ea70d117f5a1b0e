"""Maps of what textbook solvers do otherwise: transfers, unguarded divisions, linear kernels."""

from __future__ import annotations

import math
from typing import Any

import torch

from gsfluent.lab.stability.maps import Axis, Map, Outcome, Place
from gsfluent.lab.stability.matter import COURANT, HARDENING, STEPS
from gsfluent.lab.stability.scenes import (
    BRITTLE,
    DENSITY,
    DX,
    IMPACT,
    SPACING,
    STRENGTH,
    YOUNG,
    block,
    brittle,
    brittle_points,
    clusters,
    noise,
    watched,
)
from gsfluent.lab.stability.steps import courant_axis, shaken
from gsfluent.lab.stability.textbook import scene_of, watched_textbook
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.invariants import Limits
from gsfluent.lab.world.shapes import box, nacc, parameters, wave_speed

ELASTIC = {
    "law": "elastic", "young_modulus": YOUNG, "poisson_ratio": 0.3, "density": DENSITY,
}  # fmt: skip

# --- the transfer ---

TRANSFERS = ("apic (gsfluent)", "apic", "pic", "flip 0.95", "flip 0.99", "flip 1")


def free_scene(courant: float, place: Place, which: str, steps: int) -> Outcome:
    """The shaken free cube under one transfer."""
    points, volume = block()
    if "gsfluent" in which:
        return watched(shaken(points, volume, courant, place), steps, place)
    c = wave_speed(parameters(YOUNG, 0.3, DENSITY))
    name, *share = which.split()
    return watched_textbook(
        scene_of(points, 1e-3 * c * noise(len(points)), volume, ELASTIC), steps, place,
        dt=courant * DX / c, transfer=name, flip=float(share[0]) if share else 1.0,
        storage="strain", local_positions=True,
    )  # fmt: skip


def transfer_point(courant: float, which: str, variant: str, place: Place) -> Outcome:
    """A free cube under a transfer."""
    return free_scene(courant, place, which, 100)


TRANSFER_MAP = Map(
    "transfer", "A free cube, against the transfer", courant_axis(),
    Axis("transfer", "transfer (textbook solver but for the first)", TRANSFERS, TRANSFERS[0]),
    ("free cube",), transfer_point, "test_boundary_courant_number_transfer",
)  # fmt: skip

# --- loose points ---

GRADIENTS = "force by gradients, F (PhysGaussian)"


def loose_point(courant: float, poisson: float, variant: str, place: Place) -> Outcome:
    """Sixty-four shaken clusters of two points, which no neighbour holds."""
    steps, (points, volume) = 200, clusters(2)
    if variant == "gsfluent":
        return watched(shaken(points, volume, courant, place, poisson=poisson), steps, place)
    c = wave_speed(parameters(YOUNG, poisson, DENSITY))
    return watched_textbook(
        scene_of(
            points, 1e-3 * c * noise(len(points)), volume, ELASTIC | {"poisson_ratio": poisson}
        ),
        steps, place, dt=courant * DX / c, force="gradient", law="corotated", storage="F",
    )  # fmt: skip


LOOSE_MAP = Map(
    "loose", "Clusters of two points, against Poisson's ratio",
    Axis("courant", "c dt / dx",
         (0.2, 0.3, 0.4, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.9, 1.0, 1.1), 0.5),
    # 0.45 is the largest of the presets; beyond 0.47 the margin is below 1.2 (docs)
    Axis("poisson", "Poisson's ratio", (0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.48, 0.495), 0.3,
         setting=False, span=(0.0, 0.45), log=False),
    ("gsfluent", GRADIENTS), loose_point, "test_boundary_courant_number_of_loose_points",
    "gsfluent's boundary is sqrt((1 - nu) / (1 + nu)): the bulk wave alone, on a point that "
    "nothing else holds.",
)  # fmt: skip

# --- divisions ---


def lone_point(away: float, which: str, variant: str, place: Place) -> Outcome:
    """One point alone, near the place where a weight of its stencil is exactly zero."""
    steps = 4
    at = torch.full((1, 3), 20.5 * DX, dtype=torch.float64) + away * DX
    still = torch.zeros(1, 3, dtype=torch.float64)
    if which == "gsfluent":
        world = World(
            at, still, volume=DX**3, dx=DX, law=0, params=parameters(YOUNG, 0.3, DENSITY), dt=1e-4,
            dtype=torch.float32, device=place.device,
        )  # fmt: skip
        return watched(world, steps, place)
    return watched_textbook(
        scene_of(at, still, DX**3, ELASTIC), steps, place, dt=1e-4,
        transfer="flip" if "flip" in which else "apic", flip=0.99,
        guarded="unguarded" not in which, local_positions=True,
    )  # fmt: skip


ZERO_WEIGHT_MAP = Map(
    "zero_weight", "A point alone where a weight is exactly zero",
    Axis("away", "distance from (n + 1/2) dx [dx]", (0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.1),
         0.0, setting=False, log=False),
    Axis("division", "division by the mass of a node",
         ("gsfluent", "apic, guarded", "apic, unguarded", "flip, guarded", "flip, unguarded"),
         "gsfluent"),
    ("one step is enough",), lone_point, "test_boundary_weight_of_exactly_zero",
    "0 / 0 in the first step: GaussianFluent's path to NaN, if a point is alone.", gpu=True,
)  # fmt: skip

# --- the kernel ---

KERNELS = ("gsfluent", "quadratic, apic", "linear, apic", "quadratic, flip", "linear, flip")


def kernel_point(amplitude: float, which: str, variant: str, place: Place) -> Outcome:
    """A free bar in its longest wave, whose ends move by ``amplitude`` cells."""
    steps, length, row = 300, 16, parameters(YOUNG, 0.0, DENSITY)
    c, volume = wave_speed(row), (0.5 * DX) ** 3
    points = box([0.013, 0.021, 0.037], [length * DX, DX, DX], 0.5 * DX)
    velocity = torch.zeros_like(points)
    phase = math.pi * (points[:, 0] - 0.013) / (length * DX)
    velocity[:, 0] = math.pi * amplitude / length * c * torch.cos(phase)
    dt = 0.3 * DX / c
    if which == "gsfluent":
        world = World(
            points, velocity, volume=volume, dx=DX, law=0, params=row,
            dt=dt, dtype=torch.float32, device=place.device,
        )  # fmt: skip
        return watched(world, steps, place)
    kernel, transfer = which.split(", ")
    return watched_textbook(
        scene_of(points, velocity, volume, ELASTIC | {"poisson_ratio": 0.0}), steps, place, dt=dt,
        kernel=kernel, transfer=transfer, flip=1.0, force="gradient", storage="strain",
        local_positions=True,
    )  # fmt: skip


KERNEL_MAP = Map(
    "kernel", "A free bar whose points cross cells",
    Axis("amplitude", "amplitude of its ends [dx]",
         (0.03, 0.1, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8), 0.3, setting=False),
    Axis("kernel", "kernel and transfer", KERNELS, "gsfluent"),
    ("free bar",), kernel_point, "test_boundary_kernel_of_crossed_cells",
)  # fmt: skip

# --- what released solvers do with brittle matter ---

SOLVERS: dict[str, dict[str, Any]] = {
    "gsfluent": {},
    "dynamic, implicit": {"return_map": "dynamic_implicit"},
    "dynamic, explicit": {"return_map": "dynamic_explicit"},
    "fixed, explicit": {"return_map": "fixed_explicit"},
    "as released by ziran": {"return_map": "fixed_explicit", "absolute": True},
    "flip 0.99": {"return_map": "fixed_explicit", "transfer": "flip", "flip": 0.99},
    "stress of claymore": {
        "return_map": "fixed_explicit", "absolute": True, "energy_as_pressure": True,
    },
    "force of GaussianFluent": {
        "return_map": "released_explicit", "absolute": True, "transfer": "flip", "flip": 0.99,
        "force": "twice", "guarded": False,
    },
}  # fmt: skip
"""Variants of the textbook solver (but for the first); what they are called after is what they
have in common with that code (equations.md, 2.3 and section 13), not a run of it."""


def released_point(courant: float, which: str, variant: str, place: Place) -> Outcome:
    """The brittle ball by a textbook solver; its momentum is not judged, the floor's is unknown."""
    if which == "gsfluent":
        return watched(brittle(courant=courant, place=place), STEPS, place)
    hardening = float(HARDENING.default)
    row = nacc(
        BRITTLE["young_modulus"], BRITTLE["poisson_ratio"], BRITTLE["density"],
        friction=BRITTLE["friction"], cohesion=BRITTLE["cohesion"], hardening=hardening,
    )  # fmt: skip
    points, c = brittle_points(), wave_speed(row)
    velocity = torch.zeros_like(points)
    velocity[:, 2] = -IMPACT * c
    material = {**BRITTLE, "law": "nacc", "hardening": hardening, "alpha": -STRENGTH / hardening}
    floor = {
        "point": [0.0, 0.0, 3.0 * SPACING], "normal": [0.0, 0.0, 1.0], "kind": "separate",
        "friction": 0.3,
    }  # fmt: skip
    scene = scene_of(
        points, velocity, (0.5 * SPACING) ** 3, material, dx=SPACING, gravity=(0.0, 0.0, -9.81),
        colliders=(floor,),
    )  # fmt: skip
    return watched_textbook(
        scene, STEPS, place, dt=courant * SPACING / (c * (1.0 + IMPACT)),
        limits=Limits(momentum=math.inf), **SOLVERS[which],
    )  # fmt: skip


RELEASED_MAP = Map(
    "released", "A brittle ball by other solvers",
    Axis("courant", COURANT.label, (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.2, 1.5, 2.0, 3.0),
         0.5),
    Axis("solver", "solver", tuple(SOLVERS), "gsfluent"),
    ("textbook variants",), released_point, "test_boundary_released_solvers",
    "Two of them gain energy at any step: claymore's stress is the energy where its derivative "
    "belongs, GaussianFluent's released force carries the weight twice.",
)  # fmt: skip
