"""Broken bodies in a run: little is loose, chips and dust leave the grid, momentum stays."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate import resident
from gsfluent.pipeline.simulate.debris import RigidChips, let_go, near_matter, tumble
from gsfluent.pipeline.simulate.engine import SolverOptions
from gsfluent.pipeline.simulate.health import figures_of
from gsfluent.pipeline.simulate.run import Run
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

DX = 0.02


def dropped(height: float = 1.5) -> Scene:
    """A melon over the floor, 13 cells across, thrown down: it lands as from 1 m higher."""
    scene = Scene(floor=0.0)
    melon = materials.fruit.watermelon
    scene.add(ellipsoid((0.125, 0.105, 0.105), voxels=40), melon, velocity=(0.0, 0.0, -4.5))
    scene.drop(height)
    return scene


def test_little_of_a_dropped_melon_is_loose() -> None:
    landing = math.sqrt(2 * 1.5 / 9.81)
    simulation = Simulate(dx=DX, splats=False)(
        dropped(), fps=20, seconds=math.ceil(20 * (landing + 0.2)) / 20 + 0.05
    )
    *_, last = simulation
    report, stats = simulation.report, last.stats
    assert report["verdict"] == "clean" and report["momentum_error"] < 1e-5
    assert stats["time"] > landing + 0.2
    assert stats["broken_fraction"] > 0.2 and stats["pieces_over_1_percent"] >= 2
    assert 0.0 <= stats["loose_fraction"] < 0.03
    assert stats["loose_fraction"] == pytest.approx(last.pieces.debris_fraction, abs=1e-6)
    # Broken points have a piece now, and look broken after they were welded.
    broken = last.broken
    assert float((last.fragments[broken] >= 0).double().mean()) > 0.9
    assert bool((last.damage[broken] == 1.0).all())
    assert bool((simulation.run.state.peak[broken] < 0).any())
    blocks = report["per_frame"]["active_blocks"]
    assert blocks[0] == 0 and 0 < max(blocks) <= report["active_blocks_max"]


def test_a_run_that_breaks_goes_on_as_if_it_had_not_been_interrupted(tmp_path: Path) -> None:
    wanted: list[Any] = []
    whole = Simulate(dx=0.025)(dropped(), fps=30, seconds=0.7)
    for frame in whole:
        wanted.append(frame)
        if frame.index == 19:
            whole.save(tmp_path / "state.pt")
            assert bool(whole.run.state.cut_links.any()) and bool(whole.run.state.ever.any())
    again = Simulate(dx=0.025)(dropped(), fps=30, seconds=0.7, resume=tmp_path / "state.pt")
    for got, want in zip(again, wanted[20:], strict=True):
        for name in ("position", "velocity", "affine", "strain", "alpha", "deformation"):
            assert torch.equal(getattr(got.particles, name), getattr(want.particles, name)), name
        assert torch.equal(got.fragments, want.fragments)
        assert got.stats == want.stats


def test_a_thing_smaller_than_a_seed_stays_whole() -> None:
    scene = Scene(floor=0.0)
    scene.add(ellipsoid((0.011,) * 3), materials.get("glass"))
    scene.drop(0.01)
    *_, last = Simulate(dx=0.01, splats=False)(scene, fps=20, seconds=0.2)
    assert last.particles.count < 64
    assert last.stats["pieces"] == 1 and last.stats["loose_fraction"] == 0.0


def clusters(
    count: int = 3, size: int = 20, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Small clouds of points in motion: mass, position, velocity, affine, index."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    index = torch.arange(count).repeat_interleave(size)
    position = 0.01 * rand(count * size, 3) + rand(count, 3)[index]
    return (
        rand(count * size).abs(),
        position,
        rand(count * size, 3),
        rand(count * size, 3, 3),
        index,
    )


def moments(
    mass: Tensor, position: Tensor, velocity: Tensor, affine: Tensor, dx: float
) -> tuple[Tensor, Tensor]:
    """Linear and angular momentum of points."""
    c = affine
    skew = torch.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]])
    spin = torch.linalg.cross(position, velocity) + 0.25 * dx * dx * skew.T
    return (mass[:, None] * velocity).sum(dim=0), (mass[:, None] * spin).sum(dim=0)


def test_chips_keep_momentum_and_shape_in_flight() -> None:
    mass, position, velocity, affine, index = clusters()
    chips = RigidChips(mass, position, velocity, affine, index, DX)
    rows = torch.zeros(0, 32, dtype=torch.float64)
    now = tumble(chips, 0.013, torch.zeros(3, dtype=torch.float64), rows, None)
    before = moments(mass, position, velocity, affine, DX)
    after = moments(mass, now.position, now.velocity, now.affine, DX)
    for a, b in zip(before, after, strict=True):
        assert float((a - b).norm()) <= 1e-12 * float(a.norm())
    for k in range(3):
        mine = index == k
        assert torch.allclose(
            torch.cdist(now.position[mine], now.position[mine]),
            torch.cdist(position[mine], position[mine]), atol=1e-12,
        )  # fmt: skip
    turn = now.turn[0]
    assert torch.allclose(turn @ turn.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    # A rigid motion has the least kinetic energy of all with these momenta, and keeps it.
    energy = [0.5 * (mass * (v**2).sum(dim=1)).sum() for v in (velocity, now.velocity)]
    assert float(energy[1]) < float(energy[0])
    one, two = (
        tumble(RigidChips(mass, now.position, now.velocity, now.affine, index, DX), t,
               torch.zeros(3, dtype=torch.float64), rows, None) for t in (1e-9, 0.02)
    )  # fmt: skip
    kinetic = [
        float((mass * (x.velocity**2).sum(dim=1)).sum()
              + 0.25 * DX**2 * (mass * (x.affine**2).sum(dim=(1, 2))).sum()) for x in (one, two)
    ]  # fmt: skip
    assert kinetic[1] == pytest.approx(kinetic[0], rel=1e-4)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_chip_comes_to_rest_on_the_floor_as_it_lies(friction: float) -> None:
    mass, position, _, _, index = clusters(count=1)
    velocity = torch.tensor([[0.6, 0.0, -0.5]], dtype=torch.float64).expand_as(position)
    affine = torch.zeros(len(mass), 3, 3, dtype=torch.float64)
    position = position - position.mean(dim=0) + torch.tensor([0.0, 0.0, 0.2]).double()
    floor = ops.collider_row("plane", friction=friction)[None]
    pull = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    given, span = torch.zeros(3, dtype=torch.float64), 0.005
    for _ in range(100):
        chips = RigidChips(mass, position, velocity, affine, index, DX)
        now = tumble(chips, span, pull, floor, None)
        position, velocity, affine = now.position, now.velocity, now.affine
        given = given + now.impulse
    lowest = float(position[:, 2].min())
    assert abs(lowest) < 1e-9 and not affine.any()
    assert float(velocity[:, 2].abs().max()) < 1e-12
    assert float(velocity[:, 0].mean()) == pytest.approx(0.6 if friction == 0.0 else 0.0, abs=1e-12)
    # The balance of momentum: what the floor gave and gravity took.
    start = float(mass.sum()) * torch.tensor([0.6, 0.0, -0.5], dtype=torch.float64)
    end = (mass[:, None] * velocity).sum(dim=0)
    pulled = float(mass.sum()) * 100 * span * pull
    assert float((end - start - pulled - given).norm()) <= 1e-12 * float(pulled.norm())


def test_dust_keeps_its_momentum() -> None:
    scene = Scene(floor=None)
    scene.add(ellipsoid((0.05,) * 3), materials.fruit.apple)
    matter = build_matter(scene, DX)
    state = State.start(matter, torch.zeros(0, 32).double(), (True,))
    generator = torch.Generator().manual_seed(0)
    velocity = torch.randn(matter.particles.count, 3, generator=generator)
    state = state._replace(particles=state.particles.replace(velocity=velocity))
    gone = torch.rand(matter.particles.count, generator=generator) < 0.3
    after = let_go(state, gone)
    assert torch.equal(after.loose, gone) and after.unit[gone].eq(-1).all()
    before, now = (figures_of(matter, s, (0.0, 0.0, 0.0)) for s in (state, after))
    assert now.momentum == before.momentum and now.angular_momentum == before.angular_momentum


def test_near_is_what_lies_in_the_cubes_around() -> None:
    generator = torch.Generator().manual_seed(2)
    position = torch.rand(400, 3, generator=generator, dtype=torch.float64)
    what = torch.rand(400, generator=generator) < 0.5
    whom = ~what & (position[:, 0] < 0.4)
    near = near_matter(position, what, whom, 0.1)
    cube = torch.floor(position / 0.1)
    apart = (cube[:, None] - cube[None]).abs().amax(dim=2)
    assert torch.equal(near, what & ((apart <= 1) & whom).any(dim=1))


def test_chips_leave_the_grid_with_all_their_momentum_and_hold_no_block() -> None:
    """A corner that flies off: a rigid body without a grid, until it lies on the floor."""
    scene = Scene(floor=0.0)
    scene.add(ellipsoid((0.08,) * 3), materials.fruit.apple.override(variation=0.0))
    scene.drop(0.3)
    options = SolverOptions(free_flight=False)
    run = Run(scene, build_matter(scene, DX), 50.0, options)
    rest = run.matter.rest.double()
    away = (rest - rest[int(rest.sum(dim=1).argmax())]).norm(dim=1)
    chip = away <= torch.sort(away).values[39]
    a, b = run.links.unbind(dim=1)
    state = run.state
    shift = torch.where(chip[:, None], torch.tensor([0.3, 0.0, 0.0]).double(), 0.0)
    spin = torch.tensor([[0.0, -30.0, 0.0], [30.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    arm = rest - rest[chip].mean(dim=0)
    velocity = torch.where(chip[:, None], arm.float() @ spin.T + torch.tensor([1.0, 0, 0.5]), 0.0)
    run.state = state._replace(
        position=state.position + shift,
        particles=state.particles.replace(
            position=(state.position + shift).float(), velocity=velocity.float(),
            affine=torch.where(chip[:, None, None], spin, 0.0),
        ),
        cut_links=chip[a] != chip[b],
    )  # fmt: skip
    run.figures = run.start = run.watch.figures(run.state)
    run.watch.energy = run.start.total
    run.ledger.start = torch.tensor(run.start.momentum, dtype=torch.float64)
    before = run.start
    assert run.advance_to(1, None), run.failure
    assert torch.equal(run.state.loose, chip)
    now = run.watch.figures(run.state)
    gravity = 9.81 * 0.02 * float(state.particles.mass.double().sum())
    assert now.momentum[0] == pytest.approx(before.momentum[0], rel=1e-6)
    assert now.momentum[2] == pytest.approx(before.momentum[2] - gravity, rel=1e-5)
    for frame in range(2, 40):
        assert run.advance_to(frame, None), run.failure
        _, pieces, stats = run.record(frame)
    assert stats["momentum_error"] < 1e-5 and torch.equal(run.state.loose, chip)
    low = run.state.position[chip, 2].min()
    assert abs(float(low)) < 1e-3
    assert float(run.state.particles.velocity[chip].norm(dim=1).max()) < 0.05
    assert pieces.count == 1 and pieces.labels[chip].eq(-1).all()
    apart = [(x[chip][:, None] - x[chip][None]).norm(dim=2) for x in (run.state.position, rest)]
    assert float((apart[0] - apart[1]).abs().max()) < 1e-6


def test_pieces_are_looked_for_as_often_as_anything_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stiff matter takes many steps in which nothing gets anywhere."""
    scene = Scene(floor=0.0)
    stiff = dataclasses.replace(materials.fruit.watermelon, young_modulus=2e8)
    scene.add(ellipsoid((0.06,) * 3), stiff)
    scene.drop(0.2)
    scene.throw((0.0, 0.0, -12.0))
    run = Simulate(dx=DX, splats=False).run_of(scene, fps=10)
    whole, looks = run._regroup, []

    def counted(state: State, *, at_frame: bool = True) -> State:
        if not at_frame:
            looks.append((state.time, float(state.particles.velocity.norm(dim=1).max())))
        return whole(state, at_frame=at_frame)

    monkeypatch.setattr(run, "_regroup", counted)
    assert all(run.advance_to(frame, None) for frame in range(2))
    assert len(looks) > 5 and run.state.step > 100 * len(looks)
    for (before, _), (now, fastest) in itertools.pairwise(looks):
        assert fastest * (now - before) >= 0.25 * DX


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_a_melon_breaks_into_the_same_pieces_on_several_ranks_and_threads(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[Any] = []
    used: set[int] = set()
    counted = ops.Solver.counters

    def counters(solver: ops.Solver) -> dict[str, float]:
        used.add(solver.ranks)
        return counted(solver)

    monkeypatch.setattr(ops.Solver, "counters", counters)
    before = torch.get_num_threads()
    for ranks, threads in ((1, 1), (3, 2 if device == "cpu" else 1)):
        monkeypatch.setitem(ops.Solver.__init__.__kwdefaults__, "ranks", ranks)
        torch.set_num_threads(threads)
        stage = Simulate(dx=DX, splats=False, device=device)
        try:
            *_, last = stage(dropped(), fps=20, seconds=0.75)
        finally:
            torch.set_num_threads(before)
        ends.append(last)
    one, other = ends
    assert used == {1, 3} and one.stats["pieces"] > 1 and one.stats["broken_fraction"] > 0.1
    for name in ("position", "velocity", "strain", "alpha"):
        assert torch.equal(getattr(other.particles, name), getattr(one.particles, name)), name
    assert torch.equal(other.fragments, one.fragments)
    assert other.stats == one.stats


@pytest.mark.cuda
def test_all_devices_give_the_frames_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    if torch.cuda.device_count() < 2:
        pytest.skip(f"needs two GPUs of one host, this one has {torch.cuda.device_count()}")
    monkeypatch.setattr(resident, "WORTH_DEVICES", 1)
    ends = []
    for every in (False, True):
        options = SolverOptions(all_devices=every)
        stage = Simulate(dx=DX, splats=False, device="cuda", options=options)
        *_, last = stage(dropped(), fps=20, seconds=0.75)
        ends.append(last)
    one, several = ends
    assert one.stats["pieces"] > 1 and several.stats == one.stats
    assert torch.equal(several.particles.position, one.particles.position)
