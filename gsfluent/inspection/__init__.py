"""Looking without computing: captures, parts, comparisons, doctor."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.inspection.capture": ("inspect",),
        "gsfluent.inspection.compare": ("compare",),
        "gsfluent.inspection.doctor": ("examine",),
        "gsfluent.inspection.shot": ("inspect_shot", "inspect_solid"),
    },
)
