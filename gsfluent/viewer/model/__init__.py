"""What the viewer knows: sources of frames, the time line, what is looked at."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.viewer.model": ("look",),
        "gsfluent.viewer.model.color": ("Legend", "splat_colors"),
        "gsfluent.viewer.model.live_source": ("LiveSource", "factor"),
        "gsfluent.viewer.model.look": ("Cut", "Look", "angles", "direction"),
        "gsfluent.viewer.model.pace": ("Pace",),
        "gsfluent.viewer.model.playback": ("Playback",),
        "gsfluent.viewer.model.plots": ("NOW", "Plot", "plots_of"),
        "gsfluent.viewer.model.source": ("RunSource", "Source"),
        "gsfluent.viewer.model.timeline": ("Timeline",),
    },
)
