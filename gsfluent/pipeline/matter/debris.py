"""Broken matter and the piece it hangs on.

Broken points belong to no fragment, but most of them lie on one, as a layer along its crack faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

REACH = 1.6
"""Point spacings over which broken matter hangs together."""


def clinging(
    where: NDArray[np.float64], fragment: NDArray[np.int64], reach: float
) -> NDArray[np.int64]:
    """Give broken points (-1) the fragment they hang on.

    Args:
        where: [P, 3] in metres.
        fragment: [P], -1 for broken points.
        reach: Largest gap between points that hang together [m].

    Returns:
        Fragment of each point, still -1 where nothing is near.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    loose = fragment < 0
    if not loose.any() or loose.all():
        return fragment
    debris, solid = where[loose], fragment[~loose]
    gap, beside = cKDTree(where[~loose]).query(debris, distance_upper_bound=reach)
    seeds = np.flatnonzero(np.isfinite(gap))
    found = fragment.copy()
    if len(seeds) == 0:
        return found
    links = cKDTree(debris).query_pairs(reach, output_type="ndarray")
    # a zero would not count as a link
    length = np.linalg.norm(debris[links[:, 0]] - debris[links[:, 1]], axis=1) + 1e-12
    graph = coo_matrix((length, links.T), shape=(len(debris), len(debris))).tocsr()
    _, _, source = dijkstra(
        graph, directed=False, indices=seeds, return_predecessors=True, min_only=True
    )
    reached = source >= 0
    found[np.flatnonzero(loose)[reached]] = solid[beside[source[reached]]]
    return found
