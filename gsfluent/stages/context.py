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
    """

    shot: Shot  # What to do
    out: Path  # Result folder
    device: torch.device  # Where to compute
    seed: int  # Seed of everything random
    store: StageStore  # Finished stages
    record: RunRecord  # ``run.json``
    reporter: Reporter  # Progress
    capture: Capture | None = None  # The photographs, when the shot has any
    frame: Frame = field(default_factory=Frame.identity)  # World to scene; set by the isolate stage
    source_key: str = ""  # Fingerprint of the last stage, which the next one builds on

    def key(self, *parts: Any) -> list[Any]:
        """Fingerprint parts every stage shares."""
        return [self.seed, self.device.type, *parts]
