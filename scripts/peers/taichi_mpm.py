"""Run a scene of FractureBench by Taichi's MPM (taichi_elements), from outside and unchanged.

git clone https://github.com/taichi-dev/taichi_elements && pip install taichi
python scripts/peers/taichi_mpm.py --folder taichi_elements --scene S.npz --out R.npz

Law: its elastic material (fixed corotated), whose Lame parameters it multiplies by 0.3; they are
given to it divided by that. One material, one density and one volume per point for all points.
Variants: `kernels` calls its kernels without the printed dot and the greatest speed that `step`
reads back every step; `shipped` calls `step`.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import peerlib
from peerlib import NODE_ON_WALL, Cannot, Floats, Scene

SOFTER = 0.3  # what its elastic material makes of the Lame parameters
# dt = 0.02 dx (unit domain) at E = 1e6, nu 0.2, density 1000 (0.3 E): 0.37 at most
COURANT = (0.7, 0.37, 0.1, 0.9)


def uniform(values: Floats, what: str, spread: float = 1e-6) -> float:
    """The mean of all points; raise Cannot if they differ by more than a share of it (rms)."""
    mean = float(values.mean())
    if float(values.std()) > spread * abs(mean):
        raise Cannot(f"has one {what} for all points")
    return mean


def grid_cells(scene: Scene) -> int:
    """Cells along the edge of its (unbounded) grid's nominal domain."""
    return max(16, peerlib.place(scene).n)


class Engine:
    """One scene in its solver."""

    def __init__(self, peer: TaichiElements, scene: Scene, variant: str, device: str) -> None:
        self.variant, self.steps, self.count = variant, 0, scene.count
        self.solver, self.ti = peer.solver(scene, device), peer.ti
        self.settings = {"volume_spread": float(scene.volume.std() / scene.volume.mean())}
        solver = self.solver
        # its clear_particles does not compile under taichi 1.7; the same points are seeded anew
        solver.n_particles[None] = 0
        solver.t, solver.total_substeps = 0.0, 0
        solver.recover_from_external_array(
            scene.count, scene.x.astype(np.float32), scene.v.astype(np.float32),
            np.full(scene.count, solver.material_elastic, np.int32),
            np.zeros(scene.count, np.int32),
        )  # fmt: skip
        peer.set_affine(solver.C, scene.affine.astype(np.float32))

    def advance(self, count: int, dt: float) -> None:
        solver = self.solver
        if self.variant == "shipped":
            with contextlib.redirect_stdout(io.StringIO()):
                # it takes int(frame / dt) + 1 steps of equal length: a frame a hair below `count`
                # of them; its loop may add one of rounding size, which is counted as it is
                solver.default_dt = dt
                solver.step(count * dt * (1.0 - 1e-9))
            self.steps = solver.total_substeps
            self.ti.sync()
            return
        for _ in range(count):
            solver.grid.deactivate_all()
            solver.build_pid(solver.pid, solver.grid_m, 0.5)
            solver.p2g(dt)
            solver.grid_normalization_and_gravity(dt, solver.grid_v, solver.grid_m)
            for wall in solver.grid_postprocess:
                wall(solver.t, dt, solver.grid_v)
            solver.t += dt
            solver.g2p(dt)
        self.steps += count
        self.ti.sync()

    def state(self) -> tuple[Floats, Floats]:
        found = self.solver.particle_info()
        return found["position"].astype(np.float64), found["velocity"].astype(np.float64)


class TaichiElements:
    name = "taichi_elements"
    shipped = "shipped"
    needs = "taichi"
    install = (
        "Get it by: git clone https://github.com/taichi-dev/taichi_elements && pip install taichi, "
        "then --folder taichi_elements"
    )
    variants: Mapping[str, Sequence[str]] = {
        "cpu": ("kernels", "shipped"), "cuda": ("kernels", "shipped")
    }  # fmt: skip
    courant: Sequence[float] = COURANT
    module: Any = None
    ti: Any = None
    set_affine: Any = None
    made: tuple[Scene, Any] | None = None

    def load(self, folder: Path | None) -> str:
        if folder is None or not (folder / "engine" / "mpm_solver.py").is_file():
            raise FileNotFoundError(f"no engine/mpm_solver.py in {folder}")
        with contextlib.redirect_stdout(io.StringIO()):
            import taichi as ti
        sys.path.insert(0, str(folder.resolve()))
        self.ti, self.module = ti, importlib.import_module("engine.mpm_solver")
        self.set_affine = importlib.import_module("taichi_affine").set_affine
        return f"taichi {'.'.join(str(part) for part in ti.__version__[:3])}"

    def solver(self, scene: Scene, device: str) -> Any:
        """Its solver for a scene, compiled once: its constants are compiled into its kernels.

        Raises:
            Cannot: A scene that it has no means for.
        """
        if self.made is not None and self.made[0] is scene:
            return self.made[1]
        peerlib.only_elastic(scene)
        young = uniform(peerlib.per_point(scene, "young_modulus"), "stiffness")
        poisson = uniform(peerlib.per_point(scene, "poisson_ratio"), "Poisson's ratio")
        density = uniform(peerlib.per_point(scene, "density"), "density")
        volume = uniform(scene.volume, "volume", 0.01)
        ti = self.ti
        ti.reset()
        # its sparse grids take their memory from a pool that is too small for them on a GPU
        pool = (
            {"arch": ti.cuda, "device_memory_fraction": 0.3}
            if device == "cuda"
            else {"arch": ti.cpu}
        )
        ti.init(log_level=ti.ERROR, random_seed=0, offline_cache=True, **pool)
        n = grid_cells(scene)
        # unbounded: its grid is sparse about the origin, so nothing is moved
        made = self.module.MPMSolver(
            res=(n, n, n), size=n * scene.dx, unbounded=True, use_voxelizer=False,
            max_num_particles=max(2**16, scene.count), support_plasticity=False,
            use_bls=device == "cuda",
        )  # fmt: skip
        mu, lam = peerlib.lame(young, poisson)
        made.mu_0, made.lambda_0 = mu / SOFTER, lam / SOFTER
        made.p_vol, made.p_mass = volume, volume * density
        made.set_gravity(tuple(float(g) for g in scene.gravity))
        kinds = {"sticky": made.surface_sticky, "slip": made.surface_slip,
                 "separate": made.surface_separate}  # fmt: skip
        for plane in scene.colliders:
            normal = np.array(plane["normal"], float)
            raised = NODE_ON_WALL * scene.dx * normal / np.linalg.norm(normal)
            made.add_surface_collider(
                (np.array(plane["point"], float) + raised).tolist(),
                normal.tolist(),
                kinds[str(plane["kind"])],
                float(plane.get("friction", 0.0)),
            )
        self.made = (scene, made)
        return made

    def forget(self) -> None:
        """Start anew: what an error on a device leaves is of no use."""
        self.made = None

    def start(self, scene: Scene, variant: str, device: str) -> Engine:
        return Engine(self, scene, variant, device)


if __name__ == "__main__":
    sys.exit(peerlib.main(TaichiElements(), __doc__ or ""))
