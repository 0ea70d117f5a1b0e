"""Texturing: how far an inside is from a known one, against the time it took.

Solids whose inside is known (:mod:`gsfluent.lab.truth.interiors`) are textured as a user would, and
judged on planes no method has seen. The error is the distance of patches from those of the truth in
units of the crudest answer's, the colours of the surface carried inwards: at 1 a method knows
as much as that. Another object of the class has an error too, and no method can claim to be better:
that is the band.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np
import torch

from gsfluent.lab.charts.quality import Job, Outcome
from gsfluent.lab.truth.interiors import KnownInterior, known_interior
from gsfluent.lab.truth.interiors_judge import Judge
from gsfluent.pipeline.texture import InteriorTexture, Texture, load_exemplar
from gsfluent.pipeline.texture.baselines import telea_slices
from gsfluent.pipeline.texture.photo.exemplar import load_exemplars
from gsfluent.pipeline.texture.photo.profile import depth_profile, profile_volume
from gsfluent.pipeline.texture.volume.domain import blend_skin

XLABEL = "seconds"
YLABEL = "distance of patches over that of the surface's colours"
METHODS = ("color_copy", "telea", "profile", "preview", "default", "full")
"""Not procedural: its recipes are those that the truths are drawn from."""
WORST = "color_copy"


def texture(known: KnownInterior, method: str, device: str, model: str | None) -> dict[str, Any]:
    """Run one method: its volume and report, CPU seconds and wall seconds.

    The steps of ``Texture.forward``, with the true colours of the surface in place of those read
    off splats, so that the texture is judged and not the reconstruction.
    """
    photos = known.exemplars()
    began, wall = time.process_time(), time.perf_counter()
    if method == "telea_x":
        made = telea_slices(known.domain, (0,))
    elif method == "photo_profile":
        photo = load_exemplar(next(iter(photos.values())))
        # photographs of known interiors have one pixel per voxel: depths are equal
        rgb = profile_volume(known.domain.depth, *depth_profile(photo))
        made = InteriorTexture(rgb, known.labels, {})
    else:
        chosen = stage(known, method, photos, model, device)
        shown = chosen.exemplar
        opened = None if shown is None else load_exemplars(shown, chosen.photo)
        made = chosen.make(known.domain, opened, torch.device(device))
        if device != "cpu":
            torch.cuda.synchronize()
    rgb = blend_skin(known.domain, made.rgb.clip(0.0, 1.0))
    cpu, spent = time.process_time() - began, time.perf_counter() - wall
    return {"rgb": rgb, "used": used(made.report), "cpu_seconds": cpu, "seconds": spent}


def stage(
    known: KnownInterior, method: str, photos: dict[str, np.ndarray], model: str | None, device: str
) -> Texture:
    """The texture stage as a user would set it for this class."""
    if method == "procedural":
        # another seed than the truth's: another object in the same skin
        return Texture(preset=known.name, seed=known.seed + 1000)
    if method in ("color_copy", "telea", "profile"):
        return Texture(method)
    if method == "diffusion":
        prompt = f"cross section of {known.name}"
        return Texture("diffusion", model=model, exemplar=photos, prompt=prompt)
    effort: dict[str, Any] = {} if method == "default" else {"quality": method}
    return Texture(exemplar=photos, device=device, **effort, **known.settings)


def used(report: dict[str, Any]) -> str:
    """What the exemplar method made of the surface; empty for the other methods."""
    surface = report.get("surface")
    if surface == "copy":
        return "color_copy"
    return "" if surface is None else "exemplar" + " from the surface" * (surface == "keep")


class _Case:
    """One known inside; it and its judge are made when first asked for."""

    def __init__(self, name: str, size: int, draws: int, device: torch.device) -> None:
        self.name, self.size, self.draws, self.device = name, size, draws, device

    @functools.cached_property
    def judge(self) -> Judge:
        drawn = [known_interior(self.name, self.size, seed) for seed in range(1 + self.draws)]
        return Judge(drawn[0], drawn[1:])

    @functools.cached_property
    def worst(self) -> float:
        """Distance of the crudest answer."""
        made = texture(self.judge.known, WORST, str(self.device), None)
        return float(self.judge(made["rgb"])["patch"])

    def __call__(self, repeat: int, method: str) -> Outcome:
        del repeat  # minutes in all; the same seed gives the same inside
        made = texture(self.judge.known, method, str(self.device), None)
        figures = self.judge(made["rgb"])
        return Outcome(
            float(figures["patch"]) / self.worst, [made["seconds"]],
            int(self.judge.known.domain.inside.sum()),
            {"patch": float(figures["patch"]), "over another object's": figures["ratio"]["patch"],
             "profile": float(figures["profile"]), "sharpness": float(figures["sharp"])},
            band=float(self.judge.floor["patch"]) / self.worst,
            settings={"used": made["used"] or method},
        )  # fmt: skip


def jobs(*, device: torch.device, quick: bool = False) -> list[Job]:
    """The ladder: methods and efforts, on two classes and two sizes."""
    rows: list[tuple[str, int, tuple[str, ...]]]
    if quick:
        rows = [("cake", 32, ("color_copy", "profile", "preview"))]
    else:
        rows = [(name, size, METHODS) for name in ("orange", "cake") for size in (48, 64)]
    found = []
    for name, size, methods in rows:
        case = _Case(name, size, 1 if quick else 2, device)
        for method in methods:
            settings = {"voxels": size, "method": method}
            work = functools.partial(case, method=method)
            found.append(Job(f"{name}, {size} voxels", method, settings, work))
    return found
