"""The panel that throws, shoots and cuts what a live session shows."""

from __future__ import annotations

import collections
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsfluent.errors import GsfluentError
from gsfluent.live.player import FAILED, PAUSED, RUNNING, LivePlayer, Status
from gsfluent.viewer.model.live_source import factor
from gsfluent.viewer.panels.page import Page

if TYPE_CHECKING:
    import viser

_log = logging.getLogger(__name__)
_SAY_EVERY = 0.25  # seconds between two updates of the figures
_PLOT_EVERY = 0.5
_DRAWN_OVER = 2.0  # seconds over which pictures are counted
_PATIENCE = 120.0  # seconds a poke may have to wait for the frame in hand
AUTO = "automatic"
SLOW = {"1 (real time)": 1.0, "2": 2.0, "4": 4.0, "10": 10.0, "30": 30.0, "100": 100.0}


class PokePanel:
    """Controls of a live session; give it to :class:`gsfluent.viewer.app.App` as a panel.

    Args:
        player: The session's player.
        recordings: Folder of the recordings, ``recording_1`` and so on.
    """

    def __init__(self, player: LivePlayer, recordings: Path) -> None:
        self.player, self.recordings = player, recordings
        self._app: Page | None = None
        self._stop = threading.Event()
        self._drawn: collections.deque[tuple[float, int]] = collections.deque()
        self._looked = time.monotonic()
        self._thread = threading.Thread(target=self._watch, name="gsfluent-poke", daemon=True)

    def __call__(self, server: viser.ViserServer, app: Page) -> None:
        """Add the controls."""
        self._app = app
        gui = server.gui
        slow = self.player.session.slow
        chosen = next((name for name, value in SLOW.items() if value == slow), f"{slow:g}")
        chosen = AUTO if self.player.automatic else chosen
        with gui.add_folder("Poke", order=-1):
            self._figures = gui.add_html("")
            self._shoot = gui.add_button("Shoot", hint="From the camera at the middle of the view")
            self._click: Any = gui.add_checkbox(
                "Shoot where I click", False, hint="A click on the picture fires there"
            )
            self._speed = gui.add_slider("Bullet [m/s]", 5, 300, 5, 80)
            self._radius = gui.add_slider("Radius [mm]", 2, 40, 1, 15)
            self._throw = gui.add_button("Throw", hint="Away from the camera and up")
            self._toss = gui.add_slider("Throw [m/s]", 0.5, 15, 0.5, 5)
            self._cut = gui.add_button_group("Cut", ("upright", "level"))
            self._blade = gui.add_slider("Blade [m/s]", 0.5, 10, 0.5, 2)
            self._slow = gui.add_dropdown(
                "Slow motion", tuple(dict.fromkeys((AUTO, *SLOW, chosen))), initial_value=chosen
            )
            self._pause: Any = gui.add_button("Pause", hint="The simulation stands or goes on")
            self._reset = gui.add_button("Reset")
            self._record: Any = gui.add_button("Record", hint="Resets, then writes a run folder")
        self._shoot.on_click(lambda event: self._with_client(event, self._fire))
        self._throw.on_click(lambda event: self._with_client(event, self._hurl))
        self._cut.on_click(lambda event: self._with_client(event, self._slice))
        self._reset.on_click(lambda event: self._ask(self.player.reset))
        self._record.on_click(lambda event: self._toggle_recording())
        self._pause.on_click(
            lambda event: self._ask(lambda: self.player.pause(self._pause.label == "Pause"))
        )

        @self._slow.on_update
        def _(event: Any) -> None:
            chosen = None if self._slow.value == AUTO else SLOW.get(self._slow.value, slow)
            self._ask(lambda: self.player.set_slow(chosen))

        @self._click.on_update
        def _(event: Any) -> None:
            if self._click.value:
                server.scene.on_click()(self._clicked)
            else:
                server.scene.remove_click_callback()

        self._say(self.player.status)

    def start(self) -> None:
        """Begin to show frames as they come; after the app has been made."""
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    # --- what a person does ---

    def _with_client(self, event: Any, act: Callable[[Any], None]) -> None:
        if event.client is not None:
            act(event.client)

    def _view(self, client: Any) -> tuple[np.ndarray, np.ndarray]:
        """Where a browser's camera is in the scene, and its axes right, down, forward in rows."""
        assert self._app is not None
        camera = self._app.camera(client)
        return camera.center().numpy(), camera.viewmat[:3, :3].numpy()

    def _fire(self, client: Any) -> None:
        origin, axes = self._view(client)
        self._bullet(origin, axes[2])

    def _clicked(self, event: Any) -> None:
        assert self._app is not None
        origin = np.array(event.ray_origin) + np.array(self._app.shift)
        self._bullet(origin, np.array(event.ray_direction))

    def _bullet(self, origin: np.ndarray, direction: np.ndarray) -> None:
        speed, radius = float(self._speed.value), 1e-3 * float(self._radius.value)
        self._ask(
            lambda: self.player.do(
                lambda s: s.shoot(origin.tolist(), direction.tolist(), speed, radius)
            )
        )

    def _hurl(self, client: Any) -> None:
        forward = self._view(client)[1][2].copy()
        forward[2] = 0.0
        way = forward / max(float(np.linalg.norm(forward)), 1e-9) * 0.5 + np.array([0, 0, 0.87])
        velocity = (float(self._toss.value) * way).tolist()
        self._ask(lambda: self.player.do(lambda s: s.throw(velocity)))

    def _slice(self, client: Any) -> None:
        axes = self._view(client)[1]
        normal = axes[0] if self._cut.value == "upright" else axes[1]
        speed = float(self._blade.value)
        self._ask(lambda: self.player.do(lambda s: s.cut_plane(normal.tolist(), speed=speed)))

    def _toggle_recording(self) -> None:
        if self.player.status.recording is None:
            number = 1
            while (out := self.recordings / f"recording_{number}").exists():
                number += 1
            self._ask(lambda: self.player.record(out))
        else:
            self._ask(self.player.end_recording)

    def _ask(self, act: Callable[[], Any]) -> None:
        """Have it done by the player; what a user can mend is said on the page."""
        assert self._app is not None
        if self._app.playback.playing:
            self._app.pause()
        self._app.follow = True
        try:
            result = act().result(_PATIENCE)
        except GsfluentError as error:
            _log.info("poke: %s", error)
        except TimeoutError:
            _log.warning("poke: the frame in hand takes long; it will be done after it")
        else:
            if isinstance(result, Path):
                _log.info("poke: recorded %s", result)
        self._say(self.player.status)

    # --- what is shown ---

    def _watch(self) -> None:
        """Show each new frame; never more than one is waited for, so none queue up."""
        app = self._app
        assert app is not None
        seen, plotted = (self.player.revision, self.player.count), 0.0
        while not self._stop.is_set():
            now = self.player.wait_for_frame(seen, _SAY_EVERY)
            if now != seen:
                seen = now
                try:
                    plotted = self._show(app, plotted)
                except GsfluentError as error:  # the frame has gone meanwhile
                    _log.debug("poke: %s", error)
            if time.monotonic() - self._looked > _SAY_EVERY:
                self._say(self.player.status)

    def _show(self, app: Page, plotted: float) -> float:
        """Go to the newest frame; the charts follow less often."""
        moment = time.monotonic()
        if moment - plotted > _PLOT_EVERY:
            app.refresh()
            return moment
        with app.lock:
            app.timeline.refresh()
            if app.follow:
                app.show(app.timeline.count - 1)
        return plotted

    def _say(self, status: Status) -> None:
        app = self._app
        assert app is not None
        self._looked = now = time.monotonic()
        self._drawn.append((now, app.pictures))
        (then, before), (now, after) = self._drawn[0], self._drawn[-1]
        drawn = (after - before) / (now - then) if now > then else 0.0
        while now - self._drawn[0][0] > _DRAWN_OVER:
            self._drawn.popleft()
        self._figures.content = figures(status, drawn)
        self._pause.label = "Go on" if status.state == PAUSED else "Pause"
        recording = status.recording is not None
        self._record.label = "End recording" if recording else "Record"
        app.say()


def figures(status: Status, drawn: float) -> str:
    """The figures of a status as HTML."""
    rows = []
    if status.state == FAILED:
        rows.append("<b>failed</b>: reset")
    elif status.real_time is None:
        rows.append("starting" if status.state == RUNNING else status.state)
    else:
        wanted = "" if status.wanted == 1.0 else f" (slow motion asks {factor(status.wanted)})"
        rows.append(f"<b>{factor(status.real_time)} × real time</b>{wanted}")
        if status.state == PAUSED:
            rows[-1] += " until the pause"
        rows.append(f"{status.frames_per_second:.1f} frames/s, {drawn:.1f} pictures/s")
    count = f"t = {status.time:.3f} s, {status.particles} points"
    rows.append(count + (f", {status.dropped} dropped" if status.dropped else ""))
    if status.message and status.state != FAILED:
        rows.append(f'<span style="color:#b3261e">{_plain(status.message)}</span>')
    return f'<div style="padding:0 14px 6px 14px;font-size:0.85em">{"<br>".join(rows)}</div>'


def _plain(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
