"""Tasks on a Ray cluster of this machine: a head without processors and raylets beside it.

Skipped where Ray is not installed, which is no package of the developers' (79 MB, and seconds to
start): pip install "gsfluent[ray]", then this file.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import sweep_tasks
from sweep_tasks import all_squares, dies_once, names, never_ends, odd_ones_fail, square

from gsfluent.errors import InputError
from gsfluent.sweep.engine import map
from gsfluent.sweep.folder import SweepFolder

ROOT = Path(__file__).resolve().parents[2]
ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'gsfluent[ray]'")


class Machines:
    """A cluster whose machines are processes that can be killed; its head has no processor."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        self.cluster = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 0, "include_dashboard": False},
        )
        self.address = self.cluster.address
        self.raylets = [self.cluster.add_node(num_cpus=1, wait=True) for _ in range(2)]

    def end(self) -> None:
        """All of it is gone at once."""
        for node in [*self.raylets, self.cluster.head_node]:
            node.kill_all_processes(check_alive=False, allow_graceful=False)


@pytest.fixture
def path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where machines and drivers find what tests do."""
    folders = [str(ROOT), str(Path(__file__).parent), *sys.path]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")


def driver(on: str, folder: Path, count: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, sweep_tasks.__file__, str(folder), str(count), on])


def done_at_least(folder: Path, count: int, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 200
    while len(list((folder / "shots").glob("*"))) < count and time.monotonic() < end:
        assert process.poll() is None
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.usefixtures("path")
def test_tasks_end_as_on_one_machine_and_outlive_machines(tmp_path: Path) -> None:
    machines = Machines()
    on = f"ray={machines.address}"

    def mapped(function: Any, items: list[Any], where: str, **more: Any) -> Any:
        given = names(len(items))
        return map(function, items, tmp_path / where, ids=given, on=on, **more)

    try:
        # one that fails, one that is killed, one that takes too long
        found = mapped(odd_ones_fail, [4, 5], "fails")
        assert found[0].value == 4 and found[1].failure["message"] == "5 is odd"
        (found,) = mapped(dies_once, [tmp_path / "killed"], "dies")
        assert (found.value, found.tries) == ("half", 2)
        (found,) = mapped(never_ends, [1], "long", minutes=0.02)
        assert found.failure["kind"] == "time" and found.failure["log"] == ["waiting"]
        with pytest.raises(InputError, match="none of 3 machines has 7 processors"):
            mapped(square, [1], "wide", threads=7)

        # a machine is lost
        process = driver(on, tmp_path / "raylet", 60)
        done_at_least(tmp_path / "raylet", 10, process)
        machines.raylets[0].kill_all_processes(check_alive=False, allow_graceful=False)
        assert process.wait() == 0
        all_squares(tmp_path / "raylet", 60)

        # the head and the driver are lost
        process = driver(on, tmp_path / "head", 60)
        done_at_least(tmp_path / "head", 5, process)
        process.kill()
        process.wait()
    finally:
        machines.end()
    assert 5 <= len(SweepFolder(tmp_path / "head").done()) < 60

    # a new cluster goes on
    machines = Machines()
    on = f"ray={machines.address}"
    try:
        assert driver(on, tmp_path / "head", 60).wait() == 0
    finally:
        machines.end()
    all_squares(tmp_path / "head", 60)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "here:there"])
def test_no_cluster_is_said(address: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nobody answers"):
        map(square, [1], tmp_path, ids=["a"], on=f"ray={address}")
