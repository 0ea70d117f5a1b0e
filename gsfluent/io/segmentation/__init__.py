"""Label maps of photographs, read from any segmenter's files."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    files="RawLabels numbered read_raw",
    masks="LabelView Segmentation load_masks load_segmentation",
)
