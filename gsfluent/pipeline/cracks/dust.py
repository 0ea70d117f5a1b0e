"""Dust: material points that hang on nothing, each drawn as a cloud of fine grains.

A point of dust is as large as the grid is fine, which no grain of the real thing is. So it is drawn
as grains, as frequent as their size to the power -3.5 (Villermaux 2025), in the colours of the
places that they come from, drops nearer to that of the flesh. Their volumes sum to that of
the point. They leave with it: a point that has gone a way relative to the chunk that it came from
has scattered its grains by a fifth of that. What is left behind is a pit in the chunk
(:mod:`gsfluent.pipeline.cracks.chunks`). Drops that reach the floor spread on it.

All that is random about a grain is hashed from the row of its point and its number, so it is the
same in every frame, on every device and after a resume. A run without dust has no grains.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry, materials
from gsfluent.data import SPRAY, Gaussians
from gsfluent.pipeline.cracks.gaps import Births
from gsfluent.pipeline.matter.pieces import dust_limit
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.partition.chips import hashed, hashes
from gsfluent.results.frames import DUST
from gsfluent.scene.scene import Scene

BETA = 3.5
"""Grains are as frequent as their size to the power of minus this, in solids."""
FINEST, COARSEST = 1.0 / 8.0, 1.0 / 2.0
"""Smallest and largest grain, in edges of a point."""
SPLASH = 1.0
"""Largest drop, in edges of a point: one size would look like beads."""
DROP, GRAIN = 1.5e-3, 1.5e-3
"""Smallest drop and grain of powder [m], whatever the grid: juice does not become mist. Where that
is more than a point, only some of the points have one."""
SHARE = 1.0 / 40.0
"""Smallest grain, at most, as a share of the edge of a cube of the body's volume."""
MOST = 400_000
"""Grains of a body, about; where its dust would have more, the smallest ones are larger."""
SCATTER = 0.2
"""How far grains scatter about their point, as a share of the way that it has gone from its chunk:
so large are the differences of their speeds over its relative speed."""
LAG = 0.4
"""How far the smallest grains stay behind, as such a share: air holds them most."""
BEGINS, FULL = 0.5, 1.5
"""Way from its chunk [edges of a point] at which a point begins to be drawn as dust, and is all."""
SIGMA = 0.5
"""Standard deviation of the splat of a grain, in its radii."""
OPACITY = 0.97
WET = (1.8, 1.0, 1.0)
POWDER = (1.0, 0.8, 0.45)
"""Proportions of drops, which are drawn out along their way, and of grains of powder, at most."""
SPREAD = 3.0
"""How many times wider a drop is that has landed; milk and water spread 2 to 4 times on impact
(Pasandideh-Fard et al. 1996)."""
THIN, DEEP = 0.62, 0.75
"""Opacity and colour of a drop that has landed, over those in flight: so thin a film of juice lets
the floor through, and a wet floor is darker."""
LANDED, FALLING = 1.2, 2.4
"""Height of a point above the floor [its edges] at which its grains lie on it, and from which they
know nothing of it: the grid feels the floor from a cell and a half away."""
JUICE = 0.85
"""Share of the mean colour of the flesh in that of a drop: juice is mixed, wherever it is from."""
STILL = 1e-3
"""A point that has gone less than this since the last frame [edges] lies still."""
_ASKED = 4096  # points of a body that are asked for its mean colour, about
_ROOM = 1 << 10  # numbers of grains for each point


class Dust:
    """The dust of one run.

    Args:
        scene: The scene.
        matter: Its points.
    """

    def __init__(self, scene: Scene, matter: Matter) -> None:
        self._scene, self._matter = scene, matter
        self.edge = matter.particles.volume.clamp(min=0.0).pow(1.0 / 3.0)
        self.rows = torch.zeros(0, dtype=torch.int64, device=self.edge.device)
        self._grains: list[Grains] = []
        self._mean: dict[int, Tensor] = {}
        # of every point: the way that it has gone from its chunk, and where it was
        self._way = self.edge.new_zeros((len(self.edge), 3))
        self._last = self.edge.new_full((len(self.edge), 3), torch.nan)

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state`, when all that is dust has been added again."""
        rows = state["rows"].to(self.edge.device)
        self._way[rows] = state["way"].to(self._way)
        self._last[rows] = state["last"].to(self._last)

    def state(self) -> dict[str, Any]:
        """What a later run needs to go on from here."""
        rows = self.rows
        return {"rows": rows.cpu(), "way": self._way[rows].cpu(), "last": self._last[rows].cpu()}

    def add(self, rows: Tensor, color: Callable[[Tensor], Tensor]) -> None:
        """Some points have become dust.

        Args:
            rows: Which, int64 [K]; not again.
            color: Colours [G, 3] of places at rest [m], [G, 3].
        """
        self.rows = torch.cat([self.rows, rows])
        body = self._matter.particles.body[rows].long()
        for number in torch.unique(body).tolist():
            mine = rows[body == number]
            wet = materials.wet(self._scene.bodies[number].material.name)
            made = grains(mine, self.edge[mine], self._finest[number], wet)
            shade = functools.partial(self._juice, number, color) if wet else color
            self._grains.append(made.at(self._matter.rest[made.row], shade))

    def _juice(self, number: int, color: Callable[[Tensor], Tensor], places: Tensor) -> Tensor:
        """Colours [G, 3] of drops of a body that come from places at rest [m], [G, 3]."""
        if number not in self._mean:
            self._mean[number] = self._flesh(number, color).to(places)
        return torch.lerp(color(places), self._mean[number], JUICE)

    def _flesh(self, number: int, color: Callable[[Tensor], Tensor]) -> Tensor:
        """Mean colour [3] of the deeper half of a body: a rind gives no juice."""
        solid = self._scene.bodies[number].solid
        if solid is None or solid.color is None:
            a, b = self._matter.ranges[number]
            step = max(1, (b - a) // _ASKED)
            return color(self._matter.rest[a:b:step]).mean(dim=0)
        below = solid.depth[solid.occupancy]
        return solid.color[solid.occupancy][below >= below.median()].mean(dim=0)

    @functools.cached_property
    def _finest(self) -> list[float]:
        """Smallest grain of every body, in edges of a point."""
        bodies = self._scene.bodies
        body = self._matter.particles.body.long()
        points = torch.bincount(body, minlength=len(bodies)).cpu()
        share = torch.tensor([b.material.dust for b in bodies], dtype=torch.float64)
        expected = dust_limit(share, points) * points
        found: list[float] = []
        for its, many, own in zip(bodies, expected.tolist(), points.tolist(), strict=True):
            wet = materials.wet(its.material.name)
            wanted = (DROP if wet else GRAIN) / self._matter.spacing[len(found)]
            found.append(max(finest(many, wet), min(wanted, SHARE * own ** (1.0 / 3.0))))
        return found

    def step(self, position: Tensor, led: Tensor) -> None:
        """Go on to the next frame.

        Args:
            position: Where the material points are [m], [N, 3].
            led: Where their chunks would have led them [m], [N, 3].
        """
        rows = self.rows
        if rows.numel() == 0:
            return
        here, edge = position[rows].float(), self.edge[rows]
        gone, way = here - led[rows].float(), self._way[rows]
        # what lies still scatters no more, wherever its chunk goes
        moved = (here - self._last[rows]).norm(dim=1) > STILL * edge
        moved |= self._last[rows].isnan().any(dim=1)
        farther = moved & (gone.norm(dim=1) > way.norm(dim=1))
        self._way = self._way.index_copy(0, rows, torch.where(farther[:, None], gone, way))
        self._last = self._last.index_copy(0, rows, here)

    def share(self, rows: Tensor) -> Tensor:
        """How far points are drawn as dust and not with their chunk, 0 to 1."""
        way = self._way[rows].norm(dim=1) / self.edge[rows].clamp(min=1e-12)
        return ((way - BEGINS) / (FULL - BEGINS)).clamp(0.0, 1.0)

    def thrown(self) -> Tensor:
        """Points that are drawn as dust rather than with their chunk, int64 [D]."""
        return self.rows[self.share(self.rows) > 0.5]

    def born(self, position: Tensor) -> Births | None:
        """The grains at a moment; None where there are none.

        Args:
            position: Where the material points are [m], [N, 3].
        """
        if not self._grains:
            return None
        if len(self._grains) > 1:  # a hard landing sheds dust hundreds of times
            self._grains = [Grains.joined(self._grains)]
        made = self._grains[0].drawn(position, self.edge, self._way, self.share, self._scene.floor)
        return made if made.ids.numel() else None


class Grains:
    """Grains of some points of one body.

    Args:
        row: Point of each, int64 [G].
        number: Which of its point's grains, int64 [G].
        offset: Place in the cell of the point [m], [G, 3].
        toward: Where it scatters to, of a length up to 1, [G, 3].
        lag: How far it stays behind, 0 to 1, [G].
        wet: Whether it is a drop, bool [G].
        quats: Orientations, [G, 4].
        scales: Standard deviations [m], [G, 3].
        color: RGB in 0..1, [G, 3].
    """

    def __init__(
        self, row: Tensor, number: Tensor, offset: Tensor, toward: Tensor, lag: Tensor,
        wet: Tensor, quats: Tensor, scales: Tensor, color: Tensor | None = None,
    ) -> None:  # fmt: skip
        self.row, self.number, self.offset, self.toward = row, number, offset, toward
        self.lag, self.wet, self.quats, self.scales, self.color = lag, wet, quats, scales, color

    @property
    def volume(self) -> Tensor:
        """Volume of each [m^3], float64 [G]: of the ellipsoid of :data:`SIGMA`."""
        return 4.0 / 3.0 * math.pi * (self.scales.double() / SIGMA).prod(dim=1)

    @staticmethod
    def joined(parts: list[Grains]) -> Grains:
        """All of some, which have colours."""
        return Grains(
            **{name: torch.cat([vars(p)[name] for p in parts]) for name in vars(parts[0])}
        )

    def at(self, rest: Tensor, color: Callable[[Tensor], Tensor]) -> Grains:
        """With the colours of their places; ``rest``: of their points [m], [G, 3]."""
        self.color = color(rest + self.offset.to(rest))
        return self

    def drawn(
        self,
        position: Tensor,
        edge: Tensor,
        way: Tensor,
        share: Callable[[Tensor], Tensor],
        floor: float | None,
    ) -> Births:
        """Those of points that have left, as splats."""
        assert self.color is not None  # at
        opacity = OPACITY * share(self.row)
        some = (opacity > 0.0).nonzero()[:, 0]
        row = self.row[some]
        here, gone = position[row].float(), way[row]
        reach = SCATTER * gone.norm(dim=1)
        off = self.offset[some] + reach[:, None] * self.toward[some]
        off = off - LAG * self.lag[some, None] * gone
        quats, scales, color = self.quats[some], self.scales[some], self.color[some]
        opacity = opacity[some]
        if floor is not None:
            # what lies on the floor is no heap
            height = (here[:, 2] - floor).clamp(min=0.0)
            most = off[:, 2].abs().clamp(min=1e-9)
            off[:, 2] *= torch.minimum(height / torch.maximum(most, reach), torch.ones_like(most))
            lies = (FALLING - height / edge[row].clamp(min=1e-12)) / (FALLING - LANDED)
            lies = lies.clamp(0.0, 1.0)
            wet = (self.wet[some] & (lies > 0.0)).nonzero()[:, 0]
            quats[wet], scales[wet] = _spread(quats[wet], scales[wet], lies[wet])
            opacity[wet] *= 1.0 - (1.0 - THIN) * lies[wet]
            color[wet] *= 1.0 - (1.0 - DEEP) * lies[wet, None]
            down = floor + _half_height(quats, scales) - (here + off)[:, 2]
            off[:, 2] += lies * down
        gaussians = Gaussians(
            means=here + off,
            quats=quats,
            scales=scales,
            opacities=opacity,
            sh=geometry.rgb_to_sh0(color)[:, None],
            labels=torch.full_like(row, SPRAY, dtype=torch.int32),
            normals=geometry.quaternion_to_matrix(quats)[..., 2],
        )
        return Births(gaussians, DUST + row * _ROOM + self.number[some], row)


def _spread(quats: Tensor, scales: Tensor, lies: Tensor) -> tuple[Tensor, Tensor]:
    """Drops that have landed by a share ``lies`` [G], 0 to 1: flatter and wider, as much of each.

    Args:
        quats: Orientations in flight, [G, 4].
        scales: Standard deviations in flight [m], [G, 3].
        lies: The share.
    """
    mean = scales.prod(dim=1, keepdim=True).pow(1.0 / 3.0)
    long = (scales[:, :1] / mean).pow(0.5)  # what was drawn out lies as an oval
    flat = mean * torch.cat(
        [SPREAD * long, SPREAD / long, long.new_full(long.shape, SPREAD**-2)], 1
    )
    first = geometry.quaternion_to_matrix(quats)[..., 0]
    turn = 0.5 * torch.atan2(first[:, 1], first[:, 0])
    none = torch.zeros_like(turn)
    level = torch.stack([turn.cos(), none, none, turn.sin()], dim=1)
    level = level * torch.where((level * quats).sum(dim=1) < 0.0, -1.0, 1.0)[:, None]
    turned = torch.nn.functional.normalize(torch.lerp(quats, level, lies[:, None]), dim=1)
    return turned, torch.exp(torch.lerp(scales.log(), flat.log(), lies[:, None]))


def _half_height(quats: Tensor, scales: Tensor) -> Tensor:
    """Half of the vertical extent of grains [m], [G]."""
    return (geometry.quaternion_to_matrix(quats)[:, 2] * scales / SIGMA).norm(dim=1)


def grains(rows: Tensor, edge: Tensor, least: float, wet: bool) -> Grains:
    """Grains of points: sizes by the law, volumes that sum to each point's.

    Where a grain is larger than a point, as many points have one as makes the volumes right on
    average.

    Args:
        rows: The points, int64 [K].
        edge: Edges of the cubes of their volumes [m], [K].
        least: Smallest grain, in edges.
        wet: Drops, or else powder.
    """
    many = per_point(least, wet)
    if many < 1.0:
        has = 0.5 + 0.5 * hashed((rows * 0x9E3779B1) & 0xFFFFFFFF, 13) < many
        rows, edge = rows[has], edge[has]
    count = max(1, round(many))
    number = torch.arange(count, device=rows.device)
    seed = ((rows[:, None] * 0x9E3779B1) & 0xFFFFFFFF) ^ ((number * 0x85EBCA6B) & 0xFFFFFFFF)
    # one size in each of as many strata, so that every point has some of all
    drawn = 0.5 + 0.5 * hashed(seed, 0)
    size = quantile((number + drawn) / count, least, wet)
    if many >= 1.0:
        size = size * (size.pow(3).sum(dim=1, keepdim=True) * (math.pi / 6.0)).pow(-1.0 / 3.0)
    size = size.reshape(-1)
    seed, row = seed.reshape(-1), rows.repeat_interleave(count)
    height, angle = hashed(seed, 1), math.pi * hashed(seed, 2)
    ring = (1.0 - height * height).sqrt()
    toward = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)
    out = (0.5 + 0.5 * hashed(seed, 3))[:, None] * toward
    lag = (0.5 + 0.5 * hashed(seed, 12)) * (1.0 - (size / _largest(least, wet)).clamp(max=1.0))
    offset = 0.5 * hashes(seed, range(4, 7)) * edge.double().repeat_interleave(count)[:, None]
    draw = (0.5 + 0.5 * hashed(seed, 7))[:, None]
    shape = 1.0 + draw * (draw.new_tensor(WET if wet else POWDER) - 1.0)
    shape = shape / shape.prod(dim=1, keepdim=True).pow(1.0 / 3.0)
    if wet:
        quats = _along(toward)
    else:
        quats = torch.nn.functional.normalize(hashes(seed, range(8, 12)) + 1e-6, dim=1)
    size = size * edge.double().repeat_interleave(count)
    scales = (SIGMA * 0.5) * size[:, None] * shape
    offset, out, lag, quats, scales = (
        value.to(torch.float32) for value in (offset, out, lag, quats, scales)
    )
    number = number.repeat(len(rows))
    drops = torch.full_like(row, wet, dtype=torch.bool)
    return Grains(row, number, offset, out, lag, drops, quats, scales)


def _along(toward: Tensor) -> Tensor:
    """Quaternions [G, 4] that turn the first axis to unit vectors [G, 3]."""
    x, y, z = toward.unbind(dim=1)
    half = torch.stack([1.0 + x, torch.zeros_like(x), -z, y], dim=1)
    flat = half.new_tensor([0.0, 0.0, 0.0, 1.0])
    half = torch.where((x < -1.0 + 1e-9)[:, None], flat, half)
    return torch.nn.functional.normalize(half, dim=1)


def quantile(share: Tensor, least: float, wet: bool) -> Tensor:
    """Size below which a share of the grains lies, in edges, by ``n(d) ~ d^-3.5``."""
    low, high = least ** (1.0 - BETA), _largest(least, wet) ** (1.0 - BETA)
    return (low + share * (high - low)).pow(1.0 / (1.0 - BETA))


def _largest(least: float, wet: bool) -> float:
    """Largest grain: few grains that have a point's volume are larger."""
    return max(SPLASH if wet else COARSEST, 1.6 * least)


def per_point(least: float, wet: bool) -> float:
    """Grains of the law that have the volume of a point: as balls, on average."""
    low, high = least, _largest(least, wet)
    cubes = (high ** (4.0 - BETA) - low ** (4.0 - BETA)) / (4.0 - BETA)
    many = (low ** (1.0 - BETA) - high ** (1.0 - BETA)) / (BETA - 1.0)
    return min(float(_ROOM), 6.0 / math.pi * many / cubes)


def finest(points: float, wet: bool) -> float:
    """Smallest grain [edges] with which so many points of dust stay within :data:`MOST`."""
    steps = [FINEST * 4.0 ** (k / 32.0) for k in range(33)]
    return next((size for size in steps if points * per_point(size, wet) <= MOST), steps[-1])
