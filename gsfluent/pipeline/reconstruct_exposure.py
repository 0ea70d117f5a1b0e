"""Exposure compensation: an affine change of colour per photograph, learned beside the splats."""

from __future__ import annotations

import torch
from torch import Tensor

_RATE = 1e-3
_RATE_END = 0.02  # of the rate, at the end of the run
_PULL = 1e-2  # weight of the squared distance from the identity
_BETAS = (0.9, 0.99)


class Exposure:
    """``c' = (I + D_v) [c, 1]`` for photograph v, with D regularised and of mean zero.

    The mean over the photographs stays the identity, or the splats would drift in colour and
    photographs that were not trained on (which get no change) would be judged against the drift.

    Args:
        count: Photographs.
        device: Where to keep them.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.delta = torch.zeros(count, 3, 4, device=device)
        self.first, self.second = torch.zeros_like(self.delta), torch.zeros_like(self.delta)
        self._row: Tensor | None = None

    def apply(self, image: Tensor, alpha: Tensor, index: int) -> Tensor:
        """Change an image [H, W, 3] before black with opacity [H, W] as photograph ``index``."""
        self._row = self.delta[index].clone().requires_grad_()
        return image + image @ self._row[:, :3].T + alpha[..., None] * self._row[:, 3]

    def penalty(self) -> Tensor:
        """Distance from the identity of the photograph applied last."""
        assert self._row is not None
        return _PULL * self._row.square().sum()

    @torch.no_grad()
    def step(self, index: int, visits: int, progress: float) -> None:
        """One Adam step of the photograph applied last; ``visits`` counts from 1."""
        if self._row is None or self._row.grad is None:
            return
        gradient = self._row.grad
        first, second = self.first[index], self.second[index]
        first.lerp_(gradient, 1.0 - _BETAS[0])
        second.mul_(_BETAS[1]).addcmul_(gradient, gradient, value=1.0 - _BETAS[1])
        scale = (second / (1.0 - _BETAS[1] ** visits)).sqrt_().add_(1e-8)
        rate = _RATE * _RATE_END**progress / (1.0 - _BETAS[0] ** visits)
        self.delta[index].addcdiv_(first, scale, value=-rate)
        self.delta -= self.delta.mean(0)
        self._row = None

    def state(self) -> dict[str, Tensor]:
        """What must be saved."""
        return {
            "exposure.delta": self.delta,
            "exposure.first": self.first,
            "exposure.second": self.second,
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what :meth:`state` returned."""
        device = self.delta.device
        self.delta = state["exposure.delta"].to(device)
        self.first = state["exposure.first"].to(device)
        self.second = state["exposure.second"].to(device)
