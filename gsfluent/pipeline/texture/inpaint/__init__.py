"""A volume from slices that a 2-D model has inpainted."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    method="diffusion_texture no_model",
    options="InpaintOptions",
)
