"""Interior texture by inpainting slices: first along X, then X, Y and Z towards one volume.

Two-stage schedule after GaussianFluent. Slices inpainted independently flicker along their axis,
and averaging three such stacks destroys the texture; so every later round starts from the fused
volume at low strength. With the schedule ``coupled`` the three axes work together from a quarter of
the resolution on, where they can still agree on where things are.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsfluent.errors import InputError
from gsfluent.pipeline.texture.inpaint.colors import initial_volume, match_slices, to_photo
from gsfluent.pipeline.texture.inpaint.command import CommandInpainter
from gsfluent.pipeline.texture.inpaint.inpainter import Inpainter, SliceContext, slice_seed
from gsfluent.pipeline.texture.inpaint.levels import (
    SliceStore,
    coarse_domain,
    enlarge,
    fuse_stacks,
    slice_positions,
)
from gsfluent.pipeline.texture.inpaint.local import (
    ColorDiffusionInpainter,
    ExemplarInpainter,
    TeleaInpainter,
)
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions
from gsfluent.pipeline.texture.inpaint.tiles import GROUND, TiledInpainter
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, one_per_axis
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture
from gsfluent.progress import Progress, report_progress

logger = logging.getLogger(__name__)

Photographs = Exemplar | Mapping[int, Exemplar | Sequence[Exemplar]] | None
"""One photograph, or one or several per axis (the first counts)."""


@dataclass(frozen=True)
class _Pass:
    """One pass: slices across ``axes``, all from the same volume, then fused."""

    factor: int
    axes: tuple[int, ...]
    strength: float
    first: bool = False


def diffusion_texture(
    domain: InteriorDomain,
    model: str | Path | None,
    *,
    prompt: str,
    options: InpaintOptions,
    exemplar: Photographs = None,
    resume: Path | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> InteriorTexture:
    """Texture by an inpainting backend (``options.backend``), diffusers by default.

    Args:
        domain: Voxels to fill.
        model: Local folder or hub id, for the backend diffusers.
        prompt: What a slice shows, for example "cross section of a ripe watermelon".
        options: Settings.
        exemplar: Photograph, or one per axis, whose depth profile starts the volume and whose
            colours the slices are brought back to.
        resume: Folder for finished slices.
        seed: Seed; every slice derives its own from it.
        progress: Optional callback.

    Returns:
        The texture; ``report`` holds slices, resumed_slices, passes, model, pipeline and
        axis_disagreement.

    Raises:
        InputError: The model cannot be loaded.
        RunError: The model fails; finished slices stay in ``resume``.
    """
    photos = one_per_axis(exemplar)
    inpainter = make_inpainter(options.backend, options, model, resume)
    coarse = inpainter
    if options.coarse and options.coarse != options.backend:
        coarse = make_inpainter(options.coarse, options, model, resume, first=inpainter)
    digest = hashlib.sha256()
    for field in (domain.inside, domain.depth, domain.skin[domain.shell]):
        digest.update(np.ascontiguousarray(field).tobytes())
    for photo in photos.values():
        digest.update(np.ascontiguousarray(photo.image).tobytes())
    # what changes speed and memory, but not the slices, does not start a run afresh
    settings = asdict(options)
    for name in ("batch", "memory", "allow_slow", "offline"):
        settings.pop(name)
    size = getattr(inpainter, "size", None)
    parts = [str(model), size, inpainter.name, prompt, seed, settings, digest.hexdigest()]
    store = SliceStore(resume, json.dumps(parts, sort_keys=True))
    texture = inpaint_volume(
        domain,
        inpainter,
        prompt=prompt,
        options=options,
        exemplar=photos,
        coarse=coarse,
        store=store,
        seed=seed,
        progress=progress,
    )
    texture.report["model"] = None if model is None else str(model)
    texture.report["pipeline"] = inpainter.name
    texture.report["model_calls"] = getattr(inpainter, "calls", None)
    return texture


def make_inpainter(
    name: str,
    options: InpaintOptions,
    model: str | Path | None = None,
    folder: Path | None = None,
    first: Inpainter | None = None,
) -> Inpainter:
    """Backend of a name (:data:`~.inpaint_options.BACKENDS`).

    ``folder`` is where a command's windows are kept, ``first`` who makes its first reference slice.

    Raises:
        InputError: The backend lacks what it needs.
    """
    if name == "telea":
        return TeleaInpainter()
    if name == "color":
        return ColorDiffusionInpainter()
    if name == "exemplar":
        return ExemplarInpainter()
    if name == "command":
        return CommandInpainter(
            options.command,
            window=options.window,
            overlap=min(options.overlap, options.window - 1),
            first=first,
            folder=None if folder is None else folder / "command",
        )
    if model is None:
        raise no_model("diffusion")
    from gsfluent.pipeline.texture.inpaint.diffusers import DiffusersInpainter

    return DiffusersInpainter(model, options)


def no_model(method: str) -> InputError:
    """What to raise when diffusers shall paint and no model is named."""
    return InputError(
        f"texture: method {method!r} needs a model",
        hint="give a local folder or hub id, for example "
        "diffusers/stable-diffusion-xl-1.0-inpainting-0.1 (about 7 GB)",
    )


def inpaint_plan(domain: InteriorDomain, options: InpaintOptions) -> dict[str, int]:
    """How much work a run is, before it starts.

    Returns:
        passes, slices, model_calls and denoising_steps (per picture times pictures).
    """
    slices = calls = steps = 0
    passes = _passes(domain, options)
    for step in passes:
        inside = coarse_domain(domain, step.factor).inside
        for axis in step.axes:
            count = len(slice_positions(inside, axis, options.slices))
            pictures = math.ceil(count / options.tile**2)
            real = max(options.steps, math.ceil(4 / min(step.strength, 0.99)))
            slices += count
            calls += math.ceil(pictures / options.batch)
            steps += pictures * max(1, int(real * min(step.strength, 0.99)))
    return {
        "passes": len(passes),
        "slices": slices,
        "model_calls": calls,
        "denoising_steps": steps,
    }


def inpaint_volume(
    domain: InteriorDomain,
    inpainter: Inpainter,
    *,
    prompt: str,
    options: InpaintOptions,
    exemplar: Photographs = None,
    coarse: Inpainter | None = None,
    store: SliceStore | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> InteriorTexture:
    """The two-stage loop around any inpainter; more arguments as for :func:`diffusion_texture`.

    Args:
        domain: Voxels to fill.
        inpainter: Backend.
        prompt: What a slice shows.
        options: Settings of the loop.
        exemplar: Photograph, or one per axis.
        coarse: Backend of the first pass; None takes ``inpainter``.
        store: Where finished slices are kept; they stay there when the backend fails.
        seed: Seed.
        progress: Optional callback.
    """
    store = SliceStore(None, "") if store is None else store
    photos, passes = one_per_axis(exemplar), _passes(domain, options)
    plan = inpaint_plan(domain, options)
    painters = (inpainter, coarse or inpainter)
    run = _Run(*painters, prompt, options, photos, store, seed, progress, plan["slices"])
    logger.info(
        "inpainting with %s: %d slices in %d passes, %d calls, %d denoising steps if it denoises",
        inpainter.name,
        plan["slices"],
        plan["passes"],
        plan["model_calls"],
        plan["denoising_steps"],
    )
    volume, level, disagreement = np.zeros((0, 0, 0, 3), np.float32), domain, 0.0
    for number, step in enumerate(passes):
        if number == 0 or step.factor != passes[number - 1].factor:
            level = coarse_domain(domain, step.factor)
            if number == 0:
                volume = initial_volume(level, run.photos.get(0))
            else:
                volume = enlarge(volume, level.inside.shape)
            volume = np.where(level.shell[..., None], level.skin, volume).astype(np.float32)
        volume, disagreement = run.one_pass(volume, level, step, number)
    report: dict[str, Any] = {
        "slices": run.total,
        "resumed_slices": store.loaded,
        "passes": len(passes),
        "schedule": options.schedule,
        "axis_disagreement": disagreement,
    }
    return InteriorTexture(volume, np.zeros(domain.inside.shape, np.int32), report)


def _passes(domain: InteriorDomain, options: InpaintOptions) -> list[_Pass]:
    everything = (0, 1, 2)
    if options.schedule == "paper":
        first = [_Pass(1, (0,), options.strength, first=True)]
        return first + [_Pass(1, everything, s) for s in options.refine]
    factors = [f for f in (4, 2, 1) if min(domain.inside.shape) // f >= 10] or [1]
    made = [_Pass(factors[0], everything, options.strength, first=True)]
    for factor in factors:
        made += [_Pass(factor, everything, s) for s in options.refine]
    return made


@dataclass
class _Run:
    """What stays the same over a run."""

    inpainter: Inpainter
    coarse: Inpainter
    prompt: str
    options: InpaintOptions
    photos: dict[int, Exemplar]
    store: SliceStore
    seed: int
    progress: Progress | None
    total: int
    done: int = 0
    made: int = 0
    spent: float = 0.0

    def one_pass(
        self, volume: np.ndarray, level: InteriorDomain, step: _Pass, number: int
    ) -> tuple[np.ndarray, float]:
        """Slices across the axes of a pass, all from one volume, fused."""
        hole = level.inside & ~level.shell
        stacks = []
        for axis in step.axes:
            positions = slice_positions(level.inside, axis, self.options.slices)
            images = self._stack(volume, level, step, number, axis, positions)
            if self.options.match_colors:
                images = match_slices(
                    images,
                    level,
                    axis,
                    positions,
                    self.photos.get(axis),
                    slice_seed(self.seed, number, axis, -1),
                )
            stacks.append((axis, positions, images))
        fused, variance = fuse_stacks(volume.shape[:3], stacks)
        volume = np.where(hole[..., None], fused, volume).astype(np.float32)
        if self.options.match_colors and 0 in self.photos and hole.any():
            # fusion takes contrast away; the volume gets the photograph's colours back
            volume[hole] = to_photo(
                volume[hole], level.depth[hole], level, self.photos[0], self.seed + number
            )
        return volume, float(np.sqrt(variance[hole].mean())) if hole.any() else 0.0

    def _stack(
        self,
        volume: np.ndarray,
        level: InteriorDomain,
        step: _Pass,
        number: int,
        axis: int,
        positions: list[int],
    ) -> np.ndarray:
        """Inpainted slices [K, ., ., 3] across one axis, in the order of ``positions``."""
        backend = self.coarse if step.first else self.inpainter
        group = self.options.tile**2
        if group > 1:
            backend = TiledInpainter(backend, self.options.tile)
        chunk = len(positions) if backend.sequential else group * self.options.batch
        # other neighbours share a canvas in every second pass
        shift = 0 if backend.sequential or number % 2 == 0 else group // 2
        order = positions[shift:] + positions[:shift]
        shape = np.take(volume, 0, axis).shape
        found: dict[int, np.ndarray] = {}
        for start in range(0, len(order), max(chunk, 1)):
            part = order[start : start + chunk]
            for index in part:
                kept = self.store.get(number, axis, index, shape)
                if kept is not None:
                    found[index] = kept
            if any(index not in found for index in part):
                began = time.perf_counter()
                inside, shell, depth, colors = (
                    _upright(np.moveaxis(np.take(field, part, axis), axis, 0))
                    for field in (level.inside, level.shell, level.depth, volume)
                )
                made = backend(
                    np.where(inside[..., None], colors, GROUND).astype(np.float32),
                    inside & ~shell,
                    prompt=self.prompt,
                    exemplar=self.photos.get(axis),
                    strength=step.strength,
                    seeds=[slice_seed(self.seed, number, axis, index) for index in part],
                    context=SliceContext(
                        axis, tuple(part), level.voxel, inside, depth, level.max_depth
                    ),
                )
                images = np.ascontiguousarray(np.swapaxes(made[:, ::-1], 1, 2))
                self._estimate(len(part), time.perf_counter() - began)
                for index, image in zip(part, images, strict=True):
                    found[index] = image
                    self.store.put(number, axis, index, image)
            self.done += len(part)
            report_progress(
                self.progress, self.done, self.total, f"slice {part[-1]} across {'xyz'[axis]}"
            )
        return np.stack([found[index] for index in positions])

    def _estimate(self, slices: int, seconds: float) -> None:
        """Say once, after the first call, how long the rest is going to take."""
        self.made += slices
        self.spent += seconds
        rest = (self.total - self.done - slices) * self.spent / self.made
        if self.made == slices and rest > 60.0:
            logger.warning(
                "texture: %d slices to go, about %.0f minutes (%.1f s per slice with %s)",
                self.total - self.done - slices,
                rest / 60.0,
                self.spent / self.made,
                self.inpainter.name,
            )


def _upright(slices: np.ndarray) -> np.ndarray:
    """Slices [B, U, V, ...] of a volume as pictures [B, H, W, ...] with V (z where it can) up.

    A model knows which way up a cake is, and so does a photograph of one.
    """
    return np.ascontiguousarray(np.swapaxes(slices, 1, 2)[:, ::-1])
