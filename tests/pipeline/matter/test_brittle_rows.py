"""Brittle matter by handbook numbers: strengths, energy on a grid, Weibull, restitution."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials
from gsfluent.errors import InputError
from gsfluent.materials import LARGEST, STEEPEST, Field, Material, ellipse
from gsfluent.ops.plasticity import LAWS, unloading_share
from gsfluent.pipeline.matter.brittle import brittle_rows, kept_strength, softened
from gsfluent.pipeline.matter.crack_band import BAND_CELLS, softening_energies
from gsfluent.pipeline.matter.points import Matter, build_matter
from gsfluent.pipeline.simulate.stage import Simulate, SimulationFrame
from gsfluent.scene.scene import Scene

BRITTLE = [name for name in materials.names() if materials.get(name).by_handbook]
FINE = (0.0015, 0.003, 0.006)
BY_HAND = materials.plaster.override(cohesion=0.05, hardening=10.0, alpha0=-0.03)


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def one(value: Field) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).reshape(1)


def strength(row: Tensor, alpha: Tensor) -> Tensor:
    """p0 of a row [..., 8]."""
    return row[..., 1] * torch.sinh(row[..., 4] * alpha.abs())


def residual(friction: Tensor, beta: Tensor, p0: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """Of the yield surface, over M^2 p0^2."""
    m2 = friction**2
    return (q**2 * (1.0 + 2.0 * beta) + m2 * (p + beta * p0) * (p - p0)) / (m2 * p0**2)


# --- strengths ---


def test_the_ellipse_goes_through_both_uniaxial_strengths() -> None:
    friction, tensile, ratio = torch.meshgrid(
        f64(0.6, 1.2, 2.2), f64(1.0, 1e5), f64(1.3, 2.0, 10.0, 100.0), indexing="ij"
    )
    compressive = tensile * ratio
    beta, p0 = ellipse(friction, tensile, compressive, torch.full_like(tensile, math.inf))
    assert bool((beta > 0.0).all()) and bool((p0 > 0.0).all())
    drawn = residual(friction, beta, p0, -tensile / 3.0, tensile)
    pressed = residual(friction, beta, p0, compressive / 3.0, compressive)
    assert float(drawn.abs().max()) < 1e-12 and float(pressed.abs().max()) < 1e-12


def test_a_compressive_strength_out_of_reach_leaves_the_tensile_one() -> None:
    friction, tensile, largest = f64(1.5), f64(2e4), f64(1e5)
    _, free = ellipse(friction, tensile, f64(1e6), f64(math.inf))
    assert free > largest
    beta, p0 = ellipse(friction, tensile, f64(1e6), largest)
    assert p0 == largest
    assert abs(float(residual(friction, beta, p0, -tensile / 3.0, tensile))) < 1e-12


@pytest.mark.parametrize("name", BRITTLE)
def test_a_preset_yields_at_its_strengths(name: str) -> None:
    preset = materials.get(name)
    row, alpha = preset.parameters(), one(preset.start_alpha)[0]
    p0 = strength(row, alpha)
    tensile, compressive = preset.strengths()
    assert abs(float(residual(row[2], row[3], p0, -tensile / 3.0, tensile))) < 1e-10
    if p0 < (LARGEST - 1e-6) * row[1]:
        assert abs(float(residual(row[2], row[3], p0, compressive / 3.0, compressive))) < 1e-10


# --- energy ---


def on_grid(material: Material, dx: float, weakness: float = 1.0) -> tuple[Tensor, Tensor]:
    return brittle_rows(material, one, f64(weakness), dx)


def crack_energy(rows: Tensor, alpha: Tensor, dx: float) -> float:
    """Energy per area of the band [J/m^2]."""
    return BAND_CELLS * dx * float(softening_energies(rows, alpha)[0])


@pytest.mark.parametrize("dx", FINE)
@pytest.mark.parametrize("name", ["plaster", "fruit.watermelon", "rock", "bone"])
def test_the_band_takes_the_fracture_energy_at_full_strength(name: str, dx: float) -> None:
    preset = materials.get(name)
    rows, alpha = on_grid(preset, dx)
    given = float(one(preset.fracture_energy or 0.0))
    assert crack_energy(rows, alpha, dx) == pytest.approx(given, rel=1e-6)
    whole = strength(preset.parameters(), one(preset.start_alpha))
    assert float(strength(rows, alpha)[0]) == pytest.approx(float(whole), rel=1e-9)
    assert float(rows[0, 3] * rows[0, 4]) <= STEEPEST * (1.0 + 1e-9)


def test_half_the_spacing_is_twice_the_softening() -> None:
    """As the crack band asks; a little less, since elastic unloading has a share of its own."""
    alphas = [float(on_grid(materials.plaster, dx)[1]) for dx in FINE]
    for fine, coarse in itertools.pairwise(alphas):
        assert 1.8 < fine / coarse < 2.3


@pytest.mark.parametrize("name", ["glass", "ceramic"])
def test_beyond_the_brittle_spacing_strength_gives_way_and_energy_stays(name: str) -> None:
    preset = materials.get(name)
    rows, alpha = preset.parameters()[None], one(preset.start_alpha)
    p0, energy = strength(rows, alpha), one(preset.fracture_energy or 0.0)
    found = []
    for dx in (0.02, 0.08):
        hardening, start, kept = softened(rows, p0, energy, f64(1.0), dx)
        table = rows.clone()
        table[:, 4] = hardening
        assert float(kept) < 0.5
        assert float(strength(table, start)) == pytest.approx(float(kept * p0), rel=1e-9)
        assert float(rows[0, 3] * hardening) == pytest.approx(STEEPEST, rel=1e-3)
        assert crack_energy(table, start, dx) == pytest.approx(float(energy), rel=1e-6)
        found.append(float(kept))
    assert found[0] / found[1] == pytest.approx(2.0, rel=0.03)  # dx^-1/2
    # what is stronger than the grid can hold has the lowered strength, what is weaker its own
    strong = softened(rows, p0, energy, f64(1.5), 0.02)
    assert torch.equal(strong[1], softened(rows, p0, energy, f64(1.0), 0.02)[1])
    hardening, start, _ = softened(rows, p0, energy, f64(0.8 * found[0]), 0.02)
    table = rows.clone()
    table[:, 4] = hardening
    assert float(strength(table, start)) == pytest.approx(0.8 * found[0] * float(p0), rel=1e-9)
    assert crack_energy(table, start, 0.02) == pytest.approx(float(energy), rel=1e-6)


@pytest.mark.parametrize("name", ["glass", "ceramic"])
def test_who_prefers_strength_keeps_it_and_pays_with_energy(name: str) -> None:
    tough, strong = materials.get(name), materials.get(name).override(prefer="strength")
    p0 = strength(tough.parameters(), one(tough.start_alpha))
    energy, fine, coarse = float(one(tough.fracture_energy or 0.0)), 1e-5, 0.02
    assert kept_strength(strong, coarse) == 1.0 and kept_strength(tough, coarse) < 0.5
    rows, alpha = on_grid(strong, coarse)
    assert float(strength(rows, alpha)[0]) == pytest.approx(float(p0), rel=1e-9)
    assert float(rows[0, 3] * rows[0, 4]) == pytest.approx(STEEPEST, rel=1e-9)
    # as the strength squared, but for finite strains, over what the energy would allow
    ratio = crack_energy(rows, alpha, coarse) / energy
    assert ratio == pytest.approx(kept_strength(tough, coarse) ** -2, rel=0.1)
    # where the grid is fine enough there is nothing to prefer
    assert kept_strength(tough, fine) == 1.0
    for one_, other in zip(on_grid(strong, fine), on_grid(tough, fine), strict=True):
        assert torch.equal(one_, other)


def test_what_is_lowered_is_counted_where_it_is_least() -> None:
    glass, dx = materials.glass, 0.01
    field = torch.tensor([[[8.0, 800.0], [80.0, 8.0]]])
    mixed = glass.override(fracture_energy=field)
    assert kept_strength(mixed, dx) == kept_strength(glass, dx) < 1.0
    assert kept_strength(materials.jelly, dx) == kept_strength(BY_HAND, dx) == 1.0


def test_a_preference_is_one_of_two_words_and_of_brittle_matter() -> None:
    with pytest.raises(InputError, match="unknown prefer 'both'"):
        materials.glass.override(prefer="both")
    with pytest.raises(InputError, match="prefer does nothing under law 'elastic'"):
        materials.jelly.override(prefer="strength")
    strong = materials.glass.override(prefer="strength")
    assert strong.override(law="elastic").prefer == "toughness"


def test_softening_keeps_the_breaking_speed_and_the_size_number() -> None:
    hard = materials.plaster.override(softening=20.0)
    soft = materials.plaster.override(softening=180.0)

    def numbers(m: Material) -> tuple[float, float]:
        young, density = float(one(m.young_modulus or 0.0)), float(one(m.density or 0.0))
        tensile = float(m.strengths()[0])
        energy = float(one(m.fracture_energy or 0.0))
        return tensile / math.sqrt(density * young), young * energy / tensile**2

    stiff = [float(one(m.young_modulus or 0.0)) for m in (hard, soft)]
    assert stiff[0] == pytest.approx(9.0 * stiff[1])
    assert numbers(soft) == pytest.approx(numbers(hard), rel=1e-12)
    assert soft.breaking_speed == pytest.approx(hard.breaking_speed, rel=1e-9)
    # another stiffness of the same thing is another softening
    again = hard.override(young_modulus=soft.young_modulus)
    assert again.softening == pytest.approx(180.0)


@pytest.mark.parametrize("hand", [{"alpha0": -0.03}, {"hardening": 10.0}])
def test_softening_by_hand_is_left_as_it_is_on_every_grid(hand: dict[str, float]) -> None:
    material = materials.plaster.override(**hand)
    assert material.energy_by_hand and not materials.plaster.energy_by_hand
    (coarse, thick), (fine, thin) = on_grid(material, 0.01), on_grid(material, 0.002)
    assert torch.equal(coarse, fine) and torch.equal(thick, thin)
    given = {"alpha0": float(thin[0]), "hardening": float(fine[0, 4])}
    assert all(given[field] == value for field, value in hand.items())
    # the strengths hold all the same, as the other of the two follows from them
    whole = strength(materials.plaster.parameters(), one(materials.plaster.start_alpha))
    assert float(strength(fine, thin)[0]) == pytest.approx(float(whole), rel=1e-9)


def test_a_cohesion_by_hand_keeps_the_band() -> None:
    material = materials.plaster.override(cohesion=0.2)
    assert not material.energy_by_hand
    for dx in FINE:
        rows, alpha = on_grid(material, dx)
        assert float(rows[0, 3]) == 0.2
        assert crack_energy(rows, alpha, dx) == pytest.approx(7.0, rel=1e-6)


# --- weakness ---


def matter_of(material: Material, dx: float, radius: float = 0.1, seed: int = 0) -> Matter:
    scene = Scene(floor=None)
    scene.add(ellipsoid((radius,) * 3), material)
    return build_matter(scene, dx, seed=seed)


def weakness(matter: Matter) -> Tensor:
    """Factors on the strength of a material with alpha0 by hand."""
    return matter.particles.alpha.double() / float(one(BY_HAND.alpha0 or 0.0))


def test_weakness_has_the_median_and_the_modulus_of_weibull() -> None:
    material = BY_HAND.override(weibull_modulus=6.0, grain=0.01, reference_volume=1e-6)
    factor = weakness(matter_of(material, 0.005)).sort().values
    assert float(factor.median()) == pytest.approx(1.0, abs=0.02)
    survives = 1.0 - (torch.arange(len(factor)).double() + 0.5) / len(factor)
    wide = (survives > 0.02) & (survives < 0.98)
    x, y = factor[wide].log(), (-survives[wide].log()).log()
    x, y = x - x.mean(), y - y.mean()
    assert float((x @ y) / (x @ x)) == pytest.approx(6.0, rel=0.08)
    # a grain is stronger than the specimens by the root of how many of it they hold
    larger = material.override(reference_volume=8e-6)
    again = weakness(matter_of(larger, 0.005)).sort().values
    assert float((again / factor - 8.0 ** (1.0 / 6.0)).abs().max()) < 1e-5


def test_weakness_is_the_same_field_on_two_grids_that_show_its_grains() -> None:
    material = BY_HAND.override(weibull_modulus=6.0, grain=0.05)
    fine, coarse = matter_of(material, 0.01), matter_of(material, 0.02)
    match = torch.cdist(coarse.rest, fine.rest).argmin(dim=1)
    a, b = weakness(coarse), weakness(fine)[match]
    assert float(a.std()) > 0.1 * float(a.mean())
    assert float((a - b).abs().mean()) < 0.02 * float(a.mean())
    assert not torch.equal(weakness(matter_of(material, 0.02, seed=1)), a)
    again = matter_of(material, 0.02)
    assert torch.equal(weakness(again), a)


def test_grains_that_the_grid_cannot_show_are_of_eight_cells() -> None:
    small = BY_HAND.override(weibull_modulus=6.0, grain=1e-4)
    shown = BY_HAND.override(weibull_modulus=6.0, grain=0.04)
    assert torch.equal(weakness(matter_of(small, 0.02)), weakness(matter_of(shown, 0.02)))


# --- restitution ---

DX = 0.01
BALL = Material(
    "ball", young_modulus=1e6, poisson_ratio=0.3, density=1000.0, law="nacc", cohesion=1.0,
    hardening=10.0, alpha0=-0.1,
)  # fmt: skip
"""Too strong to break in these falls."""


@functools.cache
def bounced(
    restitution: float, resident: bool = True, height: float = 0.75, hysteresis: str = "pressed"
) -> tuple[list[SimulationFrame], dict[str, float]]:
    scene = Scene()
    scene.add(ellipsoid((0.05,) * 3), BALL.override(restitution=restitution, hysteresis=hysteresis))
    scene.drop(height)
    stage = Simulate(dx=DX, splats=False, resident=resident)
    simulation = stage(scene, fps=100, seconds=math.sqrt(2.0 * height / 9.81) + 0.06)
    frames = list(simulation)
    report = simulation.report
    assert report["verdict"] == "clean", report["reason"]
    assert frames[-1].stats["damaged_fraction"] == 0
    return frames, report


def rebound(frames: list[SimulationFrame]) -> float:
    """Speed after over before."""
    mass = float(frames[0].particles.mass.sum())
    up = [f.stats["momentum"][2] / mass for f in frames]
    return -max(up) / min(up)


def test_a_ball_with_restitution_rebounds_slower_and_keeps_the_books() -> None:
    (whole, report), (lossy, other) = bounced(1.0), bounced(0.7)
    assert report["momentum_error"] < 1e-5 and other["momentum_error"] < 1e-5
    assert rebound(whole) > 0.75
    assert 0.55 < rebound(lossy) < 0.85 * rebound(whole)


def test_wet_matter_loses_in_tension_too() -> None:
    both, report = bounced(0.5, True, 0.1, "both")
    assert report["momentum_error"] < 1e-5
    assert rebound(both) < 0.98 * rebound(bounced(0.5, True, 0.1)[0])
    dry, wet = BALL.override(restitution=0.5), BALL.override(restitution=0.5, hysteresis="both")
    assert float(dry.parameters()[7]) == 0.75 and float(wet.parameters()[7]) == 1.75
    assert float(BALL.override(hysteresis="both").parameters()[7]) == 0.0  # nothing is lost
    rows = torch.stack([dry.parameters(), wet.parameters()])
    law = torch.full((2,), LAWS["nacc"], dtype=torch.int32)
    column = torch.tensor([0, 1])
    stress = torch.zeros(2, 6, dtype=torch.float64)
    stress[:, 0] = 1e3
    for sign, shares in ((1.0, (1.0, 0.25)), (-1.0, (0.25, 0.25))):  # pulled, pressed
        back = torch.zeros(2, 3, 3, dtype=torch.float64)
        back[:, 0, 0] = -sign * 1e3  # it springs back
        for rate, wanted in ((back, shares), (-back, (1.0, 1.0))):
            found = unloading_share(
                sign * stress, rate, law=law, params=rows, material=column, dx=DX
            )
            assert found.tolist() == pytest.approx(wanted)


@pytest.mark.parametrize("hysteresis", ["pressed", "both"])
def test_both_engines_lose_the_same_in_a_bounce(hysteresis: str) -> None:
    (fast, _), (slow, report) = (bounced(0.5, flag, 0.1, hysteresis) for flag in (True, False))
    assert report["momentum_error"] < 1e-5
    assert rebound(slow) == pytest.approx(rebound(fast), rel=0.02)
    assert rebound(slow) < 0.8 * rebound(bounced(1.0, False, 0.1)[0])
    for a, b in zip(fast, slow, strict=True):
        apart = (a.particles.position - b.particles.position).abs().max()
        assert float(apart) < 0.1 * DX, (a.index, float(apart) / DX)
