"""Matter that relaxes: how far it rebounds, in both engines, resumed, and when it breaks."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.errors import InputError
from gsfluent.materials import Material
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate import debris
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene

RADIUS = 0.05
BALL = Material(
    "ball", young_modulus=1e6, poisson_ratio=0.3, density=1000.0, law="nacc", cohesion=1.0,
    hardening=10.0, alpha0=-0.1,
)  # fmt: skip
"""Too strong to break in these falls."""
SPAN = RADIUS / BALL.wave_speed


def dropped(material: Material, height: float = 0.1) -> Scene:
    scene = Scene()
    scene.add(ellipsoid((RADIUS,) * 3), material)
    scene.drop(height)
    return scene


def relaxing(share: float) -> Material:
    return BALL.override(relaxation_share=share, relaxation_time=3.0 * SPAN)


@functools.cache
def bounced(
    share: float, cells: int = 10, resident: bool = True, surface: bool | None = None
) -> tuple[list[SimulationFrame], dict[str, float]]:
    stage = Simulate(dx=2.0 * RADIUS / cells, splats=False, resident=resident, surface=surface)
    made = stage(
        dropped(relaxing(share) if share else BALL), fps=100, seconds=math.sqrt(0.2 / 9.81) + 0.06
    )
    frames, report = list(made), made.report
    assert report["verdict"] == "clean", report["reason"]
    assert report["momentum_error"] < 1e-5
    assert report["rollbacks"] == 0
    return frames, report


def rebound(frames: list[SimulationFrame]) -> float:
    """Speed after over before."""
    mass = float(frames[0].particles.mass.sum())
    up = [f.stats["momentum"][2] / mass for f in frames]
    return -max(up) / min(up)


def test_the_more_relaxes_the_less_a_ball_rebounds() -> None:
    whole, half, most = (rebound(bounced(share)[0]) for share in (0.0, 0.5, 0.75))
    assert whole > 0.75
    assert 0.5 < half < 0.85 * whole
    assert 0.3 < most < 0.85 * half


def test_the_rebound_does_not_hang_on_the_grid() -> None:
    coarse, fine = (rebound(bounced(0.75, cells)[0]) for cells in (10, 16))
    assert coarse == pytest.approx(fine, abs=0.04)


def test_both_engines_relax_the_same() -> None:
    (fast, quick), (slow, report) = (bounced(0.75, 8, flag, False) for flag in (True, False))
    assert quick["composed_steps"] == 0 and report["composed_steps"] > 0
    assert rebound(slow) == pytest.approx(rebound(fast), rel=0.02)
    for a, b in zip(fast, slow, strict=True):
        assert a.particles.viscous is not None and b.particles.viscous is not None
        apart = (a.particles.position - b.particles.position).abs().max()
        assert float(apart) < 0.02 * RADIUS, a.index


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_a_run_that_is_resumed_keeps_its_springs(tmp_path: Path, device: str) -> None:
    wanted, saved = [], tmp_path / "state.pt"
    stage = Simulate(dx=0.0125, splats=False, device=device)
    whole = stage(dropped(relaxing(0.5)), fps=100, seconds=0.17)
    for frame in whole:
        wanted.append(frame.particles)
        if frame.index == 15:
            whole.save(saved)
            assert float(frame.particles.viscous[:, :6].abs().max()) > 1e-4
    again = list(stage(dropped(relaxing(0.5)), fps=100, seconds=0.17, resume=saved))
    for got, want in zip(again, wanted[16:], strict=True):
        assert torch.equal(got.particles.position, want.position)
        assert torch.equal(got.particles.viscous, want.viscous)
    with pytest.raises(InputError, match="another scene"):
        stage(dropped(relaxing(0.6)), fps=100, seconds=0.17, resume=saved)


def test_only_what_names_it_relaxes() -> None:
    scene = Scene()
    scene.add(ellipsoid((RADIUS,) * 3), BALL, name="plain")
    assert build_matter(scene, 0.02).particles.viscous is None
    soft = relaxing(0.5).override(softening=4.0)
    scene.add(ellipsoid((RADIUS,) * 3), soft, name="soft", velocity=(0.0, 0.0, -1.0))
    matter = build_matter(scene, 0.02)
    branches = matter.particles.viscous
    assert branches is not None and matter.viscous
    first, second = matter.ranges[0][1], matter.particles.count
    assert not branches[:first].any() and not branches[:, :6].any()
    # a softened landing lasts longer by the root of the softening, and so does what relaxes in it
    wanted = torch.tensor([0.5, 1.0 / (2.0 * 3.0 * SPAN), 0.0])
    assert torch.allclose(branches[first:second, 6:], wanted.expand(second - first, 3))


def test_what_leaves_the_grid_as_powder_keeps_no_spring() -> None:
    scene = Scene()
    scene.add(ellipsoid((RADIUS,) * 3), relaxing(0.5))
    matter = build_matter(scene, 0.02)
    p = matter.particles
    strained = p.replace(
        strain=p.strain + 0.01, viscous=torch.cat([p.strain + 0.01, p.viscous[:, 6:]], dim=1)
    )
    state = State.start(matter, torch.zeros(0, 32).double(), (True,))._replace(particles=strained)
    gone = torch.arange(p.count) % 3 == 0
    after = debris.let_go(state, gone).particles
    assert not after.viscous[gone, :6].any() and bool((after.viscous[~gone, :6] == 0.01).all())
    assert torch.equal(after.viscous[:, 6:], p.viscous[:, 6:])
    alone = matter.stored(strained, state.peak)
    plain = matter.stored(strained.replace(viscous=None), state.peak)
    assert torch.allclose(alone, plain)  # the spring has the strain of the law


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_a_melon_that_relaxes_breaks_all_the_same(device: str) -> None:
    melon = materials.get("fruit.watermelon")
    wave = melon.wave_speed * melon.softening**0.5
    melon = melon.override(
        restitution=1.0, relaxation_share=0.75, relaxation_time=0.3 / wave, parts=()
    )
    scene = Scene()
    scene.add(ellipsoid((0.1,) * 3), melon)
    scene.drop(3.0)
    made = Simulate(dx=0.02, splats=False, device=device)(scene, fps=50, seconds=0.9)
    frames, report = list(made), made.report
    assert report["verdict"] == "clean", report["reason"]
    assert report["composed_steps"] == 0
    assert frames[-1].stats["damaged_fraction"] > 0.02
    assert bool(torch.isfinite(frames[-1].particles.viscous).all())


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("restitution", [0.5, 0.7])
def test_a_ball_that_lets_go_rebounds_with_its_restitution(restitution: float, device: str) -> None:
    ball = BALL.override(
        hysteresis="unloading", restitution=restitution, relaxation_time=100.0 * SPAN
    )
    stage = Simulate(dx=2.0 * RADIUS / 10, splats=False, device=device)
    made = stage(dropped(ball), fps=100, seconds=math.sqrt(0.2 / 9.81) + 0.06)
    frames, report = list(made), made.report
    assert report["verdict"] == "clean", report["reason"]
    assert report["rollbacks"] == 0 and report["composed_steps"] == 0
    assert rebound(frames) == pytest.approx(restitution, abs=0.08)


def test_what_lets_go_is_told_by_restitution_and_a_time() -> None:
    plaster = materials.plaster
    assert float(plaster.parameters()[7]) == 0.0
    wanted = [1.0 - plaster.restitution**2, -0.1 / plaster.relaxation_time, 0.0]
    assert plaster.viscosities().tolist() == pytest.approx(wanted)
    for law in ("phase_field", "elastic"):
        assert plaster.override(law=law).hysteresis == "pressed"
    for change in ({"relaxation_share": 0.5}, {"relaxation_time": None}):
        with pytest.raises(InputError, match="unloading"):
            plaster.override(**change)


def test_half_of_the_two_numbers_is_refused() -> None:
    with pytest.raises(InputError, match="go together"):
        BALL.override(relaxation_share=0.5)
    with pytest.raises(InputError, match="relaxation_time must be above 0"):
        BALL.override(relaxation_share=0.5, relaxation_time=0.0)
    with pytest.raises(InputError, match="relaxation_share must be at least 0"):
        BALL.override(relaxation_share=1.5, relaxation_time=1.0)
    sand = materials.get("sand")
    with pytest.raises(InputError, match="does nothing under law"):
        sand.override(relaxation_share=0.5, relaxation_time=1.0)


@pytest.mark.cuda
def test_on_a_gpu_it_rebounds_the_same() -> None:
    stage = Simulate(dx=2.0 * RADIUS / 8, splats=False, device="cuda")
    made = stage(dropped(relaxing(0.75)), fps=100, seconds=math.sqrt(0.2 / 9.81) + 0.06)
    frames, report = list(made), made.report
    assert report["verdict"] == "clean", report["reason"]
    assert report["composed_steps"] == 0
    assert rebound(frames) == pytest.approx(rebound(bounced(0.75, 8)[0]), rel=0.01)
