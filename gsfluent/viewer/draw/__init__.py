"""How the viewer makes its pictures."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.viewer.draw.artist": ("Artist",),
        "gsfluent.viewer.draw.picture": ("PictureMaker", "browser_camera"),
        "gsfluent.viewer.draw.splats": ("BrowserSplats",),
    },
)
