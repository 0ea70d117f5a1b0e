"""One finished run and one that was stopped, which the tests copy and damage."""

from __future__ import annotations

from pathlib import Path

import pytest
from fault_shot import no_report, run, stop, write_shot


@pytest.fixture(autouse=True)
def _no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page of a run, which takes longer than these runs, is not what is tested here."""
    monkeypatch.setattr("gsfluent.run.shot.write_report", no_report)


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shot."""
    return write_shot(tmp_path_factory.mktemp("shot"))


@pytest.fixture(scope="session")
def finished(shot: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its undisturbed run."""
    out = tmp_path_factory.mktemp("finished") / "out"
    assert run(shot, out)["verdict"] == "clean"
    return out


@pytest.fixture(scope="session")
def stopped(shot: Path, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped with two of its frames on disk."""
    out = tmp_path_factory.mktemp("stopped") / "out"
    stop(shot, finished, out)
    return out
