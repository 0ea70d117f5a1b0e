"""Matter that leaves the grid takes its momentum along, exactly, and brings it back."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.matter.points import Matter, build_matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.flight import Flight
from gsfluent.pipeline.simulate.groups import CALM_FRAMES, Leaving
from gsfluent.pipeline.simulate.health import Figures, figures_of
from gsfluent.pipeline.simulate.step import Stepper
from gsfluent.scene.scene import Scene

SOFT = materials.elastic.override(young_modulus=2e4)
GRAVITY = (0.5, 0.0, -9.81)
DX = 0.02
PULL = torch.tensor(GRAVITY, dtype=torch.float64)


def matter_of(scene: Scene) -> Matter:
    """Material points in float64."""
    matter = build_matter(scene, DX)
    return dataclasses.replace(
        matter,
        particles=matter.particles.to(dtype=torch.float64),
        params=matter.params.double(),
    )


def one_ball(height: float) -> Scene:
    scene = Scene(gravity=GRAVITY)
    place = Frame(torch.eye(3), torch.tensor([0.3, -0.2, height]), 1.0)
    scene.add(ellipsoid((0.06, 0.05, 0.04)), SOFT, frame=place)
    return scene


def moving(scene: Scene, matter: Matter, noise: float) -> State:
    """A state on the grid in which the points move, turn, and shake against each other."""
    generator = torch.Generator().manual_seed(1)
    p = matter.particles
    arm = p.position - p.position.mean(dim=0)
    spin = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    shake = torch.randn(p.count, 3, generator=generator, dtype=torch.float64)
    turn = torch.linalg.cross(spin.expand_as(arm), arm)
    cross = torch.linalg.cross(spin.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    affine = cross + 10 * noise * torch.randn(p.count, 3, 3, generator=generator).double()
    velocity = torch.tensor([1.0, 0.5, 3.0]) + turn + noise * shake
    state = State.start(matter, RigidSet(scene, DX).start, (True,))
    return state._replace(particles=p.replace(velocity=velocity, affine=affine))


def wide(values: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def momenta(figures: Figures) -> torch.Tensor:
    return wide((*figures.momentum, *figures.angular_momentum))


def test_a_piece_that_takes_off_keeps_both_momenta() -> None:
    scene = one_ball(1.0)
    matter = matter_of(scene)
    state = moving(scene, matter, 0.02)
    leaving = Leaving(matter, RigidSet(scene, DX), PULL, sleep=True, fly=True)
    after = leaving(state, torch.zeros_like(matter.particles.body).long(), 0.02)
    assert leaving.flights == 1 and bool((after.group >= 0).all()) and not bool(after.asleep.any())
    assert not torch.equal(after.particles.velocity, state.particles.velocity)
    before, then = (figures_of(matter, s, GRAVITY) for s in (state, after))
    size = momenta(before).norm()
    assert float((momenta(then) - momenta(before)).norm()) < 1e-12 * float(size)
    # The energy of the shaking is not lost from sight.
    lost = before.kinetic - then.kinetic
    assert lost > 0 and float(after.dissipated) == pytest.approx(lost, rel=1e-9)


def test_a_piece_that_shakes_too_much_stays_on_the_grid() -> None:
    scene = one_ball(1.0)
    matter = matter_of(scene)
    leaving = Leaving(matter, RigidSet(scene, DX), PULL, sleep=True, fly=True)
    state = moving(scene, matter, 1.0)
    assert leaving(state, torch.zeros_like(matter.particles.body).long(), 0.02) is state


def test_flight_keeps_angular_momentum_and_gains_what_gravity_gives() -> None:
    scene = one_ball(1.0)
    matter = matter_of(scene)
    state = moving(scene, matter, 0.0)
    p, pull = matter.particles, PULL
    flight = Flight(state.particles, state.position, pull, 0.0, DX, rigid=False)
    start = figures_of(matter, state, GRAVITY)
    mass = float(p.mass.sum())
    for time in (0.0, 0.013, 0.4):
        points, place = flight.state_at(time)
        now = figures_of(matter, state._replace(particles=points, position=place), GRAVITY)
        wanted = wide(start.momentum) + mass * time * pull
        assert float((wide(now.momentum) - wanted).norm()) < 1e-12 * mass * 10
        # About the centre of mass nothing acts.
        center, velocity = flight.center_at(time)
        own = wide(now.angular_momentum)
        own = own - mass * torch.linalg.cross(center, velocity)
        assert float((own - flight.momentum).norm()) < 1e-12 * float(flight.momentum.norm())
        speed = points.velocity.norm(dim=1).max()
        assert float(speed) <= flight.speed_at(time) * (1 + 1e-12)
        assert now.total == pytest.approx(start.total, rel=2e-5)  # midpoint rule on the rotation


def test_what_falls_asleep_gives_its_rest_of_momentum_to_the_floor() -> None:
    scene = one_ball(0.04)
    matter = matter_of(scene)
    state = moving(scene, matter, 1e-4)
    p = state.particles
    state = state._replace(
        particles=p.replace(velocity=1e-3 * p.velocity, affine=1e-3 * p.affine),
        calm=torch.full_like(state.calm, CALM_FRAMES),
    )
    leaving = Leaving(matter, RigidSet(scene, DX), PULL, sleep=True, fly=True)
    after = leaving(state, torch.zeros_like(p.body).long(), 0.02)
    assert leaving.naps == 1 and bool(after.asleep.all())
    before, then = (figures_of(matter, s, GRAVITY) for s in (state, after))
    given = wide(before.momentum) - wide(then.momentum)
    taken = state.impulse - after.impulse
    assert float((given - taken).norm()) < 1e-12 * float(given.norm()) and given.norm() > 0
    assert float(after.dissipated) == pytest.approx(before.kinetic - then.kinetic, rel=1e-12)


def test_a_step_without_the_grid_balances_momentum() -> None:
    """Asleep: the floor carries the weight. In flight: gravity acts on all of the mass."""
    for height, asleep in ((0.04, True), (1.0, False)):
        scene = one_ball(height)
        matter = matter_of(scene)
        stepper = Stepper(scene, matter)
        state = moving(scene, matter, 0.0)
        state = state._replace(group=torch.zeros_like(state.group))
        if asleep:
            state = stepper.leaving._lay_down(state, torch.arange(matter.particles.count))
        before = figures_of(matter, state, GRAVITY)
        later = stepper.advance(state, 0.01, 64)
        assert later.time == 0.01 and later.step == 0
        now = figures_of(matter, later, GRAVITY)
        mass = float(matter.particles.mass.sum())
        gained = wide(now.momentum) - wide(before.momentum)
        wanted = later.impulse - state.impulse + mass * 0.01 * PULL
        assert float((gained - wanted).norm()) < 1e-12 * mass * 10.0
