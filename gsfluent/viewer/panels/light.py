"""The lamps of the page: any number, each turned, dimmed, tinted and softened on its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from gsfluent.pipeline.light.environment import sky_and_ground
from gsfluent.pipeline.light.lamps import SOFTNESS, SPECULAR, Lamp, Lighting
from gsfluent.viewer.model.look import angles, direction

if TYPE_CHECKING:
    import viser

_SHOT, _SKY, _NONE = "as in the shot", "sky", "none"
_SKY_ABOVE, _GROUND_BELOW = (0.45, 0.55, 0.75), (0.25, 0.22, 0.18)
_SECOND = Lamp(direction=(-1.0, -0.6, 0.5), intensity=0.4, color=(1.0, 0.86, 0.7))
_MOST_LAMPS = 8
_WIDTH = 0.3  # of a near lamp, in sizes of the object
_FAR, _NEAR = "far away", "near"
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Handles:
    """A lamp in the terms of the sliders."""

    azimuth: float  # Around the object [degrees]
    elevation: float  # Above the floor [degrees]
    distance: float | None  # From the object [m]; None for a lamp that is far away

    @classmethod
    def of(cls, lamp: Lamp, pivot: Vector) -> Handles:
        """Where a lamp is, seen from ``pivot`` [m]."""
        if lamp.position is None:
            return cls(*angles(lamp.direction), None)
        x, y, z = (p - c for p, c in zip(lamp.position, pivot, strict=True))
        return cls(*angles((x, y, z)), max(1e-3, (x * x + y * y + z * z) ** 0.5))

    def moved(self, lamp: Lamp, pivot: Vector) -> Lamp:
        """The lamp put there; a near one has its strength at the object."""
        toward = direction(self.azimuth, self.elevation)
        if self.distance is None:
            return replace(lamp, direction=toward, position=None)
        x, y, z = (c + self.distance * t for c, t in zip(pivot, toward, strict=True))
        return replace(lamp, direction=toward, position=(x, y, z), distance=self.distance)


class LightPanel:
    """Controls of a :class:`~gsfluent.pipeline.light.lamps.Lighting`.

    Args:
        gui: The page's controls.
        first: The light at the start.
        pivot: What near lamps turn about [m].
        reach: Size of the object [m].
        changed: Called after every change by a person.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        first: Lighting,
        pivot: Vector,
        reach: float,
        changed: Callable[[], None],
    ) -> None:
        self._first, self._pivot, self._reach, self._changed = first, pivot, reach, changed
        self._lamps = list(first.lamps) or [Lamp(intensity=0.0)]
        self._shown = 0
        shine = SPECULAR if first.specular is None else first.specular
        self._shine = round(float(shine), 2)
        top = max(2.0, *(lamp.intensity for lamp in self._lamps))
        with gui.add_folder("Light"):
            self._on: Any = gui.add_checkbox(
                "Lit", True, hint="Off shows the colours as they were photographed"
            )
            self._which: Any = gui.add_dropdown("Lamp", self._names())
            self._azimuth: Any = gui.add_slider("Around", -180, 180, 1, 0, hint="[degrees]")
            self._elevation: Any = gui.add_slider("Height", -90, 90, 1, 0, hint="[degrees]")
            self._intensity: Any = gui.add_slider("Strength", 0.0, top, 0.01, 0.0)
            self._shadow: Any = gui.add_checkbox("Shadow", True)
            self._ambient: Any = gui.add_slider("Ambient", 0.0, 1.5, 0.01, float(first.ambient))
            self._specular: Any = gui.add_slider("Highlights", 0.0, 1.0, 0.01, self._shine)
            with gui.add_folder("More light", expand_by_default=False):
                self._build_more(gui)
        self._show()
        self._listen()

    def _build_more(self, gui: viser.GuiApi) -> None:
        first = self._first
        around = (_SHOT, _SKY, _NONE) if first.environment else (_NONE, _SKY)
        self._more: Any = gui.add_button_group("Lamps", ("add", "remove"))
        self._color: Any = gui.add_rgb("Colour", (255, 255, 255))
        self._size: Any = gui.add_slider(
            "Softness", 0.0, 30.0, 0.5, SOFTNESS, hint="Apparent width of the lamp [degrees]"
        )
        self._place: Any = gui.add_dropdown("Place", (_FAR, _NEAR))
        self._distance: Any = gui.add_slider(
            "Distance", 1.5, 12.0, 0.1, 4.0, hint="In sizes of the object", visible=False
        )
        self._around: Any = gui.add_dropdown("Surround", around, initial_value=around[0])
        self._occlusion: Any = gui.add_slider(
            "Occlusion", 0.0, 1.0, 0.05, float(first.occlusion), hint="Dark corners"
        )

    def lighting(self) -> Lighting | None:
        """What the controls say; None when the light is off."""
        if not self._on.value:
            return None
        environment = self._first.environment
        if self._around.value != _SHOT:
            sky = self._around.value == _SKY
            environment = sky_and_ground(_SKY_ABOVE, _GROUND_BELOW) if sky else None
        # untouched, the slider leaves every material its own highlights
        own = self._first.specular is None and self._specular.value == self._shine
        return replace(
            self._first,
            lamps=tuple(self._lamps),
            ambient=self._ambient.value,
            environment=environment,
            occlusion=self._occlusion.value,
            specular=None if own else self._specular.value,
        )

    def _names(self) -> tuple[str, ...]:
        return ("key", *(f"lamp {number + 2}" for number in range(len(self._lamps) - 1)))

    def _listen(self) -> None:
        """Callbacks; what the program itself sets (no client) is not a person's change."""
        lamp = (
            self._azimuth,
            self._elevation,
            self._intensity,
            self._color,
            self._size,
            self._shadow,
            self._place,
            self._distance,
        )
        shared = (self._on, self._ambient, self._around, self._occlusion, self._specular)

        def edited(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._lamps[self._shown] = self._edited(self._lamps[self._shown])
                self._distance.visible = self._place.value == _NEAR
                self._changed()

        def pressed(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._changed()

        for control in lamp:
            control.on_update(edited)
        for control in shared:
            control.on_update(pressed)

        @self._which.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._shown = self._names().index(self._which.value)
                self._show()

        @self._more.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            if self._more.value == "add" and len(self._lamps) < _MOST_LAMPS:
                self._lamps.append(_SECOND)
                self._shown = len(self._lamps) - 1
            elif self._more.value == "remove" and len(self._lamps) > 1:
                self._lamps.pop(self._shown)
                self._shown = max(0, self._shown - 1)
            self._which.options = self._names()
            self._which.value = self._names()[self._shown]
            self._show()
            self._changed()

    def _show(self) -> None:
        """Set the controls to the chosen lamp."""
        self._which.visible = len(self._lamps) > 1
        lamp = self._lamps[self._shown]
        where = Handles.of(lamp, self._pivot)
        near = where.distance is not None
        self._azimuth.value = round(where.azimuth)
        self._elevation.value = round(where.elevation)
        self._intensity.value = lamp.intensity
        red, green, blue = (min(255, max(0, round(255 * part))) for part in lamp.color)
        self._color.value = (red, green, blue)
        size = lamp.size if lamp.size is not None else SOFTNESS
        self._size.value = min(30.0, size)
        self._size.visible = not near
        self._shadow.value = lamp.shadow
        self._place.value = _NEAR if near else _FAR
        self._distance.visible = near
        if where.distance is not None:
            self._distance.value = min(12.0, max(1.5, where.distance / self._reach))

    def _edited(self, lamp: Lamp) -> Lamp:
        """A lamp with what the controls say; untouched controls change nothing."""
        now = Handles.of(lamp, self._pivot)
        near = self._place.value == _NEAR
        asked = Handles(
            self._azimuth.value,
            self._elevation.value,
            self._distance.value * self._reach if near else None,
        )
        same = round(now.azimuth) == asked.azimuth and round(now.elevation) == asked.elevation
        if not same or now.distance != asked.distance:
            lamp = asked.moved(lamp, self._pivot)
        if near:  # the width of a near lamp is in metres
            size = lamp.size if now.distance is not None else _WIDTH * self._reach
        else:
            size = self._size.value
        red, green, blue = (part / 255.0 for part in self._color.value)
        return replace(
            lamp,
            color=(red, green, blue),
            intensity=self._intensity.value,
            shadow=self._shadow.value,
            size=size,
        )
