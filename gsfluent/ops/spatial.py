"""Labels and distances of voxels, the largest of many fields, points among cells, sums, noise.

What they are for: :mod:`gsfluent.pipeline.partition` and :mod:`gsfluent.spatial.neighbours`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent import _load  # noqa: F401  (loads the compiled operators)
from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient

MOST_FIELDS = 32767
MOST_TURNS = 64
"""Values that :func:`hashes` draws for a number, at most."""
MOST_OCTAVES = 16
MOST_ALONG = 8192


def nearest_labels(place: Tensor, rank: Tensor, shape: Sequence[int], radius: float) -> Tensor:
    """Label of the nearest point of every voxel, int16 [X, Y, Z]; -1 where none is near.

    Squared distances are counted in shares of 1/1024, so the order of the points changes nothing.

    Args:
        place: Points in voxels, centres at whole numbers, float64 [P, 3]; NaN names nothing.
        rank: Labels of the points, int64 [P], below 2^15; of two as near the lower one wins.
        shape: Voxels along each axis.
        radius: How far a point sees [voxels], 0 to 1000.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or the radius is out of range.

    Gradient: none.
    """
    op = "nearest_labels"
    check_tensor(op, "place", place, shape=("P", 3), dtype=torch.float64)
    check_tensor(op, "rank", rank, shape=(place.shape[0],), dtype=torch.int64, like=place)
    _check_shape(op, shape)
    if not 0.0 <= radius <= 1000.0:
        raise ValueError(f"{op}: radius must be 0 to 1000, got {radius}")
    return torch.ops.gsfluent.nearest_labels.default(place, rank, list(shape), float(radius))


def largest_shares(
    place: Tensor | None, shape: Sequence[int], shares: Tensor, box: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The two largest of many fields, each of which is kept in a box of a grid.

    Fields are asked in order, and a later one must be larger to come first. Between voxels they
    are trilinear. A field that is 0 in the voxel around a place is not asked there.

    Args:
        place: Where [voxels], centres at whole numbers, float32 [M, 3]; None for every voxel.
        shape: Voxels of the grid along each axis; asked only without places.
        shares: The fields one after the other, float32 [S].
        box: For each field its first voxel, its size, and where its shares begin, int64 [F, 7];
            what reaches beyond ``shares``, or has no size, is no field.

    Returns:
        Number of the largest, -1 for none, int16; of the next one, int16; by how much the first
        leads, float32. Each [M], or [X, Y, Z] without places.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or there are more than 32767 fields.

    Gradient: none.
    """
    op = "largest_shares"
    check_tensor(op, "shares", shares, shape=("S",), dtype=torch.float32)
    check_tensor(op, "box", box, shape=("F", 7), dtype=torch.int64, like=shares)
    if place is not None:
        check_tensor(op, "place", place, shape=("M", 3), dtype=torch.float32, like=shares)
    _check_shape(op, shape)
    if box.shape[0] > MOST_FIELDS:
        raise ValueError(f"{op}: at most {MOST_FIELDS} fields, got {box.shape[0]}")
    return torch.ops.gsfluent.largest_shares.default(place, list(shape), shares, box)


def nearest_points(
    points: Tensor,
    queries: Tensor,
    count: int,
    cell: float,
    *,
    group: Tensor | None = None,
    asked: Tensor | None = None,
    reach: float = math.inf,
) -> tuple[Tensor, Tensor]:
    """Nearest points of places.

    Points are found by the hash of their cell. What lies within two cells of a query is asked;
    queries that have not found enough ask cells four times as wide.

    Args:
        points: Where to look, float64 [N, 3], world units.
        queries: float64 [M, 3], world units.
        count: Neighbours of each query.
        cell: Edge of the first cells, about the distance of the neighbours, world units.
        group: Of each point, int64 [N].
        asked: Group in which each query looks, int64 [M]; goes with ``group``.
        reach: Distance beyond which nothing is found, world units.

    Returns:
        Distances float64 [M, count], ascending, infinite where there are too few, and rows int64
        [M, count], -1 there. Of points as near the lower row comes first. Points that are not
        finite are not found, and queries that are not finite find nothing.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, ``cell`` or ``count`` is not positive, ``reach`` is
            negative, or one of ``group`` and ``asked`` is missing.

    Gradient: none.
    """
    op = "nearest_points"
    check_tensor(op, "points", points, shape=("N", 3), dtype=torch.float64)
    check_tensor(op, "queries", queries, shape=("M", 3), dtype=torch.float64, like=points)
    if (group is None) != (asked is None):
        raise ValueError(f"{op}: group and asked go together")
    for name, value, size in (("group", group, len(points)), ("asked", asked, len(queries))):
        if value is not None:
            check_tensor(op, name, value, shape=(size,), dtype=torch.int64, like=points)
    if not (math.isfinite(cell) and cell > 0.0):
        raise ValueError(f"{op}: cell must be positive, got {cell}")
    if not reach >= 0.0:
        raise ValueError(f"{op}: reach must not be negative, got {reach}")
    if count < 1:
        raise ValueError(f"{op}: count must be at least 1, got {count}")
    return torch.ops.gsfluent.nearest_points.default(
        points, queries, group, asked, float(cell), float(reach), count
    )


def box_blur(indicator: Tensor, width: int, times: int = 3) -> Tensor:
    """How often each voxel is counted by passes of a box along every axis.

    What a pass sums beyond the grid is dropped before the next one.

    Args:
        indicator: 0 and 1, bool [X, Y, Z]; outside of the grid is 0.
        width: Odd width of the box [voxels], 1 to 9.
        times: Passes along each axis, 1 to 3.

    Returns:
        int32 [X, Y, Z], at most ``width^(3 times)``.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: The shape, the width or the number of passes is wrong.

    Gradient: none.
    """
    op = "box_blur"
    check_tensor(op, "indicator", indicator, shape=("X", "Y", "Z"), dtype=torch.bool)
    if width % 2 == 0 or not 1 <= width <= 9:
        raise ValueError(f"{op}: width must be odd and 1 to 9, got {width}")
    if not 1 <= times <= 3:
        raise ValueError(f"{op}: times must be 1 to 3, got {times}")
    return torch.ops.gsfluent.box_blur.default(indicator.to(torch.int32), width, times)


def distance_transform(occupied: Tensor, *, indices: bool = False) -> tuple[Tensor, Tensor]:
    """Squared distance of every voxel from the nearest empty one, exact, and which one that is.

    The lower envelope of parabolas along one axis after another, in whole numbers (Meijster,
    Roerdink and Hesselink, "A general algorithm for computing distance transforms in linear time",
    2000).

    Args:
        occupied: bool [X, Y, Z], at most 8192 voxels along an axis and 2^31 in all.
        indices: Whether to say which voxel is nearest.

    Returns:
        Squared distances [voxels^2] int32 [X, Y, Z], 2^28 where no voxel of the grid is empty; flat
        index of the nearest empty voxel, of several the lowest one, int32 [X, Y, Z], the voxel's
        own where none is empty; [0, 0, 0] unless asked for.

    Raises:
        TypeError: ``occupied`` is not bool.
        ValueError: A shape is wrong or too large.

    Gradient: none.
    """
    op = "distance_transform"
    check_tensor(op, "occupied", occupied, shape=("X", "Y", "Z"), dtype=torch.bool)
    if max(occupied.shape) > MOST_ALONG or occupied.numel() >= 2**31 - 1:
        raise ValueError(
            f"{op}: at most {MOST_ALONG} voxels along an axis and 2^31 - 2 in all, "
            f"got {list(occupied.shape)}"
        )
    return torch.ops.gsfluent.distance_transform.default(occupied, indices)


def trilinear(grid: Tensor, place: Tensor) -> Tensor:
    """Values of a grid between its points, trilinear, [N]; corners outside of it count as 0.

    Args:
        grid: float32 or float64 [X, Y, Z].
        place: Where [steps], [N, 3], as ``grid``. At NaN and infinities the value is NaN.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong.

    Gradient: none; :func:`gsfluent.geometry.trilinear` has one.
    """
    op = "trilinear"
    check_tensor(op, "grid", grid, shape=("X", "Y", "Z"), dtype=(torch.float32, torch.float64))
    check_tensor(op, "place", place, shape=("N", 3), dtype=grid.dtype, like=grid)
    return torch.ops.gsfluent.trilinear.default(grid, place)


def value_noise(
    voxels: Tensor, spacings: Sequence[float], shifts: Sequence[float], weights: Sequence[float]
) -> Tensor:
    """Sum of octaves of value noise, three values at each voxel.

    The nodes of an octave's lattice have hashed values, uniform in -1 to 1, between which
    smoothsteps blend along one axis after the other. A hash knows its octave's number.

    Args:
        voxels: int64 [M, 3].
        spacings: Of each octave's nodes [voxels], positive; at most 16 octaves.
        shifts: Of each octave's lattice [spacings].
        weights: Of each octave.

    Returns:
        float32 [M, 3].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape is wrong, the lists are not as long as each other, or a spacing is not
            positive.

    Gradient: none.
    """
    op = "value_noise"
    check_tensor(op, "voxels", voxels, shape=("M", 3), dtype=torch.int64)
    if not len(spacings) == len(shifts) == len(weights) <= MOST_OCTAVES:
        lengths = ", ".join(str(len(part)) for part in (spacings, shifts, weights))
        raise ValueError(
            f"{op}: spacings, shifts and weights must be as many, at most {MOST_OCTAVES}, "
            f"got {lengths}"
        )
    if not all(math.isfinite(s) and s > 0.0 for s in spacings):
        raise ValueError(f"{op}: spacings must be positive, got {list(spacings)}")
    lists = ([float(v) for v in part] for part in (spacings, shifts, weights))
    return torch.ops.gsfluent.value_noise.default(voxels, *lists)


def hashes(seed: Tensor, turns: Sequence[int]) -> Tensor:
    """Uniform values in -1 to 1 from whole numbers, as many for each as there are turns.

    A hash of 32 bits of the number, salted by the turn: the same on every device.

    Args:
        seed: Whole numbers of which the lower 32 bits count, int64 of any shape [...].
        turns: Which values, at most 64.

    Returns:
        float64 [..., turns].

    Raises:
        TypeError: A wrong dtype.
        ValueError: Too many turns.

    Gradient: none.
    """
    check_tensor("hashes", "seed", seed, dtype=torch.int64)
    if len(turns) > MOST_TURNS:
        raise ValueError(f"hashes: at most {MOST_TURNS} turns, got {len(turns)}")
    flat = torch.ops.gsfluent.hashes.default(seed.reshape(-1), [int(turn) for turn in turns])
    return flat.view(*seed.shape, len(turns))


def label_boxes(labels: Tensor, count: int) -> Tensor:
    """First and last voxel of every label along each axis, int32 [count, 6]: x, x, y, y, z, z.

    A label without a voxel has the size of the grid and -1.

    Args:
        labels: int16 [X, Y, Z]; what is not in 0 to ``count`` - 1 is passed over.
        count: Number of labels, at most 32768.

    Raises:
        TypeError: A wrong dtype.
        ValueError: A wrong shape or count.

    Gradient: none.
    """
    check_tensor("label_boxes", "labels", labels, shape=("X", "Y", "Z"), dtype=torch.int16)
    if not 0 <= count <= 32768:
        raise ValueError(f"label_boxes: count must be 0 to 32768, got {count}")
    box: Tensor = torch.ops.gsfluent.label_boxes.default(labels, int(count))
    return box


def margin_counts(
    lead: Tensor, first: Tensor, second: Tensor, offset: Tensor, width: float
) -> Tensor:
    """Voxels that labels have when constants are added to their fields.

    The field of a voxel's first label leads that of its second by ``m = lead + offset[first] -
    offset[second]``: it has the first where m >= 0, and is in the band about a face of both where
    ``|m| < width``.

    Args:
        lead: Before, float32 [M].
        first: int64 [M]; a voxel one of whose labels is none is passed over.
        second: int64 [M].
        offset: Constants, float64 [F].
        width: Of the band.

    Returns:
        Voxels of each label, and those in the bands about its faces, int64 [2, F].

    Raises:
        TypeError: A wrong dtype.
        ValueError: A wrong shape or device.

    Gradient: none.
    """
    op = "margin_counts"
    check_tensor(op, "lead", lead, shape=("M",), dtype=torch.float32)
    for name, value in (("first", first), ("second", second)):
        check_tensor(op, name, value, shape=lead.shape, dtype=torch.int64, like=lead)
    if offset.device != lead.device:
        raise ValueError(f"{op}: offset is on {offset.device}, lead on {lead.device}; move it")
    check_tensor(op, "offset", offset, shape=("F",), dtype=torch.float64)
    found: Tensor = torch.ops.gsfluent.margin_counts.default(
        lead, first, second, offset, float(width)
    )
    return found


def _check_shape(op: str, shape: Sequence[int]) -> None:
    if len(shape) != 3 or any(n < 0 for n in shape):
        raise ValueError(f"{op}: shape must be three sizes, got {tuple(shape)}")


def _three(
    place: Tensor | None, shape: Sequence[int], shares: Tensor, box: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    size = tuple(shape) if place is None else (place.shape[0],)
    return (
        shares.new_empty(size, dtype=torch.int16),
        shares.new_empty(size, dtype=torch.int16),
        shares.new_empty(size),
    )


fakes(
    nearest_labels=lambda place, rank, shape, radius: place.new_empty(
        tuple(shape), dtype=torch.int16
    ),
    largest_shares=_three,
    nearest_points=lambda points, queries, group, asked, cell, reach, count: (
        queries.new_empty((queries.shape[0], count)),
        queries.new_empty((queries.shape[0], count), dtype=torch.int64),
    ),
    box_blur=lambda indicator, width, times: indicator.new_empty(indicator.shape),
    distance_transform=lambda occupied, indices: (
        occupied.new_empty(occupied.shape, dtype=torch.int32),
        occupied.new_empty(occupied.shape if indices else (0, 0, 0), dtype=torch.int32),
    ),
    trilinear=lambda grid, place: grid.new_empty(place.shape[:1]),
    value_noise=lambda voxels, *rest: voxels.new_empty(voxels.shape, dtype=torch.float32),
    hashes=lambda seed, turns: seed.new_empty((len(seed), len(turns)), dtype=torch.float64),
    label_boxes=lambda labels, count: labels.new_empty((count, 6), dtype=torch.int32),
    margin_counts=lambda lead, first, second, offset, width: first.new_empty((2, len(offset))),
)
no_gradient(
    "spatial: no gradient",
    "nearest_labels", "largest_shares", "nearest_points", "box_blur", "distance_transform",
    "trilinear", "value_noise", "hashes", "label_boxes", "margin_counts",
)  # fmt: skip
