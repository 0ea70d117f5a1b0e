"""Numbers of materials learnt from motion: parameters, forward runs, search, stage."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    breaks="Break FitPieces run_break",
    guidance="Guide",
    laws="plain",
    stage="Fit Found",
    task="Task run_task",
    video_prior="VideoPrior",
)
