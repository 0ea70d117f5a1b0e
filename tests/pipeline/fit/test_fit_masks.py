"""Films: what silhouettes show of motion, and what only colours do."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from fit_scenes import SIDE, elastic, scene

from gsfluent.data import Camera
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.parameters import Unknowns, read_learn
from gsfluent.pipeline.fit.solve import Problem, search
from gsfluent.scene.scene import Scene
from gsfluent.targets import Masks
from gsfluent.targets.target import Followers

DX, FRAMES, SPIN, SIZE = SIDE / 4, 4, 3.0, 256
TIMES = [k / 48 for k in range(FRAMES)]
KEY = "thing.angular_velocity"


def ball() -> Scene:
    """It flies without gravity; one half of its skin is red, the other blue."""
    made = scene(elastic(1e6), shape="ball", velocity=(0.0, 0.0, 0.0), gap=0.3)
    made.gravity = (0.0, 0.0, 0.0)
    solid = made.bodies[0].solid
    assert solid is not None
    red = (solid.gaussians.means[:, :1] > 0.0).float()
    paint = torch.cat([red, torch.zeros_like(red), 1.0 - red], dim=1)
    made.bodies[0] = dataclasses.replace(
        made.bodies[0],
        solid=dataclasses.replace(solid, gaussians=solid.gaussians.with_colors(paint)),
    )
    return made


def cameras() -> list[Camera]:
    eyes = [[1.1 * math.cos(a), 1.1 * math.sin(a), 0.5] for a in (0.2, 1.9)]
    return [Camera.look_at(e, [0.0, 0.0, 0.46], width=SIZE, height=SIZE, fov=56.0) for e in eyes]


def films(truth: Scene) -> tuple[Any, Any]:
    """Masks [C, T, H, W] and colours [C, T, H, W, 3] of a ball that spins about z."""
    forward = Forward(truth, TIMES, DX)
    motion = forward.run({KEY: (0.0, 0.0, SPIN)}, FRAMES, forward.step({}))
    splats = forward.setting().splats
    assert splats is not None
    follow = Followers("test", splats.means.double(), forward.setting())
    masks, colors = [], []
    for camera in cameras():
        drawn = [draw(splats.replace(means=follow.places(motion, k)[0].float()), camera,
                      antialiased=True)
                 for k in range(FRAMES)]  # fmt: skip
        masks.append(torch.stack([d.alpha for d in drawn]))
        colors.append(torch.stack([d.image / d.alpha.clamp(min=1e-6)[..., None] for d in drawn]))
    return torch.stack(masks).numpy(), torch.stack(colors).numpy()


def spun(target: Masks) -> Any:
    """What a search finds of the spin, from one that is 2 rad/s off."""
    made = ball()
    forward = Forward(made, TIMES, DX)
    unknowns = read_learn(made, [KEY])
    start = np.array([0.0, 0.0, SPIN - 2.0])
    problem = Problem(forward, target.observe(forward.setting()), Unknowns(unknowns.parameters),
                      target.step)  # fmt: skip
    return search(problem, start, FRAMES, rounds=8)


def test_only_colours_show_the_spin_of_a_ball() -> None:
    masks, colors = films(ball())
    found = spun(Masks(cameras(), masks, colors=colors, times=TIMES))
    assert found.free[2] == pytest.approx(SPIN, abs=0.1)
    blind = spun(Masks(cameras(), masks, times=TIMES))
    sure, unsure = (math.sqrt(f.covariance[2, 2]) for f in (found, blind))
    assert unsure > 1.5 * sure and abs(blind.free[2] - SPIN) > 5.0 * abs(found.free[2] - SPIN)


def test_colours_count_once_all_frames_do() -> None:
    masks, colors = films(ball())
    observer = Masks(cameras(), masks, colors=colors, times=TIMES)
    plain = Masks(cameras(), masks, times=TIMES)
    forward = Forward(ball(), TIMES, DX)
    motion = forward.run({}, FRAMES, forward.step({}))
    for frames, more in ((FRAMES - 1, 1), (FRAMES, 4)):  # one channel, then three beside it
        with_, without = (t.observe(forward.setting()).residuals(motion, frames, None)[0]
                          for t in (observer, plain))  # fmt: skip
        assert len(with_) == more * len(without)


def test_colours_are_those_of_the_masks() -> None:
    masks, colors = films(ball())
    with pytest.raises(InputError, match=r"colors must have shape \[2, 4, 256, 256, 3\]"):
        Masks(cameras(), masks, colors=colors[:, :3])
    with pytest.raises(InputError, match="sigma_color"):
        Masks(cameras(), masks, colors=colors, sigma_color=0.0)


@pytest.mark.parametrize("size", [1.0, 1.3])
def test_an_outline_lies_where_it_was_seen_in_frame_0(size: float) -> None:
    """Masks are sharp: of all that alpha covers by more than a half. Splats drawn larger than those
    that made them cover as much, and so in frames that the outline was not found in."""
    masks, _ = films(ball())
    sharp = (masks > 0.5).astype(np.float32)
    made = ball()
    solid = made.bodies[0].solid
    assert solid is not None
    larger = solid.gaussians.replace(scales=size * solid.gaussians.scales)
    made.bodies[0] = dataclasses.replace(
        made.bodies[0], solid=dataclasses.replace(solid, gaussians=larger)
    )
    forward = Forward(made, TIMES, DX)
    motion = forward.run({KEY: (0.0, 0.0, SPIN)}, FRAMES, forward.step({}))
    observer = Masks(cameras(), sharp, times=TIMES).observe(forward.setting())
    gap, frame = observer.residuals(motion, FRAMES, None)
    area = np.array([float(gap[frame == k].sum()) for k in range(1, FRAMES)]) * 0.02
    seen = np.array([masks.shape[0] * sharp[:, k].mean() * (32**2 + 16**2) for k in (1, 2, 3)])
    assert np.abs(area / seen).max() < 0.01
    assert (observer.edge > 0.6) == (size > 1.0)
