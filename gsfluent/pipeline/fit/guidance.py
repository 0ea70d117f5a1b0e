"""Numbers that make a film likelier to a video model: no motion was seen, only a text was given.

The gradient at the pixels comes from the model (:mod:`gsfluent.pipeline.fit.video_prior`), that of
the pixels by the numbers from differences of the resident solver: for up to 12 numbers they are
cheaper than the adjoint of the composed step, which costs 80 runs (docs/theory/fit.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.draw import draw_at
from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.carrying import carried
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.parameters import Unknowns, read_learn
from gsfluent.pipeline.fit.stage import Found, with_values
from gsfluent.pipeline.fit.together import TooFast
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.render.camera import Action, look_at
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress
from gsfluent.scene.scene import Scene
from gsfluent.targets.target import Followers, Motion

Array = NDArray[np.float64]
STEP = 1e-3
"""Difference of a free coordinate."""
RATE, MOMENTS = 0.1, (0.8, 0.95)
"""Of Adam (Kingma and Ba 2015) on decades, as PhysDreamer has them."""
FAR = 2.0
"""No number goes further from its start, in free coordinates."""
AWAY, AZIMUTH, ELEVATION = 3.6, -90.0, 12.0
"""The camera: distance in radii of what moves, degrees."""
STRETCH = (0.3, 3.0)


class Prior(Protocol):
    """Something that says how the pixels of a clip should change."""

    def push(self, clip: Tensor, random: torch.Generator) -> Tensor:
        """Gradient at a clip [T, 3, H, W] in 0..1."""


class Guide(Stage):
    """Learns numbers from what a video model takes for likely, by score distillation.

    What comes back is no measurement: it has no bands, and says so.

    Args:
        learn: As of :class:`gsfluent.pipeline.Fit`.
        prior: The video model.
        seconds: Length of the film.
        frames: Of the film.
        size: Its sides [px]; of a model's latents a multiple of 8.
        rounds: Steps of Adam; each takes a run for every number, and one.
        cells: Cells along the longest side of the largest body.
        camera: That stands still; one that sees all of the motion when absent.
        device: Where the solver runs.
        seed: Of noise and times: the same one gives the same bits.

    Raises:
        InputError: A number out of range.
    """

    name = "guide"

    def __init__(
        self,
        learn: Mapping[str, Mapping[str, Any]] | Sequence[str],
        prior: Prior,
        *,
        seconds: float = 1.0,
        frames: int = 16,
        size: int = 256,
        rounds: int = 60,
        cells: int = 8,
        camera: Camera | None = None,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        for name, value, low, high in (
            ("frames", frames, 2, 256), ("size", size, 16, 4096), ("rounds", rounds, 1, 10**5),
            ("cells", cells, 4, 256), ("seconds", seconds, 1e-3, 60.0),
        ):  # fmt: skip
            if not low <= value <= high:
                raise InputError(f"guide: {name} is {value}", f"give a number from {low} to {high}")
        self.learn, self.prior, self.camera = learn, prior, camera
        self.times = [k * seconds / (frames - 1) for k in range(frames)]
        self.size, self.rounds, self.cells, self.device = size, rounds, cells, device

    def forward(self, scene: Scene, *, progress: Progress | None = None) -> Found:
        """Learn.

        Args:
            scene: The start; its splats are what is filmed.
            progress: Told after each step.

        Raises:
            InputError: What is to be learnt cannot be, or there are no splats.
            RunError: The start cannot be run.
        """
        unknowns = read_learn(scene, self.learn)
        forward = Forward(
            scene, self.times, grid_spacing(scene, self.cells), device=self.device
        )  # fmt: skip
        filmed = Film(forward, self.size, self.camera)
        random = torch.Generator().manual_seed(self.seed)
        free, first, second = unknowns.start.copy(), *np.zeros((2, len(unknowns)))
        trace = [unknowns.values(free)]
        for number in range(1, self.rounds + 1):
            slope = self._slope(forward, filmed, unknowns, free, random)
            first = MOMENTS[0] * first + (1.0 - MOMENTS[0]) * slope
            second = MOMENTS[1] * second + (1.0 - MOMENTS[1]) * slope**2
            mean, size = first / (1.0 - MOMENTS[0] ** number), second / (1.0 - MOMENTS[1] ** number)
            free = free - RATE * mean / (np.sqrt(size) + 1e-12)
            free = np.clip(free, unknowns.start - FAR, unknowns.start + FAR)
            trace.append(unknowns.values(free))
            report_progress(progress, number, self.rounds, "guided")
        values = trace[-1]
        begun = {p.key: p.start[0] if p.size == 1 else list(p.start) for p in unknowns.parameters}
        report = {
            "parameters": {k: {"value": v, "start": begun[k]} for k, v in values.items()},
            "unidentified": {}, "runs": forward.runs, "trace": trace,
            "warnings": ["guided by a video model: likely to it, not measured; there are no bands"],
        }  # fmt: skip
        return Found(values, {}, {}, {}, with_values(scene, values), report)

    def _slope(
        self, forward: Forward, filmed: Film, unknowns: Unknowns, free: Array,
        random: torch.Generator,
    ) -> Array:  # fmt: skip
        """By how much the model's displeasure grows with each number."""
        count = len(self.times)
        values = unknowns.values(free)
        for halving in range(5):
            dt = forward.step(values) / 2**halving
            try:
                clip = filmed(forward.run(values, count, dt))
                push = self.prior.push(clip, random).cpu().double()
                slopes = []
                for row in range(len(free)):
                    there = free.copy()
                    there[row] += STEP
                    moved = filmed(forward.run(unknowns.values(there), count, dt))
                    slopes.append(float((push * (moved - clip).double()).sum()) / STEP)
                return np.asarray(slopes)
            except TooFast:
                continue
        raise RunError("guide: the numbers cannot be run", "nothing", "start from other numbers")


class Film:
    """A camera that films the splats of a scene.

    Args:
        forward: The scene.
        size: Sides of the pictures [px].
        camera: That stands still; one that sees where the first motion goes when None.

    Raises:
        InputError: The scene has no splats.
    """

    def __init__(self, forward: Forward, size: int, camera: Camera | None = None) -> None:
        setting = forward.setting()
        if setting.splats is None or setting.splats.count == 0:
            raise InputError("guide: the scene has no splats", "give it a solid with some")
        self.size, self.camera, self.splats = size, camera, setting.splats
        self.followers = Followers("guide", self.splats.means.double(), setting)

    def __call__(self, motion: Motion) -> Tensor:
        """The clip, [T, 3, H, W] in 0..1, on white."""
        if self.camera is None:
            action = Action.of(list(motion.position))
            low, high = motion.position.amin(dim=(0, 1)), motion.position.amax(dim=(0, 1))
            around = float(torch.maximum((high - low).norm() / 2.0, action.radius.max()))
            self.camera = look_at(
                (low + high) / 2.0, AWAY * around, AZIMUTH, ELEVATION, (self.size, self.size)
            )
        scale = self.size / self.camera.width
        K = self.camera.K.clone()
        K[:2] *= scale
        white, shown = torch.ones(3), []
        gone = torch.zeros(self.splats.count, dtype=torch.bool)
        for k in range(len(motion.position)):
            means, maps = self.followers.places(motion, k)
            now = carried(self.splats, means, maps, gone, STRETCH)
            drawn = draw_at(now, self.camera.viewmat, K, (self.size, self.size), background=white)
            shown.append(drawn.image.permute(2, 0, 1))
        return torch.stack(shown).clamp(0.0, 1.0)
