"""Run a scene of FractureBench by PhysGaussian's solver (warp-mpm), from outside and unchanged.

git clone https://github.com/XPandora/PhysGaussian && pip install warp-lang==0.10.1 torch h5py
python scripts/peers/physgaussian.py --folder PhysGaussian/mpm_solver_warp --scene S.npz --out R.npz

Its code has no licence: it is imported from the checkout and never copied. Law: its `jelly` (fixed
corotated). Variants: `shipped` calls `p2g2p`, whose five timers wait for the device each step;
`graph` (CUDA) replays one captured substep, which is the best that can be had of it.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import sys
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import peerlib
from peerlib import NODE_ON_WALL, Cannot, Floats, Placement, Scene

# c dt/dx of its six configs: 0.366, 0.110, 0.367, 0.028, 0.070, 0.013
COURANT = (0.7, 0.37, 0.1, 0.9, 0.03)
WALL_NODES = 3  # nodes at each side that its bounding box stops


def walls(scene: Scene, placed: Placement) -> tuple[Placement, list[Floats], bool]:
    """Its walls for a scene's planes: placement, points of sticky planes, bounding box or not.

    Raises:
        Cannot: A plane that it has no wall for.
    """
    sticky: list[Floats] = []
    shift, box = placed.shift.copy(), False
    for plane in scene.colliders:
        normal = np.array(plane["normal"], float)
        normal /= np.linalg.norm(normal)
        axis = int(np.abs(normal).argmax())
        if abs(normal[axis]) < 1.0 - 1e-9:
            raise Cannot("was given a plane that lies across the grid")
        if plane["kind"] == "sticky":
            point = np.array(plane["point"], float) + NODE_ON_WALL * placed.dx * normal
            sticky.append(np.array([*point, *normal]))
            continue
        # its surface collider stops a node wholly, whatever kind it is given; only its bounding
        # box lets matter slide and leave
        if plane["kind"] != "separate" or float(plane.get("friction", 0.0)) != 0.0:
            raise Cannot(
                f"stops matter at every plane, also at a {plane['kind']} one with friction"
            )
        if normal[axis] < 0.0:
            raise Cannot("has a sliding wall at the sides of its domain only")
        below = math.floor(float(plane["point"][axis]) / placed.dx + 1e-6)
        shift[axis] = below - (WALL_NODES - 1)
        box = True
    return Placement(placed.n, placed.dx, shift), sticky, box


class Engine:
    """One scene in its solver.

    Args:
        peer: The loaded solver.
        scene: The scene.
        variant: ``shipped`` or ``graph``.
        device: ``cpu`` or ``cuda``.
        placed: Its domain; default the smallest that holds the motion.
        **parameters: Further keys of its ``set_parameters_dict``.
    """

    def __init__(
        self,
        peer: PhysGaussian,
        scene: Scene,
        variant: str,
        device: str,
        placed: Placement | None = None,
        **parameters: Any,
    ) -> None:
        import torch
        import warp as wp

        peerlib.only_elastic(scene)
        self.wp, self.device = wp, "cuda:0" if device == "cuda" else "cpu"
        self.placed, sticky, box = walls(scene, placed or peerlib.place(scene))
        self.graphs: dict[float, Any] = {}
        self.variant, self.steps = variant, 0
        n = scene.count
        solver = peer.module.MPM_Simulator_WARP(n, self.placed.n, self.placed.size, self.device)
        self.solver = solver

        def tensor(value: Floats) -> Any:
            return torch.tensor(np.ascontiguousarray(value, np.float32), device=self.device)

        # what load_initial_data_from_torch does, which has cuda:0 written into it
        solver.import_particle_x_from_torch(tensor(self.placed.inward(scene.x)), True, self.device)
        solver.mpm_state.particle_vol = wp.from_numpy(
            scene.volume.astype(np.float32), dtype=float, device=self.device
        )
        wp.launch(
            kernel=peer.module.set_mat33_to_identity, dim=n,
            inputs=[solver.mpm_state.particle_F_trial], device=self.device,
        )  # fmt: skip
        solver.import_particle_v_from_torch(tensor(scene.v), True, self.device)
        solver.import_particle_C_from_torch(tensor(scene.affine), True, self.device)
        first = scene.materials[0]
        solver.set_parameters_dict(
            {"material": "jelly", "E": float(first["young_modulus"]),
             "nu": float(first["poisson_ratio"]), "density": float(first["density"]),
             "g": list(scene.gravity), "n_grid": self.placed.n, "grid_lim": self.placed.size,
             **parameters},
            device=self.device,
        )  # fmt: skip
        if len(scene.materials) > 1:
            for name, key in (("E", "young_modulus"), ("nu", "poisson_ratio")):
                getattr(solver.mpm_model, name).assign(
                    peerlib.per_point(scene, key).astype(np.float32)
                )
            solver.reset_densities_and_update_masses(
                tensor(peerlib.per_point(scene, "density")), device=self.device
            )
        solver.finalize_mu_lam(device=self.device)
        for plane in sticky:
            solver.add_surface_collider(
                self.placed.inward(plane[None, :3])[0].tolist(), plane[3:].tolist()
            )
        if box:
            solver.add_bounding_box()

    def advance(self, count: int, dt: float) -> None:
        wp = self.wp
        if self.variant == "shipped":
            for _ in range(count):
                self.solver.p2g2p(self.steps, dt, device=self.device)
                self.steps += 1
            wp.synchronize()
            return
        self.prepare(dt)
        for _ in range(count):
            wp.capture_launch(self.graphs[dt])
        self.steps += count
        wp.synchronize()

    def prepare(self, dt: float) -> None:
        """Capture a substep of this length, if this is to run by graphs."""
        if self.variant == "shipped" or dt in self.graphs:
            return
        wp = self.wp
        # its timers cannot be captured; without them it is faster than as shipped
        timer, wp.ScopedTimer = wp.ScopedTimer, lambda *_, **__: contextlib.nullcontext()
        try:
            wp.capture_begin(self.device)
            self.solver.p2g2p(self.steps, dt, device=self.device)
            self.graphs[dt] = wp.capture_end(self.device)
        finally:
            wp.ScopedTimer = timer

    def state(self) -> tuple[Floats, Floats]:
        x = self.solver.mpm_state.particle_x.numpy().astype(np.float64)
        v = self.solver.mpm_state.particle_v.numpy().astype(np.float64)
        if np.isfinite(x).all() and not self.placed.holds(x):
            # it does not check grid indices: beyond this it writes where it should not
            raise Cannot("points reached the side of its domain")
        return self.placed.outward(x), v


class PhysGaussian:
    name = "physgaussian"
    shipped = "shipped"
    needs = "warp"
    install = (
        "Get it by: git clone https://github.com/XPandora/PhysGaussian && pip install "
        "warp-lang==0.10.1 torch h5py, then --folder PhysGaussian/mpm_solver_warp"
    )
    variants: Mapping[str, Sequence[str]] = {"cpu": ("shipped",), "cuda": ("graph", "shipped")}
    courant: Sequence[float] = COURANT
    module: Any = None

    def load(self, folder: Path | None) -> str:
        if folder is None or not (folder / "mpm_solver_warp.py").is_file():
            raise FileNotFoundError(f"no mpm_solver_warp.py in {folder}")
        import warp as wp

        version = str(wp.config.version)
        if int(version.split(".")[0]) > 0:
            raise ImportError(f"its code does not load under warp-lang {version}: it pins 0.10.1")
        wp.config.quiet = True
        wp.init()
        try:
            importlib.import_module("h5py")
        except ImportError:  # only its samples read .h5
            sys.modules["h5py"] = types.ModuleType("h5py")
        sys.path.insert(0, str(folder.resolve()))
        self.module = importlib.import_module("mpm_solver_warp")
        return f"warp {version}"

    def start(self, scene: Scene, variant: str, device: str) -> Engine:
        return Engine(self, scene, variant, device)


if __name__ == "__main__":
    sys.exit(peerlib.main(PhysGaussian(), __doc__ or ""))
