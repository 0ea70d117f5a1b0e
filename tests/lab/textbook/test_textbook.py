"""The textbook solver against gsfluent's in the common special case, and its own invariants."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.fracturebench.registry import find
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.frozen.answer import run_case
from gsfluent.lab.textbook.laws import Elastic, measure
from gsfluent.lab.textbook.nacc import MAPS, Nacc, return_map
from gsfluent.lab.textbook.solver import Textbook, Variant, run_textbook
from gsfluent.lab.world.shapes import ball

DX = 1.0 / 32.0
DOUBLE = torch.float64
# the solid of failures.md row 8: it breaks on the floor
FLESH: dict[str, Any] = {
    "law": "nacc", "young_modulus": 166.0, "poisson_ratio": 0.38, "density": 1.0,
    "friction": 1.85, "cohesion": 0.6, "hardening": 3.0, "alpha": -0.04,
}  # fmt: skip
ROCK: dict[str, Any] = {
    "law": "elastic", "young_modulus": 166.0, "poisson_ratio": 0.38, "density": 1.0
}  # fmt: skip


def drop(material: dict[str, Any], kind: str = "separate", *, radius: float = 0.1) -> Scene:
    """A ball that reaches a floor within its 40 steps."""
    points = ball([0.513, 0.504, 3.1 * DX + radius], radius, 0.5 * DX).numpy()
    n = points.shape[0]
    velocity = np.tile([0.5, 0.0, -6.0], (n, 1))
    return Scene(
        "drop", DX, points, velocity, np.full(n, DX**3 / 8), np.zeros(n, np.int32),
        np.zeros(n, np.int32), np.zeros((n, 3, 3)), np.array([0.01, 0.02]), (material,),
        gravity=(0.0, 0.0, -9.81),
        colliders=({"point": [0, 0, 3 * DX], "normal": [0, 0, 1.0], "kind": kind,
                    "friction": 0.3},),
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["separate", "sticky", "slip"])
def test_it_is_gsfluent_in_the_common_special_case(kind: str) -> None:
    """APIC, e = b - I, neo-Hookean, float64: two programs, one motion."""
    scene = drop(ROCK, kind)
    ours = run_case(scene, dtype=DOUBLE, dt=5e-4, engine="ops")
    for local in (False, True):
        its = run_textbook(scene, storage="strain", dtype=DOUBLE, dt=5e-4, local_positions=local)
        assert its.steps == ours.steps
        assert np.abs(ours.v[-1] - scene.v).max() > 3.0  # it did hit the floor
        assert np.abs(its.x - ours.x).max() / DX < 1e-10
        assert np.abs(its.v - ours.v).max() / 6.0 < 1e-10


def test_f_and_strain_are_the_same_state() -> None:
    scene = drop(ROCK)
    runs = [
        run_textbook(scene, storage=s, dtype=DOUBLE, dt=5e-4, law=law)  # type: ignore[arg-type]
        for law in ("neo_hookean", "corotated")
        for s in ("F", "strain")
    ]
    for a, b in ((0, 1), (2, 3)):
        assert np.abs(runs[a].x - runs[b].x).max() / DX < 1e-10
    assert np.abs(runs[0].x - runs[2].x).max() / DX > 1e-4  # two laws are two motions


def test_a_breaking_ball_moves_as_gsfluents_does() -> None:
    """The dynamic centre with implicit alpha, written twice: the same motion to rounding."""
    scene = drop(FLESH)
    ours = run_case(scene, dtype=DOUBLE, dt=4e-4, engine="ops", irreversible=False)
    its = run_textbook(
        scene, storage="strain", return_map="dynamic_implicit", dtype=DOUBLE, dt=4e-4
    )
    broken = its.damage
    assert broken is not None and broken[-1].mean() > 0.3
    assert np.abs(its.x - ours.x).max() / DX < 1e-10


def trials(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random trial strains of up to 20 %, alphas, and params."""
    made = torch.Generator().manual_seed(7)
    f = torch.eye(3, dtype=DOUBLE) + 0.2 * (torch.rand(count, 3, 3, generator=made).double() - 0.5)
    e = f @ f.mT - torch.eye(3, dtype=DOUBLE)
    alpha = -0.08 * torch.rand(count, generator=made).double()
    params = torch.zeros(count, 8, dtype=DOUBLE)
    params[:, 0], params[:, 1], params[:, 2] = 60.0, 230.0, 1.85
    params[:, 3] = 0.1 + 2.0 * torch.rand(count, generator=made).double()
    params[:, 4], params[:, 6] = 3.0, 1.0
    return e, alpha, params


@pytest.mark.parametrize("implicit", [True, False])
def test_the_dynamic_centre_is_that_of_the_op(implicit: bool) -> None:
    e, alpha, params = trials(4000)
    six = e.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]].contiguous()
    strain, after, _, info = ops.return_mapping(
        six, alpha, torch.zeros_like(e), law=torch.ones(len(alpha), dtype=torch.int32),
        params=params, epsilon=0.1 if implicit else 0.0, implicit=implicit,
    )  # fmt: skip
    nacc = Nacc(*params[:, :5].unbind(1))
    kind = "dynamic_implicit" if implicit else "dynamic_explicit"
    own, alpha_own, plastic = return_map(kind, nacc, measure(e, "strain"), alpha)
    assert 0.3 < float(plastic.double().mean()) < 0.99 and int(info[0]) == int(plastic.sum())
    apart = (own.reshape(-1, 9)[:, [0, 4, 8, 1, 2, 5]] - strain).abs().amax(1)
    apart = torch.maximum(apart, (alpha_own - after).abs())
    assert float(apart.max()) < 1e-11


def on_the_surface(nacc: Nacc, m: Elastic, alpha: Tensor) -> Tensor:
    p = -0.5 * nacc.kappa * m.j2m1
    mean = m.e.diagonal(dim1=1, dim2=2).mean(1)
    dev = m.e - mean[:, None, None] * torch.eye(3, dtype=DOUBLE)
    q = 1.5**0.5 * nacc.mu * m.j ** (-2 / 3) * dev.norm(dim=(1, 2))
    p0 = nacc.kappa * (1e-5 + torch.sinh(3.0 * (-alpha).clamp(min=0)))
    y = q**2 * (1 + 2 * nacc.cohesion)
    return y + nacc.friction**2 * (p + nacc.cohesion * p0) * (p - p0)


def test_the_fixed_centre_keeps_the_trace_and_jumps_at_the_tips() -> None:
    """Tip jumps of users.md 6.3: beta 5, q = 3 p0: -0.199 at p0, +0.092 at -beta p0."""
    kappa, mu = 2778.0, 2000.0 / 2.76
    alpha = torch.full((2,), -0.04, dtype=DOUBLE)
    p0 = kappa * (1e-5 + float(torch.sinh(torch.tensor(0.12, dtype=DOUBLE))))
    table = ((0.6, -0.080, 0.061), (1.0, -0.096, 0.069), (5.0, -0.199, 0.092))
    for beta, at_top, at_bottom in table:
        for end, wanted in ((p0, at_top), (-beta * p0, at_bottom)):
            p = end + torch.tensor([-1.0, 1.0], dtype=DOUBLE) * 1e-6 * p0
            j = (1.0 - 2.0 * p / kappa).sqrt()
            # a deviator with q = 3 p0: pure shear d = s (xy + yx), |d| = s sqrt 2
            s = 3.0 * p0 / (1.5**0.5 * mu) / 2.0**0.5
            d = torch.zeros(2, 3, 3, dtype=DOUBLE)
            d[:, 0, 1] = d[:, 1, 0] = s
            # m with det(m I + d) = m^3 - m s^2 = 1
            m = 1.0
            for _ in range(60):
                m -= (m**3 - m * s * s - 1.0) / (3 * m * m - s * s)
            e = (j ** (2 / 3))[:, None, None] * (m * torch.eye(3, dtype=DOUBLE) + d)
            e = e - torch.eye(3, dtype=DOUBLE)
            row = torch.tensor([[mu, kappa, 1.85, beta, 3.0]], dtype=DOUBLE).expand(2, 5)
            nacc = Nacc(*row.unbind(1))
            jumps = {}
            for kind in ("fixed_explicit", "dynamic_explicit"):
                out, after, plastic = return_map(kind, nacc, measure(e, "strain"), alpha)
                assert bool(plastic.all())
                inner, outer = (0, 1) if end > 0 else (1, 0)
                jumps[kind] = float(after[inner] - after[outer])
                if kind == "fixed_explicit":
                    kept = out[inner].diagonal().sum() - e[inner].diagonal().sum()
                    assert abs(float(kept)) < 1e-14
            assert jumps["fixed_explicit"] == pytest.approx(wanted, abs=1.5e-3)
            assert abs(jumps["dynamic_explicit"]) < 1e-3


@pytest.mark.parametrize("kind", [k for k in MAPS if k.startswith("dynamic")])
def test_the_dynamic_maps_end_on_the_surface_they_say(kind: str) -> None:
    e, alpha, params = trials(2000)
    nacc = Nacc(*params[:, :5].unbind(1))
    out, after, plastic = return_map(kind, nacc, measure(e, "strain"), alpha)
    surface = after if kind.endswith("implicit") else alpha
    y = on_the_surface(nacc, measure(out, "strain"), surface)[plastic]
    scale = (nacc.friction * 0.5 * (1 + nacc.cohesion) * 230.0 * 0.1)[plastic] ** 2
    assert float((y / scale).max()) < 1e-9


@pytest.mark.parametrize("transfer", ["apic", "pic", "flip"])
def test_momentum_is_kept_by_every_transfer(transfer: Any) -> None:
    scene = find("spin").build(0.025, 8)
    solver = Textbook(scene, Variant(transfer=transfer), dtype=DOUBLE)
    content = float((solver.mass[:, None] * solver.velocity).abs().sum())
    before = solver.momentum()
    solver.run(steps=30)
    assert float((solver.momentum() - before).abs().max()) < 1e-13 * content


def test_only_apic_keeps_the_spin() -> None:
    """GaussianBench A1a: GaussianFluent's FLIP/PIC loses 99.7 % of a free ball's spin."""
    scene = find("spin").build(0.05 / 1.5, 1)
    left = {}
    for transfer in ("apic", "pic", "flip"):
        solver = Textbook(scene, Variant(transfer=transfer, flip=0.7), dtype=DOUBLE)  # type: ignore[arg-type]

        def spin(s: Textbook = solver) -> float:
            away = s.position - s.position.mean(0)
            turn = torch.linalg.cross(away, s.velocity - s.velocity.mean(0))[:, 2]
            curl = 0.25 * scene.dx**2 * (s.affine[:, 1, 0] - s.affine[:, 0, 1])
            return float((s.mass * (turn + curl)).sum())

        start = spin()
        left[transfer] = spin(solver.run(steps=150)) / start
    assert abs(left["apic"] - 1.0) < 1e-12
    assert abs(left["pic"]) < 0.01 and abs(left["flip"]) < 0.01


def test_gaussianfluents_force_is_weighted_twice() -> None:
    """Equations.md 0.6: about 12 times softer, so a bar's wave is 3.5 times slower."""
    scene = find("bar").build(1 / 8, 8)
    stiff = {}
    for force in ("gradient", "twice"):
        solver = Textbook(scene, Variant(force=force, transfer="flip", flip=1.0), dtype=DOUBLE)  # type: ignore[arg-type]
        shape = torch.from_numpy(np.cos(np.pi * scene.x[:, 0]))
        turned = []

        def watch(s: Textbook, shape: Tensor = shape, turned: list[float] = turned) -> None:
            if not turned and float((s.velocity[:, 0] * shape).sum()) < 0:
                turned.append(s.time)

        solver.run(seconds=float(scene.times[-1]), each=watch)
        stiff[force] = 1.0 / turned[0] ** 2
    assert 0.04 < stiff["twice"] / stiff["gradient"] < 0.16


@pytest.mark.parametrize("sums", ["sorted", "fixed"])
def test_sums_that_no_order_changes(sums: Any) -> None:
    scene = drop(FLESH)
    ends = {}
    for name, how in (("given", sums), ("other", sums), ("plain", "plain")):
        seed = {"given": 1, "other": 2, "plain": 3}[name]
        solver = Textbook(scene, Variant(sums=how, shuffle=seed), dt=4e-4).run(steps=30)
        ends[name] = solver.position
    assert torch.equal(ends["given"], ends["other"])
    assert not torch.equal(ends["given"], ends["plain"])


def test_bodies_stick_in_one_field_and_part_in_two() -> None:
    """Solver.md 0.5: v_end / v_0 = -0.49 in one field."""
    scene = find("pull_apart").build(0.02, 8)
    kept = {}
    for fields in (False, True):
        run = run_textbook(scene, fields=fields)
        second = scene.body == 1
        kept[fields] = run.v[-1][second, 0].mean() / scene.facts["speed"]
    assert kept[False] < 0.0 and kept[True] == pytest.approx(1.0, abs=1e-3)


def test_bodies_that_meet_turn_back_and_keep_their_momentum() -> None:
    scene = find("pull_apart").build(0.02, 8)
    head_on = dataclasses.replace(scene, v=-scene.v)
    solver = Textbook(head_on, Variant(fields=True), dtype=DOUBLE)
    content = float((solver.mass[:, None] * solver.velocity).abs().sum())
    solver.run(seconds=3.0 * 0.08 / scene.wave_speed)
    second = torch.from_numpy(scene.body == 1)
    assert float(solver.velocity[second, 0].mean()) > 0.5 * scene.facts["speed"]
    assert float(solver.momentum().abs().max()) < 1e-13 * content


def lone(place: float, **options: Any) -> Textbook:
    """One point in free flight, ``place`` dx beside a node on each axis."""
    scene = drop(ROCK)
    x = np.full((1, 3), (5.0 + place) * DX)
    zero = np.zeros(1, np.int32)
    scene = Scene(
        "point", DX, x, np.ones((1, 3)), np.full(1, DX**3), zero, zero, np.zeros((1, 3, 3)),
        np.array([1e-3]), (ROCK,),
    )  # fmt: skip
    return Textbook(scene, Variant(**options), dt=1e-9)


@pytest.mark.parametrize("transfer", ["apic", "flip"])
def test_an_unguarded_division_kills_a_point_between_nodes(transfer: Any) -> None:
    """Users.md 0.3: a lone point at (n + 1/2) dx has a weight that is exactly zero."""
    with pytest.raises(FloatingPointError, match="alone"):
        lone(0.5, transfer=transfer, guarded=False, flip=0.0).run(steps=1)
    dead = lone(0.5, transfer=transfer, guarded=False)
    with pytest.raises(FloatingPointError):
        dead.run(steps=1)
    assert dead.birth is not None and dead.birth.stage == "g2p"
    assert dead.birth.alone and dead.birth.massless
    lone(0.5, transfer=transfer, guarded=True).run(steps=3)
    lone(0.37, transfer=transfer, guarded=False).run(steps=3)


def test_bad_choices_are_refused() -> None:
    with pytest.raises(ValueError, match="transfer must be one of"):
        Variant(transfer="xpic")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="return_map must be one of"):
        Variant(return_map="ours")
    with pytest.raises(ValueError, match="gradient"):
        Variant(kernel="linear")
    with pytest.raises(ValueError, match="rising"):
        Variant(clamp=(2.0, 1.0))
    with pytest.raises(ValueError, match="dt must be positive"):
        Textbook(drop(ROCK), dt=-1.0)
    with pytest.raises(ValueError, match="no law"):
        Textbook(drop({**ROCK, "law": "fluid"}))
