"""Tasks as jobs: by submitit's stand-in for a cluster, where submitit is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest
from sweep_tasks import odd_ones_fail

from gsfluent.errors import InputError
from gsfluent.sweep import engine, slurm
from gsfluent.sweep.attempt import DONE, FAILED
from gsfluent.sweep.engine import map
from gsfluent.sweep.folder import SweepFolder
from gsfluent.sweep.slurm import SlurmPool


def test_jobs_do_the_tasks_and_list_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("submitit")

    def pool(on: str, root: Path, function: Any, **settings: Any) -> SlurmPool:
        return SlurmPool(root, function, cluster="local", **settings)

    monkeypatch.setattr(engine, "_engine", pool)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    found = map(odd_ones_fail, [4, 5], tmp_path, ids=["four", "five"], on="slurm", jobs=2)
    assert found[0].value == 4 and found[1].failure is not None
    assert found[1].failure["message"] == "5 is odd"


class Executor:
    """Jobs of which each ends as its item says."""

    def __init__(self, folder: Path, cluster: str) -> None:
        self.cancelled: list[str] = []

    def update_parameters(self, **given: Any) -> None:
        self.given = given

    def submit(self, function: Any, root: Path, name: str, work: Any, item: Any) -> Any:
        cancelled = self.cancelled

        class Job:
            job_id, state = f"{name}-1", item

            def done(self) -> bool:
                return item != "RUNNING"

            def result(self) -> str:
                if item != "COMPLETED":
                    raise RuntimeError("no result")
                return DONE

            def cancel(self) -> None:
                cancelled.append(name)

        return Job()


def test_lost_jobs_are_tried_again_and_late_ones_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Executor] = []

    class Submitit:
        @staticmethod
        def AutoExecutor(folder: Path, cluster: str) -> Executor:
            made.append(Executor(folder, cluster))
            return made[-1]

    monkeypatch.setattr(slurm, "need", lambda *names: Submitit)
    monkeypatch.setattr(slurm.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="no sbatch"):
        SlurmPool(tmp_path, odd_ones_fail, jobs=9, minutes=None, threads=2)
    monkeypatch.setattr(slurm.shutil, "which", lambda name: "/usr/bin/sbatch")
    place = SweepFolder(tmp_path)
    place.make()
    pool = SlurmPool(tmp_path, odd_ones_fail, jobs=4, minutes=1.5, threads=2)
    assert made[0].given["timeout_min"] == 2 and made[0].given["cpus_per_task"] == 2
    for name in ("COMPLETED", "NODE_FAIL", "TIMEOUT", "RUNNING"):
        pool.start(name.lower(), name)
    assert pool.room() == 0
    ended = dict(pool.ended(0.0))
    assert ended == {"completed": DONE, "node_fail": FAILED, "timeout": FAILED}
    failures = place.failures()
    again = {name: records[0]["again"] for name, records in failures.items()}
    assert again == {"node_fail": True, "timeout": False} and pool.room() == 3
    pool.close()
    assert made[0].cancelled == ["running"] and pool.room() == 4
