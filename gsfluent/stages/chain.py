"""The chain of stages that a shot is, without what a run puts around it."""

from __future__ import annotations

from collections.abc import Callable

from gsfluent.stages.context import RunContext
from gsfluent.stages.show import export_stage, render_stage
from gsfluent.stages.simulate import simulate_stage
from gsfluent.stages.solids import make_solids


def run_stages(context: RunContext, settle: Callable[[RunContext], None] | None = None) -> None:
    """Do every stage of a shot, or find it done.

    Args:
        context: The run.
        settle: Called when the solids are there and nothing has moved yet: it may change the
            shot's settings.
    """
    make_solids(context)
    if settle is not None:
        settle(context)
    simulate_stage(context)
    render_stage(context)
    export_stage(context)
