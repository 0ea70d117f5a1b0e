"""Scene -> frames: stage, run, step, health; the engines; what is off the grid."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    debris="reach_of",
    engine="CFL SolverOptions",
    groups="LANDING",
    grow="copy_of grow shrink",
    run="Run",
    stage="Moment QUALITY Simulate SimulationFrame frame_of",
)
