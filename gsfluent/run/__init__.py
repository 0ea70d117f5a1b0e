"""gsfluent run: the whole shot, the demo, single stages, the report."""

from gsfluent._lazy import room

__getattr__, __dir__, __all__ = room(
    __name__,
    carried="carry_to",
    demo="SIZES photograph_demo run_demo",
    from_input="made_shot",
    photographs="posed",
    report="read_run write_report",
    shot="run_shot",
    single="fill_to reconstruct_to texture_to",
)
