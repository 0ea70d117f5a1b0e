"""Texture from photographs of a cut object: preview (noise) and guided patch synthesis."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gsfluent.errors import InputError

from ..stage import Progress, report_progress
from .domain import InteriorDomain, InteriorTexture
from .inclusions import Inclusions, find_inclusions, paint_inclusions, remove_inclusions
from .photo import Exemplar, load_exemplar
from .profile import band_noise, depth_profile, match_colors, profile_volume
from .sweep import swept_color
from .synthesis import Schedule, SynthesisLevel, synthesize_level

__all__ = ["QUALITIES", "exemplar_texture", "load_exemplars"]

logger = logging.getLogger(__name__)

QUALITIES: dict[str, Schedule | None] = {
    "preview": None,
    "fast": Schedule(),
    "full": Schedule(iterations=(8, 5, 3), bank=6144, samples=2000, sinkhorn=5, stride=2),
}
_GUIDE_WEIGHT = 10.0  # a guide difference of 0.1 weighs like a colour difference of 1
_SWEEP_WEIGHT = 3.0  # against the 75 pixel values of a patch: structure leads, texture decides
_AXES = {"x": 0, "y": 1, "z": 2}


def load_exemplars(source: object) -> dict[int, Exemplar]:
    """Photographs per slice axis.

    Args:
        source: One image (path or array) for all axes, or a mapping from ``x``, ``y``, ``z`` to
            images; axes not named use the first one given.

    Raises:
        InputError: An axis is unknown or an image cannot be used.
    """
    if isinstance(source, Mapping):
        if not source or any(key not in _AXES for key in source):
            raise InputError(
                f"texture: exemplar axes must be x, y, z, got {sorted(map(str, source))}",
                mend="write exemplar: {x: a.jpg, z: b.jpg} or one file",
            )
        loaded = {_AXES[key]: _load(value) for key, value in source.items()}
        first = next(iter(loaded.values()))
        return {axis: loaded.get(axis, first) for axis in range(3)}
    one = _load(source)
    return {0: one, 1: one, 2: one}


def _load(source: object) -> Exemplar:
    if isinstance(source, Exemplar):
        return source
    if not isinstance(source, str | Path | np.ndarray):
        raise InputError(
            f"texture: exemplar must be a file, an array or a mapping, got {type(source).__name__}",
            mend="give the path of a photograph",
        )
    return load_exemplar(source)


def exemplar_texture(
    domain: InteriorDomain,
    exemplars: dict[int, Exemplar],
    *,
    quality: str = "fast",
    scale: float = 1.0,
    guide: str = "auto",
    directional: bool = False,
    inclusions: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> InteriorTexture:
    """Synthesise the interior from photographs.

    Args:
        domain: Voxels to fill.
        exemplars: Photograph per axis (:func:`load_exemplars`).
        quality: ``preview`` (profile, noise and inclusions), ``fast`` or ``full`` (patch
            synthesis).
        scale: Size of the photographed structure relative to the automatic choice, which makes the
            deepest point of the photograph as deep as the object's (or, for a patch of material,
            the photograph as wide as the object).
        guide: ``depth``; ``axis`` (depth, and the photograph is a cut across the object's axis
            whose structure is swept along it); ``none``; or ``auto`` (depth when the photographs
            show an outline).
        directional: True for grained materials: the photographs are not turned or mirrored.
        inclusions: Find seeds and stones and place them as labelled ellipsoids.
        seed: Seed.
        progress: Optional callback.

    Returns:
        The texture; ``report`` holds quality, guide, inclusions and axis_consistency.

    Raises:
        InputError: Unknown quality or guide, or a scale that is not positive.
    """
    if quality not in QUALITIES:
        raise InputError(
            f"texture: quality must be one of {', '.join(QUALITIES)}, got {quality!r}",
            mend="leave it at fast",
        )
    if guide not in ("auto", "depth", "axis", "none"):
        raise InputError(
            f"texture: guide must be auto, depth, axis or none, got {guide!r}",
            mend="leave it at auto",
        )
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"texture: scale must be positive, got {scale}", mend="1 is neutral")
    rng = np.random.default_rng(seed)
    crop, back = _crop(domain)
    if guide == "axis" and not all(e.silhouette for e in exemplars.values()):
        raise InputError(
            "texture: guide 'axis' needs a photograph with an outline",
            mend="cut the object out (RGBA) or use guide: none",
        )
    guided = guide in ("depth", "axis") or (
        guide == "auto" and all(e.silhouette for e in exemplars.values())
    )
    fitted: dict[int, tuple[Exemplar, Exemplar, float]] = {}
    found: dict[int, Inclusions | None] = {}
    for axis, photo in exemplars.items():
        same = next((a for a in fitted if exemplars[a] is photo), None)
        if same is not None:
            fitted[axis], found[axis] = fitted[same], found[same]
            continue
        fitted[axis], found[axis] = _fit(photo, crop, scale, guided, inclusions)
    schedule = QUALITIES[quality]
    if schedule is None:
        rgb = _preview(crop, fitted[0][0], guided, rng)
        consistency, levels = 0.0, 0
    else:
        photos = {a: f[0] for a, f in fitted.items()}
        rgb, consistency, levels = _patches(
            crop, photos, schedule, guided, guide == "axis", directional, rng, progress
        )
    labels = np.zeros(crop.inside.shape, np.int32)
    count = 0
    axis = max(found, key=lambda a: 0 if (f := found[a]) is None else f.count)
    blobs = found[axis]
    if blobs is not None:
        _, original, pitch = fitted[axis]
        rgb, labels, count = paint_inclusions(
            rgb, crop.inside, crop.depth, original, blobs, pitch, rng
        )
    full = np.zeros((*domain.inside.shape, 3), np.float32)
    full[back] = np.where(crop.inside[..., None], rgb, 0.0)
    full_labels = np.zeros(domain.inside.shape, np.int32)
    full_labels[back] = labels
    report = {
        "quality": quality,
        "guide": "axis" if guide == "axis" else "depth" if guided else "none",
        "exemplar_mask": exemplars[0].note,
        "inclusions": count,
        "levels": levels,
        "axis_disagreement": consistency,
    }
    return InteriorTexture(full, full_labels, report)


def _crop(domain: InteriorDomain) -> tuple[InteriorDomain, tuple[slice, ...]]:
    """The domain without its empty rim, and where it sits."""
    from dataclasses import replace

    index = np.argwhere(domain.inside)
    if len(index) == 0:
        raise InputError("texture: the solid is empty", mend="run fill first")
    box = tuple(slice(int(a), int(b) + 1) for a, b in zip(index.min(0), index.max(0), strict=True))
    return (
        replace(
            domain,
            inside=domain.inside[box],
            depth=domain.depth[box],
            shell=domain.shell[box],
            skin=domain.skin[box],
        ),
        box,
    )


def _fit(
    photo: Exemplar, domain: InteriorDomain, scale: float, guided: bool, inclusions: bool
) -> tuple[tuple[Exemplar, Exemplar, float], Inclusions | None]:
    """Photograph at voxel pitch without inclusions, its detailed form, and that form's pitch."""
    if guided:
        factor = scale * domain.max_depth / max(photo.max_depth, 1.0)
    else:
        factor = scale * max(domain.inside.shape) / max(photo.mask.shape)
    # inclusions are looked for at up to four pixels per voxel: finer is sensor noise
    detail = min(1.0, 4.0 * factor) if factor < 1 else 1.0
    original = photo.resized(detail) if detail < 1.0 else photo
    pitch = factor / detail
    blobs = find_inclusions(original) if inclusions else None
    clean = original if blobs is None else remove_inclusions(original, blobs)
    fitted = clean.resized(pitch) if abs(pitch - 1.0) > 1e-3 else clean
    return (fitted, original, pitch), blobs


def _preview(
    domain: InteriorDomain, photo: Exemplar, guided: bool, rng: np.random.Generator
) -> np.ndarray:
    """Depth profile plus multi-band noise, colours transported within depth ranges."""
    depth = domain.depth if guided else np.zeros_like(domain.depth)
    position, color = depth_profile(photo)
    if not guided:
        position, color = np.array([0.0]), photo.image[photo.mask].mean(0, keepdims=True)
    rgb = profile_volume(depth, position, color)
    photo_depth = photo.depth if guided else np.zeros_like(photo.depth)
    residual = photo.image - profile_volume(photo_depth, position, color)
    rgb = rgb + band_noise(photo, residual, domain.inside.shape, rng)
    rgb[domain.inside] = match_colors(
        rgb[domain.inside].clip(0, 1),
        depth[domain.inside],
        photo.image[photo.mask],
        photo_depth[photo.mask],
        bins=10 if guided else 1,
        rng=rng,
    )
    return rgb.clip(0.0, 1.0)


def _guide(depth: np.ndarray, largest: float) -> np.ndarray:
    """Saturating depth guide: steep near the skin, where layers are thin, flat in the core."""
    t = depth / max(largest, 1e-6)
    result: np.ndarray = _GUIDE_WEIGHT * 0.3 * (1.0 - np.exp(-t * 0.45 / 0.3))
    return result


def _patches(
    domain: InteriorDomain,
    photos: dict[int, Exemplar],
    schedule: Schedule,
    guided: bool,
    swept: bool,
    directional: bool,
    rng: np.random.Generator,
    progress: Progress | None,
) -> tuple[np.ndarray, float, int]:
    """Coarse-to-fine patch synthesis; returns colours, disagreement of the axes, levels."""
    factors = [f for f in (4, 2, 1) if min(domain.inside.shape) // f >= 10] or [1]
    iterations = schedule.iterations[-len(factors) :]
    # skin unlike the photographed material (crust, paint) must not leak into the patches
    keep_shell = not guided and _skin_is_material(domain, photos[0])
    rgb = np.zeros((0, 0, 0, 3), np.float32)
    disagreement = 0.0
    for step, (factor, rounds) in enumerate(zip(factors, iterations, strict=True)):
        report_progress(progress, step, len(factors), f"patches at 1/{factor}")
        inside, depth, shell, skin = _coarse(domain, factor)
        small = _shrunk(photos, factor)
        largest = float(depth.max())
        if step == 0:
            level_domain = InteriorDomain(
                inside, depth, shell, skin, domain.axis, domain.voxel * factor, domain.origin
            )
            rgb = _preview(level_domain, small[0], guided, rng)
        else:
            rgb = _upsample(rgb, inside.shape)
        fixed = shell if keep_shell else np.zeros_like(shell)
        guides = [_guide(depth, largest) if guided else np.zeros_like(depth)]
        seen = {
            a: [_guide(p.depth, p.max_depth) if guided else np.zeros_like(p.depth)]
            for a, p in small.items()
        }
        if swept:
            section = swept_color(inside, domain.axis, small[0])
            if step == 0:
                rgb = np.where(inside[..., None], section, rgb)
            guides += list(_SWEEP_WEIGHT * np.moveaxis(_lowpass(section, inside), -1, 0))
            for axis, photo in small.items():
                blurred = _lowpass(photo.image, np.ones(photo.mask.shape, bool))
                seen[axis] += list(_SWEEP_WEIGHT * np.moveaxis(blurred, -1, 0))
        rgb = np.where(fixed[..., None], skin, rgb).astype(np.float32)
        level = SynthesisLevel(
            rgb=rgb,
            inside=inside,
            fixed=fixed,
            guide=np.stack(guides, -1),
            exemplars={a: (p, np.stack(seen[a], -1)) for a, p in small.items()},
            depth=depth if guided else None,
        )
        disagreement = synthesize_level(
            level,
            schedule,
            rounds,
            turns=not directional,
            transport_last_only=not guided,
            rng=rng,
        )
        rgb = level.rgb
    report_progress(progress, len(factors), len(factors), "patches")
    return rgb, disagreement, len(factors)


def _lowpass(image: np.ndarray, mask: np.ndarray, sigma: float = 1.0) -> np.ndarray:
    """Blur of the pixels or voxels in a mask, not diluted by those outside."""
    from scipy import ndimage

    share = ndimage.gaussian_filter(mask.astype(np.float32), sigma)
    sums = [
        ndimage.gaussian_filter(image[..., c] * mask, sigma) / np.maximum(share, 1e-3)
        for c in range(3)
    ]
    return np.stack(sums, -1).astype(np.float32)


def _skin_is_material(domain: InteriorDomain, photo: Exemplar) -> bool:
    from .metrics import lab_histogram_distance

    skin = domain.skin[domain.shell]
    return lab_histogram_distance(skin, photo.image[photo.mask]) < 8.0


def _shrunk(photos: dict[int, Exemplar], factor: int) -> dict[int, Exemplar]:
    """Photographs reduced by a factor; equal ones stay one object."""
    if factor == 1:
        return photos
    made: dict[int, Exemplar] = {}
    result = {}
    for axis, photo in photos.items():
        if id(photo) not in made:
            made[id(photo)] = photo.resized(1.0 / factor)
        result[axis] = made[id(photo)]
    return result


def _coarse(
    domain: InteriorDomain, factor: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Inside, depth [coarse voxels], shell and skin at 1/factor resolution."""
    if factor == 1:
        return domain.inside, domain.depth, domain.shell, domain.skin
    pads = [(0, -s % factor) for s in domain.inside.shape]

    def blocks(field: np.ndarray) -> np.ndarray:
        padded = np.pad(field.astype(np.float32), pads + [(0, 0)] * (field.ndim - 3))
        x, y, z = (s // factor for s in padded.shape[:3])
        split = padded.reshape(x, factor, y, factor, z, factor, *padded.shape[3:])
        result: np.ndarray = split.mean((1, 3, 5))
        return result

    share = blocks(domain.inside)
    inside = share > 0.4
    depth = np.where(inside, blocks(domain.depth) / np.maximum(share, 1e-3) / factor, 0.0)
    shell_share = blocks(domain.shell)
    shell = inside & (shell_share > 0) & (depth <= 1.0)
    skin = blocks(domain.skin * domain.shell[..., None]) / np.maximum(shell_share, 1e-3)[..., None]
    return inside, depth.astype(np.float32), shell, skin.astype(np.float32)


def _upsample(rgb: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Trilinear enlargement by two, cropped to ``shape``."""
    import torch

    tensor = torch.from_numpy(np.moveaxis(rgb, -1, 0)[None].astype(np.float32))
    size = tuple(2 * s for s in rgb.shape[:3])
    big = torch.nn.functional.interpolate(tensor, size=size, mode="trilinear", align_corners=False)
    out = np.moveaxis(big[0].numpy(), 0, -1)
    grown = [max(0, s - t) for s, t in zip(shape, out.shape[:3], strict=True)]
    out = np.pad(out, [(0, g) for g in grown] + [(0, 0)], mode="edge")
    return np.ascontiguousarray(out[: shape[0], : shape[1], : shape[2]])
