"""What a step costs where nodes touch, and where points do; how deep fast bodies sink by either.

    python scripts/bench/solver/contact.py --markdown docs/measured/solver.md
    python scripts/bench/solver/contact.py --device cuda --cells 24 50 80 --json g.jsonl
    python scripts/bench/solver/contact.py --table g.jsonl --markdown docs/measured/solver.md

Cost: a cube of so many cells, eight points in each, falls onto a floor that its lowest layer
touches; as one body, and as two that touch over a whole face. That is more contact than a shot has.
On a CPU the time is that of the process, one thread; on a GPU that of events.

Depth: an elastic ball of five cells a radius lands on a floor at a share of its wave speed. How far
its lowest point gets below the floor, and which share of its speed it keeps. Always on a CPU.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
import time
from pathlib import Path

import torch

from gsfluent import has_cuda, ops
from gsfluent.figure.markdown import enter
from gsfluent.lab.charts.record import machine
from gsfluent.lab.problems.contact.contact import bodies, smooth_ball
from gsfluent.lab.problems.contact.floor import HALF
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.walls import wall

CASES = {"on a floor": False, "two halves on a floor": True}
DX = 0.02
SPEEDS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""At which a ball lands [P-wave speed]."""


@dataclasses.dataclass(frozen=True)
class Line:
    """Time of a step of one case."""

    device: str  # cpu or cuda
    machine: str  # its name
    points: int  # how many
    case: str  # of CASES
    nodes: float  # where nodes touch [s]
    push: float  # where points touch [s]


def solver(cells: int, halves: bool, push: bool, device: str) -> ops.Solver:
    """A cube of so many cells above a floor, all of it falling at 1 m/s."""
    lattice = torch.stack(torch.meshgrid(*[torch.arange(cells)] * 3, indexing="ij"), dim=-1)
    draw = torch.rand(cells**3, 8, 3, generator=torch.Generator().manual_seed(0))
    place = (lattice.reshape(-1, 1, 3) + draw).reshape(-1, 3).double() * DX
    place = place + torch.tensor([50.0, 50.0, 4.0], dtype=torch.float64) * DX
    count = len(place)
    floor = ops.collider_row(
        "plane", point=(0.0, 0.0, 3.9 * DX), normal=(0.0, 0.0, 1.0), mode="separate", friction=0.3
    )[None].float()
    body = (place[:, 2] > (4.0 + cells / 2) * DX).int() if halves else None
    fall = torch.zeros(count, 3)
    fall[:, 2] = -1.0
    mass = torch.full((count,), 125.0 * DX**3)
    young, poisson = 1e5, 0.3
    shear = young / (2.0 * (1.0 + poisson))
    bulk = young / (3.0 * (1.0 - 2.0 * poisson))
    options = {} if not push else {"radius": torch.full((count,), 0.25 * DX, device=device)}
    if push and halves:
        options["objects"] = torch.arange(2, dtype=torch.int32, device=device)
    return ops.Solver(
        place.to(device), fall.to(device), mass.to(device), (mass / 1000.0).to(device), dx=DX,
        law=torch.zeros(1, dtype=torch.int32, device=device),
        params=torch.tensor([[shear, bulk, 0.0, 0.0, 0.0, 0.0, 1000.0, 0.0]], device=device),
        body=None if body is None else body.to(device), colliders=floor.to(device), dt=1e-4,
        **options,
    )  # fmt: skip


def seconds(made: ops.Solver, steps: int, device: str) -> float:
    """Time of one of so many steps [s]."""
    if device == "cpu":
        start = time.process_time()
        made.advance(steps=steps)
        return (time.process_time() - start) / steps
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    made.advance(steps=steps)
    end.record()
    torch.cuda.synchronize()
    return 1e-3 * begin.elapsed_time(end) / steps


def measure(cells: int, device: str, repeats: int) -> list[Line]:
    """Both cases by either contact, in turn, so that what else the machine does falls on all."""
    steps = 10 if device == "cpu" else 100
    made = {
        (case, push): solver(cells, halves, push, device)
        for case, halves in CASES.items() for push in (False, True)
    }  # fmt: skip
    took: dict[tuple[str, bool], list[float]] = {key: [] for key in made}
    for number in range(repeats + 1):
        for key, one in made.items():
            spent = seconds(one, steps, device)
            if number > 0:  # the first warms up
                took[key].append(spent)
    name = machine(device)
    return [
        Line(device, name, 8 * cells**3, case,
             *(statistics.median(took[case, push]) for push in (False, True)))
        for case in CASES
    ]  # fmt: skip


def landed(speed: float, push: bool) -> tuple[float, float]:
    """How deep a ball that lands sinks [dx], and the share of its speed that it keeps.

    Args:
        speed: At which it lands [P-wave speed].
        push: Whether the floor pushes points; else it holds nodes.
    """
    points, volume = smooth_ball(5.0)
    world = bodies(
        [points + torch.tensor([0.13, 0.27, 5.73], dtype=torch.float64)],
        [torch.tensor([0.0, 0.0, -speed], dtype=torch.float64)], volume=volume,
        dtype=torch.float32, colliders=[wall(2, mode="separate")], surface=HALF if push else None,
    )  # fmt: skip
    deepest = [0.0]

    def watch(now: World) -> None:
        deepest[0] = max(deepest[0], -float(now.position[:, 2].min()))

    world.run(1.6 / speed + 30.0 * speed**-0.2, each=watch)
    kept = float(world.momentum()[2]) / float(world.scene.mass.double().sum()) / speed
    return deepest[0], kept


def depths() -> str:
    """What nodes and points do with a ball that lands, as a Markdown table."""
    rows = [
        "| speed over wave speed | nodes: sinks in, keeps | points: sinks in, keeps |",
        "|" + " --- |" * 3,
    ]
    for speed in SPEEDS:
        cells = (f"{deep:.2f} dx, {kept:.2f}" for deep, kept in
                 (landed(speed, push) for push in (False, True)))  # fmt: skip
        rows.append(f"| {speed:g} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def table(lines: list[Line]) -> str:
    """The lines as a Markdown table."""
    rows = [
        "| device | points | a block | nodes touch | points touch | |", "|" + " --- |" * 6,
        *(
            f"| {line.device} | {line.points} | {line.case} | {1e3 * line.nodes:.3g} ms "
            f"| {1e3 * line.push:.3g} ms | {line.push / line.nodes - 1.0:+.0%} |"
            for line in sorted(lines, key=lambda line: (line.device, line.points, line.case))
        ),
    ]  # fmt: skip
    where = ", ".join(sorted({f"{line.device}: {line.machine}" for line in lines}))
    return "\n".join(rows) + f"\n\n{where}."


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--cells", type=int, nargs="*", default=[16, 32], help="along an edge")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path, help="write the lines here")
    parser.add_argument("--table", type=Path, nargs="*", help="lines of files, measure nothing")
    parser.add_argument("--markdown", type=Path, help="enter the table into this page")
    options = parser.parse_args()
    if options.device == "cuda" and not has_cuda():
        parser.error("--device cuda: no GPU, or gsfluent was built without its CUDA kernels")
    torch.set_num_threads(1)
    if options.table is not None:
        rows = [row for path in options.table for row in path.read_text().splitlines()]
        lines = [Line(**json.loads(row)) for row in rows]
    else:
        each = [measure(cells, options.device, options.repeats) for cells in options.cells]
        lines = [line for some in each for line in some]
    if options.json:
        text = "".join(json.dumps(dataclasses.asdict(line)) + "\n" for line in lines)
        options.json.write_text(text, encoding="utf-8")
    if options.markdown:
        page = options.markdown.read_text(encoding="utf-8")
        page = enter(page, "solver contact", table(lines), "## What contact at points costs")
        page = enter(page, "solver depth", depths(), "## How deep fast bodies sink")
        options.markdown.write_text(page, encoding="utf-8")
    sys.stdout.write(table(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
