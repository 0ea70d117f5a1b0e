"""``gsfluent view --live``: serve a prepared object that one can poke, until Ctrl-C."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch

from gsfluent.live.player import LivePlayer
from gsfluent.live.scene import open_stage
from gsfluent.live.session import CRACKS, LiveSession
from gsfluent.viewer.app import App
from gsfluent.viewer.model.live_source import LiveSource
from gsfluent.viewer.panels.poke import PokePanel
from gsfluent.viewer.serve import stay

_log = logging.getLogger(__name__)


def view_live(
    source: Path,
    *,
    device: torch.device,
    material: str | None = None,
    run: Path | None = None,
    quality: str = "live",
    slow: float | None = None,
    cracks: str = CRACKS,
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
    browser: bool = True,
) -> dict[str, Any]:
    """Serve a live session.

    Arguments as the options of ``gsfluent view --live``.

    Returns:
        ``url``, the session's figures, and ``recordings``, the folders that were recorded.

    Raises:
        InputError: Nothing to poke, no viser, no port, or a number out of range.
    """
    stage = open_stage(source, material=material, out=run, device=device, seed=seed)
    session = LiveSession(
        stage.scene, quality=quality, device=device, slow=slow or 4.0, seed=seed, cracks=cracks
    )
    _log.info("live: %d points, cells of %.4g m", session.run.matter.particles.count, session.dx)
    if not session.at_rest and not session.settle():
        _log.warning("live: the scene does not come to rest; it goes on while nobody pokes it")
    player = LivePlayer(session, stage.shot)
    player.automatic = slow is None
    home = run or (source if source.is_dir() else source.parent)
    before = set(home.glob("recording_*"))
    panel = PokePanel(player, home)
    app = App(
        LiveSource(player, stage.title, stage.shot), device, host=host, port=port, panels=[panel]
    )
    player.start()
    panel.start()
    try:
        stay(app, browser=browser)
    finally:
        panel.close()
        player.close()
        app.close()
    recordings = sorted(str(path) for path in set(home.glob("recording_*")) - before)
    return {"url": app.url, "recordings": recordings} | session.report()
