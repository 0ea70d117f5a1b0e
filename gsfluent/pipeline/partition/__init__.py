"""The rest solid cut into pieces by a smooth partition, finer than the points that carry them."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    chips="hashed",
    mesh="PieceMesh Surfaces",
    roughness="amplitude relief",
    splits="Split Splits",
    threshold="CHIP",
    tree="Partition",
)
