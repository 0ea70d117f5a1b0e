"""What a panel may ask of the page that it stands on."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Protocol

from gsfluent.data import Camera
from gsfluent.viewer.model.look import Look
from gsfluent.viewer.model.playback import Playback
from gsfluent.viewer.model.source import Source
from gsfluent.viewer.model.timeline import Timeline

if TYPE_CHECKING:
    import viser


class Page(Protocol):
    """The page as its panels know it; :class:`gsfluent.viewer.app.App` is one."""

    source: Source
    timeline: Timeline
    playback: Playback
    index: int
    follow: bool
    tracking: bool
    pictures: int
    shift: tuple[float, float, float]
    lock: threading.RLock

    def show(self, index: int) -> None:
        """Go to frame ``index``."""

    def refresh(self) -> None:
        """Look for new frames."""

    def say(self) -> None:
        """Write the state of the page anew."""

    def toggle(self) -> None:
        """Play, or pause."""

    def pause(self) -> None:
        """Stop playing."""

    def set_look(self, look: Look) -> None:
        """Change colours, light or cut."""

    def track(self, on: bool) -> None:
        """Whether the view travels with the matter."""

    def go_home(self, client: viser.ClientHandle) -> None:
        """Bring a client's camera back to where it began."""

    def camera(self, client: viser.ClientHandle, budget: float = float("inf")) -> Camera:
        """The camera of a client."""

    def png(self, client: viser.ClientHandle) -> bytes:
        """The picture that a client sees."""
