"""How the viewer makes its pictures."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    artist="Artist",
    picture="PictureMaker browser_camera",
    splats="BrowserSplats",
)
