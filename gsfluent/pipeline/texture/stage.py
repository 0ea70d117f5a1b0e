"""Texture: colours for the inside of a solid."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent import materials
from gsfluent.data import INTERIOR, Capture, Solid
from gsfluent.data.regions import with_inclusions
from gsfluent.errors import InputError, check_choice
from gsfluent.geometry import rgb_to_sh0
from gsfluent.pipeline.stage import Stage
from gsfluent.pipeline.texture.baselines import color_copy, telea_slices
from gsfluent.pipeline.texture.inpaint.method import diffusion_texture, no_model
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions
from gsfluent.pipeline.texture.photo.exemplar import (
    Exemplars,
    PhotoOptions,
    each,
    load_exemplars,
    one_per_axis,
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
from gsfluent.pipeline.texture.polish import polish_colors
from gsfluent.pipeline.texture.presets.by_material import PLAIN, inside_of
from gsfluent.pipeline.texture.presets.procedural import check_preset, procedural_texture
from gsfluent.pipeline.texture.structure import take_apart, with_structure
from gsfluent.pipeline.texture.sweep import CUTS
from gsfluent.pipeline.texture.synthesis.method import SynthesisOptions, exemplar_texture
from gsfluent.pipeline.texture.unseen_skin import mend_unseen_skin
from gsfluent.pipeline.texture.volume.domain import (
    InteriorDomain,
    InteriorTexture,
    blend_skin,
    options_of,
)
from gsfluent.progress import Progress, report_progress

logger = logging.getLogger(__name__)

BASELINES = ("color_copy", "telea")
METHODS = ("auto", "exemplar", "procedural", "diffusion", "inpaint", "profile", *BASELINES)


class Texture(Stage):
    """Give the inside of a solid its colours.

    The result is a volume: any cut through it is consistent, and material points, transition
    splats and interior Gaussians all sample the same field.

    Methods:
        ``exemplar``: guided patch synthesis from photographs of a cut object (the default when an
        exemplar is given); ``procedural``: a preset; ``diffusion``: slices inpainted by a diffusers
        pipeline; ``inpaint``: slices inpainted by another backend (``inpaint={"backend": ...}``,
        :class:`.inpaint_options.InpaintOptions`); ``profile``, ``color_copy`` and ``telea``:
        the skin's colours carried inward, baselines for comparison. With nothing given: the preset
        of the material, or of plain matter in the skin's colour, which the log says.

    Args:
        method: One of the above, or ``auto``.
        exemplar: Photograph of the inside (path or array), a list of them, or one or a list per
            axis ``{x: ..., z: ...}``.
        preset: Name of a procedural preset.
        material: Name of the material preset, which chooses the inside when nothing else does.
        prompt: Text for the diffusion model.
        model: Local folder or hub id of an inpainting pipeline.
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
        device: Where the exemplar method computes; None: where the solid is.
        seed: Seed of everything random.
        synthesis: Settings of the exemplar method, the fields of
            :class:`~.synthesis.method.SynthesisOptions`.

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
        material: str | None = None,
        prompt: str = "",
        model: str | Path | None = None,
        axis: tuple[float, float, float] | None = None,
        cut: str | None = None,
        photo: PhotoOptions | Mapping[str, Any] | None = None,
        inpaint: InpaintOptions | Mapping[str, Any] | None = None,
        resume: str | Path | None = None,
        polish: bool = False,
        device: str | torch.device | None = None,
        seed: int = 0,
        **synthesis: Any,
    ) -> None:
        super().__init__(seed=seed)
        check_choice("texture: method", method, METHODS, "leave it at auto")
        self.synthesis = SynthesisOptions(**synthesis)
        if method == "auto":
            method = "procedural" if exemplar is None else "exemplar"
            if method == "procedural" and preset is None:
                preset = PLAIN if material is None else inside_of(materials.get(material).name)
                logger.info(
                    "texture: neither exemplar nor preset given; %s gets the inside %r; "
                    "texture: {exemplar: cut.jpg} or {preset: NAME} is what it really has",
                    material or "the object",
                    preset,
                )
        if method == "exemplar" and exemplar is None:
            raise InputError(
                "texture: method 'exemplar' needs an exemplar photograph",
                hint="add exemplar: cut.jpg, or use method: procedural with a preset",
            )
        if method == "procedural":
            preset = preset or prompt
            check_preset(preset)
        self.inpaint = options_of(InpaintOptions, "inpaint", inpaint)
        slices = method in ("diffusion", "inpaint")
        if slices and "diffusers" in (self.inpaint.backend, self.inpaint.coarse) and model is None:
            raise no_model(method)
        if cut is not None:
            hint = "leave it out when the structure does not follow the object's axis"
            check_choice("texture: cut", cut, CUTS, hint)
        self.method, self.exemplar, self.preset, self.cut = method, exemplar, preset, cut
        self.prompt, self.model = prompt, model
        self.axis = None if axis is None else np.asarray(axis, dtype=float)
        self.photo = options_of(PhotoOptions, "photo", photo)
        self.resume = None if resume is None else Path(resume)
        self.polish = bool(polish)
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
        with ThreadPoolExecutor(1) as pool:  # photographs are read beside the look at the solid
            loading = None
            if self.exemplar is not None:
                loading = pool.submit(load_exemplars, self.exemplar, self.photo)
            domain = InteriorDomain.from_solid(solid, self.axis)
            domain, mended = mend_unseen_skin(domain, solid.report.get("closed_side"))
        exemplars, shown, structure = None, None, None
        if loading is not None:
            exemplars = loading.result()
            if self.photo.white == "skin":
                skin = domain.skin[domain.shell]
                exemplars = each(exemplars, lambda photo: with_skin(photo, skin))
            shown = exemplars
            if self.cut is not None:
                exemplars, structure = take_apart(exemplars)
        if not domain.inside.any():
            raise InputError("texture: the solid is empty", hint="run fill first")
        device = solid.occupancy.device
        texture = self.make(domain, exemplars, device, progress)
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
        regions, table = with_inclusions(solid, texture.labels)
        report_progress(progress, 1, 1, "textured")
        return replace(
            solid,
            gaussians=colored,
            color=torch.from_numpy(rgb).to(device, solid.depth.dtype),
            regions=regions,
            report={**report, **table, "fill": solid.report},
        )

    def make(
        self,
        domain: InteriorDomain,
        exemplars: Exemplars | None,
        device: torch.device,
        progress: Progress | None = None,
    ) -> InteriorTexture:
        """Run the chosen method in voxels; ``device`` is where the solid is."""
        if self.method == "exemplar" and exemplars is not None:
            return exemplar_texture(
                domain,
                exemplars,
                self.synthesis,
                device=self.device or device,
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
            return diffusion_texture(
                domain,
                self.model,
                prompt=self.prompt,
                options=self.inpaint,
                exemplar=exemplars,
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
        exemplars: Exemplars | None,
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
            photo = one_per_axis(exemplars)[0]
            if "photo_pitch" in texture.report:
                factor = texture.report["photo_pitch"] / self.synthesis.scale
            elif photo.silhouette:
                factor = domain.max_depth / max(photo.max_depth, 1.0)
            else:
                factor = max(domain.inside.shape) / max(photo.mask.shape)
            fitted = photo.resized(self.synthesis.scale * factor)
            slices = volume_slices(texture.rgb, domain.inside)
            report["patch_distance"] = patch_distance(slices, [(fitted.image, fitted.mask)])
            interior = texture.rgb[domain.inside]
            report["color_distance"] = lab_histogram_distance(interior, photo.image[photo.mask])
            if photo.silhouette:
                report["depth_profile_error"] = depth_profile_error(domain, texture.rgb, photo)
        return report


def _color_interior(
    solid: Solid, texture: InteriorTexture, domain: InteriorDomain, polish: bool = False
) -> tuple[Any, dict[str, Any]]:
    """Gaussians whose INTERIOR rows wear the volume's colour, all others the same; a report."""
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
        device = solid.occupancy.device
        color, report["polish"] = polish_colors(domain, texture.rgb, place, color, device=device)
    sh = gaussians.sh.clone()
    sh[chosen] = 0.0
    sh[chosen, 0] = rgb_to_sh0(torch.from_numpy(color).to(sh))
    return gaussians.replace(sh=sh), report
