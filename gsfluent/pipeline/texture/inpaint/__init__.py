"""A volume from slices that a 2-D model has inpainted."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.texture.inpaint.method": ("diffusion_texture", "no_model"),
        "gsfluent.pipeline.texture.inpaint.options": ("InpaintOptions",),
    },
)
