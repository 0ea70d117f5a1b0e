"""Held-out quality of a reconstruction."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import BACKGROUND, Camera, Capture, Gaussians
from gsfluent.data.capture import View
from gsfluent.draw import draw
from gsfluent.io import save_image
from gsfluent.io.atomic import write_json
from gsfluent.metrics import psnr, ssim
from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.reconstruct.density import ends
from gsfluent.pipeline.reconstruct.masks import silhouette

HOLD_OUT = 8
"""Every eighth photograph judges, the others teach."""


@torch.no_grad()
def render_view(gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Render Gaussians as a camera sees them, before black: image [H, W, 3] and alpha [H, W]."""
    result = draw(gaussians, camera)
    return result.image, result.alpha


class Judged(NamedTuple):
    """A held-out photograph and the render that is compared with it."""

    image: Tensor  # the render, [H, W, 3] in [0, 1], on the CPU; before white when there is a mask
    target: Tensor  # the photograph, likewise
    valid: Tensor | None  # 1 where the photograph covers the pixel, [H, W]; None when everywhere


def judged(gaussians: Gaussians, view: View) -> Judged:
    """Render what a photograph shows, as :func:`evaluate` compares it."""
    image, alpha = (value.cpu() for value in render_view(gaussians, view.camera))
    target = view.image
    if view.mask is not None:
        mask = view.mask[..., None]
        target = target * mask + (1.0 - mask)
        image = image + (1.0 - alpha[..., None])
    valid = None if view.valid is None else view.valid.float()
    return Judged(image.clamp(0.0, 1.0), target, valid)


def evaluate(gaussians: Gaussians, held_out: Capture | None, max_size: int) -> dict[str, Any]:
    """PSNR and SSIM on photographs that were not trained on.

    With masks the whole image is compared before white (object times mask plus white), and
    ``psnr_inside`` looks only at pixels inside the mask. Without masks the whole photograph is
    compared, and ``psnr_inside`` looks at the silhouette of the splats not labelled ``BACKGROUND``
    (when some are): the object as found, since nobody said where it is.

    Args:
        gaussians: What to judge.
        held_out: Photographs to judge by, or None.
        max_size: Longer side of the images [px].

    Returns:
        ``psnr``, ``ssim`` (means over the images, None without any), ``psnr_inside`` (None when
        nothing tells the object), ``psnr_region`` ("whole image before white" or "whole image"),
        ``psnr_views``.
    """
    if held_out is None:
        return {"psnr": None, "ssim": None, "psnr_inside": None, "psnr_region": "none held out"}
    whole, inside, similar, masked = [], [], [], False
    found = rest = None
    if gaussians.labels is not None and bool((gaussians.labels == BACKGROUND).any()):
        found = gaussians.select(gaussians.labels != BACKGROUND)
        rest = gaussians.select(gaussians.labels == BACKGROUND)
    for index in range(len(held_out)):
        view = held_out.view(index, max_size)
        image, target, valid = judged(gaussians, view)
        masked |= view.mask is not None
        whole.append(psnr(image, target, valid))
        shut = 1.0 if valid is None else valid[..., None]
        similar.append(float(ssim(image * shut, target * shut)))
        shown = view.mask
        if shown is None and found is not None and rest is not None:
            camera = view.camera
            shown = silhouette(
                found, rest, camera.viewmat, camera.K, camera.width, camera.height
            ).cpu()
        if shown is not None:
            region = (shown > 0.5).float() * (1.0 if valid is None else valid)
            if float(region.sum()) > 0:
                inside.append(psnr(image, target, region))
    return {
        "psnr": round(sum(whole) / len(whole), 3),
        "ssim": round(sum(similar) / len(similar), 4),
        "psnr_inside": round(sum(inside) / len(inside), 3) if inside else None,
        "psnr_region": "whole image before white" if masked else "whole image",
        "psnr_views": [round(value, 2) for value in whole],
    }


_STICKS = 0.01  # of the object's size
_NEEDLE = 8.0  # axis ratio


@torch.no_grad()
def hair(gaussians: Gaussians, hull: Hull) -> dict[str, int]:
    """Count what sticks out of an object: an axis that ends over 1 % of its size beyond the hull.

    An axis ends for the eye where the opacity has fallen to 0.02 (:func:`ends`); the size is the
    longest side of the hull.

    Args:
        gaussians: The object.
        hull: Where it can be.

    Returns:
        ``sticking_out`` (all of them), ``needles`` (of these, longest over middle axis above 8) and
        ``slivers`` (longest over shortest above 8: needles and thin discs).
    """
    low, high = hull.bounds()
    tips = ends(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    away = hull.beyond(tips.reshape(-1, 3)).reshape(-1, 6).amax(1)
    out = away > _STICKS * float((high - low).max())
    axes = gaussians.scales.sort(dim=1).values
    return {
        "sticking_out": int(out.sum()),
        "needles": int((out & (axes[:, 2] > _NEEDLE * axes[:, 1])).sum()),
        "slivers": int((out & (axes[:, 2] > _NEEDLE * axes[:, 0])).sum()),
    }


_MOST_ROWS = 8
_ERROR_GAIN = 4.0  # the error panel shows four times the error, grey
_GAP = 4  # pixels between panels


def write_report(folder: str | Path, gaussians: Gaussians, capture: Capture) -> list[Path]:
    """Write ``reconstruct.json``, ``.md`` and, when photographs were held out, ``.png``.

    The picture has a row per held-out photograph: as photographed, as rendered, and four times the
    absolute error (mean of the channels).

    Args:
        folder: Where to; made when missing.
        gaussians: The result; its ``report`` is what stands in the file.
        capture: What it was made from.

    Returns:
        The files written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "reconstruct.json", folder / "reconstruct.md"]
    write_json(files[0], gaussians.report)
    files[1].write_text(markdown(gaussians.report), encoding="utf-8")
    held = capture.split(HOLD_OUT)[1]
    if held is not None:
        files.append(folder / "reconstruct.png")
        save_image(sheet(gaussians, held, int(gaussians.report["image_size"])), files[-1])
    return files


def sheet(gaussians: Gaussians, held_out: Capture, max_size: int) -> Tensor:
    """Truth, render and error side by side, a row per photograph (at most eight), [H, W, 3]."""
    total = len(held_out)
    chosen = np.unique(np.linspace(0, total - 1, min(_MOST_ROWS, total)).round().astype(int))
    rows = []
    for index in chosen.tolist():
        pair = judged(gaussians, held_out.view(index, max_size))
        error = (pair.image - pair.target).abs().mean(-1, keepdim=True) * _ERROR_GAIN
        shut = 1.0 if pair.valid is None else pair.valid[..., None]
        panels = [pair.target, pair.image, (error * shut).clamp_max(1.0).expand(-1, -1, 3)]
        rows.append(_beside(panels, 1))
    return _beside(rows, 0)


def _beside(panels: list[Tensor], axis: int) -> Tensor:
    """Panels in a line with white gaps; shorter ones are padded with white."""
    other = 1 - axis
    longest = max(panel.shape[other] for panel in panels)
    parts: list[Tensor] = []
    for number, panel in enumerate(panels):
        shape = list(panel.shape)
        shape[other] = longest - panel.shape[other]
        full = torch.cat([panel, torch.ones(shape)], other)
        if number:
            shape = list(full.shape)
            shape[axis] = _GAP
            parts.append(torch.ones(shape))
        parts.append(full)
    return torch.cat(parts, axis)


def markdown(report: dict[str, Any]) -> str:
    """The figures as a page."""
    names = (
        "psnr", "ssim", "psnr_inside", "psnr_region", "held_out", "images", "gaussians",
        "object_gaussians", "iterations", "image_size", "recipe", "densify", "target_psnr",
        "exposure", "start", "train_seconds", "seconds",
    )  # fmt: skip
    lines = ["# Reconstruction", "", "| figure | value |", "| --- | --- |"]
    lines += [f"| {name} | {report[name]} |" for name in names if report.get(name) is not None]
    if report.get("psnr_views"):
        lines += ["", f"PSNR of each held-out photograph [dB]: {report['psnr_views']}"]
    history = report.get("history") or []
    if history:
        lines += ["", "## Quality against count", ""]
        lines += ["| step | Gaussians | PSNR on training photographs |", "| --- | --- | --- |"]
        every = max(1, len(history) // 20)
        kept = history[every - 1 :: every]
        lines += [f"| {step} | {count} | {db:.2f} |" for step, count, db in kept]
    return "\n".join(lines) + "\n"
