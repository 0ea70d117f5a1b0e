"""Splats in files: PLY, compressed PLY, .splat, SPZ, .ksplat, SOG, checkpoints, delta sequences."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    delta="DeltaFrame DeltaReader hamilton",
    delta_write="Roster steps write_delta",
    load="READERS load_splats save_forged save_splats",
    ply="read_ply write_ply",
    splat="save_splat",
    spz="save_spz",
)
