"""One finished run and one that was stopped, which the tests copy and damage."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fault_shot import run, write_shot


@pytest.fixture(autouse=True, scope="session")
def _no_page() -> Iterator[None]:
    """The page of a run, which takes longer than these runs, is not what is tested here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsfluent.run.shot.write_report", lambda out, values: None)
        yield


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shot."""
    return write_shot(tmp_path_factory.mktemp("shot"))


@pytest.fixture(scope="session")
def finished(shot: Path, _no_page: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its undisturbed run."""
    out = tmp_path_factory.mktemp("finished") / "out"
    assert run(shot, out)["verdict"] == "clean"
    return out


@pytest.fixture(scope="session")
def stopped(shot: Path, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped with two of its frames on disk."""
    import shutil

    from gsfluent.stages import simulate

    out = tmp_path_factory.mktemp("stopped") / "out"
    shutil.copytree(finished, out)
    for name in ("simulate", "render"):
        shutil.rmtree(out / "stages" / name)
    save = simulate.save_frame

    def stop(folder: Path, frame: Any) -> None:
        if frame.index == 2:
            raise KeyboardInterrupt
        save(folder, frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "save_frame", stop)
        with pytest.raises(KeyboardInterrupt, match="resume"):
            run(shot, out)
    assert (out / "stages" / "simulate" / "state.pt").is_file()
    return out
