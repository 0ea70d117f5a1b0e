"""gsfluent run: the whole shot, the demo, single stages, the report."""

from gsfluent._lazy import lazy

__getattr__, __dir__, __all__ = lazy(
    __name__,
    {
        "gsfluent.run.demo": ("SIZES", "photograph_demo", "run_demo"),
        "gsfluent.run.report": ("read_run", "write_report"),
        "gsfluent.run.shot": ("run_shot",),
        "gsfluent.run.single": ("fill_to", "reconstruct_to", "texture_to"),
    },
)
