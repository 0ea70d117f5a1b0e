"""A volume grown from patches of exemplars."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.texture.synthesis.method": ("SynthesisOptions", "exemplar_texture"),
        "gsfluent.pipeline.texture.synthesis.patches": ("Schedule", "project_slice"),
    },
)
