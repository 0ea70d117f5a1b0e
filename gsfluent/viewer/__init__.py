"""The viewer: a result in the browser, drawn by our own rasterizer, so that light shows.

A :class:`~gsfluent.viewer.model.source.Source` hands out frames (a finished run, a running one, a
live
session); :class:`~gsfluent.viewer.model.timeline.Timeline` keeps what they have in common;
:class:`~gsfluent.viewer.draw.picture.PictureMaker` turns a moment, a camera and a
:class:`~gsfluent.viewer.model.look.Look` into a picture without any browser; and
:class:`~gsfluent.viewer.app.App` is the page.
"""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    app="App",
    guard="Guard",
    serve="stay view_run",
    serve_live="view_live",
    server="start_server stop_server",
)
