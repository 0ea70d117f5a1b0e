"""Rounds of changed files over all readers: short in the tests, long in scripts/safety/fuzz.py."""

from __future__ import annotations

import collections
import dataclasses

import hypothesis
from fuzz_changes import changed, changes
from fuzz_server import Reading, Verdict
from hypothesis import HealthCheck, Phase, given, settings


@dataclasses.dataclass(frozen=True)
class Finding:
    """A file that ended in something else than values or the usual error."""

    reader: str
    verdict: Verdict
    parts: tuple[bytes, ...]

    @property
    def same(self) -> tuple[str, str, str]:
        """What findings of one cause have in common."""
        lines = [line.strip() for line in self.verdict.text.strip().splitlines()] or [""]
        return self.reader, self.verdict.kind, lines[-1][:60]


@dataclasses.dataclass
class Tally:
    """What became of all files."""

    verdicts: collections.Counter[tuple[str, str]] = dataclasses.field(
        default_factory=collections.Counter
    )
    findings: dict[tuple[str, str, str], Finding] = dataclasses.field(default_factory=dict)

    def add(self, name: str, verdict: Verdict, parts: list[bytes]) -> None:
        self.verdicts[name, verdict.kind] += 1
        if not verdict.fine:
            found = Finding(name, verdict, tuple(parts))
            self.findings.setdefault(found.same, found)


def sweep(reading: Reading, name: str, count: int, seed: int, tally: Tally) -> None:
    """Read ``count`` changed files of one reader; the same seed makes the same files."""

    @hypothesis.seed(seed)
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(changes)
    def each(given_changes: list[object]) -> None:
        parts = changed(reading.parts[name], given_changes)
        tally.add(name, reading.read(name, parts), parts)

    each()
