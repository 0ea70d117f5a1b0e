"""Texture from photographs of a cut object: guided patch synthesis on object-anchored levels."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gsfluent.errors import InputError, check_choice
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, Exemplars
from gsfluent.pipeline.texture.photo.parts import read_parts, resized_parts
from gsfluent.pipeline.texture.synthesis.choice import surface_verdict
from gsfluent.pipeline.texture.synthesis.guides import GUIDES, PlacedPhoto, explained, place_photo
from gsfluent.pipeline.texture.synthesis.inclusions import (
    Inclusions,
    find_inclusions,
    paint_inclusions,
    remove_inclusions,
)
from gsfluent.pipeline.texture.synthesis.levels import ObjectFields
from gsfluent.pipeline.texture.synthesis.patches import Schedule
from gsfluent.pipeline.texture.synthesis.pyramid import synthesize_pyramid, to_grid
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture
from gsfluent.progress import Progress
from gsfluent.spatial.voxels import small_convolutions

logger = logging.getLogger(__name__)

QUALITIES: dict[str, Schedule] = {
    "preview": Schedule(iterations=(3, 2, 0), polish=(4, 4, 0), bank=1536),
    "fast": Schedule(),
    "full": Schedule(iterations=(8, 5, 3), bank=6144, samples=2000, sinkhorn=5, stride=2),
}
SURFACES = ("auto", "keep", "copy", "ignore")
CORES = ("open", "closed")


@dataclass(frozen=True)
class SynthesisOptions:
    """How a texture is synthesised from photographs.

    Attributes:
        quality: ``preview``, ``fast`` or ``full``.
        scale: Size of the photographed structure relative to the automatic choice, which lays the
            photograph into the object (or, for a patch of material, makes the photograph as wide
            as the object).
        guide: What the structure follows: ``depth``; ``axis`` (depth, distance to the object's
            axis, and a cut across it whose structure is carried along it); ``height`` (depth, and
            height along the axis: layers); ``none``; an array [X, Y, Z] of the user's own
            coordinate; or ``auto``, which takes what explains the photographs' colours.
        directional: True for grained materials: the photographs are not turned or mirrored, and
            slices across an axis without a photograph are not matched.
        inclusions: Find seeds and stones and place them as labelled ellipsoids.
        parts: What shows the inclusions of the first photograph, where they shall not be guessed: a
            label image (file or array: 0 is matter, each other number one part; or a mask), or a
            colour as three values in 0..1.
        depth_scale: Depth of the photograph's deepest point in units of the object's largest
            depth; None works it out.
        surface: What the surface's colours are to the inside: ``keep`` them fixed and grow the
            inside from them, ``copy`` them inwards, ``ignore`` them, or ``auto``: copied where that
            gives the photograph's statistics without streaks, kept where the material is unlayered
            and its surface looks like the photograph, else ignored (:mod:`.choice`).
        core: With guide ``axis``: ``open``, the core goes on from pole to pole (orange, log), or
            ``closed``, it ends below the surface (apple).
    """

    quality: str = "fast"
    scale: float = 1.0
    guide: str | np.ndarray = "auto"
    directional: bool = False
    inclusions: bool = True
    parts: object = None
    depth_scale: float | None = None
    surface: str = "auto"
    core: str = "open"

    def __post_init__(self) -> None:
        """Check ranges."""
        check_choice("texture: quality", self.quality, QUALITIES, "leave it at fast")
        if isinstance(self.guide, str):
            check_choice("texture: guide", self.guide, GUIDES, "leave it at auto")
        check_choice("texture: surface", self.surface, SURFACES, "leave it at auto")
        check_choice("texture: core", self.core, CORES, "leave it at open")
        for name in ("scale", "depth_scale"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"texture: {name} must be positive, got {value}", "1 is neutral")


def exemplar_texture(
    domain: InteriorDomain,
    exemplars: Exemplars,
    options: SynthesisOptions | None = None,
    *,
    device: str | torch.device = "cpu",
    seed: int = 0,
    progress: Progress | None = None,
    **settings: Any,
) -> InteriorTexture:
    """Synthesise the interior from photographs.

    Args:
        domain: Voxels to fill.
        exemplars: Photographs per axis of the object (:func:`.exemplar.load_exemplars`).
        options: Settings; None takes ``settings``.
        device: Where to compute.
        seed: Seed. The same seed gives the same texture on the same kind of device.
        progress: Optional callback.
        settings: Fields of :class:`SynthesisOptions`.

    Returns:
        The texture; ``report`` holds quality, guide, photographs, inclusions, levels and
        axis_disagreement.

    Raises:
        InputError: A guide that needs an outline or has another shape, or an empty solid.
    """
    options = options or SynthesisOptions(**settings)
    began = time.process_time()
    where = torch.device(device)
    photos, guide = exemplars, options.guide
    everything = [e for group in photos.values() for e in group]
    outlined = all(e.silhouette for e in everything)
    along = isinstance(guide, str) and guide in ("axis", "height")
    if along and not outlined:
        raise InputError(
            f"texture: guide {guide!r} needs a photograph with an outline",
            hint="cut the object out (RGBA) or use guide: none",
        )
    crop, back = _crop(domain)
    if isinstance(guide, np.ndarray):
        if guide.shape != domain.inside.shape or not np.isfinite(guide).all():
            raise InputError(
                f"texture: a guide array must be finite, of shape {list(domain.inside.shape)}, "
                f"got {list(guide.shape)}",
                hint="give one value per voxel of the solid",
            )
        guide = guide[back]
    shared = len({id(e) for e in everything}) == len(photos[min(photos)])
    fields = ObjectFields(crop, shared and not (options.directional or along), where)
    guided = not isinstance(guide, str) or (guide != "none" and outlined)
    rng = np.random.default_rng([seed, 99])

    def place(photo: Exemplar, axis: int) -> PlacedPhoto:
        return place_photo(photo, fields, axis, guided, options.scale, options.depth_scale)

    # one photograph for everything: across the axis if that is what carries the structure
    across = isinstance(guide, str) and guide == "axis"
    home = None if not shared else 2 if across else 0
    prepared, blobs = _prepare(photos, place, home, options.inclusions, options.parts)
    kind = guide if isinstance(guide, str) else "array"
    if kind == "auto":
        kind = choose_guide(prepared) if guided else "none"
    verdict, surface = _surface(crop, prepared, kind, options.surface, seed)
    if surface == "copy":
        rgb, figures = crop.skin, {"levels": 0, "axis_disagreement": 0.0}
    else:
        with small_convolutions():
            volume, lattice, figures = synthesize_pyramid(
                fields,
                prepared,
                QUALITIES[options.quality],
                kind,
                own=guide if isinstance(guide, np.ndarray) else None,
                directional=options.directional,
                keep=surface == "keep",
                closed=options.core == "closed",
                seed=seed,
                progress=progress,
            )
        rgb = to_grid(volume, lattice, fields)
    labels = np.zeros(crop.inside.shape, np.int32)
    count = 0
    if blobs is not None and surface != "copy":
        anchor = (fields.rotation, fields.center, fields.size)
        rgb, labels, count = paint_inclusions(rgb, crop, blobs[1], blobs[0], anchor, rng)
    full = np.zeros((*domain.inside.shape, 3), np.float32)
    full[back] = np.where(crop.inside[..., None], rgb, 0.0)
    full_labels = np.zeros(domain.inside.shape, np.int32)
    full_labels[back] = labels
    report = {
        "quality": options.quality,
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
    why, choice = "the surface does not look like the photograph: synthesised", "ignore"
    if verdict["copy_suffices"]:
        why = "the surface copied inwards has the photograph's colours and patches and no streaks"
        choice = "copy"
    elif alike and kind == "none":
        why = "the surface looks like the photograph; copied inwards it would make streaks: kept"
        choice = "keep"
    elif alike:
        why = "the surface looks like the photograph, but the inside follows a guide: synthesised"
    logger.info("texture: %s", why)
    return verdict | {"why": why}, choice


def _crop(domain: InteriorDomain) -> tuple[InteriorDomain, tuple[slice, ...]]:
    """The domain without its empty rim, and where it sits."""
    if not domain.inside.any():
        raise InputError("texture: the solid is empty", hint="run fill first")
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


Blobs = tuple[Inclusions, PlacedPhoto]


def _prepare(
    photos: dict[int, list[Exemplar]],
    place: Callable[[Exemplar, int], PlacedPhoto],
    home: int | None,
    find: bool,
    parts: object,
) -> tuple[dict[int, list[PlacedPhoto]], Blobs | None]:
    """Photographs without inclusions, placed in the object; and the richest set of inclusions.

    ``home`` is the axis that photographs shared by all slice axes are a cut across, None their own;
    ``parts`` shows the inclusions of the first photograph (:func:`.parts.read_parts`).
    """
    made: dict[int, PlacedPhoto] = {}
    best: Blobs | None = None
    for axis, group in photos.items():
        for photo in group:
            if id(photo) in made:
                continue
            placed = place(photo, axis if home is None else home)
            shown = None if parts is None or made else read_parts(parts, photo)
            if find and (shown is not None or parts is None):
                # inclusions are looked for at up to four pixels per voxel: finer is sensor noise
                detail = min(1.0, 4.0 * placed.pitch)
                original = photo.resized(detail) if detail < 0.98 else photo
                if shown is not None:
                    shown = resized_parts(shown, original.mask.shape)
                found = find_inclusions(original, parts=shown)
                if found is not None:
                    whole = place(original, placed.axis)
                    if best is None or found.count > best[0].count:
                        best = found, whole
                    placed = place(remove_inclusions(original, found), placed.axis)
            made[id(photo)] = placed
    return {axis: [made[id(photo)] for photo in group] for axis, group in photos.items()}, best


def choose_guide(prepared: dict[int, list[PlacedPhoto]]) -> str:
    """Height when it explains the colours of cuts along the axis clearly better than depth does."""
    height, depth = [], []
    for axis, group in prepared.items():
        for placed in group:
            if axis == 2 or placed.axis == 2 or not placed.fitted:
                continue
            # below the rim: an icing follows the depth whatever it encloses
            inner = placed.mask & (placed.depth > 0.25 * placed.depth.max())
            color = placed.image[inner]
            height.append(explained(placed.local[inner][:, 2], color))
            depth.append(explained(placed.depth[inner], color))
    if height and np.mean(height) > np.mean(depth) + 0.1:
        return "height"
    return "depth"
