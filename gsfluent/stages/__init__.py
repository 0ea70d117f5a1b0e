"""Stages of a run over files: fingerprint, work, record; resumable."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.stages.chain": ("run_stages",),
        "gsfluent.stages.context": ("RunContext",),
        "gsfluent.stages.select": ("select_mask",),
        "gsfluent.stages.show": ("render_again",),
        "gsfluent.stages.simulate": (
            "build_scene",
            "moving_settings",
            "saved",
            "solver_options",
            "thin_walls",
        ),
        "gsfluent.stages.solids": ("context_of", "load_solids", "make_solids"),
    },
)
