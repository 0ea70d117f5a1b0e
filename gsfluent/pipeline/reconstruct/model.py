"""The trained splats: raw parameters with their optimiser."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Gaussians
from gsfluent.geometry import normalize_quaternions
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.pipeline.reconstruct.recipe import LearningRates

_BETA1 = 0.9
_EPSILON = 1e-15
_NEEDLE = 3.0  # longest over middle axis before it is pulled back

Rows = dict[str, Tensor]


class Pulls(NamedTuple):
    """Weights of penalties in the loss."""

    size: float = 0.0  # of the mean scale, in units of the extent
    needle: float = 0.0  # of the mean excess of longest over middle axis, over 3
    opacity: float = 0.0  # of the mean opacity


class SplatModel:
    """Trainable Gaussians with per-parameter Adam moments that survive densification.

    Args:
        start: Gaussians to start from.
        extent: Size of what is reconstructed [world units]: radius of the object, or distance of
            the cameras from it.
        isotropic: Keep one standard deviation per Gaussian.
        rates: Learning rates.
        deterministic: The same bits of the gradients in every run on a GPU too.
    """

    def __init__(
        self,
        start: Gaussians,
        extent: float,
        *,
        isotropic: bool,
        rates: LearningRates,
        deterministic: bool = False,
    ) -> None:
        self.extent = extent
        self.isotropic = isotropic
        self.deterministic = deterministic
        self.rates = rates
        scales = start.scales.log()
        if isotropic:
            scales = scales.mean(1, keepdim=True)
        self.parameters: Rows = {
            "means": start.means,
            "scales": scales,
            "quats": normalize_quaternions(start.quats),
            "opacities": torch.logit(start.opacities.clamp(0.005, 0.99)),
            "sh0": start.sh[:, :1],
            "sh_rest": start.sh[:, 1:],
        }
        self.parameters = {
            name: value.detach().clone().contiguous() for name, value in self.parameters.items()
        }
        self.first = {name: torch.zeros_like(p) for name, p in self.parameters.items()}
        self.second = {name: torch.zeros_like(p) for name, p in self.parameters.items()}
        self.steps = 0

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.parameters["means"].shape[0])

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.parameters["means"].device

    # -- rendering -------------------------------------------------------------------------------
    def scales(self) -> Tensor:
        """Standard deviations [N, 3]."""
        return self.parameters["scales"].exp().expand(-1, 3)

    def opacities(self) -> Tensor:
        """Peak opacities [N]."""
        return torch.sigmoid(self.parameters["opacities"])

    def activated(self, degree: int) -> ops.activation.Activated:
        """The splats as the rasterizer takes them, with ``degree`` bands of SH."""
        p = self.parameters
        return ops.activate(p["scales"], p["opacities"], p["sh0"], p["sh_rest"], degree)

    def render(
        self,
        view: TrainView,
        degree: int,
        *,
        features: Tensor | None = None,
        contribution: bool = False,
    ) -> ops.raster.Rendered:
        """Render one view before black.

        Args:
            view: The camera.
            degree: SH bands that are used.
            features: Values [N, C] to blend instead of the colours.
            contribution: Also sum each Gaussian's blend weights.
        """
        p, splats = self.parameters, self.activated(degree)
        return ops.rasterize(
            p["means"],
            splats.opacities,
            view.viewmat,
            view.K,
            *view.size,
            quats=p["quats"],
            scales=splats.scales,
            sh=splats.sh if features is None else None,
            colors=features,
            contribution=contribution,
            depth=False,
            near=0.01 * self.extent,
            deterministic=self.deterministic,
        )

    def record(
        self,
        view: TrainView,
        splats: ops.activation.Activated,
        probe: Tensor | None = None,
        *,
        absgrad: bool = False,
    ) -> ops.raster.Recorded:
        """Render one view before black, with its adjoint.

        Args:
            view: The camera.
            splats: From :meth:`activated`.
            probe: Zeros [N, 2] that stand for the projected centres: their gradient is wanted.
            absgrad: The sum of its absolute values over the pixels is.
        """
        return ops.rasterize_recorded(
            self.parameters["means"],
            splats.opacities,
            view.viewmat,
            view.K,
            *view.size,
            quats=self.parameters["quats"],
            scales=splats.scales,
            sh=splats.sh,
            probe=probe,
            absgrad=absgrad,
            near=0.01 * self.extent,
            deterministic=self.deterministic,
        )

    # -- optimisation ----------------------------------------------------------------------------
    def gradients(
        self,
        splats: ops.activation.Activated,
        slopes: ops.raster.Slopes,
        pulls: Pulls,
        mark: Tensor | None = None,
    ) -> Rows:
        """Gradients of the parameters.

        Args:
            splats: From :meth:`activated`.
            slopes: Of what was drawn with them.
            pulls: Weights of the penalties.
            mark: A scalar that becomes NaN where a splat has no finite shape.
        """
        raw = ops.activate_backward(
            splats,
            slopes.scales,
            slopes.opacities,
            slopes.sh,
            columns=self.parameters["scales"].shape[1],
            rest=self.parameters["sh_rest"].shape[1],
            size=pulls.size / (3 * self.count * self.extent),
            needle=pulls.needle / self.count,
            aspect=_NEEDLE,
            opacity=pulls.opacity / self.count,
            mark=mark,
        )
        shapes = {"means": slopes.means, "quats": slopes.quats, "scales": raw.scales}
        return shapes | {
            "opacities": raw.opacities,
            "sh0": raw.sh0,
            "sh_rest": raw.sh_rest,
        }

    def step(self, gradients: Rows, progress: float) -> None:
        """One Adam step; ``progress`` in [0, 1] sets the decay."""
        self.steps += 1
        names = [name for name, value in self.parameters.items() if value.numel() > 0]
        ops.adam_step(
            [self.parameters[name] for name in names],
            [gradients[name] for name in names],
            [self.first[name] for name in names],
            [self.second[name] for name in names],
            lr=[
                self.rates.at(name, progress) * (self.extent if name == "means" else 1.0)
                for name in names
            ],
            step=self.steps,
            betas=(_BETA1, self.rates.beta2),
            eps=_EPSILON,
        )

    # -- rows ------------------------------------------------------------------------------------
    def rows(self, index: Tensor) -> Rows:
        """Copies of rows ``index`` [M] of every parameter."""
        return {name: p[index] for name, p in self.parameters.items()}

    def append(self, rows: Rows) -> None:
        """Add rows; their moments start at zero."""
        zeros = {name: torch.zeros_like(value) for name, value in rows.items()}
        self.parameters = {name: torch.cat([p, rows[name]]) for name, p in self.parameters.items()}
        self.first = {name: torch.cat([m, zeros[name]]) for name, m in self.first.items()}
        self.second = {name: torch.cat([m, zeros[name]]) for name, m in self.second.items()}

    def forget(self, index: Tensor) -> None:
        """Clear the moments of rows ``index`` [M]."""
        for moments in (self.first, self.second):
            for value in moments.values():
                value[index] = 0.0

    def keep(self, mask: Tensor) -> None:
        """Drop the Gaussians outside ``mask``, bool [N]."""
        if bool(mask.all()):
            return
        index = mask.nonzero()[:, 0]
        self.parameters = self.rows(index)
        self.first = {name: m[index] for name, m in self.first.items()}
        self.second = {name: m[index] for name, m in self.second.items()}

    # -- in and out ------------------------------------------------------------------------------
    def gaussians(self, degree: int) -> Gaussians:
        """The splats with activated values; rows with non-finite values are left out."""
        p = self.parameters
        sh = torch.cat([p["sh0"], p["sh_rest"][:, : (degree + 1) ** 2 - 1]], dim=1)
        quats = normalize_quaternions(p["quats"])
        result = Gaussians(p["means"], quats, self.scales().contiguous(), self.opacities(), sh)
        finite = torch.ones(self.count, dtype=torch.bool, device=result.device)
        for value in (result.means, result.quats, result.scales, result.sh.flatten(1)):
            finite &= torch.isfinite(value).all(1)
        return result.select(finite & torch.isfinite(result.opacities))

    def state(self) -> dict[str, Tensor]:
        """Everything needed to go on, tensors only."""
        groups = {"parameter": self.parameters, "first": self.first, "second": self.second}
        flat = {
            f"{group}.{name}": value
            for group, values in groups.items()
            for name, value in values.items()
        }
        return flat | {"steps": torch.tensor(self.steps)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what :meth:`state` returned.

        Raises:
            KeyError: Something is missing.
        """
        device = self.device
        for name in self.parameters:
            self.first[name] = state[f"first.{name}"].to(device)
            self.second[name] = state[f"second.{name}"].to(device)
            self.parameters[name] = state[f"parameter.{name}"].to(device)
        self.steps = int(state["steps"])


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

    def apply(self, image: Tensor, alpha: Tensor, index: int) -> Tensor:
        """Change an image [H, W, 3] before black with opacity [H, W] as photograph ``index``."""
        row = self.delta[index]
        return image + image @ row[:, :3].T + alpha[..., None] * row[:, 3]

    def adjoint(
        self, slope: Tensor, image: Tensor, alpha: Tensor, index: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients behind :meth:`apply`, whose result has the gradient ``slope`` [H, W, 3].

        Returns:
            Those of the image, of the opacity, and of the row, [3, 4], where the squared distance
            from the identity is penalised.
        """
        row = self.delta[index]
        flat = slope.reshape(-1, 3)
        turn = flat.T @ image.reshape(-1, 3)
        shift = flat.T @ alpha.reshape(-1, 1)
        gradient = torch.cat([turn, shift], 1) + 2.0 * _PULL * row
        return slope + slope @ row[:, :3], slope @ row[:, 3], gradient

    def step(self, gradient: Tensor, index: int, visits: int, progress: float) -> None:
        """One Adam step of a photograph's row by its gradient; ``visits`` counts from 1."""
        first, second = self.first[index], self.second[index]
        first.lerp_(gradient, 1.0 - _BETAS[0])
        second.mul_(_BETAS[1]).addcmul_(gradient, gradient, value=1.0 - _BETAS[1])
        scale = (second / (1.0 - _BETAS[1] ** visits)).sqrt_().add_(1e-8)
        rate = _RATE * _RATE_END**progress / (1.0 - _BETAS[0] ** visits)
        self.delta[index].addcdiv_(first, scale, value=-rate)
        self.delta -= self.delta.mean(0)

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
