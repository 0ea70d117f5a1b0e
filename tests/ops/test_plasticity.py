"""return_mapping and elastic_energy: reference, gradients, registration, errors, parity."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent.materials import LAWS
from gsfluent.ops import elastic_energy, return_mapping
from gsfluent.ops.reference import plasticity as reference

DTYPES = [torch.float32, torch.float64]


def tables(dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Elastic rubber, watermelon flesh, hard rind with shear damage, fully frictionless milk."""
    mu, kappa = 724.6, 2777.8
    rows = [
        [mu, kappa, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [mu, kappa, 1.85, 0.3, 3.0, 0.0, 1.0, 0.0],
        [10 * mu, 10 * kappa, 2.36, 0.25, 1.0, 0.3, 2.0, 0.0],
        [0.1 * mu, kappa, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0],
    ]
    law = torch.tensor([0, 1, 1, 1], dtype=torch.int32)
    return {"law": law, "params": torch.tensor(rows, dtype=dtype)}


def states(count: int, scale: float = 0.05, dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    """Strained particles of all materials; about half of them yield."""
    torch.manual_seed(11)
    f = torch.eye(3, dtype=torch.float64) + scale * torch.randn(count, 3, 3, dtype=torch.float64)
    strain = reference.to_sym(f @ f.mT - torch.eye(3, dtype=torch.float64))
    alpha = -0.06 * torch.rand(count, dtype=torch.float64) + 0.005
    increment = 0.4 * scale * torch.randn(count, 3, 3, dtype=torch.float64)
    material = torch.randint(0, 4, (count,), dtype=torch.int32)
    return {
        "args": (strain.to(dtype), alpha.to(dtype), increment.to(dtype)),
        "material": material,
    }


def call(op: Any, s: dict[str, Any], dtype: torch.dtype = torch.float64, **options: Any) -> Any:
    return op(*s["args"], **tables(dtype), material=s["material"], **options)


@pytest.mark.parametrize("implicit", [True, False])
@pytest.mark.parametrize(("k", "epsilon"), [(2.0, 0.1), (2.0, 0.0), (8.0, 0.05)])
def test_float64_matches_the_reference(implicit: bool, k: float, epsilon: float) -> None:
    s = states(4000)
    got = call(return_mapping, s, k=k, epsilon=epsilon, implicit=implicit)
    want = call(reference.return_mapping, s, k=k, epsilon=epsilon, implicit=implicit)
    assert 500 < int(got[3][0]) < 3000
    assert torch.equal(got[3], want[3])
    for g, w in zip(got[:3], want[:3], strict=True):
        assert (g - w).abs().max() <= 1e-12 * w.abs().max()


@pytest.mark.parametrize("op", [return_mapping, reference.return_mapping])
def test_both_precisions_take_the_same_of_several_roots(op: Any) -> None:
    """Steps that overshoot a brittle surface several times over: alpha has up to three roots."""
    generator = torch.Generator().manual_seed(6)
    strain = 0.1 * (torch.rand(4000, 6, generator=generator) - 0.5)
    alpha = -0.08 * torch.rand(4000, generator=generator)
    increment = 0.05 * (torch.rand(4000, 3, 3, generator=generator) - 0.5)
    params = torch.tensor([[3.6e4, 1.2e5, 1.85, 0.6, 3.0, 0.0, 1.0, 0.0]])
    law = torch.ones(1, dtype=torch.int32)
    got = op(strain, alpha, increment, law=law, params=params)
    wide = (strain.double(), alpha.double(), increment.double())
    want = op(*wide, law=law, params=params.double())
    assert (got[1].double() - want[1]).abs().max() < 1e-5


@pytest.mark.parametrize("implicit", [True, False])
def test_float32_matches_the_float64_reference(implicit: bool) -> None:
    s = states(4000, dtype=torch.float32)
    got = call(return_mapping, s, torch.float32, implicit=implicit)
    wide = {"args": tuple(a.double() for a in s["args"]), "material": s["material"]}
    want = reference.return_mapping(
        *wide["args"],
        law=tables()["law"],
        params=tables(torch.float32)["params"].double(),
        material=s["material"],
        implicit=implicit,
    )
    for g, w in zip(got[:3], want[:3], strict=True):
        assert (g.double() - w).abs().max() <= 1e-5 * w.abs().max()


def test_guards_match_the_reference() -> None:
    eye = torch.eye(3, dtype=torch.float64)
    increments = torch.stack(
        [
            torch.diag(torch.tensor([-0.9, -0.9, -0.9])).double(),  # J = 0.001
            2.0 * eye,  # J = 27
            torch.diag(torch.tensor([20.0, -0.9, 0.0])).double(),  # too sheared
            torch.diag(torch.tensor([300.0, 0.0, 0.0])).double(),  # strain beyond the bound
            torch.diag(torch.tensor([-1.5, 0.0, 0.0])).double(),  # inside out
            torch.diag(torch.tensor([float("nan"), 0.0, 0.0])).double(),
        ]
    )
    for law in (0, 1):
        args = (torch.zeros(6, 6).double(), torch.full((6,), -0.04).double(), increments)
        table = {"law": torch.tensor([law], dtype=torch.int32), "params": tables()["params"][1:2]}
        got = return_mapping(*args, **table)
        want = reference.return_mapping(*args, **table)
        assert got[3].tolist()[1:] == [5, 1, 1]
        assert torch.equal(got[3], want[3])
        for g, w in zip(got[:3], want[:3], strict=True):
            assert torch.isfinite(g).all()
            assert (g - w).abs().max() <= 1e-12 * w.abs().max()
        volume = torch.linalg.det(reference.to_matrix(got[0]) + eye).sqrt()
        assert volume.min() > 0.049
        assert volume.max() < 20.1
        assert torch.equal(got[0][5], torch.zeros(6).double())


def test_one_row_for_all_and_one_row_each_agree_with_material_rows() -> None:
    s = states(64)
    t = tables()
    each = {"law": t["law"][s["material"].long()], "params": t["params"][s["material"].long()]}
    for g, w in zip(return_mapping(*s["args"], **each), call(return_mapping, s), strict=True):
        assert torch.equal(g, w)
    one = {"law": t["law"][1:2], "params": t["params"][1:2]}
    rows = torch.ones(64, dtype=torch.int32)
    by_row = return_mapping(*s["args"], **t, material=rows)
    for g, w in zip(return_mapping(*s["args"], **one), by_row, strict=True):
        assert torch.equal(g, w)


def test_empty_and_single_particle() -> None:
    t = {"law": torch.tensor([1], dtype=torch.int32), "params": tables()["params"][1:2]}
    empty = return_mapping(
        torch.zeros(0, 6).double(), torch.zeros(0).double(), torch.zeros(0, 3, 3).double(), **t
    )
    assert [list(v.shape) for v in empty] == [[0, 6], [0], [0, 6], [4]]
    assert empty[3].tolist() == [0, 0, 0, 0]
    one = return_mapping(
        torch.zeros(1, 6).double(),
        torch.full((1,), -0.04).double(),
        torch.zeros(1, 3, 3).double(),
        **t,
    )
    assert torch.equal(one[0], torch.zeros(1, 6).double())
    assert torch.equal(one[2], torch.zeros(1, 6).double())


def test_stress_is_the_derivative_of_the_energy() -> None:
    """tau = 2 (dPsi/db) b for an isotropic law."""
    s = states(50)
    strain = s["args"][0].clone().requires_grad_(True)
    still = torch.zeros(50, 3, 3).double()
    table = {"law": torch.zeros(1, dtype=torch.int32), "params": tables()["params"][:1]}
    (g,) = torch.autograd.grad(elastic_energy(strain, **table).sum(), strain)
    g = torch.cat([g[:, :3], 0.5 * g[:, 3:]], dim=1)  # off-diagonals appear twice
    b = reference.to_matrix(strain.detach()) + torch.eye(3).double()
    want = 2.0 * reference.to_matrix(g) @ b
    tau = return_mapping(strain.detach(), s["args"][1], still, **table)[2]
    assert (reference.to_matrix(tau) - want).abs().max() < 1e-10 * want.abs().max()


def test_energy_keeps_its_digits_at_small_strain() -> None:
    strain = torch.zeros(1, 6)
    strain[0, 3] = 2e-6  # simple shear of 2e-6: Psi = mu gamma^2 / 2
    table = {
        "law": torch.zeros(1, dtype=torch.int32),
        "params": tables(torch.float32)["params"][:1],
    }
    mu = float(table["params"][0, 0])
    assert float(elastic_energy(strain, **table)) == pytest.approx(0.5 * mu * 4e-12, rel=1e-4)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("scale", [1e-6, 0.05, 1.0])
def test_the_compiled_energy_is_that_of_the_reference(scale: float, device: str) -> None:
    """Of states turned inside out, too: no number in both."""
    strain = states(3000, scale)["args"][0]
    strain[::7, :3] *= -1.0
    t, material = tables(), states(3000)["material"]
    given = {"law": t["law"], "params": t["params"], "material": material}
    want = elastic_energy(strain.requires_grad_(), **given).detach()
    there = {name: value.to(device) for name, value in given.items()}
    found = elastic_energy(strain.detach().to(device), **there).cpu()
    number = torch.isfinite(want)
    assert bool(number.any()) and torch.equal(torch.isfinite(found), number)
    # det b loses digits where a large strain leaves little of a volume
    rtol = 1e-7 if scale == 1.0 else 3e-12
    torch.testing.assert_close(found[number], want[number], rtol=rtol, atol=0.0)


def test_energies_of_several_laws_are_each_its_own() -> None:
    strain, material = states(60)["args"][0], torch.arange(60, dtype=torch.int32) % 2
    t = {
        "law": torch.tensor([LAWS["nacc"], LAWS["corotated"]], dtype=torch.int32),
        "params": tables()["params"][1:3].contiguous(),
    }
    found = elastic_energy(strain, **t, material=material)
    for row in (0, 1):
        alone = {name: value[row : row + 1] for name, value in t.items()}
        assert torch.equal(found[row::2], elastic_energy(strain[row::2], **alone))


@pytest.mark.parametrize("implicit", [True, False])
def test_gradients(implicit: bool) -> None:
    s = states(12)
    inputs = [a.clone().requires_grad_(True) for a in s["args"]]
    t = tables()
    params = t["params"][:3].clone().requires_grad_(True)
    material = s["material"] % 3

    def f(strain: Tensor, alpha: Tensor, increment: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
        out = return_mapping(
            strain,
            alpha,
            increment,
            law=t["law"][:3].contiguous(),
            params=params * scale,
            material=material,
            implicit=implicit,
        )
        return out[0], out[1], out[2] / 1e3

    scale = torch.ones(3, 8, dtype=torch.float64, requires_grad=True)
    assert int(call(return_mapping, s)[3][0]) >= 4
    assert torch.autograd.gradcheck(f, (*inputs, scale), fast_mode=True)


def test_registration() -> None:
    s = states(8)
    t = tables()
    tail = (t["law"], t["params"], s["material"], 2.0, 0.1, True)
    torch.library.opcheck(torch.ops.gsfluent.return_mapping.default, (*s["args"], *tail))
    grads = [a.clone().requires_grad_(True) for a in s["args"]]
    torch.library.opcheck(torch.ops.gsfluent.return_mapping.default, (*grads, *tail))
    stored = (s["args"][0], t["params"], s["material"])
    torch.library.opcheck(torch.ops.gsfluent.neo_hookean_energy.default, stored)
    compiled = torch.compile(return_mapping, fullgraph=True, backend="aot_eager")
    for g, w in zip(call(compiled, s), call(return_mapping, s), strict=True):
        assert torch.equal(g, w)


def test_errors_name_the_argument() -> None:
    s = states(4)
    strain, alpha, increment = s["args"]
    t = {"law": torch.tensor([1], dtype=torch.int32), "params": tables()["params"][1:2].clone()}
    with pytest.raises(TypeError, match="strain must be float32 or float64"):
        return_mapping(strain.half(), alpha, increment, **t)
    with pytest.raises(TypeError, match="alpha must be float64"):
        return_mapping(strain, alpha.float(), increment, **t)
    with pytest.raises(ValueError, match=r"increment must have shape \[4, 3, 3\]"):
        return_mapping(strain, alpha, increment[:3], **t)
    with pytest.raises(ValueError, match=r"params must have shape"):
        return_mapping(strain, alpha, increment, law=t["law"], params=t["params"][:, :7])
    with pytest.raises(ValueError, match="1 or N = 4 rows"):
        return_mapping(strain, alpha, increment, **tables_rows(2))
    with pytest.raises(ValueError, match="epsilon must be in"):
        return_mapping(strain, alpha, increment, **t, epsilon=1.0)
    with pytest.raises(ValueError, match="k must not be negative"):
        return_mapping(strain, alpha, increment, **t, k=-1.0)
    with pytest.raises(ValueError, match=r"material must hold rows 0 to 0 of params, got 0 to 7"):
        rows = torch.tensor([0, 0, 7, 0], dtype=torch.int32)
        return_mapping(strain, alpha, increment, **t, material=rows)
    with pytest.raises(NotImplementedError, match="fixed centre"):
        return_mapping(strain.clone().requires_grad_(), alpha, increment, **t, k=float("inf"))


def tables_rows(rows: int) -> dict[str, Tensor]:
    return {"law": torch.ones(rows, dtype=torch.int32), "params": tables()["params"][:rows]}


def test_unknown_law_is_refused_also_after_an_in_place_change() -> None:
    s = states(4)
    law, params = torch.tensor([1], dtype=torch.int32), tables()["params"][1:2].clone()
    return_mapping(*s["args"], law=law, params=params)
    law[0] = 11
    with pytest.raises(ValueError, match="law must be one of 0"):
        return_mapping(*s["args"], law=law, params=params)
    law[0] = 1
    for column, value, name in ((1, 0.0, "kappa"), (3, -1.0, "cohesion"), (0, float("nan"), "mu")):
        wrong = params.clone()
        wrong[0, column] = value
        with pytest.raises(ValueError, match=rf"params\[0\] {name} must be"):
            return_mapping(*s["args"], law=law, params=wrong)


def test_raw_operator_counts_bad_rows_instead_of_reading_them() -> None:
    s = states(4)
    rows = torch.tensor([1, -1, 4, 2**31 - 1], dtype=torch.int32)
    t = tables()
    out = torch.ops.gsfluent.return_mapping(*s["args"], t["law"], t["params"], rows, 2.0, 0.1, True)
    assert int(out[3][3]) == 3
    assert torch.equal(out[2][1:], torch.zeros(3, 6).double())


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("implicit", [True, False])
def test_cuda_matches_cpu(dtype: torch.dtype, implicit: bool) -> None:
    s = states(4000, dtype=dtype)
    t = tables(dtype)
    want = return_mapping(*s["args"], **t, material=s["material"], implicit=implicit)
    got = return_mapping(
        *(a.cuda() for a in s["args"]),
        law=t["law"].cuda(),
        params=t["params"].cuda(),
        material=s["material"].cuda(),
        implicit=implicit,
    )
    bound = 2e-4 if dtype == torch.float32 else 1e-10
    for g, w in zip(got[:3], want[:3], strict=True):
        assert (g.cpu() - w).abs().max() <= bound * w.abs().max()
    assert (got[3].cpu() - want[3]).abs().max() <= (8 if dtype == torch.float32 else 0)
