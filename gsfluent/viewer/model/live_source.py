"""A live session as something to view."""

from __future__ import annotations

from typing import Any

from gsfluent.config import Shot
from gsfluent.live.player import AT_REST, FAILED, PAUSED, LivePlayer
from gsfluent.results.frames import SavedFrame


class LiveSource:
    """Frames of a player since its last reset (a :class:`~gsfluent.viewer.model.source.Source`)."""

    running = True

    def __init__(self, player: LivePlayer, title: str, shot: Shot | None = None) -> None:
        self.player, self.title, self.shot = player, title, shot

    def count(self) -> int:
        """Frames since the reset."""
        return self.player.count

    def frame(self, index: int) -> SavedFrame:
        """A frame; the oldest are gone after a while."""
        return self.player.frame(index)

    def facts(self, index: int) -> dict[str, Any]:
        """Its figures."""
        return self.player.facts(index)

    @property
    def revision(self) -> str:
        """Changes at a reset."""
        return str(self.player.revision)

    def state(self) -> str:
        """What the session is doing."""
        status = self.player.status
        if status.state == FAILED:
            return f"**The simulation has failed:** {status.message} Press *Reset*."
        heads = {AT_REST: "**At rest.** Poke it.", PAUSED: "**Paused.**"}
        head = heads.get(status.state, "**Live**")
        if status.real_time is not None:
            head += f" · {factor(status.real_time)} × real time"
        if status.recording is not None:
            head += f" · recording, {status.recording} frames"
        return head + (f"\n\n**Not done:** {status.message}" if status.message else "")


def factor(value: float) -> str:
    """A real-time factor with two digits that mean something."""
    if value >= 0.095:
        return f"{value:.2f}"
    return f"{value:.3f}" if value >= 0.00095 else "less than 0.001"
