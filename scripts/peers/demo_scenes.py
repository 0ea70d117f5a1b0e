"""PhysGaussian's six demo settings as scenes with a known answer (NumPy and FractureBench only).

The models of its demos are not public here. The stand-in is a block of their size (longest side
``scale``, sides 1 : 1/2 : 1/4) in the middle of their 2 m domain, with the config's E, nu, density,
grid and step, vibrating freely in its first bending mode, whose frequency and shape are known to
many digits (method of Ritz). Matter is what their pipeline makes of a splat model: Gaussians in a
layer under the surface, random fill points inside as ``particle_filling`` says (without it the
Gaussians are everywhere), and for each the volume of its grid cell over the points in it.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import peerlib
from fracturebench.ritz import box_rule, modes
from peerlib import Floats, Run, Scene

GAUSSIANS = 300_000  # of the object in a trained model; their demo models are not public here
STRAIN = 1e-2  # largest at the start of the motion: small enough for the linear theory
PERIODS, EACH = 2, 8
SIDES = (1.0, 0.25, 0.5)  # bends in y
MIDDLE = 1.0  # of the domain [m]; it moves every object there


@dataclasses.dataclass(frozen=True)
class Setting:
    """What a config says.

    Attributes:
        name: Of the config.
        n_grid: Cells along the 2 m domain.
        dt: Its substep [s].
        frame: Its frame [s].
        young: [Pa].
        poisson: Poisson's ratio.
        density: [kg/m^3].
        scale: Longest side of the object [m].
        material: Its law; all are run as ``jelly`` here, the cheapest, so that there is a mode.
        fill: ``particle_filling`` or None.
    """

    name: str
    n_grid: int
    dt: float
    frame: float
    young: float
    poisson: float
    density: float
    scale: float
    material: str
    fill: Mapping[str, Any] | None

    @property
    def dx(self) -> float:
        """Its node spacing [m]."""
        return 2.0 / self.n_grid

    @property
    def size(self) -> Floats:
        """Sides of the stand-in [m]."""
        return self.scale * np.array(SIDES)

    @property
    def row(self) -> dict[str, Any]:
        """The stand-in's row of materials."""
        return {"law": "elastic", "young_modulus": self.young, "poisson_ratio": self.poisson,
                "density": self.density}  # fmt: skip


def read_config(path: Path) -> Setting:
    """Read a config as its ``decode_param.py`` does: the defaults are its own."""
    data = json.loads(path.read_text(encoding="utf-8"))
    return Setting(
        name=path.stem.removesuffix("_config"),
        n_grid=int(data.get("n_grid", 50)),
        dt=float(data.get("substep_dt", 1e-4)),
        frame=float(data.get("frame_dt", 1e-2)),
        young=float(data.get("E", 1e5)),
        poisson=float(data.get("nu", 0.4)),
        density=float(data.get("density", 200.0)),
        scale=float(data.get("scale", 1.0)),
        material=str(data.get("material", "jelly")),
        fill=data.get("particle_filling"),
    )


def settings(checkout: Path) -> list[Setting]:
    """All configs of a PhysGaussian checkout, by name."""
    found = [read_config(p) for p in sorted((checkout / "config").glob("*_config.json"))]
    if not found:
        raise FileNotFoundError(f"no config/*_config.json in {checkout}")
    return found


class Mode:
    """First bending mode of a stand-in: frequency [1/s], shape and gradient at points."""

    def __init__(self, setting: Setting) -> None:
        half = (0.5 * setting.size).tolist()
        parity = ((1, 1, 0), (0, 0, 0), (0, 1, 1))
        found = modes(box_rule(half, (17, 9, 9)), half, setting.row, parity, (16, 8, 8))
        self.found, self.omega = found, float(found.omega[1])
        edge = np.array([[0.0, 0.0, 0.0], [0.0, half[1], 0.0]])
        shape, gradient = found.at(edge, 1)
        self.middle = float(shape[0, 1])
        strain = np.abs(0.5 * (gradient + gradient.transpose(0, 2, 1))).max()
        self.amplitude = STRAIN / float(strain / abs(self.middle))

    def at(self, x: Floats) -> tuple[Floats, Floats]:
        """Shape [N, 3] (1 in the middle) and gradient [N, 3, 3] at positions in the domain."""
        shape, gradient = self.found.at(x - MIDDLE, 1)
        return shape / self.middle, gradient / self.middle


def lattice(setting: Setting, dx: float, per_cell: int) -> tuple[Floats, Floats]:
    """Points that fill the stand-in evenly, about ``per_cell`` per cell of dx, and volumes."""
    step = dx / per_cell ** (1.0 / 3.0)
    counts = np.maximum(1, np.round(setting.size / step)).astype(int)
    axes = [(np.arange(n) + 0.5) / n - 0.5 for n in counts]
    unit = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    volume = float(np.prod(setting.size / counts))
    return MIDDLE + unit * setting.size, np.full(unit.shape[0], volume)


def fill_cell(setting: Setting) -> float:
    """Edge of a cell of its filling grid [m]: the grid spans ``boundary``, or its whole domain."""
    fill = setting.fill or {}
    box = fill.get("boundary")
    edge = max(box[1] - box[0], box[3] - box[2], box[5] - box[4]) if box else 2.0
    return float(edge) / int(fill["n_grid"])


def pipeline(setting: Setting, gaussians: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Points and volumes as their pipeline makes them of a splat model (see the module)."""
    rng = np.random.default_rng(seed)
    size, corner = setting.size, MIDDLE - 0.5 * setting.size
    if setting.fill is None:
        x = corner + rng.random((gaussians, 3)) * size
    else:
        cell = fill_cell(setting)
        area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
        axis = rng.choice(3, gaussians, p=area / area.sum())
        x = rng.random((gaussians, 3)) * size
        depth = rng.random(gaussians) * min(cell, 0.5 * float(size.min()))
        far = rng.random(gaussians) < 0.5
        rows = np.arange(gaussians)
        x[rows, axis] = np.where(far, size[axis] - depth, depth)
        x += corner
        first = np.ceil(corner / cell - 1e-9).astype(int)
        last = np.floor((corner + size) / cell + 1e-9).astype(int)
        axes = [np.arange(a, b) for a, b in zip(first, last, strict=True)]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        cells = np.repeat(cells, int(setting.fill["max_partciels_per_cell"]), axis=0)
        inside = (cells + rng.random(cells.shape)) * cell
        room = max(0, int(setting.fill["max_particles_num"]))
        x = np.concatenate([x, inside[:room]])
    index = np.floor(x / setting.dx).astype(np.int64)
    flat = (index[:, 0] * setting.n_grid + index[:, 1]) * setting.n_grid + index[:, 2]
    _, where, count = np.unique(flat, return_inverse=True, return_counts=True)
    return x, setting.dx**3 / count[where]


def scene(setting: Setting, x: Floats, volume: Floats, dx: float, mode: Mode) -> Scene:
    """The stand-in bending freely; times fall on whole steps of the config."""
    period = 2.0 * math.pi / mode.omega
    steps = np.round(np.arange(1, PERIODS * EACH + 1) * period / EACH / setting.dt)
    shape, gradient = mode.at(x)
    speed = mode.amplitude * mode.omega
    n = x.shape[0]
    return Scene(
        name=f"demo_{setting.name}", dx=dx, x=x, v=speed * shape, volume=volume,
        material=np.zeros(n, np.int32), body=np.zeros(n, np.int32), affine=speed * gradient,
        times=steps * setting.dt, materials=(setting.row,),
        facts={"omega": mode.omega, "amplitude": mode.amplitude},
    )  # fmt: skip


def displacement(given: Scene, run: Run, mode: Mode) -> Floats:
    """Of the mode over its amplitude, [T]: the exact one is ``sin(w t)``."""
    shape, _ = mode.at(given.x)
    weight = given.mass[:, None] * shape
    u = (weight * (run.x - given.x)).sum(axis=(1, 2)) / float((weight * shape).sum())
    return np.asarray(u / mode.amplitude)


def pitch(times: Floats, u: Floats, omega: float) -> float:
    """Frequency of a displacement over ``omega``: of the free sine that fits it best."""
    tried = np.arange(0.2, 2.0, 0.001)
    left = []
    for share in tried:
        wave = np.stack([np.sin(share * omega * times), np.cos(share * omega * times)], axis=1)
        left.append(float(((u - wave @ np.linalg.lstsq(wave, u, rcond=None)[0]) ** 2).sum()))
    return float(tried[int(np.argmin(left))])


def error(given: Scene, run: Run, mode: Mode) -> float:
    """Displacement of the mode against ``sin(w t)``, relative rms; infinite if it broke off."""
    if not run.finite:
        return math.inf
    exact = np.sin(mode.omega * given.times)
    u = displacement(given, run, mode)
    return float(np.sqrt(np.mean((u - exact) ** 2) / np.mean(exact**2)))


def domain(setting: Setting) -> peerlib.Placement:
    """Their domain: n_grid cells, 2 m, nothing moved."""
    return peerlib.Placement(setting.n_grid, setting.dx, np.zeros(3, np.int64))
