"""Demo objects whose shape is a signed distance, and several objects side by side."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsfluent.demo.objects import DemoObject

_STRIDE = 0.6  # share of the distance that a ray walks: distances of bent shapes are too long
_LEAST = 1e-3  # share of the box that a ray walks at least: one that grazes a face would never end
_HALVINGS = 20  # between the last place outside and the first inside
_SLOPE = 1e-5  # m, half the step of a difference quotient


class DistanceObject(DemoObject):
    """Base of objects with a signed distance instead of a bumpy ellipsoid.

    ``axes`` are the half extents of a box around the object, whose centre is the object's.
    Subclasses give :meth:`distance` (in coordinates relative to the centre) and the colours.
    """

    bump_amplitude = 0.0
    level_faces = True

    def distance(self, local: Tensor) -> Tensor:
        """Signed distance [m] of points relative to the centre [N, 3], negative inside, [N].

        It may exceed the true distance by two thirds at most: rays walk by it.
        """
        raise NotImplementedError

    def _place_seeds(self, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        empty = torch.zeros(0, 3, dtype=torch.float64)
        return empty, torch.zeros(0, 3, 3, dtype=torch.float64), torch.ones(3)

    def _lowest_point(self) -> float:
        return -self.axes[2]

    def level(self, points: Tensor) -> Tensor:
        """Signed distance of points [N, 3] from the surface [m], negative inside, [N]."""
        return self.distance(self._local(points))

    def depth(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.depth`."""
        return -self.level(points)

    def parts(self, points: Tensor) -> Tensor:
        """As :meth:`labels`: there are no seeds to tell apart."""
        return self.labels(points)

    def normal(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.normal`."""
        wide = points.to(torch.float64)
        parts = []
        for axis in range(3):
            step = torch.zeros(3, dtype=torch.float64)
            step[axis] = _SLOPE
            parts.append(self.level(wide + step) - self.level(wide - step))
        slope = torch.stack(parts, dim=1)
        return (slope / slope.norm(dim=1, keepdim=True).clamp_min(1e-12)).to(points.dtype)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """See :meth:`DemoObject.bounds`."""
        reach = torch.tensor(self.axes, dtype=torch.float64)
        return self.center - reach, self.center + reach

    def intersect(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """First hits of rays; see :meth:`DemoObject.intersect`."""
        return walk(self, origin, direction)


def walk(obj: DemoObject, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """First hits of rays with an object, by walking as far as its surface is away.

    Args:
        obj: The object; its ``level`` must be a distance [m].
        origin: Ray origin [m], [3].
        direction: Ray directions, [N, 3].

    Returns:
        Indices of the rays that hit, int64 [M], and their hit points [m], [M, 3].
    """
    start = origin.to(torch.float64)
    unit = direction.to(torch.float64)
    unit = unit / unit.norm(dim=1, keepdim=True)
    low, high = obj.bounds()
    a, b = (low - start) / unit, (high - start) / unit
    near = torch.minimum(a, b).amax(dim=1).clamp_min(0.0)
    far = torch.maximum(a, b).amin(dim=1)
    rows = torch.nonzero(far > near)[:, 0]
    t, end = near[rows], far[rows]
    extent = float((high - low).max())
    fine, least = 1e-5 * extent, _LEAST * extent
    hit = torch.zeros_like(rows, dtype=torch.bool)
    before = t.clone()

    def left(of: Tensor, along: Tensor) -> Tensor:
        return obj.level(start + along[:, None] * unit[rows[of]])

    going = torch.arange(len(rows))
    while going.numel() > 0:
        away = left(going, t[going])
        on = away < fine
        hit[going[on]] = True
        going, away = going[~on], away[~on]
        before[going] = t[going]
        t[going] += (_STRIDE * away).clamp_min(least)
        going = going[t[going] < end[going]]
    # the least stride may end inside, so the surface is looked for behind it
    inside = torch.nonzero(hit & (t > before))[:, 0]
    for _ in range(_HALVINGS):
        middle = 0.5 * (before[inside] + t[inside])
        under = left(inside, middle) < fine
        t[inside] = torch.where(under, middle, t[inside])
        before[inside] = torch.where(under, before[inside], middle)
    index = rows[hit]
    return index, (start + t[hit, None] * unit[index]).to(direction.dtype)


class Several(DemoObject):
    """Objects side by side along x, photographed together.

    Attributes:
        members: The objects; each rests on z = 0 like one that is alone.
        offsets: Where each stands [m].
    """

    def __init__(self, members: list[DemoObject], gap: float, seed: int = 0) -> None:
        self.seed, self.members = seed, members
        widths = [2.0 * float((m.bounds()[1] - m.bounds()[0])[0]) / 2.0 for m in members]
        total = sum(widths) + gap * (len(members) - 1)
        left, self.offsets = -0.5 * total, []
        for member, width in zip(members, widths, strict=True):
            x = left + 0.5 * width - float(member.center[0])
            self.offsets.append(torch.tensor([x, 0.0, 0.0], dtype=torch.float64))
            left += width + gap
        boxes = [m.bounds() for m in members]
        low = torch.stack([b[0] + o for b, o in zip(boxes, self.offsets, strict=True)]).amin(dim=0)
        high = torch.stack([b[1] + o for b, o in zip(boxes, self.offsets, strict=True)]).amax(dim=0)
        self.center = 0.5 * (low + high)
        half = (0.5 * (high - low)).tolist()
        self.axes = (half[0], half[1], half[2])
        self.bump_amplitude = 0.0

    def one(self) -> DemoObject:
        """See :meth:`DemoObject.one`."""
        return self.members[0]

    def _of(self, points: Tensor) -> Tensor:
        """Which member each point belongs to: the one it is deepest in, int64 [N]."""
        return torch.stack([m.depth(p) for m, p in self._moved(points)]).argmax(dim=0)

    def _moved(self, points: Tensor) -> list[tuple[DemoObject, Tensor]]:
        pairs = zip(self.members, self.offsets, strict=True)
        return [(m, points - o.to(points.dtype)) for m, o in pairs]

    def _each(self, points: Tensor, name: str) -> Tensor:
        owner = self._of(points)
        found: Tensor | None = None
        for number, (member, moved) in enumerate(self._moved(points)):
            rows = owner == number
            part = getattr(member, name)(moved[rows])
            if found is None:
                found = part.new_zeros(len(points), *part.shape[1:])
            found[rows] = part
        assert found is not None
        return found

    def level(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.level`: the smallest of the members'."""
        return torch.stack([m.level(p) for m, p in self._moved(points)]).amin(dim=0)

    def depth(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.depth`."""
        return torch.stack([m.depth(p) for m, p in self._moved(points)]).amax(dim=0)

    def normal(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.normal`."""
        return self._each(points, "normal")

    def bounds(self) -> tuple[Tensor, Tensor]:
        """See :meth:`DemoObject.bounds`."""
        reach = torch.tensor(self.axes, dtype=torch.float64)
        return self.center - reach, self.center + reach

    def intersect(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`DemoObject.intersect`: the nearest of the members' hits."""
        best = torch.full((len(direction),), torch.inf, dtype=direction.dtype)
        place = torch.zeros_like(direction)
        for member, offset in zip(self.members, self.offsets, strict=True):
            index, hit = member.intersect(origin - offset, direction)
            hit = hit + offset.to(hit.dtype)
            away = (hit - origin.to(hit.dtype)).norm(dim=1)
            nearer = away < best[index]
            best[index[nearer]], place[index[nearer]] = away[nearer], hit[nearer]
        index = torch.nonzero(torch.isfinite(best))[:, 0]
        return index, place[index]

    def labels(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.labels`."""
        return self._each(points, "labels")

    def parts(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.parts`; seeds of different members may share a number."""
        return self._each(points, "parts")

    def surface_color(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.surface_color`."""
        return self._each(points, "surface_color")

    def interior(self, points: Tensor) -> Tensor:
        """See :meth:`DemoObject.interior`."""
        return self._each(points, "interior")
