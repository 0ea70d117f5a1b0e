"""One stage from files to files: behind ``gsfluent reconstruct``, ``fill`` and ``texture``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import Capture
from gsfluent.io import load_capture, load_splats
from gsfluent.io.solid import load_solid, save_solid
from gsfluent.io.splats.load import save_splats
from gsfluent.pipeline.fill.mesh_skin import mesh_gaussians
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.reconstruct.evaluate import write_report
from gsfluent.pipeline.reconstruct.isolate import Isolate
from gsfluent.pipeline.reconstruct.stage import Reconstruct
from gsfluent.pipeline.render.cuts import save_cut_views
from gsfluent.pipeline.texture import Texture
from gsfluent.progress import Progress
from gsfluent.spatial.mesh_file import is_mesh


def reconstruct_to(
    capture: Path,
    out: Path,
    *,
    device: torch.device,
    seed: int = 0,
    keep_background: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Photographs to a splat file; ``reconstruct.json``, ``.md`` and ``.png`` beside it.

    Arguments as the options of ``gsfluent reconstruct``; ``options`` go to the stage.

    Returns:
        What stands in ``reconstruct.json``.

    Raises:
        InputError: The capture cannot be read.
        RunError: The disk is full.
    """
    photographs = load_capture(capture)
    stage = Reconstruct(**options, device=device, seed=seed)
    gaussians = stage(photographs, progress=progress)
    kept = gaussians if keep_background else Isolate(seed=seed)(gaussians, photographs)
    save_splats(kept, out)
    values = gaussians.report | {"gaussians_saved": kept.count, "output": str(out)}
    write_report(out.parent, gaussians.replace(report=values), photographs)
    return values


def fill_to(
    model: Path,
    out: Path,
    *,
    capture: Path | None = None,
    solid: Path | None = None,
    device: torch.device,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> dict[str, Any]:
    """A splat file, a mesh or a masked capture to a solid: ``out`` and its ``.volume.npz``.

    Arguments as above, and ``solid``: a mesh that says what is matter, in the splats' frame.

    Raises:
        InputError: The input cannot be read or has no inside.
        RunError: The disk is full.
    """
    gaussians, photographs = None, _photographs(capture)
    if model.is_dir():
        photographs = load_capture(model)
    elif is_mesh(model):
        solid, gaussians = model, mesh_gaussians(model, seed=seed).to(device)
    else:
        gaussians = load_splats(model).to(device)
    start = time.perf_counter()
    stage = Fill(**options, seed=seed)
    filled = stage(gaussians, photographs, progress=progress, solid=solid)
    save_solid(filled, out)
    return dict(filled.report) | {"seconds": time.perf_counter() - start, "output": str(out)}


def texture_to(
    solid: Path,
    out: Path,
    *,
    capture: Path | None = None,
    device: torch.device,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> dict[str, Any]:
    """A solid to one with a coloured inside, and ``<out>.cuts.png``; arguments as above.

    Raises:
        InputError: The solid or the exemplar cannot be read.
        RunError: The disk is full.
    """
    filled = load_solid(solid).to(device)
    start = time.perf_counter()
    textured = Texture(**options, seed=seed)(filled, _photographs(capture), progress=progress)
    save_solid(textured, out)
    cuts = out.with_suffix(".cuts.png")
    save_cut_views(textured, cuts)
    seconds = time.perf_counter() - start
    report = {k: v for k, v in textured.report.items() if k != "fill"}
    return report | {"seconds": seconds, "output": str(out), "cuts": str(cuts)}


def _photographs(capture: Path | None) -> Capture | None:
    return None if capture is None else load_capture(capture)
