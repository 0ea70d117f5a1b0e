"""Changed files for every reader, in seconds; scripts/safety/fuzz.py goes on for hours."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz_server import Reading
from fuzz_session import Tally, sweep

if sys.platform != "linux":
    pytest.skip("forks with limits as Linux has them", allow_module_level=True)

SEEDS = Path(__file__).parent / "seeds"
FILES = 4  # of each reader
SEED = 20


@pytest.fixture(scope="module")
def reading() -> Iterator[Reading]:
    process = Reading()
    yield process
    process.close()


def test_valid_files_are_read(reading: Reading) -> None:
    wrong = {n: reading.read(n, parts) for n, parts in reading.parts.items()}
    assert {n: v for n, v in wrong.items() if v.kind != "read"} == {}


def test_changed_files_are_read_or_refused(reading: Reading) -> None:
    tally = Tally()
    for name in reading.parts:
        sweep(reading, name, FILES, SEED, tally)
    assert [(f.reader, f.verdict) for f in tally.findings.values()] == []
    assert sum(tally.verdicts.values()) >= 0.8 * FILES * len(reading.parts)  # the same one once
    # changes that no reader notices, or that none survives, would test nothing
    kinds = {kind for _, kind in tally.verdicts}
    assert kinds == {"read", "refused"}


@pytest.mark.parametrize("path", sorted(SEEDS.glob("*.json")), ids=lambda p: p.stem)
def test_what_was_found_once_stays_mended(reading: Reading, path: Path) -> None:
    kept = json.loads(path.read_text(encoding="utf-8"))
    verdict = reading.read(kept["reader"], [bytes.fromhex(part) for part in kept["parts"]])
    assert verdict.fine, verdict


def test_a_reader_that_does_wrong_is_found(reading: Reading) -> None:
    # the limits themselves: without them the tests above could not fail
    for name, kind in (("_spins", "hang"), ("_eats", "memory"), ("_dies", "crash"),
                       ("_raises", "exception"), ("_lies", "not finite"),
                       ("_mute", "no hint")):  # fmt: skip
        assert reading.read(name, [b""]).kind == kind
