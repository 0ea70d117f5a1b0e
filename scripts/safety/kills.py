"""Random kills of everything that a sweep is made of; what is lost, what is doubled.

    python scripts/safety/kills.py [--local 20] [--store 10] [--ray 20] [--json FILE]
    python scripts/safety/kills.py --page FILE.json     # enters the table into the docs

Sweeps of small tasks are driven to their end while processes of them get SIGKILL at random times:
drivers and processes of tasks on one machine; the same with results in a local S3 server (moto);
drivers, processes of tasks, machines (raylets) and heads of Ray clusters of this machine. A killed
driver, machine or head is started again. Needs the extras s3 and ray, and moto[server,s3], for
what they are asked for. Enters docs/measured/sweeps.md.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gsfluent.figure.markdown import enter
from gsfluent.sweep.bucket import SweepBucket, fetch, opened
from gsfluent.sweep.engine import map as sweep_map

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "sweeps.md"
TASKS = 60
Kill = Callable[[random.Random], str]


def square(item: int, folder: Path) -> int:
    """A task of a tenth of a second."""
    (folder / "first.txt").write_text("half of it")
    time.sleep(0.1)
    (folder / "number.txt").write_text(str(item * item))
    return item * item


def names(count: int) -> list[str]:
    return [f"n{i:04d}" for i in range(count)]


def drive(folder: str, count: int, on: str) -> None:
    """What a driver does."""
    from kills import square  # not of __main__, which is another module elsewhere

    sweep_map(square, range(count), folder, ids=names(count), jobs=2, tries=10**6, on=on)


class Driver:
    """A driver that is started again when it has ended before all was done."""

    def __init__(self, folder: str, on: str, environment: dict[str, str]) -> None:
        self.command = [sys.executable, str(Path(__file__).resolve()), "drive", folder, on]
        self.environment, self.starts = environment, 0
        self.start()

    def start(self) -> None:
        self.starts += 1
        self.process = subprocess.Popen(
            self.command, env=os.environ | self.environment, stderr=subprocess.DEVNULL
        )

    def is_over(self) -> bool:
        """Whether it has ended with all done; one that ended otherwise is started again."""
        if self.process.poll() is None:
            return False
        if self.process.returncode == 0:
            return True
        self.start()
        return False

    def kill(self) -> str:
        self.process.kill()
        self.process.wait()
        return "driver"


def tree(pid: int) -> list[int]:
    """All processes below one."""
    with contextlib.suppress(OSError):
        own = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return [p for child in map(int, own) for p in (child, *tree(child))]
    return []


def workers(pids: list[int]) -> list[int]:
    """Those of some processes that do tasks."""
    found = []
    for pid in pids:
        with contextlib.suppress(OSError):
            if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text():
                found.append(pid)
    return found


def killed(pids: list[int], draw: random.Random) -> str:
    """Kill one of some processes; "" where there is none any more."""
    with contextlib.suppress(ProcessLookupError, IndexError):
        os.kill(draw.choice(pids), signal.SIGKILL)
        return "process of a task"
    return ""


def look(folder: str, scratch: Path) -> Counter[str]:
    """What there is of one sweep in the end; files are read, not only names."""
    place = opened(folder)
    here = place
    if isinstance(place, SweepBucket):
        here = fetch(folder, scratch / "here")
    found: Counter[str] = Counter(tasks=TASKS)
    for i, name in enumerate(names(TASKS)):
        row, file = here.row(name), here.shots / name / "number.txt"
        if row is None:
            found["lost"] += 1
        elif row["value"] != i * i or not file.is_file() or file.read_text() != str(i * i):
            found["wrong"] += 1
        else:
            found["tries"] += int(row["tries"])
    found["doubled"] = len(place.done() - set(names(TASKS)))
    if isinstance(place, SweepBucket):
        tries = {tuple(key.split("/")[1:3]) for key in place._find("shots")}
        found["doubled"] += len(place._find("done")) - TASKS
        found["left-overs"] = len(tries) - TASKS
    else:
        found["left-overs"] = len(list((place.root / "work").iterdir()))
    return found


def through(
    kills: int, pause: tuple[float, float], draw: random.Random, driver: Driver, kill: Kill
) -> Counter[str]:
    """Drive one sweep to its end with at most so many kills; returns whom they hit."""
    found: Counter[str] = Counter()
    due = time.monotonic() + draw.uniform(*pause)
    while not driver.is_over():
        if found.total() < kills and time.monotonic() >= due:
            if whom := kill(draw):
                found[whom] += 1
            due = time.monotonic() + draw.uniform(*pause)
        time.sleep(0.01)
    return found


@contextlib.contextmanager
def folders(place: Path) -> Iterator[tuple[Callable[[int], str], dict[str, str]]]:
    """Folders of this machine, and variables of the drivers."""
    yield (lambda number: str(place / f"sweep_{number}")), {}


@contextlib.contextmanager
def stores(place: Path) -> Iterator[tuple[Callable[[int], str], dict[str, str]]]:
    """Places in a local S3 server."""
    import s3fs
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line for each request
    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    variables = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1", "TMPDIR": str(place),
    }  # fmt: skip
    os.environ.update(variables)
    s3fs.S3FileSystem().mkdir("s3://sweeps")
    try:
        yield (lambda number: f"s3://sweeps/{place.name}_{number}"), variables
    finally:
        server.stop()


def on_one_machine(kills: int, store: bool, draw: random.Random) -> Counter[str]:
    """Kills of drivers and of processes of tasks."""
    found: Counter[str] = Counter()
    number = 0
    with (
        tempfile.TemporaryDirectory(prefix="kills-") as place,
        (stores if store else folders)(Path(place)) as (folder, variables),
    ):
        while (left := kills - count_of(found)) > 0:
            number += 1
            driver = Driver(folder(number), "local", variables)

            def kill(draw: random.Random, driver: Driver = driver) -> str:
                if draw.random() < 0.3:
                    return driver.kill()
                return killed(workers(tree(driver.process.pid)), draw)

            found += through(left, (0.2, 1.5), draw, driver, kill)
            found += look(folder(number), Path(place) / f"look_{number}")
            found["drivers"] += driver.starts
            found["sweeps"] += 1
    return found


class Machines:
    """A Ray cluster of this machine: a head without processors, and two raylets."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 0, "include_dashboard": False}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.raylets = [self.cluster.add_node(num_cpus=1) for _ in range(2)]

    def lose(self, draw: random.Random) -> str:
        node = self.raylets.pop(draw.randrange(len(self.raylets)))
        node.kill_all_processes(check_alive=False, allow_graceful=False)
        self.raylets.append(self.cluster.add_node(num_cpus=1))
        return "machine"

    def processes(self) -> list[int]:
        raylets = [
            info.process.pid
            for node in self.raylets
            for info in node.all_processes.get("raylet", [])
        ]
        return workers([pid for raylet in raylets for pid in tree(raylet)])

    def end(self) -> None:
        for node in [*self.raylets, self.cluster.head_node]:
            node.kill_all_processes(check_alive=False, allow_graceful=False)


def on_ray(kills: int, draw: random.Random) -> Counter[str]:
    """Kills of drivers, processes of tasks, machines and heads."""
    path = os.pathsep.join([str(ROOT), str(Path(__file__).resolve().parent), *sys.path])
    os.environ.update({"PYTHONPATH": path, "RAY_USAGE_STATS_ENABLED": "0"})
    found: Counter[str] = Counter()
    machines = Machines()
    with tempfile.TemporaryDirectory(prefix="kills-") as place:
        while (left := kills - count_of(found)) > 0:
            number = found["sweeps"] + 1
            folder = str(Path(place) / f"sweep_{number}")
            driver = Driver(folder, f"ray={machines.cluster.address}", {})

            def kill(draw: random.Random, driver: Driver = driver) -> str:
                nonlocal machines
                whom = draw.random()
                if whom < 0.4:
                    return killed(machines.processes(), draw)
                if whom < 0.65:
                    return driver.kill()
                if whom < 0.9:
                    return machines.lose(draw)
                machines.end()  # whatever its driver makes of that, another one goes on
                driver.kill()
                machines = Machines()
                driver.command[-1] = f"ray={machines.cluster.address}"
                return "head, with machines and driver"

            found += through(left, (2.0, 6.0), draw, driver, kill)
            found += look(folder, Path(place))
            found["drivers"] += driver.starts
            found["sweeps"] += 1
    machines.end()
    return found


WHOM = ("driver", "process of a task", "machine", "head, with machines and driver")


def count_of(found: Counter[str]) -> int:
    return sum(found[whom] for whom in WHOM)


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table."""
    counts = ("tasks", "tries", "lost", "doubled", "wrong", "left-overs")
    head = ("where", "kills", "of whom", "tasks", "tries noted", *counts[2:])
    lines = ["| " + " | ".join(head) + " |", "| --- " * len(head) + "|"]
    for row in rows:
        whom = ", ".join(f"{row[w]} {w}" for w in WHOM if row.get(w))
        kills = sum(row.get(w, 0) for w in WHOM)
        cells = [row["where"], kills, whom, *(row.get(name, 0) for name in counts)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    if sys.argv[1:2] == ["drive"]:
        drive(sys.argv[2], TASKS, sys.argv[3])
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--local", type=int, default=20, help="kills on one machine")
    parser.add_argument("--store", type=int, default=10, help="kills with results in a store")
    parser.add_argument("--ray", type=int, default=20, help="kills on Ray clusters")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="where the counts go")
    parser.add_argument("--page", type=Path, metavar="FILE.json", help="only enter these")
    options = parser.parse_args()
    if options.page is not None:
        rows = json.loads(options.page.read_text())
        PAGE.write_text(enter(PAGE.read_text(), "kills", markdown(rows)))
        return
    draw, rows = random.Random(options.seed), []
    if options.local:
        found = on_one_machine(options.local, False, draw)
        rows.append({"where": "one machine, a folder", **found})
    if options.store:
        found = on_one_machine(options.store, True, draw)
        rows.append({"where": "one machine, an S3 server", **found})
    if options.ray:
        rows.append({"where": "Ray, a folder", **on_ray(options.ray, draw)})
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(markdown(rows))
    if any(row.get(bad) for row in rows for bad in ("lost", "doubled", "wrong")):
        raise SystemExit("kills.py: something is lost, doubled or wrong")


if __name__ == "__main__":
    main()
