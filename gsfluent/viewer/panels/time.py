"""Frame slider, play, speed, loop, and what is known of the moment shown."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from gsfluent.viewer.panels.page import Page

if TYPE_CHECKING:
    import viser

_SPEEDS = {f"1/{n}": 1.0 / n for n in (256, 128, 64, 32, 16, 8, 4, 2)}
_SPEEDS |= {"1 (real time)": 1.0, "2": 2.0}
_WATCHABLE = 20.0  # frames a second
_HELD = 0.4  # seconds for which a slider counts as held after it was moved


class TimePanel:
    """The controls of time."""

    def __init__(self, server: viser.ViserServer, app: Page) -> None:
        gui = server.gui
        self._app = app
        self._held = 0.0
        first = first_speed(app.timeline.fps())
        with gui.add_folder("Time"):
            self._slider: Any = gui.add_slider("Frame", 0, 1, 1, 0)
            self._facts = gui.add_html("")
            self._play = gui.add_button("Play")
            self._step = gui.add_button_group("Step", ("first", "back", "next", "last"))
            self._speed = gui.add_dropdown("Speed", tuple(_SPEEDS), initial_value=first)
            self._loop = gui.add_checkbox("Loop", True)
            self._follow: Any = gui.add_checkbox(
                "Newest frame", False, hint="Go to each frame as it is written", visible=False
            )
        app.playback.speed = _SPEEDS[first]

        @self._slider.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is None:  # the clock moved it, not a person
                return
            self._held = time.monotonic()
            app.playback.pause()
            app.follow = False
            # several of these may run at once; the last one to get in shows the newest place
            with app.lock:
                app.show(int(self._slider.value))

        @self._play.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            app.toggle()

        @self._step.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            app.playback.pause()
            app.follow = False
            last = app.timeline.count - 1
            now = app.index
            to = {"first": 0, "back": now - 1, "next": now + 1, "last": last}
            app.show(max(0, min(last, to[self._step.value])))

        @self._speed.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            app.playback.set_speed(_SPEEDS[self._speed.value], app.index)

        @self._loop.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            app.playback.loop = self._loop.value

        @self._follow.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                app.follow = self._follow.value

        self.update()

    def update(self) -> None:
        """Show the app's present state."""
        app = self._app
        last = app.timeline.count - 1
        # a slider needs two places
        self._slider.max = max(1, last)
        self._slider.disabled = self._play.disabled = last < 1
        self._step.visible = last >= 1
        # not under a person's finger, where it may have gone farther meanwhile
        if time.monotonic() - self._held > _HELD:
            self._slider.value = app.index
        self._play.label = "Pause" if app.playback.playing else "Play"
        self._follow.visible = app.source.running
        self._follow.value = app.follow
        facts = app.timeline.facts()
        self._facts.content = facts_line(facts[app.index] if app.index < len(facts) else {})


def first_speed(fps: float) -> str:
    """The fastest speed, up to real time, at which the eye can follow ``fps`` frames a second."""
    slow = [name for name, speed in _SPEEDS.items() if speed <= 1.0 and fps * speed <= _WATCHABLE]
    return slow[-1] if slow else next(iter(_SPEEDS))


def facts_line(facts: dict[str, Any]) -> str:
    """Time, pieces and damage of a moment, as HTML."""
    words = []
    if "time" in facts:
        words.append(f"t = {facts['time']:.3f} s")
    if isinstance(facts.get("fragments"), int):
        count = facts["fragments"]
        words.append(f"{count} piece{'s' * (count != 1)}")
    if isinstance(facts.get("damaged_fraction"), float):
        words.append(f"{100 * facts['damaged_fraction']:.1f} % broken")
    if not words:
        return ""
    text = " · ".join(words)
    return f'<div style="padding:0 14px 6px 14px;font-size:0.8em;opacity:0.75">{text}</div>'
