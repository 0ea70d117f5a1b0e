"""How often the law that made a motion is found, by the frames that no search has seen.

Scenes as of tracks.py, the matter by turns; each is fitted under every law.

python scripts/study/fit/laws.py --jobs 10 --minutes 8
python scripts/study/fit/laws.py --jobs 4 --beside 3 --device cuda  # searches of ten as one run
"""

from __future__ import annotations

import argparse
import time as clock
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tracks import DATA, FPS, KINDS, PAGE, SIDE, entered, in_pool, noted, read, scene_of, seen

from gsfluent.pipeline.fit.laws import choose_laws
from gsfluent.pipeline.fit.task import one_by_one
from gsfluent.pipeline.fit.together import together
from gsfluent.scene.scene import Scene
from gsfluent.targets import Points

MATTER = ("elastic", "plasticine", "newtonian", "sand")
LAWS = ("elastic", "von_mises", "drucker_prager", "fluid")


def record(number: int, cells: int, device: str = "cpu") -> dict[str, Any]:
    """One scene: truth, a fit under each law, the one that was taken."""
    torch.set_num_threads(1)
    return judged(shown(number, cells, device), cells, device)


def shown(number: int, cells: int, device: str) -> tuple[int, Scene, np.ndarray]:
    """A scene as the searches start, and its tracks."""
    random = np.random.default_rng([number, 77])
    kind = KINDS[MATTER[number % len(MATTER)]]
    solid, velocity, _, tracks, _ = seen(kind, number, cells, random, device)
    stiff = {"young_modulus": 10**5.5, "poisson_ratio": 0.3}
    guess = scene_of(KINDS["elastic"], solid, stiff, velocity + random.uniform(-0.1, 0.1, 3))
    return number, guess, tracks


def judged(made: tuple[int, Scene, np.ndarray], cells: int, device: str) -> dict[str, Any]:
    """Fit under each law, and take one."""
    number, guess, tracks = made
    matter = MATTER[number % len(MATTER)]
    begun = clock.perf_counter()
    found = choose_laws(
        guess, Points(tracks, fps=FPS), ["it.velocity"], LAWS, starts=1, seed=0, dx=SIDE / cells,
        grids=2, offset=True, runner=together if device == "cuda" else one_by_one, device=device,
    )  # fmt: skip
    facts = found.report["it"]
    return {
        "scene": number, "matter": matter, "law": KINDS[matter].law, "cells": cells,
        "taken": facts["taken"], "alike": facts["alike"],
        "held_out": {law: f["held_out"] for law, f in facts["tried"].items()},
        "seconds": clock.perf_counter() - begun,
    }  # fmt: skip


def beside(numbers: list[int], cells: int, device: str, path: Path) -> list[dict[str, Any]]:
    """Scenes whose searches wait for each other."""
    torch.set_num_threads(1)
    made = [shown(number, cells, device) for number in numbers]
    return noted(lambda one: judged(one, cells, device), made, path)


def table(records: list[dict[str, Any]]) -> str:
    """Errors on the last 30 % of the frames under each law, and what was taken."""
    lines = [f"| scene | matter | {' | '.join(LAWS)} | taken |", "| --- " * (len(LAWS) + 3) + "|"]
    for r in sorted(records, key=lambda r: r["scene"]):
        errors = " | ".join(f"{r['held_out'][law]:.3g}" for law in LAWS)
        right = "" if r["taken"] == r["law"] else ", wrong"
        lines.append(f"| {r['scene']} | {r['matter']} | {errors} | {r['taken']}{right} |")
    right = sum(r["taken"] == r["law"] for r in records)
    seconds = np.median([r["seconds"] for r in records])
    lines += ["", f"Right in {right} of {len(records)} (bar 9 of 10); {seconds:.0f} s "
              "for the searches of a scene (median)."]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    """Do what is left, then enter the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--cells", type=int, default=8, help="along the thing, coarser grid")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--beside", type=int, default=1, help="scenes whose searches are one run")
    parser.add_argument(
        "--minutes", type=float, default=1e6, help="what is not done by then is left"
    )
    parser.add_argument("--out", type=Path, default=DATA / "fit_laws.jsonl")
    parser.add_argument("--markdown", type=Path, default=PAGE)
    options = parser.parse_args()
    records = read(options.out)
    done = {r["scene"] for r in records}
    left = [n for n in range(options.scenes) if n not in done]
    size, cells, device, path = options.beside, options.cells, options.device, options.out
    if size > 1:
        groups = [(left[k : k + size], cells, device, path) for k in range(0, len(left), size)]
        in_pool(beside, groups, path, options.jobs, options.minutes)
    else:
        tasks = [(n, cells, device) for n in left]
        in_pool(record, tasks, path, options.jobs, options.minutes)
    records = read(path)
    if records:
        entered(options.markdown, "laws", table(records), "## Which law")


if __name__ == "__main__":
    main()
