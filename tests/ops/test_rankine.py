"""Rankine's surface: against its definition, its energy on any path, and what it may never do."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.errors import InputError
from gsfluent.materials import LAWS, opening
from gsfluent.ops.reference import plasticity as reference
from gsfluent.pipeline.matter.brittle import brittle_rows, kept_strength
from gsfluent.pipeline.matter.crack_band import BAND_CELLS

YOUNG, NU = 1e6, 0.3
MU, KAPPA = YOUNG / (2.0 * (1.0 + NU)), YOUNG / (3.0 * (1.0 - 2.0 * NU))
NACC = torch.tensor([LAWS["nacc"]], dtype=torch.int32)


def row(strength: float, energy: float, crushing: float = 5.0, friction: float = 1.5) -> Tensor:
    """Parameters [1, 8] and the alpha they begin with; strength in units of the stiffness."""
    one = torch.ones(1, dtype=torch.float64)
    beta, xi, alpha0, kept = opening(MU * one, KAPPA * one, strength * YOUNG * one, energy * one)
    assert float(kept) == 1.0
    columns = (MU, KAPPA, friction, float(beta), float(xi), -crushing, 1000.0, 0.0)
    return torch.tensor([[*columns, float(alpha0)]], dtype=torch.float64)


def states(scale: float, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random steps of matter at rest, softened or broken by chance: strain, alpha, step, rows."""
    generator = torch.Generator().manual_seed(3)
    count = 3000
    table = row(0.5 * scale, 3.0 * (0.5 * scale) ** 2 * YOUNG)
    alpha = float(table[0, 8]) * torch.rand(count, generator=generator, dtype=torch.float64)
    alpha[::5] *= -0.3  # of parted matter
    step = 0.5 * scale * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    strain = torch.zeros(count, 6, dtype=torch.float64)
    rows = table[:, :8].expand(count, 8)
    return tuple(v.to(dtype).contiguous() for v in (strain, alpha, step, rows))  # type: ignore[return-value]


@pytest.mark.parametrize("scale", [1e-3, 0.05, 0.3])
@pytest.mark.parametrize("implicit", [True, False])
def test_the_operator_does_what_its_definition_says(scale: float, implicit: bool) -> None:
    strain, alpha, step, rows = states(scale, torch.float64)
    law = NACC.expand(len(alpha)).contiguous()
    found = ops.return_mapping(strain, alpha, step, law=law, params=rows, implicit=implicit)
    wanted = reference.return_mapping(strain, alpha, step, law=law, params=rows, implicit=implicit)
    assert found[3].tolist() == wanted[3].tolist()
    assert int(found[3][0]) > len(alpha) // 2
    for have, want in zip(found[:3], wanted[:3], strict=True):
        torch.testing.assert_close(have, want, rtol=1e-6, atol=1e-7 * float(want.abs().max()))


@pytest.mark.parametrize("scale", [1e-3, 0.05, 0.3])
def test_single_precision_finds_the_same(scale: float) -> None:
    strain, alpha, step, rows = states(scale, torch.float32)
    law = NACC.expand(len(alpha)).contiguous()
    found = ops.return_mapping(strain, alpha, step, law=law, params=rows)
    wanted = ops.return_mapping(
        strain.double(), alpha.double(), step.double(), law=law, params=rows.double()
    )
    for have, want in zip(found[:3], wanted[:3], strict=True):
        off = (have.double() - want).abs().max() / want.abs().max()
        assert float(off) < 1e-3 * max(scale, 0.01)


@pytest.mark.parametrize("scale", [1e-3, 0.05, 0.3])
def test_no_step_stores_energy_and_none_moves_twice(scale: float) -> None:
    strain, alpha, step, rows = states(scale, torch.float64)
    law = NACC.expand(len(alpha)).contiguous()
    elastic, plain = torch.zeros_like(law), rows.clone()
    plain[:, 5] = 0.0
    trial = ops.return_mapping(strain, alpha, step, law=elastic, params=plain)[0]
    after, moved, _, _ = ops.return_mapping(strain, alpha, step, law=law, params=rows)
    before, now = (ops.elastic_energy(e, law=law, params=rows) for e in (trial, after))
    assert bool((now <= before + 1e-12 * before.max()).all())
    again, still, _, _ = ops.return_mapping(after, moved, 0.0 * step, law=law, params=rows)
    torch.testing.assert_close(again, after, rtol=0.0, atol=1e-7 * float(after.abs().max()))
    torch.testing.assert_close(still, moved, rtol=0.0, atol=1e-7 * scale)


def test_nothing_pulls_more_than_the_strength_that_is_left() -> None:
    strain, alpha, step, rows = states(0.05, torch.float64)
    law = NACC.expand(len(alpha)).contiguous()
    _, moved, stress, _ = ops.return_mapping(strain, alpha, step, law=law, params=rows)
    xx, yy, zz, xy, xz, yz = stress.unbind(dim=1)
    tensor = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).view(-1, 3, 3)
    left = rows[:, 3] * rows[:, 1] * torch.sinh(rows[:, 4] * (-moved).clamp(min=0.0))
    most = torch.linalg.eigvalsh(tensor)[:, 2]
    assert bool((most <= left + 1e-6 * float(stress.abs().max())).all())


WAYS = {
    "sides held": (1.0, 0.0, 0.0),
    "sides free": (1.0, -NU, -NU),
    "along two axes": (1.0, 0.7, -0.6),
    "along three": (1.0, 0.9, 0.8),
    "sheared": (1.0, -1.0, 0.0),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_break_takes_its_energy_whichever_way_it_is_pulled(way: str) -> None:
    """The whole point of it: the ellipse takes 2 to 20 times as much on some of these paths."""
    strength, energy = 1e-3, 8.0
    table = row(strength, energy, crushing=50.0, friction=50.0)  # nothing slides
    rows, alpha = table[:, :8].contiguous(), table[:, 8].contiguous()
    strain = torch.zeros(1, 6, dtype=torch.float64)
    stress, work, steps = torch.zeros(1, 6, dtype=torch.float64), 0.0, 800
    start, size = float(alpha), -float(alpha) / steps
    direction = torch.tensor(WAYS[way], dtype=torch.float64)
    for _ in range(12 * steps):
        step = torch.diag(torch.expm1(size * direction))[None]
        strain, alpha, after, _ = ops.return_mapping(strain, alpha, step, law=NACC, params=rows)
        work += 0.5 * size * float(((stress + after)[0, :3] * direction).sum())
        if float(alpha) > start:  # a crack is a band whose sides are held by what is beside it
            direction = torch.tensor(WAYS["sides held"], dtype=torch.float64)
        stress = after
        if float(alpha) >= 0.0:
            break
    assert float(alpha) >= 0.0
    left = float(ops.elastic_energy(strain, law=NACC, params=rows))
    assert work - left == pytest.approx(energy, rel=0.01)


def test_the_answer_turns_with_what_is_asked() -> None:
    strain, alpha, step, rows = states(0.05, torch.float64)
    law = NACC.expand(len(alpha)).contiguous()
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())[
        0
    ]
    turn = turn * torch.linalg.det(turn).sign()
    _, plain, stress, _ = ops.return_mapping(strain, alpha, step, law=law, params=rows)
    _, turned, other, _ = ops.return_mapping(
        strain, alpha, turn @ step @ turn.T, law=law, params=rows
    )
    torch.testing.assert_close(turned, plain, rtol=0.0, atol=1e-9)
    back = turn.T @ reference.to_matrix(other) @ turn
    near = 1e-6 * float(stress.abs().max())
    torch.testing.assert_close(back, reference.to_matrix(stress), rtol=0.0, atol=near)


def test_what_has_parted_closes_before_it_presses() -> None:
    table = row(1e-3, 8.0)
    rows = table[:, :8].contiguous()
    strain, alpha = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)[None]
    options = {"law": NACC, "params": rows}
    strain, alpha, stress, _ = ops.return_mapping(strain, alpha, 0.01 * eye, **options)
    assert float(stress.abs().max()) < 1e-9 * YOUNG
    assert float(alpha) == pytest.approx(3.0 * math.log(1.01))
    back = 1.0 / 1.01
    strain, alpha, stress, _ = ops.return_mapping(strain, alpha, (back - 1.0) * eye, **options)
    assert float(stress.abs().max()) < 1e-9 * YOUNG
    assert float(alpha) == pytest.approx(0.0, abs=1e-12)
    _, _, stress, _ = ops.return_mapping(strain, alpha, -0.01 * eye, **options)
    assert float(stress[0, 0]) == pytest.approx(-3.0 * KAPPA * 0.01, rel=0.05)


def test_pressed_matter_holds_its_compressive_strength_and_slides_when_broken() -> None:
    table = row(1e-3, 8.0, crushing=6.0, friction=1.2)
    rows = table[:, :8].contiguous()
    strain = torch.zeros(2, 6, dtype=torch.float64)
    alpha = torch.tensor([float(table[0, 8]), 0.0], dtype=torch.float64)
    step = torch.diag(torch.tensor([-0.05, 0.02, 0.02], dtype=torch.float64)).expand(2, 3, 3)
    law = NACC.expand(2).contiguous()
    _, _, stress, _ = ops.return_mapping(
        strain, alpha, step.contiguous(), law=law, params=rows.expand(2, 8).contiguous()
    )
    p = -stress[:, :3].mean(dim=1)
    q = (stress[:, 0] - stress[:, 1]).abs()
    most = torch.stack([torch.maximum(torch.tensor(6e-3 * YOUNG), 1.2 * p[0]), 1.2 * p[1]])
    torch.testing.assert_close(q, most.double(), rtol=1e-5, atol=0.0)


def test_gradients_follow_the_definition() -> None:
    strain, alpha, step, rows = (v[4:6].clone() for v in states(0.05, torch.float64))
    law = NACC.expand(len(alpha)).contiguous()
    strain, alpha, step = (v.requires_grad_() for v in (strain, alpha, step))

    def through(*given: Tensor) -> tuple[Tensor, ...]:
        return ops.return_mapping(*given, law=law, params=rows)[:3]

    assert torch.autograd.gradcheck(through, (strain, alpha, step), eps=1e-6, atol=1e-4, rtol=1e-3)


def test_a_grid_keeps_energy_and_strength() -> None:
    glass = materials.get("glass").override(surface="rankine", variation=0.0, weibull_modulus=0.0)
    dx = 2e-4
    rows, alpha = brittle_rows(
        glass, lambda field: torch.full((3,), float(field)).double(), torch.ones(3).double(), dx
    )
    size = rows[:, 3] * rows[:, 1]
    strength = size * torch.sinh(rows[:, 4] * alpha.abs())
    wanted = float(glass.strengths()[0]) * kept_strength(glass, dx)
    assert strength.tolist() == pytest.approx([wanted] * 3)
    energy = size * (torch.cosh(rows[:, 4] * alpha.abs()) - 1.0) / rows[:, 4]
    assert (energy * BAND_CELLS * dx).tolist() == pytest.approx([8.0] * 3)
    assert kept_strength(glass, 1.0) < kept_strength(glass, 2e-4)


def test_rankine_is_given_by_handbooks_alone() -> None:
    with pytest.raises(InputError, match="surface 'rankine' takes law 'nacc' with"):
        materials.get("glass").override(surface="rankine", alpha0=-0.1)
    with pytest.raises(InputError, match="surface"):
        materials.get("jelly").override(surface="rankine")
    back = materials.get("glass").override(surface="rankine").override(surface="cam_clay")
    assert back.parameters().tolist() == materials.get("glass").parameters().tolist()
