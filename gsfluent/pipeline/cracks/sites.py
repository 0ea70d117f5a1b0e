"""Sites of crack faces: places inside the solids, at rest, where a face may open.

A site is a point of a lattice in the matter, as fine as the colour volume or the pieces that matter
can break into, whichever is finer. It knows its colour, the way to the skin, and the material
points around it. All of this is computed once, when something starts to break.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from gsfluent.data import Gaussians, Solid
from gsfluent.pipeline.matter.carry import nearest_points
from gsfluent.pipeline.matter.points import Matter, body_frame
from gsfluent.pipeline.solid.colors import surface_colors_at
from gsfluent.scene.scene import Scene
from gsfluent.spatial.neighbours import nearest_rows
from gsfluent.spatial.pieces import sample, signed_depth

PER_POINT = (2.0, 3.0)
"""Sites per spacing of the material points and axis, at least, so that debris of one point has a
shape, and at most; between them the voxels of the colours decide."""
MOST = 1_000_000
"""Largest number of sites of a scene; more would make a coarser lattice."""
SKIN = 1.75
"""Sites within this many pitches of the skin know the colour of the skin."""
_AT_ONCE = 1 << 20  # places that are looked at together


@dataclasses.dataclass(frozen=True, eq=False)
class Sites:
    """Where faces may open, in scene coordinates at rest.

    Args:
        means: Places [m], [S, 3].
        pitch: Distance between sites [m], [S].
        voxel: Voxel of the colour volume [m], [S].
        color: Colour of the matter, RGB in 0..1, [S, 3].
        outward: Unit vector to the nearest skin, [S, 3].
        depth: Distance to the skin [m], [S].
        skin: Colour of the skin where it is near, else that of the matter, [S, 3].
        owner: Nearest material point, int64 [S].
    """

    means: Tensor
    pitch: Tensor
    voxel: Tensor
    color: Tensor
    outward: Tensor
    depth: Tensor
    skin: Tensor
    owner: Tensor

    @property
    def count(self) -> int:
        """Number of sites S."""
        return int(self.means.shape[0])

    @staticmethod
    def of(scene: Scene, matter: Matter) -> Sites:
        """Place sites in the solids of a scene; liquids and grains, which have no faces, get none.

        Args:
            scene: The scene at time 0.
            matter: Its material points.
        """
        device = matter.particles.device
        volume = sum(body.volume for body in scene.bodies if body.solid is not None)
        finest = (volume / MOST) ** (1 / 3)
        columns: list[list[Tensor]] = [[] for _ in range(8)]
        for number, body in enumerate(scene.bodies):
            if body.solid is None:
                continue
            coarse, fine = (matter.spacing[number] / n for n in PER_POINT)
            pitch = max(min(max(body.frame.scale * body.solid.voxel, fine), coarse), finest)
            frame = body_frame(body, scene)
            made = _of_solid(body.solid.to(device), pitch / frame.scale)
            means, color, outward, depth, skin = made
            count = means.shape[0]
            voxel = frame.scale * body.solid.voxel
            rows = (
                frame.apply(means), torch.full((count,), pitch, device=device),
                torch.full((count,), voxel, device=device), color,
                frame.apply_vector(outward), depth * frame.scale, skin,
                torch.full((count,), number, dtype=torch.int64, device=device),
            )  # fmt: skip
            for column, row in zip(columns, rows, strict=True):
                column.append(row)
        if not columns[0]:
            return _none(device)
        means, pitches, voxels, color, outward, depth, skin, owner = (torch.cat(c) for c in columns)
        points = nearest_points(means, owner, matter)
        firm = ~matter.of_law("fluid", "drucker_prager")[points]
        every = (means, pitches, voxels, color, outward, depth, skin, points)
        return Sites(*(value[firm] for value in every))


def _none(device: torch.device) -> Sites:
    flat, tall = torch.zeros(0, device=device), torch.zeros(0, 3, device=device)
    return Sites(tall, flat, flat, tall, tall, flat, tall, flat.to(torch.int64))


def _of_solid(solid: Solid, pitch: float) -> tuple[Tensor, ...]:
    """Places, colours, ways to the skin, depths and skin colours, in the solid's coordinates."""
    field = signed_depth(solid.occupancy, solid.depth / solid.voxel)
    step = pitch / solid.voxel
    counts = [math.ceil(size / step) for size in field.shape]
    axes = [(torch.arange(n, device=field.device) + 0.5) * step for n in counts]
    kept = []
    # some slabs at a time: memory stays small for fine lattices
    for some in axes[0].split(max(1, _AT_ONCE // (counts[1] * counts[2]))):
        slabs = torch.cartesian_prod(some, axes[1], axes[2])
        kept.append(slabs[sample(field, slabs) > 0.0])
    place = torch.cat(kept)
    depth = sample(field, place)
    half = 0.5 * torch.eye(3, device=field.device)
    inward = [sample(field, place + e) - sample(field, place - e) for e in half]
    outward = -torch.nn.functional.normalize(torch.stack(inward, dim=1), dim=1)
    means = place * solid.voxel + solid.origin.to(place)
    color = matter_colors(solid, place, means)
    skin = color.clone()
    near = (depth * solid.voxel < SKIN * pitch).nonzero()[:, 0]
    shown = skin_colors_at(solid, means[near])
    if shown is not None:
        skin[near] = shown.to(skin)
    return means, color, outward, depth * solid.voxel, skin


def skin_colors_at(solid: Solid, means: Tensor) -> Tensor | None:
    """Colours of the skin near places [M, 3] in the solid's coordinates; None where it has none."""
    if means.shape[0] == 0 or not _has_skin(solid.gaussians):
        return None
    shown = surface_colors_at(solid.gaussians, means.double(), 0.5 * solid.voxel)
    return shown.to(torch.float32)


def _has_skin(gaussians: Gaussians) -> bool:
    from gsfluent.data import SURFACE

    return gaussians.labels is not None and bool((gaussians.labels == SURFACE).any())


def matter_colors(solid: Solid, place: Tensor, means: Tensor) -> Tensor:
    """Colour of the matter at places [voxels]: trilinear over the voxels that hold matter."""
    if solid.color is None:
        _, nearest = nearest_rows(solid.gaussians.means, means, 1, 2.0 * solid.voxel)
        return solid.gaussians.colors()[nearest[:, 0]].clamp(max=1.0)
    weight = solid.occupancy.to(torch.float32)
    total = sample(weight, place).clamp(min=1e-6)
    fields = torch.stack([weight * solid.color[..., i] for i in range(3)])
    return (sample(fields, place) / total).T.contiguous()
