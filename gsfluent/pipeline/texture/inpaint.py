"""Interior texture by inpainting slices: first along X, then X, Y and Z towards one volume.

Two-stage schedule after GaussianFluent. Slices inpainted independently flicker along their axis,
and averaging three such stacks destroys the texture; so every later pass starts from the fused
volume at low strength, and each axis hands its result to the next.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from gsfluent.errors import InputError

from ..stage import Progress, report_progress
from .diffusers_adapter import DiffusersInpainter, InpaintOptions
from .domain import InteriorDomain, InteriorTexture
from .photo import Exemplar
from .profile import depth_profile, match_colors, profile_volume, surface_profile

__all__ = ["InpaintOptions", "Inpainter", "SliceStore", "diffusion_texture", "inpaint_volume"]

logger = logging.getLogger(__name__)

Inpainter = Callable[..., np.ndarray]
"""``f(images, masks, *, prompt, strength, seeds) -> images``: see :class:`DiffusersInpainter`."""

_GROUND = 0.5  # neutral grey around the object, kept known so that the model sees the silhouette
_SHARE = 0.7  # of the new slices in the fused volume during refinement


class SliceStore:
    """Finished slices on disk, so that an interrupted run goes on where it stopped.

    Args:
        folder: Where to keep them; None keeps nothing.
        key: What the slices depend on; another key starts afresh.
    """

    def __init__(self, folder: Path | None, key: str) -> None:
        self.folder = folder
        self.loaded = 0
        if folder is None:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            marker = folder / "key.txt"
            if not marker.is_file() or marker.read_text() != key:
                stale = list(folder.glob("slice_*.npy"))
                for path in stale:
                    path.unlink()
                if stale:
                    logger.info("%s: settings changed, %d slices redone", folder, len(stale))
                self._write(marker, key.encode())
        except OSError as error:
            raise InputError(
                f"{folder}: slices cannot be kept here ({error})", mend="choose a writable folder"
            ) from error

    def _write(self, path: Path, content: bytes) -> None:
        temporary = path.with_suffix(".part")
        temporary.write_bytes(content)
        os.replace(temporary, path)

    def get(self, number: int, axis: int, index: int, shape: tuple[int, ...]) -> np.ndarray | None:
        """Slice ``index`` across ``axis`` of pass ``number``, if it was finished."""
        if self.folder is None:
            return None
        path = self.folder / f"slice_{number}_{axis}_{index:04d}.npy"
        if not path.is_file():
            return None
        try:
            image = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            return None  # cut off while writing: made again
        if image.shape != shape:
            return None
        self.loaded += 1
        return np.asarray(image, np.float32)

    def put(self, number: int, axis: int, index: int, image: np.ndarray) -> None:
        """Keep a finished slice."""
        if self.folder is None:
            return
        path = self.folder / f"slice_{number}_{axis}_{index:04d}.npy"
        temporary = path.with_suffix(".part.npy")
        np.save(temporary, image.astype(np.float32))
        os.replace(temporary, path)


def diffusion_texture(
    domain: InteriorDomain,
    model: str | Path,
    *,
    prompt: str,
    options: InpaintOptions,
    exemplar: Exemplar | None = None,
    resume: Path | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> InteriorTexture:
    """Texture by a diffusers inpainting pipeline.

    Args:
        domain: Voxels to fill.
        model: Local folder or hub id.
        prompt: What a slice shows, for example "cross section of a ripe watermelon".
        options: Settings.
        exemplar: Photograph whose depth profile starts the volume and whose colours the slices
            are brought back to.
        resume: Folder for finished slices.
        seed: Seed; every slice derives its own from it.
        progress: Optional callback.

    Returns:
        The texture; ``report`` holds slices, resumed_slices, model and axis_disagreement.

    Raises:
        InputError: The model cannot be loaded.
        RunError: The model fails; finished slices stay in ``resume``.
    """
    inpainter = DiffusersInpainter(model, options)
    digest = hashlib.sha256()
    for field in (domain.inside, domain.skin[domain.shell]):
        digest.update(np.ascontiguousarray(field).tobytes())
    if exemplar is not None:
        digest.update(np.ascontiguousarray(exemplar.image).tobytes())
    parts = [str(model), inpainter.size, prompt, seed, asdict(options), digest.hexdigest()]
    store = SliceStore(resume, json.dumps(parts, sort_keys=True))
    texture = inpaint_volume(
        domain,
        inpainter,
        prompt=prompt,
        options=options,
        exemplar=exemplar,
        store=store,
        seed=seed,
        progress=progress,
    )
    texture.report["model"] = str(model)
    texture.report["pipeline"] = inpainter.name
    return texture


def inpaint_volume(
    domain: InteriorDomain,
    inpainter: Inpainter,
    *,
    prompt: str,
    options: InpaintOptions,
    exemplar: Exemplar | None = None,
    store: SliceStore | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> InteriorTexture:
    """The two-stage loop around any inpainter; arguments as :func:`diffusion_texture`."""
    store = SliceStore(None, "") if store is None else store
    if exemplar is not None and exemplar.silhouette:
        position, color = depth_profile(exemplar)
        relative = domain.depth * exemplar.max_depth / max(domain.max_depth, 1e-6)
        volume = profile_volume(relative, position, color)
    else:
        volume = surface_profile(domain)
    volume = np.where(domain.shell[..., None], domain.skin, volume)
    passes = [(0, options.strength)]
    passes += [(axis, strength) for strength in options.refine for axis in range(3)]
    total = sum(len(_positions(domain, axis, options.slices)) for axis, _ in passes)
    done, change = 0, 0.0
    for number, (axis, strength) in enumerate(passes):
        positions = _positions(domain, axis, options.slices)
        made = []
        for index in positions:
            image = store.get(number, axis, index, np.take(volume, index, axis).shape)
            if image is None:
                image = _one_slice(
                    volume, domain, inpainter, axis, index, number, prompt, strength, seed
                )
                store.put(number, axis, index, image)
            made.append(image)
            done += 1
            report_progress(progress, done, total, f"slice {index} across {'xyz'[axis]}")
        stack = _interpolate(np.stack(made), positions, domain.inside.shape[axis])
        proposal = np.moveaxis(stack, 0, axis)
        hole = (domain.inside & ~domain.shell)[..., None]
        if number > 0:
            change = float(np.sqrt(((proposal - volume)[hole[..., 0]] ** 2).mean()))
            proposal = volume + _SHARE * (proposal - volume)
        volume = np.where(hole, proposal, volume).astype(np.float32)
        if exemplar is not None:
            volume = _to_exemplar(volume, domain, exemplar, seed + number)
    report = {
        "slices": total,
        "resumed_slices": store.loaded,
        "passes": len(passes),
        # how much the last axis still wanted to change: small when the axes agree
        "axis_disagreement": change,
    }
    return InteriorTexture(volume, np.zeros(domain.inside.shape, np.int32), report)


def _positions(domain: InteriorDomain, axis: int, count: int) -> list[int]:
    """Indices of the slices across an axis."""
    filled = np.flatnonzero(domain.inside.any(tuple(i for i in range(3) if i != axis)))
    number = min(count, len(filled))
    picked = np.linspace(filled[0], filled[-1], number).round().astype(int)
    return [int(p) for p in np.unique(picked)]


def _one_slice(
    volume: np.ndarray,
    domain: InteriorDomain,
    inpainter: Inpainter,
    axis: int,
    index: int,
    number: int,
    prompt: str,
    strength: float,
    seed: int,
) -> np.ndarray:
    """Inpaint one slice of the volume."""
    inside = np.take(domain.inside, index, axis)
    hole = inside & ~np.take(domain.shell, index, axis)
    image = np.where(inside[..., None], np.take(volume, index, axis), _GROUND)
    # the seed names the slice, not its place in a batch or in a resumed run
    own = int.from_bytes(hashlib.sha256(f"{seed}/{number}/{axis}/{index}".encode()).digest()[:6])
    made: np.ndarray = inpainter(
        image[None].astype(np.float32), hole[None], prompt=prompt, strength=strength, seeds=[own]
    )[0]
    return made


def _interpolate(slices: np.ndarray, positions: list[int], count: int) -> np.ndarray:
    """Linear interpolation of slices [K, ...] at ``positions`` to all 0..count-1."""
    place = np.arange(count)
    upper = np.searchsorted(positions, place).clip(1, max(len(positions) - 1, 1))
    lower = upper - 1
    upper = np.minimum(upper, len(positions) - 1)
    known = np.asarray(positions, dtype=float)
    gap = np.maximum(known[upper] - known[lower], 1e-9)
    t = np.clip((place - known[lower]) / gap, 0.0, 1.0)[:, None, None, None]
    mixed: np.ndarray = (1 - t) * slices[lower] + t * slices[upper]
    return mixed


def _to_exemplar(
    volume: np.ndarray, domain: InteriorDomain, exemplar: Exemplar, seed: int
) -> np.ndarray:
    """Bring the colours back to the exemplar's, within depth ranges when it has an outline."""
    inner = domain.inside & ~domain.shell
    if exemplar.silhouette:
        depth = domain.depth[inner] * exemplar.max_depth / max(domain.max_depth, 1e-6)
        own, bins = exemplar.depth[exemplar.mask], 8
    else:
        depth, own, bins = np.zeros(int(inner.sum())), np.zeros(int(exemplar.mask.sum())), 1
    result = volume.copy()
    result[inner] = match_colors(
        volume[inner],
        depth,
        exemplar.image[exemplar.mask],
        own,
        bins=bins,
        rng=np.random.default_rng(seed),
    )
    return result
