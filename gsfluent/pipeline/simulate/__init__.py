"""Scene -> frames: stage, run, step, health; the engines; what is off the grid."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.pipeline.simulate.debris": ("reach_of",),
        "gsfluent.pipeline.simulate.engine": ("CFL", "SolverOptions"),
        "gsfluent.pipeline.simulate.groups": ("LANDING",),
        "gsfluent.pipeline.simulate.grow": ("copy_of", "grow", "shrink"),
        "gsfluent.pipeline.simulate.run": ("Run",),
        "gsfluent.pipeline.simulate.stage": ("QUALITY", "Simulate", "SimulationFrame", "frame_of"),
    },
)
