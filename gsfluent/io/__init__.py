"""Files in and out: splats, captures, images. Nothing here keeps state."""

from gsfluent.io.atomic import atomic_path, write_json
from gsfluent.io.capture import kind_of, load_capture
from gsfluent.io.images import load_image, save_image
from gsfluent.io.solid import load, load_solid, save, save_solid
from gsfluent.io.splats.delta import DeltaReader
from gsfluent.io.splats.load import load_splats, save_splats
from gsfluent.io.splats.ply import read_ply, write_ply

__all__ = [
    "DeltaReader",
    "atomic_path",
    "kind_of",
    "load",
    "load_capture",
    "load_image",
    "load_solid",
    "load_splats",
    "read_ply",
    "save",
    "save_image",
    "save_solid",
    "save_splats",
    "write_json",
    "write_ply",
]
