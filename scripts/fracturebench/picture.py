"""Four histories that FractureBench judges, gsfluent's over dx beside the reference.

    python scripts/fracturebench/picture.py [--device cuda] [-o FILE]

Writes docs/images/fracturebench.png. Twenty seconds on one quiet core.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsfluent.figure.style import COLORS, INK, OURS, new_figure, save_png
from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.scenes.contact import height_history, momentum_history
from gsfluent.fracturebench.scenes.elastic import growth_history
from gsfluent.fracturebench.scenes.flow import wave_history
from gsfluent.lab.frozen.answer import run_case

ROOT = Path(__file__).resolve().parents[2]
History = Callable[[Scene, Run], tuple[np.ndarray, np.ndarray, np.ndarray]]
PANELS: tuple[tuple[str, str, str, str, History], ...] = (
    ("bar_wave", "pulse arrives at the far end", "time [s]", "displacement [m]", wave_history),
    ("spin", "turning ball widens", "time [s]", "growth of its moment of inertia", growth_history),
    ("collide", "two balls head on", "time since contact [R/c]", "momentum over the first",
     momentum_history),
    ("drop", "cube on a sticky floor", "time [edge/c]", "height of the centre [edge]",
     height_history),
)  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument(
        "-o", "--out", type=Path, default=ROOT / "docs" / "images" / "fracturebench.png"
    )
    args = parser.parse_args()
    with new_figure(9.2, 5.8) as figure:
        grid = figure.subplots(2, 2).ravel()
        for axes, (name, title, along, up, history) in zip(grid, PANELS, strict=True):
            case = find(name)
            ladder = [case.ladder[i] for i in (0, len(case.ladder) // 2, -1)]
            for dx, color in zip(ladder, (COLORS[3], COLORS[1], OURS), strict=True):
                scene = case.build(dx, 8)
                end = float(scene.facts.get("breathing", scene.seconds))
                scene = dataclasses.replace(scene, times=np.linspace(0.0, end, 101)[1:] * 0.999)
                time, seen, exact = history(scene, run_case(scene, device=args.device))
                axes.plot(time, seen, "-", color=color, lw=1.4, label=f"{scene.count} points")
                sys.stderr.write(f"{name}, dx {dx:.4g}\n")
            axes.plot(time, exact, "--", color=INK, lw=1.0, label="reference")
            axes.set_title(f"{name}: {title}")
            axes.set_xlabel(along)
            axes.set_ylabel(up)
            axes.legend(
                ncols=4, columnspacing=0.9, handlelength=1.5, loc="upper left", fontsize=7.0
            )
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.16 * (high - low))  # room for the legend
        save_png(figure, args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
