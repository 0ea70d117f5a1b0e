"""Captures as phone apps and services hand them out: in a zip, with a file per photograph."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__, archive="unpacked", polycam="is_polycam polycam_frames"
)
