"""Every parameter of every law changes a small simulation; what would not is refused by name."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from loaded_scripts import load_script
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.errors import InputError
from gsfluent.lab.world.driver import World
from gsfluent.materials import LAWS, READS, Material
from gsfluent.materials.laws import JOHNSON_COOK
from gsfluent.pipeline.matter.brittle import brittle_rows

DX = 0.05
SOLID = {"young_modulus": 1e5, "poisson_ratio": 0.3, "density": 1000.0}
BASE: dict[str, Material] = {
    "elastic": Material("test", law="elastic", **SOLID),
    "corotated": Material("test", law="corotated", **SOLID),
    "nacc": Material(
        "test", law="nacc", cohesion=0.2, hardening=3.0, friction_angle=40.0, alpha0=-0.02,
        shear_damage=0.1, **SOLID,
    ),
    "drucker_prager": Material(
        "test", law="drucker_prager", friction_angle=30.0, cohesion_pressure=200.0, **SOLID
    ),
    "von_mises": Material(
        "test", law="von_mises", yield_stress=1500.0, hardening_modulus=5e3,
        plastic_viscosity=200.0, **SOLID,
    ),
    "von_mises by power": Material(
        "test", law="von_mises", yield_stress=1500.0, hardening_modulus=5e3,
        hardening_exponent=0.3, rate_sensitivity=0.05, melting_heat=5e3, **SOLID,
    ),
    "fluid": Material(
        "test", law="fluid", density=1000.0, bulk_modulus=1e5, viscosity=2.0, tait_exponent=7.0
    ),
    "rigid": Material("test", law="rigid", density=1000.0),
    "phase_field": Material(
        "test", law="phase_field", toughness=20.0, length=0.12, tensile_strength=4e3, **SOLID
    ),
    "phase_field by strength": Material(
        "test", law="phase_field", toughness=60.0, tensile_strength=3e3, **SOLID
    ),
    "yeoh": Material("test", law="yeoh", yeoh_c20=2e4, yeoh_c30=2e5, **SOLID),
    "ogden": Material(
        "test", law="ogden", ogden_alpha1=1.3, ogden_mu2=4e3, ogden_alpha2=8.0, ogden_mu3=-4e3,
        ogden_alpha3=-3.0, **SOLID,
    ),
    "nacc by handbook": Material(
        "test", law="nacc", tensile_strength=4e3, compressive_strength=2e4, fracture_energy=60.0,
        friction_angle=40.0, **SOLID,
    ),
}  # fmt: skip
RELAXES = {"relaxation_share": 0.5, "relaxation_time": 5e-3}
BASE |= {f"{law} that relaxes": BASE[law].override(**RELAXES) for law in ("elastic", "nacc")}
BASE["nacc that yields late"] = BASE["nacc"].override(yield_time=2e-3)
CASES = [(law, field) for law, reads in READS.items() for field in reads]


def of_one_point(value: materials.Field) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).reshape(1)


def fall(material: Material) -> Tensor:
    """Positions [dx] of a 3 x 3 x 3 cell cube, thrown on its edge onto a slab on the floor.

    The slab is elastic and stays the same: alone, a heavier body of the same wave speed would move
    the same.
    """
    side = torch.arange(6, dtype=torch.float64) * (DX / 2.0) + 0.25 * DX
    grid = torch.stack(torch.meshgrid(side, side, side, indexing="ij"), dim=-1).reshape(-1, 3)
    turn = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]], dtype=torch.float64)
    cube = (grid - 1.5 * DX) @ turn.T + torch.tensor([0.0, 0.0, 0.28], dtype=torch.float64)
    slab = grid * torch.tensor([2.0, 2.0, 0.5], dtype=torch.float64)
    slab = slab - torch.tensor([3.0 * DX, 3.0 * DX, -0.5 * DX], dtype=torch.float64)
    row, start = material.parameters(), float(material.start_alpha)
    if material.by_handbook:  # only a grid makes something of a fracture energy
        found, alphas = brittle_rows(material, of_one_point, torch.ones(1).double(), DX)
        row, start = found[0], float(alphas[0])
    if material.law == "phase_field":
        row = materials.phase_field.rows(material, of_one_point, torch.ones(1).double(), DX)[0]
    rows = torch.stack([row, materials.elastic.parameters()])
    count = len(cube)
    kind = torch.cat([torch.zeros(count), torch.ones(count)]).int()
    volume = torch.cat([torch.full((count,), (DX / 2.0) ** 3), torch.full((count,), DX**3 / 4.0)])
    velocity = torch.zeros(2 * count, 3, dtype=torch.float64)
    velocity[:count] = torch.tensor([0.6, 0.0, -2.5], dtype=torch.float64)
    alpha = torch.where(kind == 0, start, materials.UNBROKEN)
    scene: dict[str, Any] = dict(
        mass=rows[kind.long(), 6] * volume,
        volume=volume,
        dx=DX,
        law=torch.tensor([LAWS[material.law], LAWS["elastic"]]),
        params=rows,
        material=kind,
        alpha=alpha,
        gravity=(0.0, 0.0, -9.81),
        colliders=torch.tensor([[0, 2, 0.4, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]]).double(),
        dt=4e-4,
    )
    if material.viscous:  # a matter of the points
        branch = torch.zeros(2 * count, 9, dtype=torch.float64)
        branch[:count, 6:] = material.viscosities()
        kinds = {"law": scene["law"].int(), "volume": volume.double(), "alpha": alpha.double()}
        solver = ops.Solver(torch.cat([cube, slab]), velocity, viscous=branch, **scene | kinds)
        solver.advance(110 * 4e-4)
        return solver.position[:count] / DX
    world = World(torch.cat([cube, slab]), velocity, **scene)
    world.run(steps=110)
    return world.position[:count] / DX


def base_of(law: str, field: str) -> str:
    """Strengths and energy take the place of what the other base gives by hand."""
    if law == "phase_field":
        return "phase_field by strength" if field == "tensile_strength" else law
    if field in RELAXES:
        return f"{law} that relaxes"
    if field in JOHNSON_COOK:
        return "von_mises by power"
    if field == "yield_time":
        return "nacc that yields late"
    return "nacc by handbook" if field in materials.HANDBOOK else law


@functools.cache
def base(name: str) -> Tensor:
    return fall(BASE[name])


@pytest.mark.parametrize(("law", "field"), CASES)
def test_every_parameter_changes_the_outcome(law: str, field: str) -> None:
    name = base_of(law, field)
    changed = BASE[name].override(**{field: 1.2 * float(getattr(BASE[name], field))})
    moved = (fall(changed) - base(name)).norm(dim=1).max()
    assert moved > 1e-4, f"{field}: {float(moved):.2g} dx"
    assert moved < 10.0


def test_the_same_material_gives_the_same_outcome() -> None:
    """What the test above measures is not chance."""
    assert torch.equal(fall(BASE["nacc"].override(name="twin")), base("nacc"))


@pytest.mark.parametrize("law", list(LAWS))
def test_a_parameter_that_the_law_does_not_read_is_refused_by_name(law: str) -> None:
    for field in materials.PARAMETERS:
        if field in READS[law]:
            continue
        low, high, _ = materials.RANGES[field]
        value = 1.0 if low <= 1.0 <= high else 0.5 * (low + high)
        with pytest.raises(InputError, match=rf"{field} does nothing under law '{law}'") as caught:
            BASE[law].override(**{field: value})
        assert "use law" in str(caught.value)


def test_viscosity_on_an_elastic_body_names_the_fluid() -> None:
    with pytest.raises(InputError, match="viscosity does nothing under law 'elastic'") as caught:
        materials.jelly.override(viscosity=1.0)
    assert "fluid" in caught.value.hint


def test_scatter_of_strength_is_refused_where_nothing_breaks() -> None:
    with pytest.raises(InputError, match="variation does nothing under law 'fluid'"):
        materials.water.override(variation=0.2)


@pytest.mark.parametrize(
    ("law", "missing", "given"),
    [
        ("von_mises", "yield_stress", dict(SOLID)),
        ("fluid", "bulk_modulus", {"density": 1000.0}),
        ("elastic", "poisson_ratio", {"young_modulus": 1e5, "density": 1000.0}),
        ("rigid", "density", {}),
    ],
)
def test_a_parameter_that_the_law_needs_is_asked_for(
    law: str, missing: str, given: dict[str, Any]
) -> None:
    with pytest.raises(InputError, match=f"law '{law}' needs {missing}"):
        Material("mine", law=law, **given)


def test_a_change_of_law_drops_what_the_new_law_does_not_read() -> None:
    calm = materials.fruit.watermelon.override(law="elastic")
    assert calm.tensile_strength is None and calm.weibull_modulus == 0.0
    assert calm.cohesion is None and calm.variation == 0.0 and calm.parts == ()
    assert calm.young_modulus == materials.fruit.watermelon.young_modulus
    metal = materials.glass.override(law="von_mises", yield_stress=1e5)
    assert metal.hardening_modulus == 0.0
    with pytest.raises(InputError, match="cohesion does nothing"):
        materials.glass.override(law="elastic", cohesion=1.0)


@pytest.mark.parametrize("name", materials.names())
def test_rows_of_presets_are_accepted_by_the_op(name: str) -> None:
    preset = materials.get(name)
    law = torch.tensor([LAWS[preset.law]], dtype=torch.int32)
    strain = torch.zeros(1, 6, dtype=torch.float64)
    alpha = torch.full((1,), float(preset.start_alpha), dtype=torch.float64)
    still = torch.zeros(1, 3, 3, dtype=torch.float64)
    row = preset.parameters()[None]
    out = ops.return_mapping(strain, alpha, still, law=law, params=row, dt=1e-3)
    assert out[3].tolist() == [0, 0, 0, 0]
    assert torch.equal(out[2], strain)
    speed = float(ops.wave_speed(strain, law=law, params=row)[0])
    assert speed == pytest.approx(preset.wave_speed, rel=1e-9)
    # A frame of 1/30 s in cells of 1 cm is then at most about 1500 steps.
    assert 0.0 < preset.wave_speed < 230.0


def test_sand_slope_is_the_published_one() -> None:
    """alpha_DP = sqrt(2/3) 2 sin / (3 - sin) (Klar et al. 2016)."""
    row = materials.sand.override(friction_angle=30.0).parameters()
    assert float(row[2]) == pytest.approx((2.0 / 3.0) ** 0.5 * 1.0 / 2.5, rel=1e-12)


@pytest.mark.parametrize("block", ["numbers", "sources"])
def test_the_page_holds_what_the_presets_are(block: str) -> None:
    """Renewed by scripts/study/materials.py."""
    page = Path(__file__).resolve().parents[2] / "docs" / "measured" / "materials.md"
    found = re.search(
        rf"<!-- {block}: begin -->\n(.*?)<!-- {block}: end -->", page.read_text("utf-8"), re.DOTALL
    )
    assert found is not None and found.group(1) == getattr(load_script("study/materials"), block)()
