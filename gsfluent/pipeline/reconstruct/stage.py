"""Posed photographs to Gaussians: 3D Gaussian Splatting for one object (Kerbl et al. 2023).

What differs from the scene-scale recipe: masks give a visual hull to start on its surface and an
opacity loss to hold it; photographs are cropped to the object; densification is short and capped;
scales are regularised because the splats will be carried by a solid. A capture without masks is
learned whole first, then its object again from the silhouettes found.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import BACKGROUND, SURFACE, Capture, Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.capture.carve import carve_cavities
from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.capture.views import TrainView, read_views
from gsfluent.pipeline.reconstruct.density import contained, draws
from gsfluent.pipeline.reconstruct.evaluate import HOLD_OUT, evaluate
from gsfluent.pipeline.reconstruct.floaters import clean_views
from gsfluent.pipeline.reconstruct.init import hull_gaussians, joined_start, point_gaussians
from gsfluent.pipeline.reconstruct.isolate import Isolate
from gsfluent.pipeline.reconstruct.masks import agreed_hull, object_views, seen_background
from gsfluent.pipeline.reconstruct.model import SplatModel
from gsfluent.pipeline.reconstruct.recipe import recipe_for
from gsfluent.pipeline.reconstruct.train import Checkpoint, Trainer, TrainSettings, decibels
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress

_log = logging.getLogger(__name__)

_SCENE_SHARE = 0.6  # of the steps for everything, before the object gets the rest
_FAINT = 0.02  # opacity below which a trained Gaussian is dropped
_BUDGET = 100_000  # of MCMC, when none is given
_HULL_START = 20_000  # Gaussians on a hull at most; photographs ask for more where they want them


class Reconstruct(Stage):
    """Train Gaussians on a capture.

    Args:
        iterations: Training steps, one photograph each.
        max_gaussians: Hard cap on the count; the recipe's when None. It is the budget of MCMC
            (100,000 when None), which fills it.
        kernel: "anisotropic" (ellipsoids) or "isotropic" (spheres; costs about 4 dB).
        scale_regularization: Strength of the pull towards small, not needle-shaped Gaussians; when
            None 1 for an object, and 0 for a whole scene, whose plain walls need large ones.
        image_size: Longer side of the photographs in training [px]; the recipe's when None.
        sh_degree: Bands of view-dependent colour, 0 to 3. 0 (matte) relights best.
        start_gaussians: Gaussians to start with; the recipe's when None.
        gradient_threshold: Mean screen-space gradient (units of half the image width) above which a
            Gaussian is cloned or split; the recipe's when None.
        absgrad: Judge that by the sum of absolute gradients over the pixels (AbsGS), which finds
            large Gaussians over fine texture; as the recipe says when None.
        recipe: Schedule: "quick", "long", "classic" (Kerbl et al. 2023), or "auto": quick below
            3000 iterations, long from there.
        densify: "adc" (adaptive density control) or "mcmc" (relocation and noise with a budget).
        target_psnr: PSNR [dB] on the training photographs that is enough: Gaussians are added only
            where the error is above it, and dropped while it is below. None: as many as the
            schedule makes.
        exposure: Learn an affine change of colour per photograph. Held-out photographs get none.
        deterministic: The same bits in every run on the same GPU, for some time
            (docs/measured/deterministic.md); on the CPU they are the same anyway.
        checkpoint: File to save to while training and to resume from when it exists.
        checkpoint_every: Steps between saves; a tenth of the run, at least 250, when None.
        separate: Without masks, spend the last 40 % of the steps on the object alone: find it in
            what was learned until then (:class:`Isolate`), and train it afresh on its silhouettes.
        clean: Take floaters out of the object at the end (:func:`clean_floaters`).
        carve: Start in the cavities that no silhouette shows but colours do
            (:func:`gsfluent.pipeline.capture.carve_cavities`), not on their lids.
        device: Where to train; where the points of the capture are when None.
        seed: Seed of everything random.

    Raises:
        InputError: A setting is out of range.
    """

    name = "reconstruct"

    def __init__(
        self,
        iterations: int = 800,
        max_gaussians: int | None = None,
        kernel: str = "anisotropic",
        scale_regularization: float | None = None,
        image_size: int | None = None,
        *,
        sh_degree: int = 0,
        start_gaussians: int | None = None,
        gradient_threshold: float | None = None,
        absgrad: bool | None = None,
        recipe: str = "auto",
        densify: str = "adc",
        target_psnr: float | None = None,
        exposure: bool = False,
        deterministic: bool = False,
        checkpoint: str | Path | None = None,
        checkpoint_every: int | None = None,
        separate: bool = True,
        clean: bool = True,
        carve: bool = True,
        device: str | torch.device | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        for label, name, known in (
            ("kernel", kernel, ("anisotropic", "isotropic")),
            ("densify", densify, ("adc", "mcmc")),
        ):
            if name not in known:
                raise InputError(
                    f"reconstruct.{label} {name!r} is not known", f"choose {' or '.join(known)}"
                )
        self.recipe = recipe_for(recipe, int(iterations))
        for label, value, low, high in (
            ("iterations", iterations, 1, 1_000_000),
            ("max_gaussians", max_gaussians, 10, 50_000_000),
            ("image_size", image_size, 24, 8192),
            ("sh_degree", sh_degree, 0, 3),
            ("scale_regularization", scale_regularization, 0.0, 1e6),
            ("target_psnr", target_psnr, 1.0, 100.0),
            ("gradient_threshold", gradient_threshold, 0.0, 1e6),
        ):
            if value is not None and not low <= value <= high:
                raise InputError(
                    f"reconstruct.{label} must be {low} to {high}, got {value}", "change it"
                )
        self.iterations = int(iterations)
        limit = self.recipe.max_gaussians
        self.max_gaussians = int(
            max_gaussians or (min(limit, _BUDGET) if densify == "mcmc" else limit)
        )
        self.kernel, self.densify = kernel, densify
        self.scale_regularization = scale_regularization
        self.image_size = int(image_size or self.recipe.image_size)
        self.sh_degree = int(sh_degree)
        start = self.recipe.start_gaussians if start_gaussians is None else int(start_gaussians)
        self.start_gaussians = min(start, self.max_gaussians)
        self.absgrad = self.recipe.absgrad if absgrad is None else bool(absgrad)
        if gradient_threshold is None:
            chosen = self.recipe
            gradient_threshold = (
                chosen.absgrad_threshold if self.absgrad else chosen.gradient_threshold
            )
        self.gradient_threshold = float(gradient_threshold)
        self.target_psnr = target_psnr
        self.exposure = bool(exposure)
        self.deterministic = bool(deterministic)
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.checkpoint_every = int(checkpoint_every or max(250, self.iterations // 10))
        self.separate = bool(separate)
        self.clean = bool(clean)
        self.carve = bool(carve)
        self.device = None if device is None else torch.device(device)

    def forward(self, capture: Capture, progress: Progress | None = None) -> Gaussians:
        """Train on a capture.

        Args:
            capture: Posed photographs, with masks, or with sparse points.
            progress: Called every 10 steps (50 off the CPU) as ``progress(step, total, note)``.

        Returns:
            The Gaussians in the capture's world frame; ``report`` holds ``images, held_out, psnr,
            ssim, psnr_region, psnr_inside, gaussians, iterations, seconds, train_seconds (without
            reading and judging), resumed_at, start, object_gaussians, history (rows of step, count,
            PSNR on the last training photographs), cleaned`` (see :func:`clean_floaters`; None when
            nothing was told from its background), ``hull`` (see
            :func:`~gsfluent.pipeline.capture.carve_cavities`; None when there was none). When the
            object was told from its background, labels are set.

        Raises:
            InputError: Black photographs, no masks and no points, or masks that contradict poses.
            RunError: Training diverged.
        """
        started = time.monotonic()
        device = self.device or capture.points.device
        train_set, held = capture.split(HOLD_OUT)
        views = read_views(train_set, self.image_size, device, crop=True)
        run = _Run(self, Checkpoint(self.checkpoint, self._identity()), progress)
        trained = time.monotonic()
        if views[0].mask is not None:
            start = "visual hull"
            hull = agreed_hull(views)
            gaussians = run.object_of(views, hull, 0, self.iterations).labelled(SURFACE)
        else:
            gaussians, start = run.scene_of(train_set, views), "sparse points"
        if gaussians.count == 0:
            raise RunError(
                "reconstruct: every Gaussian faded away in training",
                hint="check that the poses belong to the photographs (gsfluent inspect)",
            )
        trained = _now(device) - trained
        labels = gaussians.labels
        report = {
            "images": len(capture),
            "held_out": 0 if held is None else len(held),
            **evaluate(gaussians, held, self.image_size),
            "gaussians": gaussians.count,
            "object_gaussians": None if labels is None else int((labels == SURFACE).sum()),
            "iterations": self.iterations,
            "image_size": self.image_size,
            "start": start,
            "recipe": self.recipe.name,
            "densify": self.densify,
            "target_psnr": self.target_psnr,
            "exposure": self.exposure,
            "deterministic": self.deterministic or device.type == "cpu",
            "history": run.history,
            "cleaned": run.cleaned,
            "hull": run.hull,
            "resumed_at": run.resumed_at,
            "train_seconds": round(trained, 2),
            "seconds": round(time.monotonic() - started, 2),
        }
        return gaussians.replace(report=report)

    def _identity(self) -> dict[str, Any]:
        """What a checkpoint must agree on to be resumed."""
        names = (
            "iterations", "max_gaussians", "kernel", "scale_regularization", "image_size",
            "sh_degree", "start_gaussians", "gradient_threshold", "absgrad", "densify",
            "target_psnr", "exposure", "separate", "seed",
        )  # fmt: skip
        identity = {name: getattr(self, name) for name in names} | {"recipe": self.recipe.name}
        # what was trained until then must repeat as well
        identity |= {"deterministic": True} if self.deterministic else {}
        return identity | ({} if self.carve else {"carve": False})


class _Run:
    """One call of the stage: its phases, progress and checkpoints."""

    def __init__(
        self,
        stage: Reconstruct,
        checkpoint: Checkpoint,
        progress: Progress | None,
    ) -> None:
        self.stage = stage
        self.checkpoint = checkpoint
        self.progress = progress
        self.history: list[tuple[int, int, float]] = []
        self.saved = checkpoint.load()
        self.resumed_at = 0
        self.cleaned: dict[str, Any] | None = None
        self.hull: dict[str, Any] | None = None

    def scene_of(self, capture: Capture, views: list[TrainView]) -> Gaussians:
        """Learn everything, then the object again from the silhouettes of what was found."""
        stage = self.stage
        steps = stage.iterations
        if stage.separate:
            steps = max(1, round(_SCENE_SHARE * steps))
        scene = None
        if self.saved is not None and int(self.saved["phase"]) == 1:
            scene = Checkpoint.scene(self.saved, views[0].color.device)
        if scene is None:
            start, extent = point_gaussians(
                capture,
                views,
                stage.start_gaussians,
                stage.sh_degree,
                draws(stage.seed, 5, 0),
                stage.recipe,
            )
            rates = stage.recipe.scene_rates
            model = SplatModel(
                start,
                extent,
                isotropic=stage.kernel == "isotropic",
                rates=rates,
                deterministic=stage.deterministic,
            )
            scene = self._train(model, views, 0, 0, steps, None, None)
        if steps == stage.iterations:
            return scene
        try:
            found, rest = Isolate("plane", seed=stage.seed).split(scene, capture)
        except InputError as error:
            _log.warning("the object was not told from its background: %s", error.what)
            return scene
        masked, _ = object_views(views, found, rest)
        if len(masked) < max(3, len(views) // 2):
            _log.warning(
                "the object shows in %d of %d views; not separated", len(masked), len(views)
            )
            return scene
        try:
            hull = agreed_hull(masked)
        except InputError:  # these silhouettes are ours: nothing that a user gave is wrong
            _log.warning(
                "the silhouettes of the object have no common body; it stays as %d of %d steps "
                "have it: more steps, larger photographs, or masks", steps, stage.iterations,
            )  # fmt: skip
            return Gaussians.cat([found.labelled(SURFACE), rest.labelled(BACKGROUND)])
        found = self.object_of(masked, hull, steps, stage.iterations - steps, scene, found)
        rest, _ = seen_background(found, rest, views)
        return Gaussians.cat([found.labelled(SURFACE), rest.labelled(BACKGROUND)])

    def object_of(
        self,
        views: list[TrainView],
        hull: Hull,
        before: int,
        steps: int,
        scene: Gaussians | None = None,
        found: Gaussians | None = None,
    ) -> Gaussians:
        """Learn what the masks show, from their visual hull.

        Args:
            views: Masked, cropped views.
            hull: Their visual hull.
            before: Steps done in earlier phases.
            steps: Steps of this one.
            scene: Result of the earlier phase, kept in checkpoints.
            found: The object as the earlier phase has it.
        """
        stage = self.stage
        count = min(stage.start_gaussians, _HULL_START)
        # only the start: in training, Gaussians may be wherever the masks allow them
        body = hull
        if stage.carve:
            body, self.hull = carve_cavities(hull, views)
        start = hull_gaussians(body, views, count, stage.sh_degree, draws(stage.seed, 6, 0))
        if found is not None:
            start = joined_start(hull, start, found)
        lower, upper = hull.bounds()
        model = SplatModel(
            start,
            0.5 * float((upper - lower).max()),
            isotropic=stage.kernel == "isotropic",
            rates=stage.recipe.object_rates,
            deterministic=stage.deterministic,
        )
        phase = 0 if scene is None else 1
        gaussians = self._train(model, views, phase, before, steps, hull, scene)
        if stage.clean and gaussians.count and stage.kernel == "anisotropic":
            inside, outside = contained(gaussians, hull)
            if inside.count:
                gaussians = inside
                _log.info("%d Gaussians lay outside the hull", outside)
        if stage.clean and gaussians.count:
            gaussians, self.cleaned = clean_views(gaussians, views, hull=hull)
        return gaussians

    def _train(
        self,
        model: SplatModel,
        views: list[TrainView],
        phase: int,
        before: int,
        steps: int,
        hull: Hull | None,
        scene: Gaussians | None,
    ) -> Gaussians:
        stage = self.stage
        whole = 1.0  # share of the threshold, see Recipe.gradient_threshold
        if hull is None:
            whole = stage.recipe.absgrad_whole if stage.absgrad else 0.5
        regularization = stage.scale_regularization
        if regularization is None:
            regularization = 0.0 if hull is None else 1.0
        settings = TrainSettings(
            stage.recipe,
            steps,
            stage.max_gaussians,
            regularization,
            stage.sh_degree,
            stage.gradient_threshold * whole,
            densify=stage.densify,
            absgrad=stage.absgrad,
            target_psnr=stage.target_psnr,
            exposure=stage.exposure,
            seed=stage.seed + phase,
        )
        trainer = Trainer(model, views, settings, hull)
        if self.saved is not None and int(self.saved["phase"]) == phase:
            trainer.restore(self.saved)
            self.resumed_at = before + trainer.done
            self.saved = None

        def on_look(done: int, error: float) -> None:
            note = f"{decibels(error):.1f} dB, {model.count} Gaussians"
            report_progress(self.progress, before + done, stage.iterations, note)

        def save(done: int) -> None:
            self.checkpoint.save(trainer.state(), phase, scene)

        try:
            trainer.run(on_look, save, stage.checkpoint_every)
        except RunError as error:
            kept = self.checkpoint.path
            if kept is None or not kept.is_file():
                raise
            raise RunError(error.what, f"the last checkpoint, {kept}", error.hint) from error
        self.history += [
            (before + step, count, round(db, 2)) for step, count, db in trainer.history
        ]
        gaussians = model.gaussians(stage.sh_degree)
        return gaussians.select(gaussians.opacities > min(_FAINT, stage.recipe.prune_opacity))


def _now(device: torch.device) -> float:
    """The clock, once the device has done what it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.monotonic()
