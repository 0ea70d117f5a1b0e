"""The controls of the page."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    look="LookPanel",
    page="Page",
    plot="PlotPanel",
    poke="PokePanel",
    time="TimePanel",
)
