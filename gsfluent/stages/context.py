"""What the stages of one run share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.data import Capture, Frame
from gsfluent.progress import Reporter
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageResult, StageStore, fingerprint


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

    def do(
        self,
        name: str,
        work: Callable[[Path], dict[str, Any]],
        *parts: Any,
        section: str = "",
        hands_on: bool = True,
        scratch: Sequence[str] = (),
    ) -> StageResult:
        """Do a stage, or find it done.

        Args:
            name: Its name.
            work: See :meth:`gsfluent.results.store.StageStore.run`.
            parts: What it depends on beside the stages before it.
            section: Of ``run.json``, takes its report.
            hands_on: Whether the next stages build on it.
            scratch: Files that only an unfinished stage needs.
        """
        key = fingerprint(name, [self.seed, self.device.type, self.source_key, *parts])
        result = self.store.run(name, key, work, scratch)
        if section:
            self.record.values[section] = dict(result.report)
        if hands_on:
            # and the content: a stage done anew, with other results, is built on anew
            self.source_key = fingerprint(result.fingerprint, result.content)
        return result
