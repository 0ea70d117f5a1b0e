"""Tasks on a Ray cluster, whose machines share the folder of the sweep or its store.

Ray places tasks and says when their machines are gone. What a task does, it does in a process of
its own that a :class:`LocalPool` on that machine watches: time limits, signals and last words are
those of a sweep on one machine.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

from gsfluent.errors import InputError, RunError, need
from gsfluent.sweep.attempt import FAILED, Function
from gsfluent.sweep.bucket import opened
from gsfluent.sweep.folder import last_lines
from gsfluent.sweep.pool import LocalPool

_LOOK = 0.5  # seconds
_PATIENCE = 10.0


class RayPool:
    """Hands every task to a Ray cluster that runs already.

    Args:
        root: Folder of the sweep, under the same path on every machine; or its store.
        function: What a task does; its module has to be importable there.
        jobs: Tasks at a time; None for as many as the cluster has processors for.
        minutes: Longest time of a task; None for any.
        threads: Processors of a task.
        gpu: Part of a GPU that a task takes; 0 for none.
        address: Of the cluster's head: ``host:6379``, or ``auto`` for the one of this machine.

    Raises:
        MissingPackage: Ray is not installed.
        InputError: No cluster answers there, or none of its machines has what a task takes.
    """

    def __init__(
        self, root: str | Path, function: Function, *, jobs: int | None, minutes: float | None,
        threads: int, gpu: float = 0.0, address: str = "auto",
    ) -> None:  # fmt: skip
        self._ray = ray = need("ray", "ray", "--on ray")
        try:
            if address != "auto":  # Ray itself asks for minutes
                host, _, port = address.rpartition("://")[2].rpartition(":")
                socket.create_connection((host, int(port)), _PATIENCE).close()
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--on ray={address}: nobody answers ({error})",
                "start a cluster with `ray start --head` and give HOST:PORT of its head",
            ) from error
        machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        fits = [
            min(
                int(has.get("CPU", 0.0) / threads),
                int(has.get("GPU", 0.0) / gpu + 1e-6) if gpu else 10**6,
            )
            for has in machines
        ]
        if not any(fits):
            ray.shutdown()
            words = f"{threads} processors" + (f" and {gpu} GPUs" if gpu else "")
            raise InputError(
                f"--on ray={address}: none of {len(machines)} machines has {words}",
                "lower `each:` of the sweep, or add machines",
            )
        self._place, self._function, self._most = opened(root), function, jobs or sum(fits)
        self._minutes, self._threads, self._gpu = minutes, threads, gpu
        self._refs: dict[Any, str] = {}
        # what dies is tried again by the rules of the sweep, not by Ray's
        self._try = ray.remote(
            num_cpus=threads, num_gpus=gpu, max_retries=0, scheduling_strategy="SPREAD"
        )(_try)

    def room(self) -> int:
        """How many tasks may be started now."""
        return self._most - len(self._refs)

    def start(self, name: str, item: Any) -> None:
        """Hand out a task."""
        settings = {"minutes": self._minutes, "threads": self._threads, "gpu": self._gpu}
        ref = self._try.remote(self._place.address, name, self._function, item, settings)
        self._refs[ref] = name

    def ended(self, seconds: float) -> list[tuple[str, str]]:
        """Tasks whose tries have ended, each with how; waits a while for one.

        Raises:
            RunError: The cluster is gone, or a machine cannot write.
        """
        if not self._refs:
            return []
        ready, _ = self._ray.wait(list(self._refs), timeout=seconds, fetch_local=False)
        return [(name, self._state(name, ref)) for ref in ready for name in [self._refs.pop(ref)]]

    def close(self) -> None:
        """Stop what is queued or at work, and leave the cluster as it is."""
        for ref in self._refs:
            self._ray.cancel(ref, force=True)
        self._refs = {}
        self._ray.shutdown()

    def _state(self, name: str, ref: Any) -> str:
        """How a task has ended; one whose machine was lost is noted."""
        errors = self._ray.exceptions
        try:
            return str(self._ray.get(ref))
        except errors.RayTaskError as error:
            raise RunError(
                f"{name}: {error.cause}", f"what is in {self._place.address}",
                "mend that machine or its folder, then run the same command again",
            ) from error  # fmt: skip
        except errors.RayError as error:
            left = self._place.tries(name)
            self._place.fail(
                name,
                {
                    "kind": "machine",
                    "message": f"{type(error).__name__}: {str(error).splitlines()[0]}",
                    "again": True,
                    "log": last_lines(left[-1]) if left else [],
                },
            )
            # if it lives on out of sight it loses the race for the name, as any second try does
            self._place.free(name)
            return FAILED


_POOLS: dict[tuple[Any, ...], LocalPool] = {}
"""The pool of a worker of Ray, kept from task to task, for torch is slow to import."""


def _try(
    root: str | Path, name: str, function: Function, item: Any, settings: dict[str, Any]
) -> str:
    """Try a task in a process of its own; runs in a worker of Ray."""
    # Ray may give the next task another GPU
    key = (root, function, os.environ.get("CUDA_VISIBLE_DEVICES"), *settings.items())
    if key not in _POOLS:
        for pool in _POOLS.values():
            pool.close()
        _POOLS.clear()
        opened(root).make()
        _POOLS[key] = LocalPool(root, function, jobs=1, **settings)
    pool = _POOLS[key]
    while True:
        pool.start(name, item)
        ended: list[tuple[str, str]] = []
        while not ended:
            ended = pool.ended(_LOOK)
        if ended[0][1]:  # else the process had gone before it began
            return ended[0][1]
