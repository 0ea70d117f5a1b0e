"""The voxels that get colours: domain, noise, colour spaces."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.texture.volume.domain": (
            "InteriorDomain",
            "InteriorTexture",
            "SHELL",
            "axis_frame",
            "blend_skin",
            "block_mean",
            "gradient",
            "nearest_in",
            "options_of",
            "smoothstep",
        ),
        "gsfluent.pipeline.texture.volume.noise": ("cells", "fractal", "value_noise"),
    },
)
