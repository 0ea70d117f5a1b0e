"""Gaussians -> picture -> video; the Render stage."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.render.backdrop": ("Backdrop", "no_background"),
        "gsfluent.pipeline.render.camera": ("Action", "orbit"),
        "gsfluent.pipeline.render.cuts": ("save_cut_views",),
        "gsfluent.pipeline.render.figures": ("FilmFigures",),
        "gsfluent.pipeline.render.film": ("Film", "captured_backdrop", "poster_frame"),
        "gsfluent.pipeline.render.path": ("Cut", "FREEZE_SECONDS", "freeze"),
        "gsfluent.pipeline.render.stage": ("Render",),
        "gsfluent.pipeline.render.studio": ("Studio",),
        "gsfluent.pipeline.render.video": ("to_bytes", "write_animation", "write_video"),
    },
)
