"""Where other programs stand on the maps: named points, from their released settings."""

from __future__ import annotations

from collections.abc import Sequence

from gsfluent.charts.stability import Map
from gsfluent.figure.map import Mark

__all__ = ["marks"]


def marks(maps: Sequence[Map]) -> dict[str, list[Mark]]:
    """Named points by map."""
    return {}
