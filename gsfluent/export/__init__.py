"""A finished simulation in other programs' formats."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.export.write": ("ExportOptions", "export", "write_exports"),
    },
)
