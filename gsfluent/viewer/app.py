"""The page: a source's frames in the browser, with controls.

Threads: viser calls the controls' callbacks from its own pool, the artist draws in one thread, and
a clock thread plays and looks for new frames. What they share is plain values, replaced whole.
"""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gsfluent.data import Camera
from gsfluent.errors import GsfluentError
from gsfluent.pipeline.render.film import poster_frame
from gsfluent.viewer.draw.artist import Artist
from gsfluent.viewer.draw.picture import PictureMaker, browser_camera
from gsfluent.viewer.draw.splats import BrowserSplats
from gsfluent.viewer.guard import Guard
from gsfluent.viewer.model.look import Look
from gsfluent.viewer.model.pace import Pace
from gsfluent.viewer.model.playback import Playback
from gsfluent.viewer.model.source import Source
from gsfluent.viewer.model.timeline import Timeline
from gsfluent.viewer.panels.look import LookPanel
from gsfluent.viewer.panels.page import Page
from gsfluent.viewer.panels.plot import PlotPanel
from gsfluent.viewer.panels.time import TimePanel
from gsfluent.viewer.server import start_server, stop_server

if TYPE_CHECKING:
    import viser

_log = logging.getLogger(__name__)

AddPanel = Callable[["viser.ViserServer", Page], None]
"""Adds controls of its own to the page, for example to throw and shoot at a live object."""

_TICK = 1.0 / 60.0
_LOOK_FOR_FRAMES = 0.5  # seconds
_PANEL_WIDTH = 310.0
_LARGEST = 2560  # pixels of the longer side of a picture


class App:
    """A viewer that is being served.

    Attributes:
        source: Where frames come from.
        timeline: They and what they have in common.
        guard: Who may talk to the page.
        server: viser's server; panels may add controls and scene nodes of their own.
        playback: The clock.
        index: Frame shown.
        follow: Whether each new frame is shown as it comes.
        pictures: How many have been drawn.
        lock: Held while the frame shown changes.
        shift: Scene position = position in the browser + shift [m]; changes while the view follows
            the object.

    Args:
        source: What to show.
        device: Where to draw.
        host: Address to listen on.
        port: First port to try, 0 for any.
        splats: Let the browser draw the splats (no light, but no picture to send either).
        panels: Called at the end with (server, app).

    Raises:
        InputError: viser is not there, no port can be had, or too many splats for the browser.
        RunError: No frame can be read.
    """

    def __init__(
        self,
        source: Source,
        device: torch.device,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        splats: bool = False,
        panels: Sequence[AddPanel] = (),
    ) -> None:
        self.source = source
        self.timeline = Timeline(source, device)
        self.maker = PictureMaker(self.timeline)
        self.playback = Playback()
        self.pace = Pace()
        self.index = self._first_index()
        self.follow = source.running
        self.tracking = self._travels()
        self._tracked_by_itself = True
        self._revision = self.timeline.revision
        self._home = self._center(self.timeline.first.index)
        self._standing: tuple[float, float, float] | None = None
        self.shift = (0.0, 0.0, 0.0)
        self._anchor = self._center(self.index)
        self._problem = ""
        self.pictures = 0
        self.lock = threading.RLock()
        self._done = threading.Event()
        self.browser = BrowserSplats(self.timeline) if splats else None
        self.guard = Guard(host)
        self.server = start_server(host, port, f"gsfluent · {source.title}", self.guard)
        self._state = self.server.gui.add_markdown("")
        self.server.gui.main_panel.dock_right()
        self.server.gui.main_panel.set_width(_PANEL_WIDTH)
        self._look_panel: LookPanel | None = None
        self._time_panel = TimePanel(self.server, self)
        self._look_panel = LookPanel(
            self.server, self, self.maker.first_light(), lit=self.browser is None
        )
        self.look = self._look_panel.look()
        self._plots = PlotPanel(self.server, self.timeline)
        self._set_first_camera()
        if self.browser is not None:
            self.browser.prepare(self.server)
        for add_panel in panels:
            add_panel(self.server, self)
        self._artist = Artist(self._paint)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(lambda client: self._artist.forget(client.client_id))
        self.show(self.index)
        self._clock = threading.Thread(target=self._run, name="gsfluent-clock", daemon=True)
        self._clock.start()

    @property
    def url(self) -> str:
        """Address of the page, with the token where it can be reached from elsewhere."""
        host = self.server.get_host()
        shown = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        token = f"/?token={self.guard.token}" if self.guard.token else ""
        return f"http://{shown}:{self.server.get_port()}{token}"

    def show(self, index: int) -> None:
        """Go to frame ``index``."""
        with self.lock:
            if self.timeline.revision != self._revision:
                self._begin_anew()
            index = max(0, min(index, self.timeline.count - 1))
            if self.tracking:
                center = self._center(index)
                x, y, z = (c - a for c, a in zip(center, self._anchor, strict=True))
                self.shift = (x, y, z)
            self.index = index
            facts = self.timeline.facts()
            self._time_panel.update()
            busy = self.playback.playing or (self.follow and self.source.running)
            if self.index < len(facts) and "time" in facts[self.index]:
                self._plots.mark(facts[self.index]["time"], at_once=not busy)
            self.redraw()

    def redraw(self) -> None:
        """The picture is out of date, for example because a source's newest frame has changed."""
        self.say()
        self._artist.request()

    def set_look(self, look: Look) -> None:
        """Change colours, light or cut."""
        self.look = look
        self.redraw()

    def toggle(self) -> None:
        """Play, or pause."""
        if self.playback.playing:
            self.pause()
        else:
            at_end = self.index >= self.timeline.count - 1
            self.playback.play(0 if at_end else self.index)
            self.follow = False
            self._time_panel.update()

    def pause(self) -> None:
        """Stop playing."""
        self.playback.pause()
        self._time_panel.update()

    def track(self, on: bool) -> None:
        """Whether the view travels with the matter; nothing jumps when this changes."""
        self._tracked_by_itself = False
        self._set_tracking(on)

    def _track_by_itself(self) -> None:
        """Follow matter that has left its place, unless a person has decided."""
        if self._tracked_by_itself and not self.tracking and self._travels():
            self._standing = self.shift
            self._set_tracking(True)
            if self._look_panel is not None:
                self._look_panel.show_tracking(True)

    def _begin_anew(self) -> None:
        """Keep the object in view when the source has begun anew."""
        home, self._revision = self._home, self.timeline.revision
        self._home = self._center(self.timeline.first.index)
        if self._standing is not None and self._tracked_by_itself and not self._travels():
            # what made the view follow is undone (a live reset): it stands again where it stood
            self.tracking, self.shift, self._standing = False, self._standing, None
            if self._look_panel is not None:
                self._look_panel.show_tracking(False)
        if not self.tracking:
            # the solid lies where it was photographed, the first frame where it is dropped from
            x, y, z = (s + a - b for s, a, b in zip(self.shift, self._home, home, strict=True))
            self.shift = (x, y, z)

    def _set_tracking(self, on: bool) -> None:
        with self.lock:
            center = self._center(self.index)
            x, y, z = (c - s for c, s in zip(center, self.shift, strict=True))
            self._anchor, self.tracking = (x, y, z), on
            self.show(self.index)

    def go_home(self, client: viser.ClientHandle) -> None:
        """Turn a browser's camera to the whole of what is in the present frame."""
        try:
            survey = self.timeline.survey(self.index)
            size = (max(16, client.camera.image_width), max(16, client.camera.image_height))
            camera = self.maker.camera(self.index, *size)
        except GsfluentError:
            return
        shift = np.array(self.shift)
        with client.atomic():
            client.camera.position = camera.center().numpy() - shift
            client.camera.look_at = np.array(survey.center) - shift
            client.camera.fov = 2.0 * np.arctan(0.5 * camera.height / float(camera.K[1, 1]))

    def camera(self, client: viser.ClientHandle, budget: float = float("inf")) -> Camera:
        """The camera of a browser in the scene, at the size that is drawn within ``budget`` [s]."""
        seen = client.camera
        width, height = max(16, seen.image_width), max(16, seen.image_height)
        scale = min(1.0, _LARGEST / max(width, height))
        width, height = round(scale * width), round(scale * height)
        if budget < float("inf"):
            scale = self.pace.scale(width, height, budget)
            width, height = max(16, round(scale * width)), max(16, round(scale * height))
        return browser_camera(seen.wxyz, seen.position, seen.fov, (width, height), self.shift)

    def png(self, client: viser.ClientHandle) -> bytes:
        """The picture of a browser in full size as PNG."""
        from PIL import Image

        picture = self.maker.picture(self.index, self.camera(client), self.look)
        stream = io.BytesIO()
        Image.fromarray(picture).save(stream, "PNG")
        return stream.getvalue()

    def wait_idle(self, timeout: float = 30.0) -> bool:
        """Wait until every browser's picture is up to date and sharp."""
        return self._artist.wait_idle(timeout)

    def close(self) -> None:
        """Stop serving."""
        self._done.set()
        self._clock.join(timeout=10.0)
        self._artist.close()
        stop_server(self.server)

    def wait(self) -> None:
        """Serve until :meth:`close` or Ctrl-C."""
        # asleep, not in a lock: Ctrl-C inside Event.wait may leave with the lock's own error
        while not self._done.is_set():
            time.sleep(0.2)

    def _paint(self, viewer: int, budget: float) -> bool:
        """Draw for one browser; returns whether the picture has its full size."""
        client = self.server.get_clients().get(viewer)
        if client is None:
            return True
        try:
            if self.browser is not None:
                legend = self.browser.show(self.server, self.index, self.look, self.shift)
                self._legend(legend)
                return True
            with self.lock:  # frame and camera of the same moment
                index, full, camera = self.index, self.camera(client), self.camera(client, budget)
            start = time.perf_counter()
            picture, legend = self.maker.picture_and_legend(index, camera, self.look)
            self.pace.measured(camera.width * camera.height, time.perf_counter() - start)
        except GsfluentError as error:
            self._problem = str(error).split("\n")[0]
            self.say()
            return True
        self._problem = ""
        self._legend(legend)
        sharp = camera.width >= full.width
        client.scene.set_background_image(picture, format="jpeg", jpeg_quality=92 if sharp else 80)
        client.flush()
        self.pictures += 1
        return sharp

    def _legend(self, legend: Any) -> None:
        if self._look_panel is not None:
            self._look_panel.show_legend("" if legend is None else legend.html())
        self.say()

    def say(self) -> None:
        """The line at the head of the page."""
        text = self.source.state()
        if self._problem:
            text += f"\n\n**Frame {self.index} cannot be shown:** {self._problem}"
        if text != self._state.content:
            self._state.content = text

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda camera: self._artist.request(client.client_id))
        self._artist.request(client.client_id)

    def _run(self) -> None:
        """The clock: plays, and looks for new frames."""
        looked = time.monotonic()
        while not self._done.wait(_TICK):
            try:
                if self.playback.playing:
                    self._play()
                if time.monotonic() - looked > _LOOK_FOR_FRAMES:
                    looked = time.monotonic()
                    self.refresh()
            except Exception:
                _log.exception("viewer: the clock stumbled")  # and goes on

    def _play(self) -> None:
        """One tick of playing."""
        index = self.playback.index(self.timeline.count, self.timeline.fps())
        if index != self.index:
            self.show(index)
        elif not self.playback.playing:
            self._time_panel.update()

    def refresh(self) -> None:
        """Look for new frames now."""
        try:
            if not self.timeline.refresh():
                return
        except GsfluentError as error:
            self._problem = str(error).split("\n")[0]
            self.say()
            return
        self._track_by_itself()
        facts = self.timeline.facts()
        last = self.timeline.count - 1
        now = last if self.follow else min(self.index, last)
        self._plots.update(facts[now].get("time", 0.0))
        self.show(now)

    def _first_index(self) -> int:
        """The most telling frame of a finished run, the newest of a running one."""
        index = self.timeline.count - 1
        if not self.source.running and index > 0:
            counts = [int(row.get("fragments") or 1) for row in self.timeline.facts()]
            index = poster_frame(counts, self.timeline.fps())
        return self.timeline.readable(index)

    def _center(self, index: int) -> tuple[float, float, float]:
        try:
            return self.timeline.survey(index).center
        except GsfluentError:  # said when the frame is drawn
            return self.timeline.survey(self.timeline.first.index).center

    def _travels(self) -> bool:
        """Whether the matter leaves the place where it is in the first frame."""
        centers = np.array([survey.center for survey in self.timeline.surveys()])
        return bool(np.ptp(centers, axis=0).max() > 0.5 * self.timeline.radius)

    def _set_first_camera(self) -> None:
        camera = self.maker.camera(self.index, 4, 3)
        first = self.server.initial_camera
        first.position = camera.center().numpy()
        first.look_at = np.array(self._center(self.index))
        first.fov = 2.0 * np.arctan(0.5 * 3 / float(camera.K[1, 1]))
