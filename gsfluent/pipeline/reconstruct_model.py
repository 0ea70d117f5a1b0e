"""The trained splats: raw parameters, their optimiser, and adaptive density control."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Gaussians
from gsfluent.geometry import normalize_quaternions, quaternion_to_matrix
from gsfluent.pipeline.reconstruct_views import TrainView

_SPLIT_FACTOR = 1.6  # a split Gaussian's parts are this much smaller (Kerbl et al. 2023)
_BETAS = (0.9, 0.99)
_EPSILON = 1e-15


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes. ``means`` is in units of the extent and decays to 2 % over the run."""

    means: float = 1.6e-3
    scales: float = 1.0e-2
    quats: float = 2.0e-3
    opacities: float = 5.0e-2
    sh0: float = 1.0e-2
    sh_rest: float = 5.0e-4


class SplatModel:
    """Trainable Gaussians with per-parameter Adam moments that survive densification.

    Args:
        start: Gaussians to start from.
        extent: Size of what is reconstructed [world units]: radius of the object, or distance of
            the cameras from it.
        isotropic: Keep one standard deviation per Gaussian.
        rates: Learning rates.
    """

    def __init__(
        self, start: Gaussians, extent: float, *, isotropic: bool, rates: LearningRates
    ) -> None:
        self.extent = extent
        self.isotropic = isotropic
        self.rates = rates
        scales = start.scales.log()
        if isotropic:
            scales = scales.mean(1, keepdim=True)
        self.parameters = {
            "means": start.means,
            "scales": scales,
            "quats": normalize_quaternions(start.quats),
            "opacities": torch.logit(start.opacities.clamp(0.01, 0.99)),
            "sh0": start.sh[:, :1],
            "sh_rest": start.sh[:, 1:],
        }
        self.parameters = {
            name: value.detach().clone().contiguous().requires_grad_()
            for name, value in self.parameters.items()
        }
        self.first = {name: torch.zeros_like(p) for name, p in self.parameters.items()}
        self.second = {name: torch.zeros_like(p) for name, p in self.parameters.items()}
        self.steps = 0
        self.reset_statistics()

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.parameters["means"].shape[0])

    def reset_statistics(self) -> None:
        """Forget the accumulated screen-space gradients."""
        device = self.parameters["means"].device
        self.gradient = torch.zeros(self.count, device=device)
        self.visits = torch.zeros(self.count, device=device)

    # -- rendering -------------------------------------------------------------------------------
    def scales(self) -> Tensor:
        """Standard deviations [N, 3]."""
        return self.parameters["scales"].exp().expand(-1, 3)

    def render(
        self, view: TrainView, degree: int, offset: Tensor | None = None
    ) -> ops.raster.Rendered:
        """Render one view before black with the first ``degree`` SH bands."""
        p = self.parameters
        sh = p["sh0"]
        if degree > 0:
            sh = torch.cat([sh, p["sh_rest"][:, : (degree + 1) ** 2 - 1]], dim=1)
        width, height = view.size
        return ops.rasterize(
            p["means"],
            torch.sigmoid(p["opacities"]),
            view.viewmat,
            view.K,
            width,
            height,
            quats=p["quats"],
            scales=self.scales().contiguous(),
            sh=sh.contiguous(),
            means2d_offset=offset,
            near=0.01 * self.extent,
        )

    # -- optimisation ----------------------------------------------------------------------------
    @torch.no_grad()
    def step(self, progress: float) -> None:
        """One Adam step, then clear the gradients; ``progress`` in [0, 1] sets the decay."""
        self.steps += 1
        correction1 = 1.0 - _BETAS[0] ** self.steps
        correction2 = 1.0 - _BETAS[1] ** self.steps
        for name, parameter in self.parameters.items():
            gradient = parameter.grad
            if gradient is None or parameter.numel() == 0:
                continue
            rate: float = getattr(self.rates, name)
            if name == "means":
                rate *= self.extent * 0.02**progress
            first, second = self.first[name], self.second[name]
            first.lerp_(gradient, 1.0 - _BETAS[0])
            second.mul_(_BETAS[1]).addcmul_(gradient, gradient, value=1.0 - _BETAS[1])
            scale = (second / correction2).sqrt_().add_(_EPSILON)
            parameter.addcdiv_(first, scale, value=-rate / correction1)
            parameter.grad = None

    @torch.no_grad()
    def observe(self, offset_gradient: Tensor, radii: Tensor, width: int) -> None:
        """Add one view's screen-space gradient, in units of half the image width."""
        seen = radii > 0
        self.gradient += offset_gradient.norm(dim=1) * (0.5 * width) * seen
        self.visits += seen

    # -- adaptive density control ----------------------------------------------------------------
    @torch.no_grad()
    def densify(
        self, threshold: float, limit: int, split_above: float, generator: torch.Generator
    ) -> int:
        """Clone small and split large Gaussians whose mean gradient is above ``threshold``.

        At most ``limit`` Gaussians remain afterwards; the strongest gradients come first.

        Args:
            threshold: Mean screen-space gradient, see :meth:`observe`.
            limit: Cap on the count.
            split_above: Largest standard deviation [world units] that is cloned rather than split.
            generator: Draws where the parts of a split lie (CPU).

        Returns:
            How many were added.
        """
        mean = self.gradient / self.visits.clamp_min(1.0)
        room = min(limit - self.count, int((mean > threshold).sum()))
        if room <= 0:
            self.reset_statistics()
            return 0
        chosen = mean.topk(room).indices.sort().values
        scales = self.scales()
        large = scales[chosen].amax(1) > split_above
        draw = torch.randn(room, 3, generator=generator).to(scales)
        turn = quaternion_to_matrix(self.parameters["quats"][chosen])
        shift = (turn @ (draw * scales[chosen])[..., None])[..., 0] * large[:, None]
        new = {name: p.detach()[chosen].clone() for name, p in self.parameters.items()}
        new["means"] += shift
        smaller = math.log(_SPLIT_FACTOR) * large
        new["scales"] -= smaller[:, None]
        self.parameters["scales"][chosen] -= smaller[:, None]
        self.parameters["means"][chosen] -= shift
        zeros = {name: torch.zeros_like(value) for name, value in new.items()}
        self.parameters = {
            name: torch.cat([p.detach(), new[name]]).requires_grad_()
            for name, p in self.parameters.items()
        }
        self.first = {name: torch.cat([m, zeros[name]]) for name, m in self.first.items()}
        self.second = {name: torch.cat([m, zeros[name]]) for name, m in self.second.items()}
        self.reset_statistics()
        return room

    @torch.no_grad()
    def keep(self, mask: Tensor) -> None:
        """Drop the Gaussians outside ``mask``, bool [N]."""
        if bool(mask.all()):
            return
        self.parameters = {
            name: p.detach()[mask].requires_grad_() for name, p in self.parameters.items()
        }
        self.first = {name: m[mask] for name, m in self.first.items()}
        self.second = {name: m[mask] for name, m in self.second.items()}
        self.gradient, self.visits = self.gradient[mask], self.visits[mask]

    # -- in and out ------------------------------------------------------------------------------
    @torch.no_grad()
    def gaussians(self, degree: int) -> Gaussians:
        """The splats with activated values; rows with non-finite values are left out."""
        p = {name: value.detach() for name, value in self.parameters.items()}
        sh = torch.cat([p["sh0"], p["sh_rest"][:, : (degree + 1) ** 2 - 1]], dim=1)
        quats = normalize_quaternions(p["quats"])
        result = Gaussians(
            p["means"], quats, self.scales().contiguous(), torch.sigmoid(p["opacities"]), sh
        )
        finite = torch.ones(self.count, dtype=torch.bool, device=result.device)
        for value in (result.means, result.quats, result.scales, result.sh.flatten(1)):
            finite &= torch.isfinite(value).all(1)
        return result.select(finite & torch.isfinite(result.opacities))

    def state(self) -> dict[str, Tensor]:
        """Everything needed to go on, tensors only."""
        groups = {"parameter": self.parameters, "first": self.first, "second": self.second}
        flat = {
            f"{group}.{name}": value.detach()
            for group, values in groups.items()
            for name, value in values.items()
        }
        return flat | {
            "gradient": self.gradient,
            "visits": self.visits,
            "steps": torch.tensor(self.steps),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what :meth:`state` returned.

        Raises:
            KeyError: Something is missing.
        """
        device = self.parameters["means"].device
        for name in self.parameters:
            self.first[name] = state[f"first.{name}"].to(device)
            self.second[name] = state[f"second.{name}"].to(device)
            self.parameters[name] = state[f"parameter.{name}"].to(device).requires_grad_()
        self.gradient = state["gradient"].to(device)
        self.visits = state["visits"].to(device)
        self.steps = int(state["steps"])
