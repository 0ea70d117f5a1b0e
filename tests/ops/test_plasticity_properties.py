"""Properties of the return mapping over a million extreme states and along its own tips."""

from __future__ import annotations

import functools

import pytest
import torch
from plasticity_svd import return_mapping_svd
from torch import Tensor

from gsfluent.ops import return_mapping
from gsfluent.ops.reference import plasticity as reference
from gsfluent.ops.reference.tensors import diagonal

NACC = torch.tensor([1], dtype=torch.int32)
EYE = torch.eye(3, dtype=torch.float64)
DTYPES = [torch.float32, torch.float64]
ALPHA_0 = -0.04


def moduli(young: float, poisson: float) -> tuple[float, float]:
    mu = young / (2.0 * (1.0 + poisson))
    return mu, young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)) + 2.0 * mu / 3.0


def material(cohesion: float = 0.6, hardening: float = 3.0, eta: float = 0.0) -> Tensor:
    """Watermelon flesh of equations.md section 17 by default."""
    mu, kappa = moduli(2e3, 0.38)
    return torch.tensor([[mu, kappa, 1.85, cohesion, hardening, eta, 1.0, 0.0]]).double()


def rotations(count: int) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(torch.randn(4, count, dtype=torch.float64), dim=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(r, dim=1) for r in rows], dim=1)


def stretched(sigma: Tensor) -> Tensor:
    n = sigma.shape[0]
    return (rotations(n) * sigma[:, None, :]) @ rotations(n)


@functools.cache
def extreme_states(count: int) -> dict[str, Tensor]:
    """The seven families of equations.md section 7.5: trial deformation gradients, float64."""
    torch.manual_seed(7)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 3, dtype=torch.float64)

    flipped = torch.exp(uniform(-2.0, 2.0))
    flipped[:, 2] *= -1.0
    flat = torch.exp(uniform(-2.0, 2.0))
    flat[:, 2] = 0.0
    flat[: count // 4, 1] = 0.0
    return {
        "mild": EYE + 0.1 * torch.randn(count, 3, 3, dtype=torch.float64),
        "strong": EYE + 0.6 * torch.randn(count, 3, 3, dtype=torch.float64),
        "thousandfold": stretched(10.0 ** uniform(-3.0, 3.0)),
        "trillionfold": stretched(10.0 ** uniform(-12.0, 12.0)),
        "inverted": stretched(flipped),
        "singular": stretched(flat),
        "isotropic": 10.0 ** uniform(-3.0, 3.0)[:, :1, None] * EYE,
    }


def energy(trace_b: Tensor, j: Tensor, params: Tensor) -> Tensor:
    mu, kappa = float(params[0, 0]), float(params[0, 1])
    volumetric = (j * j - 1.0) / 2.0 - torch.log(j)
    return 0.5 * mu * (j ** (-2.0 / 3.0) * trace_b - 3.0) + 0.5 * kappa * volumetric


def run(f: Tensor, params: Tensor, dtype: torch.dtype, alpha: Tensor | None = None, **options):
    """Return map from rest by A = F - I; also the F that the op saw, in float64."""
    increment = (f - EYE).to(dtype)
    if alpha is None:
        alpha = torch.full((f.shape[0],), ALPHA_0)
    rest = torch.zeros(f.shape[0], 6, dtype=dtype)
    table = params.to(dtype)
    out = return_mapping(rest, alpha.to(dtype), increment, law=NACC, params=table, **options)
    return out, increment.double() + EYE


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("implicit", "count"), [(True, 150_000), (False, 20_000)])
def test_million_extreme_states_stay_finite_and_gain_no_energy(
    dtype: torch.dtype, implicit: bool, count: int
) -> None:
    params = material(eta=0.3)
    for name, f in extreme_states(count).items():
        (strain, alpha, stress, info), seen = run(f, params, dtype, implicit=implicit)
        assert int(info[3]) == 0, name
        for value in (strain, alpha, stress):
            assert torch.isfinite(value).all(), name
        b = reference.to_matrix(strain.double()) + EYE
        det = torch.linalg.det(b)
        assert (det > 0).all(), name
        j = torch.linalg.det(seen)
        proper = j > 0
        if name in ("inverted", "singular") and not proper.any():
            continue
        before = energy((seen * seen).sum((1, 2)), j.clamp(min=1e-300), params)[proper]
        after = energy(b.diagonal(dim1=1, dim2=2).sum(1), det.clamp(min=1e-300).sqrt(), params)
        gain = after[proper] - before
        slack = 1e-12 if dtype == torch.float64 else 2e-5
        assert (gain <= slack * (before.abs() + float(params[0, 1]))).all(), (name, gain.max())


@functools.cache
def mild_states(count: int = 8_000) -> Tensor:
    """Trial states that no clamp of either form touches."""
    torch.manual_seed(3)
    scale = 10.0 ** (-4.0 + 3.5 * torch.rand(count, 1, 1, dtype=torch.float64))
    f = EYE + scale * torch.randn(count, 3, 3, dtype=torch.float64)
    sigma = torch.linalg.svdvals(f)
    j = torch.linalg.det(f)
    return f[(sigma[:, 2] > 0.06) & (sigma[:, 0] < 5.0) & (j > 0.06)]


@pytest.mark.parametrize("implicit", [True, False])
@pytest.mark.parametrize("cohesion", [0.1, 0.3, 0.6, 5.0])
@pytest.mark.parametrize("k", [2.0, 8.0])
def test_equals_the_svd_form(implicit: bool, cohesion: float, k: float) -> None:
    f = mild_states()
    params = material(cohesion, eta=0.2)
    (strain, alpha, _, info), _ = run(f, params, torch.float64, implicit=implicit, k=k)
    old = torch.full((len(f),), ALPHA_0).double()
    columns = reference.gather_material(params, None, len(f))
    # The implicit result lies on the surface of the new alpha and implies that alpha.
    want = return_mapping_svd(f, alpha if implicit else old, columns, k=k)
    assert int(info[0]) > len(f) // 8
    assert int(info[1]) == 0
    assert (reference.to_matrix(strain) + EYE - want.b).abs().max() < 1e-12
    assert (old + want.alpha_step - alpha).abs().max() < 1e-12


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("implicit", [True, False])
def test_mapping_twice_with_frozen_alpha_is_mapping_once(
    dtype: torch.dtype, implicit: bool
) -> None:
    params = material(hardening=3.0)
    (strain, alpha, stress, _), _ = run(mild_states(), params, dtype, implicit=implicit)
    # Frozen: the second pass sees the surface the first one ended on.
    surface = alpha if implicit else torch.full_like(alpha, ALPHA_0)
    again = return_mapping(
        strain,
        surface,
        torch.zeros(len(strain), 3, 3, dtype=dtype),
        law=NACC,
        params=params.to(dtype),
        implicit=implicit,
    )
    bound = 2e-5 if dtype == torch.float32 else 1e-13
    assert (again[0] - strain).abs().max() < bound
    assert (again[1] - surface).abs().max() < bound
    assert (again[2] - stress).abs().max() < bound * float(params[0, 1])


@pytest.mark.parametrize("dtype", DTYPES)
def test_rotation_of_the_state_rotates_the_result(dtype: torch.dtype) -> None:
    f = mild_states()
    q = rotations(len(f))
    params = material()
    (strain, alpha, stress, _), _ = run(f, params, dtype)
    (turned, turned_alpha, turned_stress, _), _ = run(q @ f @ q.mT, params, dtype)
    bound = 5e-5 if dtype == torch.float32 else 1e-12

    def rotate(sym: Tensor) -> Tensor:
        return q @ reference.to_matrix(sym.double()) @ q.mT

    firm = (turned_alpha - alpha).abs() < bound
    # In float32 a state at the edge of brittle softening may fall on either side of it.
    assert firm.double().mean() > (0.999 if dtype == torch.float32 else 0.99999)
    assert (rotate(strain) - reference.to_matrix(turned.double()))[firm].abs().max() < bound
    error = rotate(stress) - reference.to_matrix(turned_stress.double())
    assert error[firm].abs().max() < bound * float(params[0, 1])


def states_at(u: Tensor, w: Tensor, params: Tensor) -> Tensor:
    """Strains whose normalized trial pressure and shear are (u, w) for alpha = ALPHA_0."""
    m = reference.gather_material(params, None, len(u))
    _, _, center, half, height = reference.yield_surface(m, torch.full_like(u, ALPHA_0))
    p, q = center + half * u, height * w
    d = (q / (1.5**0.5 * m.mu * 6.0**0.5))[:, None] * torch.tensor([2.0, -1, -1, 0, 0, 0])
    return reference.strain_from_isochoric(d, 0.5 * torch.log1p(-2.0 * p / m.kappa))


@pytest.mark.parametrize("tip", [1.0, -1.0])
@pytest.mark.parametrize(("implicit", "cohesion"), [(False, 0.6), (False, 5.0), (True, 0.25)])
def test_continuous_across_the_tips(tip: float, implicit: bool, cohesion: float) -> None:
    """Implicit brittle softening (cohesion * hardening > 1) snaps by design; see the docs."""
    params = material(cohesion)
    w = torch.tensor([0.1, 0.3, 1.0, 2.0, 4.0], dtype=torch.float64)
    sides = []
    for offset in (-1e-6, 1e-6):
        e = states_at(torch.full_like(w, tip * (1.0 + offset)), w, params)
        still = torch.zeros(len(w), 3, 3, dtype=torch.float64)
        alpha = torch.full_like(w, ALPHA_0)
        sides.append(return_mapping(e, alpha, still, law=NACC, params=params, implicit=implicit))
    kappa = float(params[0, 1])
    assert int(sides[0][3][0]) == len(w)  # all plastic, so that the test is about the map
    assert (sides[0][0] - sides[1][0]).abs().max() < 2e-5
    assert (sides[0][1] - sides[1][1]).abs().max() < 2e-5
    assert (sides[0][2] - sides[1][2]).abs().max() < 2e-5 * kappa


def test_fixed_centre_jumps_where_the_dynamic_one_does_not() -> None:
    params = material()
    w = torch.tensor([1.0], dtype=torch.float64)
    alphas = {}
    for k, epsilon in ((float("inf"), 0.0), (2.0, 0.1)):
        for offset in (-1e-6, 1e-6):
            e = states_at(torch.tensor([1.0 + offset], dtype=torch.float64), w, params)
            still = torch.zeros(1, 3, 3, dtype=torch.float64)
            alpha = torch.full_like(w, ALPHA_0)
            out = return_mapping(
                e, alpha, still, law=NACC, params=params, k=k, epsilon=epsilon, implicit=False
            )
            alphas[k, offset] = float(out[1])
    assert abs(alphas[float("inf"), -1e-6] - alphas[float("inf"), 1e-6]) > 1e-2
    assert abs(alphas[2.0, -1e-6] - alphas[2.0, 1e-6]) < 1e-5


def yield_value(strain: Tensor, alpha: Tensor, params: Tensor) -> Tensor:
    """u^2 + w^2 of the state on the surface of alpha; 1 on the surface."""
    m = reference.gather_material(params, None, len(alpha))
    x = torch.linalg.det(reference.to_matrix(strain) + EYE)
    d = x[:, None] ** (-1 / 3) * (strain - diagonal(strain[:, :3].mean(1)))
    norm = ((d[:, :3] ** 2).sum(1) + 2.0 * (d[:, 3:] ** 2).sum(1)).sqrt()
    u, w = reference.normalized(m, alpha, -0.5 * m.kappa * (x - 1.0), 1.5**0.5 * m.mu * norm)
    return u * u + w * w


def test_implicit_alpha_ends_on_the_updated_surface_and_explicit_does_not() -> None:
    params = material(eta=0.3)
    f = mild_states()
    (strain, alpha, _, info), _ = run(f, params, torch.float64)
    assert int(info[0]) > 500
    # Fully softened material has a surface of 1e-5 kappa: det(b) - 1 carries 1e-16 of 1e-5.
    assert yield_value(strain, alpha, params).max() < 1.0 + 1e-8
    (strain, alpha, _, _), _ = run(f, params, torch.float64, implicit=False)
    assert yield_value(strain, alpha, params).max() > 1.1


@pytest.mark.parametrize("law", [0, 1])
def test_elastic_domain_keeps_the_trial_strain_bit_for_bit(law: int) -> None:
    params = material()
    torch.manual_seed(5)
    increment = 1e-3 * torch.randn(500, 3, 3, dtype=torch.float64)
    e = 1e-3 * torch.randn(500, 6, dtype=torch.float64)
    alpha = torch.full((500,), ALPHA_0).double()
    laws = torch.tensor([law], dtype=torch.int32)
    strain, new_alpha, _, info = return_mapping(e, alpha, increment, law=laws, params=params)
    assert info.tolist() == [0, 0, 0, 0]
    assert torch.equal(new_alpha, alpha)
    g = increment + EYE
    want = g @ (reference.to_matrix(e) + EYE) @ g.mT - EYE
    assert (reference.to_matrix(strain) - want).abs().max() < 1e-15


def test_small_strains_keep_their_digits_in_float32() -> None:
    torch.manual_seed(6)
    increment = 1e-7 * torch.randn(200, 3, 3, dtype=torch.float64)
    params = material()
    (strain, _, stress, _), _ = run(increment + EYE, params, torch.float32)
    exact = increment.float().double()
    want = reference.to_sym(exact + exact.mT)
    assert (strain.double() - want).abs().max() < 1e-6 * want.abs().max()
    mu, kappa = float(params[0, 0]), float(params[0, 1])
    mean = want[:, :3].mean(1)
    hooke = 2 * mu * 0.5 * (want - diagonal(mean))
    hooke = hooke + diagonal(1.5 * kappa * mean)
    assert (stress.double() - hooke).abs().max() < 1e-5 * hooke.abs().max()


@pytest.mark.parametrize(
    ("column", "factor"),
    [("mu", 1.1), ("kappa", 1.1), ("friction", 0.8), ("cohesion", 0.5), ("hardening", 0.5)],
)
def test_every_parameter_changes_the_outcome(column: str, factor: float) -> None:
    index = {"mu": 0, "kappa": 1, "friction": 2, "cohesion": 3, "hardening": 4}[column]
    params = material()
    changed = params.clone()
    changed[0, index] *= factor
    f = mild_states(2000)
    base, _ = run(f, params, torch.float64)
    other, _ = run(f, changed, torch.float64)
    assert (base[0] - other[0]).abs().max() > 1e-3
    assert (base[1] - other[1]).abs().max() > 1e-3


def test_shear_damage_softens_simple_shear() -> None:
    shear = torch.zeros(1, 3, 3, dtype=torch.float64)
    shear[0, 0, 1] = 1e-3
    ends = []
    for eta in (0.0, 0.3):
        params = material(eta=eta)
        strain, alpha = torch.zeros(1, 6).double(), torch.full((1,), ALPHA_0).double()
        for _ in range(600):
            strain, alpha, _, _ = return_mapping(strain, alpha, shear, law=NACC, params=params)
        ends.append(float(alpha))
    assert ends[1] > ends[0] + 0.01


def test_tension_softens_and_compression_hardens() -> None:
    params = material()
    for sign, softer in ((1.0, True), (-1.0, False)):
        strain, alpha = torch.zeros(1, 6).double(), torch.full((1,), ALPHA_0).double()
        increment = sign * 1e-3 * EYE[None]
        for _ in range(150):
            strain, alpha, _, _ = return_mapping(strain, alpha, increment, law=NACC, params=params)
        assert (float(alpha) > ALPHA_0 + 0.01) == softer
        assert (float(alpha) < ALPHA_0 - 0.01) == (not softer)
