"""How many Gaussians, and where: adaptive density control, or MCMC with a budget.

Both look at the model every hundred steps. Adaptive density control (Kerbl et al. 2023) clones and
splits what the photographs pull at and prunes what is transparent; with ``absgrad`` the pull is the
sum of absolute per-pixel gradients (Ye et al. 2024, AbsGS). MCMC (Kheradmand et al. 2024) moves
transparent Gaussians onto opaque ones, grows by 5 % towards its budget and shakes the centres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Gaussians
from gsfluent.errors import RunError
from gsfluent.geometry import normalize_quaternions, quaternion_to_matrix
from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.pipeline.reconstruct.model import Pulls, SplatModel
from gsfluent.pipeline.reconstruct.recipe import Recipe

_SPLIT_FACTOR = 1.6  # a split Gaussian's parts are this much smaller (Kerbl et al. 2023)
_SPLIT_ABOVE = 0.01  # of the extent: larger is split, smaller cloned
_RESET_OPACITY = 0.01
_GROWTH = 1.05  # of the count, each time (MCMC)
_DEAD = 0.005  # opacity below which MCMC relocates
_NOISE = 80.0  # strength of the noise: 5e5 times a step of 1.6e-4, in units of the extent
_NOISE_END = 0.01  # of it, at the end of the run
_NOISE_EVERY = 5  # steps; five times the variance, a fifth of the work
_UNTIL = 0.85  # of the run: the end of relocation and growth (MCMC)
_SHARPNESS = 100.0  # of the switch that spares opaque Gaussians from noise
_MOST_COPIES = 50  # one Gaussian is split among at most so many
_MCMC_OPACITY = 0.01  # weight of the mean opacity in the loss
_MCMC_SCALE = 0.01  # weight of the mean scale, in units of the extent
_ASPECT = 2.0  # longest over middle axis of what is kept: more is a needle
_OVERHANG = 0.004  # of the object's size: how far a Gaussian may reach beyond the hull
_LOOSE = 0.01  # the same in training: a tighter hold costs half a decibel inside the masks
_SEEN = 0.02  # opacity at which a Gaussian ends for the eye
_ROUNDING = 1e-3  # of the overhang


def draws(seed: int, purpose: int, step: int) -> torch.Generator:
    """A CPU generator for one purpose at one step; a resumed run draws what the whole run drew."""
    return torch.Generator().manual_seed((seed * 1_000_003 + step) * 8 + purpose)


@dataclass(frozen=True)
class Place:
    """Where Gaussians may be."""

    hull: Hull | None  # visual hull of the object; None for a whole scene
    eyes: Tensor  # camera positions [V, 3]

    def misplaced(self, model: SplatModel) -> Tensor:
        """Gaussians that are huge, not finite, outside the hull or right before a lens, [N]."""
        means, largest = model.parameters["means"], model.scales().amax(1)
        wrong = ~torch.isfinite(means).all(1)
        if self.hull is not None:
            wrong |= largest >= 0.3 * model.extent
            wrong |= ~self.hull.contains(means, slack=4)
        else:
            # Matter right before a lens explains one photograph and spoils all others.
            for eye in self.eyes:
                wrong |= (means - eye).square().sum(1) < (0.3 * model.extent) ** 2
            wrong |= largest >= model.extent
        return wrong

    def restrain(self, model: SplatModel) -> None:
        """Shorten what reaches beyond the hull until it ends there; nothing without a hull."""
        if self.hull is None or model.isotropic:
            return
        p, splats = model.parameters, model.activated(0)
        rooms = shortened(
            p["means"],
            p["quats"],
            splats.scales,
            splats.opacities,
            self.hull,
            _LOOSE * 2.0 * model.extent,
        )
        p["scales"].add_(rooms.log())


def ends(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, share: Tensor | None = None
) -> Tensor:
    """Where Gaussians end for the eye: both ends of each axis, [N, 3, 2, 3].

    An axis ends where the opacity has fallen to 0.02, ``sqrt(2 log(o / 0.02))`` deviations from the
    centre; what is fainter at its centre is a point.

    Args:
        means: Centres, [N, 3].
        quats: Rotations, [N, 4].
        scales: Standard deviations, [N, 3].
        opacities: Peak opacities, [N].
        share: Of each axis that is taken, [N, 3]; all of it when None.
    """
    reach = (2.0 * (opacities.clamp_min(_SEEN) / _SEEN).log()).sqrt()
    length = scales * reach[:, None]
    if share is not None:
        length = length * share
    axes = (quaternion_to_matrix(normalize_quaternions(quats)) * length[:, None, :]).mT
    return torch.stack([means[:, None] + axes, means[:, None] - axes], 2)


def shortened(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    hull: Hull,
    overhang: float,
) -> Tensor:
    """Share of each axis [N, 3] that ends at most ``overhang`` [world units] beyond the hull.

    At least 0.02 is left, also of what has its centre farther out.
    """
    away, origin = hull.distances()
    return ops.shorten_axes(
        means,
        quats,
        scales,
        opacities,
        away.to(means),
        origin=origin,
        voxel=hull.voxel,
        overhang=overhang,
    )


def contained(gaussians: Gaussians, hull: Hull) -> tuple[Gaussians, int]:
    """Gaussians that end within the hull, give or take 0.4 % of its size, and how many went.

    Axes that reach farther are cut; what still does has its centre outside and goes.
    """
    low, high = hull.bounds()
    overhang = _OVERHANG * float((high - low).max())
    shape = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    scales = gaussians.scales * shortened(*shape, hull, overhang)
    cut = ends(gaussians.means, gaussians.quats, scales, gaussians.opacities)
    away = hull.beyond(cut.reshape(-1, 3)).reshape(-1, 6)
    keep = (away <= overhang * (1.0 + _ROUNDING)).all(1)
    return gaussians.replace(scales=scales).select(keep), int((~keep).sum())


def clamp_aspect(model: SplatModel) -> None:
    """No longest axis over twice the middle one; strokes and needles swing and stick out."""
    if not model.isotropic:
        ops.clamp_aspect(model.parameters["scales"], _ASPECT)


@dataclass(frozen=True)
class Wanted:
    """What the image error asks of the next change of the count."""

    grow: Tensor | None = None  # gaussians that may be multiplied, bool [N]; None for all
    drop: Tensor | None = None  # gaussians that the images do not need, bool [N]; None for none
    stop: bool = False  # add none at all


class Density:
    """What the training loop asks of a density control; what one leaves out does nothing."""

    absgrad = False

    def probe(self, model: SplatModel) -> Tensor | None:
        """Zeros [N, 2] for the projected centres when their gradient is wanted, or None."""
        return None

    def observe(self, radii: Tensor, slope: Tensor, view: TrainView) -> None:
        """Take note of one view: radii [N], and the gradient [N, 2] if :meth:`probe` wants it."""

    def pulls(self, model: SplatModel) -> Pulls:
        """Weights of penalties in the loss."""
        return Pulls()

    def after_step(self, model: SplatModel, done: int) -> None:
        """Called after every optimiser step."""

    def control(self, model: SplatModel, done: int, wanted: Wanted) -> None:
        """Change the Gaussians; called every ``densify_every`` steps."""

    def forget(self) -> None:
        """Drop what was noted of single Gaussians: their rows have changed."""

    def state(self) -> dict[str, Tensor]:
        """What must be saved."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what :meth:`state` returned."""


class Adc(Density):
    """Adaptive density control.

    Args:
        recipe: Schedule.
        iterations: Length of the run.
        limit: Cap on the count.
        threshold: Mean screen-space gradient above which a Gaussian is cloned or split.
        place: Where Gaussians may be.
        absgrad: Whether the probe receives absolute gradients.
        seed: Seed of the places of split parts.
    """

    def __init__(
        self,
        recipe: Recipe,
        iterations: int,
        limit: int,
        threshold: float,
        place: Place,
        *,
        absgrad: bool,
        seed: int,
    ) -> None:
        self.recipe, self.iterations, self.limit = recipe, iterations, limit
        self.threshold, self.place, self.absgrad, self.seed = threshold, place, absgrad, seed
        self.gradient = self.visits = torch.empty(0)

    def probe(self, model: SplatModel) -> Tensor | None:
        """Zeros, while the count may grow."""
        if model.steps >= self.recipe.densify_until * self.iterations:
            return None
        return torch.zeros(model.count, 2, device=model.device)

    def observe(self, radii: Tensor, slope: Tensor, view: TrainView) -> None:
        """Add one view's screen-space gradient, in units of half the image width."""
        if slope.numel() == 0:
            return
        if len(self.gradient) != len(slope):
            self.gradient = torch.zeros(len(slope), device=slope.device)
            self.visits = torch.zeros_like(self.gradient)
        # 0 where not seen
        self.gradient.add_(slope.norm(dim=1), alpha=0.5 * view.full_width)
        self.visits += radii > 0

    def pulls(self, model: SplatModel) -> Pulls:
        """Pull on opacities, as the recipe has it, while the count may grow."""
        growing = model.steps < self.recipe.densify_until * self.iterations
        return Pulls(opacity=self.recipe.opacity_pull if growing else 0.0)

    def after_step(self, model: SplatModel, done: int) -> None:
        """Reset opacities when it is time."""
        recipe = self.recipe
        growing = done < recipe.densify_until * self.iterations
        if recipe.reset_every and done % recipe.reset_every == 0 and growing:
            reset_opacities(model)

    def control(self, model: SplatModel, done: int, wanted: Wanted) -> None:
        """Clone and split, then prune what is transparent or misplaced.

        Raises:
            RunError: Nothing is left.
        """
        recipe = self.recipe
        if recipe.densify_from <= done <= recipe.densify_until * self.iterations:
            if not wanted.stop and len(self.gradient) == model.count:
                mean = self.gradient / self.visits.clamp_min(1.0)
                if wanted.grow is not None:
                    mean = mean * wanted.grow
                densify(model, mean, self.threshold, self.limit, draws(self.seed, 1, done))
        keep = ~self.place.misplaced(model)
        keep &= model.opacities() > recipe.prune_opacity
        if wanted.drop is not None:
            keep[: len(wanted.drop)] &= ~wanted.drop
        if not bool(keep.any()):
            raise RunError(
                f"reconstruct: no Gaussian survived step {done}",
                hint="check that masks, poses and photographs belong together",
            )
        model.keep(keep)
        self.forget()

    def forget(self) -> None:
        """Start the sums afresh."""
        self.gradient = self.visits = torch.empty(0)

    def state(self) -> dict[str, Tensor]:
        """The sums since the last control."""
        return {"gradient": self.gradient, "visits": self.visits}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over what :meth:`state` returned."""
        device = self.place.eyes.device
        self.gradient, self.visits = state["gradient"].to(device), state["visits"].to(device)


def reset_opacities(model: SplatModel) -> None:
    """Cut opacities to 0.01, so that only what the photographs need comes back."""
    ceiling = math.log(_RESET_OPACITY / (1.0 - _RESET_OPACITY))
    model.parameters["opacities"].clamp_(max=ceiling)
    model.first["opacities"].zero_()
    model.second["opacities"].zero_()


def densify(
    model: SplatModel, score: Tensor, threshold: float, limit: int, generator: torch.Generator
) -> int:
    """Clone small and split large Gaussians whose score is above the threshold, best first.

    Args:
        model: What is changed.
        score: Pull of the photographs on each Gaussian, [N].
        threshold: Least score.
        limit: Cap on the count.
        generator: Draws where the parts of a split lie (CPU).

    Returns:
        How many were added.
    """
    room = min(limit - model.count, int((score > threshold).sum()))
    if room <= 0:
        return 0
    chosen = score.topk(room).indices.sort().values
    scales = model.scales()[chosen]
    large = scales.amax(1) > _SPLIT_ABOVE * model.extent
    draw = torch.randn(room, 3, generator=generator).to(scales)
    quats = normalize_quaternions(model.parameters["quats"][chosen])
    shift = (quaternion_to_matrix(quats) @ (draw * scales)[..., None])[..., 0] * large[:, None]
    smaller = math.log(_SPLIT_FACTOR) * large[:, None]
    new = model.rows(chosen)
    new["means"] += shift
    new["scales"] -= smaller
    model.parameters["scales"][chosen] -= smaller
    model.parameters["means"][chosen] -= shift
    model.append(new)
    return room


class Mcmc(Density):
    """Relocation, growth to a budget, and noise on the centres.

    Args:
        recipe: Schedule; relocation and growth go on until 85 % of the run, though.
        iterations: Length of the run.
        limit: The budget.
        place: Where Gaussians may be; what is elsewhere counts as dead.
        seed: Seed of draws and noise.
    """

    def __init__(
        self, recipe: Recipe, iterations: int, limit: int, place: Place, *, seed: int
    ) -> None:
        self.recipe, self.iterations, self.limit = recipe, iterations, limit
        self.place, self.seed = place, seed
        self.generator: torch.Generator | None = None

    def pulls(self, model: SplatModel) -> Pulls:
        """Pull on opacities and scales, so that Gaussians that are not needed die."""
        return Pulls(size=_MCMC_SCALE, opacity=_MCMC_OPACITY)

    def after_step(self, model: SplatModel, done: int) -> None:
        """Shake the centres along each Gaussian, the transparent ones most."""
        if done % _NOISE_EVERY != 0:
            return
        if self.generator is None:
            self.generator = torch.Generator(device=model.device)
        generator = self.generator
        generator.manual_seed((self.seed * 1_000_003 + done) * 8 + 2)
        means = model.parameters["means"]
        draw = torch.randn(means.shape, generator=generator, device=means.device)
        # sigmoid(-k (o - 0.005)): 1/2 at the opacity that is dead, none from 0.05 on
        weight = torch.sigmoid(-_SHARPNESS * (model.opacities() - _DEAD))
        # covariances over the extent: the original lets the scene have the size 1
        rate = _NOISE * _NOISE_END ** (done / self.iterations) / model.extent
        rate *= math.sqrt(_NOISE_EVERY)
        turn = quaternion_to_matrix(normalize_quaternions(model.parameters["quats"]))
        variance = model.scales().square()
        local = (turn.transpose(1, 2) @ draw[..., None])[..., 0] * variance
        means += (turn @ local[..., None])[..., 0] * (weight * rate)[:, None]

    def control(self, model: SplatModel, done: int, wanted: Wanted) -> None:
        """Relocate the dead, and grow.

        Raises:
            RunError: All are dead.
        """
        if not self.recipe.densify_from <= done <= _UNTIL * self.iterations:
            if wanted.drop is not None:
                model.keep(~wanted.drop)
            return
        dead = self.place.misplaced(model) | (model.opacities() <= _DEAD)
        if wanted.drop is not None:
            dead |= wanted.drop
        if bool(dead.all()):
            raise RunError(
                f"reconstruct: no Gaussian survived step {done}",
                hint="check that masks, poses and photographs belong together",
            )
        generator = draws(self.seed, 3, done)
        if wanted.stop:
            model.keep(~dead)
            return
        weight = model.opacities() * ~dead
        if wanted.grow is not None and bool((weight * wanted.grow).any()):
            weight = weight * wanted.grow
        relocate(model, dead, weight, generator)
        added = min(self.limit, int(_GROWTH * model.count)) - model.count
        if added > 0:
            grow(model, added, model.opacities() if wanted.grow is None else weight, generator)


def shared_out(opacity: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scales of ``copies`` Gaussians that together look like one.

    Kheradmand et al. 2024, equation 9: ``o' = 1 - (1 - o)^(1/n)`` keeps the transmittance through
    the centre, and ``s' = s o / sum_{i=1..n} sum_{k<i} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1)``
    keeps the integral across it.

    Args:
        opacity: Opacity of the one, [M].
        scales: Its standard deviations, [M, 3].
        copies: How many replace it, [M] integers, at least 1 (at most 50 are counted).

    Returns:
        Opacity [M] and scales [M, 3] of each.
    """
    opacity = opacity.double()
    copies = copies.clamp(1, _MOST_COPIES)
    each = -torch.expm1(torch.log1p(-opacity) / copies)
    total = torch.zeros_like(each)
    # sum_i sum_k C(i-1, k) (-1)^k x^(k+1) / sqrt(k+1); the inner alternating sums lose digits for
    # large i only where x is near 1, and x = each falls with the number of copies.
    for i in range(1, int(copies.max()) + 1):
        terms = [math.comb(i - 1, k) * (-1.0) ** k / math.sqrt(k + 1) for k in range(i)]
        power = torch.arange(1, i + 1, device=opacity.device)
        inner = (each.new_tensor(terms) * each[:, None] ** power).sum(1)
        total += torch.where(copies >= i, inner, torch.zeros_like(inner))
    factor = opacity / total.clamp_min(1e-12)
    return each.to(scales), scales * factor.to(scales)[:, None]


def relocate(model: SplatModel, dead: Tensor, weight: Tensor, generator: torch.Generator) -> None:
    """Move dead Gaussians onto living ones, drawn by ``weight`` [N]; the picture stays."""
    gone = dead.nonzero()[:, 0]
    if len(gone) == 0:
        return
    source = _draw(weight, len(gone), generator)
    _share(model, source)
    for name, value in model.rows(source).items():
        model.parameters[name][gone] = value
    model.forget(gone)


def grow(model: SplatModel, count: int, weight: Tensor, generator: torch.Generator) -> None:
    """Add ``count`` Gaussians by sharing out those drawn by ``weight`` [N]; the picture stays."""
    source = _draw(weight, count, generator)
    _share(model, source)
    model.append(model.rows(source))


def _draw(weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Rows drawn with replacement in proportion to ``weight``, by inversion (no 2^24 limit)."""
    edges = weight.cpu().double().cumsum(0)  # in one order; a GPU's is chance
    at = torch.rand(count, generator=generator, dtype=torch.float64) * edges[-1]
    drawn = torch.searchsorted(edges, at, right=True).clamp_max(len(weight) - 1)
    return drawn.to(weight.device)


def _share(model: SplatModel, source: Tensor) -> None:
    """Share each Gaussian named in ``source`` among itself and its copies."""
    named, counts = source.unique(return_counts=True)
    opacity, scales = shared_out(model.opacities()[named], model.scales()[named], counts + 1)
    raw = torch.logit(opacity.clamp(_DEAD, 1.0 - 1e-6))
    model.parameters["opacities"][named] = raw
    width = model.parameters["scales"].shape[1]
    model.parameters["scales"][named] = scales[:, :width].log()
    model.forget(named)
