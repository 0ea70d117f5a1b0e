"""What is checked before a file is read: that it is one, its size, its names, its numbers."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    arrays="read_npy read_npz",
    files="is_file parse_json read_bytes read_json read_text regular_file",
    inside="allow_outside inside",
    limits="DEPTH limit unpacked_limit within",
    pictures="check_pixels opened_image",
)
