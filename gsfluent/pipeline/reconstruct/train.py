"""The training loop: one photograph per step, nothing read back between two looks at the density.

Everything random is drawn from the seed and the step alone (:func:`draws`), so a resumed run is the
uninterrupted run, and the order of the photographs is the same on every device.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.geometry import rgb_to_sh0
from gsfluent.io.atomic import write_tensors
from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.capture.views import TrainView, halved
from gsfluent.pipeline.reconstruct.density import (
    Adc,
    Density,
    Mcmc,
    Place,
    Wanted,
    clamp_aspect,
    draws,
)
from gsfluent.pipeline.reconstruct.floaters import CleanLimits, floating
from gsfluent.pipeline.reconstruct.model import Exposure, Pulls, SplatModel
from gsfluent.pipeline.reconstruct.recipe import Recipe
from gsfluent.pipeline.reconstruct.target import ErrorTarget

_HALVED_FROM = 64  # pixels; smaller photographs are not halved
_MASK_WEIGHT = 2.0  # weight of the opacity loss; 0.5 leaves a rim of a third of a pixel (measured)
_SWEEPS = (0.3, 0.5, 0.7, 0.85)  # of an object's run: what hangs before its skin is swept away
_SWEPT = CleanLimits(depth=0.01)  # closer than cleaning at the end, since the rest can still learn
_RESTRAIN_EVERY = 10  # steps
_OBJECT_PULL = 0.03  # opacity_pull of an object at least: its start is a hull that is too large
_DROP_UNTIL = 0.9  # of the run; what was dropped for an error target is made up for afterwards
_COVERED = 0.99  # coverage of a pixel that shows nothing but the object
_LOOKED_AT = 1_000_000  # pixels whose colours are sorted, about
_GLINTS = 0.001  # share of them at each end of a channel that says nothing about matter
_RECENT = 64  # steps whose losses are remembered
_LOOK = {"cpu": 10}  # steps between two looks at the losses
_LOOK_ELSEWHERE = 50  # each look waits for the device


@dataclass(frozen=True)
class TrainSettings:
    """Settings of :class:`Trainer`, see :class:`gsfluent.pipeline.Reconstruct`."""

    recipe: Recipe
    iterations: int
    max_gaussians: int
    scale_regularization: float
    sh_degree: int
    gradient_threshold: float
    densify: str = "adc"
    absgrad: bool = False
    target_psnr: float | None = None
    exposure: bool = False
    seed: int = 0

    @property
    def sh_every(self) -> float:
        """Steps between two bands of view-dependent colour."""
        return min(float(self.recipe.sh_every), self.iterations / 4)


OnLook = Callable[[int, float], None]


class Trainer:
    """One training of one model.

    Args:
        model: What is trained, in place.
        views: Photographs, on the model's device.
        settings: Settings.
        hull: Where the object can be; None when unknown.
    """

    def __init__(
        self,
        model: SplatModel,
        views: list[TrainView],
        settings: TrainSettings,
        hull: Hull | None,
    ) -> None:
        self.model, self.views, self.settings = model, views, settings
        recipe = settings.recipe
        if hull is not None:
            recipe = replace(recipe, opacity_pull=max(recipe.opacity_pull, _OBJECT_PULL))
        large = min(min(view.size) for view in views) >= _HALVED_FROM
        self.half_until = recipe.half_until * settings.iterations if large else 0.0
        self.small = [halved(view) for view in views] if self.half_until > 0 else views
        eyes = torch.stack([-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in views])
        self.place = place = Place(hull, eyes)
        self.sweeps: set[int] = set()
        self.gamut = None if hull is None else _gamut(views)
        if hull is not None:
            self.sweeps = {round(share * settings.iterations) for share in _SWEEPS}
        steps, limit = settings.iterations, settings.max_gaussians
        self.density: Density
        if settings.densify == "mcmc":
            self.density = Mcmc(recipe, steps, limit, place, seed=settings.seed)
        else:
            self.density = Adc(
                recipe,
                steps,
                limit,
                settings.gradient_threshold,
                place,
                absgrad=settings.absgrad,
                seed=settings.seed,
            )
        device = model.device
        self.target = None
        if settings.target_psnr is not None:
            self.target = ErrorTarget(views, settings.target_psnr)
        self.exposure = Exposure(len(views), device) if settings.exposure else None
        self.last = torch.full((len(views),), math.nan, device=device)
        self.recent = torch.zeros(2, _RECENT, device=device)
        # Before black a dark object may stay transparent; before a random colour it may not.
        self.backdrops = torch.rand(steps, 3, generator=draws(settings.seed, 4, 0)).to(device)
        self.done = 0
        self.order: list[int] = []
        self.history: list[tuple[int, int, float]] = []

    # -- the loop --------------------------------------------------------------------------------
    def run(self, on_look: OnLook, save: Callable[[int], None], save_every: int) -> None:
        """Train from where it stands to the end.

        Args:
            on_look: Called every 10 steps (50 off the CPU) and at the end with the steps done and
                the mean squared error of the last ones.
            save: Called every ``save_every`` steps, after the losses were found finite.
            save_every: Steps.

        Raises:
            RunError: The loss is not finite, or no Gaussian survives.
        """
        settings, recipe = self.settings, self.settings.recipe
        look = _LOOK.get(self.model.device.type, _LOOK_ELSEWHERE)
        while self.done < settings.iterations:
            self._step(self.done)
            self.done += 1
            done, last = self.done, self.done == settings.iterations
            # before the look at the density, which adds none then: what is left has to settle first
            if done in self.sweeps and not last:
                self._sweep(done)
            if done % recipe.densify_every == 0 and not last:
                error = self._look()
                self._control(done)
                self.history.append((done, self.model.count, decibels(error)))
            if self.place.hull is not None and (done % _RESTRAIN_EVERY == 0 or last):
                self.place.restrain(self.model)
            if done % look == 0 or last:
                on_look(done, self._look())
            if done % save_every == 0:
                self._look()
                save(done)

    def _sweep(self, done: int) -> None:
        """Take away what hangs before the skin of an object, or shows in no photograph."""
        gaussians = self.model.gaussians(0)
        if gaussians.count != self.model.count:  # not finite: the losses will say so
            return
        gone = floating(gaussians, self.views, self.place.hull, _SWEPT)
        if bool(gone.all()):
            raise RunError(
                f"reconstruct: no Gaussian survived step {done}",
                hint="check that masks, poses and photographs belong together",
            )
        self.model.keep(~gone)
        self.density.forget()

    def _view(self, step: int) -> tuple[int, TrainView]:
        count = len(self.views)
        if not self.order or step % count == 0:
            generator = draws(self.settings.seed, 0, step // count)
            self.order = torch.randperm(count, generator=generator).tolist()
        index = self.order[step % count]
        return index, (self.small if step < self.half_until else self.views)[index]

    def degree(self, step: int) -> int:
        """SH bands in use at a step."""
        return min(self.settings.sh_degree, int(step / self.settings.sh_every))

    def _step(self, step: int) -> None:
        """One photograph: loss, gradients, Adam.

        Adjoints are called by hand: autograd's part of a step took longer on a GPU than its
        kernels.
        """
        model, settings, slot = self.model, self.settings, step % _RECENT
        index, view = self._view(step)
        splats = model.activated(self.degree(step))
        probe = self.density.probe(model)
        drawn = model.record(view, splats, probe, absgrad=self.density.absgrad)
        image, alpha, masked = drawn.rendered.image, drawn.rendered.alpha, view.mask is not None
        if self.exposure is not None:
            cover = alpha if masked else torch.ones_like(alpha)
            image = self.exposure.apply(image, cover, index)
        found, of_image, of_alpha = ops.photometric_slopes(
            image,
            view.color,
            valid=view.valid,
            alpha=alpha if masked else None,
            mask=view.mask,
            backdrop=self.backdrops[step] if masked else None,
            mask_weight=_MASK_WEIGHT if masked else 0.0,
        )
        progress = step / settings.iterations
        if self.exposure is not None:
            of_image, more, row = self.exposure.adjoint(
                of_image, drawn.rendered.image, cover, index
            )
            of_alpha = None if of_alpha is None else of_alpha + more
            self.exposure.step(row, index, step // len(self.views) + 1, progress)
        self.last[index] = found.mse
        self.recent[0, slot], self.recent[1, slot] = found.loss, found.mse
        slopes = drawn.adjoint(of_image, of_alpha)
        gradients = model.gradients(splats, slopes, self._pulls(), self.recent[0, slot])
        self.density.observe(drawn.rendered.radii, slopes.probe, view)
        model.step(gradients, progress)
        if self.place.hull is not None:
            clamp_aspect(model)
        if self.gamut is not None:
            # Beyond it a splat only makes up for what lies before it, and shows where that parts.
            torch.clamp(model.parameters["sh0"], *self.gamut, out=model.parameters["sh0"])
        self.density.after_step(model, step + 1)

    def _pulls(self) -> Pulls:
        """Penalties: small scales (GaussianFluent's equation 1), no needles, and the density's.

        The mean of the scales keeps its weight independent of the count. Needles are penalised
        because they swing widely when the matter they ride on turns.
        """
        pulls, weight = self.density.pulls(self.model), self.settings.scale_regularization
        return pulls._replace(size=pulls.size + 0.5 * weight, needle=0.002 * weight)

    def _look(self) -> float:
        """Read the last losses back; returns the mean squared error of the last 30 steps."""
        losses, errors = self.recent.tolist()
        first = max(0, self.done - _RECENT)
        for step in range(first, self.done):
            if not math.isfinite(losses[step % _RECENT]):
                raise RunError(
                    f"reconstruct: the loss became {losses[step % _RECENT]} at step {step}",
                    hint="check the poses with `gsfluent inspect`, or change the seed",
                )
        steps = range(max(0, self.done - 30), self.done)
        return sum(errors[step % _RECENT] for step in steps) / max(1, len(steps))

    def _control(self, done: int) -> None:
        wanted = Wanted()
        if self.target is not None and done <= _DROP_UNTIL * self.settings.iterations:
            wanted = self.target.wanted(self.model, self.degree(done), self.last)
        self.density.control(self.model, done, wanted)

    # -- in and out ------------------------------------------------------------------------------
    def state(self) -> dict[str, Tensor]:
        """Everything needed to go on, tensors only."""
        values = self.model.state() | self.density.state()
        values |= {"last": self.last, "recent": self.recent, "done": torch.tensor(self.done)}
        values["history"] = torch.tensor(self.history, dtype=torch.float64).reshape(-1, 3)
        if self.target is not None:
            values["target"] = torch.tensor(self.target.previous, dtype=torch.float64)
        return values | ({} if self.exposure is None else self.exposure.state())

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what :meth:`state` returned.

        Raises:
            KeyError: Something is missing.
        """
        self.model.restore(state)
        self.density.restore(state)
        if self.exposure is not None:
            self.exposure.restore(state)
        if self.target is not None:
            self.target.previous = float(state["target"])
        self.last = state["last"].to(self.model.device)
        self.recent = state["recent"].to(self.model.device)
        self.done = int(state["done"])
        self.order = []
        self.history = [(int(a), int(b), c) for a, b, c in state["history"].tolist()]


def _gamut(views: list[TrainView]) -> tuple[Tensor, Tensor] | None:
    """Lowest and highest colour of an object in photographs, as sh0 [3]; None without masks."""
    shown = [view.color[view.mask >= _COVERED] for view in views if view.mask is not None]
    pixels = torch.cat(shown) if shown else torch.empty(0, 3)
    if len(pixels) == 0:
        return None
    ends = pixels[:: max(1, len(pixels) // _LOOKED_AT)].float().sort(dim=0).values
    spared = int(_GLINTS * len(ends))
    return rgb_to_sh0(ends[spared]), rgb_to_sh0(ends[len(ends) - 1 - spared])


def decibels(mean_squared_error: float) -> float:
    """PSNR [dB] of a mean squared error."""
    return -10.0 * math.log10(max(mean_squared_error, 1e-10))


_log = logging.getLogger(__name__)


_FIELDS = ("means", "quats", "scales", "opacities", "sh")


class Checkpoint:
    """A file with the state of a training; tensors only, replaced atomically.

    Args:
        path: The file; None saves nothing.
        settings: What a saved state must agree on to be resumed.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any]) -> None:
        self.path = path
        self._mark = json.dumps(settings, sort_keys=True)

    def save(
        self,
        state: dict[str, Tensor],
        phase: int,
        scene: Gaussians | None,
    ) -> None:
        """Write the state within ``phase``, and the finished scene."""
        if self.path is None:
            return
        values = dict(state)
        values["phase"] = torch.tensor(phase)
        values["settings"] = torch.tensor(list(self._mark.encode()), dtype=torch.uint8)
        if scene is not None:
            values |= {f"scene.{name}": getattr(scene, name) for name in _FIELDS}
        write_tensors(self.path, values)

    def load(self) -> dict[str, Tensor] | None:
        """The saved state, or None when there is none.

        Raises:
            InputError: The file is damaged, or of other settings.
        """
        if self.path is None or not self.path.is_file():
            return None
        try:
            state: dict[str, Tensor] = torch.load(self.path, map_location="cpu", weights_only=True)
            mark = bytes(state["settings"].tolist()).decode()
            _ = state["phase"], state["done"], state["steps"], state["recent"]
        except Exception as error:
            raise InputError(
                f"{self.path}: the checkpoint is damaged ({type(error).__name__})",
                "remove it to start afresh",
            ) from error
        if mark != self._mark:
            raise InputError(
                f"{self.path}: the checkpoint is of other settings, {mark}",
                "remove it, or reconstruct with those settings",
            )
        _log.info("resuming from %s", self.path)
        return state

    @staticmethod
    def scene(state: dict[str, Tensor], device: torch.device) -> Gaussians | None:
        """The finished scene of a saved second phase."""
        if "scene.means" not in state:
            return None
        means, quats, scales, opacities, sh = (
            state[f"scene.{name}"].to(device) for name in _FIELDS
        )
        return Gaussians(means, quats, scales, opacities, sh)
