"""csrc/core through pybind11: one particle, one fit, against NumPy and the tensor ops."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
import pytest
import torch

from gsfluent import ops

core = pytest.importorskip("gsfluent._core", reason="built without gsfluent._core (pybind11)")
MODULES = [(core.float32, np.float32, 2e-5), (core.float64, np.float64, 1e-12)]
MU, KAPPA = 724.6, 2777.8


@pytest.mark.parametrize(("module", "dtype", "tolerance"), MODULES)
def test_svd_rebuilds_the_matrix(module: ModuleType, dtype: type, tolerance: float) -> None:
    rng = np.random.default_rng(0)
    for scale in (1e-6, 1.0, 1e6):
        f = (scale * rng.standard_normal((3, 3))).astype(dtype)
        u, sigma, v = module.svd3(f)
        assert np.abs(u @ np.diag(sigma) @ v.T - f).max() < tolerance * scale * 10
        assert np.linalg.det(u) == pytest.approx(1.0, abs=tolerance * 10)
        assert np.linalg.det(v) == pytest.approx(1.0, abs=tolerance * 10)
        assert sigma[0] >= sigma[1] >= abs(sigma[2])
        want = np.linalg.svd(f.astype(np.float64), compute_uv=False)
        assert np.abs(np.abs(sigma) - want).max() < tolerance * scale * 10


@pytest.mark.parametrize(("module", "dtype", "tolerance"), MODULES)
def test_one_particle_equals_the_tensor_op(
    module: ModuleType, dtype: type, tolerance: float
) -> None:
    rng = np.random.default_rng(1)
    material = module.Material(MU, KAPPA, 1.85, 0.3, 3.0, 0.2)
    params = np.array([[MU, KAPPA, 1.85, 0.3, 3.0, 0.2, 1.0, 0.0]], dtype=dtype)
    law = torch.tensor([1], dtype=torch.int32)
    strain = (0.05 * rng.standard_normal((50, 6))).astype(dtype)
    increment = (0.05 * rng.standard_normal((50, 3, 3))).astype(dtype)
    alpha = np.full(50, -0.04, dtype=dtype)
    got = ops.return_mapping(
        torch.from_numpy(strain),
        torch.from_numpy(alpha),
        torch.from_numpy(increment),
        law=law,
        params=torch.from_numpy(params),
    )
    plastic = 0
    for i in range(50):
        one = module.return_mapping(strain[i], alpha[i], increment[i], 1, material)
        plastic += one["plastic"]
        assert np.abs(one["strain"] - got[0][i].numpy()).max() < tolerance
        assert one["alpha"] == pytest.approx(float(got[1][i]), abs=tolerance)
        assert np.abs(one["stress"] - got[2][i].numpy()).max() < tolerance * KAPPA
    assert plastic == int(got[3][0]) > 10


@pytest.mark.parametrize(("module", "dtype", "tolerance"), MODULES)
def test_energy_equals_the_python_helper(module: ModuleType, dtype: type, tolerance: float) -> None:
    rng = np.random.default_rng(2)
    law = torch.zeros(1, dtype=torch.int32)
    params = torch.tensor([[MU, KAPPA, 0, 0, 0, 0, 1, 0]], dtype=torch.float64)
    for scale in (1e-5, 1e-2, 0.2):
        strain = (scale * rng.standard_normal(6)).astype(dtype)
        wide = torch.from_numpy(strain.astype(np.float64))[None]
        want = float(ops.elastic_energy(wide, law=law, params=params))
        relative = 10 * tolerance if dtype == np.float32 else 1e-9
        assert module.elastic_energy(strain, MU, KAPPA) == pytest.approx(want, rel=relative)


@pytest.mark.parametrize(("module", "dtype", "tolerance"), MODULES)
def test_one_fit_equals_the_tensor_op(module: ModuleType, dtype: type, tolerance: float) -> None:
    points = np.random.default_rng(3).standard_normal((30, 3)).astype(dtype)
    center, shape = module.mvee(points)
    want_center, want_shape = ops.mvee(torch.from_numpy(points)[None])
    assert np.abs(center - want_center[0].numpy()).max() < tolerance
    assert np.abs(shape - want_shape[0].numpy()).max() < tolerance * np.abs(shape).max()


def test_ball_lens_is_tight_at_its_contacts() -> None:
    """Equal balls: the ellipsoid passes through the rim and both poles of the lens."""
    center, axial, radial, overlap = core.float64.ball_lens(1.0, 1.0, 1.2)
    assert overlap
    assert center == pytest.approx(0.6)
    assert axial == pytest.approx(1.0 - 0.6)
    assert radial == pytest.approx((1.0 - 0.36) ** 0.5)
    assert not core.float64.ball_lens(1.0, 1.0, 2.0)[3]


def test_ball_lens_is_continuous_between_its_cases() -> None:
    distances = np.linspace(0.11, 1.89, 4001)
    shapes = np.array([core.float64.ball_lens(1.0, 0.9, d)[:3] for d in distances])
    assert np.abs(np.diff(shapes, axis=0)).max() < 5e-3


def test_errors_name_the_argument() -> None:
    with pytest.raises(ValueError, match=r"strain must have shape \[6\]"):
        core.float64.return_mapping(
            np.zeros(5), 0.0, np.zeros((3, 3)), 0, core.float64.Material(1.0, 1.0)
        )
    with pytest.raises(ValueError, match="law must be 0 to 9"):
        core.float64.return_mapping(
            np.zeros(6), 0.0, np.zeros((3, 3)), 10, core.float64.Material(1.0, 1.0)
        )
    with pytest.raises(ValueError, match="at least one point"):
        core.float64.mvee(np.zeros((0, 3)))


def test_sums_have_no_order() -> None:
    """The same bits in any order, as near the exact sum as doubles are, far below the bound too."""
    rng = np.random.default_rng(2)
    values = rng.standard_normal(5000) * 10.0 ** rng.uniform(-16, 0, 5000)
    values = values.astype(np.float32).astype(np.float64)
    bound = 1e3 * np.abs(values).max()  # a loose one
    sums = {
        core.float64.order_free_sum(rng.permutation(values), bound, most)
        for most in (5000, 8192)
        for _ in range(5)
    }
    exact = math.fsum(values)
    assert len(sums) == 1  # every addend of float32 is held exactly
    assert sums.pop() == pytest.approx(exact, rel=1e-15)


def test_order_free_sums_reach_their_bound_and_refuse_what_is_above() -> None:
    for most in (1, 2, 4096, 1 << 26):
        count = min(most, 4096)
        for bound in (1e-30, 1.0, 2.0, 3e38):
            full = np.full(count, bound)
            total = core.float64.order_free_sum(full, bound, most)
            assert total == pytest.approx(count * bound, rel=2**-35 / most + 1e-15)
            total = core.float64.order_free_sum(np.concatenate([full, -full]), bound, 2 * most)
            assert total == 0.0
    assert core.float64.order_free_sum(np.zeros(3), 0.0, 3) == 0.0
    for wrong in (np.nan, np.inf, -np.inf, 2.5):
        with pytest.raises(ValueError, match="not finite or above"):
            core.float64.order_free_sum(np.array([1.0, wrong]), 1.0, 2)
