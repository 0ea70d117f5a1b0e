"""A sweep as training data: depth, flow, labels; WebDataset and Hugging Face folders."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    write="write_dataset",
)
