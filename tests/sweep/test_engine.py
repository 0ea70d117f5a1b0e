"""Every task once: whatever is killed, whoever else is at work, and however often one begins."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import sweep_tasks
from sweep_tasks import (
    all_squares,
    dies_once,
    gpu_fails_once,
    names,
    never_ends,
    odd_ones_fail,
    slow_square,
    square,
)

from gsfluent.errors import InputError
from gsfluent.sweep import claims
from gsfluent.sweep.attempt import DONE, FAILED, HELD, attempt
from gsfluent.sweep.claims import SILENCE, claimed
from gsfluent.sweep.engine import map
from gsfluent.sweep.folder import SweepFolder, myself, write_words
from gsfluent.sweep.pool import LocalPool

ROOT = Path(__file__).resolve().parents[2]


def driver(folder: Path, count: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, sweep_tasks.__file__, str(folder), str(count)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )


def children(pid: int) -> list[int]:
    try:
        words = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [int(word) for word in words]


def command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def kill_and_restart(folder: Path, count: int, kills: int, seed: int = 0) -> None:
    """Drive a sweep to its end while processes of it are killed at random."""
    choose = random.Random(seed)
    running = [driver(folder, count)]
    while kills and any(process.poll() is None for process in running):
        time.sleep(choose.uniform(0.05, 0.3))
        (process,) = running
        victims = [process.pid, *children(process.pid)]
        os.kill(choose.choice(victims), signal.SIGKILL)
        kills -= 1
        if choose.random() < 0.3:
            process.kill()
        if process.poll() is not None:
            running = [driver(folder, count)]
    for process in running:
        if process.wait() != 0:
            assert driver(folder, count).wait() == 0


def test_nothing_is_lost_or_doubled_by_kills(tmp_path: Path) -> None:
    kill_and_restart(tmp_path, count=60, kills=8)
    all_squares(tmp_path, 60)


def test_two_drivers_share_a_folder(tmp_path: Path) -> None:
    both = [driver(tmp_path, 40), driver(tmp_path, 40)]
    assert [process.wait() for process in both] == [0, 0]
    all_squares(tmp_path, 40)
    assert list((tmp_path / "work").iterdir()) == list((tmp_path / "claims").iterdir()) == []


def test_ten_thousand_done_are_found_done(tmp_path: Path) -> None:
    place, count = SweepFolder(tmp_path), 10_000
    place.make()
    for i, name in enumerate(names(count)):
        (place.shots / name).mkdir()
        row = {"id": name, "value": i, "tries": 1}
        (place.shots / name / "row.json").write_text(json.dumps(row))
    told: list[tuple[int, int]] = []
    found = map(
        square, range(count), tmp_path, ids=names(count),
        progress=lambda done, total, note: told.append((done, total)),
    )  # fmt: skip
    assert [outcome.value for outcome in found] == list(range(count))
    assert told == [(count, count)]  # nothing was started


def test_a_failing_task_harms_no_other_and_is_listed(tmp_path: Path) -> None:
    found = map(odd_ones_fail, range(4), tmp_path, ids=names(4), jobs=1)
    assert [outcome.value for outcome in found] == [0, None, 2, None]
    failure = found[1].failure
    assert failure is not None and (failure["kind"], failure["message"]) == (
        "ValueError",
        "1 is odd",
    )
    assert failure["log"][0] == "looked at 1" and found[1].tries == 1
    assert not list((tmp_path / "work").iterdir())
    # it stays where it is until it is asked for again
    again = map(odd_ones_fail, range(4), tmp_path, ids=names(4))
    assert [outcome.failure for outcome in again] == [outcome.failure for outcome in found]
    mended = map(square, range(4), tmp_path, ids=names(4), jobs=1, retry=True)
    assert [outcome.value for outcome in mended] == [0, 1, 2, 9]
    assert not list((tmp_path / "failed").iterdir())


def test_a_killed_task_is_tried_again_and_goes_on(tmp_path: Path) -> None:
    (found,) = map(dies_once, [tmp_path / "killed"], tmp_path / "out", ids=["one"], jobs=1)
    assert (found.value, found.tries) == ("half", 2)  # from what the first try had left


def test_a_fault_of_a_gpu_may_be_anothers_and_is_tried_again(tmp_path: Path) -> None:
    (found,) = map(gpu_fails_once, [tmp_path / "seen"], tmp_path / "out", ids=["one"], jobs=1)
    assert (found.value, found.tries) == (7, 2)


def test_a_process_that_dies_while_the_pool_looks_is_not_forgotten(tmp_path: Path) -> None:
    place, begun = SweepFolder(tmp_path), tmp_path / "begun"
    place.make()
    pool = LocalPool(tmp_path, sweep_tasks.touches_and_waits, jobs=1, minutes=None)
    pool.start("one", begun)
    while not begun.exists():
        assert pool.ended(0.02) == []
    state = pool._state

    def looked(worker: Any) -> str | None:
        found = state(worker)
        worker.process.kill()  # after it was found alive
        worker.process.join()
        return found

    pool._state = looked  # type: ignore[method-assign]
    assert pool.ended(0.0) == []
    assert pool.ended(0.0) == [("one", FAILED)]
    pool.close()


def test_a_task_that_is_killed_each_time_is_given_up(tmp_path: Path) -> None:
    item = tmp_path / "missing" / "killed"  # a name that cannot be touched: an error each time
    (found,) = map(dies_once, [item], tmp_path / "out", ids=["one"], jobs=1, tries=2)
    assert found.failure is not None and found.failure["kind"] == "FileNotFoundError"
    (tmp_path / "out" / "failed").joinpath("two.a.json").write_text("torn")
    place = SweepFolder(tmp_path / "out")
    for _ in range(2):
        place.fail("two", {"kind": "process", "message": "", "again": True, "log": []})
    (given_up,) = map(square, [3], tmp_path / "out", ids=["two"], tries=2)
    assert given_up.failure is not None and given_up.tries == 2
    (more,) = map(square, [3], tmp_path / "out", ids=["two"], tries=3, jobs=1)
    assert (more.value, more.tries) == (9, 3)


def test_a_task_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    (found,) = map(never_ends, [1], tmp_path, ids=["long"], jobs=1, minutes=0.005)
    assert found.failure is not None and found.failure["kind"] == "time"
    assert found.failure["log"] == ["waiting"] and not found.failure["again"]
    assert not list((tmp_path / "work").iterdir())


def test_ctrl_c_keeps_what_is_done_and_ends_every_process(tmp_path: Path) -> None:
    process = driver(tmp_path, 400)
    while len(list((tmp_path / "shots").glob("*"))) < 2:
        time.sleep(0.02)
    workers = [pid for pid in children(process.pid) if "spawn_main" in command(pid)]
    process.send_signal(signal.SIGINT)
    assert process.wait() != 0
    assert workers and not any(command(pid) for pid in workers)
    assert not list((tmp_path / "claims").iterdir())
    place = SweepFolder(tmp_path)
    assert all(place.row(name) for name in place.done()) and len(place.done()) < 400


def test_a_late_try_loses_against_the_one_that_was_quicker(tmp_path: Path) -> None:
    place = SweepFolder(tmp_path)
    place.make()
    late = place.begin("one")  # of a process that is stopped, and continued when all is over
    assert attempt(tmp_path, "one", square, 5) == DONE
    assert not place.finish("one", late, {"id": "one", "value": -1})
    row = place.row("one")
    assert row is not None and row["value"] == 25 and not late.exists()


def test_a_process_that_was_stopped_until_another_had_won_changes_nothing(tmp_path: Path) -> None:
    place = SweepFolder(tmp_path / "out")
    place.make()
    pool = LocalPool(place.root, sweep_tasks.waits_to_go, jobs=1, minutes=None)
    pool.start("one", tmp_path)
    while not (tmp_path / "begun").exists():
        assert pool.ended(0.02) == []
    (worker,) = pool._workers
    os.kill(worker.process.pid, signal.SIGSTOP)
    os.utime(place.claim("one"), (time.time() - SILENCE - 1,) * 2)
    assert attempt(place.root, "one", square, 5) == DONE
    (tmp_path / "go").touch()
    os.kill(worker.process.pid, signal.SIGCONT)
    while not (ended := pool.ended(0.1)):
        pass
    pool.close()
    row = place.row("one")
    assert ended == [("one", DONE)] and row is not None and row["value"] == 25
    assert not list((place.root / "work").iterdir()) + list((place.root / "claims").iterdir())


def test_a_claim_is_held_freed_and_retaken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = SweepFolder(tmp_path)
    place.make()
    path = place.claim("one")
    with claimed(path) as ours:
        assert ours
        with claimed(path) as second:
            assert not second
        assert attempt(tmp_path, "one", square, 5) == HELD
    assert not path.exists()
    write_words(path, myself() | {"process": 2**22 + 1})  # of a process that has ended
    with claimed(path) as ours:
        assert ours
    write_words(path, myself() | {"host": "elsewhere"})  # of another machine: alive while it beats
    with claimed(path) as ours:
        assert not ours
    os.utime(path, (time.time() - SILENCE - 1,) * 2)
    with claimed(path) as ours:
        assert ours
    monkeypatch.setattr(claims, "BEAT", 0.01)
    with claimed(path):
        os.utime(path, (0, 0))
        end = time.monotonic() + 10
        while path.stat().st_mtime < 1 and time.monotonic() < end:
            time.sleep(0.01)
        assert path.stat().st_mtime > 1


def test_one_of_many_gets_a_stale_claim(tmp_path: Path) -> None:
    path = tmp_path / "one"
    for _ in range(20):
        write_words(path, myself() | {"process": 2**22 + 1})
        got, gate = [], threading.Barrier(4)

        def take(got: list[bool] = got, gate: threading.Barrier = gate) -> None:
            with claimed(path) as ours:
                got.append(ours)
                gate.wait()

        threads = [threading.Thread(target=take) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sum(got) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ids": ["a", "a"]}, "1 names for 2 items"),
        ({"ids": ["a", "../b"]}, "no name of a folder"),
        ({"ids": ["a", "b"], "jobs": 0}, "jobs is 0"),
        ({"ids": ["a", "b"], "minutes": 0.0}, "minutes"),
        ({"ids": ["a", "b"], "on": "moon"}, "no such engine"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, object], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        map(square, [1, 2], tmp_path, **change)  # type: ignore[arg-type]


def test_a_function_of_no_module_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be sent"):
        map(lambda item, folder: item, [1], tmp_path, ids=["a"])


def test_names_hang_on_function_and_item(tmp_path: Path) -> None:
    first = [outcome.id for outcome in map(square, [1, 2], tmp_path, jobs=1)]
    other = [outcome.id for outcome in map(slow_square, [1], tmp_path, jobs=1)]
    assert len({*first, *other}) == 3
