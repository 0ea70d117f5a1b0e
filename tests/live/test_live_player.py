"""The thread that drives a live session: order of pokes, honest figures, failures, recordings."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent.config import Shot
from gsfluent.errors import InputError, RunError
from gsfluent.io import save_solid
from gsfluent.live import player as live_player
from gsfluent.live.player import AT_REST, FAILED, RUNNING, LivePlayer
from gsfluent.live.scene import open_stage
from gsfluent.live.session import LiveSession
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.results.frames import count_frames, load_frame
from gsfluent.results.record import shot_of
from gsfluent.scene.scene import Scene
from gsfluent.stages.simulate import build_scene

DX = 0.0125


@pytest.fixture
def solid(tmp_path: Path) -> Path:
    path = tmp_path / "ball.ply"
    save_solid(ellipsoid((0.05,) * 3, splats=200), path)
    return path


def player_of(path: Path, **options) -> LivePlayer:
    stage = open_stage(path, material="fruit.watermelon")
    session = LiveSession(stage.scene, dx=DX, fps=100.0, **options)
    return LivePlayer(session, stage.shot)


def frames_until(player: LivePlayer, count: int) -> None:
    seen = (player.revision, player.count)
    while player.count < count:
        now = player.wait_for_frame(seen, 60.0)
        assert now != seen, f"no further frame: {player.status}"
        seen = now


def test_it_sleeps_until_it_is_poked_and_shows_what_a_session_shows(solid) -> None:
    player = player_of(solid).start()
    try:
        assert player.status.state == AT_REST and player.status.real_time is None
        player.do(lambda s: s.shoot((0.2, 0, 0.05), (-1, 0, 0), 30.0)).result(60)
        frames_until(player, 6)
        status = player.status
        assert status.state == RUNNING and status.message == ""
        seen = player.frame(5)
    finally:
        player.close()
    alone = player_of(solid).session
    alone.shoot((0.2, 0, 0.05), (-1, 0, 0), 30.0)
    frame = alone.advance(0.05)[-1]
    assert torch.equal(frame.positions, seen.positions) and frame.time == seen.time
    assert seen.index == 5 and player.facts(5)["time"] == pytest.approx(0.05)
    with pytest.raises(InputError, match="has ended"):
        player.reset()


def test_the_real_time_factor_is_simulated_time_by_wall_time(solid) -> None:
    # a clock that ticks 0.02 s every time it is looked at: three looks a frame of 0.0025 s
    ticks = iter(range(10**6))
    player = player_of(solid, slow=4.0)
    player._clock = lambda: 0.02 * next(ticks)
    player.do(lambda s: s.throw((0, 0, 1.0)))
    player._obey()
    for _ in range(3):
        player._one_frame()
    status = player.status
    assert status.wanted == 0.25
    walls = [wall for wall, _, _ in player._speed]
    assert status.real_time == pytest.approx(3 * 0.0025 / sum(walls))
    assert status.frames_per_second == pytest.approx(3 / sum(walls))
    assert status.latency == pytest.approx(0.02) and min(walls) >= 0.04


def test_automatic_slow_motion_follows_the_machine(solid) -> None:
    player = player_of(solid)
    player.automatic = True
    now = [0.0]
    player._clock = lambda: now[0]
    player.do(lambda s: s.throw((0, 0, 1.0)))
    player._obey()
    step = player.session.step

    def slow_step():
        now[0] += cost
        return step()

    player.session.step = slow_step  # type: ignore[method-assign]
    cost = 0.05  # five times what 100 frames a second allow
    for _ in range(12):
        player._one_frame()
    assert player.session.slow == 7.0 and player.status.wanted == pytest.approx(1 / 7)
    cost = 0.0101
    for _ in range(8):
        player._one_frame()
    assert player.session.slow == 7.0
    player.set_slow(2.0)
    player._obey()
    assert player.session.slow == 2.0 and not player.automatic


def test_a_bad_poke_is_told_and_nothing_stops(solid) -> None:
    player = player_of(solid).start()
    try:
        bad = player.do(lambda s: s.shoot((1, 0, 0.1), (0, 0, 0)))
        with pytest.raises(InputError, match="must not be zero"):
            bad.result(60)
        assert "must not be zero" in player.status.message
        player.do(lambda s: s.throw((0, 0, 1.0))).result(60)
        frames_until(player, 2)
        assert player.status.message == ""
    finally:
        player.close()


def test_after_a_failure_the_page_lives_and_reset_helps(solid) -> None:
    player = player_of(solid).start()
    try:

        def spoil(session: LiveSession) -> None:
            session.throw((0, 0, 1.0))
            p = session.run.state.particles
            wrong = p.replace(velocity=p.velocity + math.nan)
            session.run.state = session.run.state._replace(particles=wrong)

        player.do(spoil).result(60)
        seen = (player.revision, player.count)
        for _ in range(200):
            if player.status.state == FAILED:
                break
            player.wait_for_frame(seen, 0.05)
        assert player.status.state == FAILED and player.status.message
        with pytest.raises(InputError, match="failed"):
            player.do(lambda s: s.throw((0, 0, 1.0))).result(60)
        player.reset().result(60)
        assert player.status.state == AT_REST and player.revision == 1 and player.count == 1
    finally:
        player.close()


def test_memory_is_bounded(solid, monkeypatch) -> None:
    monkeypatch.setattr(live_player, "MOST_FRAMES", 6)
    player = player_of(solid)
    monkeypatch.setattr(live_player, "KEPT_BYTES", 3 * player._bytes)
    player.do(lambda s: s.throw((0, 0, 1.0)))
    player._obey()
    for _ in range(5):
        player._one_frame()
    assert len(player._frames) <= 3 and player.count == 6
    with pytest.raises(RunError, match="gone"):
        player.frame(0)
    player._one_frame()
    assert player.revision == 1 and player.count == 1 and len(player._facts) == 1
    assert player.frame(player.count - 1).time == player.session.time


def test_a_take_is_a_run_and_its_shot_gives_the_same(solid, tmp_path) -> None:
    player = player_of(solid, slow=2.0)
    out = tmp_path / "take"
    done = [player.record(out)]
    player._obey()
    done.append(player.do(lambda s: s.throw((0, 0, 0.5))))
    player._obey()
    for i in range(6):
        if i == 2:
            done.append(player.do(lambda s: s.shoot((0.3, 0, 0.06), (-1, 0, 0), 60.0)))
        player._obey()
        player._one_frame()
    with pytest.raises(InputError, match="one speed"):
        slow = player.set_slow(1.0)
        player._obey()
        slow.result(0)
    done.append(player.end_recording())
    player._obey()
    assert [future.exception(0) for future in done] == [None] * 4
    folder = out / "stages" / "simulate"
    assert count_frames(folder) == 7
    last = load_frame(folder, 6)
    assert last.time == pytest.approx(6 / 200) and last.index == 6
    assert torch.equal(last.positions, player.session.frame().positions)
    shot = shot_of(out)
    assert isinstance(shot, Shot) and shot.output.fps == 200.0 and shot.output.slow == 2.0
    assert [getattr(e, "at", None) for e in shot.events] == [0.0, pytest.approx(2 / 200)]
    # the shot file alone, simulated from the start
    stage = open_stage(solid, material="fruit.watermelon")
    solids = {body.name: body.solid for body in stage.scene.bodies}
    scene = build_scene(shot, solids, stage.scene.bodies[0].frame)
    assert scene.bodies[0].offset == pytest.approx(stage.scene.bodies[0].offset)
    solve = shot.solve
    simulate = Simulate(dx=DX, standing=solve.standing)
    *_, end = simulate(scene, fps=shot.output.fps, seconds=shot.output.seconds)
    assert end.index == 6
    count = last.positions.shape[0]
    assert end.particles.position.shape[0] == count
    assert torch.equal(end.particles.position, last.positions)
    with pytest.raises(InputError, match="is there already"):
        again = player.record(out)
        player._obey()
        again.result(0)


def test_what_cannot_be_opened_is_said(solid, tmp_path) -> None:
    with pytest.raises(InputError, match="there is no"):
        open_stage(tmp_path / "nothing")
    with pytest.raises(InputError, match="not the record of a run"):
        open_stage(tmp_path)
    bare = tmp_path / "bare.ply"
    bare.write_bytes(solid.read_bytes())
    with pytest.raises(InputError, match="no filled solid"):
        open_stage(bare)
    with pytest.raises(InputError, match="says itself"):
        open_stage(tmp_path, material="glass")
    scene = open_stage(solid).scene
    assert isinstance(scene, Scene) and float(scene.bodies[0].bounds()[0][2]) == pytest.approx(0.0)
