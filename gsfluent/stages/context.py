"""What the stages of one run share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.data import Capture, Frame
from gsfluent.progress import Reporter
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageStore


@dataclass
class RunContext:
    """Settings of a run and what its stages hand on.

    They hand on files and fingerprints, not tensors, so that any of them may be skipped.

    Attributes:
        shot: What to do.
        out: Result folder.
        device: Where to compute.
        seed: Seed of everything random.
        store: Finished stages.
        record: ``run.json``.
        reporter: Progress.
        capture: The photographs, when the shot has any.
        frame: World to scene; set by the isolate stage.
        source_key: Fingerprint of the last stage, which the next one builds on.
    """

    shot: Shot
    out: Path
    device: torch.device
    seed: int
    store: StageStore
    record: RunRecord
    reporter: Reporter
    capture: Capture | None = None
    frame: Frame = field(default_factory=Frame.identity)
    source_key: str = ""

    def key(self, *parts: Any) -> list[Any]:
        """Fingerprint parts every stage shares."""
        return [self.seed, self.device.type, *parts]
