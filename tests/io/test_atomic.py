"""Files appear whole or not at all."""

from __future__ import annotations

import errno
import json
import math
from pathlib import Path

import pytest

from gsfluent.errors import RunError
from gsfluent.io import atomic_path, write_json


def test_file_appears_only_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("whole")
        assert not path.exists() and temporary.parent == path.parent and temporary.suffix == ".txt"
    assert path.read_text() == "whole" and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("failure", [ValueError("odd"), KeyboardInterrupt()])
def test_failure_keeps_the_old_file(tmp_path: Path, failure: BaseException) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(type(failure)), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise failure
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES])
def test_full_or_forbidden_disk_is_a_run_error(tmp_path: Path, code: int) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(RunError, match=r"a\.txt: cannot be written") as caught, atomic_path(path):
        raise OSError(code, "no")
    assert caught.value.hint and caught.value.kept and list(tmp_path.iterdir()) == []


def test_other_os_errors_pass(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a.txt"):
        raise FileNotFoundError("elsewhere")


def test_json_has_no_nan(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [1.5, math.nan, math.inf], "path": tmp_path, 3: (1, 2)})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "a": [1.5, None, None],
        "path": str(tmp_path),
        "3": [1, 2],
    }


def test_only_what_has_no_digest_waits_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[int] = []
    monkeypatch.setattr("gsfluent.io.atomic.os.fsync", waits.append)
    for synced in (False, True):
        with atomic_path(tmp_path / "file", synced=synced) as temporary:
            temporary.write_text("whole")
        assert (tmp_path / "file").read_text() == "whole"
        assert len(waits) == int(synced)
