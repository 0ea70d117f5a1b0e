"""A sweep in an object store: against a local server that speaks S3.

Skipped where it is not installed, which is no package of the developers' (moto and what it needs
are hundreds of MB): pip install "gsfluent[s3]" "moto[server,s3]", then this file.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sweep_tasks import all_squares, names, odd_ones_fail, square

from gsfluent.errors import InputError
from gsfluent.sweep import bucket
from gsfluent.sweep.attempt import DONE, FAILED, HELD, attempt
from gsfluent.sweep.bucket import SweepBucket, fetch, opened
from gsfluent.sweep.engine import map
from gsfluent.sweep.folder import SweepFolder

_WHY = "no local S3 server: pip install 'gsfluent[s3]' 'moto[server,s3]'"


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    pytest.importorskip("s3fs", reason=_WHY)
    moto = pytest.importorskip("moto.server", reason=_WHY)
    with pytest.MonkeyPatch.context() as patch:
        running = moto.ThreadedMotoServer(port=0, verbose=False)
        running.start()
        host, port = running.get_host_and_port()
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1",
        }.items():  # fmt: skip
            patch.setenv(name, value)
        bucket._client.cache_clear()
        bucket._client().mkdir("s3://sweeps")
        yield "s3://sweeps"
        bucket._client.cache_clear()
        running.stop()


@pytest.fixture
def url(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A place of its own in the store, and for this machine."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return f"{server}/{tmp_path.name}"


def placed(url: str) -> SweepBucket:
    place = opened(url)
    assert isinstance(place, SweepBucket)
    place.make()
    return place


def test_a_sweep_in_a_store_is_done_once_and_brought_here(url: str, tmp_path: Path) -> None:
    found = map(square, range(4), url, ids=names(4), jobs=1)
    assert [(o.id, o.value, o.folder) for o in found] == [(f"n{i}", i * i, None) for i in range(4)]
    again = map(odd_ones_fail, range(4), url, ids=names(4), jobs=1)  # nothing is done again
    assert [o.value for o in again] == [0, 1, 4, 9]
    place = placed(url)
    assert place.done() == set(names(4))
    assert not place._find("claims") and not list((place.root / "work").iterdir())
    fetch(url, tmp_path / "here", ids=["n1"])
    fetch(url, tmp_path / "here")
    all_squares(tmp_path / "here", 4)


def test_of_two_tries_one_is_the_tasks_and_the_other_leaves_nothing(url: str) -> None:
    place = placed(url)
    late = place.begin("one")
    (late / "number.txt").write_text("late")
    assert attempt(url, "one", square, 5) == DONE
    assert not place.finish("one", late, {"id": "one", "value": -1})
    row = place.row("one")
    assert row is not None and row["value"] == 25 and not late.exists()
    there = f"shots/one/{row['try']}"
    assert sorted(place._find("shots")) == [f"{there}/log.txt", f"{there}/number.txt"]
    assert attempt(url, "one", odd_ones_fail, 5) == DONE  # found, not done


def test_an_answer_that_was_lost_is_no_defeat(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    place = placed(url)
    create = SweepBucket._create

    def twice(self: SweepBucket, key: str, words: dict[str, Any]) -> bool:
        create(self, key, words)
        return create(self, key, words)  # as a client does that got no answer

    monkeypatch.setattr(SweepBucket, "_create", twice)
    assert place.finish("one", place.begin("one"), {"id": "one", "value": 1})


def test_failures_are_kept_and_forgiven(url: str) -> None:
    place = placed(url)
    for number in (3, 4, 5):
        attempt(url, f"n{number}", odd_ones_fail, number)
    assert attempt(url, "n3", odd_ones_fail, 3) == FAILED
    found = place.failures()
    assert {name: len(records) for name, records in found.items()} == {"n3": 2, "n5": 1}
    assert found["n3"][0]["message"] == "3 is odd" and place.failures("n5")["n5"] == found["n5"]
    place.forgive(["n3", "n4"])
    assert set(place.failures()) == {"n5"}
    place.forgive(["n5"])
    assert not place.failures() and place.done() == {"n4"}


def test_a_claim_is_held_freed_and_taken_over(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    place = placed(url)
    monkeypatch.setattr("gsfluent.sweep.claims.BEAT", 0.01)
    with place.held("one") as ours:
        first = place._read("claims/one")
        time.sleep(0.1)  # signs of life do not change it
        assert ours and place._read("claims/one") == first
        with place.held("one") as second:
            assert not second
        assert attempt(url, "one", square, 5) == HELD
        assert place.abandoned(["one", "two"]) == ["two"]
    assert not place._find("claims")
    lost = {**(first or {}), "process": 2**22 + 1}
    place._put("claims/one", lost)
    assert place.abandoned(["one"]) == ["one"]
    with place.held("one") as ours:
        assert ours
    place._put("claims/one", lost)
    place.tidy()
    assert not place._find("claims")
    place._put("claims/one", {**lost, "host": "elsewhere"})
    with place.held("one") as ours:
        assert not ours
    monkeypatch.setattr(bucket, "SILENCE", -2.0)
    with place.held("one") as ours:
        assert ours


def test_a_store_that_puts_over_what_is_there_is_refused(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def over(self: SweepBucket, key: str, words: dict[str, Any]) -> bool:
        self._put(key, words)
        return True

    with monkeypatch.context() as patch:
        patch.setattr(SweepBucket, "_create", over)
        with pytest.raises(InputError, match="in spite of If-None-Match"):
            placed(url)
    with pytest.raises(InputError, match="no-such-bucket"):
        placed("s3://no-such-bucket/a")


def test_places_are_read_as_people_write_them(tmp_path: Path) -> None:
    here = opened(tmp_path)
    assert type(here) is SweepFolder and here.root == tmp_path
    (one, two) = (opened(name) for name in (Path("s3://b/a"), "s3://b/a/"))
    assert one == two and one.address == "s3://b/a"
    with pytest.raises(InputError, match="kept in folders and at s3"):
        opened("gs://b/a")
    with pytest.raises(InputError, match="not a place in a store"):
        fetch(str(tmp_path), tmp_path)


def test_without_the_package_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    bucket._client.cache_clear()
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match=r"gsfluent\[s3\]"):
        map(square, [1], "s3://b/a", ids=["a"])
