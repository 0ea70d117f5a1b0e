"""A volume grown from patches of exemplars."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    method="SynthesisOptions exemplar_texture",
    patches="Schedule project_slice",
)
