"""A live session on a GPU: the same pokes, the same matter, nothing left uninitialised."""

from __future__ import annotations

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent.live.player import LivePlayer
from gsfluent.live.session import LiveSession
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

pytestmark = pytest.mark.cuda
DX = 0.0125
BULLET = {"type": "bullet", "from": [0.2, 0, 0.05], "toward": [0, 0, 0.05], "speed": 60.0}


def standing() -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3, splats=200), name="ball")
    return scene


def test_a_poke_is_the_event_of_a_shot_on_the_gpu() -> None:
    live = LiveSession(standing(), dx=DX, fps=100.0, device="cuda")
    live.advance(0.03)
    live.poke(BULLET)
    frames = live.advance(0.04)
    scene = standing()
    scene.add_event(BULLET | {"at": 0.03})
    simulate = Simulate(dx=DX, standing=True, device="cuda")
    *_, last = simulate(scene, fps=100.0, seconds=0.08)
    assert last.index == live.index
    assert torch.equal(last.particles.position, frames[-1].positions)
    assert torch.equal(last.damage, frames[-1].damage)


def test_many_pokes_over_a_long_time_stay_sound() -> None:
    live = LiveSession(standing(), dx=DX, fps=100.0, device="cuda")
    for turn in range(5):
        live.shoot((0.3, 0.0, 0.05 + 0.01 * turn), (-1, 0, 0), 60.0, 0.008)
        live.advance(0.03)
        live.throw((0, 0, 0.5))
        frames = live.advance(0.03)
        p = live.run.state.particles
        for value in (p.position, p.velocity, p.strain, p.deformation, p.affine, p.alpha):
            assert bool(torch.isfinite(value).all())
        assert bool(torch.isfinite(frames[-1].gaussians.means).all())
    assert live.report()["verdict"] in ("clean", "healed")
    assert live.report()["momentum_error"] < 1e-4


def test_the_player_hands_out_whole_frames_from_its_own_stream() -> None:
    player = LivePlayer(LiveSession(standing(), dx=DX, fps=100.0, device="cuda")).start()
    try:
        player.do(lambda s: s.shoot((0.2, 0, 0.05), (-1, 0, 0), 60.0)).result(60)
        seen = (0, 0)
        while player.count < 8:
            seen = player.wait_for_frame(seen, 60.0)
        frame = player.frame(7)
        assert bool(torch.isfinite(frame.gaussians.means).all())
        positions = frame.positions.cpu()
    finally:
        player.close()
    alone = LiveSession(standing(), dx=DX, fps=100.0, device="cuda")
    alone.shoot((0.2, 0, 0.05), (-1, 0, 0), 60.0)
    assert torch.equal(alone.advance(0.07)[-1].positions.cpu(), positions)
