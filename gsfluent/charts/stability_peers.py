"""Where other programs stand on the maps: named points, from what their released code does.

Sources: users.md section 0 and equations.md sections 2.3 and 19 of the specification, which were
read from the code of CD-MPM (ziran), claymore, GaussianFluent, PhysGaussian (warp-mpm) and Taichi's
MPM. What is run at such a point is gsfluent's or the textbook solver's variant of the same choice,
not that program; scripts/peers runs the programs.
"""

from __future__ import annotations

from collections.abc import Sequence

from gsfluent.charts.stability import Map
from gsfluent.figure.map import Mark

__all__ = ["KNOWN", "marks"]

_GS = "PhysGaussian, GaussianFluent, Taichi"
# map -> (variant whose panel shows it, x, y, name)
KNOWN: dict[str, tuple[tuple[str, float | str, float | str, str], ...]] = {
    "fields": (("one field", 0.0, 1e-2, _GS),),
    "early_contact": (("one field", 1.0, 1.5, _GS),),
    "return_map": (
        ("explicit, ordinary sums", 100.0, 0.0, "CD-MPM, claymore"),
        ("explicit, ordinary sums", 2.0, 0.0, "GaussianFluent, paper"),
    ),
    "order": (("fixed centre, explicit", 3.0, "ordinary", "CD-MPM's map, atomic sums"),),
    "precision": (("absolute positions", 1e5, "float32", _GS),),
    "creep": (("absolute positions", 1e3, 1e-3, _GS),),
    "storage": (("gsfluent", 1e-5, "F, float32", _GS),),
    # demo settings against the automatic step: solver.md, section 6, row 1
    "speed": (
        ("fixed step", 0.5 / 1.37, 0.1, "PhysGaussian ficus, wolf"),
        ("fixed step", 0.5 / 0.81, 0.03, "ficus, light part"),
    ),
    "zero_weight": (("one step is enough", 0.0, "flip, unguarded", "GaussianFluent g2p_flip"),),
    "transfer": (("free cube", 0.6, "flip 0.99", "GaussianFluent's step (0.6)"),),
    "released": (
        ("textbook variants", 0.3, "stress of claymore", "claymore: explodes on impact"),
        ("textbook variants", 0.5, "force of GaussianFluent", "GaussianFluent, released"),
    ),
}


def marks(maps: Sequence[Map]) -> dict[tuple[str, str], list[Mark]]:
    """Named points of these maps by (map, variant)."""
    found: dict[tuple[str, str], list[Mark]] = {}
    for m in maps:
        for variant, x, y, name in KNOWN.get(m.name, ()):
            found.setdefault((m.name, variant), []).append(Mark(x, y, name))
    return found
