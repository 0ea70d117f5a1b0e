"""Texture: colours for the inside of a solid."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gsfluent.data.regions import with_inclusions
from gsfluent.errors import InputError
from gsfluent.pipeline.stage import Stage
from gsfluent.pipeline.texture.baselines import color_copy, telea_slices
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions
from gsfluent.pipeline.texture.photo.exemplar import (
    Exemplar,
    PhotoOptions,
    open_exemplars,
    with_skin,
)
from gsfluent.pipeline.texture.photo.metrics import (
    depth_profile_error,
    lab_histogram_distance,
    neighbour_slice_ratio,
    patch_distance,
    volume_slices,
)
from gsfluent.pipeline.texture.photo.profile import surface_profile
from gsfluent.pipeline.texture.presets.procedural import PRESETS, preset_names, procedural_texture
from gsfluent.pipeline.texture.structure import take_apart, with_structure
from gsfluent.pipeline.texture.sweep import CUTS
from gsfluent.pipeline.texture.synthesis.method import QUALITIES, exemplar_texture, load_exemplars
from gsfluent.pipeline.texture.unseen_skin import mend_unseen_skin
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture, blend_skin
from gsfluent.progress import Progress, report_progress

if TYPE_CHECKING:
    from gsfluent.data import Capture, Solid

logger = logging.getLogger(__name__)

METHODS = (
    "auto",
    "exemplar",
    "procedural",
    "diffusion",
    "inpaint",
    "profile",
    "color_copy",
    "telea",
)


class Texture(Stage):
    """Give the inside of a solid its colours.

    The result is a volume: any cut through it is consistent, and material points, transition
    splats and interior Gaussians all sample the same field.

    Methods:
        ``exemplar``: guided patch synthesis from photographs of a cut object (the default when an
        exemplar is given); ``procedural``: a preset; ``diffusion``: slices inpainted by a diffusers
        pipeline; ``inpaint``: slices inpainted by another backend (``inpaint={"backend": ...}``,
        :class:`.inpaint_options.InpaintOptions`); ``profile``: surface colour fading to its mean
        (the default with nothing given, with a warning); ``color_copy`` and ``telea``: baselines
        for comparison.

    Args:
        method: One of the above, or ``auto``.
        exemplar: Photograph of the inside (path or array), a list of them, or one or a list per
            axis ``{x: ..., z: ...}``.
        preset: Name of a procedural preset.
        prompt: Text for the diffusion model.
        model: Local folder or hub id of an inpainting pipeline.
        quality: ``preview``, ``fast`` or ``full`` (exemplar method).
        scale: Size of the exemplar's structure relative to the automatic choice.
        guide: What the structure follows: ``auto``, ``depth``, ``axis`` (a cut across the object's
            axis shows what goes on along it), ``height`` (layers along the axis) or ``none``
            (exemplar method).
        directional: True for grained materials: the exemplar is not turned or mirrored.
        inclusions: Detect seeds and stones in the exemplar and place them as labelled parts.
        axis: The object's own axis in world coordinates; None takes scene "up", else +z.
        cut: ``across`` or ``along`` when the (first) photograph was cut across the object's axis or
            through it: structure seen in one place only (an apple's star, segments) is then swept
            about the axis instead of being spread as material (:mod:`.structure`). None: it is
            material like the rest.
        photo: What is done to photographs before their material is used (:class:`PhotoOptions`,
            or its settings as a mapping); None for the defaults.
        inpaint: Settings of the slice methods, or a mapping of them.
        resume: Folder in which the diffusion method keeps finished slices.
        polish: Fit the colours of interior Gaussians that are coarser than the voxels to slices
            of the volume, instead of sampling it at their centres (:mod:`.polish`).
        parts: Label image or mask (file or array) that shows the inclusions of the first
            photograph, or their colour; None finds them (exemplar method).
        depth_scale: Depth of the photograph's deepest point in units of the object's largest depth;
            None works it out (exemplar method).
        surface: What the surface's colours are to the inside: ``auto``, ``keep``, ``copy`` or
            ``ignore`` (exemplar method, :func:`.exemplar.exemplar_texture`).
        core: ``open`` or ``closed``: whether a core seen in a cut across the axis goes on from
            pole to pole (guide ``axis``).
        device: Where the exemplar method computes; ``auto`` takes a CUDA device when there is one.
        seed: Seed of everything random.

    Raises:
        InputError: Unknown method or quality, or a method without what it needs.
    """

    name = "texture"

    def __init__(
        self,
        method: str = "auto",
        *,
        exemplar: object = None,
        preset: str | None = None,
        prompt: str = "",
        model: str | Path | None = None,
        quality: str = "fast",
        scale: float = 1.0,
        guide: str = "auto",
        directional: bool = False,
        inclusions: bool = True,
        axis: tuple[float, float, float] | None = None,
        cut: str | None = None,
        photo: PhotoOptions | Mapping[str, Any] | None = None,
        inpaint: InpaintOptions | Mapping[str, Any] | None = None,
        resume: str | Path | None = None,
        polish: bool = False,
        parts: object = None,
        depth_scale: float | None = None,
        surface: str = "auto",
        core: str = "open",
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        if method not in METHODS:
            raise InputError(
                f"texture: method must be one of {', '.join(METHODS)}, got {method!r}",
                hint="leave it at auto",
            )
        if quality not in QUALITIES:
            raise InputError(
                f"texture: quality must be one of {', '.join(QUALITIES)}, got {quality!r}",
                hint="leave it at fast",
            )
        if method == "auto":
            method = "exemplar" if exemplar is not None else "procedural" if preset else "profile"
            if method == "profile":
                logger.warning(
                    "texture: neither exemplar nor preset given; the inside gets the mean surface "
                    "colour. Give a photograph of a cut object (exemplar) or a preset (%s)",
                    ", ".join(preset_names()),
                )
        if method == "exemplar" and exemplar is None:
            raise InputError(
                "texture: method 'exemplar' needs an exemplar photograph",
                hint="add exemplar: cut.jpg, or use method: procedural with a preset",
            )
        if method == "procedural":
            preset = preset or prompt
            if preset not in PRESETS:
                raise InputError(
                    f"texture: preset must be one of {', '.join(preset_names())}, got {preset!r}",
                    hint="choose one of these or give an exemplar photograph",
                )
        options = InpaintOptions.of(inpaint)
        slices = method in ("diffusion", "inpaint")
        if slices and "diffusers" in (options.backend, options.coarse) and model is None:
            raise InputError(
                f"texture: method {method!r} needs a model",
                hint="give a local folder or hub id, for example "
                "diffusers/stable-diffusion-xl-1.0-inpainting-0.1 (about 7 GB)",
            )
        self.method = method
        self.exemplar = exemplar
        self.preset = preset
        self.prompt = prompt
        self.model = model
        self.quality = quality
        self.scale = float(scale)
        self.guide = guide
        self.directional = directional
        self.inclusions = inclusions
        self.axis = None if axis is None else np.asarray(axis, dtype=float)
        if cut is not None and cut not in CUTS:
            raise InputError(
                f"texture: cut must be one of {', '.join(CUTS)}, got {cut!r}",
                hint="leave it out when the structure does not follow the object's axis",
            )
        self.cut = cut
        self.photo = PhotoOptions.of(photo)
        self.inpaint = options
        self.resume = None if resume is None else Path(resume)
        self.polish = bool(polish)
        self.parts = parts
        self.depth_scale = depth_scale
        self.surface = surface
        self.core = core
        self.device = device

    def forward(
        self,
        solid: Solid,
        capture: Capture | None = None,
        progress: Progress | None = None,
    ) -> Solid:
        """Texture a solid.

        Args:
            solid: A filled solid.
            capture: Not used by the present methods; the surface colours come from the splats.
            progress: Optional callback ``(done, total, note)``.

        Returns:
            The solid with ``color``, ``regions`` (inclusions, numbered from 1, where found) and
            coloured interior Gaussians; surface Gaussians are untouched. ``report``
            holds method, slices, patch_distance, axis_consistency and more.

        Raises:
            InputError: The exemplar, preset or model cannot be used.
        """
        began = time.perf_counter()
        domain = InteriorDomain.from_solid(solid, self.axis)
        domain, mended = mend_unseen_skin(domain, solid.report.get("closed_side"))
        exemplars, shown, structure = None, None, None
        if self.exemplar is not None:
            opened = open_exemplars(self.exemplar, self.photo)
            if self.photo.white == "skin":
                opened = with_skin(opened, domain.skin[domain.shell])
            exemplars = shown = load_exemplars(opened)
            if self.cut is not None:
                opened, structure = take_apart(opened)
                exemplars = load_exemplars(opened)
        if not domain.inside.any():
            raise InputError("texture: the solid is empty", hint="run fill first")
        texture = self._make(domain, exemplars, progress)
        if structure is not None:
            texture = with_structure(domain, texture, structure, self.cut or CUTS[0])
        rgb = blend_skin(domain, texture.rgb.clip(0.0, 1.0))
        colored, polished = _color_interior(solid, replace(texture, rgb=rgb), domain, self.polish)
        # brings the compiled renderer with it, which texturing itself does without
        from gsfluent.pipeline.solid.colors import keep_skin

        colored = keep_skin(solid, colored)
        report = self._report(domain, texture, shown) | polished
        report["skin_mended"] = mended
        report["seconds"] = time.perf_counter() - began
        device = solid.occupancy.device
        regions, table = with_inclusions(solid, texture.labels)
        report_progress(progress, 1, 1, "textured")
        return replace(
            solid,
            gaussians=colored,
            color=torch.from_numpy(rgb).to(device, solid.depth.dtype),
            regions=regions,
            report={**report, **table, "fill": solid.report},
        )

    def _make(
        self,
        domain: InteriorDomain,
        exemplars: dict[int, list[Exemplar]] | None,
        progress: Progress | None,
    ) -> InteriorTexture:
        """Run the chosen method."""
        if self.method == "exemplar" and exemplars is not None:
            return exemplar_texture(
                domain,
                exemplars,
                quality=self.quality,
                scale=self.scale,
                guide=self.guide,
                directional=self.directional,
                inclusions=self.inclusions,
                parts=self.parts,
                depth_scale=self.depth_scale,
                surface=self.surface,
                core=self.core,
                device=self.device,
                seed=self.seed,
                progress=progress,
            )
        if self.method == "procedural" and self.preset is not None:
            return procedural_texture(domain, self.preset, self.seed)
        if self.method == "color_copy":
            return color_copy(domain)
        if self.method == "telea":
            return telea_slices(domain)
        if self.method in ("diffusion", "inpaint"):
            from gsfluent.pipeline.texture.inpaint.method import diffusion_texture

            return diffusion_texture(
                domain,
                self.model,
                prompt=self.prompt,
                options=self.inpaint,
                exemplar=None if exemplars is None else _one_per_axis(exemplars),
                resume=self.resume,
                seed=self.seed,
                progress=progress,
            )
        labels = np.zeros(domain.inside.shape, np.int32)
        return InteriorTexture(surface_profile(domain), labels, {})

    def _report(
        self,
        domain: InteriorDomain,
        texture: InteriorTexture,
        exemplars: dict[int, list[Exemplar]] | None,
    ) -> dict[str, Any]:
        """Figures for ``run.json``; distances are to the exemplar and null without one."""
        ratios = neighbour_slice_ratio(texture.rgb, domain.inside)
        report: dict[str, Any] = {
            "method": self.method,
            "slices": 0,
            "patch_distance": None,
            # change across an axis over the change across the others: 1 is like a real solid
            "axis_consistency": max(ratios),
            "neighbour_slice_ratio": ratios,
            **texture.report,
        }
        if exemplars is not None:
            photo = _one_per_axis(exemplars)[0]
            if "photo_pitch" in texture.report:
                factor = texture.report["photo_pitch"] / self.scale
            elif photo.silhouette:
                factor = domain.max_depth / max(photo.max_depth, 1.0)
            else:
                factor = max(domain.inside.shape) / max(photo.mask.shape)
            fitted = photo.resized(self.scale * factor)
            slices = volume_slices(texture.rgb, domain.inside)
            report["patch_distance"] = patch_distance(slices, [(fitted.image, fitted.mask)])
            interior = texture.rgb[domain.inside]
            report["color_distance"] = lab_histogram_distance(interior, photo.image[photo.mask])
            if photo.silhouette:
                report["depth_profile_error"] = depth_profile_error(domain, texture.rgb, photo)
        return report


def _one_per_axis(exemplars: dict[int, list[Exemplar]]) -> dict[int, Exemplar]:
    """The first photograph of every axis; axes without one share the first of all."""
    first = next(iter(exemplars.values()))
    return {axis: exemplars.get(axis, first)[0] for axis in range(3)}


def _color_interior(
    solid: Solid, texture: InteriorTexture, domain: InteriorDomain, polish: bool = False
) -> tuple[Any, dict[str, Any]]:
    """Gaussians whose INTERIOR rows wear the volume's colour, all others the same; a report."""
    from gsfluent.data import INTERIOR
    from gsfluent.geometry import rgb_to_sh0

    gaussians = solid.gaussians
    if gaussians.labels is None:
        return gaussians, {}
    chosen = gaussians.labels == INTERIOR
    if not bool(chosen.any()):
        return gaussians, {}
    means = gaussians.means[chosen].detach().double().cpu().numpy()
    place = (means - domain.origin) / domain.voxel
    color = texture.sample(place, domain.inside)
    report: dict[str, Any] = {}
    if polish:
        from gsfluent.pipeline.texture.polish import polish_colors

        color, figures = polish_colors(
            domain, texture.rgb, place, color, device=solid.occupancy.device
        )
        report = {"polish": figures}
    sh = gaussians.sh.clone()
    sh[chosen] = 0.0
    sh[chosen, 0] = rgb_to_sh0(torch.from_numpy(color).to(sh))
    return gaussians.replace(sh=sh), report
