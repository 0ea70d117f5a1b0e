"""The viewer: a result in the browser, drawn by our own rasterizer, so that light shows.

A :class:`~gsfluent.viewer.source.Source` hands out frames (a finished run, a running one, a live
session); :class:`~gsfluent.viewer.timeline.Timeline` keeps what they have in common;
:class:`~gsfluent.viewer.picture.PictureMaker` turns a moment, a camera and a
:class:`~gsfluent.viewer.look.Look` into a picture without any browser; and
:class:`~gsfluent.viewer.app.App` is the page.
"""
