"""Model no more than a scene needs: each thing that is left out, on and off, changes nothing."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from simulation_scenes import SOFT, at, near_miss, resting
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.ops.reference import plasticity
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene

APPLE = materials.fruit.apple.override(
    tensile_strength=4e4, compressive_strength=4e5, fracture_energy=20.0, restitution=1.0
)
DX = 0.02


class Ran:
    """A finished, clean run."""

    def __init__(
        self, scene: Scene, *, fps: float, seconds: float, dx: float = DX, **options: Any
    ) -> None:
        simulation = Simulate(dx=dx, splats=False, **options)(scene, fps=fps, seconds=seconds)
        self.frames: list[SimulationFrame] = list(simulation)
        self.report = simulation.report
        self.skipped: dict[str, float] = self.report["skipped"]
        assert self.report["verdict"] == "clean", self.report["reason"]
        assert self.report["momentum_error"] < 1e-5


def assert_same(
    on: Ran, off: Ran, *, place: float, energy: float, momentum: float = 1e-4, dx: float = DX
) -> None:
    """Same pieces, damage, momenta and energies in every frame, and points in the same places.

    ``place`` is in cells; ``momentum`` and ``energy`` are relative to the largest of the run, and
    to a fall through one cell.
    """
    assert len(on.frames) == len(off.frames) > 1
    size = {name: max(abs(f.energy[name]) for f in off.frames) for name in ("kinetic", "elastic")}
    lifted = abs(off.frames[0].energy["gravity"]) > 0.0
    mass = float(off.frames[0].particles.mass.sum())
    scale = max(*size.values(), 9.81 * mass * dx if lifted else 0.0)
    push = max(float(torch.tensor(f.stats["momentum"]).norm()) for f in off.frames)
    push = max(push, (2.0 * mass * scale) ** 0.5)
    for a, b in zip(on.frames, off.frames, strict=True):
        assert torch.equal(a.fragments, b.fragments)
        assert float((a.damage - b.damage).abs().mean()) < 10 * energy
        apart = (a.particles.position - b.particles.position).abs().max()
        assert float(apart) <= place * dx, (a.index, float(apart) / dx)
        for name in ("kinetic", "elastic"):
            assert abs(a.energy[name] - b.energy[name]) <= energy * scale, (a.index, name)
        for name in ("momentum", "angular_momentum"):
            gap = torch.tensor(a.stats[name]) - torch.tensor(b.stats[name])
            assert float(gap.norm()) <= momentum * push, (a.index, name, float(gap.norm()), push)


def landing(material: materials.Material, speed: float = 3.0) -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), material, velocity=(0.3, 0, -speed))
    scene.drop(0.02)
    return scene


# --- the early way out of the return map ---


def test_points_inside_the_yield_surface_leave_the_return_map_early(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Off: every point takes the whole way through the return map of the reference, in float64."""
    on = Ran(landing(APPLE, 8.0), fps=200, seconds=0.015, resident=False)
    compiled = ops.return_mapping

    def whole_way(
        strain: Tensor, alpha: Tensor, increment: Tensor, *, law: Tensor, params: Tensor,
        material: Tensor | None = None, dt: float = 0.0,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        if strain.dtype == torch.float64:  # no step of the run: the paths of the crack band
            return compiled(strain, alpha, increment, law=law, params=params)
        wide = (v.double() for v in (strain, alpha, increment))
        *state, info = plasticity.return_mapping(
            *wide, law=law, params=params.double(), material=material, dt=dt
        )
        info = info.clone()
        info[0] = strain.shape[0]  # none left early
        return *(v.to(strain) for v in state), info  # type: ignore[return-value]

    monkeypatch.setattr(ops, "return_mapping", whole_way)
    off = Ran(landing(APPLE, 8.0), fps=200, seconds=0.015, resident=False)
    assert off.skipped["elastic_only_fraction"] == 0.0 < on.skipped["elastic_only_fraction"] < 1.0
    assert on.frames[-1].stats["damaged_fraction"] > 0.01
    assert_same(on, off, place=2e-3, energy=1e-3)


# --- contact ---


def meeting() -> Scene:
    """Two balls that meet, and a third one that lies far from both."""
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(-0.14, 0, 0.05), velocity=(2.0, 0, 0))
    scene.add(ellipsoid((0.05,) * 3), SOFT, frame=at(0.09, 0.01, 0.05))
    scene.add(ellipsoid((0.04,) * 3), SOFT, frame=at(0.5, 0, 0.04))
    return scene


@pytest.mark.parametrize("resident", [True, False])
def test_contact_is_looked_for_only_where_bodies_are_near(resident: bool) -> None:
    more = {"free_flight": False, "surface": False}  # the composed operators know nodes alone
    on = Ran(meeting(), fps=40, seconds=0.1, resident=resident, **more)
    off = Ran(meeting(), fps=40, seconds=0.1, contact_proximity=False, **more)
    assert on.report["contact_nodes"] > 0 and off.report["contact_nodes"] > 0
    assert on.skipped["contact_block_fraction"] > 0.0 == off.skipped["contact_block_fraction"]
    assert on.skipped["contact_steps"] > 0 == off.skipped["contact_steps"]
    # Two engines take steps of different lengths; one engine the same.
    assert_same(on, off, place=0.02 if resident else 1e-4, energy=0.02 if resident else 1e-5,
                momentum=0.01 if resident else 1e-5)  # fmt: skip


# --- kernels ---


@pytest.mark.parametrize("material", [SOFT, APPLE])
def test_kernels_for_fewer_laws_do_the_same(material: materials.Material) -> None:
    on, off = (
        Ran(landing(material), fps=200, seconds=0.04, law_kernels=flag) for flag in (True, False)
    )
    assert on.skipped["law_kernel_steps"] == on.report["substeps"] > 0
    assert off.skipped["law_kernel_steps"] == 0 < off.report["substeps"]
    assert_same(on, off, place=1e-3, energy=1e-4)


# --- flight ---


def tossed() -> Scene:
    scene = Scene()
    for x in (-0.2, 0.2):
        scene.add(
            ellipsoid((0.05, 0.04, 0.04)), SOFT, frame=at(x, 0, 0.4), velocity=(-2 * x, 0.2, 0.5),
            angular_velocity=(0.0, 3.0, 1.0),
        )  # fmt: skip
    return scene


def test_bodies_in_their_first_flight_need_no_grid() -> None:
    on, off = (
        Ran(tossed(), fps=20, seconds=0.25, free_flight=flag, dx=DX) for flag in (True, False)
    )
    assert on.skipped["free_flight_seconds"] == pytest.approx(0.2)
    assert off.skipped["free_flight_seconds"] == off.skipped["free_flight_body_steps"] == 0
    assert on.report["substeps"] == 0 < off.report["substeps"]
    # Symplectic Euler falls g t dt / 2 below the parabola: up to a fifth of a cell here.
    bias = 0.5 * 9.81 * 0.2 * off.report["dt_max"]
    assert_same(on, off, place=1.1 * bias / DX + 0.02, energy=0.01, momentum=0.01)


def test_pieces_that_touch_nothing_any_more_fly_again() -> None:
    on, off = (Ran(near_miss(), fps=40, seconds=0.3, piece_flight=flag) for flag in (True, False))
    assert on.report["pieces_flown"] == 2 and on.skipped["piece_flight_fraction"] > 0.2
    assert off.report["pieces_flown"] == 0 == off.skipped["piece_flight_fraction"]
    assert 0 < on.report["substeps"] < off.report["substeps"]
    assert on.report["contact_nodes"] == off.report["contact_nodes"] == 0
    assert_same(on, off, place=0.02, energy=5e-3, momentum=2e-3)


# --- rest ---


def test_what_rests_sleeps() -> None:
    on, off = (
        Ran(resting(False), fps=10, seconds=2.0, sleep=flag, dx=DX) for flag in (True, False)
    )
    assert on.report["naps"] == 1 and on.skipped["sleeping_fraction"] > 0.1
    assert off.report["naps"] == 0 == off.skipped["sleeping_fraction"]
    assert on.report["substeps"] < 0.9 * off.report["substeps"]
    weight = float(on.frames[0].particles.mass.sum()) * 9.81
    assert on.report["frozen_motion"] < 0.01 * weight * DX  # no more than lifts it by that
    assert_same(on, off, place=0.03, energy=0.01, momentum=0.05)


def test_what_sleeps_wakes_when_something_comes() -> None:
    on, off = (Ran(resting(True), fps=10, seconds=2.0, sleep=flag) for flag in (True, False))
    assert on.report["naps"] >= 1 and on.report["wakes"] >= 1 and off.report["wakes"] == 0
    lower = on.frames[0].particles.body == 0
    pushed = on.frames[-1].particles.velocity[lower].norm(dim=1).mean()
    assert float(pushed) > 0.1  # it felt the blow
    assert_same(on, off, place=0.25, energy=0.02, momentum=0.02)


# --- blocks ---


sparse_blocks = ops.build_blocks


def everywhere(position: Tensor, dx: float, **options: Any) -> ops.Blocks:
    """Blocks for the whole bounding box: what a dense grid would store."""
    sparse = sparse_blocks(position, dx, **options)
    size = sparse.table.shape
    table = torch.arange(sparse.table.numel(), dtype=torch.int32).view(size)
    coords = torch.cartesian_prod(*[torch.arange(n, dtype=torch.int32) for n in size])
    coords = coords + torch.tensor(sparse.origin, dtype=torch.int32)
    counts = torch.zeros(table.numel(), dtype=torch.int32)
    counts[sparse.table.flatten() >= 0] = sparse.start.diff()
    start = torch.nn.functional.pad(torch.cumsum(counts, 0), (1, 0)).to(torch.int32)
    return sparse._replace(table=table, coords=coords, start=start)


def test_no_block_is_stored_without_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {"fps": 40, "seconds": 0.1, "free_flight": False}
    fast, on = Ran(meeting(), **given), Ran(meeting(), **given, resident=False)
    monkeypatch.setattr(ops, "build_blocks", everywhere)
    off = Ran(meeting(), **given, resident=False)
    for ran in (fast, on):
        assert ran.skipped["empty_block_fraction"] > 0.2
        assert ran.report["active_blocks_max"] < off.report["active_blocks_max"]
    assert off.skipped["empty_block_fraction"] == 0.0
    assert_same(on, off, place=1e-6, energy=1e-9, momentum=1e-9)
