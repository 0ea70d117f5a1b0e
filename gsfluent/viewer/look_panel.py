"""Colour, light, cut and view controls."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gsfluent.pipeline.light import SPECULAR, Lamp, Lighting
from gsfluent.viewer import look
from gsfluent.viewer.look import Cut, Look

if TYPE_CHECKING:
    import viser

    from gsfluent.viewer.app import App

_FREE = "free"
_STEPS = 48  # of the cut's slider over the object


class LookPanel:
    """What the picture looks like.

    Args:
        server: The page.
        app: Gets a new :class:`~gsfluent.viewer.look.Look` with every change.
        first: The light at the start.
        lit: Whether light can be had at all (not with splats drawn in the browser).
    """

    def __init__(
        self, server: viser.ViserServer, app: App, first: Lighting, *, lit: bool = True
    ) -> None:
        self._app, self._first, self._lit = app, first, lit
        gui = server.gui
        with gui.add_folder("Colour"):
            self._color = gui.add_dropdown("By", look.COLOR_BY, initial_value=look.APPEARANCE)
            self._legend = gui.add_html("", visible=False)
        if lit:
            self._build_light(gui, first)
        self._build_cut(gui)
        with gui.add_folder("View", expand_by_default=False):
            self._track = gui.add_checkbox(
                "Follow object", app.tracking, hint="The view travels with the matter"
            )
            self._floor = gui.add_checkbox("Floor", True, visible=lit)
            home = gui.add_button("Reset view")
            save = gui.add_button("Save picture", visible=lit)
        for control in self._controls():
            control.on_update(self._changed)

        @self._track.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
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

    def _build_light(self, gui: viser.GuiApi, first: Lighting) -> None:
        key = first.lamps[0] if first.lamps else Lamp(intensity=0.0)
        shine = SPECULAR if first.specular is None else first.specular
        self._shine = round(float(shine) / 0.02) * 0.02
        azimuth, elevation = look.angles(key.position or key.direction)
        with gui.add_folder("Light"):
            self._on = gui.add_checkbox(
                "Lit", True, hint="Off shows the colours as they were photographed"
            )
            self._azimuth = gui.add_slider("Around", -180, 180, 1, round(azimuth), hint="[°]")
            self._elevation = gui.add_slider("Height", 0, 90, 1, round(max(0.0, elevation)))
            self._intensity = gui.add_slider("Strength", 0.0, 2.0, 0.05, float(key.intensity))
            self._ambient = gui.add_slider("Ambient", 0.0, 1.5, 0.05, float(first.ambient))
            self._specular = gui.add_slider("Highlights", 0.0, 1.0, 0.02, self._shine)
            self._shadow = gui.add_checkbox("Shadow", bool(key.shadow))

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
        light = []
        if self._lit:
            light = [
                self._on,
                self._azimuth,
                self._elevation,
                self._intensity,
                self._ambient,
                self._specular,
                self._shadow,
            ]
        cut = [
            self._cut,
            self._axis,
            self._cut_azimuth,
            self._cut_elevation,
            self._offset,
            self._flip,
        ]
        return [self._color, *light, *cut, self._floor]

    def _changed(self, event: Any) -> None:
        free = self._axis.value == _FREE
        self._cut_azimuth.visible = self._cut_elevation.visible = free
        self._app.set_look(self.look())

    def look(self) -> Look:
        """What the controls say."""
        return Look(self._color.value, self._light(), self._cut_plane(), self._floor.value)

    def _light(self) -> Lighting | None:
        if not self._lit or not self._on.value:
            return None
        first = self._first
        key = replace(
            first.lamps[0] if first.lamps else Lamp(),
            direction=look.direction(self._azimuth.value, self._elevation.value),
            position=None,
            intensity=self._intensity.value,
            shadow=self._shadow.value,
        )
        # untouched, the slider leaves every material its own highlights
        shine = self._specular.value
        own = first.specular is None and shine == self._shine
        return replace(
            first,
            lamps=(key, *first.lamps[1:]),
            ambient=self._ambient.value,
            specular=None if own else shine,
        )

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

    def show_legend(self, content: str) -> None:
        """Put the legend under the choice of colours; nothing hides it."""
        if content != self._legend.content:
            self._legend.content = content
        self._legend.visible = bool(content)
