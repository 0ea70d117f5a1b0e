"""The cheapest setting that meets an error."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.choose.choose": ("QUICK",),
        "gsfluent.choose.shot": ("chart_shot", "choose_stage", "readable"),
    },
)
