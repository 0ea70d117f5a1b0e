"""Compute the references of FractureBench that have no closed form, and store them.

    python scripts/fracturebench/references.py [NAME ...] [-o FILE]

Lagrangian finite elements in NumPy, nothing of gsfluent's solver: elements that follow the matter
have no grid to cross, and contact with a plane is a condition on their nodes. ``collide`` is one
ball against its mirror image, with elements of its meridian plane; ``drop`` a quarter of a cube on
a floor that holds what touches it. Each is run with three meshes of halved elements; the last is
stored, and how far Richardson's extrapolation is from it. About five minutes on one core.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Law = Callable[[np.ndarray, float, float], np.ndarray]
ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "gsfluent" / "fracturebench" / "data" / "references.json"


def moduli(poisson: float) -> tuple[float, float]:
    """Shear and bulk modulus of a material whose pressure wave has modulus 1."""
    young = (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson)
    return young / (2.0 * (1.0 + poisson)), young / (3.0 * (1.0 - 2.0 * poisson))


def piola(f: np.ndarray, mu: float, kappa: float) -> np.ndarray:
    """First Piola-Kirchhoff stress of the neo-Hookean law.

    Kirchhoff stress mu J^(-2/3) dev(b) + kappa / 2 (J^2 - 1) I.
    """
    cofactor = np.stack(
        [np.cross(f[..., 1, :], f[..., 2, :]), np.cross(f[..., 2, :], f[..., 0, :]),
         np.cross(f[..., 0, :], f[..., 1, :])], axis=-2,
    )  # fmt: skip
    j = (f[..., 0, :] * cofactor[..., 0, :]).sum(-1)
    if j.min() <= 0.0:
        raise FloatingPointError("an element turned inside out")
    trace = (f * f).sum((-1, -2))
    shear = mu * j ** (-2.0 / 3.0)
    inner = (0.5 * kappa * (j * j - 1.0) - shear * trace / 3.0) / j
    return shear[..., None, None] * f + inner[..., None, None] * cofactor


def corotated(f: np.ndarray, mu: float, kappa: float) -> np.ndarray:
    """First Piola-Kirchhoff stress of the fixed corotated law (Stomakhin et al. 2012).

    The law of most MPM codes for graphics: 2 mu (F - R) + lambda (J - 1) cof F.
    """
    u, _, vt = np.linalg.svd(f)
    cofactor = np.stack(
        [np.cross(f[..., 1, :], f[..., 2, :]), np.cross(f[..., 2, :], f[..., 0, :]),
         np.cross(f[..., 0, :], f[..., 1, :])], axis=-2,
    )  # fmt: skip
    j = (f[..., 0, :] * cofactor[..., 0, :]).sum(-1)
    lam = kappa - 2.0 / 3.0 * mu
    return 2.0 * mu * (f - u @ vt) + (lam * (j - 1.0))[..., None, None] * cofactor


GAUSS = 1.0 / math.sqrt(3.0)


def half_disc(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [N, 2] (r, z) and quadrilaterals [E, 4] of half a disc of radius 1 about (0, 1)."""
    u, v = np.meshgrid(
        np.linspace(0.0, 1.0, n + 1), np.linspace(-1.0, 1.0, 2 * n + 1), indexing="ij"
    )
    # rings of the square become rings of the disc (Shirley & Chiu 1997): elements of like size
    ring = np.maximum(u, np.abs(v))
    safe = np.where(ring > 0.0, ring, 1.0)
    side = u >= np.abs(v)
    turn = 0.25 * math.pi * np.where(side, v / safe, np.sign(v) * (2.0 - u / safe))
    nodes = np.stack([ring * np.cos(turn), 1.0 + ring * np.sin(turn)], axis=-1)
    nodes[0, :, 0] = 0.0  # the axis, whatever the cosine rounds to
    number = np.arange(nodes[..., 0].size).reshape(u.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1)
    return nodes.reshape(-1, 2), quads.reshape(-1, 4)


def ball_on_mirror(
    n: int, speed: float, poisson: float, times: np.ndarray, law: Law = piola
) -> np.ndarray:
    """Momentum of a ball that touches its mirror image at time 0, over that before.

    Args:
        n: Elements along a radius.
        speed: Towards the mirror, over that of the pressure wave.
        poisson: Poisson's ratio.
        times: [radius / wave speed].
        law: First Piola-Kirchhoff stress.
    """
    mu, kappa = moduli(poisson)
    nodes, quads = half_disc(n)
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    points = corner * GAUSS
    value = 0.25 * (1.0 + points[:, None] * corner[None]).prod(-1)  # [g, a]
    steep = 0.25 * np.stack(
        [
            corner[:, 0] * (1.0 + points[:, 1:] * corner[:, 1]),
            corner[:, 1] * (1.0 + points[:, :1] * corner[:, 0]),
        ],
        axis=-1,
    )  # fmt: skip  [g, a, 2]
    place = nodes[quads]
    jacobian = np.einsum("eai,gaj->egij", place, steep)
    gradient = np.einsum("gaj,egji->egai", steep, np.linalg.inv(jacobian))
    radius = np.einsum("ga,ea->eg", value, place[..., 0])
    weight = np.linalg.det(jacobian) * radius  # of one radian
    mass = np.bincount(quads.ravel(), np.einsum("eg,ga->ea", weight, value).ravel(), len(nodes))
    edges = np.linalg.norm(place - np.roll(place, 1, axis=1), axis=-1)
    area = np.linalg.det(jacobian).sum(1)
    dt = 0.4 * float((area / edges.max(1)).min())
    x, v = nodes.copy(), np.zeros_like(nodes)
    v[:, 1] = -speed
    axis = nodes[:, 0] == 0.0
    f = np.zeros((*radius.shape, 3, 3))
    total = float(mass.sum()) * speed
    history = [(0.0, -float(mass @ v[:, 1]) / total)]
    hoop = value[None] / radius[..., None]
    flat = np.arange(len(nodes))
    now = 0.0
    while now < times[-1]:
        here = x[quads]
        f[..., :2, :2] = np.einsum("eai,egaj->egij", here, gradient, optimize=True)
        f[..., 2, 2] = np.einsum("ega,ea->eg", hoop, here[..., 0])
        p = law(f, mu, kappa) * weight[..., None, None]
        force = np.einsum("egij,egaj->eai", p[..., :2, :2], gradient, optimize=True)
        force[..., 0] += np.einsum("eg,ega->ea", p[..., 2, 2], hoop)
        for i in range(2):
            v[:, i] -= dt * np.bincount(quads.ravel(), force[..., i].ravel(), len(flat)) / mass
        v[axis, 0] = 0.0
        below = x[:, 1] + dt * v[:, 1] < 0.0
        v[below, 1] = -x[below, 1] / dt  # just reaches the plane; held as long as it is pushed
        x += dt * v
        now += dt
        history.append((now, -float(mass @ v[:, 1]) / total))
    t, p_of_t = np.array(history).T
    return np.asarray(np.interp(times, t, p_of_t))


def cube_on_floor(
    n: int, speed: float, gravity: float, poisson: float, times: np.ndarray, law: Law = piola
) -> np.ndarray:
    """Height of the centre of a unit cube above its start that touches a sticky floor at time 0.

    Args:
        n: Elements along half an edge.
        speed: Downwards, over that of the pressure wave.
        gravity: [wave speed^2 / edge].
        poisson: Poisson's ratio.
        times: [edge / wave speed].
        law: First Piola-Kirchhoff stress.
    """
    mu, kappa = moduli(poisson)
    h, shape = 0.5 / n, (n + 1, n + 1, 2 * n + 1)
    corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    sign = 2.0 * corner - 1.0
    points = sign * GAUSS
    factor = 1.0 + points[:, None] * sign[None]  # [g, a, 3]
    gradient = np.stack(
        [0.25 / h * sign[:, i] * np.delete(factor, i, axis=2).prod(-1) for i in range(3)], axis=-1
    )
    columns = gradient.transpose(1, 0, 2).reshape(8, 24)
    x = np.stack(
        np.meshgrid(*(np.arange(s) * h for s in shape), indexing="ij"), axis=-1
    )  # x and y from the planes of symmetry
    v, mass = np.zeros_like(x), np.zeros(shape)
    parts = [tuple(slice(o, s - 1 + o) for o, s in zip(c, shape, strict=True)) for c in corner]
    for part in parts:
        mass[part] += h**3 / 8.0
    start = float((mass * x[..., 2]).sum() / mass.sum())
    v[..., 2] = -speed
    v[:, :, 0] = 0.0
    dt, now, history = 0.3 * h, 0.0, [(0.0, 0.0)]
    cells = (n, n, 2 * n)
    while now < times[-1]:
        corners = np.stack([x[part].reshape(-1, 3) for part in parts], axis=-1)  # [E, 3, a]
        f = (corners @ columns).reshape(-1, 3, 8, 3).transpose(0, 2, 1, 3)
        p = law(f, mu, kappa) * (h**3 / 8.0)
        force = p.transpose(0, 2, 1, 3).reshape(-1, 3, 24) @ columns.T
        total = np.zeros_like(x)
        for a, part in enumerate(parts):
            total[part] += force[..., a].reshape(*cells, 3)
        v -= dt * total / mass[..., None]
        v[..., 2] -= dt * gravity
        v[0, :, :, 0] = 0.0
        v[:, 0, :, 1] = 0.0
        v[:, :, 0] = 0.0  # the floor
        x += dt * v
        now += dt
        history.append((now, float((mass * x[..., 2]).sum() / mass.sum()) - start))
    t, height = np.array(history).T
    return np.asarray(np.interp(times, t, height))


def refine(solve: Any, sizes: tuple[int, ...]) -> tuple[np.ndarray, float, float]:
    """Run three meshes; return the finest, the order, and the error left by Richardson.

    The error is a root mean square over that of the answer.
    """
    found = []
    for n in sizes:
        found.append(solve(n))
        print(f"  {n} elements", file=sys.stderr, flush=True)
    coarse, fine = found[1] - found[0], found[2] - found[1]
    size = float(np.sqrt(np.mean(found[2] ** 2)))
    rms = [float(np.sqrt(np.mean(d * d))) / size for d in (coarse, fine)]
    order = math.log2(rms[0] / rms[1])
    return found[2], order, rms[1] / (2.0**order - 1.0)


def stiffening(times: np.ndarray, momentum: np.ndarray, speed: float, poisson: float) -> float:
    """How much stiffer than Hertz's the contact of two balls is: s in F (1 + s sqrt(depth / R)).

    The s for which a ball of this force has the given momentum (units as in ball_on_mirror).
    """
    young = (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson)
    mass = 4.0 / 3.0 * math.pi
    hertz = 4.0 / 3.0 * 0.5 * young / (1.0 - poisson**2) * math.sqrt(0.5) / mass

    def miss(s: float) -> float:
        dt, half, v, found = 0.002, 0.0, speed, [1.0]  # half the depth
        for _ in range(round(times[-1] / dt)):
            depth = max(2.0 * half, 0.0)
            v -= dt * hertz * depth**1.5 * (1.0 + s * math.sqrt(depth))
            half += dt * v
            found.append(v / speed)
        seen = np.interp(times, np.arange(len(found)) * dt, found)
        return float(np.mean((seen - momentum) ** 2))

    low, high = 0.0, 3.0
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    while high - low > 1e-3:
        a, b = high - golden * (high - low), low + golden * (high - low)
        low, high = (low, b) if miss(a) < miss(b) else (a, high)
    return 0.5 * (low + high)


def collide() -> dict[str, Any]:
    """Two balls that meet head on at 0.04 of the wave speed."""
    speed, poisson, times = 0.02, 0.3, np.linspace(0.0, 16.0, 161)
    p, order, left = refine(lambda n: ball_on_mirror(n, speed, poisson, times), (16, 32, 64))
    return {
        "speed": speed, "poisson_ratio": poisson, "times": times.round(6).tolist(),
        "momentum": p.round(7).tolist(), "order": round(order, 2), "error": float(f"{left:.2g}"),
        "stiffening": round(stiffening(times, p, speed, poisson), 3),
    }  # fmt: skip


def drop() -> dict[str, Any]:
    """A cube on a sticky floor at 0.03 of the wave speed."""
    speed, gravity, poisson, times = 0.03, 0.00728, 0.3, np.linspace(0.0, 8.0, 81)
    height, order, left = refine(
        lambda n: cube_on_floor(n, speed, gravity, poisson, times), (6, 12, 24)
    )
    return {
        "speed": speed, "gravity": gravity, "poisson_ratio": poisson,
        "times": times.round(6).tolist(), "height": height.round(8).tolist(),
        "order": round(order, 2), "error": float(f"{left:.2g}"),
    }  # fmt: skip


def hertz() -> dict[str, Any]:
    """Largest force of ever slower impacts over that of Hertz: a check of the elements."""
    poisson, rows = 0.3, []
    young = (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson)
    mass, stiff = 4.0 / 3.0 * math.pi, 0.5 * young / (1.0 - poisson**2)
    for n, speed, end in ((16, 0.02, 12.0), (24, 0.005, 18.0), (32, 0.002, 22.0)):
        times = np.linspace(0.0, end, 401)
        momentum = ball_on_mirror(n, speed, poisson, times)
        depth = (15.0 * 0.5 * mass * (2.0 * speed) ** 2 / (16.0 * stiff * math.sqrt(0.5))) ** 0.4
        force = 4.0 / 3.0 * stiff * math.sqrt(0.5) * depth**1.5
        push = -np.diff(momentum) / np.diff(times) * mass * speed
        rows.append(round(float(push.max()) / force, 3))
        print(f"  speed {speed}: {rows[-1]} of Hertz's force", file=sys.stderr, flush=True)
    return {"speeds": [0.02, 0.005, 0.002], "force_over_hertz": rows}


def laws() -> dict[str, Any]:
    """How much the answers change with the fixed corotated law: what another law may cost."""
    times, poisson = np.linspace(0.0, 16.0, 161), 0.3
    a, b = (ball_on_mirror(16, 0.02, poisson, times, law) for law in (piola, corotated))
    found = {"collide": round(float(np.sqrt(np.mean((a - b) ** 2))), 4)}
    times = np.linspace(0.0, 8.0, 81)
    a, b = (cube_on_floor(6, 0.03, 0.00728, poisson, times, law) for law in (piola, corotated))
    found["drop"] = round(float(np.sqrt(np.mean((a - b) ** 2) / np.mean(a**2))), 4)
    return found


CASES = {"collide": collide, "drop": drop, "hertz": hertz, "laws": laws}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; default all")
    parser.add_argument("-o", "--out", type=Path, default=OUT, metavar="FILE")
    args = parser.parse_args()
    if unknown := sorted(set(args.names) - set(CASES)):
        parser.error(f"no reference {', '.join(unknown)}; there are {', '.join(CASES)}")
    said = json.loads(args.out.read_text(encoding="utf-8")) if args.out.is_file() else {}
    for name in args.names or CASES:
        print(name, file=sys.stderr)
        said[name] = CASES[name]()
        print(name, {k: v for k, v in said[name].items() if not isinstance(v, list)})
    temporary = args.out.with_suffix(".tmp")
    rows = {name: said[name] for name in sorted(said)}
    temporary.write_text(json.dumps(rows) + "\n", encoding="utf-8")
    temporary.replace(args.out)


if __name__ == "__main__":
    main()
