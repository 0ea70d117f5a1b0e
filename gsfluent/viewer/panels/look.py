"""Colour, light, cut and view controls."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.viewer.model import look
from gsfluent.viewer.model.look import Cut, Look
from gsfluent.viewer.panels.light import LightPanel
from gsfluent.viewer.panels.page import Page

if TYPE_CHECKING:
    import viser

_FREE = "free"
_STEPS = 48  # of the cut's slider over the object


class LookPanel:
    """What the picture looks like.

    Args:
        server: The page.
        app: Gets a new :class:`~gsfluent.viewer.model.look.Look` with every change.
        first: The light at the start.
        lit: Whether light can be had at all (not with splats drawn in the browser).
    """

    def __init__(
        self, server: viser.ViserServer, app: Page, first: Lighting, *, lit: bool = True
    ) -> None:
        self._app = app
        gui = server.gui
        with gui.add_folder("Colour"):
            self._color = gui.add_dropdown("By", look.COLOR_BY, initial_value=look.APPEARANCE)
            self._legend = gui.add_html("", visible=False)
        self._light: LightPanel | None = None
        if lit:
            x, y = app.timeline.middle()
            radius = app.timeline.radius
            self._light = LightPanel(gui, first, (x, y, radius), radius, self._changed)
        self._build_cut(gui)
        with gui.add_folder("View", expand_by_default=False):
            self._track: Any = gui.add_checkbox(
                "Follow object", app.tracking, hint="The view travels with the matter"
            )
            self._floor = gui.add_checkbox("Floor", True, visible=lit)
            home = gui.add_button("Reset view")
            save = gui.add_button("Save picture", visible=lit)
        for control in self._controls():
            control.on_update(self._changed)

        @self._track.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                app.track(self._track.value)

        @home.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                app.go_home(event.client)

        @save.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                name = f"{re.sub(r'[^A-Za-z0-9_-]', '_', app.source.title)}_{app.index:04d}.png"
                event.client.send_file_download(name, app.png(event.client))

    def _build_cut(self, gui: viser.GuiApi) -> None:
        reach = 1.3 * self._app.timeline.radius
        self._unit, self._factor = ("cm", 100.0) if reach < 1.0 else ("m", 1.0)
        step = float(f"{2.0 * reach * self._factor / _STEPS:.1g}")
        span = round(step * math.ceil(reach * self._factor / step), 6)
        with gui.add_folder("Cut plane", expand_by_default=False):
            self._cut = gui.add_checkbox("Cut open", False)
            self._axis = gui.add_dropdown("Across", (*look.AXES, _FREE), initial_value="y")
            self._cut_azimuth = gui.add_slider("Around", -180, 180, 1, -60, visible=False)
            self._cut_elevation = gui.add_slider("Tilt", -90, 90, 1, 20, visible=False)
            self._offset = gui.add_slider(f"At [{self._unit}]", -span, span, step, 0.0)
            self._flip = gui.add_checkbox("Other side", False)

    def _controls(self) -> list[Any]:
        cut = [
            self._cut,
            self._axis,
            self._cut_azimuth,
            self._cut_elevation,
            self._offset,
            self._flip,
        ]
        return [self._color, *cut, self._floor]

    def _changed(self, event: Any = None) -> None:
        free = self._axis.value == _FREE
        self._cut_azimuth.visible = self._cut_elevation.visible = free
        self._app.set_look(self.look())

    def look(self) -> Look:
        """What the controls say."""
        light = None if self._light is None else self._light.lighting()
        return Look(self._color.value, light, self._cut_plane(), self._floor.value)

    def _cut_plane(self) -> Cut | None:
        if not self._cut.value:
            return None
        if self._axis.value == _FREE:
            normal = look.direction(self._cut_azimuth.value, self._cut_elevation.value)
        else:
            normal = look.AXES[self._axis.value]
        sign = -1.0 if self._flip.value else 1.0
        x, y, z = (sign * value for value in normal)
        return Cut((x, y, z), sign * self._offset.value / self._factor)

    def show_tracking(self, on: bool) -> None:
        """Show whether the view follows the object."""
        self._track.value = on

    def show_legend(self, content: str) -> None:
        """Put the legend under the choice of colours; nothing hides it."""
        if content != self._legend.content:
            self._legend.content = content
        self._legend.visible = bool(content)
