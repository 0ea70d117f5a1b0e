"""The verdict on a run: each law broken at a known step by a made-up run, and real runs."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.invariants import (
    Limits,
    OfWorld,
    State,
    Violation,
    check,
    first_violation,
    observe,
)
from gsfluent.lab.world.shapes import ball, box, parameters, wave_speed
from gsfluent.lab.world.walls import wall

REST = State(
    step=0, time=0.0, finite=True, kinetic=2.0, elastic=1.0, momentum=((1.0, 0.0, 0.0),),
    moment=((0.0, 0.0, 0.0),), volume=(1.0, 1.0), given=((0.0, 0.0, 0.0),), work=0.0, mass=(4.0,),
)  # fmt: skip
SCALE = math.sqrt(2.0 * 4.0 * 3.0)
DX = 0.1
POINT = (0.5 * DX) ** 3
ROW = parameters(1e5, 0.3, 1000.0)
C = wave_speed(ROW)


class Staged:
    """A run whose state is made up: ``change`` applies from step ``at`` to ``until``."""

    def __init__(self, at: int, until: int = 10**9, **change: object) -> None:
        self.at, self.until, self.change, self.step = at, until, change, 0
        self.advanced = 0

    def advance(self, steps: int) -> None:
        self.step += steps
        self.advanced += steps
        if self.change.get("raises") and self.step >= self.at:
            raise FloatingPointError("solver: a point moved further than a cell\n  hint: lower dt")

    def look(self) -> State:
        now = dataclasses.replace(REST, step=self.step, time=0.1 * self.step)
        if self.at <= self.step < self.until and "raises" not in self.change:
            now = dataclasses.replace(now, **self.change)  # type: ignore[arg-type]
        return now

    def save(self) -> int:
        return self.step

    def load(self, saved: int) -> None:
        self.step = saved


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("finite", {"finite": False}),
        ("finite", {"reset": 1}),
        ("energy", {"kinetic": 2.0 + 0.05 * 3.0 + 1e-4}),
        ("energy", {"elastic": math.nan}),
        ("momentum", {"momentum": ((1.0, 1.01e-5 * SCALE, 0.0),)}),
        ("volume", {"volume": (0.049, 1.0)}),
        ("volume", {"volume": (1.0, 20.1)}),
        ("volume", {"pulled_back": 3}),
        ("stopped", {"raises": True}),
    ],
)
@pytest.mark.parametrize("at", [1, 7, 8, 9, 61])
def test_each_kind_is_found_at_its_step(kind: str, change: dict[str, object], at: int) -> None:
    run = Staged(at, **change)
    found = first_violation(run, 100, every=8)
    assert found is not None and (found.step, found.kind) == (at, kind)
    assert run.advanced <= at + 8 + 3 * 8  # few steps are done twice


def test_what_is_allowed_is_no_violation() -> None:
    fine = dataclasses.replace(
        REST, kinetic=2.0 + 0.05 * 3.0, momentum=((1.0, 0.99e-5 * SCALE, 0.0),),
        volume=(0.0501, 19.9),
    )  # fmt: skip
    assert check(REST, fine) is None
    assert first_violation(Staged(101, finite=False), 100, every=8) is None
    assert first_violation(Staged(100, finite=False), 100, every=8) is not None


def test_gravity_and_colliders_are_no_violation_and_are_no_excuse() -> None:
    given = dataclasses.replace(
        REST, momentum=((1.0, 0.0, -3.0),), given=((0.0, 0.0, -3.0),), kinetic=6.0, work=4.0
    )
    assert check(REST, given) is None
    less = dataclasses.replace(given, work=3.8)
    assert (bad := check(REST, less)) is not None and bad.kind == "energy"
    other = dataclasses.replace(given, given=((0.0, 0.0, -2.999),))
    assert (bad := check(REST, other)) is not None and bad.kind == "momentum"


def test_limits_can_be_chosen_and_a_lag_is_looked_at_when_asked() -> None:
    now = dataclasses.replace(REST, time=2.0, moment=((1.8, 0.0, 0.0),))  # 2.0 would be right
    assert check(REST, now) is None
    bad = check(REST, now, Limits(path=0.05))
    assert bad is not None and bad.kind == "path" and bad.value == pytest.approx(0.1)
    assert check(REST, now, Limits(path=0.11)) is None


def test_sums_in_another_order_are_no_path() -> None:
    # two looks at one state, on a GPU: nothing has moved, and the last digits differ
    far = dataclasses.replace(REST, moment=((2.5e5, 1.0, 1.0),) * len(REST.moment))
    again = dataclasses.replace(far, moment=((2.5e5 * (1 + 4e-16), 1.0, 1.0),) * len(REST.moment))
    assert far.moment != again.moment
    assert check(far, again, Limits(path=0.05)) is None
    off = dataclasses.replace(far, moment=((2.5e5 + 1e-6, 1.0, 1.0),) * len(REST.moment))
    assert check(far, off, Limits(path=0.05)) is not None
    hot = dataclasses.replace(REST, kinetic=2.1)
    assert check(REST, hot) is None and check(REST, hot, Limits(energy=1.01)) is not None


def test_groups_keep_their_momentum_each() -> None:
    x = torch.zeros(2, 3, dtype=torch.float64)
    common = {
        "time": 0.0, "dx": DX, "position": x, "affine": torch.zeros(2, 3, 3), "mass": torch.ones(2),
        "volume": torch.ones(2), "law": torch.zeros(1, dtype=torch.int32), "params": ROW[None],
        "strain": torch.zeros(2, 6),
    }  # fmt: skip
    apart = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    first, then = {}, {}
    for name, group in (("one", None), ("two", torch.tensor([0, 1]))):
        first[name] = observe(step=0, velocity=apart, group=group, **common)
        then[name] = observe(step=1, velocity=0.9 * apart, group=group, **common)
    assert check(first["one"], then["one"]) is None
    assert (bad := check(first["two"], then["two"])) is not None and bad.kind == "momentum"
    with pytest.raises(ValueError, match="group"):
        observe(
            step=0, velocity=apart, group=torch.tensor([0, 1]), impulse=torch.ones(1, 3), **common
        )


def test_strain_and_deformation_give_the_same_sums() -> None:
    f = torch.eye(3, dtype=torch.float64) + 0.3 * torch.rand(5, 3, 3, dtype=torch.float64)
    b = f @ f.mT - torch.eye(3, dtype=torch.float64)
    strain = torch.stack([b[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    common = {
        "step": 0, "time": 0.0, "dx": DX, "position": torch.zeros(5, 3),
        "velocity": torch.ones(5, 3), "affine": torch.zeros(5, 3, 3), "mass": torch.ones(5),
        "volume": torch.ones(5), "law": torch.zeros(1, dtype=torch.int32), "params": ROW[None],
    }  # fmt: skip
    one = observe(deformation=f, **common)  # type: ignore[arg-type]
    other = observe(strain=strain.T, **common)  # type: ignore[arg-type]
    assert one.kinetic == pytest.approx(7.5) and one.elastic == pytest.approx(other.elastic)
    assert one.volume == pytest.approx(other.volume)
    assert one.elastic > 0.0
    with pytest.raises(ValueError, match="either"):
        observe(**common)  # type: ignore[arg-type]


def cube(**options: object) -> World:
    points = box([0.0, 0.0, 0.0], [0.3, 0.3, 0.3], 0.5 * DX)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(points.shape, dtype=torch.float64, generator=generator)
    return World(
        points,
        1e-3 * C * noise,
        mass=1000.0 * POINT,
        volume=POINT,
        dx=DX,
        law=0,
        params=ROW,
        **options,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("engine", ["solver", "ops"])
def test_a_real_blow_up_is_found_at_the_same_step_however_often_it_is_looked_at(
    engine: str,
) -> None:
    found = [
        first_violation(OfWorld(cube(dt=1.5 * DX / C, engine=engine)), 100, every=every)
        for every in (1, 8, 13)
    ]
    assert found[0] is not None and found[0].kind == "energy" and 2 < found[0].step < 60
    assert {(v.step, v.kind) for v in found if v is not None} == {(found[0].step, "energy")}
    assert first_violation(OfWorld(cube(dt=0.5 * DX / C, engine=engine)), 60) is None


def test_a_ball_that_falls_and_bounces_is_within_the_laws() -> None:
    floor = wall(2, mode="separate", friction=0.3)[None]
    world = World(
        ball([0.0, 0.0, 0.28], 0.2, 0.5 * DX), [0.2 * C, 0.0, -0.1 * C], mass=1000.0 * POINT,
        volume=POINT, dx=DX, law=0, params=ROW, colliders=floor, gravity=(0.0, 0.0, -9.81),
        dtype=torch.float32,
    )  # fmt: skip
    seen: list[State] = []
    assert first_violation(OfWorld(world), 120, seen=seen.append) is None
    pushed = float(world.impulse[0, 2])
    assert pushed > 0.1 * C * seen[-1].mass[0]  # the floor did push
    weight = -9.81 * seen[-1].mass[0] * world.time
    assert seen[-1].given[0][2] == pytest.approx(pushed + weight)
    assert len(seen) == 15


def test_a_crushed_ball_breaks_the_range_of_j() -> None:
    row = parameters(1e3, 0.3, 1000.0)
    floor = wall(2, mode="separate")[None]
    world = World(
        ball([0.0, 0.0, 0.3], 0.25, 0.5 * DX), [0.0, 0.0, -3.0 * wave_speed(row)],
        mass=1000.0 * POINT, volume=POINT, dx=DX, law=0, params=row, colliders=floor,
        dtype=torch.float32,
    )  # fmt: skip
    found = first_violation(OfWorld(world), 100)
    assert isinstance(found, Violation) and found.kind == "volume" and found.value <= 0.05


def test_matter_at_rest_has_no_scale_to_divide_by() -> None:
    rest = dataclasses.replace(REST, kinetic=0.0, elastic=0.0, momentum=((0.0, 0.0, 0.0),))
    moved = dataclasses.replace(rest, step=1, kinetic=1e-30)
    assert check(rest, rest) is None
    assert check(rest, moved) == Violation(1, "energy", math.inf, 1.0)
    pushed = dataclasses.replace(rest, step=1, momentum=((1e-30, 0.0, 0.0),))
    assert check(rest, pushed) == Violation(1, "momentum", math.inf, Limits().momentum)
