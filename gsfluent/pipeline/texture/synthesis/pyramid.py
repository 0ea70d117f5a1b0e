"""The synthesis from coarse to fine, on lattices that are fixed in the object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.colors import lab100_to_rgb, rgb_to_lab100
from gsfluent.pipeline.texture.synthesis.bank import Bank, LevelPhoto
from gsfluent.pipeline.texture.synthesis.guides import DepthGuide, PlacedPhoto
from gsfluent.pipeline.texture.synthesis.level_guides import LevelGuides
from gsfluent.pipeline.texture.synthesis.levels import (
    Lattice,
    ObjectFields,
    hashed_noise,
    pad_edges,
)
from gsfluent.pipeline.texture.synthesis.patches import Schedule, SynthesisLevel, synthesize_level
from gsfluent.pipeline.texture.synthesis.sections import Section
from gsfluent.pipeline.texture.synthesis.transport import Cells
from gsfluent.progress import Progress, report_progress

_PARTS = 96  # parts of the guide's space over which the photographs' pixels are spread
_PATCH = 7  # patches whose statistics are matched
_FIBRE, _LINES = 2.0, 0.7  # voxels of smoothing along the axis: fibres; lines among cells


def synthesize_pyramid(
    fields: ObjectFields,
    prepared: dict[int, list[PlacedPhoto]],
    schedule: Schedule,
    kind: str,
    *,
    own: np.ndarray | None = None,
    directional: bool = False,
    keep: bool = False,
    closed: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Tensor, Lattice, dict[str, Any]]:
    """Synthesise an object's inside, coarse to fine.

    The guide is of the ``kind`` ``depth``, ``axis``, ``height``, ``none`` or ``array`` (the user's
    ``own`` coordinate on the solid's grid). ``directional`` photographs are not turned, and only
    their own axes are matched; ``keep`` holds the surface's colours; the core of the section may be
    ``closed`` (:class:`.sections.Section`).

    Returns:
        Lab / 100 [3, X, Y, Z] on the last lattice, that lattice, and figures for the report.
    """
    section = None
    if kind == "axis":
        across = prepared.get(2, next(iter(prepared.values())))[0]
        reach = float(max(np.abs(fields.low[:2]).max(), np.abs(fields.high[:2]).max()))
        section = Section(across, fields.max_depth, reach, fields.device, closed)
    groups = dict(prepared)
    if not directional:
        first = next(iter(prepared.values()))
        groups = {axis: prepared.get(axis, first) for axis in range(3)}
    placed = list({id(p): p for group in prepared.values() for p in group}.values())
    depth_guide = DepthGuide(placed, fields.max_depth)
    # a cut along the axis shows more of the core than the object holds
    typical = [id(p) for p in (placed if section is None else [section.placed])]
    lattices = fields.lattices()
    before: _Done | None = None
    disagreement = 0.0
    for step, lattice in enumerate(lattices):
        report_progress(progress, step, len(lattices), f"patches at 1/{lattice.pitch:.1f}")
        here = fields.on(lattice)
        inside = here["inside"]
        # every level has its own random numbers: how many a coarser one took does not matter
        rng = np.random.default_rng([seed, step])
        guides = LevelGuides(kind, fields, lattice, section, own, directional, depth_guide)
        guide = guides.of_volume(here)
        photos = {id(p): guides.of_photo(p) for group in groups.values() for p in group}
        reference = (
            torch.cat([photos[k].image[photos[k].mask] for k in typical]),
            torch.cat([photos[k].guide[photos[k].mask] for k in typical]),
        )
        target = guide.reshape(len(guide), -1)[:, inside.reshape(-1)].T
        banks = _banks(groups, photos, target, schedule, directional, rng)
        base = guides.base(guide, reference, inside)
        reference = _as_in(target, reference, rng)
        if before is None:
            volume = _initial(lattice, inside, guide, reference, seed)
        else:
            # and the detail that the guide fixes and the coarser level could not hold
            volume = before.on(lattice, before.volume) + base - before.on(lattice, before.base)
        fixed = here["shell"] if keep else torch.zeros_like(inside)
        skin = rgb_to_lab100(here["skin"].movedim(0, -1)).movedim(-1, 0)
        volume = torch.where(fixed, skin, volume) * inside
        along = 0.0 if kind != "axis" else _FIBRE if directional else _LINES
        level = SynthesisLevel(volume, inside, fixed, guide, banks, reference, lattice.first, along)
        rounds = schedule.at(step, len(lattices))
        disagreement = synthesize_level(
            level, schedule, rounds, transport_last_only=kind == "none", rng=rng
        )
        before = _Done(lattice, inside, level.volume, base)
    report_progress(progress, len(lattices), len(lattices), "patches")
    assert before is not None  # there is always the finest lattice
    figures = {
        "levels": len(lattices),
        "axis_disagreement": disagreement,
        "axes_matched": sorted("xyz"[a] for a in groups),
    }
    return before.volume, lattices[-1], figures


def _as_in(
    target: Tensor, reference: tuple[Tensor, Tensor], rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Pixels drawn so that their guide values are spread as the voxels' are.

    A solid holds more shallow places than its cut shows, also within a part of the guide's space.
    """
    color, place = reference
    cells = Cells(place, _PARTS, rng)
    own = cells.of(place)
    have = torch.bincount(own, minlength=len(cells.centers)).double()
    want = torch.bincount(cells.of(target), minlength=len(cells.centers)).double()
    ratio = (want / want.sum().clamp(min=1.0)) / (have / have.sum()).clamp(min=1e-9)
    mass = ratio.clamp(0.1, 10.0)[own].cumsum(0)
    count = min(max(len(color), 1 << 14), 1 << 17)
    steps = torch.arange(count, device=color.device).double() + float(rng.random())
    pick = torch.searchsorted(mass, steps / count * mass[-1]).clamp(max=len(color) - 1)
    return color[pick], place[pick]


@dataclass(frozen=True)
class _Done:
    """A finished level: its lattice, inside, colours, and what the guide alone says of them."""

    lattice: Lattice
    inside: Tensor
    volume: Tensor
    base: Tensor

    def on(self, lattice: Lattice, volume: Tensor) -> Tensor:
        """One of its volumes on a finer lattice of the same object."""
        own = self.lattice
        a, b, c = (
            (fine - coarse) / own.pitch
            for fine, coarse in zip(lattice.corner, own.corner, strict=True)
        )
        scaled = Lattice(
            (a, b, c), lattice.pitch / own.pitch, lattice.shape, np.eye(3), np.zeros(3)
        )
        return scaled.sample(pad_edges(volume, self.inside, 3))


def _banks(
    groups: dict[int, list[PlacedPhoto]],
    photos: dict[int, LevelPhoto],
    target: Tensor,
    schedule: Schedule,
    directional: bool,
    rng: np.random.Generator,
) -> dict[int, Bank]:
    """Patches per slice axis; axes with the same photographs share them."""
    # more patches than queries cannot all be used; in powers of two, which a voxel does not change
    queries = max(len(target) / schedule.stride**2, 1.0)
    wanted = min(schedule.bank, max(512, 2 ** round(float(np.log2(queries)))))
    made: dict[tuple[int, ...], Bank] = {}
    banks = {}
    for axis, group in groups.items():
        key = tuple(id(p) for p in group)
        if key not in made:
            shown = [photos[k] for k in key]
            made[key] = Bank(shown, wanted, _PATCH, schedule.patch, not directional, target, rng)
        banks[axis] = made[key]
    return banks


def _initial(
    lattice: Lattice,
    inside: Tensor,
    guide: Tensor,
    reference: tuple[Tensor, Tensor],
    seed: int,
) -> Tensor:
    """Mean colour at each guide value, plus noise with the spread found there."""
    color, place = reference
    some = torch.linspace(0, len(color) - 1, min(2048, len(color)), device=color.device).long()
    color, place = color[some], place[some]
    query = guide.reshape(len(guide), -1)[:, inside.reshape(-1)].T
    near = min(24, len(place))
    mean = torch.empty(len(query), 3, device=color.device)
    spread = torch.empty_like(mean)
    for start in range(0, len(query), 1 << 14):
        part = query[start : start + (1 << 14)]
        score = (place**2).sum(1) - 2 * part @ place.T
        index = score.topk(near, largest=False).indices if place.std() > 1e-6 else None
        chosen = color[index] if index is not None else color[None].expand(len(part), -1, -1)
        mean[start : start + len(part)] = chosen.mean(1)
        spread[start : start + len(part)] = chosen.std(1)
    noise = hashed_noise(lattice, 3, seed, color.device)
    kernel = torch.tensor([0.25, 0.5, 0.25], device=color.device)
    for axis in range(3):
        shape = [1] * 5
        shape[axis + 2] = 3
        padding = [0, 0, 0]
        padding[axis] = 1
        noise = functional.conv3d(noise[:, None], kernel.reshape(shape), padding=padding)[:, 0]
    noise = noise / noise.std()
    volume = torch.zeros(3, *inside.shape, device=color.device)
    volume[:, inside] = (mean + spread * noise[:, inside].T).T
    return volume


def to_grid(volume: Tensor, lattice: Lattice, fields: ObjectFields) -> np.ndarray:
    """RGB [X, Y, Z, 3] of Lab / 100 [3, *] on the solid's own voxels; 0 outside."""
    inside = fields.inside
    own = fields.on(lattice)["inside"]
    extended = pad_edges(volume, own, 2)
    rgb = np.zeros((*inside.shape, 3), np.float32)
    for k in range(len(inside)):
        spot = inside[k].nonzero().float()
        if len(spot) == 0:
            continue
        points = torch.cat([torch.full_like(spot[:, :1], k), spot], 1) + 0.5
        colors = lab100_to_rgb(lattice.read(extended, points).T)
        rgb[k][inside[k].cpu().numpy()] = colors.cpu().numpy()
    return rgb
