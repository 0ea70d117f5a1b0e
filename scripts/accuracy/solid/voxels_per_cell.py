"""How many voxels of a solid per cell of the simulation: docs/measured/interior.md.

    python scripts/accuracy/solid/voxels_per_cell.py [--cells 40] [--write]

An ellipsoid is voxelised at v voxels per grid cell, its material points are sampled as the
simulation samples them, and the mass they bring to 3 x 3 x 3 neighbourhoods of the grid (what a
quadratic kernel sees) is compared with the exact one near the surface.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from gsfluent.data import SURFACE, Gaussians, Solid
from gsfluent.figure.markdown import enter
from gsfluent.pipeline.matter.points import sample_points

PAGE = Path(__file__).resolve().parents[3] / "docs" / "measured" / "interior.md"
AXES = (1.0, 1.3, 1.6)  # the radius is half the unit length over these
PER_CELL = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 8.0)
DRAWS = 6


def inside(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    a, b, c = AXES
    result: np.ndarray = (a * x[:, None, None]) ** 2 + (b * y[None, :, None]) ** 2 + (
        c * z[None, None, :]
    ) ** 2 <= 0.25
    return result


def exact(cells: int, low: float, fine: int = 8) -> np.ndarray:
    """Share of every grid cell that is matter."""
    count = cells + 6
    axis = low + (np.arange(count * fine) + 0.5) / (cells * fine)
    blocks = inside(axis, axis, axis).reshape(count, fine, count, fine, count, fine)
    result: np.ndarray = blocks.mean((1, 3, 5))
    return result


def solid(voxel: float, shift: np.ndarray) -> Solid:
    count = int(np.ceil(1.3 / voxel))
    origin = -0.65 + (shift - 0.5) * voxel
    axes = [origin[i] + (np.arange(count) + 0.5) * voxel for i in range(3)]
    occupied = torch.from_numpy(inside(*axes))
    one = Gaussians.from_colors(
        torch.zeros(1, 3), torch.full((1,), voxel), torch.full((1, 3), 0.5), label=SURFACE
    )
    return Solid(one, occupied, occupied.float(), torch.from_numpy(origin).float(), voxel)


def row(cells: int, per_cell: float) -> tuple[float, float]:
    """RMS error of the surface cells' mass [share of a full cell], mean error of the volume."""
    from scipy.ndimage import uniform_filter

    dx = 1.0 / cells
    low = -0.5 - 3.0 * dx
    true = exact(cells, low)
    near = uniform_filter(true, 3)
    surface = (near > 0.02) & (near < 0.98)
    errors, volumes = [], []
    rng = np.random.default_rng(0)
    for draw in range(DRAWS):
        body = solid(dx / per_cell, rng.random(3))
        points = sample_points(body, 0.5 * dx, seed=draw).numpy()
        mass = np.zeros_like(true)
        index = np.floor((points - low) / dx).astype(int)
        np.add.at(mass, tuple(index.T), body.volume / len(points) / dx**3)
        errors.append(float(np.sqrt((uniform_filter(mass - true, 3)[surface] ** 2).mean())))
        volumes.append(abs(body.volume / float(true.sum() * dx**3) - 1.0))
    return float(np.mean(errors)), float(np.mean(volumes))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=40, help="grid cells along the object")
    parser.add_argument("--write", action="store_true", help="enter the table into the page")
    options = parser.parse_args()
    lines = [
        "| voxels per cell | mass of surface cells, error | volume, error |",
        "| --- | --- | --- |",
    ]
    for per_cell in PER_CELL:
        mass, volume = row(options.cells, per_cell)
        lines.append(f"| {per_cell:g} | {100 * mass:.1f} % | {100 * volume:.3f} % |")
    table = "\n".join(lines)
    print(table)
    if options.write:
        PAGE.write_text(enter(PAGE.read_text(), "voxels", table))


if __name__ == "__main__":
    main()
