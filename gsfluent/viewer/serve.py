"""``gsfluent view``: serve a run until Ctrl-C, or draw one picture of it to see that all works."""

from __future__ import annotations

import logging
import os
import sys
import webbrowser
from pathlib import Path
from typing import Any, Protocol

import torch

from gsfluent.io import save_image
from gsfluent.viewer.app import App
from gsfluent.viewer.model.source import RunSource

_log = logging.getLogger(__name__)
_CHECK_SIZE = (960, 720)


def view_run(
    out: Path,
    *,
    device: torch.device,
    host: str = "127.0.0.1",
    port: int = 8080,
    splats: bool = False,
    check: bool = False,
    to: Path | None = None,
    browser: bool = True,
) -> dict[str, Any]:
    """Serve the viewer of a run.

    Arguments as the options of ``gsfluent view``.

    Returns:
        ``url`` and ``frames``; with ``check`` also ``output`` and ``frame``.

    Raises:
        InputError: Not a run, no viser, no port, too many splats.
        RunError: No frame can be read.
    """
    source = RunSource(out)
    app = App(source, device, host=host, port=0 if check else port, splats=splats)
    result: dict[str, Any] = {"url": app.url, "frames": app.timeline.count}
    try:
        if check:
            target = to or out / "view.png"
            camera = app.maker.camera(app.index, *_CHECK_SIZE)
            picture = app.maker.picture(app.index, camera, app.look)
            save_image(torch.from_numpy(picture).float() / 255.0, target)
            return result | {"output": str(target), "frame": app.index}
        stay(app, browser=browser)
    finally:
        app.close()
    return result


class Page(Protocol):
    """What is served at an address."""

    @property
    def url(self) -> str:
        """The address."""

    def wait(self) -> None:
        """Serve until Ctrl-C."""


def stay(page: Page, *, browser: bool, name: str = "viewer") -> None:
    """Say the address, open a browser where one could show, and serve until Ctrl-C."""
    try:
        _log.info("%s: %s (Ctrl-C ends)", name, page.url)
        if browser and has_desktop():
            webbrowser.open(page.url)
        page.wait()
    except KeyboardInterrupt:
        _log.info("%s: ended", name)


def has_desktop() -> bool:
    """Whether a browser could show a window: never over a bare ssh line."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
