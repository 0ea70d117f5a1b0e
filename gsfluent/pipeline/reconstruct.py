"""Posed photographs to Gaussians: 3D Gaussian Splatting for one object (Kerbl et al. 2023).

What differs from the scene-scale recipe: masks give a visual hull to start on its surface and an
opacity loss to hold it; photographs are cropped to the object; densification is short and capped;
scales are regularised because the splats will be carried by a solid.
"""

from __future__ import annotations

import json
import logging
import math
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.data import Capture, Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.metrics import ssim
from gsfluent.pipeline.reconstruct_evaluate import evaluate
from gsfluent.pipeline.reconstruct_init import (
    Hull,
    hull_gaussians,
    point_gaussians,
    visual_hull,
)
from gsfluent.pipeline.reconstruct_model import LearningRates, SplatModel
from gsfluent.pipeline.reconstruct_views import TrainView, halved, read_views
from gsfluent.pipeline.stage import Progress, Stage, report_progress

_log = logging.getLogger(__name__)

_HOLD_OUT = 8  # every eighth photograph judges, the others teach
_DENSIFY_EVERY = 100
_DENSIFY_UNTIL = 0.6  # of the run
_RAMP_UNTIL = 0.35  # of the run at half size
_NEEDLE = 6.0  # longest over middle axis before it is pulled back


class Reconstruct(Stage):
    """Train Gaussians on a capture.

    Args:
        iterations: Training steps, one photograph each.
        max_gaussians: Hard cap on the count.
        kernel: "anisotropic" (ellipsoids) or "isotropic" (spheres; costs about 4 dB).
        scale_regularization: Strength of the pull towards small, not needle-shaped Gaussians.
        image_size: Longer side of the photographs in training [px].
        sh_degree: Bands of view-dependent colour, 0 to 3. 0 (matte) relights best.
        start_gaussians: Gaussians to start with.
        gradient_threshold: Mean screen-space gradient (units of half the image width) above which a
            Gaussian is cloned or split.
        checkpoint: File to save to while training and to resume from when it exists.
        checkpoint_every: Steps between saves.
        device: Where to train.
        seed: Seed of everything random.

    Raises:
        InputError: A setting is out of range.
    """

    name = "reconstruct"

    def __init__(
        self,
        iterations: int = 800,
        max_gaussians: int = 60_000,
        kernel: str = "anisotropic",
        scale_regularization: float = 1.0,
        image_size: int = 400,
        *,
        sh_degree: int = 0,
        start_gaussians: int = 12_000,
        gradient_threshold: float = 4e-4,
        checkpoint: str | Path | None = None,
        checkpoint_every: int = 250,
        device: str | torch.device = "cpu",
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        if kernel not in ("anisotropic", "isotropic"):
            raise InputError(
                f"reconstruct.kernel {kernel!r} is not known", "choose anisotropic or isotropic"
            )
        for label, value, low, high in (
            ("iterations", iterations, 1, 1_000_000),
            ("max_gaussians", max_gaussians, 10, 50_000_000),
            ("image_size", image_size, 24, 8192),
            ("sh_degree", sh_degree, 0, 3),
            ("scale_regularization", scale_regularization, 0.0, 1e6),
        ):
            if not low <= value <= high:
                raise InputError(
                    f"reconstruct.{label} must be {low} to {high}, got {value}", "change it"
                )
        self.iterations = int(iterations)
        self.max_gaussians = int(max_gaussians)
        self.kernel = kernel
        self.scale_regularization = float(scale_regularization)
        self.image_size = int(image_size)
        self.sh_degree = int(sh_degree)
        self.start_gaussians = min(int(start_gaussians), self.max_gaussians)
        self.gradient_threshold = float(gradient_threshold)
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.checkpoint_every = int(checkpoint_every)
        self.device = torch.device(device)

    def forward(
        self, capture: Capture, progress: Progress | None = None
    ) -> tuple[Gaussians, dict[str, Any]]:
        """Train on a capture.

        Args:
            capture: Posed photographs, with masks, or with sparse points.
            progress: Called every 10 steps as ``progress(step, iterations, note)``.

        Returns:
            The Gaussians in the capture's world frame, and the report: ``images, held_out, psnr,
            ssim, psnr_region, psnr_inside, gaussians, iterations, seconds, resumed_at, start``.

        Raises:
            InputError: Black photographs, no masks and no points, or masks that contradict poses.
            RunError: Training diverged.
        """
        started = time.monotonic()
        train, held = capture.split(_HOLD_OUT)
        views = read_views(train, self.image_size, self.device, crop=True)
        generator = torch.Generator().manual_seed(self.seed)
        model, hull, start = self._start(train, views, generator)
        self._eyes = train.centers().to(self.device, torch.float32)
        first = self._resume(model, generator)
        resumed_at = first
        small = [halved(view) for view in views] if min(_short(v) for v in views) >= 64 else views
        order: list[int] = []
        recent: list[float] = []
        for step in range(first, self.iterations):
            if not order:
                order = torch.randperm(len(views), generator=generator).tolist()
            index = order.pop()
            view = small[index] if step < _RAMP_UNTIL * self.iterations else views[index]
            error = self._train_step(model, view, step, generator)
            recent = [*recent[-29:], error]
            done = step + 1
            if done % _DENSIFY_EVERY == 0:
                self._control(model, hull, done, generator)
            if done % 10 == 0 or done == self.iterations:
                quality = -10.0 * math.log10(max(sum(recent) / len(recent), 1e-10))
                note = f"{quality:.1f} dB, {model.count} Gaussians"
                report_progress(progress, done, self.iterations, note)
            if self.checkpoint is not None and done % self.checkpoint_every == 0:
                self._save(model, generator, done)
        gaussians = model.gaussians(self.sh_degree)
        visible = gaussians.opacities > 0.02
        gaussians = gaussians.select(visible)
        if gaussians.count == 0:
            raise RunError(
                "reconstruct: every Gaussian faded away in training",
                mend="check that the poses belong to the photographs (gsfluent inspect)",
            )
        report = {
            "images": len(capture),
            "held_out": 0 if held is None else len(held),
            **evaluate(gaussians, held, self.image_size),
            "gaussians": gaussians.count,
            "iterations": self.iterations,
            "image_size": self.image_size,
            "start": start,
            "resumed_at": resumed_at,
            "seconds": round(time.monotonic() - started, 2),
        }
        return gaussians, report

    def _start(
        self, capture: Capture, views: list[TrainView], generator: torch.Generator
    ) -> tuple[SplatModel, Hull | None, str]:
        isotropic = self.kernel == "isotropic"
        if views and views[0].mask is not None:
            hull = visual_hull(views)
            lower, upper = hull.bounds()
            start = hull_gaussians(hull, views, self.start_gaussians, self.sh_degree, generator)
            extent = 0.5 * float((upper - lower).max())
            rates = LearningRates()
            model = SplatModel(start, extent, isotropic=isotropic, rates=rates)
            return model, hull, "visual hull"
        start, extent = point_gaussians(
            capture, views, self.start_gaussians, self.sh_degree, generator
        )
        rates = LearningRates(means=8e-4)
        return SplatModel(start, extent, isotropic=isotropic, rates=rates), None, "sparse points"

    def _train_step(
        self, model: SplatModel, view: TrainView, step: int, generator: torch.Generator
    ) -> float:
        """One photograph: loss, gradients, Adam. Returns the mean squared error."""
        degree = min(self.sh_degree, 4 * step // max(1, self.iterations))
        offset = torch.zeros(model.count, 2, device=self.device, requires_grad=True)
        rendered = model.render(view, degree, offset)
        image, alpha = rendered.image, rendered.alpha
        if view.valid is not None:
            image, alpha = image * view.valid[..., None], alpha * view.valid
        # Compared before black the object's own darkness is free; before a random colour it is not.
        miss = image - view.color
        loss = torch.zeros((), device=self.device)
        if view.mask is not None:
            backdrop = torch.rand(3, generator=generator).to(self.device)
            miss = miss - (alpha - view.mask)[..., None] * backdrop
            loss = loss + 2.0 * (alpha - view.mask).abs().mean()
        loss = loss + 0.8 * miss.abs().mean() + 0.2 * (1.0 - ssim(image, view.target))
        if self.scale_regularization > 0:
            loss = loss + self.scale_regularization * self._shape_loss(model)
        if not bool(torch.isfinite(loss)):
            raise RunError(
                f"reconstruct: the loss became {loss.item()} at step {step}",
                "" if self.checkpoint is None else f"the last checkpoint, {self.checkpoint}",
                "check the poses with `gsfluent inspect`, or change the seed",
            )
        loss.backward()
        assert offset.grad is not None
        model.observe(offset.grad, rendered.radii, view.full_width)
        model.step(step / self.iterations)
        return float(miss.detach().square().mean())

    def _shape_loss(self, model: SplatModel) -> Tensor:
        """Mean scale in units of the extent, and the excess of needles over an aspect of 6."""
        scales = model.scales()
        size = 0.5 * scales.mean() / model.extent
        if model.isotropic:
            return size
        ordered = scales.sort(dim=1).values
        aspect = ordered[:, 2] / ordered[:, 1].clamp_min(1e-9)
        return size + 0.002 * (aspect - _NEEDLE).clamp_min(0.0).mean()

    def _control(
        self, model: SplatModel, hull: Hull | None, done: int, generator: torch.Generator
    ) -> None:
        """Densify while it is time, and prune what is transparent, huge or outside the hull."""
        share = done / self.iterations
        if share <= _DENSIFY_UNTIL:
            model.densify(
                self.gradient_threshold, self.max_gaussians, 0.01 * model.extent, generator
            )
        else:
            model.reset_statistics()
        with torch.no_grad():
            keep = torch.sigmoid(model.parameters["opacities"]) > 0.01
            scales = model.scales()
            if hull is not None:
                keep &= scales.amax(1) < 0.3 * model.extent
                keep &= hull.contains(model.parameters["means"], slack=4)
            else:
                # Matter right before a lens explains one photograph and spoils all others.
                apart = torch.cdist(model.parameters["means"], self._eyes)
                keep &= apart.amin(1) > 0.3 * model.extent
                keep &= scales.amax(1) < model.extent
            keep &= torch.isfinite(model.parameters["means"]).all(1)
            if not bool(keep.any()):
                raise RunError(
                    f"reconstruct: no Gaussian survived step {done}",
                    mend="check that masks, poses and photographs belong together",
                )
            model.keep(keep)

    def _fingerprint(self) -> str:
        """What a checkpoint must agree on to be resumed."""
        names = ("iterations", "kernel", "image_size", "sh_degree", "start_gaussians", "seed")
        return json.dumps({name: getattr(self, name) for name in names}, sort_keys=True)

    def _save(self, model: SplatModel, generator: torch.Generator, done: int) -> None:
        from gsfluent.io.atomic import atomic_path

        assert self.checkpoint is not None
        mark = torch.tensor(list(self._fingerprint().encode()), dtype=torch.uint8)
        state = model.state() | {
            "iteration": torch.tensor(done),
            "generator": generator.get_state(),
            "fingerprint": mark,
        }
        with atomic_path(self.checkpoint) as temporary:
            torch.save(state, temporary)

    def _resume(self, model: SplatModel, generator: torch.Generator) -> int:
        """Restore a checkpoint when there is one; the step to go on from."""
        if self.checkpoint is None or not self.checkpoint.is_file():
            return 0
        try:
            state = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
            mark = bytes(state["fingerprint"].tolist()).decode()
            if mark != self._fingerprint():
                raise InputError(
                    f"{self.checkpoint}: the checkpoint is of other settings ({mark})",
                    "remove it, or reconstruct with those settings",
                )
            model.restore(state)
            generator.set_state(state["generator"])
            return int(state["iteration"])
        except InputError:
            raise
        except Exception as error:
            raise InputError(
                f"{self.checkpoint}: the checkpoint is damaged ({type(error).__name__})",
                "remove it to start afresh",
            ) from error


def _short(view: TrainView) -> int:
    return min(view.size)
