"""The MPM solver that textbooks describe and others ship, with the variants they differ by.

Written from the formulas (equations.md sections 2, 8, 9) in plain PyTorch, as something to measure
gsfluent's solver against: every switch of :class:`Variant` is a choice that a released solver makes
(:mod:`gsfluent.lab.peers.known` names them). Not for use: it is slow, and most variants fail.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.textbook import laws
from gsfluent.lab.textbook.grid import (
    Stencil,
    collide,
    contact,
    deterministic,
    node_positions,
    scatter,
    stencil,
)
from gsfluent.lab.textbook.nacc import Nacc, return_map
from gsfluent.lab.textbook.variant import Birth, Variant
from gsfluent.lab.world.drives import Drives, damage


def six(m: Tensor) -> Tensor:
    """Entries xx, yy, zz, xy, xz, yz of symmetric matrices, [N, 6]."""
    return m.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]]


class Textbook:
    """A scene run by a variant.

    Raises:
        ValueError: A law or drive that this solver does not have.
    """

    def __init__(
        self,
        scene: Scene,
        variant: Variant | None = None,
        *,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        dt: float | None = None,
        cfl: float = 0.5,
    ):
        if dt is not None and not 0.0 < dt < math.inf:
            raise ValueError(f"Textbook: dt must be positive, got {dt}")
        self.scene, self.variant = scene, variant or Variant()
        self.device, self.dtype = torch.device(device), dtype
        self.fixed_dt, self.cfl = dt, cfl
        n = scene.count
        self.material = torch.from_numpy(scene.material).long().to(device)
        self.mass, self.volume = self._number(scene.mass), self._number(scene.volume)
        self._read_materials()
        self.body = torch.from_numpy(scene.body).long().to(device)
        self.count_fields = int(scene.body.max()) + 1 if self.variant.fields else 1
        x = torch.from_numpy(scene.x).to(device) / scene.dx
        cell = torch.floor(x)
        if self.variant.local_positions:
            self._cell, self._offset = cell.long(), (x - cell).to(dtype)
        else:
            self._cell = torch.zeros(n, 3, dtype=torch.int64, device=device)
            self._offset = self._number(scene.x)  # metres
        self.velocity, self.affine = self._number(scene.v), self._number(scene.affine)
        one = torch.eye(3, dtype=dtype, device=device).expand(n, 3, 3).clone()
        self.state = one if self.variant.storage == "F" else torch.zeros_like(one)
        """F or e = b - I, [N, 3, 3]."""
        self.stress = torch.zeros_like(one)
        self.time, self.steps, self.dt = 0.0, 0, 0.0
        self.birth: Birth | None = None
        self.peak = self.alpha
        self.deformation = one.clone() if "deformation" in scene.asks else None
        """Deformation gradient since the start, [N, 3, 3], where the scene asks for it."""
        self._drives = Drives(scene, dtype, self.device) if scene.drives else None
        self._turn = torch.Generator().manual_seed(self.variant.shuffle or 0)

    def _number(self, value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=self.dtype, device=self.device).clone()

    def _read_materials(self) -> None:
        rows, nacc, start = [], [], []
        for m in self.scene.materials:
            if m["law"] not in ("elastic", "nacc"):
                raise ValueError(f"Textbook: no law {m['law']!r}; it has elastic and nacc")
            young, nu = float(m["young_modulus"]), float(m["poisson_ratio"])
            brittle = m["law"] == "nacc"
            rows.append(
                [young / (2.0 + 2.0 * nu), young / (3.0 - 6.0 * nu)]
                + ([float(m[k]) for k in ("friction", "cohesion", "hardening")] if brittle
                   else [0.0, 0.0, 0.0])
            )  # fmt: skip
            nacc.append(brittle)
            start.append(float(m.get("alpha", 0.0)) if brittle else 0.0)
        table = self._number(rows)[self.material]
        self.nacc = Nacc(*table.unbind(1))
        self.brittle = torch.tensor(nacc, device=self.device)[self.material]
        self.alpha = self._number(start)[self.material]
        self._brittle = self.brittle.nonzero()[:, 0]

    @property
    def position(self) -> Tensor:
        """Positions [m], float64 [N, 3]."""
        if self.variant.local_positions:
            return (self._cell.double() + self._offset.double()) * self.scene.dx
        return self._offset.double()

    @property
    def strain(self) -> Tensor:
        """Elastic strain e = b - I, [N, 6]: xx, yy, zz, xy, xz, yz."""
        e = laws.measure(self.state, self.variant.storage).e
        return six(e)

    @property
    def volume_ratio(self) -> Tensor:
        """J, negative where F is turned inside out, [N]."""
        return laws.measure(self.state, self.variant.storage).j

    def kinetic(self) -> float:
        """Kinetic energy [J], with the part in the affine velocities."""
        each = (self.velocity.double() ** 2).sum(1)
        each = each + 0.25 * self.scene.dx**2 * (self.affine.double() ** 2).sum((1, 2))
        return float(0.5 * (self.mass.double() * each).sum())

    def elastic(self) -> float:
        """Stored elastic energy [J]."""
        params = torch.zeros(len(self.material), 8, dtype=torch.float64, device=self.device)
        params[:, 0], params[:, 1] = self.nacc.mu.double(), self.nacc.kappa.double()
        params[:, 6] = 1.0
        number = 6 if self.variant.law == "corotated" else 0
        law = torch.where(self.brittle, 0, number).int()
        density = ops.elastic_energy(self.strain.double(), law=law, params=params)
        return float((self.volume.double() * density).sum())

    def momentum(self) -> Tensor:
        """Momentum [kg m/s], float64 [3]."""
        return (self.mass.double()[:, None] * self.velocity.double()).sum(0)

    def limit(self) -> float:
        """Time step [s]: the fixed one, or ``cfl dx / (c + |v|)``."""
        if self.fixed_dt is not None:
            return self.fixed_dt
        fastest = float(self.velocity.norm(dim=1).max()) + self.scene.wave_speed
        if not math.isfinite(fastest):
            raise FloatingPointError(f"no time step: velocities of {fastest} m/s")
        return self.cfl * self.scene.dx / fastest

    def run(
        self,
        seconds: float | None = None,
        steps: int | None = None,
        each: Callable[[Textbook], None] | None = None,
    ) -> Textbook:
        """Advance by a time, to the end of it exactly, or by a number of steps.

        Raises:
            ValueError: Not exactly one of ``seconds`` and ``steps``.
            FloatingPointError: A number is not finite; :attr:`birth` says where it came from.
        """
        if (seconds is None) == (steps is None):
            raise ValueError("Textbook.run: give either seconds or steps")
        end, first = self.time + (seconds or 0.0), self.steps
        while self.time < end if steps is None else self.steps - first < steps:
            dt, last = self.limit(), False
            if steps is None and dt * (1.0 + 1e-9) >= end - self.time:
                dt, last = end - self.time, True
            self.advance(dt)
            if last:
                self.time = end
            if each is not None:
                each(self)
        return self

    def advance(self, dt: float) -> None:
        """Advance by one step of ``dt`` seconds.

        Raises:
            FloatingPointError: A number is not finite.
        """
        variant, scene = self.variant, self.scene
        if self._drives is not None:
            self._drives(cast(Any, self), dt)  # reads time and velocity alone
        scaled = self._offset if variant.local_positions else self._offset / scene.dx
        with torch.no_grad():
            s = stencil(self._cell, scaled, scene.dx, variant.kernel)
            mass, new, old = self._grid(s, dt)
            slope = self._gather(s, new, old, dt)
            inverted = laws.det(slope * dt + torch.eye(3, dtype=self.dtype, device=self.device))
            self._map(dt * slope, ~(inverted > 0))
            fine = torch.isfinite(self.velocity).all() & torch.isfinite(self.stress).all()
            fine &= torch.isfinite(self._offset).all() & torch.isfinite(self.alpha).all()
        self.time += dt
        self.steps += 1
        self.dt = dt
        if not bool(fine):
            self.birth = self._diagnose(s, mass, new, slope)
            raise FloatingPointError(str(self.birth))

    def _order(self, s: Stencil) -> Tensor | None:
        if self.variant.sums == "sorted":
            return torch.argsort(s.node[:, 0], stable=True)
        if self.variant.shuffle is None:
            return None
        return torch.randperm(s.node.shape[0], generator=self._turn).to(self.device)

    def _grid(self, s: Stencil, dt: float) -> tuple[Tensor, Tensor, Tensor | None]:
        """Masses [G], velocities after forces and walls [G, 3], and before (FLIP)."""
        variant, dx = self.variant, self.scene.dx
        m, w = self.mass, s.weight
        node, size = s.node, s.size
        if self.count_fields > 1:
            node, size = node + (self.body * s.size)[:, None], size * self.count_fields
        carried = m[:, None] * self.velocity
        push = dt * self.volume[:, None, None] * self.stress
        spread = m[:, None, None] * self.affine
        if variant.force == "mls":
            spread = spread - 4.0 / dx**2 * push
        start = carried - dx * (spread @ s.place[:, :, None])[:, :, 0]
        moved = w[:, :, None] * (start[:, None] + dx * (s.corner @ spread.mT))
        pushed = None
        if variant.force != "mls":
            pushed = -(s.slope @ push)
            if variant.force == "twice":
                pushed = pushed * w[:, :, None]
        elif variant.transfer == "flip":
            spread = -4.0 / dx**2 * push
            start = -dx * (spread @ s.place[:, :, None])[:, :, 0]
            pushed = w[:, :, None] * (start[:, None] + dx * (s.corner @ spread.mT))
            moved = w[:, :, None] * carried[:, None]
        columns = [moved, (w * m[:, None])[:, :, None]]
        if variant.transfer == "flip" and pushed is not None:
            columns.append(pushed)
        elif pushed is not None:
            columns[0] = moved + pushed
        sums = "plain" if variant.sums == "sorted" else variant.sums
        with deterministic(variant.sums == "sorted"):
            grid = scatter(node, torch.cat(columns, 2), size, sums, self._order(s))
        mass = grid[:, 3]
        heavy = mass > variant.mass_floor
        safe = torch.where(heavy, mass, 1.0)[:, None]
        before, old = grid[:, :3], None
        if variant.transfer == "flip":
            old = before / mass[:, None]
            if variant.guarded:
                old = torch.where(heavy[:, None], before / safe, 0.0)
            before = before + grid[:, 4:]
        gravity = dt * self._number(self.scene.gravity)
        if variant.guarded or variant.transfer == "flip":
            new = torch.where(heavy[:, None], before / safe + gravity, 0.0)
        else:
            new = before / mass[:, None] + gravity
        if self.count_fields > 1:
            new = self._touch(s, node, size, mass, new)
        if self.scene.colliders:
            x = node_positions(s, dx).repeat(self.count_fields, 1)
            new = collide(new, x, self.scene.colliders, dx)
        return mass, new, old

    def _touch(self, s: Stencil, node: Tensor, size: int, mass: Tensor, new: Tensor) -> Tensor:
        """Velocities of all fields after contact between bodies, [G, 3]."""
        dx, m = self.scene.dx, self.mass[:, None, None]
        arm = s.weight[:, :, None] * (s.place[:, None] - s.corner)  # from node to point [dx]
        sums = "plain" if self.variant.sums == "sorted" else self.variant.sums
        with deterministic(self.variant.sums == "sorted"):
            moments = scatter(
                node, torch.cat([m * s.slope, m * arm], 2), size, sums, self._order(s)
            )
        k = self.count_fields
        centre = dx * moments[:, 3:] / torch.where(mass > 0, mass, 1.0)[:, None]
        after = contact(
            new.view(k, -1, 3), mass.view(k, -1), moments[:, :3].reshape(k, -1, 3),
            centre.view(k, -1, 3), dx, self.scene.friction,
        )  # fmt: skip
        return after.view(-1, 3)

    def _gather(self, s: Stencil, new: Tensor, old: Tensor | None, dt: float) -> Tensor:
        """Take velocities, move the points; the velocity gradient [1/s], [N, 3, 3]."""
        variant, dx = self.variant, self.scene.dx
        node = s.node
        if self.count_fields > 1:
            node = node + (self.body * s.size)[:, None]
        at, w = new[node], s.weight[:, :, None]
        taken = (w * at).sum(1)
        slope = at.mT @ s.slope
        affine = slope
        if variant.kernel == "quadratic":
            first = at.mT @ (w * s.corner)
            affine = 4.0 / dx * (first - taken[:, :, None] * s.place[:, None, :])
            slope = affine if variant.force == "mls" else slope
        move = taken
        if variant.transfer == "flip" and old is not None:
            lost = (w * old[node]).sum(1)
            taken = taken + variant.flip * (self.velocity - lost)
        self.velocity = taken
        self.affine = affine if variant.transfer == "apic" else torch.zeros_like(affine)
        if variant.local_positions:
            here = self._offset + dt / dx * move
            whole = torch.floor(torch.nan_to_num(here))
            self._cell, self._offset = self._cell + whole.long(), here - whole
        else:
            self._offset = self._offset + dt * move
        return slope

    def _map(self, increment: Tensor, inverted: Tensor) -> None:
        variant, m = self.variant, self.nacc
        if self.deformation is not None:
            self.deformation = self.deformation + increment @ self.deformation
        state = laws.advance(self.state, increment, variant.storage)
        if variant.clamp is not None:
            state = laws.clamped(state, variant.storage, *variant.clamp, inverted)
        rows = self._brittle
        if rows.shape[0]:
            own = laws.measure(state[rows], variant.storage)
            e, alpha, plastic = return_map(
                variant.return_map, m.of(rows), own, self.alpha[rows], absolute=variant.absolute
            )
            self.alpha = self.alpha.index_copy(0, rows, alpha)
            self.peak = torch.maximum(self.peak, self.alpha)
            moved = plastic.nonzero()[:, 0]
            if moved.shape[0]:
                at, e = rows[moved], e[moved]
                kept = laws.with_stretch(state[at], e) if variant.storage == "F" else e
                state = state.index_copy(0, at, kept)
        self.state = state
        measured = laws.measure(state, variant.storage)
        self.stress = laws.neo_hookean(
            measured, m.mu, m.kappa, energy_as_pressure=variant.energy_as_pressure
        )
        if variant.law == "corotated":
            tough = (~self.brittle).nonzero()[:, 0]
            own_stress = laws.corotated(state[tough], variant.storage, m.mu[tough], m.kappa[tough])
            self.stress = self.stress.index_copy(0, tough, own_stress)

    def _diagnose(self, s: Stencil, mass: Tensor, new: Tensor, slope: Tensor) -> Birth:
        node = s.node
        if self.count_fields > 1:
            node = node + (self.body * s.size)[:, None]
        on_grid = ~torch.isfinite(new).all(1) & (mass > 0)
        bad = on_grid[node].any(1)
        stage = "grid"
        if not bool(bad.any()):
            stage = "g2p"
            bad = ~(torch.isfinite(self.velocity).all(1) & torch.isfinite(slope).all(2).all(1))
        if not bool(bad.any()):
            stage = "return map"
            bad = ~torch.isfinite(self.stress).all(2).all(1) | ~torch.isfinite(self.alpha)
        if not bool(bad.any()):
            stage, bad = "position", ~torch.isfinite(self._offset).all(1)
        point = int(bad.nonzero()[0, 0])
        shared = torch.bincount(node.reshape(-1), minlength=mass.shape[0])
        return Birth(
            stage, self.steps - 1, int(bad.sum()), point,
            bool((shared[node[point]] == 1).all()), bool((mass[node[point]] == 0).any()),
        )  # fmt: skip


def run_textbook(
    scene: Scene,
    *,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    dt: float | None = None,
    **options: Any,
) -> Run:
    """Run a scene by the textbook solver.

    Returns:
        The run; one that broke off says why in ``failed``. Impulses are not kept.

    Raises:
        ValueError: A choice that there is not.
        TypeError: An option that there is not.
    """
    variant = Variant(**options)
    solver = Textbook(scene, variant, device=device, dtype=dtype, dt=dt, cfl=0.5)
    count = scene.times.shape[0]
    x, v = np.full((count, scene.count, 3), math.nan), np.full((count, scene.count, 3), math.nan)
    intact = solver.alpha
    kept: dict[str, np.ndarray] = {"damage": np.full(x.shape[:2], math.nan)}
    if "stress" in scene.asks:
        kept["stress"] = np.full((*x.shape[:2], 6), math.nan)
    if "deformation" in scene.asks:
        kept["deformation"] = np.full((*x.shape, 3), math.nan)
    wall, failed = 0.0, ""
    for i, end in enumerate(scene.times):
        start = time.perf_counter()
        try:
            solver.run(seconds=float(end) - solver.time)
        except FloatingPointError as error:
            failed = str(error)
            break
        if solver.device.type == "cuda":
            torch.cuda.synchronize()
        wall += time.perf_counter() - start
        x[i], v[i] = solver.position.cpu().numpy(), solver.velocity.double().cpu().numpy()
        kept["damage"][i] = damage(cast(Any, solver), intact).double().cpu().numpy()
        if "stress" in kept:
            kept["stress"][i] = six(solver.stress).double().cpu().numpy()
        if solver.deformation is not None:
            kept["deformation"][i] = solver.deformation.double().cpu().numpy()
    settings = {
        "dx": scene.dx, "cfl": 0.5, "dt": dt, "dtype": str(dtype).removeprefix("torch."),
        **dataclasses.asdict(variant),
    }  # fmt: skip
    return Run(
        scene.name, "textbook", scene.times, x, v, wall, solver.steps, settings, str(device),
        failed, **kept,
    )  # fmt: skip
