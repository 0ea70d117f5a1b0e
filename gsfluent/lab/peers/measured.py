"""What is measured at the named points of :mod:`gsfluent.lab.peers.known`.

Every function takes switches of :class:`gsfluent.lab.textbook.solver.Variant` and the
numbers of a point,
and returns one figure; not a number where the run broke off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.problems.fracture import brittle
from gsfluent.lab.problems.fracture.brittle import plain
from gsfluent.lab.textbook.laws import advance, measure
from gsfluent.lab.textbook.nacc import Nacc, return_map
from gsfluent.lab.textbook.solver import Textbook, Variant
from gsfluent.lab.world.shapes import ball, box

Switches = Mapping[str, Any]
Numbers = Mapping[str, float]
DX = brittle.DX
DOUBLE = torch.float64
SOFT: dict[str, Any] = {
    "law": "elastic", "young_modulus": 1e5, "poisson_ratio": 0.0, "density": 1000.0
}  # fmt: skip


def _bar(cells: int) -> tuple[Scene, float]:
    """A free bar in its first mode, and the angular frequency of it [1/s]."""
    length = cells * DX
    points = box([0.0, 0.0, 0.0], [length, 2 * DX, 2 * DX], 0.5 * DX).numpy() + 5.37 * DX
    k = math.pi / length
    phase = k * (points[:, 0] - 5.37 * DX)
    velocity, affine = np.zeros_like(points), np.zeros((points.shape[0], 3, 3))
    velocity[:, 0] = 1e-2 * np.cos(phase)
    affine[:, 0, 0] = -1e-2 * k * np.sin(phase)
    scene = plain(points, velocity, SOFT, affine=affine)
    return scene, k * scene.wave_speed


def energy_left(switches: Switches, numbers: Numbers) -> float:
    """Energy left after a period of a mode of 6 cells, over what a step of 0.5 dx / c leaves."""
    chosen = dict(switches)
    own = float(chosen.pop("_courant", numbers["courant"]))
    left = []
    for c in (own, 0.5):
        scene, omega = _bar(6)
        solver = Textbook(scene, Variant(**chosen), dtype=DOUBLE, dt=c * DX / scene.wave_speed)
        start = solver.kinetic()
        solver.run(seconds=2.0 * math.pi / omega)
        left.append((solver.kinetic() + solver.elastic()) / start)
    return left[0] / left[1]


def bar_stiffness(switches: Switches, numbers: Numbers) -> float:
    """Stiffness of a bar over E: the square of the frequency of its first mode."""
    scene, omega = _bar(8)
    solver = Textbook(scene, Variant(**switches), dtype=DOUBLE, dt=0.3 * DX / scene.wave_speed)
    shape = torch.from_numpy(scene.v[:, 0])
    turned: list[float] = []

    def watch(s: Textbook) -> None:
        if not turned and float((s.velocity[:, 0] * shape).sum()) < 0.0:
            turned.append(s.time)

    solver.run(seconds=4.0 * math.pi / omega, each=watch)
    return (0.5 * math.pi / omega / turned[0]) ** 2 if turned else 0.0


def cluster_growth(switches: Switches, numbers: Numbers) -> float:
    """Largest energy of loose clusters of 1 to 8 points over 250 steps, over that of the first."""
    random = np.random.default_rng(3)
    clouds = [
        0.8 * DX * random.random((size, 3)) + 12.0 * DX * np.array([size, place, 0.0])
        for place in range(6)
        for size in range(1, 9)
    ]
    points = np.concatenate(clouds)
    material = {**SOFT, "poisson_ratio": 0.4}
    scene = plain(points, np.zeros(3), material)
    speed = 1e-3 * scene.wave_speed * random.standard_normal(points.shape)
    scene = plain(points, speed, material)
    dt = numbers["courant"] * DX / scene.wave_speed
    solver = Textbook(scene, Variant(**switches), dtype=DOUBLE, dt=dt).run(steps=1)
    first, largest = solver.kinetic() + solver.elastic(), 0.0
    try:
        for _ in range(50):
            solver.run(steps=5)
            largest = max(largest, solver.kinetic() + solver.elastic())
    except FloatingPointError:
        return math.nan
    return largest / first


def _ends(outcome: brittle.Outcome) -> float:
    return math.nan if outcome.birth is not None else outcome.kinetic


def impact(switches: Switches, numbers: Numbers) -> float:
    """Kinetic energy of a brittle ball 60 steps after it fell on a floor, over that before."""
    scene = brittle.drop(0.08)
    return _ends(brittle.run(scene, Variant(**switches), steps=60, dt=brittle.step(scene)))


def fast_impact(switches: Switches, numbers: Numbers) -> float:
    """The same at ``mach`` times the wave speed with a step that the speed does not shorten."""
    c = brittle.drop(0.08).wave_speed
    scene = brittle.drop(0.08, speed=numbers["mach"] * c)
    dt = numbers["courant"] * DX / c
    return _ends(brittle.run(scene, Variant(**switches), steps=30, dt=dt))


def order_spread(switches: Switches, numbers: Numbers) -> float:
    """Distance of two runs of a breaking ball whose sums are made in other orders [dx]."""
    scene = brittle.drop(0.08)
    runs = [
        brittle.run(
            scene, Variant(storage="strain", shuffle=seed, **switches), steps=80,
            dt=brittle.step(scene),
        )
        for seed in (1, 2)
    ]  # fmt: skip
    return brittle.apart(*runs)[0]


def units(switches: Switches, numbers: Numbers) -> float:
    """Difference of the broken share when E and density are both multiplied by ``scale``."""
    share = []
    for scale in (1.0, numbers["scale"]):
        flesh = dict(brittle.FLESH)
        flesh |= {k: flesh[k] * scale for k in ("young_modulus", "density")}
        scene = brittle.drop(0.08, material=flesh)
        run = brittle.run(
            scene, Variant(**switches), steps=60, dt=brittle.step(scene), dtype=DOUBLE
        )
        share.append(run.broken)
    return abs(share[1] - share[0])


def lone_point(switches: Switches, numbers: Numbers) -> float:
    """Speed of a point that flies alone, after one step over before."""
    scene = plain(
        np.full((1, 3), (5.0 + numbers["place"]) * DX), np.array([1.0, 0.0, 0.0]), SOFT, 1
    )
    solver = Textbook(scene, Variant(**switches), dt=1e-9)
    try:
        solver.run(steps=1)
    except FloatingPointError:
        return math.nan
    return float(solver.velocity[0, 0])


def spin_left(switches: Switches, numbers: Numbers) -> float:
    """Angular momentum of a free ball after 100 steps over that before, affine part included."""
    points = ball([8.0 * DX] * 3, 2.0 * DX, 0.5 * DX).numpy()
    turn = np.array([[0.0, -4.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    scene = plain(
        points, (points - points.mean(0)) @ turn.T, SOFT,
        affine=np.tile(turn, (points.shape[0], 1, 1)),
    )  # fmt: skip
    solver = Textbook(scene, Variant(**switches), dtype=DOUBLE, dt=0.5 * DX / scene.wave_speed)
    if solver.variant.transfer != "apic":
        solver.affine = torch.zeros_like(solver.affine)  # what it never has

    def spin() -> float:
        arm = solver.position - solver.position.mean(0)
        orbit = torch.linalg.cross(arm, solver.velocity)[:, 2]
        curl = 0.25 * DX**2 * (solver.affine[:, 1, 0] - solver.affine[:, 0, 1])
        return float((solver.mass * (orbit + curl)).sum())

    start = spin()
    solver.run(steps=100)
    return spin() / start


# --- the return maps ---

KAPPA, MU, FRICTION, HARDENING, ALPHA = 2778.0, 2000.0 / 2.76, 1.85, 3.0, -0.04
"""Watermelon of users.md 6.3."""


def _strain(p: float, q: float) -> torch.Tensor:
    """E = b - I of a state of pressure p and shear q (pure shear plus volume) [Pa], [1, 3, 3]."""
    j = math.sqrt(1.0 - 2.0 * p / KAPPA)
    s = q / (math.sqrt(1.5) * MU) / math.sqrt(2.0)
    m = 1.0
    for _ in range(60):  # det(m I + d) = 1
        m -= (m**3 - m * s * s - 1.0) / (3.0 * m * m - s * s)
    b = torch.diag(torch.full((3,), m, dtype=DOUBLE))
    b[0, 1] = b[1, 0] = s
    return (j ** (2.0 / 3.0) * b - torch.eye(3, dtype=DOUBLE))[None]


def _change(switches: Switches, beta: float, p: float, q: float) -> float:
    row = [MU, KAPPA, FRICTION, beta, HARDENING]
    nacc = Nacc(*torch.tensor([row], dtype=DOUBLE).unbind(1))
    alpha = torch.full((1,), ALPHA, dtype=DOUBLE)
    kind = str(switches["return_map"])
    return float(return_map(kind, nacc, measure(_strain(p, q), "strain"), alpha)[1] - alpha)


def _tip() -> float:
    return KAPPA * (1e-5 + math.sinh(-HARDENING * ALPHA))


def tip_jump(switches: Switches, numbers: Numbers) -> float:
    """Change of alpha just inside a tip of the surface less that just outside."""
    p0 = _tip()
    end = p0 if numbers["tip"] > 0 else -numbers["beta"] * p0
    q = numbers["q"] * p0
    inside, outside = (
        _change(switches, numbers["beta"], end * (1.0 + s), q) for s in (-1e-6, 1e-6)
    )
    return inside - outside


def first_yield(switches: Switches, numbers: Numbers) -> float:
    """Change of alpha of flesh whose shear is 1e-6 beyond the surface at ``u``."""
    beta, p0 = 0.6, _tip()
    half = 0.5 * (1.0 + beta) * p0
    p = 0.5 * (1.0 - beta) * p0 + numbers["u"] * half
    height = FRICTION * half / math.sqrt(1.0 + 2.0 * beta)
    q = height * math.sqrt(1.0 - numbers["u"] ** 2) * (1.0 + 1e-5)
    return _change(switches, beta, p, q)


# --- what single precision does ---


def rotation_strain(switches: Switches, numbers: Numbers) -> float:
    """Largest entry of b - I of a point that only turns, by 0.01 per step, float32."""
    storage = str(switches["storage"])
    turn = torch.zeros(3, 3, dtype=DOUBLE)
    turn[0, 0] = turn[1, 1] = math.cos(1e-2) - 1.0
    turn[1, 0], turn[0, 1] = math.sin(1e-2), -math.sin(1e-2)
    increment = turn[None].float()
    state = torch.eye(3)[None] if storage == "F" else torch.zeros(1, 3, 3)
    for _ in range(int(numbers["turns"])):
        state = advance(state, increment, storage)
    return float(measure(state, storage).e.abs().max())


def creep(switches: Switches, numbers: Numbers) -> float:
    """Distance that a point moves in 200 steps over v t, float32."""
    scene = plain(np.full((1, 3), numbers["x"]), np.array([numbers["speed"], 0.0, 0.0]), SOFT, 1)
    solver = Textbook(scene, Variant(**switches), dt=numbers["dt"]).run(steps=200)
    moved = float(solver.position[0, 0]) - numbers["x"]
    return moved / (200.0 * numbers["dt"] * numbers["speed"])


def speed_kept(switches: Switches, numbers: Numbers) -> float:
    """Speed that a block keeps when it leaves another which it touched."""
    left = box([4.0 * DX] * 3, [4.0 * DX, 3.0 * DX, 3.0 * DX], 0.5 * DX).numpy()
    points = np.concatenate([left, left + [4.0 * DX, 0.0, 0.0]])
    body = np.repeat(np.array([0, 1], np.int32), left.shape[0])
    material = {**SOFT, "poisson_ratio": 0.2}
    speed = numbers["share"] * plain(left, np.zeros(3), material).wave_speed
    velocity = np.zeros_like(points)
    velocity[:, 0] = np.where(body == 1, speed, -speed)
    scene = plain(points, velocity, material, body=body)
    solver = Textbook(scene, Variant(**switches), dt=0.5 * DX / scene.wave_speed)
    solver.run(seconds=12.0 * 8.0 * DX / scene.wave_speed)
    return float(solver.velocity[torch.from_numpy(body == 1), 0].mean()) / speed
