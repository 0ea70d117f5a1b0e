"""Numbers of materials learnt from motion: parameters, forward runs, search, stage."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    stage="Fit Found",
    guidance="Guide",
    video_prior="VideoPrior",
    task="Task run_task",
    laws="plain",
)
