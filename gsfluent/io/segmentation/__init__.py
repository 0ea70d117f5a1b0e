"""Label maps of photographs, read from any segmenter's files."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.io.segmentation.files": ("RawLabels", "numbered", "read_raw"),
        "gsfluent.io.segmentation.masks": (
            "LabelView",
            "Segmentation",
            "load_masks",
            "load_segmentation",
        ),
    },
)
