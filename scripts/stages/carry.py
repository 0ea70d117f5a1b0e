"""What it costs to turn splats with their matter: nanoseconds of CPU for one of them, medians.

python scripts/stages/carry.py --markdown docs/measured/shots.md

Deformations are rotations with stretches of a few per cent, as in a body that shakes.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from gsfluent import geometry, ops
from gsfluent.figure.markdown import enter

REPEATS = 7


def nanoseconds(work: Callable[[], object], count: int) -> float:
    """CPU time of one of ``count`` things, median of some calls after a first one."""
    took = []
    for _ in range(REPEATS + 1):
        begun = time.process_time()
        work()
        took.append(time.process_time() - begun)
    return 1e9 * statistics.median(took[1:]) / count


def table(count: int) -> str:
    """Rows of operators over so many splats."""
    draw = torch.Generator().manual_seed(0)
    quats = geometry.normalize_quaternions(torch.randn(count, 4, generator=draw))
    scales = 0.1 + torch.rand(count, 3, generator=draw)
    stretch = torch.eye(3) + 0.03 * torch.randn(count, 3, 3, generator=draw)
    deformation = (geometry.quaternion_to_matrix(quats) @ stretch).contiguous()
    grid = torch.rand(96, 96, 96, generator=draw)
    place = 95.0 * torch.rand(count, 3, generator=draw)
    turn, bounded = ops.polar_clamped(deformation)
    rows = {
        "`polar_clamped`, float32": lambda: ops.polar_clamped(deformation),
        "`polar_clamped`, float64": lambda: ops.polar_clamped(deformation.double()),
        "`carry_axes`, float32": lambda: ops.carry_axes(quats, scales, bounded, turn, rigid=1e-3),
        "`geometry.trilinear`, float32": lambda: geometry.trilinear(grid, place),
    }
    lines = ["| what | ns of CPU for one |", "| --- | --- |"]
    lines += [f"| {name} | {nanoseconds(work, count):.0f} |" for name, work in rows.items()]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100_000, help="splats")
    parser.add_argument("--label", default="", help="what the table is of, such as: before")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    found = table(options.count)
    if page := options.markdown:
        page.write_text(enter(page.read_text(), f"carry {options.label}".rstrip(), found))
    sys.stdout.write(found + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
