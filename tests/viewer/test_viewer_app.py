"""The page's logic with viser's server but no browser: following, playing, panels of others."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from viewer_scene import FRAMES, frame, write_run

pytest.importorskip("viser", reason="the viewer's extra is not installed")

from gsfluent.errors import InputError
from gsfluent.pipeline.light.lamps import Lamp, Lighting
from gsfluent.results.frames import SavedFrame, save_frame
from gsfluent.viewer.app import App
from gsfluent.viewer.draw import splats
from gsfluent.viewer.model.look import BODY, Cut, Look
from gsfluent.viewer.model.source import RunSource
from gsfluent.viewer.panels.light import Handles

CPU = torch.device("cpu")


class Falling:
    """A source of our own, as a live session is one: the ball falls, and never ends."""

    title, shot, running, revision = "falling", None, True, "1"
    frames = 3

    def count(self) -> int:
        return self.frames

    def frame(self, index: int) -> SavedFrame:
        moment = frame(0)
        drop = torch.tensor([0.0, 0.0, 1.0 - 0.2 * index])
        gaussians = moment.gaussians.replace(means=moment.gaussians.means + drop)
        place = moment.positions + drop
        return dataclasses.replace(moment, index=index, gaussians=gaussians, positions=place)

    def facts(self, index: int) -> dict[str, Any]:
        return {"time": 0.05 * index, "kinetic": float(index)}

    def state(self) -> str:
        return "live"


@pytest.fixture
def serve() -> Iterator[Any]:
    apps = []

    def start(source: Any, **options: Any) -> App:
        apps.append(App(source, CPU, port=0, **options))
        return apps[-1]

    yield start
    for app in apps:
        app.close()


def until(true: Any) -> None:
    end = time.monotonic() + 10.0
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def test_a_running_source_is_followed_until_a_person_goes_elsewhere(serve: Any) -> None:
    source = Falling()
    app = serve(source)
    assert app.follow and app.index == 2
    source.frames = 5
    until(lambda: app.index == 4)
    app.follow = False
    app.show(1)
    source.frames = 6
    until(lambda: app.timeline.count == 6)
    assert app.index == 1


def test_the_view_travels_with_the_object_without_a_jump(serve: Any) -> None:
    app = serve(Falling())
    assert app.tracking  # it falls by more than its size
    app.show(0)
    first = np.array(app.shift)
    app.show(2)
    np.testing.assert_allclose(np.array(app.shift) - first, [0, 0, -0.4], atol=1e-6)
    kept = app.shift
    app.track(False)
    app.show(0)
    assert app.shift == kept
    app.track(True)
    assert app.shift == pytest.approx(kept)
    app.show(1)
    np.testing.assert_allclose(np.array(app.shift) - kept, [0, 0, -0.2], atol=1e-6)


def test_a_view_that_stands_begins_to_follow_what_falls_away(serve: Any) -> None:
    source = Falling()
    source.frames = 1
    app = serve(source)
    assert not app.tracking
    source.frames = 4
    until(lambda: app.index == 3 and app.tracking)
    kept = app.shift  # no jump where it begins
    source.frames = 5
    until(lambda: app.index == 4)
    np.testing.assert_allclose(np.array(app.shift) - kept, [0, 0, -0.2], atol=1e-6)
    # a live reset: everything is where it was, and so is the view
    source.frames, source.revision = 1, "2"
    until(lambda: app.index == 0 and not app.tracking)
    assert app.shift == (0.0, 0.0, 0.0)
    source.frames = 4
    until(lambda: app.tracking)
    app.track(False)  # and a person's word is the last
    source.frames = 6
    until(lambda: app.index == 5)
    assert not app.tracking


def test_the_view_goes_with_an_object_that_is_placed_anew(serve: Any) -> None:
    source = Falling()
    source.frames = 1
    app = serve(source)
    app.track(False)
    lifted = source.frame

    def frame_higher(index: int) -> SavedFrame:
        moment = lifted(index)
        up = torch.tensor([0.0, 0.0, 0.7])
        gaussians = moment.gaussians.replace(means=moment.gaussians.means + up)
        return dataclasses.replace(moment, gaussians=gaussians, positions=moment.positions + up)

    source.frame, source.revision = frame_higher, "2"
    until(lambda: app.timeline.revision == "2" and app.shift != (0.0, 0.0, 0.0))
    assert app.shift == pytest.approx((0.0, 0.0, 0.7), abs=1e-6)


def test_playing_goes_on_to_the_end_and_begins_anew(serve: Any, tmp_path: Path) -> None:
    app = serve(RunSource(write_run(tmp_path / "ball")))
    app.playback.loop, app.playback.speed = False, 2.0
    app.show(0)
    app.toggle()
    assert app.playback.playing
    until(lambda: not app.playback.playing)
    assert app.index == FRAMES - 1
    app.toggle()
    until(lambda: app.index < FRAMES - 1)
    app.pause()
    assert not app.playback.playing


def test_a_finished_run_opens_at_its_most_telling_frame(serve: Any, tmp_path: Path) -> None:
    # it breaks between frames 2 and 3; 0.08 s later is at 20 frames/s two frames on, or the last
    assert serve(RunSource(write_run(tmp_path / "ball"))).index == FRAMES - 1


def test_others_add_panels_and_see_source_and_server(serve: Any) -> None:
    seen = []

    def add_panel(server: Any, app: App) -> None:
        with server.gui.add_folder("Poke"):
            seen.append(server.gui.add_button("Throw"))
        seen.append((app.source.title, app.shift, app.index))

    serve(Falling(), panels=[add_panel])
    assert seen[0].label == "Throw" and seen[1] == ("falling", (0.0, 0.0, 0.0), 2)


def test_too_many_splats_for_a_browser_are_refused(
    serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splats, "MOST", 100)
    with pytest.raises(InputError, match=r"--splats: \d+ splats; browsers draw about 100"):
        serve(RunSource(write_run(tmp_path / "ball", 1)), splats=True)


def test_splats_arrive_in_the_browser_where_they_are_in_the_scene(
    serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = serve(Falling(), splats=True)
    sent: dict[str, Any] = {}
    monkeypatch.setattr(
        app.server.scene, "add_gaussian_splats", lambda name, **values: sent.update(values)
    )
    shift = (0.1, 0.2, 0.3)
    cut = Cut((0.0, 0.0, 1.0), 0.02)
    legend = app.browser.show(app.server, 1, Look(BODY, None, cut), shift)
    assert legend is not None and legend.title == "Bodies: 1"
    gaussians = app.timeline.frame(1).gaussians
    middle = app.timeline.survey(1).center
    kept = gaussians.means[:, 2] <= middle[2] + 0.02
    seen = sent["centers"] * sent["scale"] + np.array(sent["position"]) + np.array(shift)
    np.testing.assert_allclose(seen, gaussians.means[kept], atol=1e-6)
    assert np.ptp(sent["rgbs"], axis=0).max() < 1e-6  # one body, one colour
    sent.clear()
    app.browser.show(app.server, 1, Look(BODY, None, cut), shift)
    assert sent == {}  # nothing has changed, nothing is sent


def test_a_single_frame_needs_no_controls_of_time(serve: Any, tmp_path: Path) -> None:
    app = serve(RunSource(write_run(tmp_path / "ball", 1)))
    assert app.index == 0 and app.timeline.fps() > 0
    app.toggle()
    until(lambda: app.playback.playing)
    assert app.index == 0


def test_a_run_that_is_begun_anew_stays_in_range(serve: Any, tmp_path: Path) -> None:
    out = write_run(tmp_path / "ball")
    app = serve(RunSource(out))
    folder = out / "stages" / "simulate"
    for path in folder.glob("*"):
        path.unlink()
    save_frame(folder, frame(0))
    (folder / "stage.json").write_text('{"fingerprint": "new", "complete": false}')
    until(lambda: app.timeline.count == 1 and app.index == 0)


def test_lamps_are_turned_about_the_object_and_come_back() -> None:
    pivot = (0.1, -0.2, 0.3)
    far = Lamp(direction=(1.0, -1.0, 2.0), intensity=0.7, color=(1.0, 0.5, 0.2))
    where = Handles.of(far, pivot)
    assert where.distance is None
    again = where.moved(far, pivot)
    assert again.toward == pytest.approx(far.toward) and again.intensity == 0.7
    near = Handles(90.0, 0.0, 0.5).moved(far, pivot)
    assert near.position == pytest.approx((0.1, 0.3, 0.3)) and near.color == far.color
    assert near.distance == 0.5  # its strength is that at the object
    back = Handles.of(near, pivot)
    assert (back.azimuth, back.elevation, back.distance) == pytest.approx((90.0, 0.0, 0.5))


def test_the_page_starts_with_the_light_of_the_shot(serve: Any) -> None:
    app = serve(Falling())
    assert app.look.light == Lighting()  # no shot: the usual one, untouched by the controls
