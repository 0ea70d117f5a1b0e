"""Time PhysGaussian's solver on the scenes of mpm.py, for the same table on the same machine.

git clone https://github.com/XPandora/PhysGaussian && pip install warp-lang==0.10.1
python scripts/bench/physgaussian.py PhysGaussian/mpm_solver_warp --json peer.json
python scripts/bench/mpm.py --peer peer.json --markdown docs/measured/benchmarks.md

Its code is imported from that folder, unchanged, and never copied: it has no licence. One substep
is captured in a CUDA graph (`p2g2p` without its five synchronising timers, which is faster than as
shipped), 50 substeps to warm up, then the median of five runs of 100. Material: its jelly (fixed
corotated), the same E, nu, density, points, step and walls.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import sys
import time
import types
from pathlib import Path
from typing import Any

import torch
from mpm import PEER, points


def solver_module(folder: Path) -> Any:
    """Import ``mpm_solver_warp`` from a checkout; h5py, which its samples need, may be absent."""
    try:
        importlib.import_module("h5py")
    except ImportError:
        sys.modules["h5py"] = types.ModuleType("h5py")
    sys.path.insert(0, str(folder))
    return importlib.import_module("mpm_solver_warp")


def measure(module: Any, n: int, cells: int, order: str) -> dict[str, Any]:
    import warp as wp

    x, dx = points(n, cells, order, torch.device("cuda"))
    count = x.shape[0]
    solver = module.MPM_Simulator_WARP(count)
    volume = torch.full((count,), dx**3 / 8, device="cuda")
    solver.load_initial_data_from_torch(x, volume, n_grid=n, grid_lim=2.0)
    velocity = torch.zeros(count, 3, device="cuda")
    velocity[:, 2] = -3.0
    solver.import_particle_v_from_torch(velocity)
    solver.set_parameters_dict(
        {"material": "jelly", "E": 1e5, "nu": 0.3, "density": 1000.0, "g": [0.0, 0.0, -9.8],
         "n_grid": n, "grid_lim": 2.0}
    )  # fmt: skip
    solver.finalize_mu_lam()
    solver.add_bounding_box()
    for step in range(50):
        solver.p2g2p(step, 1e-4)
    wp.synchronize()
    timer, wp.ScopedTimer = wp.ScopedTimer, lambda *_, **__: contextlib.nullcontext()
    try:
        wp.capture_begin()
        solver.p2g2p(50, 1e-4)
        graph = wp.capture_end()
    finally:
        wp.ScopedTimer = timer
    times = []
    for _ in range(5):
        wp.synchronize()
        start = time.perf_counter()
        for _ in range(100):
            wp.capture_launch(graph)
        wp.synchronize()
        times.append((time.perf_counter() - start) / 100)
    height = float(solver.export_particle_x_to_torch()[:, 2].mean())
    return {
        "grid": n, "cells": cells, "order": order, "particles": count,
        "ms": 1e3 * sorted(times)[2], "mean_height": height,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="mpm_solver_warp of a PhysGaussian checkout")
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()
    if not (options.folder / "mpm_solver_warp.py").is_file():
        parser.error(f"{options.folder} holds no mpm_solver_warp.py")
    if not torch.cuda.is_available():
        parser.error("needs a CUDA GPU")
    import warp as wp

    wp.init()
    module, rows = solver_module(options.folder), []
    for n, cells, order in PEER:
        rows.append(measure(module, n, cells, order))
        sys.stderr.write(f"{n}^3 {rows[-1]['particles']:,} {order}: {rows[-1]['ms']:.3f} ms\n")
        options.json.write_text(
            json.dumps({"device": torch.cuda.get_device_name(), "warp": wp.config.version,
                        "rows": rows}, indent=1) + "\n"
        )  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
