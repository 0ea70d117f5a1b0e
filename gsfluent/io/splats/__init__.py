"""Splats in files: PLY, compressed PLY, .splat, SPZ, delta sequences."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.io.splats.delta": ("DeltaFrame", "DeltaReader", "hamilton"),
        "gsfluent.io.splats.delta_write": ("Roster", "steps", "write_delta"),
        "gsfluent.io.splats.load": ("load_splats", "save_splats"),
        "gsfluent.io.splats.ply": ("read_ply", "write_ply"),
        "gsfluent.io.splats.splat": ("save_splat",),
        "gsfluent.io.splats.spz": ("save_spz",),
    },
)
