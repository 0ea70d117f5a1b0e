"""Materials, scenes and the sampling of material points."""

from __future__ import annotations

import math

import pytest
import torch
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.data import Frame
from gsfluent.errors import InputError
from gsfluent.ops.plasticity import LAWS
from gsfluent.pipeline.matter.points import build_matter, sample_points
from gsfluent.scene.scene import Scene


def test_parameters_follow_isotropic_elasticity():
    row = materials.elastic.parameters()
    young, nu = materials.elastic.young_modulus, materials.elastic.poisson_ratio
    mu, kappa = float(row[0]), float(row[1])
    assert math.isclose(9 * kappa * mu / (3 * kappa + mu), young, rel_tol=1e-12)
    assert math.isclose((3 * kappa - 2 * mu) / (2 * (3 * kappa + mu)), nu, rel_tol=1e-12)


def test_friction_slope_at_45_degrees_is_the_published_one():
    assert math.isclose(
        float(materials.get("bread").parameters()[2]), 1.850343771924453, rel_tol=1e-12
    )


@pytest.mark.parametrize(
    "field",
    [
        "young_modulus",
        "poisson_ratio",
        "density",
        "cohesion",
        "hardening",
        "friction_angle",
        "shear_damage",
        "tensile_strength",
        "compressive_strength",
        "softening",
        "restitution",
    ],
)
def test_every_parameter_changes_the_row(field):
    base = materials.plaster.override(hysteresis="pressed")
    columns = {"cohesion": 3, "hardening": 4}  # these follow from the strengths unless given
    value = base.parameters()[columns[field]] if field in columns else getattr(base, field)
    changed = base.override(**{field: float(value) * 1.1 + 0.01})
    assert not torch.equal(base.parameters(), changed.parameters())


def test_every_preset_says_where_its_numbers_come_from():
    for name in materials.names():
        preset = materials.get(name)
        for field in preset.reads:
            assert preset.source(field).split(":")[0] in (
                "measured",
                "derived",
                "estimate",
                "chosen by eye",
            )


def test_unknown_names_suggest_the_nearest():
    with pytest.raises(InputError, match=r"fruit\.watermelon"):
        materials.get("fruit.watermellon")
    with pytest.raises(InputError, match="cohesion"):
        materials.glass.override(cohesoin=1.0)
    with pytest.raises(InputError, match="drucker_prager"):
        materials.glass.override(law="druker_prager")


@pytest.mark.parametrize(
    "bad",
    [
        {"density": 0.0},
        {"poisson_ratio": 0.5},
        {"young_modulus": math.nan},
        {"cohesion": -1.0},
        {"density": "heavy"},
    ],
)
def test_bad_numbers_are_refused(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        materials.glass.override(**bad)


def test_brittle_and_elastic_failure_strain():
    assert math.isinf(materials.jelly.failure_strain)
    weak = materials.fruit.watermelon.override(cohesion=0.01)
    assert 0 < weak.failure_strain < materials.fruit.watermelon.failure_strain
    weak = materials.fruit.watermelon.override(tensile_strength=2e4)
    assert weak.failure_strain == pytest.approx(0.5 * materials.fruit.watermelon.failure_strain)


def test_drop_puts_the_lowest_point_at_the_height():
    scene = Scene(floor=0.5)
    scene.add(ellipsoid(), "apple")
    scene.drop(1.0)
    assert math.isclose(float(scene.bodies[0].bounds()[0][2]), 1.5, abs_tol=1e-9)


def test_events_of_a_shot_are_checked():
    scene = Scene(floor=None)
    with pytest.raises(InputError, match="no solid"):
        scene.add_event({"type": "drop", "height": 1.0})
    scene.add(ellipsoid(), "apple")
    scene.add_event({"type": "throw", "velocity": [1, 0, 0], "spin": [0, 0, 3]})
    assert scene.bodies[0].velocity == (1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="'path' is missing"):
        scene.add_event({"type": "blade"})
    with pytest.raises(InputError, match="'drop'"):
        scene.add_event({"type": "dorp", "height": 1})
    with pytest.raises(InputError, match="'height'"):
        scene.add_event({"type": "drop", "hight": 1})
    with pytest.raises(InputError, match="missing"):
        scene.add_event({"type": "bullet", "from": [1, 0, 0]})


def test_bullet_keeps_the_time_step():
    scene = Scene(floor=None)
    scene.add(ellipsoid(), "watermelon")
    scene.add_event(
        {"type": "bullet", "from": [1, 0, 0], "toward": [0, 0, 0], "speed": 60, "density": 7800}
    )
    bullet, melon = scene.bodies[1].material, scene.bodies[0]
    fastest = max(
        [melon.material.wave_speed, *(p.material(melon.material).wave_speed for p in melon.parts)]
    )
    assert math.isclose(bullet.wave_speed, fastest, rel_tol=1e-6)


def test_sampled_mass_is_density_times_volume():
    solid = ellipsoid((0.1, 0.08, 0.06))
    scene = Scene(floor=None)
    scene.add(solid, materials.elastic)
    matter = build_matter(scene, 0.02)
    assert math.isclose(float(matter.particles.mass.sum()), 1000 * solid.volume, rel_tol=1e-5)
    assert bool(solid.contains(matter.rest).all())
    cells = solid.volume / 0.02**3
    assert 0.8 * 8 < matter.particles.count / cells < 1.2 * 8


def test_a_body_that_lasts_may_have_its_own_inertia():
    solid = ellipsoid((0.1, 0.03, 0.03))
    for material, temperature, changes in (
        (materials.elastic, None, True),
        (materials.elastic, 20.0, False),
        (materials.fruit.watermelon, None, False),
    ):
        scene = Scene(floor=None)
        scene.add(solid, material, temperature=temperature)
        plain, own = (build_matter(scene, 0.012, inertia=wanted) for wanted in (False, True))
        a, b = plain.particles.mass, own.particles.mass
        assert torch.equal(plain.rest, own.rest)
        assert math.isclose(float(a.sum()), float(b.sum()), rel_tol=1e-5)
        if changes:
            far = own.rest[:, 1:].double() - own.rest[:, 1:].double().mean(0)
            assert float((b * far.square().sum(1)).sum()) < 0.9 * float(
                (a * far.square().sum(1)).sum()
            )
        else:
            assert torch.equal(a, b)


def test_sampling_follows_the_frame_and_the_seed():
    solid = ellipsoid((1.0, 0.8, 0.6))
    half_turn = Frame(
        torch.diag(torch.tensor([-1.0, -1.0, 1.0])), torch.tensor([0.0, 0.0, 0.06]), 0.1
    )
    scene = Scene(floor=None)
    scene.add(solid, materials.elastic, frame=half_turn)
    matter = build_matter(scene, 0.02)
    back = half_turn.inverse().apply(matter.rest)
    wanted = sample_points(solid, 0.1)
    gap = torch.cdist(back.double(), wanted).amin(dim=1)
    assert back.shape == wanted.shape and float(gap.max()) < 1e-5
    again = build_matter(scene, 0.02, seed=1)
    assert not torch.equal(again.rest[:50], matter.rest[:50])


def test_parts_select_by_depth_colour_box_and_sphere():
    solid = ellipsoid((0.1, 0.1, 0.1))
    scene = Scene(floor=None)
    parts = [
        {"name": "rind", "where": {"depth_below": 0.02}, "density": 2000.0},
        {
            "name": "red",
            "where": {"color_near": [0.9, 0.2, 0.2], "sphere": [0, 0, 0, 0.05]},
            "density": 3000.0,
        },
        {
            "name": "top",
            "where": {"box": [[-1, -1, 0.0], [1, 1, 1]], "depth_above": 0.06},
            "law": "elastic",
            "density": 4000.0,
        },
    ]
    scene.add(solid, materials.glass, parts=parts)
    matter = build_matter(scene, 0.02)
    rows = matter.particles.material
    density = matter.params[rows, 6]
    radius = matter.rest.norm(dim=1)
    depth = 0.1 - radius
    assert set(density.unique().tolist()) == {2000.0, 2500.0, 3000.0, 4000.0}
    assert bool((density[depth < 0.01] == 2000).all())
    assert bool((density[(radius < 0.03) & (matter.rest[:, 2] < -0.005)] == 3000).all())
    assert bool((matter.law[rows][density == 4000] == 0).all())


def test_a_parameter_field_varies_in_space():
    solid = ellipsoid()
    field = torch.full(solid.occupancy.shape, 0.1)
    field[: solid.occupancy.shape[0] // 2] = 0.3
    scene = Scene(floor=None)
    scene.add(solid, materials.glass.override(cohesion=field))
    matter = build_matter(scene, 0.02)
    cohesion = matter.params[matter.particles.material, 3]
    left = matter.rest[:, 0] < -solid.voxel
    assert torch.allclose(cohesion[left], torch.tensor(0.3))
    assert torch.allclose(cohesion[matter.rest[:, 0] > solid.voxel], torch.tensor(0.1))
    wrong = Scene(floor=None)
    wrong.add(solid, materials.glass.override(cohesion=torch.ones(2, 2, 2)))
    with pytest.raises(InputError, match="shape of the voxels"):
        build_matter(wrong, 0.02)


BY_HAND = materials.glass.override(cohesion=0.05, hardening=10.0, alpha0=-0.03, variation=0.0)
"""Softening as given, on every grid, and no Weibull modulus."""


def test_weakness_noise_is_bounded_and_seeded():
    scene = Scene(floor=None)
    scene.add(ellipsoid(), BY_HAND)
    alpha = build_matter(scene, 0.02).particles.alpha
    base = BY_HAND.alpha0
    assert float(alpha.min()) >= base * 1.1501 and float(alpha.max()) <= base * 0.8499
    assert float(alpha.std()) > 0.05 * abs(base)
    assert torch.equal(alpha, build_matter(scene, 0.02).particles.alpha)


def test_strength_scatter_is_smooth_seeded_and_of_the_size_asked_for():
    varied = BY_HAND.override(variation=0.3, grain=0.03)
    scene, plain = Scene(floor=None), Scene(floor=None)
    scene.add(ellipsoid(), varied)
    plain.add(ellipsoid(), BY_HAND)
    matter = build_matter(scene, 0.01, jitter=0.0)
    factor = matter.particles.alpha / build_matter(plain, 0.01, jitter=0.0).particles.alpha
    assert 0.2 < float(factor.std()) < 0.4
    near = torch.cdist(matter.rest[:2000], matter.rest)
    near[near == 0] = 1.0
    neighbour = factor[near.argmin(dim=1)]
    assert float((neighbour - factor[:2000]).abs().max()) < 0.3
    coarse = build_matter(scene, 0.02, jitter=0.0)
    match = torch.cdist(coarse.rest, matter.rest).argmin(dim=1)
    assert float((coarse.particles.alpha - matter.particles.alpha[match]).abs().mean()) < 0.01
    with pytest.raises(InputError, match="variation"):
        varied.override(variation=2.0)


def test_points_are_stored_in_cell_order():
    scene = Scene(floor=None)
    scene.add(ellipsoid((0.2, 0.1, 0.1)), materials.glass)
    rest = build_matter(scene, 0.02).rest
    step = (rest[1:] - rest[:-1]).norm(dim=1)
    assert float(step.median()) < 0.02
    blocks = torch.floor((rest - rest.amin(dim=0)) / 0.08)
    changes = int((blocks[1:] != blocks[:-1]).any(dim=1).sum())
    assert changes < 1.5 * torch.unique(blocks, dim=0).shape[0]


def test_empty_and_oversized_scenes_are_refused():
    with pytest.raises(InputError, match="empty"):
        build_matter(Scene(), 0.02)
    sunk = Scene(floor=0.0)
    sunk.add(ellipsoid(), materials.glass, frame=Frame.identity())
    with pytest.raises(InputError, match="below the floor"):
        build_matter(sunk, 0.02)
    scene = Scene(floor=None)
    scene.add(ellipsoid(), materials.glass)
    with pytest.raises(InputError, match="material points"):
        build_matter(scene, 1e-4)


def test_laws_have_the_numbers_of_the_ops() -> None:
    """Two tables, so that materials can be read without the compiled library."""
    assert materials.LAWS == LAWS
