"""Run every peer that is here on FractureBench's cases, over a ladder of dx and of time steps.

python scripts/peers/all.py -o out/peers --folder physgaussian=PhysGaussian/mpm_solver_warp \\
    --folder taichi_elements=taichi_elements [--peer newton] [--device cuda] [--quick]
python scripts/peers/collect.py out/peers -o docs/measured/data/peers_cpu.jsonl

Scenes are frozen to files, each peer is started once as a process of its own (--python gives it
its own interpreter) and works off its list; a run that is there is not done again. What would
take longer than --budget seconds by a rough cost model is left out, and said.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import peerlib
from newton_mpm import Newton
from peerlib import Peer, Scene
from physgaussian import PhysGaussian
from taichi_mpm import TaichiElements
from textbook_nacc import Textbook

HERE = Path(__file__).resolve().parent
PEERS: dict[str, tuple[Peer, str]] = {
    "physgaussian": (PhysGaussian(), "physgaussian.py"),
    "taichi_elements": (TaichiElements(), "taichi_mpm.py"),
    "newton": (Newton(), "newton_mpm.py"),
    "textbook": (Textbook(), "textbook_nacc.py"),
}
KINDS = ("elastic", "contact")
NOT = ("covariance_transport",)  # asks for what Gaussians become, which is no part of a solver
# rough seconds: of a run whatever its size, of a step, of a point's step, of a node's step
COST: Mapping[tuple[str, str], tuple[float, float, float, float]] = {
    ("physgaussian", "cpu"): (0.5, 2e-4, 1.5e-6, 5e-8),
    ("physgaussian", "cuda"): (0.05, 8e-5, 2e-9, 2e-11),
    ("taichi_elements", "cpu"): (4.0, 2e-2, 3e-6, 0.0),
    ("taichi_elements", "cuda"): (1.5, 3e-4, 2e-9, 0.0),
    ("newton", "cpu"): (3.0, 4e-2, 4e-5, 0.0),
    ("newton", "cuda"): (0.5, 1e-2, 1e-8, 0.0),
    ("textbook", "cpu"): (0.2, 2e-3, 5e-6, 0.0),
    ("textbook", "cuda"): (0.2, 3e-3, 1e-8, 0.0),
}


def predicted(peer: str, device: str, scene: Scene, courant: float, runs: int) -> float:
    """Seconds that a job will take, roughly."""
    fixed, step, point, node = COST[peer, device]
    steps = scene.seconds * scene.wave_speed / (courant * scene.dx)
    cells = peerlib.place(scene).n ** 3
    return fixed + runs * steps * (step + point * scene.count + node * cells)


def freeze(folder: Path, quick: bool, chosen: Sequence[str]) -> list[Path]:
    """Write the scenes of all cases that a peer may try, eight points per cell."""
    from fracturebench.registry import cases

    paths = []
    for case in cases():
        if case.kind not in KINDS or case.name in NOT or (chosen and case.name not in chosen):
            continue
        for dx in case.ladder[:2] if quick else case.ladder:
            path = folder / "scenes" / f"{case.name}-{dx:.5g}.npz"
            if not path.is_file():
                case.build(dx, 8).save(path)
            paths.append(path)
    return paths


def jobs(
    name: str, scenes: Sequence[Path], folder: Path, options: argparse.Namespace
) -> tuple[list[dict[str, Any]], list[str]]:
    """What a peer is to do, by scene, and what is left out for its price."""
    peer, _ = PEERS[name]
    variants = peer.variants[options.device][: 1 if options.quick else None]
    courants = peer.courant[: 1 if options.quick else None]
    priced = []
    for path in scenes:
        scene = Scene.load(path)
        for i, variant in enumerate(variants):
            for j, courant in enumerate(courants):
                out = folder / name / f"{path.stem}-{variant}-{courant:g}.npz"
                job = {"scene": str(path), "out": str(out), "variant": variant,
                       "courant": courant, "repeat": options.repeat}  # fmt: skip
                price = predicted(name, options.device, scene, courant, 1 + options.repeat)
                # first its fastest way at every dx of every case, then longer and shorter steps
                priced.append((i + j, price, job))
    priced.sort(key=lambda entry: entry[:2])
    taken, left, spent = [], [], 0.0
    for _, price, job in priced:
        if spent + price > options.budget:
            left.append(f"{Path(job['out']).stem} (about {price:.0f} s)")
            continue
        spent += price
        taken.append(job)
    # one scene after another: a peer that compiles for a scene does so once
    return sorted(taken, key=lambda job: str(job["scene"])), left


def pairs(given: Sequence[str]) -> dict[str, str]:
    """``name=value`` arguments as a mapping."""
    out = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not equals or name not in PEERS:
            raise SystemExit(f"all.py: give PEER=VALUE with PEER of {', '.join(PEERS)}: {item!r}")
        out[name] = value
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of scenes and runs")
    parser.add_argument("--peer", action="append", choices=sorted(PEERS), help="only these")
    parser.add_argument("--case", action="append", default=[], help="only these")
    parser.add_argument("--folder", action="append", default=[], metavar="PEER=CHECKOUT")
    parser.add_argument("--python", action="append", default=[], metavar="PEER=INTERPRETER")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--repeat", type=int, help="timed runs; default 0 (cpu), 2 (cuda)")
    parser.add_argument("--budget", type=float, help="seconds per peer; default 60")
    parser.add_argument("--quick", action="store_true", help="two dx, one step, one variant each")
    options = parser.parse_args(arguments)
    gpu = options.device == "cuda"
    options.repeat = (2 if gpu else 0) if options.repeat is None else options.repeat
    options.budget = options.budget or (10.0 if options.quick else 60.0)
    folders, pythons = pairs(options.folder), pairs(options.python)
    cases = options.case or (["bar", "pull_apart"] if options.quick else [])
    scenes = freeze(options.out, options.quick, cases)
    for name in options.peer or PEERS:
        listed, left = jobs(name, scenes, options.out, options)
        if left:
            sys.stdout.write(
                f"{name}: {len(left)} of {len(left) + len(listed)} runs left out for their price "
                f"(--budget), such as {left[0]}\n"
            )
        lines = options.out / f"{name}.jobs"
        lines.write_text("".join(json.dumps(job) + "\n" for job in listed), encoding="utf-8")
        command = [pythons.get(name, sys.executable), str(HERE / PEERS[name][1]),
                   "--jobs", str(lines), "--device", options.device]  # fmt: skip
        if name in folders:
            command += ["--folder", folders[name]]
        sys.stdout.flush()
        done = subprocess.run(command, env=os.environ, check=False)
        if done.returncode:
            # a peer may take its process with it; the others go on, and what it left is kept
            sys.stdout.write(f"{name}: its process ended with {done.returncode}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
