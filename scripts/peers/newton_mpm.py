"""Run a scene of FractureBench by Newton's implicit MPM, from outside.

pip install newton
python scripts/peers/newton_mpm.py --scene S.npz --out R.npz --courant 1

Its elastic law with yield out of reach, E, nu and density per particle. Implicit: its steps may be
longer than a wave's crossing of a cell, but damp what they do not resolve. Variant `default`: every
numerical setting as shipped; `graph` (CUDA): the same, two captured steps replayed, on a grid whose
room is reserved.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import peerlib
from peerlib import Cannot, Floats, Scene

COURANT = (1.0, 0.37, 3.0, 10.0, 0.1)
UNREACHED = 1e15  # yield pressure and stress [Pa], its own default for "never"
# `default` is its best: B-splines, GIMP, other strain bases, more iterations and no air drag were
# tried on the bar and cost more for the same error or a larger one
OPTIONS: dict[str, dict[str, Any]] = {
    "default": {},
    "b2": {"velocity_basis": "B2"},
    "gimp": {"integration_scheme": "gimp"},
    "tight": {"tolerance": 1e-6, "max_iterations": 1000},
}


def material(scene: Scene) -> dict[str, list[float]]:
    """Its per-particle attributes for a scene's elastic points."""
    peerlib.only_elastic(scene)
    n = scene.count

    def same(value: float) -> list[float]:
        return [value] * n

    return {
        "mpm:young_modulus": peerlib.per_point(scene, "young_modulus").tolist(),
        "mpm:poisson_ratio": peerlib.per_point(scene, "poisson_ratio").tolist(),
        "mpm:yield_pressure": same(UNREACHED),
        "mpm:yield_stress": same(UNREACHED),
        "mpm:tensile_yield_ratio": same(1.0),
        "mpm:friction": same(0.0),
    }


class Engine:
    """One scene in its solver."""

    def __init__(self, peer: Newton, scene: Scene, variant: str, device: str) -> None:
        newton, wp = peer.newton, peer.wp
        attributes = material(scene)
        gravity = tuple(float(g) for g in scene.gravity)
        builder = newton.ModelBuilder(gravity=gravity)
        newton.solvers.SolverImplicitMPM.register_custom_attributes(builder)
        builder.add_particles(
            pos=[wp.vec3(*p) for p in scene.x.tolist()],
            vel=[wp.vec3(*p) for p in scene.v.tolist()],
            mass=scene.mass.tolist(),
            radius=(0.5 * np.cbrt(scene.volume)).tolist(),  # it takes (2 r)^3 for the volume
            custom_attributes=attributes,
        )
        stiff = max(float(m["young_modulus"]) for m in scene.materials)
        for plane in scene.colliders:
            if plane["kind"] == "slip":
                raise Cannot("has no plane along which matter slides without leaving it")
            normal = np.array(plane["normal"], float)
            normal /= np.linalg.norm(normal)
            offset = -float(normal @ np.array(plane["point"], float))
            sticky = plane["kind"] == "sticky"
            # nothing in the scenes pulls at a wall with ten times Young's modulus
            config = builder.ShapeConfig(mu=1.0 if sticky else float(plane.get("friction", 0.0)))
            builder.add_shape_plane(
                plane=(*normal.tolist(), offset), cfg=config,
                custom_attributes={"mpm:collider_adhesion": 10.0 * stiff if sticky else 0.0},
            )  # fmt: skip
        name = "cuda:0" if device == "cuda" else "cpu"
        with contextlib.redirect_stdout(io.StringIO()):
            self.model = builder.finalize(device=name)
            options = newton.solvers.SolverImplicitMPM.Config(
                voxel_size=scene.dx, **OPTIONS.get(variant, {})
            )
            if variant == "graph":  # a graph needs room that is reserved: it may move and widen
                cells = np.unique(np.floor(scene.x / scene.dx).astype(int), axis=0).shape[0]
                options.max_active_cell_count = 4 * cells + 64
            self.solver = newton.solvers.SolverImplicitMPM(self.model, options)
        self.now, self.next = self.model.state(), self.model.state()
        self.now.mpm.particle_qd_grad.assign(scene.affine.astype(np.float32))
        self.wp, self.steps, self.variant = wp, 0, variant
        self.graphs: dict[float, Any] = {}

    def advance(self, count: int, dt: float) -> None:
        pairs = count // 2 if self.variant == "graph" else 0
        if pairs:
            self.prepare(dt)
            for _ in range(pairs):
                self.wp.capture_launch(self.graphs[dt])
        for _ in range(count - 2 * pairs):
            self.solver.step(self.now, self.next, None, None, dt)
            self.now, self.next = self.next, self.now
            self.graphs.clear()  # they hold the states the other way round
        self.steps += count
        self.wp.synchronize()

    def prepare(self, dt: float) -> None:
        """Capture two steps of this length, there and back again between the two states."""
        if self.variant != "graph" or dt in self.graphs:
            return
        # some of its kernels are made by the first step; what that leaves is written over
        self.solver.step(self.now, self.next, None, None, dt)
        with self.wp.ScopedCapture() as capture:
            self.solver.step(self.now, self.next, None, None, dt)
            self.solver.step(self.next, self.now, None, None, dt)
        self.graphs[dt] = capture.graph

    def state(self) -> tuple[Floats, Floats]:
        x, v = self.now.particle_q.numpy(), self.now.particle_qd.numpy()
        return x.astype(np.float64), v.astype(np.float64)


class Newton:
    name = "newton"
    shipped = "default"
    needs = "newton"
    install = "Get it by: pip install newton"
    variants: Mapping[str, Sequence[str]] = {"cpu": ("default",), "cuda": ("graph", "default")}
    tried: Sequence[str] = tuple(OPTIONS)
    courant: Sequence[float] = COURANT
    newton: Any = None
    wp: Any = None

    def load(self, folder: Path | None) -> str:
        import newton
        import newton.solvers
        import warp as wp

        wp.config.quiet = True
        wp.init()
        self.newton, self.wp = newton, wp
        return f"newton {newton.__version__}, warp {wp.config.version}"

    def start(self, scene: Scene, variant: str, device: str) -> Engine:
        return Engine(self, scene, variant, device)


if __name__ == "__main__":
    sys.exit(peerlib.main(Newton(), __doc__ or ""))
