"""Texture from photographs of a cut object: guided patch synthesis on object-anchored levels."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.errors import InputError

from ..stage import Progress, report_progress
from .bank import Bank, LevelPhoto
from .choice import surface_verdict
from .color import lab_to_rgb, rgb_to_lab100
from .domain import InteriorDomain, InteriorTexture
from .guides import GUIDES, PlacedPhoto, depth_guide, explained, place_photo
from .inclusions import Inclusions, find_inclusions, paint_inclusions, remove_inclusions
from .levels import Lattice, ObjectFields, hashed_noise, pad_edges
from .photo import Exemplar, load_exemplar
from .sections import Section
from .synthesis import Schedule, SynthesisLevel, synthesize_level

__all__ = ["QUALITIES", "SURFACES", "exemplar_texture", "load_exemplars"]

logger = logging.getLogger(__name__)

QUALITIES: dict[str, Schedule] = {
    "preview": Schedule(iterations=(3, 2, 0), polish=(4, 4, 1), bank=1536),
    "fast": Schedule(),
    "full": Schedule(iterations=(8, 5, 3), bank=6144, samples=2000, sinkhorn=5, stride=2),
}
SURFACES = ("auto", "keep", "copy", "ignore")
_AXES = {"x": 0, "y": 1, "z": 2}
_PER_VOXEL = 0.08  # guide weight of a cell of height or distance to the axis
_SECTION_WEIGHT = 3.0  # against the 75 values of a patch: structure leads, texture decides
_PATCH = 7  # patches whose statistics are matched


def load_exemplars(source: object) -> dict[int, list[Exemplar]]:
    """Photographs per slice axis.

    Args:
        source: One image (path or array) or a list of them for all axes, or a mapping from ``x``,
            ``y``, ``z`` (axes of the object, z its own axis) to images or lists.

    Returns:
        Photographs by axis; only the axes that were named, or all three with the same list.

    Raises:
        InputError: An axis is unknown or an image cannot be used.
    """
    if isinstance(source, Mapping):
        if not source or any(key not in _AXES for key in source):
            raise InputError(
                f"texture: exemplar axes must be x, y, z, got {sorted(map(str, source))}",
                mend="write exemplar: {x: a.jpg, z: b.jpg} or one file",
            )
        return {_AXES[key]: _load_list(source[key]) for key in sorted(source)}
    one = _load_list(source)
    return {0: one, 1: one, 2: one}


def _load_list(source: object) -> list[Exemplar]:
    if isinstance(source, Sequence) and not isinstance(source, str):
        if not source:
            raise InputError("texture: the list of exemplars is empty", mend="name a photograph")
        return [item for part in source for item in _load_list(part)]
    if isinstance(source, Exemplar):
        return [source]
    if not isinstance(source, str | Path | np.ndarray):
        raise InputError(
            f"texture: exemplar must be a file, an array or a mapping, got {type(source).__name__}",
            mend="give the path of a photograph",
        )
    return [load_exemplar(source)]


def exemplar_texture(
    domain: InteriorDomain,
    exemplars: Mapping[int, Exemplar | Sequence[Exemplar]],
    *,
    quality: str = "fast",
    scale: float = 1.0,
    guide: str | np.ndarray = "auto",
    directional: bool = False,
    inclusions: bool = True,
    depth_scale: float | None = None,
    surface: str = "auto",
    device: str | torch.device = "auto",
    seed: int = 0,
    progress: Progress | None = None,
) -> InteriorTexture:
    """Synthesise the interior from photographs.

    Args:
        domain: Voxels to fill.
        exemplars: Photographs per axis of the object (:func:`load_exemplars`).
        quality: ``preview``, ``fast`` or ``full``.
        scale: Size of the photographed structure relative to the automatic choice, which lays the
            photograph into the object (or, for a patch of material, makes the photograph as wide
            as the object).
        guide: ``depth``; ``axis`` (depth, distance to the object's axis, and a cut across it whose
            structure is carried along it); ``height`` (depth, and height along the axis); ``none``;
            an array [X, Y, Z] of the user's own coordinate; or ``auto``, which takes what explains
            the photographs' colours.
        directional: True for grained materials: the photographs are not turned or mirrored, and
            slices across an axis without a photograph are not matched.
        inclusions: Find seeds and stones and place them as labelled ellipsoids.
        depth_scale: Depth of the photograph's deepest point in units of the object's largest
            depth; None works it out.
        surface: What the surface's colours are to the inside: ``keep`` them fixed and grow the
            inside from them, ``copy`` them inwards, ``ignore`` them, or ``auto``: copied where that
            gives the photograph's statistics without streaks, kept where the material is unlayered
            and its surface looks like the photograph, else ignored (:mod:`.choice`).
        device: Where to compute; ``auto`` takes a CUDA device when there is one.
        seed: Seed. The same seed gives the same texture on the same kind of device.
        progress: Optional callback.

    Returns:
        The texture; ``report`` holds quality, guide, photographs, inclusions, levels and
        axis_disagreement.

    Raises:
        InputError: Unknown quality or guide, a guide that needs an outline, a scale that is not
            positive, or an empty solid.
    """
    _check(quality, scale, guide, depth_scale)
    if surface not in SURFACES:
        raise InputError(
            f"texture: surface must be one of {', '.join(SURFACES)}, got {surface!r}",
            mend="leave it at auto",
        )
    began = time.process_time()
    where = _device(device)
    photos = {a: [e] if isinstance(e, Exemplar) else list(e) for a, e in exemplars.items()}
    everything = [e for group in photos.values() for e in group]
    outlined = all(e.silhouette for e in everything)
    if isinstance(guide, str) and guide in ("axis", "height") and not outlined:
        raise InputError(
            f"texture: guide {guide!r} needs a photograph with an outline",
            mend="cut the object out (RGBA) or use guide: none",
        )
    crop, back = _crop(domain)
    shared = len({id(e) for e in everything}) == len(photos[min(photos)])
    aligned = not directional and guide not in ("axis", "height") and shared
    fields = ObjectFields(crop, aligned, where)
    guided = not (guide == "none" if isinstance(guide, str) else False) and (
        outlined if isinstance(guide, str) else True
    )
    rng = np.random.default_rng(seed)
    prepared, blobs = _prepare(photos, fields, guided, scale, depth_scale, inclusions, shared, guide)
    kind = guide if isinstance(guide, str) else "array"
    if kind == "auto":
        kind = _choose_guide(prepared) if guided else "none"
    verdict, surface = _surface(crop, prepared, kind, surface, seed)
    if surface == "copy":
        rgb, figures = crop.skin, {"levels": 0, "axis_disagreement": 0.0}
    else:
        volume, lattice, figures = _synthesize(
            crop, fields, prepared, QUALITIES[quality], kind, guide, directional,
            surface == "keep", seed, rng, progress,
        )  # fmt: skip
        rgb = _to_grid(volume, lattice, fields, crop)
    labels = np.zeros(crop.inside.shape, np.int32)
    count = 0
    if blobs is not None and surface != "copy":
        found, original, pitch = blobs
        rgb, labels, count = paint_inclusions(
            rgb, crop.inside, crop.depth, original, found, pitch, rng
        )
    full = np.zeros((*domain.inside.shape, 3), np.float32)
    full[back] = np.where(crop.inside[..., None], rgb, 0.0)
    full_labels = np.zeros(domain.inside.shape, np.int32)
    full_labels[back] = labels
    report = {
        "quality": quality,
        "guide": kind,
        "exemplar_mask": everything[0].note,
        "exemplars": len({id(e) for e in everything}),
        "laid_into_object": all(p.fitted for group in prepared.values() for p in group),
        "inclusions": count,
        "photo_pitch": next(iter(prepared.values()))[0].pitch,
        "surface": surface,
        **verdict,
        "device": str(where),
        "cpu_seconds": time.process_time() - began,
        **figures,
    }
    return InteriorTexture(full, full_labels, report)


def _surface(
    domain: InteriorDomain,
    prepared: dict[int, list[PlacedPhoto]],
    kind: str,
    wanted: str,
    seed: int,
) -> tuple[dict[str, Any], str]:
    """What the surface is to the inside, and why."""
    placed = list({id(p): p for group in prepared.values() for p in group}.values())
    verdict = surface_verdict(domain, placed, seed)
    alike = verdict["surface_like_interior"]
    if wanted != "auto":
        return verdict | {"why": f"surface: {wanted} was asked for"}, wanted
    if verdict["copy_suffices"]:
        why = "the surface copied inwards has the photograph's colours and patches and no streaks"
        choice = "copy"
    elif alike and kind == "none":
        why = "the surface looks like the photograph; copied inwards it would make streaks: kept"
        choice = "keep"
    elif alike:
        why = "the surface looks like the photograph, but the inside follows a guide: synthesised"
        choice = "ignore"
    else:
        why = "the surface does not look like the photograph: synthesised"
        choice = "ignore"
    logger.info("texture: %s", why)
    return verdict | {"why": why}, choice


def _check(
    quality: str, scale: float, guide: str | np.ndarray, depth_scale: float | None
) -> None:
    if quality not in QUALITIES:
        raise InputError(
            f"texture: quality must be one of {', '.join(QUALITIES)}, got {quality!r}",
            mend="leave it at fast",
        )
    if isinstance(guide, str) and guide not in GUIDES:
        raise InputError(
            f"texture: guide must be one of {', '.join(GUIDES)}, got {guide!r}",
            mend="leave it at auto",
        )
    for name, value in (("scale", scale), ("depth_scale", depth_scale)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"texture: {name} must be positive, got {value}", mend="1 is neutral")


def _device(device: str | torch.device) -> torch.device:
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(device)


def _crop(domain: InteriorDomain) -> tuple[InteriorDomain, tuple[slice, ...]]:
    """The domain without its empty rim, and where it sits."""
    if not domain.inside.any():
        raise InputError("texture: the solid is empty", mend="run fill first")
    box = []
    for k in range(3):
        used = np.flatnonzero(domain.inside.any(tuple(i for i in range(3) if i != k)))
        box.append(slice(int(used[0]), int(used[-1]) + 1))
    where = tuple(box)
    cropped = replace(
        domain,
        inside=np.ascontiguousarray(domain.inside[where]),
        depth=np.ascontiguousarray(domain.depth[where]),
        shell=np.ascontiguousarray(domain.shell[where]),
        skin=np.ascontiguousarray(domain.skin[where]),
    )
    return cropped, where


Blobs = tuple[Inclusions, Exemplar, float]


def _prepare(
    photos: dict[int, list[Exemplar]],
    fields: ObjectFields,
    guided: bool,
    scale: float,
    depth_scale: float | None,
    inclusions: bool,
    shared: bool,
    guide: str | np.ndarray,
) -> tuple[dict[int, list[PlacedPhoto]], Blobs | None]:
    """Photographs without inclusions, placed in the object; and the richest set of inclusions."""
    made: dict[int, PlacedPhoto] = {}
    best: Blobs | None = None
    result: dict[int, list[PlacedPhoto]] = {}
    # one photograph for everything: across the axis if that is what carries the structure
    home = 2 if isinstance(guide, str) and guide == "axis" else 0
    for axis, group in photos.items():
        result[axis] = []
        for photo in group:
            if id(photo) not in made:
                own = home if shared else axis
                placed = place_photo(
                    photo, fields, own, guided=guided, scale=scale, depth_scale=depth_scale
                )
                if inclusions:
                    placed, found = _without_inclusions(placed, fields, guided, scale, depth_scale)
                    if found is not None and (best is None or found[0].count > best[0].count):
                        best = found
                made[id(photo)] = placed
            result[axis].append(made[id(photo)])
    return result, best


def _without_inclusions(
    placed: PlacedPhoto,
    fields: ObjectFields,
    guided: bool,
    scale: float,
    depth_scale: float | None,
) -> tuple[PlacedPhoto, Blobs | None]:
    photo = placed.photo
    # inclusions are looked for at up to four pixels per voxel: finer is sensor noise
    detail = min(1.0, 4.0 * placed.pitch)
    original = photo.resized(detail) if detail < 0.98 else photo
    found = find_inclusions(original)
    if found is None:
        return placed, None
    clean = remove_inclusions(original, found)
    placed = place_photo(
        clean, fields, placed.axis, guided=guided, scale=scale, depth_scale=depth_scale
    )
    return placed, (found, original, placed.pitch)


def _choose_guide(prepared: dict[int, list[PlacedPhoto]]) -> str:
    """Height when it explains the colours of cuts along the axis clearly better than depth does."""
    height, depth = [], []
    for axis, group in prepared.items():
        for placed in group:
            if axis == 2 or placed.axis == 2 or not placed.fitted:
                continue
            color = placed.image[placed.mask]
            height.append(explained(placed.local[placed.mask][:, 2], color))
            depth.append(explained(placed.depth[placed.mask], color))
    if height and np.mean(height) > np.mean(depth) + 0.1:
        return "height"
    return "depth"


def _synthesize(
    domain: InteriorDomain,
    fields: ObjectFields,
    prepared: dict[int, list[PlacedPhoto]],
    schedule: Schedule,
    kind: str,
    own: str | np.ndarray,
    directional: bool,
    keep: bool,
    seed: int,
    rng: np.random.Generator,
    progress: Progress | None,
) -> tuple[Tensor, Lattice, dict[str, Any]]:
    """Coarse to fine; returns Lab on the last lattice, that lattice, and figures."""
    device = fields.device
    section = None
    if kind == "axis":
        across = prepared.get(2, next(iter(prepared.values())))[0]
        reach = float(max(np.abs(fields.low[:2]).max(), np.abs(fields.high[:2]).max()))
        section = Section(across, fields.max_depth, reach, device)
    groups = dict(prepared)
    first = next(iter(prepared.values()))
    if not directional:
        groups = {axis: prepared.get(axis, first) for axis in range(3)}
    lattices = fields.lattices()
    volume: Tensor | None = None
    disagreement = 0.0
    for step, lattice in enumerate(lattices):
        report_progress(progress, step, len(lattices), f"patches at 1/{lattice.pitch:.1f}")
        here = fields.on(lattice)
        if not bool(here["inside"].any()):
            continue
        guides = _Guides(kind, fields, lattice, section, own, directional)
        guide = guides.of_volume(here)
        photos: dict[int, LevelPhoto] = {}
        for group in groups.values():
            for placed in group:
                if id(placed) not in photos:
                    photos[id(placed)] = guides.of_photo(placed)
        inside = here["inside"]
        target = guide.reshape(len(guide), -1)[:, inside.reshape(-1)].T
        banks = {}
        pooled: dict[tuple[int, ...], Bank] = {}
        for axis, group in groups.items():
            key = tuple(id(p) for p in group)
            if key not in pooled or directional:
                queries = int(inside.sum()) // schedule.stride**2
                # more patches than queries cannot all be used
                wanted = min(schedule.bank, max(512, queries))
                pooled[key] = Bank(
                    [photos[k] for k in key], wanted, _PATCH, schedule.patch,
                    not directional, target, rng,
                )
            banks[axis] = pooled[key]
        reference = (
            torch.cat([p.image[p.mask] for p in photos.values()]),
            torch.cat([p.guide[p.mask] for p in photos.values()]),
        )
        if volume is None:
            base = guides.base(guide, reference, inside)
            volume = _initial(lattice, inside, guide, reference, seed)
        else:
            volume = _refined(volume, previous, lattice, inside)
            # detail that the guide fixes and the coarser level could not hold
            base = guides.base(guide, reference, inside)
            volume = volume + base - _refined(base_before, previous, lattice, inside)
        fixed = here["shell"] if keep else torch.zeros_like(inside)
        skin = rgb_to_lab100(here["skin"].movedim(0, -1)).movedim(-1, 0)
        volume = torch.where(fixed, skin, volume)
        along = 0.0 if kind != "axis" else 2.0 if directional else 0.7
        level = SynthesisLevel(volume, inside, fixed, guide, banks, reference, along)
        rounds = schedule.at(step, len(lattices))
        disagreement = synthesize_level(
            level, schedule, rounds, transport_last_only=kind == "none", rng=rng
        )
        volume, previous = level.volume, (lattice, inside)
        base_before = base
    report_progress(progress, len(lattices), len(lattices), "patches")
    assert volume is not None  # the last lattice holds every voxel
    figures = {
        "levels": len(lattices),
        "axis_disagreement": disagreement,
        "axes_matched": sorted("xyz"[a] for a in groups),
        "surface_kept": keep,
    }
    return volume, lattices[-1], figures


class _Guides:
    """Guide values of voxels and of photographs' pixels on one level."""

    def __init__(
        self,
        kind: str,
        fields: ObjectFields,
        lattice: Lattice,
        section: Section | None,
        own: str | np.ndarray,
        directional: bool,
    ) -> None:
        self.directional = directional
        self._polar: Tensor | None = None
        self.kind, self.fields, self.lattice, self.section = kind, fields, lattice, section
        self.own: Tensor | None = None
        if not isinstance(own, str):
            self.own = torch.from_numpy(np.asarray(own, np.float32)).to(fields.device)

    def _common(self, local: list[Tensor], depth: Tensor, picture: Tensor | None) -> Tensor:
        """Guide values [G, ...]; ``local`` are three broadcastable coordinates."""
        pitch = self.lattice.pitch
        if self.kind == "none":
            return torch.zeros_like(depth)[None]
        layered = 1.0 if self.section is None else self.section.skin
        values = [layered * depth_guide(depth, self.fields.max_depth)]
        if self.kind == "height":
            values.append((_PER_VOXEL / pitch * local[2]).expand_as(depth))
        if self.kind == "axis" and picture is not None:
            values += list(picture)
        return torch.stack(values)

    def polar(self) -> Tensor:
        """What the section carries along the axis, at this level's detail."""
        if self._polar is None:
            assert self.section is not None
            image, _, _, _ = self.section.placed.at(self.lattice.pitch)
            lab = rgb_to_lab100(torch.from_numpy(image).to(self.fields.device)).movedim(-1, 0)
            self._polar = self.section.polar(lab, self.directional)
        return self._polar

    def _carried(self, local: Tensor, depth: Tensor) -> Tensor:
        """Radius and colour in the section [n, 4], weighted."""
        assert self.section is not None
        turn, relative = self.section.locate(local, depth)
        radius = _PER_VOXEL / self.lattice.pitch * self.section.reach * relative
        colors = self.section.color(turn, relative, self.polar())
        return torch.cat([radius[:, None], _SECTION_WEIGHT * colors], 1)

    def widths(self) -> list[float]:
        """Half a cell of this level, in guide values."""
        if self.own is not None:
            return [0.05]
        near_skin = 4.5 * self.lattice.pitch / max(self.fields.max_depth, 1e-6)
        return [0.5 * near_skin, 0.5 * _PER_VOXEL]

    def base(self, guide: Tensor, reference: tuple[Tensor, Tensor], inside: Tensor) -> Tensor:
        """What the guide alone says about the colours, [3, X, Y, Z]."""
        if self.kind == "none":
            return torch.zeros(3, *inside.shape, device=guide.device)
        if self.section is not None:
            return guide[-3:] / _SECTION_WEIGHT
        flat = guide.reshape(len(guide), -1)[:, inside.reshape(-1)].T
        result = torch.zeros(3, *inside.shape, device=guide.device)
        result[:, inside] = _regress(flat, *reference, self.widths()).T
        return result

    def of_volume(self, here: dict[str, Tensor]) -> Tensor:
        """Guide values [G, X, Y, Z]."""
        local = self.lattice.local(self.fields.device)
        picture = None
        if self.section is not None:
            inside = here["inside"]
            spot = inside.nonzero()
            places = torch.stack([local[k].reshape(-1)[spot[:, k]] for k in range(3)], -1)
            picture = torch.zeros(4, *inside.shape, device=places.device)
            picture[:, inside] = self._carried(places, here["depth"][inside]).T
        if self.own is not None:
            value = self.lattice.sample(self.own[None])
            return depth_like(value)
        return self._common(local, here["depth"], picture)

    def of_photo(self, placed: PlacedPhoto) -> LevelPhoto:
        """The photograph at this level's pitch."""
        device = self.fields.device
        image, mask, depth, local = placed.at(self.lattice.pitch)
        lab = rgb_to_lab100(torch.from_numpy(image).to(device))
        below = torch.from_numpy(depth).to(device).float()
        place = torch.from_numpy(local).to(device)
        picture = None
        if self.section is not None:
            found = self._carried(place.reshape(-1, 3), below.reshape(-1))
            picture = found.T.reshape(4, *mask.shape)
        if self.own is not None:
            turn = torch.tensor(self.fields.rotation, dtype=torch.float32, device=device)
            center = torch.tensor(self.fields.center, dtype=torch.float32, device=device)
            from .levels import trilinear

            guide = depth_like(trilinear(self.own[None], place @ turn + center))
        else:
            guide = self._common(list(place.movedim(-1, 0)), below, picture)
        return LevelPhoto(lab, torch.from_numpy(mask).to(device), guide.movedim(0, -1).contiguous())


def depth_like(value: Tensor) -> Tensor:
    """A user's coordinate, weighted like a depth."""
    return 4.5 * value


def _regress(query: Tensor, color: Tensor, place: Tensor, width: list[float]) -> Tensor:
    """Mean colour [n, 3] of the photographs near guide values [n, G], G one or two.

    Kernel regression (Nadaraya 1964; Watson 1964) on a table, read bilinearly.

    Args:
        query: Guide values wanted [n, G].
        color: Colours of the photographs' pixels [m, 3].
        place: Their guide values [m, G].
        width: Bandwidth per guide value [G].
    """
    if len(place) > 6000:
        some = torch.linspace(0, len(place) - 1, 6000, device=place.device).long()
        color, place = color[some], place[some]
    if place.shape[1] == 1:
        place, query, width = (
            functional.pad(place, (0, 1)), functional.pad(query, (0, 1)), [*width, 1.0]
        )
    scale = torch.tensor(width[:2], device=place.device)
    place, query = place / scale, query / scale
    low = torch.minimum(place.amin(0), query.amin(0))
    high = torch.maximum(place.amax(0), query.amax(0))
    count = [min(400, max(2, int(2 * float(high[k] - low[k])))) for k in range(2)]
    lines = [torch.linspace(float(low[k]), float(high[k]), count[k]) for k in range(2)]
    grid = torch.stack(torch.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2).to(place)
    table = []
    for part in grid.split(max(1, (1 << 24) // len(place))):
        gap = torch.cdist(part, place) ** 2
        # the second, wide kernel decides where there is no pixel near
        weight = torch.exp(-0.5 * gap) + 1e-4 / (1.0 + gap) ** 2
        table.append(weight @ color / weight.sum(1, keepdim=True))
    image = torch.cat(table).T.reshape(1, 3, *count)
    at = (query - low) / (high - low).clamp(min=1e-6)
    size = torch.tensor(count, device=place.device)
    at = 2 * (at * (size - 1) + 0.5) / size - 1
    found = functional.grid_sample(
        image, at.flip(-1)[None, None], padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


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


def _refined(
    volume: Tensor,
    previous: tuple[Lattice, Tensor],
    lattice: Lattice,
    inside: Tensor,
) -> Tensor:
    """The coarser volume on a finer lattice of the same object."""
    coarse, known = previous
    extended = pad_edges(volume, known, 3)
    scaled = Lattice(
        tuple((a - b) / coarse.pitch for a, b in zip(lattice.corner, coarse.corner, strict=True)),
        lattice.pitch / coarse.pitch,
        lattice.shape,
        np.eye(3),
        np.zeros(3),
    )
    return scaled.sample(extended) * inside


def _to_grid(
    volume: Tensor, lattice: Lattice, fields: ObjectFields, domain: InteriorDomain
) -> np.ndarray:
    """RGB [X, Y, Z, 3] on the solid's own voxels."""
    inside = fields.inside
    own = fields.on(lattice)["inside"]
    extended = pad_edges(volume, own, 2)
    rgb = np.zeros((*domain.inside.shape, 3), np.float32)
    for k in range(domain.inside.shape[0]):
        spot = inside[k].nonzero().float()
        if len(spot) == 0:
            continue
        points = torch.cat([torch.full_like(spot[:, :1], k), spot], 1) + 0.5
        colors = lab_to_rgb(lattice.read(extended, points).T)
        rgb[k][domain.inside[k]] = colors.cpu().numpy()
    return rgb
