"""Three-point bending by finite elements: what the beam of the study is held against.

    python scripts/study/phase_field/elements.py OUT [--dx 0.02] [--fine 0.03] [--steps 40]

The beam of :func:`cases.bending`: 8 x 2 mm in plane strain, notch of 0.4 mm, AT2 without a split,
l 0.06 mm. Bilinear squares, small strains, forces and damage solved in turn until neither moves,
history as Miehe's. A crack through elements costs 1 + fine / 2 l of Gc, so they work with that
much less. By --dx the notch is three cells of the study's grid wide, and what bears the beam
touches it by edges four cells apart. Leaves bending_elements*.json in OUT, which run.py --enter
reads.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from cases import BEAM, BEAM_TOUGHNESS
from numpy.typing import NDArray

from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.record import machine

Floats = NDArray[np.float64]
WIDE, HIGH, DEEP, LENGTH = 8e-3, 2e-3, 4e-4, 6e-5
NOTCH, BAR = 3.0, 4.0  # cells of the study's grid between what is cut, and outer nodes of a bar
RESIDUAL = 1e-4
GAUSS = [np.array(p) / np.sqrt(3.0) for p in itertools.product((-1.0, 1.0), repeat=2)]
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def graded(begin: float, end: float, fine: float) -> Floats:
    """Places between two, fine at both and coarser in between; ``begin`` is left out."""
    half, step = [0.0], fine
    while half[-1] + step < 0.5 * (end - begin):
        half.append(half[-1] + step)
        step = min(1.3 * step, 2.5e-4)
    rest = 0.5 * (end - begin) / (half[-1] + step)
    half = [rest * x for x in (*half, half[-1] + step)]
    return np.array([begin + x for x in half[1:]] + [end - x for x in half[-2::-1]])


def lines(fine: float, bears: float) -> tuple[Floats, Floats]:
    """Places of the columns and rows of nodes [m]: fine in the middle and where the beam is borne.

    A point that bears gives way by the logarithm of the elements' size, and a tenth of all way is
    that.
    """
    inner = np.arange(0.0, 6e-4 + 0.5 * fine, fine)
    outer = graded(bears, 0.5 * WIDE, fine)
    half = np.concatenate([inner, graded(inner[-1], bears, fine), outer])
    columns = 0.5 * WIDE + np.concatenate([-half[:0:-1], half])
    return columns, np.linspace(0.0, HIGH, round(HIGH / fine) + 1)


class Beam:
    """Elements of half and half a notch: its two faces have nodes of their own."""

    def __init__(self, fine: float, dx: float = 0.0) -> None:
        self.toughness = BEAM_TOUGHNESS / (1.0 + 0.5 * fine / LENGTH)
        edge = 0.5 * BAR * dx
        x, y = lines(fine, 0.5 * WIDE - 2e-4 - edge)
        nx, ny = len(x), len(y)
        number = np.arange(nx * ny).reshape(nx, ny)
        self.place = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        middle, below = nx // 2, int(np.searchsorted(y, DEEP - 1e-9))
        twin = number.copy()  # for the elements on the right of the notch
        twin[middle, :below] = nx * ny + np.arange(below)
        self.place = np.concatenate([self.place, self.place[number[middle, :below]]])
        cells = []
        for i, j in itertools.product(range(nx - 1), range(ny - 1)):
            of = twin if i == middle else number
            cells.append([of[i, j], of[i + 1, j], of[i + 1, j + 1], of[i, j + 1]])
        self.cells = np.array(cells)
        middles = self.place[self.cells].mean(axis=1)
        gone = (np.abs(middles[:, 0] - 0.5 * WIDE) < 0.5 * NOTCH * dx) & (middles[:, 1] < DEEP)
        kept, self.cells = np.unique(self.cells[~gone], return_inverse=True)
        self.place, self.cells = self.place[kept], self.cells.reshape(-1, 4)
        size = np.stack([self.place[self.cells[:, 2]] - self.place[self.cells[:, 0]]])[0]
        self.weight = 0.25 * size.prod(axis=1)
        young, poisson, _ = BEAM
        self.mu = young / (2.0 * (1.0 + poisson))
        self.lame = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
        stiff = np.diag([self.lame + 2.0 * self.mu] * 2 + [self.mu])
        stiff[0, 1] = stiff[1, 0] = self.lame
        self.stiff = stiff
        self.shape, self.slope = [], []
        for p in GAUSS:
            self.shape.append(0.25 * (1.0 + CORNERS[:, 0] * p[0]) * (1.0 + CORNERS[:, 1] * p[1]))
            own = 0.25 * np.stack(
                [CORNERS[:, 0] * (1.0 + CORNERS[:, 1] * p[1]),
                 CORNERS[:, 1] * (1.0 + CORNERS[:, 0] * p[0])], -1,
            )  # fmt: skip
            self.slope.append(own[None] * (2.0 / size)[:, None, :])
        low, top = self.place[:, 1] < 1e-9, self.place[:, 1] > HIGH - 1e-9
        places = (2e-4 + edge, WIDE - 2e-4 - edge)
        ends = [int(np.argmin(np.abs(self.place[:, 0] - x) + 1e3 * ~low)) for x in places]
        near = np.abs(np.abs(self.place[:, 0] - 0.5 * WIDE) - edge) + 1e3 * ~top
        pressed = np.flatnonzero(near < near.min() + 1e-9)
        self.press = 2 * pressed + 1
        self.held = np.array([2 * ends[0] + 1, 2 * ends[1] + 1, 2 * pressed[0], *self.press])
        self.damage = np.zeros(len(self.place))
        self.history = np.zeros((4, len(self.cells)))
        # the load and the supports bear on points, where nothing may be damaged
        far = np.abs(self.place[self.cells].mean(axis=1)[:, 0] - 0.5 * WIDE) < 1.2e-3
        self.breaks = far & (self.place[self.cells].mean(axis=1)[:, 1] < HIGH - 1.8e-4)

    def _strain_of(self, g: int) -> Floats:
        """Strain over displacements of an element's corners at a Gauss point, [E, 3, 8]."""
        b = np.zeros((len(self.cells), 3, 8))
        b[:, 0, 0::2] = b[:, 2, 1::2] = self.slope[g][..., 0]
        b[:, 1, 1::2] = b[:, 2, 0::2] = self.slope[g][..., 1]
        return b

    def displace(self, way: float) -> tuple[Floats, float]:
        """Displacements under a way of the load [m], and its force per thickness [N/m]."""
        wide = np.stack([2 * self.cells, 2 * self.cells + 1], -1).reshape(-1, 8)
        k = np.zeros((len(self.cells), 8, 8))
        for g in range(4):
            d = self.damage[self.cells] @ self.shape[g]
            left = ((1.0 - RESIDUAL) * (1.0 - d) ** 2 + RESIDUAL) * self.weight
            b = self._strain_of(g)
            k += left[:, None, None] * np.einsum("eia,ij,ejb->eab", b, self.stiff, b)
        matrix = _sparse(k, wide, 2 * len(self.place))
        u = np.zeros(2 * len(self.place))
        u[self.press] = -way
        free = np.setdiff1d(np.arange(len(u)), self.held)
        rows = matrix[free]
        u[free] = _factors(rows[:, free].tocsc()).solve(-(rows @ u))
        self.drive(u[wide])
        return u, -float((matrix[self.press] @ u).sum())

    def drive(self, u: Floats) -> None:
        """The history of the displacements of the elements' corners, kept in ``now``."""
        self.now = self.history.copy()
        for g in range(4):
            strain = np.einsum("eia,ea->ei", self._strain_of(g), u)
            energy = 0.5 * np.einsum("ei,ij,ej->e", strain, self.stiff, strain)
            self.now[g] = np.where(self.breaks, np.maximum(self.history[g], energy), 0.0)

    def break_(self) -> None:
        """The damage of this history: (2 H + Gc/l) d - Gc l lap d = 2 H."""
        k, f = np.zeros((len(self.cells), 4, 4)), np.zeros((len(self.cells), 4))
        for g in range(4):
            n, s = self.shape[g], self.slope[g]
            local = (2.0 * self.now[g] + self.toughness / LENGTH) * self.weight
            k += local[:, None, None] * np.outer(n, n)
            k += (self.toughness * LENGTH * self.weight)[:, None, None] * (s @ s.transpose(0, 2, 1))
            f += (2.0 * self.now[g] * self.weight)[:, None] * n
        right = np.bincount(self.cells.ravel(), f.ravel(), len(self.place))
        self.damage = _factors(_sparse(k, self.cells, len(self.place)).tocsc()).solve(right)


def _factors(matrix: Any) -> Any:
    from scipy.sparse.linalg import splu

    return splu(matrix)


def _sparse(k: Floats, wide: NDArray[np.int64], count: int) -> Any:
    from scipy.sparse import coo_matrix

    rows = np.broadcast_to(wide[:, :, None], k.shape).ravel()
    columns = np.broadcast_to(wide[:, None, :], k.shape).ravel()
    return coo_matrix((k.ravel(), (rows, columns)), (count, count)).tocsr()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--dx", type=float, default=0.0, help="of the study's grid [mm]; 0: a slit")
    parser.add_argument(
        "--fine", type=float, default=0.0, help="edge in the middle [mm]; default: half a notch"
    )
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--far", type=float, default=0.06, help="way of the load [mm]")
    args = parser.parse_args()
    begin = time.perf_counter()
    fine = args.fine or 0.5 * NOTCH * args.dx or 0.03
    beam = Beam(1e-3 * fine, 1e-3 * args.dx)
    ways, forces = [], []
    for way in np.linspace(0.0, 1e-3 * args.far, args.steps + 1)[1:]:
        for _ in range(60):
            before = beam.damage.copy()
            _, force = beam.displace(float(way))
            beam.break_()
            if np.abs(beam.damage - before).max() < 2e-3:
                break
        beam.history = beam.now
        ways.append(float(way))
        forces.append(force)
        sys.stderr.write(f"{1e6 * way:.1f} um {force / 1e6:.4f} kN/mm d {beam.damage.max():.2f}\n")
        if force < 0.6 * max(forces):
            break
    at = int(np.argmax(forces))
    args.out.mkdir(parents=True, exist_ok=True)
    kind = f"notch of {NOTCH * args.dx:g} mm" if args.dx else "slit"
    found = {
        "test": "elements", "of": 1e-3 * args.dx, "force": forces[at] / 1e6,
        "setting": f"elements of {fine:g} mm, {kind}",
        "moved": 1e6 * ways[at], "off": 0.0, "wall": time.perf_counter() - begin,
        "points": len(beam.place), "curve": [ways, forces], "machine": machine("cpu"),
    }  # fmt: skip
    with atomic_path(args.out / f"bending_elements_{args.dx:g}.json") as path:
        path.write_text(json.dumps(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
