"""From photographs without poses, or a video, to a capture: structure from motion by COLMAP."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__, colmap="LEAST find_poses photographs_in poses_text", frames="SUFFIXES"
)
