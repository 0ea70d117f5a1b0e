"""The page: controls over a :class:`~gsfluent.studio.desk.Desk`, behind the viewer's guard."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from gsfluent.errors import GsfluentError
from gsfluent.studio.desk import (
    DROP,
    EVENTS,
    FORMATS,
    SUGGESTED,
    THROW,
    UPLOADS,
    Desk,
    preset_names,
)  # fmt: skip
from gsfluent.studio.job import DONE, FAILED, RUNNING
from gsfluent.viewer.app import App
from gsfluent.viewer.guard import Guard
from gsfluent.viewer.model.source import RunSource
from gsfluent.viewer.serve import stay
from gsfluent.viewer.server import start_server, stop_server

_HOST = "127.0.0.1"  # who may start programs here is who works at this machine
_TICK = 0.5  # seconds between two looks at the command
_LINES = 6  # of its log that are shown
_NONE = "(drop a file below)"


class Studio:
    """A studio that is being served.

    Attributes:
        desk: What it does.
        guard: Who may talk to the page.
        viewers: Pages that show results, by result folder.

    Args:
        desk: See above.
        device: Where results are drawn.
        port: First port to try, 0 for any.

    Raises:
        InputError: viser is not there, or no port can be had.
    """

    def __init__(self, desk: Desk, device: torch.device, port: int) -> None:
        self.desk, self.device, self.guard = desk, device, Guard(_HOST)
        self.viewers: dict[Path, App] = {}
        self._said = ""
        self.server = start_server(_HOST, port, "gsfluent · studio", self.guard)
        gui: Any = self.server.gui
        with gui.add_folder("1 Object"):
            self._object = gui.add_dropdown("Object", (_NONE,))
            self._upload = gui.add_upload_button("Upload a file", mime_type=",".join(UPLOADS))
            self._size = gui.add_number("Size [m]", 0.0, min=0.0, step=0.01,
                                        hint="Largest extent; 0 leaves it as it is")  # fmt: skip
        with gui.add_folder("2 What happens"):
            self._material = gui.add_dropdown("Material", tuple(preset_names()))
            self._event = gui.add_dropdown("Event", EVENTS, initial_value=SUGGESTED)
            self._height = gui.add_number("Height [m]", 1.0, min=0.01, visible=False)
            self._speed = gui.add_number("Speed [m/s]", 8.0, min=0.1, visible=False)
        with gui.add_folder("3 Work"):
            self._plan = gui.add_button("Plan")
            self._run = gui.add_button("Run")
            self._stop = gui.add_button("Stop")
            self._bar = gui.add_progress_bar(0.0)
            self._state = gui.add_html("")
        with gui.add_folder("4 Result"):
            self._watch = gui.add_button("Watch")
            self._link = gui.add_html("")
            self._format = gui.add_dropdown("Format", FORMATS)
            self._export = gui.add_button("Export")
        self.refresh()
        self._upload.on_upload(lambda event: self._try(self._receive))
        self._event.on_update(lambda event: self._show_numbers())
        self._plan.on_click(lambda event: self._try(lambda: desk.plan(self._shot())))
        self._run.on_click(lambda event: self._try(lambda: desk.run(self._shot())))
        self._stop.on_click(lambda event: self._try(desk.stop))
        self._watch.on_click(lambda event: self._try(self._open_viewer))
        self._export.on_click(
            lambda event: self._try(lambda: desk.export(self._object.value, self._format.value))
        )
        self._end = threading.Event()
        self._clock = threading.Thread(target=self._tick, name="gsfluent-studio", daemon=True)
        self._clock.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{_HOST}:{self.server.get_port()}"

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        # asleep, not in a lock: Ctrl-C inside Event.wait may leave with the lock's own error
        while not self._end.is_set():
            time.sleep(_TICK)

    def close(self) -> None:
        """Stop what is at work, and stop serving."""
        self._end.set()
        self._clock.join()
        self.desk.stop()
        for viewer in self.viewers.values():
            viewer.close()
        stop_server(self.server)

    def refresh(self, choose: str = "") -> None:
        """Look for objects anew, and choose one."""
        names = self.desk.objects() or [_NONE]
        kept = choose or self._object.value
        self._object.options = tuple(names)
        self._object.value = kept if kept in names else names[0]

    def _receive(self) -> None:
        file = self._upload.value
        self.refresh(self.desk.receive(file.name, file.content))
        self._say(f"{self._object.value} is there, {len(file.content) / 1e6:.1f} MB")

    def _show_numbers(self) -> None:
        self._height.visible = self._event.value == DROP
        self._speed.visible = self._event.value == THROW

    def _shot(self) -> Path:
        self._say("")
        return self.desk.prepare(
            self._object.value, self._material.value, self._event.value,
            self._height.value, self._speed.value, self._size.value,
        )  # fmt: skip

    def _open_viewer(self) -> None:
        """Serve the result, finished or growing, on a page of its own."""
        out = self.desk.out(self._object.value)
        self._link.content = ""
        self._say(f"opening {out.name}")
        if out not in self.viewers:
            self.viewers[out] = App(RunSource(out), self.device, host=_HOST, port=0)
        address = html.escape(self.viewers[out].url)
        self._link.content = f'<a id="watch" href="{address}" target="_blank">{address}</a>'
        self._say("")

    def _try(self, act: Callable[[], None]) -> None:
        try:
            act()
        except GsfluentError as error:
            self._say(str(error))

    def _say(self, text: str) -> None:
        self._said = text

    def _tick(self) -> None:
        while not self._end.wait(_TICK):
            self._state.content, self._bar.value = self._news()

    def _news(self) -> tuple[str, float]:
        """What the page says of the command and of what was pressed, and how far it is in %."""
        parts, share = [], 0.0
        job = self.desk.job
        if job is not None:
            state, progress = job.state, job.progress
            parts.append(f"<b>{job.name}: {state}</b>, {job.seconds:.0f} s")
            if state == RUNNING and progress is not None:
                share = 100.0 * progress[1]
                parts[-1] += f", {progress[0]} {share:.0f} %"
            share = 100.0 if state == DONE else share
            text = job.answer if state == DONE else "\n".join(list(job.lines)[-_LINES:])
            if state == FAILED:
                text = "\n".join(job.lines)
            parts.append(f'<pre style="white-space:pre-wrap">{html.escape(text)}</pre>')
        if self._said:
            parts.append(f'<pre style="white-space:pre-wrap">{html.escape(self._said)}</pre>')
        body = "".join(parts) or "Choose an object, then Plan or Run."
        return f'<div style="padding:0 1em;font-size:0.8em">{body}</div>', share


def serve_studio(
    folder: Path,
    *,
    device: torch.device,
    seed: int = 0,
    port: int = 8080,
    browser: bool = True,
) -> dict[str, Any]:
    """Serve the studio until Ctrl-C.

    Arguments as the options of ``gsfluent studio``.

    Returns:
        ``url`` and ``folder``.

    Raises:
        InputError: No viser, or no port.
    """
    studio = Studio(Desk(folder, str(device), seed), device, port)
    try:
        stay(studio, browser=browser, name="studio")
    finally:
        studio.close()
    return {"url": studio.url, "folder": str(folder)}
