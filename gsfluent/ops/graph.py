"""Graphs of links between points: how far links are stretched, what hangs together, what is near.

The use of all three: :mod:`gsfluent.pipeline.matter.pieces`. What names no point is no link.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient

FAR_KEY = (1 << 62) - 1
"""Key of a point that no seed reaches."""


def link_costs(
    links: Tensor, length: Tensor, spacing: Tensor, position: Tensor, broken: Tensor,
    flowing: Tensor, may_break: Tensor, before: Tensor, gone: Tensor | None = None, *,
    open: float, torn: float, steep: float, unit: float, shift: int,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Which links are cut now, and what the others cost as a way.

    With the ratio ``r`` of a link's length to that at rest, a link of points that may break and do
    not flow is cut where ``r > open`` and an end of it is broken, or ``r > torn``. What is not cut
    and is shorter than ``torn`` costs ``unit length / spacing (1 + steep clamp(r - 1, 0, 2))``,
    rounded, at least 1.

    Args:
        links: Pairs of rows, int64 [L, 2].
        length: Their lengths at rest [m], float64 [L].
        spacing: Distance between the points of each one's body [m], float64 [N].
        position: Where they are [m], float64 [N, 3].
        broken: Broken points, bool [N].
        flowing: Points whose links are never cut by stretching, bool [N].
        may_break: Points of bodies that can come apart, bool [N].
        before: Links that were cut before, bool [L].
        gone: Points on which nothing hangs, bool [N].
        open: Ratio for broken ends.
        torn: Ratio for all.
        steep: Growth of the cost with the stretch.
        unit: Cost of a link as long as the spacing.
        shift: Bits by which costs are shifted up, 0 to 30.

    Returns:
        Links that are cut, bool [L]; costs, int64 [L], 0 of what does not hold; points at an end of
        a cut link, bool [N].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or ``shift``.

    Gradient: none.
    """
    op = "link_costs"
    check_tensor(op, "links", links, shape=("L", 2), dtype=torch.int64)
    check_tensor(op, "position", position, shape=("N", 3), dtype=torch.float64, like=links)
    for name, value, size, dtype in (
        ("length", length, len(links), torch.float64), ("before", before, len(links), torch.bool),
        ("spacing", spacing, len(position), torch.float64),
        ("broken", broken, len(position), torch.bool),
        ("flowing", flowing, len(position), torch.bool),
        ("may_break", may_break, len(position), torch.bool),
        ("gone", gone, len(position), torch.bool),
    ):  # fmt: skip
        if value is not None:
            check_tensor(op, name, value, shape=(size,), dtype=dtype, like=links)
    if not 0 <= shift <= 30:
        raise ValueError(f"{op}: shift must be 0 to 30, got {shift}")
    found: tuple[Tensor, Tensor, Tensor] = torch.ops.gsfluent.link_costs.default(
        links, length, spacing, position, broken, flowing, may_break, gone, before, open, torn,
        steep, unit, shift,
    )  # fmt: skip
    return found


def components(
    links: Tensor, count: int, apart: Tensor | None = None, inside: Tensor | None = None
) -> Tensor:
    """Connected components of a graph (on a GPU after Jaiganesh and Burtscher 2018).

    Args:
        links: Pairs of rows, int64 [L, 2].
        count: Number of points N.
        apart: Links that do not count, bool [L].
        inside: Points whose links count, bool [N]; all when absent.

    Returns:
        The smallest row of each point's component, int64 [N].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or ``count`` is negative.

    Gradient: none.
    """
    op = "components"
    check_tensor(op, "links", links, shape=("L", 2), dtype=torch.int64)
    if count < 0:
        raise ValueError(f"{op}: count must not be negative, got {count}")
    for name, value, size in (("apart", apart, len(links)), ("inside", inside, count)):
        if value is not None:
            check_tensor(op, name, value, shape=(size,), dtype=torch.bool, like=links)
    root: Tensor = torch.ops.gsfluent.components.default(links, count, apart, inside)
    return root


def nearest_seeds(links: Tensor, cost: Tensor, key: Tensor, other: Tensor) -> Tensor:
    """Least sum of a seed's key and the costs of a way from it: shortest paths (Bellman 1958).

    Args:
        links: Pairs of rows, int64 [L, 2].
        cost: Of each in both directions, int64 [L]; 0 or less: it does not hold.
        key: Of the seeds, int64 [N], at least 0; :data:`FAR_KEY` of all other points.
        other: Points that may be reached, bool [N]; the keys of others stay.

    Returns:
        Keys of all points, int64 [N]; what none reaches keeps :data:`FAR_KEY`.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "nearest_seeds"
    check_tensor(op, "links", links, shape=("L", 2), dtype=torch.int64)
    check_tensor(op, "cost", cost, shape=(len(links),), dtype=torch.int64, like=links)
    check_tensor(op, "key", key, shape=("N",), dtype=torch.int64, like=links)
    check_tensor(op, "other", other, shape=(len(key),), dtype=torch.bool, like=links)
    found: Tensor = torch.ops.gsfluent.nearest_seeds.default(links, cost, key, other)
    return found


fakes(
    link_costs=lambda links, length, spacing, position, broken, *rest: (
        torch.empty_like(broken, dtype=torch.bool).new_empty(links.shape[0]),
        links.new_empty(links.shape[0]),
        torch.empty_like(broken),
    ),
    components=lambda links, count, *rest: links.new_empty(count),
    nearest_seeds=lambda links, cost, key, other: torch.empty_like(key),
)
no_gradient("graph: no gradient", "link_costs", "components", "nearest_seeds")
