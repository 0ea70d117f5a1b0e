"""Tasks as jobs of a SLURM cluster, whose machines share the folder of the sweep; by submitit."""

from __future__ import annotations

import math
import shutil
import time
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError, need
from gsfluent.sweep.attempt import FAILED, Function, attempt
from gsfluent.sweep.bucket import SweepBucket, opened
from gsfluent.sweep.folder import last_lines

_LONGEST = 24 * 60.0  # minutes of a job that has no limit of its own
_POLL = 2.0  # seconds


class SlurmPool:
    """Hands every task to the cluster as a job of its own.

    Args:
        root: Folder of the sweep, under the same path on every machine; or its store.
        function: What a task does.
        jobs: Jobs queued or running at a time.
        minutes: Longest time of a task; a day when None.
        threads: Processors of a job.
        gpu: Above 0 for jobs that need a GPU: each has one of its own.
        cluster: ``slurm``, or ``local`` for submitit's stand-in on this machine.

    Raises:
        MissingPackage: submitit is not installed.
        InputError: This machine submits no jobs to SLURM.
    """

    def __init__(
        self, root: str | Path, function: Function, *, jobs: int, minutes: float | None,
        threads: int, gpu: float = 0.0, cluster: str = "slurm",
    ) -> None:  # fmt: skip
        submitit = need("submitit", "slurm", "--on slurm")
        if cluster == "slurm" and shutil.which("sbatch") is None:
            raise InputError(
                "--on slurm: there is no sbatch on this machine", "run it where jobs are submitted"
            )
        self._place, self._function, self._most = opened(root), function, jobs
        self._jobs: dict[str, Any] = {}
        # what submitit leaves its machines have to share
        place = Path.cwd() if isinstance(self._place, SweepBucket) else self._place.root
        self._executor = submitit.AutoExecutor(folder=place / "slurm" / "%j", cluster=cluster)
        limit = math.ceil(minutes or _LONGEST)
        self._executor.update_parameters(
            name="gsfluent", timeout_min=limit, cpus_per_task=threads, tasks_per_node=1,
            **({"gpus_per_node": 1} if gpu else {}),
        )  # fmt: skip

    def room(self) -> int:
        """How many tasks may be started now."""
        return self._most - len(self._jobs)

    def start(self, name: str, item: Any) -> None:
        """Submit a task."""
        self._jobs[name] = self._executor.submit(
            attempt, self._place.address, name, self._function, item
        )

    def ended(self, seconds: float) -> list[tuple[str, str]]:
        """Tasks whose jobs have ended, each with how; waits a while for one."""
        end = time.monotonic() + max(seconds, _POLL)
        while True:
            found = [name for name, job in self._jobs.items() if job.done()]
            if found or time.monotonic() >= end:
                return [(name, self._state(name, self._jobs.pop(name))) for name in found]
            time.sleep(min(_POLL, 0.2))

    def close(self) -> None:
        """Cancel what is queued or running."""
        for job in self._jobs.values():
            job.cancel()
        self._jobs = {}

    def _state(self, name: str, job: Any) -> str:
        """How a job has ended; one that could not say it, since its machine was lost, is noted."""
        try:
            return str(job.result())
        except Exception as error:
            late = "TIMEOUT" in job.state
            left = self._place.tries(name)
            self._place.fail(
                name,
                {
                    "kind": "time" if late else "job",
                    "message": f"job {job.job_id} ended as {job.state}: {error}",
                    "again": not late,
                    "log": last_lines(left[0]) if left else [],
                },
            )
            return FAILED
