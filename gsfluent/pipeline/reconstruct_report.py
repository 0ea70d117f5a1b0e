"""A reconstruction on paper: held-out photographs beside their renders, and the figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Capture, Gaussians
from gsfluent.io import save_image
from gsfluent.io.atomic import write_json
from gsfluent.pipeline.reconstruct_evaluate import HOLD_OUT, judged

_MOST_ROWS = 8
_ERROR_GAIN = 4.0  # the error panel shows four times the error, grey
_GAP = 4  # pixels between panels


def write_report(
    folder: str | Path, gaussians: Gaussians, capture: Capture, report: dict[str, Any]
) -> list[Path]:
    """Write ``reconstruct.json``, ``.md`` and, when photographs were held out, ``.png``.

    The picture has a row per held-out photograph: as photographed, as rendered, and four times the
    absolute error (mean of the channels).

    Args:
        folder: Where to; made when missing.
        gaussians: The result.
        capture: What it was made from.
        report: What the stage returned, and what else shall stand in the file.

    Returns:
        The files written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "reconstruct.json", folder / "reconstruct.md"]
    write_json(files[0], report)
    files[1].write_text(markdown(report), encoding="utf-8")
    held = capture.split(HOLD_OUT)[1]
    if held is not None:
        files.append(folder / "reconstruct.png")
        save_image(sheet(gaussians, held, int(report["image_size"])), files[-1])
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
