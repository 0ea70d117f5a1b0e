"""Fragments: which material points still hang together.

Points are linked to their neighbours at rest. A link is cut when one of its ends is broken (for
good) or while it is stretched beyond twice its length at rest; fragments are the connected
components of what remains.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from gsfluent.ops.blade import cut_apart

LINK_RADIUS = 1.5
"""Points closer than this many mean spacings at rest are linked."""
STRETCH_LIMIT = 2.0
SMALLEST = 20
"""Components with fewer points are debris."""
DEBRIS = -1


@dataclasses.dataclass(frozen=True, eq=False)
class Fragments:
    """The pieces of one moment.

    Args:
        labels: Piece of each point, int32 [N]: the row of its first point, which a piece keeps for
            as long as it keeps that point; -1 for broken points and debris.
        ids: Labels of the pieces, largest mass first, int64 [F].
        mass_fractions: Share of the total mass of each piece, float64 [F].
        debris_fraction: Share of the mass in no piece.
    """

    labels: Tensor
    ids: Tensor
    mass_fractions: Tensor
    debris_fraction: float

    @property
    def count(self) -> int:
        """Number of pieces."""
        return int(self.ids.shape[0])

    @property
    def largest(self) -> float:
        """Mass fraction of the largest piece; 0 when all is debris."""
        return float(self.mass_fractions[0]) if self.count else 0.0


def rest_links(
    rest: Tensor, ranges: tuple[tuple[int, int], ...], spacing: tuple[float, ...]
) -> Tensor:
    """Link points of the same body that are close at rest.

    Args:
        rest: Rest positions [m], [N, 3].
        ranges: First and last + 1 row of each body.
        spacing: Mean point spacing of each body [m].

    Returns:
        Pairs of rows, int64 [L, 2], first row smaller.
    """
    from scipy.spatial import cKDTree

    found = []
    for (a, b), distance in zip(ranges, spacing, strict=True):
        tree = cKDTree(rest[a:b].cpu().numpy())
        pairs = tree.query_pairs(LINK_RADIUS * distance, output_type="ndarray")
        found.append(torch.from_numpy(pairs).to(torch.int64) + a)
    return torch.cat(found) if found else torch.zeros(0, 2, dtype=torch.int64)


def find_fragments(
    links: Tensor,
    rest: Tensor,
    position: Tensor,
    broken: Tensor,
    mass: Tensor,
    *,
    cut: Tensor | None = None,
    smallest: int = SMALLEST,
) -> Fragments:
    """Group the points that still hang together.

    Args:
        links: Pairs at rest, int64 [L, 2], from :func:`rest_links`.
        rest: Rest positions [m], [N, 3].
        position: Present positions [m], [N, 3].
        broken: Points that are broken, or that belong to no piece for another reason, bool [N].
        mass: Masses [kg], [N].
        cut: Sides of blades, int32 [N]; a link between opposite sides is cut.
        smallest: Components with fewer points count as debris.

    Returns:
        The pieces, largest first.

    Raises:
        ValueError: A shape does not match, or a link names a point that does not exist.
    """
    count = rest.shape[0]
    if links.ndim != 2 or links.shape[1] != 2:
        raise ValueError(f"find_fragments: links must have shape [L, 2], got {list(links.shape)}")
    if links.numel() and not (int(links.min()) >= 0 and int(links.max()) < count):
        raise ValueError(f"find_fragments: links must name rows 0 to {count - 1}")
    for name, value in (("position", position), ("broken", broken), ("mass", mass)):
        if value.shape[0] != count:
            raise ValueError(
                f"find_fragments: {name} must have {count} rows (from rest), got {value.shape[0]}"
            )
    import numpy as np
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = links.to(rest.device).unbind(dim=1)
    length = (rest[a] - rest[b]).norm(dim=1)
    stretched = (position[a] - position[b]).norm(dim=1) > STRETCH_LIMIT * length
    gone = broken[a] | broken[b] | stretched
    if cut is not None:
        gone = gone | cut_apart(cut[a], cut[b])
    if rest.is_cuda:
        return _on_device(a[~gone], b[~gone], broken, mass, smallest)
    kept = links[(~gone).cpu()].cpu().numpy()
    graph = coo_matrix(
        (np.ones(len(kept), dtype=bool), (kept[:, 0], kept[:, 1])), shape=(count, count)
    )
    number, component = connected_components(graph, directed=False)
    component = component.astype(np.int64)
    sizes = np.bincount(component, minlength=number)
    masses = np.bincount(component, weights=mass.double().cpu().numpy(), minlength=number)
    first = np.full(number, count, dtype=np.int64)
    np.minimum.at(first, component, np.arange(count))
    whole = (sizes >= smallest) & ~(broken.cpu().numpy()[first])
    labels = np.where(whole[component], first[component], DEBRIS)
    order = np.flatnonzero(whole)
    order = order[np.argsort(-masses[order], kind="stable")]
    fractions = masses[order] / masses.sum()
    return Fragments(
        torch.from_numpy(labels).to(torch.int32).to(rest.device),
        torch.from_numpy(first[order]),
        torch.from_numpy(fractions),
        float(1.0 - fractions.sum()),
    )


def components(a: Tensor, b: Tensor, count: int) -> Tensor:
    """Connected components of a graph, on its device.

    Roots are hooked onto smaller ones and paths halved until all points know their root (after
    Shiloach and Vishkin 1982): a few rounds, each a few kernels.

    Args:
        a: One end of each link, int64 [L].
        b: The other end.
        count: Number of points.

    Returns:
        The smallest row of each point's component, int64 [count].
    """
    root = torch.arange(count, device=a.device)
    while a.numel():
        root.scatter_reduce_(0, torch.maximum(a, b), torch.minimum(a, b), "amin")
        while not torch.equal(further := root[root], root):
            root = further
        a, b = root[a], root[b]
        open_ = a != b
        a, b = a[open_], b[open_]
    return root


_SHARES = 2.0**40


def _on_device(a: Tensor, b: Tensor, broken: Tensor, mass: Tensor, smallest: int) -> Fragments:
    """The pieces, without a copy of the points on the host; sums in whole numbers have no order."""
    count = mass.shape[0]
    root = components(a, b, count)
    sizes = torch.bincount(root, minlength=count)
    whole = (sizes >= smallest) & ~broken.to(root.device)
    share = mass.double() / mass.double().sum()
    weight = torch.zeros_like(root).index_add_(0, root, (share * _SHARES).round().long())
    labels = torch.where(whole[root], root, torch.full_like(root, DEBRIS))
    ids = whole.nonzero()[:, 0].cpu()
    fractions = weight.cpu()[ids].double() / _SHARES
    order = torch.argsort(fractions, descending=True, stable=True)
    fractions = fractions[order]
    return Fragments(labels.to(torch.int32), ids[order], fractions, float(1.0 - fractions.sum()))
