"""No more Gaussians than the image error asks for: a target steers growth and pruning.

Each pixel's squared error is attributed to the Gaussians that blend into it (Rota Bulo et al. 2024)
by one backward pass through a feature that is zero everywhere: the gradient of
``sum_p e_p sum_k w_kp f_k`` with respect to ``f_k`` is ``sum_p w_kp e_p``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent.pipeline.capture.views import TrainView
from gsfluent.pipeline.reconstruct.density import Wanted
from gsfluent.pipeline.reconstruct.model import SplatModel

_MOST_VIEWS = 24  # views looked at for growth; the worst
_SLACK = 0.97  # of the target error: below, Gaussians are dropped
_DROP_SHARE = 0.1  # of the Gaussians, at most, each time
_DROP_WEIGHT = 0.02  # of all blend weights, at most, each time, when there is no error at all
_NEAR = 2.0  # times the target error: from there on patience is worth it
_FALLING = 0.9  # of the last mean error: while training alone gains so much, none is added
_MARGIN_DB = 0.15  # training ends a little better than its target, steps still jitter


class ErrorTarget:
    """Steers the count of Gaussians by the error on the training photographs.

    Args:
        views: The photographs.
        psnr: Mean PSNR [dB] of the photographs that is wanted.
    """

    def __init__(self, views: list[TrainView], psnr: float) -> None:
        self.views = views
        self.error = 10.0 ** (-(psnr + _MARGIN_DB) / 10.0)
        self.previous = math.inf

    def wanted(self, model: SplatModel, degree: int, last: Tensor) -> Wanted:
        """What the next change of the count shall be.

        Args:
            model: The Gaussians.
            degree: SH bands in use.
            last: Mean squared error of each view when it was last trained on, [V].
        """
        known = torch.isfinite(last)
        if not bool(known.any()):
            return Wanted()
        mean = float(last[known].mean())
        falling, self.previous = mean < _FALLING * self.previous, mean
        if self.error < mean < _NEAR * self.error and falling:
            return Wanted(stop=True)
        if mean > self.error:
            chosen = torch.where(known, last, torch.zeros_like(last))
            worst = chosen.topk(min(_MOST_VIEWS, len(self.views))).indices.tolist()
            error, weight = attributed(model, [self.views[k] for k in worst], degree)
            return Wanted(grow=error > self.error * weight)
        drop = None
        if mean < _SLACK * self.error:
            share = _DROP_WEIGHT * (1.0 - mean / self.error)
            drop = least_seen(model, self.views, share, _DROP_SHARE)
        return Wanted(drop=drop, stop=True)


@torch.no_grad()
def least_seen(
    model: SplatModel, views: list[TrainView], weight_share: float, count_share: float = 1.0
) -> Tensor:
    """Gaussians that blend least into the views.

    Args:
        model: The Gaussians.
        views: All photographs.
        weight_share: How much of all blend weights they may hold together.
        count_share: How many of the Gaussians they may be.

    Returns:
        bool [N].
    """
    weight = torch.zeros(model.count, device=model.device)
    for view in views:
        seen = model.render(view, 0, contribution=True).contribution
        assert seen is not None
        weight += seen
    order = weight.argsort(stable=True)
    spent = weight[order].cpu().double().cumsum(0)  # in one order; a GPU's is chance
    least = (spent <= weight_share * spent[-1]).to(weight.device)
    least[int(count_share * model.count) :] = False
    chosen = torch.zeros_like(least)
    chosen[order] = least
    return chosen


def attributed(model: SplatModel, views: list[TrainView], degree: int) -> tuple[Tensor, Tensor]:
    """Squared error under each Gaussian and its blend weight, summed over views, [N] each."""
    error = torch.zeros(model.count, device=model.device)
    weight = torch.zeros_like(error)
    for view in views:
        with torch.no_grad():
            image = model.render(view, degree).image
            if view.valid is not None:
                image = image * view.valid[..., None]
            wrong = (image - view.color).square().mean(-1)
        probe = torch.zeros(model.count, 1, device=model.device, requires_grad=True)
        blended = model.render(view, 0, features=probe, contribution=True)
        assert blended.contribution is not None
        (slope,) = torch.autograd.grad((blended.image * wrong[..., None]).sum(), probe)
        error += slope[:, 0]
        weight += blended.contribution.detach()
    return error, weight
