"""What a crack takes by its angle to the rows of nodes, over the fracture energy asked for.

    python scripts/study/shots/crack_cost.py                 # four minutes of one core
    python scripts/study/shots/crack_cost.py --surface rankine --angles 0 45
    python scripts/study/shots/crack_cost.py --grid-moves 16     # the grid shifts every 16 steps

The slab of ``cantilever_energy`` with jittered points, turned against the grid: the mean of three
places between the nodes, and how many cells are broken across the crack. A crack runs where it is
cheap, so what is not one number here is why pieces are cut along the grid.
"""

from __future__ import annotations

import argparse
import math
import sys

from gsfluent.lab.problems.fracture.energy import open_slowly

SHIFTS = (0.0, 0.25, 0.5)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--surface", choices=("cam_clay", "rankine"), default="cam_clay")
    parser.add_argument("--angles", type=float, nargs="+", default=(0.0, 22.5, 45.0), help="degree")
    parser.add_argument("--cells", type=int, default=32, help="per metre of a slab one metre long")
    parser.add_argument("--grid-moves", type=int, default=0, help="steps; 0: never")
    options = parser.parse_args()
    for angle in options.angles:
        cracks = [
            open_slowly(
                options.cells, shift=shift, angle=math.radians(angle), jitter=1.0,
                surface=options.surface, grid_moves=options.grid_moves,
            )
            for shift in SHIFTS
        ]  # fmt: skip
        energy = sum(crack.energy for crack in cracks) / len(cracks)
        band = sum(crack.band for crack in cracks) / len(cracks)
        sys.stdout.write(
            f"{options.surface} {angle:g} degrees: {energy:.2f} of G_c, {band:.1f} cells broken\n"
        )
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
