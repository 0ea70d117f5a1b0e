"""The voxels that get colours: domain, noise, colour spaces."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    domain=(
        "InteriorDomain InteriorTexture SHELL axis_frame blend_skin block_mean gradient "
        "nearest_in options_of smoothstep"
    ),
    noise="cells fractal value_noise",
)
