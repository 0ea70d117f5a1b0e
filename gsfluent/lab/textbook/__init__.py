"""The textbook solver: MPM as papers print it, with its variants."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.lab.textbook.grid": ("stencil",),
        "gsfluent.lab.textbook.laws": ("advance", "measure"),
        "gsfluent.lab.textbook.nacc": ("Nacc", "return_map"),
        "gsfluent.lab.textbook.solver": ("Textbook", "Variant", "run_textbook"),
        "gsfluent.lab.textbook.variant": ("Birth",),
    },
)
