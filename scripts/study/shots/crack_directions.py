"""How the crack bands of finished runs lie to the axes of the grid.

    python scripts/study/shots/crack_directions.py out/melons [more runs]

A band is the broken points within four spacings of one of them, where they are flat; its normal is
the axis along which they reach least, at rest. Printed are, for each body: bands found, the share
whose normal lies within 18 degrees of an axis (0.15 for normals that know no axis, 0.41 for such
that lie in a plane of two of them), and the shares of the normals near the plane across the widest
axis by angle, in steps of 15 degrees (0.17 each).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from gsfluent.results.frames import count_frames, load_frame

REACH = 4.0  # spacings
FEWEST = 20  # points of a band
FLAT = 0.35  # least over middle variance of a band, at most
LOOKS = 4000  # broken points that are looked at, about
PLANE = 0.3  # cosine to the axis that normals are near the plane across


def normals(rest: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Normals [B, 3] of the bands of broken points among points at rest [m], [N, 3]."""
    from scipy.spatial import cKDTree

    spacing = float(np.median(cKDTree(rest).query(rest[:500], k=2)[0][:, 1]))
    places = rest[broken]
    tree, found = cKDTree(places), []
    asked = places[:: max(1, len(places) // LOOKS)]
    for rows in tree.query_ball_point(asked, REACH * spacing):
        if len(rows) >= FEWEST:
            near = places[rows] - places[rows].mean(axis=0)
            value, axis = np.linalg.eigh(near.T @ near)
            if value[0] < FLAT * value[1]:
                found.append(axis[:, 0])
    return np.abs(np.array(found).reshape(-1, 3))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    for run in parser.parse_args().runs:
        folder = run / "stages" / "simulate"
        first, last = load_frame(folder, 0), load_frame(folder, count_frames(folder) - 1)
        rest, body = first.positions.numpy(), first.body.numpy()
        broken = last.damage[: len(rest)].numpy() >= 0.999
        for number in np.unique(body):
            mine = body == number
            found = normals(rest[mine], broken[mine])
            if len(found) == 0:
                continue
            steep = float((found.max(axis=1) > 0.95).mean())
            across = int(found.mean(axis=0).argmin())
            flat = np.delete(found[found[:, across] < PLANE], across, axis=1)
            angle = np.degrees(np.arctan2(flat[:, 1], flat[:, 0]))
            shares = np.histogram(angle, np.arange(0, 91, 15))[0] / max(1, len(angle))
            line = " ".join(f"{share:.2f}" for share in shares)
            sys.stdout.write(
                f"{run} body {number}: {len(found)} bands, {steep:.2f} near an axis, {line}\n"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
