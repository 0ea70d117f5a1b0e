"""The scripts of scripts/safety: the lock fits the project, licences are told, faults are found."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from loaded_scripts import load_script

ROOT = Path(__file__).resolve().parents[2]
lock = load_script("safety/lock")
licences = load_script("safety/licences")
faults = load_script("safety/faults")


def test_the_lock_has_all_that_the_project_asks_for_by_hash() -> None:
    rows = [row for row in lock.LOCK.read_text().splitlines() if not row.startswith("#")]
    pinned = {}
    for row in rows:
        found = re.fullmatch(r"([\w.-]+)==([\w.!]+) --hash=sha256:([0-9a-f]{64})", row)
        assert found, row
        pinned[licences.canonical(found[1])] = found[2]
    asked = {}
    for each in lock.wanted():
        name, relation, version = re.fullmatch(r"([\w-]+)(==|>=|)([\d.]*)", each).groups()
        asked[licences.canonical(name)] = (relation, version)
    assert set(asked) <= set(pinned)
    for name, (relation, version) in asked.items():
        got, least = ([int(n) for n in v.split(".")] for v in (pinned[name], version or "0"))
        assert got == least if relation == "==" else got >= least, name


def test_licences_are_of_what_is_asked_for() -> None:
    found = licences.asked_for()
    assert found["torch"] == found["imageio-ffmpeg"] == "gsfluent" and "pytest" not in found
    rows = licences.table(found).splitlines()
    assert len(rows) == 2 + len(found) + 1  # ffmpeg has one of its own
    assert any(row.startswith("| ffmpeg, a program") and "GPL" in row for row in rows)
    page = licences.PAGE.read_text(encoding="utf-8")
    assert re.search(r"\| ffmpeg, a program in it \|.*GPL", page)


def test_an_end_that_is_not_as_wanted_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    series = faults.Series("kill", "ended by the signal")
    series.add("one", noticed=True, same=True, lost=False, left=False)
    assert series.wrong == [] and series.row == "| kill | 1 | 1 | 1 | 0 | 0 | ended by the signal |"
    series.add("two", noticed=True, same=False, lost=False, left=False)
    series.add("three", noticed=True, same=True, lost=False, left=True)
    assert series.wrong == ["kill: two", "kill: three"] and "kill: two" in capsys.readouterr().out


@pytest.mark.slow
def test_a_short_series_of_faults() -> None:
    words = [sys.executable, "-P", "scripts/safety/faults.py", "--flips", "0", "--kills", "2",
             "--doubles", "1", "--disks", "0"]  # fmt: skip
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| kill | 2 | 2 | 2 | 0 | 0 |" in done.stdout
    assert "| double start | 1 | 1 | 1 | 0 | 0 |" in done.stdout
