"""The training loop: one photograph per step, densification and pruning every hundred."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.errors import RunError
from gsfluent.metrics import ssim
from gsfluent.pipeline.reconstruct_init import Hull
from gsfluent.pipeline.reconstruct_model import SplatModel
from gsfluent.pipeline.reconstruct_views import TrainView, halved

_DENSIFY_EVERY = 100
_DENSIFY_UNTIL = 0.6  # of the run
_RAMP_UNTIL = 0.35  # of the run at half size
_RAMP_SMALLEST = 64  # pixels; smaller photographs are not halved
_MASK_WEIGHT = 2.0  # weight of the opacity loss; 0.5 leaves a rim of a third of a pixel (measured)
_NEEDLE = 6.0  # longest over middle axis before it is pulled back


@dataclass(frozen=True)
class TrainSettings:
    """Settings of :func:`train`, see :class:`gsfluent.pipeline.Reconstruct`."""

    iterations: int
    max_gaussians: int
    scale_regularization: float
    sh_degree: int
    gradient_threshold: float


OnStep = Callable[[int, float], None]


def train(
    model: SplatModel,
    views: list[TrainView],
    settings: TrainSettings,
    generator: torch.Generator,
    *,
    hull: Hull | None,
    first: int = 0,
    on_step: OnStep,
) -> None:
    """Train ``model`` in place.

    Args:
        model: What is trained.
        views: Photographs.
        settings: Settings.
        generator: Draws the order of the photographs and the backdrops (CPU).
        hull: Where the object can be; None when unknown.
        first: Step to start from.
        on_step: Called after each step with the number of steps done and the mean squared error of
            the last ones.

    Raises:
        RunError: The loss is not finite, or no Gaussian survives.
    """
    large = min(min(view.size) for view in views) >= _RAMP_SMALLEST
    small = [halved(view) for view in views] if large else views
    eyes = torch.stack([-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in views])
    recent: list[float] = []
    order: list[int] = []
    for step in range(first, settings.iterations):
        if not order:
            order = torch.randperm(len(views), generator=generator).tolist()
        chosen = small if step < _RAMP_UNTIL * settings.iterations else views
        view = chosen[order.pop()]
        error = _step(model, view, step, settings, generator)
        recent = [*recent[-29:], error]
        done = step + 1
        if done % _DENSIFY_EVERY == 0:
            control(model, settings, done, generator, hull=hull, eyes=eyes)
        on_step(done, sum(recent) / len(recent))


def _step(
    model: SplatModel,
    view: TrainView,
    step: int,
    settings: TrainSettings,
    generator: torch.Generator,
) -> float:
    """One photograph: loss, gradients, Adam. Returns the mean squared error."""
    device = view.color.device
    degree = min(settings.sh_degree, 4 * step // settings.iterations)
    offset = torch.zeros(model.count, 2, device=device, requires_grad=True)
    rendered = model.render(view, degree, offset)
    image, alpha = rendered.image, rendered.alpha
    if view.valid is not None:
        image, alpha = image * view.valid[..., None], alpha * view.valid
    miss = image - view.color
    loss = torch.zeros((), device=device)
    if view.mask is not None:
        # Before black a dark object may stay transparent; before a random colour it may not.
        backdrop = torch.rand(3, generator=generator).to(device)
        excess = alpha - view.mask
        miss = miss - excess[..., None] * backdrop
        loss = loss + _MASK_WEIGHT * excess.abs().mean()
    loss = loss + 0.8 * miss.abs().mean() + 0.2 * (1.0 - ssim(image, view.target))
    if settings.scale_regularization > 0:
        loss = loss + settings.scale_regularization * shape_loss(model)
    if not bool(torch.isfinite(loss)):
        raise RunError(
            f"reconstruct: the loss became {loss.item()} at step {step}",
            mend="check the poses with `gsfluent inspect`, or change the seed",
        )
    loss.backward()
    assert offset.grad is not None
    model.observe(offset.grad, rendered.radii, view.full_width)
    model.step(step / settings.iterations)
    return float(miss.detach().square().mean())


def shape_loss(model: SplatModel) -> Tensor:
    """Mean scale in units of the extent, and the excess of needles over an aspect of 6.

    GaussianFluent's equation 1 asks for small scales; the mean keeps its weight independent of the
    count. Needles are penalised because they swing widely when the matter they ride on turns.
    """
    scales = model.scales()
    size = 0.5 * scales.mean() / model.extent
    if model.isotropic:
        return size
    ordered = scales.sort(dim=1).values
    aspect = ordered[:, 2] / ordered[:, 1].clamp_min(1e-9)
    return size + 0.002 * (aspect - _NEEDLE).clamp_min(0.0).mean()


@torch.no_grad()
def control(
    model: SplatModel,
    settings: TrainSettings,
    done: int,
    generator: torch.Generator,
    *,
    hull: Hull | None,
    eyes: Tensor,
) -> None:
    """Densify while it is time, and prune what is transparent, huge or where no object can be."""
    if done <= _DENSIFY_UNTIL * settings.iterations:
        model.densify(
            settings.gradient_threshold, settings.max_gaussians, 0.01 * model.extent, generator
        )
    else:
        model.reset_statistics()
    means, scales = model.parameters["means"], model.scales()
    keep = torch.sigmoid(model.parameters["opacities"]) > 0.01
    keep &= torch.isfinite(means).all(1)
    if hull is not None:
        keep &= scales.amax(1) < 0.3 * model.extent
        keep &= hull.contains(means, slack=4)
    else:
        # Matter right before a lens explains one photograph and spoils all others.
        keep &= torch.cdist(means, eyes).amin(1) > 0.3 * model.extent
        keep &= scales.amax(1) < model.extent
    if not bool(keep.any()):
        raise RunError(
            f"reconstruct: no Gaussian survived step {done}",
            mend="check that masks, poses and photographs belong together",
        )
    model.keep(keep)


def decibels(mean_squared_error: float) -> float:
    """PSNR [dB] of a mean squared error."""
    return -10.0 * math.log10(max(mean_squared_error, 1e-10))
