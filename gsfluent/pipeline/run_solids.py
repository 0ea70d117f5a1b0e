"""The stages up to the solids of a shot, for a run and for whoever needs its objects at rest."""

from __future__ import annotations

from pathlib import Path

import torch

from gsfluent.config import Shot
from gsfluent.pipeline.run_context import RunContext
from gsfluent.pipeline.run_prepare import (
    fill_stage,
    isolate_stage,
    reconstruct_stage,
    texture_stage,
)
from gsfluent.pipeline.run_record import RunRecord
from gsfluent.pipeline.run_regions import regions_stage
from gsfluent.pipeline.run_store import StageStore
from gsfluent.progress import LineReporter, Reporter

__all__ = ["context_of", "make_solids"]


def context_of(
    shot: Shot,
    out: Path,
    device: torch.device | str,
    seed: int,
    reporter: Reporter | None = None,
) -> RunContext:
    """What stages need to take up, or to begin, a run in a folder; nothing is done or written yet.

    Args:
        shot: The shot.
        out: Folder of the run.
        device: Where the stages compute.
        seed: Seed of everything random.
        reporter: Receives progress; log lines by default.
    """
    device = torch.device(device)
    record = RunRecord(out / "run.json", shot.resolved(), device, seed)
    store = StageStore(out / "stages")
    return RunContext(shot, out, device, seed, store, record, reporter or LineReporter())


def make_solids(context: RunContext) -> None:
    """Do the stages up to the solids and their regions, or find them done.

    Raises:
        InputError: The shot, or a file that it names, is wrong.
    """
    for stage in (reconstruct_stage, isolate_stage, fill_stage, texture_stage, regions_stage):
        stage(context)
