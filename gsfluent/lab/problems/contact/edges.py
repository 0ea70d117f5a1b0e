"""Cubes that meet flat, and a cube between plates: contact at points on a few cells.

Units as in :mod:`gsfluent.lab.problems.contact.contact`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from gsfluent.lab.problems.contact.contact import SPACING, bodies
from gsfluent.lab.problems.contact.floor import HALF
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box
from gsfluent.lab.world.walls import wall
from gsfluent.ops.collider import STIFFEST


def cubes(cells: int, *, touch: bool = True, speed: float = 0.05) -> tuple[float, float]:
    """Let a cube meet one of half its edge, face to face, both off the nodes.

    Args:
        cells: Edge of the smaller [dx].
        touch: Whether points push each other; else nodes exchange impulses.
        speed: Of each [c].

    Returns:
        Energy, kinetic and elastic, that is left, and the most that was there, over the first.
    """
    large, small = 2.0 * cells, float(cells)
    gap = 0.5
    parts = [
        box((-large - gap + 0.13, 0.27, -0.31), (large,) * 3, SPACING),
        box((gap + 0.13, 0.27 + 0.5 * small, 0.5 * small - 0.31), (small,) * 3, SPACING),
    ]
    along = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    world = bodies(
        parts, [along, -along], dtype=torch.float32, surface=HALF if touch else None, touch=touch,
    )  # fmt: skip
    start, most = world.kinetic(), 1.0
    for _ in range(12):
        world.run((gap / speed + 6.0 * large) / 12.0)
        now = (world.kinetic() + world.elastic()) / start
        most = max(most, now)
    return now, most


def pressed(cells: int, share: float, *, touch: bool = True, stiffer: float = STIFFEST) -> float:
    """Press a cube slowly between two plates; how far each has sunk into it [dx].

    Args:
        cells: Edge of the cube [dx].
        share: Of its height that the plates come nearer.
        touch: Whether plates push points; else they hold nodes.
        stiffer: What the springs of the plates are stiffer than matter; default: as of a press.
    """
    way, speed = share * cells, 0.02
    rows = [
        wall(2, 0.37, mode="separate", stiffer=stiffer),
        wall(2, 0.37 + cells, -1, mode="separate", velocity=[0.0, 0.0, -speed], stiffer=stiffer),
    ]
    world = bodies(
        [box((0.13, 0.27, 0.37), (cells,) * 3, SPACING)], [torch.zeros(3, dtype=torch.float64)],
        dtype=torch.float32, colliders=rows, surface=HALF if touch else None,
    )  # fmt: skip
    order = torch.argsort(world.position[:, 2])
    layer = (2 * cells) ** 2
    world.run(way / speed)
    z = world.position[:, 2].double()
    between = float(z[order[-layer:]].mean() - z[order[:layer]].mean())
    # the outer layers lie half a spacing inside, less what they are pressed themselves
    return 0.5 * (between + (1.0 - share) * SPACING - (cells - way))


@problem(tier="fast")
def unequal_cubes() -> Iterator[Result]:
    """Cubes of 3, 5, 7 cells meet others twice as large: energy left."""
    edges = (3, 5, 7)
    left, most = zip(*(cubes(n) for n in edges), strict=True)
    lost = ", ".join(f"{1.0 - e:.3f}" for e in left)
    yield compare(
        "energy after / before, 7 cells", left[-1], 1.0, tolerance=0.1, source="elastic impact",
        note=f"0.05 c each; points push; lost at 3, 5, 7 cells: {lost}; at nodes, 7 cells: "
        f"{1.0 - cubes(7, touch=False)[0]:.3f}",
    )  # fmt: skip
    order = math.log((1.0 - left[0]) / (1.0 - left[-1])) / math.log(edges[-1] / edges[0])
    yield compare(
        "order of the energy lost, 3 to 7 cells", order, 1.0, error=max(0.0, 1.0 - order),
        tolerance=0.2, source="order 1",
    )  # fmt: skip
    yield compare(
        "largest energy / first", max(most), 1.0, tolerance=1e-5, source="energy never rises"
    )


@problem(tier="fast")
def pressed_cube() -> Iterator[Result]:
    """Two plates press a cube: how far they sink into it."""
    for cells, share in ((4, 0.05), (8, 0.05), (8, 0.24)):
        yield compare(
            f"each plate in a cube of {cells} cells, pressed by {share:.0%}",
            pressed(cells, share), tolerance=0.1, unit="dx", source="touching",
            note=f"plates hold nodes: {pressed(cells, share, touch=False):.3f} dx; springs as "
            f"stiff as the matter: {pressed(cells, share, stiffer=0.0):.3f} dx",
        )  # fmt: skip
