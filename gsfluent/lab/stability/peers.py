"""Where other programs stand on the maps: named points, from what their released code does.

Sources: :mod:`gsfluent.lab.peers.known`, which has them one by one, for CD-MPM (ziran), claymore,
GaussianFluent, PhysGaussian (warp-mpm) and Taichi's MPM. What is run at such a point is gsfluent's
or the textbook solver's variant of the same choice, not that program; scripts/peers runs the
programs, and what it found there is read by :func:`measured`.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError
from gsfluent.figure.map import Mark
from gsfluent.lab.peers.known import find
from gsfluent.lab.stability.maps import Map


def _courant(demo: str) -> float:
    return find(f"PhysGaussian {demo}").parameters["courant"]


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
    "speed": tuple(
        ("fixed step", _courant(name), mach, f"{name}, its demo")
        for name, mach in (("ficus", 0.1), ("vasedeck", 0.3))
    ),
    "loose": (
        (
            "force by gradients, F (PhysGaussian)",
            _courant("ficus, leaves"),
            0.4,
            "ficus, its leaves",
        ),
    ),
    "zero_weight": (("one step is enough", 0.0, "flip, unguarded", "GaussianFluent g2p_flip"),),
    "transfer": (("free cube", 0.6, "flip 0.99", "GaussianFluent's step (0.6)"),),
    "released": (
        ("textbook variants", 0.3, "stress of claymore", "claymore: explodes on impact"),
        ("textbook variants", 0.5, "force of GaussianFluent", "GaussianFluent, released"),
    ),
}


@dataclasses.dataclass(frozen=True)
class Measured:
    """A failure looked for in a program itself, by ``scripts/peers/failures.py``."""

    map: str  # the map it belongs to
    name: str  # of the experiment
    peer: str  # the program and its version
    what: str  # what was measured
    seen: float  # the figure; NaN where there is none
    right: float  # what it should be
    failed: bool  # whether the failure was there
    note: str  # more
    mark: tuple[str, Mark] | None = None  # panel and point of the map, where it has one


# name of the experiment -> map, panel, and the keys of "axes" that are its coordinates
_EXPERIMENTS: dict[str, tuple[str, str, str | float | None, str | float | None]] = {
    "pull_apart": ("fields", "one field", 0.0, "v_over_c"),
    "step_limit": ("poisson", "gsfluent", "courant", "poisson_ratio"),
    "stagnation": ("creep", "absolute positions", None, None),
    "rotation_drift": ("storage", "gsfluent", None, None),
    "half_cell": ("zero_weight", "one step is enough", None, None),
    "stiffness_ratio": ("ratios", "fixed step of the first", None, None),
}


def measured(path: str | Path) -> list[Measured]:
    """Read what ``scripts/peers/failures.py`` wrote, as far as it belongs to a map.

    Raises:
        InputError: The file cannot be read or holds something else.
    """

    def coordinate(key: str | float | None, axes: dict[str, Any]) -> float | None:
        if isinstance(key, str):
            return float(axes[key]) if key in axes else None
        return key

    found = []
    try:
        for item in json.loads(Path(path).read_text(encoding="utf-8")):
            if item["name"] not in _EXPERIMENTS:
                continue
            name, panel, x_key, y_key = _EXPERIMENTS[item["name"]]
            x, y = (coordinate(key, item.get("axes", {})) for key in (x_key, y_key))
            peer = f"{item['peer']} {item.get('version', '')}".strip()
            mark = None
            if x is not None and y is not None:
                mark = panel, Mark(x, y, f"{item['peer']}, measured")
            seen = item.get("seen")
            found.append(
                Measured(
                    name, item["name"], peer, item["what"], math.nan if seen is None else seen,
                    float(item["right"]), bool(item["reproduced"]), item.get("note", ""), mark,
                )
            )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not the failures of the peers ({type(error).__name__}: {error})",
            "give the file that scripts/peers/failures.py wrote",
        ) from error
    return found


def marks(
    maps: Sequence[Map], programs: Sequence[Measured] = ()
) -> dict[tuple[str, str], list[Mark]]:
    """Named points of these maps by (map, variant), those measured on programs with them."""
    found: dict[tuple[str, str], list[Mark]] = {}
    for one in programs:
        if one.mark is not None and any(m.name == one.map for m in maps):
            found.setdefault((one.map, one.mark[0]), []).append(one.mark[1])
    for m in maps:
        for variant, x, y, name in KNOWN.get(m.name, ()):
            found.setdefault((m.name, variant), []).append(Mark(x, y, name))
    return found
