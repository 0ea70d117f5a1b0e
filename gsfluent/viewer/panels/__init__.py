"""The controls of the page."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.viewer.panels.look": ("LookPanel",),
        "gsfluent.viewer.panels.page": ("Page",),
        "gsfluent.viewer.panels.plot": ("PlotPanel",),
        "gsfluent.viewer.panels.poke": ("PokePanel",),
        "gsfluent.viewer.panels.time": ("TimePanel",),
    },
)
