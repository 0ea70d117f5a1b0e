"""Face elements: flat Gaussians on the planes halfway between points that have come apart."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient


class FaceSites(NamedTuple):
    """Places at which there may be elements, and the points around them at rest.

    Attributes:
        means: Places [m], [S, 3], float32 or float64.
        owner: Own point of each, int64 [S].
        pitch: Distance between the places [m], [S].
        outward: Unit vector to the nearest skin, [S, 3].
        depth: Distance to it [m], [S].
        near: Neighbours of every point, int64 [N, K]; one that is no row counts as the point.
        opened: Which of them have moved away, bool [N, K].
        rest: The points [m], [N, 3].
    """

    means: Tensor
    owner: Tensor
    pitch: Tensor
    outward: Tensor
    depth: Tensor
    near: Tensor
    opened: Tensor
    rest: Tensor


class FaceFit(NamedTuple):
    """How elements fit their faces, lengths in pitches.

    Attributes:
        layer: Half thickness of the layer of places beside a face, times the 1-norm of its normal.
        overlap: How far the middle of an element may lie in the cell of a third point.
        width: Standard deviation along the face.
        inset: How far below the face the centre lies.
        rim: How near a face is along which the skin has elements.
        edge: Standard deviations that fit between a centre and the nearest edge.
        narrowest: Smallest width that an edge leaves, as a share of the width.
        steep: Sine of the angle between two faces below which they have no edge.
        thickness: Standard deviation across the face.
    """

    layer: float
    overlap: float
    width: float
    inset: float
    rim: float
    edge: float
    narrowest: float
    steep: float
    thickness: float


def _check(op: str, rows: Tensor, sites: FaceSites) -> None:
    means = check_tensor(op, "means", sites.means, shape=("S", 3))
    count = means.shape[0]
    check_tensor(op, "rows", rows, shape=("M",), dtype=torch.int64, like=means)
    check_tensor(op, "owner", sites.owner, shape=(count,), dtype=torch.int64, like=means)
    check_tensor(op, "pitch", sites.pitch, shape=(count,), like=means)
    check_tensor(op, "outward", sites.outward, shape=(count, 3), like=means)
    check_tensor(op, "depth", sites.depth, shape=(count,), like=means)
    rest = check_tensor(op, "rest", sites.rest, shape=("N", 3), like=means)
    near = check_tensor(
        op, "near", sites.near, shape=(rest.shape[0], "K"), dtype=torch.int64, like=means
    )
    check_tensor(op, "opened", sites.opened, shape=near.shape, dtype=torch.bool, like=means)


def find_faces(rows: Tensor, sites: FaceSites, fit: FaceFit) -> Tensor:
    """Which places have an element on the face to which neighbour of their own point.

    The face to a neighbour that has moved away lies halfway. A place has an element there when it
    is within the layer beside it, and no third point is nearer to where it is. Along the rim of a
    face the skin has elements as well, of places just below it.

    Args:
        rows: The places asked for, int64 [M].
        sites: All of them.
        fit: How elements fit their faces.

    Returns:
        bool [M, K + 1], the last column for elements of the skin.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    _check("find_faces", rows, sites)
    numbers = [float(value) for value in fit]
    found: Tensor = torch.ops.gsfluent.find_faces.default(rows, *sites, numbers)
    return found


def face_elements(
    rows: Tensor, column: Tensor, sites: FaceSites, fit: FaceFit
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The elements that :func:`find_faces` found.

    Their third axis is the normal of the face; the first one points to the nearest edge, where
    another face or the skin begins, which makes them narrow.

    Args:
        rows: Place of each, int64 [E].
        column: Neighbour to which its face is, K for the skin, int64 [E].
        sites: As given there.
        fit: The same.

    Returns:
        Column of the neighbour, for the skin that of the face whose rim it is, int64 [E]; centres
        [m], [E, 3]; quaternions wxyz [E, 4]; standard deviations [m], [E, 3]; unit normals away
        from the place's own point, [E, 3]. Zeros and the identity where there is no such element.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none.
    """
    op = "face_elements"
    _check(op, rows, sites)
    check_tensor(op, "column", column, shape=rows.shape, dtype=torch.int64, like=sites.means)
    numbers = [float(value) for value in fit]
    rival, means, quats, scales, normals = torch.ops.gsfluent.face_elements.default(
        rows, column, *sites, numbers
    )
    return rival, means, quats, scales, normals


fakes(
    find_faces=lambda rows, means, owner, pitch, outward, depth, near, *rest: rows.new_empty(
        (len(rows), near.shape[1] + 1), dtype=torch.bool
    ),
    face_elements=lambda rows, column, means, *rest: (
        rows.new_empty(rows.shape),
        *(means.new_empty((len(rows), n)) for n in (3, 4, 3, 3)),
    ),
)
no_gradient("faces: no gradient", "find_faces", "face_elements")
