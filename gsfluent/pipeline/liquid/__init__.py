"""Liquids: how they leave a nozzle, hold to what they wet, and are drawn."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    clear="OPACITY Clear Surface body_opacities ceiling in_front mirrored single smoothed "
    "surface_normals",
    closing="closed",
    looks="Liquids",
    nozzle="WAITING pours",
    parts="LiquidParts",
    sheet="CLOSED SPRAY TENSION ellipsoids",
    tearing="in_air tears",
)
