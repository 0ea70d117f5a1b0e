"""Dust: material points that hang on nothing, each drawn as a cloud of fine grains.

A point of dust is as large as the grid is fine, which no grain of the real thing is. So it is drawn
as chips with flat sides, as frequent as their size to the power -3.5 (Villermaux 2025), in the
colours of the places that they come from, and as a puff of mist for what is too fine to be seen one
by one: as opaque as its drops are, seen beside each other. They leave with it, and tumble: a point
that has gone a way relative to the chunk that it came from has scattered its grains by a fifth of
that, and its mist has grown. What is left behind is a pit in the chunk
(:mod:`gsfluent.pipeline.cracks.chunks`).

All that is random about a grain is hashed from the row of its point and its number, so it is the
same in every frame, on every device and after a resume. A run without dust has no grains.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsfluent import geometry, materials, ops
from gsfluent.data import SPRAY, Gaussians
from gsfluent.pipeline.cracks.gaps import Births
from gsfluent.pipeline.matter.pieces import dust_limit
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.partition.chips import hashed
from gsfluent.results.frames import DUST
from gsfluent.scene.scene import Scene

BETA = 3.5
"""Grains are as frequent as their size to the power of minus this, in solids."""
GRAIN = 1.4e-3
"""Smallest chip [m], whatever the grid; what is finer is mist. Where that is more than a point,
only some of the points have one."""
SHARE, LARGEST = 1.0 / 45.0, 1.0 / 8.0
"""Smallest chip, at most, and largest, as shares of the edge of a cube of the body's volume."""
MIST = (0.1, 0.06)
"""Share of dust that is mist: of powder, of juice; a quarter of a melon's hid all of it."""
FINE = 5e-4
"""Mean size of the drops of mist [m] (Sauter): its volume over that is what it hides."""
PUFF, GROWTH, WIDEST = 0.6, 0.12, 5.0
"""Standard deviation of a puff when it leaves [edges], by how much of its way it grows, and how
large it gets at most [edges]: then it is thinner than the eye can tell."""
THINNEST = 0.02
"""Opacity that a puff has less than its drops hide: a picture leaves out what is thinner than
1 / 255, and hundreds of wide puffs that end there one behind the other would show an edge."""
PALE = 0.35
"""How far mist is paler than what it is of: it scatters light many times."""
MOST = 40_000
"""Chips of a body, about; where its dust would have more, the smallest ones are larger."""
SCATTER = 0.2
"""How far grains scatter about their point, as a share of the way that it has gone from its chunk:
so large are the differences of their speeds over its relative speed."""
LAG = 0.4
"""How far the smallest grains stay behind, as such a share: air holds them most."""
BEGINS, FULL = 0.5, 1.5
"""Way from its chunk [edges of a point] at which a point begins to be drawn as dust, and is all."""
OPACITY = 0.97
SPLATS, FEWEST, MANY = 140.0, 12, 160
"""Splats of the largest chip, which go as the power 1.5 of the size; fewest and most: as a picture
of the body sees chips. Six, a side each, were scraps of paper, with soft edges and no body."""
SPREAD, THIN = 0.47, 0.22
"""Standard deviations of such a splat: along its side over the edge of its share of it, and across
it over the shorter of these."""
FLAT = ((0.6, 1.0), (0.45, 0.8))
"""Second and third edge of a chip over its first, from and to."""
TILT, UNEVEN = 0.35, 0.25
"""By how much the normals of its sides are tilted, as the tangent along each axis, and by how much
of their distance sides are moved in or out, at most."""
ROUGH, RUGGED = 0.1, 0.45
"""By how much of it a splat is moved in or out, and its normal tilted, at most: sides are torn."""
TUMBLE = 0.5
"""Turn of a chip [rad] on a way as long as it is large, at most."""
DEEP = 0.75
"""Colour of a drop that has landed over that in flight: a wet floor is darker."""
FILM = 0.15
"""Standard deviation of mist that has landed, across the floor [edges]."""
LANDED, FALLING = 1.2, 2.4
"""Height of a point above the floor [its edges] at which its grains lie on it, and from which they
know nothing of it: the grid feels the floor from a cell and a half away."""
JUICE = 0.85
"""Share of the mean colour of the flesh in that of a drop: juice is mixed, wherever it is from."""
DARKEST = 0.5
"""Lightness of the darkest chips of what is dry, over that of its inside."""
STILL = 1e-3
"""A point that has gone less than this since the last frame [edges] lies still."""
_ASKED = 4096  # points of a body that are asked for its mean colour, about
_CORNER = 3.0**-0.5
_PLANES = (
    (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0),
    (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0),
    (_CORNER, _CORNER, _CORNER), (_CORNER, -_CORNER, -_CORNER),
    (-_CORNER, _CORNER, -_CORNER), (-_CORNER, -_CORNER, _CORNER),
)  # fmt: skip
_FINE = 2.0**40  # of a sum in whole numbers
_ROOM = 1 << 14  # numbers of grains for each point
_AT_ONCE = (_ROOM - 1) // MANY  # chips of a point, at most


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

    def twin(self) -> Dust:
        """The same, to go on from here in another way."""
        other = copy.copy(self)
        other._grains = list(self._grains)
        return other

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
            least, most = self._sizes[number]
            chips, mist = grains(mine, self.edge[mine], least, most, wet)
            paint = color if wet else functools.partial(self._dry, number, color)
            self._grains.append(chips.at(self._matter.rest[chips.row], paint))
            shade = functools.partial(self._pale, number, wet, color)
            self._grains.append(mist.at(self._matter.rest[mist.row], shade))

    def _pale(
        self, number: int, wet: bool, color: Callable[[Tensor], Tensor], places: Tensor
    ) -> Tensor:
        """Colours [G, 3] of mist of a body."""
        own = self._juice(number, color, places) if wet else color(places)
        return torch.lerp(own, torch.ones_like(own), PALE)

    def _dry(self, number: int, color: Callable[[Tensor], Tensor], places: Tensor) -> Tensor:
        """Colours [G, 3] of chips of what is dry, none of which is much darker than its inside.

        The darkest skin of a capture lay in a hollow that no light reached: in the open its chips
        would be black specks.
        """
        own, inside = color(places), self._inside(number, color, places)
        least, light = DARKEST * inside.mean(), own.mean(dim=1, keepdim=True)
        share = (least - light) / (inside.mean() - light).clamp(min=1e-6)
        return torch.lerp(own, inside.expand_as(own), share.clamp(0.0, 1.0))

    def _inside(self, number: int, color: Callable[[Tensor], Tensor], like: Tensor) -> Tensor:
        """Mean colour [3] of the deeper half of a body, kept."""
        if number not in self._mean:
            self._mean[number] = self._flesh(number, color).to(like)
        return self._mean[number]

    def _juice(self, number: int, color: Callable[[Tensor], Tensor], places: Tensor) -> Tensor:
        """Colours [G, 3] of drops of a body that come from places at rest [m], [G, 3]."""
        return torch.lerp(color(places), self._inside(number, color, places), JUICE)

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
    def _sizes(self) -> list[tuple[float, float]]:
        """Smallest and largest chip of every body, in edges of a point."""
        bodies = self._scene.bodies
        body = self._matter.particles.body.long()
        points = torch.bincount(body, minlength=len(bodies)).cpu()
        share = torch.tensor([b.material.dust for b in bodies], dtype=torch.float64)
        expected = dust_limit(share, points) * points
        return [
            sizes(GRAIN / spacing, own, many)
            for spacing, own, many in zip(
                self._matter.spacing, points.tolist(), expected.tolist(), strict=True
            )
        ]

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
    """Splats of the grains of some points of one body: of the sides of chips, or puffs of mist.

    Args:
        row: Point of each, int64 [G].
        number: Which of its point's, int64 [G].
        amount: Volume that it stands for [m^3], float64 [G].
        offset: Place of its grain in the cell of the point [m], [G, 3].
        toward: Where that scatters to, of a length up to 1, [G, 3].
        lag: How far it stays behind, 0 to 1, [G].
        wet: Whether it darkens what it lands on, bool [G].
        arm: Place of a splat from the middle of its chip [m], [G, 3].
        frame: Orientation of the chip, [G, 4].
        half: How far that reaches along its own axes [m], [G, 3]; 0 for mist.
        spin: Axis that it turns about times the turn on its way [rad/m], [G, 3].
        quats: Orientations, [G, 4].
        scales: Standard deviations [m], [G, 3].
        color: RGB in 0..1, [G, 3].
    """

    def __init__(
        self, row: Tensor, number: Tensor, amount: Tensor, offset: Tensor, toward: Tensor,
        lag: Tensor, wet: Tensor, arm: Tensor, frame: Tensor, half: Tensor, spin: Tensor,
        quats: Tensor, scales: Tensor, color: Tensor | None = None,
    ) -> None:  # fmt: skip
        self.row, self.number, self.amount, self.offset = row, number, amount, offset
        self.toward, self.lag, self.wet, self.arm, self.frame = toward, lag, wet, arm, frame
        self.half, self.spin, self.quats, self.scales, self.color = half, spin, quats, scales, color

    @staticmethod
    def joined(parts: list[Grains]) -> Grains:
        """All of some, which have colours."""
        return Grains(
            **{name: torch.cat([vars(p)[name] for p in parts]) for name in vars(parts[0])}
        )

    def at(self, rest: Tensor, color: Callable[[Tensor], Tensor]) -> Grains:
        """With the colours of their places; ``rest``: of their points [m], [G, 3].

        A side has that of where it was: what lay at the skin wears it on one side.
        """
        self.color = color(rest + (self.offset + self.arm).to(rest))
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
        left = share(self.row)
        some = (left > 0.0).nonzero()[:, 0]
        row, left = self.row[some], left[some]
        here, gone, size = position[row].float(), way[row], edge[row]
        far = gone.norm(dim=1)
        reach = SCATTER * far
        off = self.offset[some] + reach[:, None] * self.toward[some]
        off = off - LAG * self.lag[some, None] * gone
        turn = _turned(self.spin[some] * far[:, None])
        frame, quats = (
            geometry.quaternion_multiply(turn, q[some]) for q in (self.frame, self.quats)
        )
        color, scales, half = self.color[some], self.scales[some], self.half[some]
        puff = half[:, 0] == 0.0
        wide = torch.minimum(scales[:, 0] + GROWTH * far, WIDEST * size)
        scales = torch.where(puff[:, None], wide[:, None] * scales.new_tensor(_PUFF), scales)
        # as many drops as are beside each other in the middle of the puff hide what is behind it
        hidden = 1.5 * self.amount[some] / FINE / (2.0 * math.pi * wide.double().square())
        thin = (1.0 - torch.exp(-hidden) - THINNEST).clamp(0.0, OPACITY)
        opacity = torch.where(puff, thin, OPACITY)
        opacity = opacity.float() * left
        if floor is not None:
            # what lies on the floor is no heap
            height = (here[:, 2] - floor).clamp(min=0.0)
            most = off[:, 2].abs().clamp(min=1e-9)
            off[:, 2] *= torch.minimum(height / torch.maximum(most, reach), torch.ones_like(most))
            lies = (FALLING - height / size.clamp(min=1e-12)) / (FALLING - LANDED)
            lies = lies.clamp(0.0, 1.0)
            film = torch.lerp(scales[:, 2], torch.minimum(FILM * size, scales[:, 2]), lies)
            scales[:, 2] = torch.where(puff, film, scales[:, 2])
            color = color * (1.0 - (1.0 - DEEP) * lies * self.wet[some])[:, None]
            # and on its broad side
            level = _turned(lies[:, None] * _toppled(frame, half))
            turn, frame, quats = (
                geometry.quaternion_multiply(level, q) for q in (turn, frame, quats)
            )
            up = (geometry.quaternion_to_matrix(frame)[:, 2] * half).norm(dim=1)
            down = floor + torch.where(puff, 2.0 * scales[:, 2], up) - (here + off)[:, 2]
            off[:, 2] += lies * down
        arm = geometry.quaternion_to_matrix(turn) @ self.arm[some][..., None]
        gaussians = Gaussians(
            means=here + off + arm[..., 0],
            quats=quats,
            scales=scales,
            opacities=opacity,
            sh=geometry.rgb_to_sh0(color)[:, None],
            labels=torch.full_like(row, SPRAY, dtype=torch.int32),
            normals=geometry.quaternion_to_matrix(quats)[..., 2],
        )
        return Births(gaussians, DUST + row * _ROOM + self.number[some], row)


_PUFF = (1.0, 1.0, 0.95)  # a little flat, so that its light is that of a level thing


def _turned(vector: Tensor) -> Tensor:
    """Quaternions [G, 4] of rotation vectors [rad], [G, 3]."""
    angle = vector.norm(dim=1, keepdim=True)
    axis = vector / angle.clamp(min=1e-12)
    return torch.cat([(0.5 * angle).cos(), (0.5 * angle).sin() * axis], dim=1)


def _toppled(frame: Tensor, half: Tensor) -> Tensor:
    """Rotation vectors [rad], [G, 3], that turn the shortest axes of chips upright; 0 for mist."""
    short = half.argmin(dim=1)[:, None, None].expand(-1, 3, 1)
    axis = geometry.quaternion_to_matrix(frame).gather(2, short)[..., 0]
    axis = axis * torch.where(axis[:, 2:] < 0.0, -1.0, 1.0)
    across = torch.stack([axis[:, 1], -axis[:, 0], torch.zeros_like(axis[:, 0])], dim=1)
    length = across.norm(dim=1, keepdim=True)
    turn = across * (torch.atan2(length, axis[:, 2:]) / length.clamp(min=1e-9))
    return torch.where(half[:, :1] > 0.0, turn, torch.zeros_like(turn))


def grains(
    rows: Tensor, edge: Tensor, least: float, most: float, wet: bool
) -> tuple[Grains, Grains]:
    """Chips and mist of points: sizes by the law, volumes that are right on average.

    Args:
        rows: The points, int64 [K].
        edge: Edges of the cubes of their volumes [m], [K].
        least: Smallest chip, in edges.
        most: Largest chip, in edges.
        wet: Juice, or else powder.

    Returns:
        The sides of the chips, and a puff of mist for every point.
    """
    share = MIST[wet]
    many = (1.0 - share) * per_point(least, most)
    own = (rows * 0x9E3779B1) & 0xFFFFFFFF
    count = (many + 0.5 + 0.5 * hashed(own, 13)).floor().long()
    row, size = rows.repeat_interleave(count), edge.double().repeat_interleave(count)
    first = count.cumsum(0) - count
    number = torch.arange(len(row), device=rows.device) - first.repeat_interleave(count)
    seed = own.repeat_interleave(count) ^ ((number * 0x85EBCA6B) & 0xFFFFFFFF)
    # one size in each of as many strata, so that every point has some of all
    drawn = (number + 0.5 + 0.5 * hashed(seed, 0)) / count.repeat_interleave(count)
    size = size * quantile(drawn, least, most)
    chips = _chips(row, seed, size, edge.double().repeat_interleave(count), most)
    toward, offset = _thrown(own, edge.double())
    none, still = torch.zeros_like(offset), offset.new_tensor([1.0, 0.0, 0.0, 0.0])
    still = still.expand(len(rows), 4)
    mist = [
        share * edge.double().pow(3), offset, 0.5 * toward, torch.ones_like(edge).double(),
        torch.full_like(rows, wet, dtype=torch.bool), none, still, none, none, still,
        (PUFF * edge.double())[:, None] * offset.new_tensor(_PUFF),
    ]  # fmt: skip
    last = torch.full_like(rows, _ROOM - 1)
    return Grains(*chips), Grains(rows, last, mist[0], *(_single(value) for value in mist[1:]))


def _single(value: Tensor) -> Tensor:
    return value.float() if value.is_floating_point() else value


def _thrown(seed: Tensor, edge: Tensor) -> tuple[Tensor, Tensor]:
    """Where grains scatter to, and where they were in the cell of their point [m], [G, 3] each."""
    height, angle = hashed(seed, 1), math.pi * hashed(seed, 2)
    ring = (1.0 - height * height).sqrt()
    toward = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)
    out = (0.5 + 0.5 * hashed(seed, 3))[:, None] * toward
    return out, 0.5 * ops.hashes(seed, range(4, 7)) * edge[:, None]


def _chips(row: Tensor, seed: Tensor, size: Tensor, edge: Tensor, most: float) -> list[Tensor]:
    """Surfaces of chips of some sizes [m], float64 [C], as :class:`Grains` takes them.

    A chip is what lies between planes: the sides of a box and its corners, some of them cut off,
    all tilted and shifted; and its sides are rough. Its splats look all ways evenly, and each lies
    in the plane that is met first that way. All of it is stretched to three unlike edges.
    """
    toward, offset = _thrown(seed, edge)
    draw = 0.5 + 0.5 * ops.hashes(seed, range(7, 9))
    low, high = draw.new_tensor(FLAT).unbind(dim=1)
    half = torch.cat([torch.ones_like(draw[:, :1]), low + draw * (high - low)], dim=1)
    half = half * geometry.product(half)[:, None].pow(-1.0 / 3.0)
    frame = torch.nn.functional.normalize(ops.hashes(seed, range(9, 13)) + 1e-6, dim=1)
    lag = (0.5 + 0.5 * hashed(seed, 14)) * (1.0 - (size / (2.0 * edge)).clamp(max=1.0))
    spin = TUMBLE * ops.hashes(seed, range(15, 18)) / size[:, None]
    planes = torch.tensor(_PLANES, dtype=torch.float64, device=row.device)
    tilt = ops.hashes(seed, range(20, 20 + planes.numel())).view(-1, *planes.shape)
    normal = planes + TILT * tilt
    normal = torch.nn.functional.normalize(normal, dim=2)
    reach = 1.0 + UNEVEN * ops.hashes(seed, range(64, 64 + len(planes)))
    count = splats_of(size / (most * edge))
    chip = torch.arange(len(row), device=row.device).repeat_interleave(count)
    which = torch.arange(len(chip), device=row.device)
    which = which - (count.cumsum(0) - count)[chip]
    way = _spiral(which, count[chip])
    met = torch.full_like(way[:, 0], math.inf)
    flat = way.clone()
    for plane in range(len(planes)):  # one after the other: a chip has ten, and many splats
        along = (way * normal[chip, plane]).sum(dim=1)
        far = torch.where(along > 1e-3, reach[chip, plane] / along.clamp(min=1e-3), math.inf)
        flat = torch.where((far < met)[:, None], normal[chip, plane], flat)
        met = torch.minimum(met, far)
    own = (seed[chip] ^ ((which * 0xC2B2AE35) & 0xFFFFFFFF)) & 0xFFFFFFFF
    met = met * (1.0 + ROUGH * hashed(own, 80))
    flat = torch.nn.functional.normalize(flat + RUGGED * ops.hashes(own, range(81, 84)), dim=1)
    # between splats that look all ways evenly there is the same volume
    cubes = (met.pow(3) * _FINE).round().long()  # whole numbers, whose sum has no order
    cubes = torch.zeros_like(row).index_add_(0, chip, cubes).double() / (_FINE * count)
    size_of = 0.5 * size / cubes.pow(1.0 / 3.0)
    half = half * size_of[:, None]
    stretch = half[chip]
    arm = stretch * way * met[:, None]
    # a disc in the plane becomes an ellipse in the stretched one
    first, second = (stretch * axis for axis in _across(flat))
    turn = torch.atan2(
        2.0 * (first * second).sum(dim=1), first.square().sum(dim=1) - second.square().sum(dim=1)
    )
    c, s = (0.5 * turn).cos()[:, None], (0.5 * turn).sin()[:, None]
    first, second = c * first + s * second, c * second - s * first
    long, wide = first.norm(dim=1), second.norm(dim=1)
    axes = torch.stack([first / long[:, None], second / wide[:, None]], dim=2)
    third = torch.linalg.cross(axes[..., 0], axes[..., 1])
    third = third * torch.where((third * arm).sum(dim=1) < 0.0, -1.0, 1.0)[:, None]
    axes = torch.stack([torch.linalg.cross(axes[..., 1], third), axes[..., 1], third], dim=2)
    spread = SPREAD * met * (4.0 * math.pi / count[chip]).sqrt()
    long, wide = spread * long, spread * wide
    scales = torch.stack([long, wide, THIN * torch.minimum(long, wide)], dim=1)
    turned = geometry.quaternion_to_matrix(frame)[chip]
    # how far a chip reaches along its own axes, by which it lies on the floor
    reaches = half.new_zeros(half.shape).scatter_reduce_(
        0, chip[:, None].expand(-1, 3), arm.abs(), "amax"
    )
    # grains of a point are numbered one after the other
    _, many = torch.unique_consecutive(row[chip], return_counts=True)
    numbers = torch.arange(len(chip), device=row.device)
    numbers = numbers - (many.cumsum(0) - many).repeat_interleave(many)
    made = [
        offset[chip], toward[chip], lag[chip], torch.zeros_like(chip, dtype=torch.bool),
        (turned @ arm[..., None])[..., 0], frame[chip], reaches[chip], spin[chip],
        geometry.quaternion_multiply(frame[chip], geometry.matrix_to_quaternion(axes)), scales,
    ]  # fmt: skip
    amount = (math.pi / 6.0 * size.pow(3) / count)[chip]
    return [row[chip], numbers, amount, *(_single(value) for value in made)]


def splats_of(size: Tensor) -> Tensor:
    """Splats of chips, int64 [C], by their sizes over that of the largest, [C]."""
    return (SPLATS * size.pow(1.5)).round().long().clamp(FEWEST, MANY)


def _spiral(which: Tensor, count: Tensor) -> Tensor:
    """Directions [M, 3] that lie evenly on a ball: number ``which`` of ``count`` on a spiral."""
    height = 1.0 - (2.0 * which.double() + 1.0) / count
    angle = which.double() * (math.pi * (3.0 - 5.0**0.5))
    ring = (1.0 - height * height).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)


def _across(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors along planes of normals [M, 3]."""
    other = torch.zeros_like(normal).scatter_(1, normal.abs().argmin(1, keepdim=True), 1.0)
    one = torch.nn.functional.normalize(torch.linalg.cross(normal, other), dim=1)
    return one, torch.linalg.cross(normal, one)


def quantile(share: Tensor, least: float, most: float) -> Tensor:
    """Size below which a share of the chips lies, by ``n(d) ~ d^-3.5``."""
    low, high = least ** (1.0 - BETA), most ** (1.0 - BETA)
    return (low + share * (high - low)).pow(1.0 / (1.0 - BETA))


def per_point(least: float, most: float) -> float:
    """Chips of the law that have the volume of a point: as balls, on average."""
    cubes = (most ** (4.0 - BETA) - least ** (4.0 - BETA)) / (4.0 - BETA)
    many = (least ** (1.0 - BETA) - most ** (1.0 - BETA)) / (BETA - 1.0)
    return 6.0 / math.pi * many / cubes


def sizes(smallest: float, points: int, dust: float) -> tuple[float, float]:
    """Smallest and largest chip of a body [edges].

    Args:
        smallest: :data:`GRAIN`, in edges.
        points: Points of the body.
        dust: How many of them may be dust.
    """
    whole = max(1, points) ** (1.0 / 3.0)
    most, least = max(1.0, LARGEST * whole), min(smallest, SHARE * whole)
    fits = min(float(_AT_ONCE - 1), MOST / max(dust, 1.0))
    while least < 0.5 * most and per_point(least, most) > fits:
        least *= 1.1
    return min(least, 0.5 * most), most
