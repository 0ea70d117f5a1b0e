"""Gaussians -> picture -> video; the Render stage."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    backdrop="Backdrop no_background",
    camera="Action FARTHEST cameras_for look_at orbit",
    cuts="save_cut_views",
    figures="FilmFigures",
    film="Film captured_backdrop drawn_by poster_frame studio_is_dark",
    path="Cut FREEZE_SECONDS freeze",
    stage="Render",
    studio="Studio",
    video="to_bytes write_animation write_video",
)
