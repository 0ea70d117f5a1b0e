"""Schedules of a reconstruction: what a short run on a CPU does, and what a long one does."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gsfluent.errors import InputError

_LONG_FROM = 3000  # iterations; below, every step counts too much for resets and slow rates


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes.

    ``means`` is in units of the extent and decays exponentially to ``means_end`` of itself over the
    run; the others decay to ``others_end`` of themselves from ``others_from`` of the run on, so
    that the jitter of single photographs settles.
    """

    means: float = 1.6e-3
    means_end: float = 0.02
    scales: float = 1.0e-2
    quats: float = 2.0e-3
    opacities: float = 5.0e-2
    sh0: float = 1.0e-2
    sh_rest: float = 5.0e-4
    beta2: float = 0.99
    others_end: float = 1.0
    others_from: float = 0.5

    def at(self, name: str, progress: float) -> float:
        """Step size of a parameter at ``progress`` in [0, 1] of the run."""
        rate: float = getattr(self, name)
        if name == "means":
            return rate * self.means_end**progress
        late = max(0.0, progress - self.others_from) / max(1e-9, 1.0 - self.others_from)
        return rate * self.others_end**late


@dataclass(frozen=True)
class Recipe:
    """One schedule."""

    name: str  # what the report calls it
    object_rates: LearningRates  # step sizes when the extent is that of one object
    scene_rates: LearningRates  # step sizes when the extent is the distance of the cameras
    densify_from: int = 100  # first step that may densify
    densify_until: float = 0.6  # share of the run after which the count no longer grows
    densify_every: int = 100  # steps between two looks at the density
    # mean screen-space gradient (units of half the image width) above which a Gaussian is cloned or
    # split, for photographs cropped to the object; half of it for whole ones, whose mean weighs a
    # pixel about half as much.
    gradient_threshold: float = 4e-4
    # take the sum over the pixels of absolute gradients (Ye et al. 2024, AbsGS).
    absgrad: bool = False
    absgrad_threshold: float = 1.6e-3  # threshold for it, for photographs cropped to the object
    absgrad_whole: float = 0.5  # share of that for whole photographs
    reset_every: int = 0  # steps between opacity resets; 0 for none
    prune_opacity: float = 0.01  # opacity below which a Gaussian goes
    # weight of the mean opacity in the loss while the count may grow, so that Gaussians that are
    # not needed fade, are pruned and make room.
    opacity_pull: float = 0.0
    half_until: float = 0.35  # share of the run at half size
    # steps between two bands of view-dependent colour, at most a quarter of the run.
    sh_every: int = 1000
    start_opacity: float = 0.3  # opacity of Gaussians at sparse points
    start_scale: float = 0.7  # their size in units of the mean distance of three neighbours
    shell: bool = True  # add a far shell for plain walls
    max_gaussians: int = 60_000  # cap when none is given
    start_gaussians: int = 12_000  # start when none is given
    image_size: int = 400  # longer side of the photographs when none is given [px]


QUICK = Recipe("quick", LearningRates(), LearningRates(means=8e-4))

_SLOW = LearningRates(
    means=1.6e-4,
    means_end=0.01,
    scales=5e-3,
    quats=1e-3,
    opacities=5e-2,
    sh0=2.5e-3,
    sh_rest=1.25e-4,
    beta2=0.999,
)

CLASSIC = Recipe(
    "classic",
    replace(_SLOW, means=8e-4),
    _SLOW,
    densify_from=500,
    densify_until=1.0,
    reset_every=3000,
    prune_opacity=0.005,
    half_until=0.0,
    start_opacity=0.1,
    start_scale=1.0,
    shell=False,
    max_gaussians=5_000_000,
    start_gaussians=1_000_000,
    image_size=800,
)
"""The schedule of Kerbl et al. 2023 and gsplat's default trainer: what others are measured with."""

_BRISK = replace(
    _SLOW,
    means=4e-4,
    scales=1e-2,
    quats=2e-3,
    sh0=5e-3,
    sh_rest=2.5e-4,
    others_end=0.1,
    others_from=0.75,
)

LONG = replace(
    CLASSIC,
    name="long",
    object_rates=replace(_BRISK, means=8e-4),
    scene_rates=_BRISK,
    densify_until=0.5,
    reset_every=0,
    shell=True,
    absgrad=True,
    absgrad_whole=1.0,
    opacity_pull=0.03,
)
"""Long runs: no resets; a pull on opacities instead frees what is not needed (measured in
docs/theory/reconstruction.md)."""

RECIPES = {recipe.name: recipe for recipe in (QUICK, LONG, CLASSIC)}


def recipe_for(name: str, iterations: int) -> Recipe:
    """The recipe ``name``; "auto" takes quick below 3000 iterations and long from there.

    Raises:
        InputError: No such recipe.
    """
    if name == "auto":
        return LONG if iterations >= _LONG_FROM else QUICK
    if name not in RECIPES:
        raise InputError(
            f"reconstruct.recipe {name!r} is not known",
            f"choose auto, {', '.join(sorted(RECIPES))}",
        )
    return RECIPES[name]
