"""Reconstruction: error on photographs held out, against training time.

The melon of the demo is photographed by ray casting; every eighth photograph judges. The error is
the rms difference of display values that the held-out PSNR stands for, ``10^(-PSNR / 20)``, always
at the full size of the photographs, whatever size was trained on.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Mapping
from typing import Any

import torch

from gsfluent.data import Capture
from gsfluent.demo import make_capture
from gsfluent.io import load_capture
from gsfluent.lab.charts.quality import Job, Outcome
from gsfluent.pipeline.reconstruct.evaluate import HOLD_OUT, evaluate
from gsfluent.pipeline.reconstruct.stage import Reconstruct

XLABEL = "seconds of training"
YLABEL = "rms error on held-out photographs"


class _Case:
    """One capture; it is photographed when first asked for."""

    def __init__(self, views: int, size: int, device: torch.device) -> None:
        self.views, self.size, self.device = views, size, device
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    @functools.cached_property
    def capture(self) -> Capture:
        self._folder = tempfile.TemporaryDirectory()  # photographs are read when they are asked for
        make_capture("watermelon", self._folder.name, views=self.views, size=self.size)
        return load_capture(self._folder.name)

    def __call__(self, repeat: int, options: Mapping[str, Any]) -> Outcome:
        del repeat  # a training is long, and the same seed gives the same splats
        keys = {"iterations": 200, **options}
        stage = Reconstruct(**keys, device=self.device)
        splats = stage(self.capture)
        _, held = self.capture.split(HOLD_OUT)
        judged = evaluate(splats, held, self.size)
        psnr = float(judged["psnr"])
        return Outcome(
            10.0 ** (-psnr / 20.0), [float(splats.report["train_seconds"])], splats.count,
            {"PSNR [dB]": psnr, "SSIM": float(judged["ssim"]),
             "PSNR inside [dB]": float(judged["psnr_inside"])},
            settings={"steps": stage.iterations, "image_size": stage.image_size,
                      "recipe": stage.recipe.name},
        )  # fmt: skip


def jobs(*, device: torch.device, quick: bool = False) -> list[Job]:
    """The ladder: steps, size of the photographs, recipes, number of Gaussians, colours."""
    views, size = (16, 48) if quick else (32, 128)
    steps = (20, 60) if quick else (25, 50, 100, 200, 400)
    ladder: list[tuple[str, dict[str, Any]]] = [
        (f"{n} steps", {"iterations": n, "recipe": "quick"}) for n in steps
    ]
    if quick:
        ladder.append(("60 steps, half size", {"iterations": 60, "image_size": size // 2}))
    else:
        ladder += [
            (f"{n} steps, half size", {"iterations": n, "image_size": size // 2})
            for n in (100, 400)
        ]
        ladder += [(f"200 steps, {n}", {"recipe": n}) for n in ("long", "classic")]
        ladder += [(f"200 steps, at most {n} Gaussians", {"max_gaussians": n, "start_gaussians": n})
                   for n in (1500, 5000)]  # fmt: skip
        ladder += [
            ("200 steps, mcmc", {"densify": "mcmc", "max_gaussians": 10_000}),
            ("200 steps, degree 2", {"sh_degree": 2}),
            ("200 steps, isotropic", {"kernel": "isotropic"}),
        ]
    case = _Case(views, size, device)
    name = f"watermelon, {views} photographs of {size} px"
    return [
        Job(name, words, options, functools.partial(case, options=options))
        for words, options in ladder
    ]
