"""Named points: where released MPM solvers are known to fail, and what of the textbook shows it.

Each point has its source, the switches of :class:`gsfluent.lab.textbook.solver.Variant`
that the solver
has in common with that code, the same without the fault, and what is measured on both. What is
measured is the textbook solver's variant and never the named program (scripts/peers runs those).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from gsfluent.lab.peers import measured as measured

Switches = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Known:
    """A failure of a released solver."""

    name: str  # of the point
    peer: str  # whose it is
    failure: str  # what fails, in a few words
    source: str  # where it is read
    variant: Switches  # switches of the textbook solver that have the fault
    sound: Switches  # the same without it
    parameters: Mapping[str, float]  # numbers of the point, such as courant = c dt / dx
    quantity: str  # what is measured
    measure: Callable[[Switches, Mapping[str, float]], float]  # measure(switches, parameters)
    # interval of the measured value in which the failure is there; what is not a number is a
    # failure too
    fails: tuple[float, float]
    # their own or the specification's figure, where the quantity is the same
    reported: float | None = None
    shown: bool = True  # whether the variant shows it; False: it does not, and the test says so

    def failing(self, value: float) -> bool:
        """Whether a measured value is the failure."""
        return not math.isfinite(value) or self.fails[0] <= value <= self.fails[1]


def courant(young: float, poisson: float, density: float, dt: float, dx: float) -> float:
    """C dt / dx of a material, with the speed c of its pressure waves."""
    stiff = young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    return math.sqrt(stiff / density) * dt / dx


# PhysGaussian, config/*.json: E, nu, density, substep_dt, grid of 2 m with n_grid (50 if not said)
_DEMOS = {
    "ficus": (2e6, 0.4, 200.0, 1e-4, 50),
    "vasedeck": (1e4, 0.3, 40.0, 1e-4, 120),
    "wolf": (5e7, 0.3, 2000.0, 2e-5, 200),
    "tear_bread": (2e3, 0.3, 200.0, 1e-4, 150),
    "plane": (1e5, 0.3, 1000.0, 1e-4, 120),
    "pillow2sofa": (1e4, 0.3, 2000.0, 1e-4, 100),
}
_PHYSGAUSSIAN = {"law": "corotated", "force": "gradient", "storage": "F"}


def _demo(name: str) -> Known:
    young, poisson, density, dt, cells = _DEMOS[name]
    c = courant(young, poisson, density, dt, 2.0 / cells)
    return Known(
        f"PhysGaussian {name}", "PhysGaussian", "step too short: APIC loses energy by the step",
        f"config/{name}_config.json; solver.md 0.3",
        _PHYSGAUSSIAN, {**_PHYSGAUSSIAN, "_courant": 0.5}, {"courant": c},
        "energy left after one period of a mode of 6 cells, over that at 0.5",
        measured.energy_left, (0.0, 0.98), shown=c < 0.3,
    )  # fmt: skip


_FIXED = {"return_map": "fixed_explicit"}
_OURS = {"return_map": "dynamic_implicit"}

POINTS: tuple[Known, ...] = (
    *(_demo(name) for name in _DEMOS),
    Known(
        "PhysGaussian ficus, leaves", "PhysGaussian",
        "beyond the limit of loose clusters, which the force by gradients has at 0.52 to 0.55",
        "config/ficus_config.json, part of density 70; p2g_apic_with_stress (solver.md 0.3)",
        _PHYSGAUSSIAN, {**_PHYSGAUSSIAN, "force": "mls"},
        {"courant": courant(2e6, 0.4, 70.0, 1e-4, 0.04)},
        "energy of clusters of 1 to 8 points over 250 steps, over that after the first",
        measured.cluster_growth, (1.01, math.inf),
    ),
    Known(
        "PhysGaussian, speed forgotten", "PhysGaussian, GaussianFluent",
        "the step does not know the speed: F turns inside out and J^(-2/3) is no number",
        "dt = 0.6 dx / c of one E, nu, density (equations.md 10)",
        {"storage": "F", **_FIXED}, {"storage": "strain", **_FIXED},
        {"courant": 0.6, "mach": 2.0}, "kinetic energy left of a ball that hits a floor",
        measured.fast_impact, (1.0, math.inf),
    ),
    Known(
        "GaussianFluent, half-way", "GaussianFluent", "0 / 0 where a weight is exactly 0",
        "g2p_flip divides by grid_m unguarded (users.md 0.3; read in mpm_utils.py)",
        {"transfer": "flip", "flip": 0.0, "guarded": False}, {"transfer": "flip", "flip": 0.0},
        {"place": 0.5}, "speed of a lone point at (n + 1/2) dx after a step, over that before",
        measured.lone_point, (2.0, math.inf),
    ),
    Known(
        "GaussianFluent, twice the weight", "GaussianFluent",
        "internal forces carry the weight twice", "p2g_flip_pic_with_stress (equations.md 0.6)",
        {"transfer": "flip", "flip": 1.0, "force": "twice"},
        {"transfer": "flip", "flip": 1.0, "force": "gradient"}, {},
        "stiffness of a bar over E, from the period of its first mode", measured.bar_stiffness,
        (0.0, 0.3), 0.083,
    ),
    Known(
        "GaussianFluent, first yield", "GaussianFluent",
        "alpha jumps at the first yield anywhere on the surface",
        "only one component of the line is normalised (equations.md 3.3)",
        {"return_map": "released_explicit"}, _FIXED, {"u": -0.9},
        "change of alpha when flesh yields by 1e-6", measured.first_yield, (0.01, math.inf), 0.083,
    ),
    Known(
        "GaussianFluent, spin", "GaussianFluent", "no affine part: spin is lost",
        "GaussianBench A1a: 99.7 % lost in 2.5 s (users.md 0.4)",
        {"transfer": "flip", "flip": 0.7}, {"transfer": "apic"}, {},
        "angular momentum left of a free ball after 100 steps", measured.spin_left, (-0.5, 0.5),
    ),
    Known(
        "CD-MPM, compressive tip", "CD-MPM, claymore", "alpha jumps at p = p0",
        "fixed centre; users.md 6.3: -0.199 at q = 3 p0, beta = 5", _FIXED,
        {"return_map": "dynamic_explicit"}, {"beta": 5.0, "q": 3.0, "tip": 1.0},
        "change of alpha inside less outside", measured.tip_jump, (-math.inf, -0.01), -0.199,
    ),
    Known(
        "CD-MPM, tensile tip", "CD-MPM, claymore", "alpha jumps at p = -beta p0",
        "fixed centre; users.md 6.3: +0.092 at q = 3 p0, beta = 5", _FIXED,
        {"return_map": "dynamic_explicit"}, {"beta": 5.0, "q": 3.0, "tip": -1.0},
        "change of alpha inside less outside", measured.tip_jump, (0.01, math.inf), 0.092,
    ),
    Known(
        "CD-MPM, order", "CD-MPM, claymore, GaussianFluent",
        "the same run in another order of sums ends elsewhere", "solver.md 0.6", _FIXED, _OURS, {},
        "distance of two runs of a breaking ball after 80 steps [dx], float32",
        measured.order_spread, (1e-4, math.inf),
    ),
    Known(
        "claymore, pressure", "claymore", "compression pulls: explodes on impact",
        "stress has the energy where its derivative belongs, since f6ac816 (solver.md 0.7)",
        {**_FIXED, "energy_as_pressure": True}, _FIXED, {},
        "kinetic energy of a ball that hits a floor after 60 steps, over that before",
        measured.impact, (1.0, math.inf),
    ),
    Known(
        "claymore, pressure, clamped", "claymore",
        "\"clamping of all J prevents crash, but results are still wrong\"",
        "its own comment (users.md 0.3)",
        {**_FIXED, "energy_as_pressure": True, "clamp": (0.05, 20.0)},
        {**_FIXED, "clamp": (0.05, 20.0)}, {},
        "kinetic energy of a ball that hits a floor after 60 steps, over that before",
        measured.impact, (1.0, math.inf),
    ),
    Known(
        "ziran, units", "CD-MPM, claymore", "tolerances of 1e-4 Pa: other units, other fracture",
        "equations.md 3.4", {**_FIXED, "absolute": True}, _FIXED, {"scale": 1e-6},
        "broken share of a ball with E and density in other units, less that in SI",
        measured.units, (0.05, math.inf),
    ),
    Known(
        "F in float32", "PhysGaussian, GaussianFluent, claymore, Taichi, warp-mpm",
        "rotation makes strain", "solver.md 0.2: 7e-5 to 5e-3 after 1e5 turns", {"storage": "F"},
        {"storage": "strain"}, {"turns": 5000.0}, "|b - I| of an unstrained point",
        measured.rotation_strain, (1e-5, math.inf),
    ),
    Known(
        "absolute float32", "PhysGaussian, GaussianFluent, Taichi, warp-mpm",
        "v dt below half a unit in the last place: never moves", "solver.md 4, row 21", {},
        {"local_positions": True}, {"x": 1.5, "speed": 5e-3, "dt": 1e-5},
        "distance moved over v t", measured.creep, (-0.5, 0.5), 0.0,
    ),
    Known(
        "one field", "PhysGaussian, GaussianFluent, claymore, Taichi, warp-mpm",
        "touching bodies stick", "solver.md 0.5: -0.49 and -0.41 at 0.01 and 0.001 c", {},
        {"fields": True}, {"share": 0.01}, "speed kept by a block that leaves another",
        measured.speed_kept, (-1.0, 0.5), -0.49,
    ),
)  # fmt: skip


def find(name: str) -> Known:
    """Return a point by name.

    Raises:
        ValueError: No such point.
    """
    for point in POINTS:
        if point.name == name:
            return point
    raise ValueError(f"no point {name!r}; there are {', '.join(p.name for p in POINTS)}")
