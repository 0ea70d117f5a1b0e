"""How a thing stands by itself: which of its sides it rests on, and how far it may tip.

A body rests on a facet of its convex hull when its centre of mass stands above that facet. How far
it may be tipped before it falls over is ``atan(m / h)``, with ``m`` the distance of the centre's
foot from the edge of the support and ``h`` its height.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BAND = 0.02
"""Share of the largest extent above the lowest point that counts as touching the ground."""
_STEADY = np.radians(20.0)
"""Whoever may be tipped this far stands; a figure on its feet is no worse than one on its back."""
_FALLS = np.radians(3.0)
_FIRM = np.radians(15.0)
_TOUCHES, _FLAT = 0.1, 0.3  # shares of the outline that touch the ground
_FEW = 24  # sides of a hull that are tried, largest first
_LEAN = np.cos(np.radians(12.0))  # sides of a hull nearer to each other than this are one


@dataclasses.dataclass(frozen=True)
class Pose:
    """One way to stand."""

    up: Array  # unit vector [3]
    tip: float  # angle by which it may be tipped before it falls over [rad], 0 when it cannot stand
    contact: float  # share of its outline seen from above that touches the ground, 0..1

    @property
    def firm(self) -> bool:
        """Whether it stands beyond doubt."""
        return bool(self.tip >= _FIRM and self.contact >= _TOUCHES)


def upright(points: Array, axes: list[Array], *, most: float = math.pi) -> tuple[Array, bool]:
    """Choose the upward direction of a thing that stands by itself.

    Conventions are kept where they can be: people model and scan things the right way up, and a
    figure lies more firmly on its back than it stands on its feet. Only where the thing would fall
    over on the first axis (tips within 3 degrees, and touches the ground with less than a tenth of
    its outline), the next one on which it stands firmly is taken; where there is none, the side of
    the hull on which it stands best.

    Args:
        points: Points on the surface [N, 3], evenly spread.
        axes: Upward directions that conventions suggest, likeliest first, unit vectors [3].
        most: How far a side of the hull may turn it from the first of them [rad].

    Returns:
        Unit vector [3], and whether the shape chose it against the first convention.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):  # flat, or hardly any points
        return axes[0], False
    corners, center = points[hull.vertices], _centroid(points, hull)
    first = _pose(points, corners, center, axes[0])
    if first.tip >= _FALLS or first.contact >= _TOUCHES:
        return axes[0], False
    for axis in axes[1:]:
        if _pose(points, corners, center, axis).firm:
            return axis, True
    sides = [_pose(points, corners, center, side) for side in _sides(points, hull)]
    near = [pose for pose in sides if pose.up @ axes[0] >= math.cos(most) - 1e-9]
    firm = [pose for pose in near if pose.firm and pose.contact >= _FLAT]
    if not firm:
        return axes[0], False
    return max(firm, key=lambda pose: min(pose.tip / _STEADY, 1.0) + pose.contact).up, True


def _centroid(points: Array, hull: object) -> Array:
    """Centre of the volume of a convex hull [3]."""
    corner = points[hull.simplices]  # type: ignore[attr-defined]
    middle = points.mean(axis=0)
    volume = np.abs(np.linalg.det(corner - middle))
    return np.asarray(middle + volume @ (corner - middle).sum(axis=1) / (4.0 * volume.sum()))


def _sides(points: Array, hull: object) -> Array:
    """Upward directions in which the largest sides of the hull are at the bottom [K, 3]."""
    normals = hull.equations[:, :3]  # type: ignore[attr-defined]
    corner = points[hull.simplices]  # type: ignore[attr-defined]
    area = 0.5 * np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    # neighbouring triangles of one side share a normal, up to the noise of the points
    found: list[Array] = []
    order = np.argsort(-area)
    weight = [float(area[np.abs(normals @ normals[i] - 1.0) < 5e-3].sum()) for i in order[:200]]
    for rank in np.argsort(-np.array(weight)):
        up = -normals[order[rank]]
        if all(up @ other < _LEAN for other in found):
            found.append(up)
        if len(found) == _FEW:
            break
    return np.array(found).reshape(-1, 3)


def _pose(points: Array, corners: Array, center: Array, up: Array) -> Pose:
    across = _across(up)
    height = points @ up
    ground = float(np.quantile(height, 0.001))
    extent = float(np.ptp(corners, axis=0).max())
    low = points[height < ground + _BAND * extent]
    foot, lift = across @ center, float(center @ up) - ground
    margin, touched = _margin(low @ across.T, foot)
    _, outline = _margin(corners @ across.T, foot)
    tip = float(np.arctan2(max(margin, 0.0), max(lift, 1e-12)))
    contact = min(1.0, touched / max(outline, 1e-30))
    return Pose(up, tip, contact)


def _margin(flat: Array, foot: Array) -> tuple[float, float]:
    """How far a place [2] lies inside the hull of points [N, 2], and the area of that hull."""
    from scipy.spatial import ConvexHull, QhullError

    if len(flat) < 3:
        return -np.inf, 0.0
    try:
        hull = ConvexHull(flat)
    except QhullError:
        return -np.inf, 0.0
    return float(-(hull.equations[:, :2] @ foot + hull.equations[:, 2]).max()), float(hull.volume)


def _across(up: Array) -> Array:
    """Two unit vectors across ``up``, [2, 3]."""
    other = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(up, other)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])
