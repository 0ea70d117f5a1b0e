"""Whole differentiable steps: gradcheck, checkpointing, what a fit recovers."""

from __future__ import annotations

import math
import weakref
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from torch.utils._python_dispatch import TorchDispatchMode

from gsfluent import ops
from gsfluent.ops.plasticity import LAWS

DX = 0.125
F64 = torch.float64


def block(side: int = 3, low: float = 0.3) -> Tensor:
    """Side^3 particles, 8 per cell, lowest layer at height ``low``."""
    ticks = (torch.arange(side, dtype=F64) + 0.5) * 0.5 * DX
    return torch.cartesian_prod(ticks, ticks, ticks) + torch.tensor([0.31, 0.27, low], dtype=F64)


def floor(height: float, friction: float = 0.3, restitution: float = 0.0) -> Tensor:
    row = torch.zeros(1, 16, dtype=F64)
    row[0, [1, 2, 5, 8, 13]] = torch.tensor([2.0, friction, height, 1.0, restitution], dtype=F64)
    return row


def law(number: int) -> Tensor:
    return torch.tensor([number], dtype=torch.int32)


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=F64, requires_grad=True)


def common(x: Tensor, params: Tensor, laws: Tensor, dt: float, **more: Any) -> dict[str, Any]:
    volume = torch.full((len(x),), (0.5 * DX) ** 3, dtype=F64)
    return {
        "mass": 1000.0 * volume,
        "volume": volume,
        "dx": DX,
        "dt": dt,
        "law": laws,
        "params": params,
        **more,
    }


# --- gradcheck of several steps ---


def test_elastic_steps_on_a_floor() -> None:
    x = block()
    v = torch.tensor([0.7, 0.1, -3.0], dtype=F64) + 0.3 * torch.randn(len(x), 3, dtype=F64)

    def fall(x: Tensor, v: Tensor, young: Tensor, poisson: Tensor) -> tuple[Tensor, ...]:
        params = ops.material_params(young, poisson)
        state = ops.mpm_state(x, v, law=law(0), params=params)
        colliders = floor(0.34, 0.2)  # one node layer below the block's lower nodes
        state = ops.rollout(
            state, 5, **common(x, params, law(0), 1e-3, colliders=colliders), checkpoint_every=2
        )
        return state.position, state.velocity, state.strain

    inputs = (x.requires_grad_(), v.requires_grad_(), number(1e5), number(0.3))
    # the floor acts: without it the block would fall freely
    assert fall(*inputs)[1][:, 2].mean() > v[:, 2].mean() + 0.05
    assert gradcheck(fall, inputs, fast_mode=True, atol=1e-6)


@pytest.mark.parametrize("implicit", [True, False])
def test_nacc_steps_while_yielding(implicit: bool) -> None:
    x = block()
    x0 = x.mean(0)
    v = -6.0 * (x - x0) + torch.cross(torch.tensor([[0.0, 9.0, 40.0]]).double(), x - x0, dim=1)
    v = v + 2.0 * torch.randn(len(x), 3, dtype=F64)
    nacc = (1.85, 0.6, 3.0, 0.3)  # M, beta, xi, eta
    yielded = 0.0

    def crush(
        v: Tensor, alpha: Tensor, young: Tensor, poisson: Tensor, *strength: Tensor
    ) -> tuple[Tensor, ...]:
        names = ("friction", "cohesion", "hardening", "shear_damage")
        params = ops.material_params(young, poisson, **dict(zip(names, strength, strict=True)))
        state = ops.mpm_state(x, v, law=law(1), params=params, alpha=alpha)
        more = {"implicit": implicit, "checkpoint_every": 2, "colliders": floor(0.34)}
        state = ops.rollout(state, 4, **common(x, params, law(1), 2e-3, **more))
        nonlocal yielded
        yielded = float((state.alpha != alpha).double().mean())
        return state.position, state.velocity, state.alpha, state.stress / 1e3

    alpha = torch.full((len(x),), -0.02, dtype=F64)
    inputs = (v, alpha, number(1e5), number(0.3), *map(number, nacc))
    inputs[0].requires_grad_(), inputs[1].requires_grad_()
    crush(*inputs)
    assert yielded > 0.3
    assert gradcheck(crush, inputs, fast_mode=True, atol=1e-5, eps=1e-7)


ROWS = {  # mu, kappa, strength, cohesion, hardening, eta, density, exponent
    "drucker_prager": [4e4, 8e4, 0.2, 300.0, 0.0, 0.0, 1000.0, 0.0],
    "von_mises": [4e4, 8e4, 2e3, 0.0, 1e4, 0.0, 1000.0, 0.0],
    "fluid": [0.0, 8e4, 20.0, 0.0, 0.0, 0.0, 1000.0, 7.0],
    "corotated": [4e4, 8e4, 0.0, 0.0, 0.0, 0.0, 1000.0, 0.0],
    "yeoh": [4e4, 8e4, -3e3, 4e3, 0.0, 0.0, 1000.0, 0.0],
    "ogden": [4e4, 8e4, 1.3, 2e2, 5.0, -1e3, 1000.0, -2.0],
}


@pytest.mark.parametrize("name", ROWS)
def test_steps_of_other_laws(name: str) -> None:
    x = block()
    v = 6.0 * (x - x.mean(0)) + 2.0 * torch.randn(len(x), 3, dtype=F64)
    laws = law(LAWS[name])
    row = torch.tensor([ROWS[name]], dtype=F64)

    def deform(v: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
        params = row * scale
        state = ops.mpm_state(x, v, law=laws, params=params, alpha=torch.zeros(27, dtype=F64))
        state = ops.rollout(state, 3, **common(x, params, laws, 2e-3))
        return state.position, state.velocity, state.alpha, state.stress / 1e3

    inputs = (v.requires_grad_(), torch.ones(8, dtype=F64, requires_grad=True))
    if name in ("drucker_prager", "von_mises"):
        assert deform(*inputs)[2].detach().abs().max() > 1e-3  # it yields
    assert gradcheck(deform, inputs, fast_mode=True, atol=1e-5, eps=1e-7)


def test_two_fields_in_contact() -> None:
    x = torch.cat([block(), block() + torch.tensor([0.0, 0.0, 1.6 * DX], dtype=F64)])
    body = (torch.arange(len(x)) >= len(x) // 2).int()
    v = torch.zeros(len(x), 3, dtype=F64)
    v[:, 2] = torch.where(body == 0, 2.0, -2.0)
    v += 0.1 * torch.randn(len(x), 3, dtype=F64)
    params = ops.material_params(1e5, 0.3)

    def collide(v: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
        rows = params * scale
        state = ops.mpm_state(x, v, law=law(0), params=rows)
        more = {"body": body, "fields": 2, "contact_gap": 1.5, "friction": 0.1}
        state = ops.rollout(state, 3, **common(x, rows, law(0), 1e-3, **more))
        return state.position, state.velocity

    assert gradcheck(collide, (v.requires_grad_(), number(1.0)), fast_mode=True, atol=1e-6)


def test_rows_per_particle_and_by_index_agree() -> None:
    x, v = block(), torch.randn(27, 3, dtype=F64)
    young = torch.tensor([1e5, 3e5], dtype=F64)
    rows = (torch.arange(27) % 2).int()

    def gradient(per_particle: bool) -> Tensor:
        e = young.clone().requires_grad_()
        table = ops.material_params(e, 0.3)
        params = table[rows.long()] if per_particle else table
        index = None if per_particle else rows
        laws = torch.zeros(len(params), dtype=torch.int32)
        state = ops.mpm_state(x, v, law=laws, params=params, material=index)
        state = ops.rollout(state, 4, material=index, **common(x, params, laws, 1e-3))
        (g,) = torch.autograd.grad(state.position.square().sum(), e)
        return g

    assert (gradient(True) != 0).all()
    torch.testing.assert_close(gradient(True), gradient(False), rtol=1e-10, atol=0.0)


def test_float32_gradient_is_the_float64_one() -> None:
    x, kick = block(), torch.randn(27, 3, dtype=F64)

    def gradients(dtype: torch.dtype) -> list[Tensor]:
        v = kick.to(dtype).requires_grad_()
        young = torch.tensor(1e5, dtype=dtype, requires_grad=True)
        params = ops.material_params(young, 0.3, friction=1.85, cohesion=0.6, hardening=3.0)
        alpha = torch.full((27,), -0.01, dtype=dtype)
        state = ops.mpm_state(x.to(dtype), v, law=law(1), params=params, alpha=alpha)
        options = common(x, params, law(1), 2e-3, colliders=floor(0.34).to(dtype))
        options |= {name: options[name].to(dtype) for name in ("mass", "volume")}
        end = ops.rollout(state, 6, **options)
        loss = end.position.square().sum() + end.alpha.sum()
        return [g.double() for g in torch.autograd.grad(loss, (v, young))]

    for single, double in zip(gradients(torch.float32), gradients(F64), strict=True):
        assert (single - double).norm() < 1e-3 * double.norm()


# --- checkpointing ---


class Live(TorchDispatchMode):
    """Bytes of the tensors alive that were made inside, now and at the most."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.most = 0
        self.seen: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for t in out if isinstance(out, (tuple, list)) else [out]:
            if isinstance(t, Tensor):
                self.add(t)
        return out

    def add(self, t: Tensor) -> None:
        storage = t.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key in self.seen:
            return
        self.seen.add(key)
        self.now += size
        self.most = max(self.most, self.now)
        weakref.finalize(storage, self.remove, key, size)

    def remove(self, key: int, size: int) -> None:
        self.seen.discard(key)
        self.now -= size


def fly(steps: int, checkpoint_every: int | None) -> tuple[Tensor, Tensor, int]:
    torch.manual_seed(0)
    x = block(6)
    v = torch.randn(len(x), 3, dtype=F64, requires_grad=True)
    young = number(1e5)
    params = ops.material_params(young, 0.3)
    state = ops.mpm_state(x, v, law=law(0), params=params)
    options = common(x, params, law(0), 1e-3)
    with Live() as live:
        end = ops.rollout(state, steps, checkpoint_every=checkpoint_every, **options)
        g_v, g_e = torch.autograd.grad(end.position.square().sum(), (v, young))
    return g_v, g_e, live.most


def test_checkpoints_change_memory_and_nothing_else() -> None:
    everything = fly(32, 0)
    for every in (1, 4, 50, None):
        g_v, g_e, _ = fly(32, every)
        assert torch.equal(g_v, everything[0])
        assert torch.equal(g_e, everything[1])


def test_memory_grows_with_the_square_root() -> None:
    most = {steps: fly(steps, None)[2] for steps in (16, 64)}
    stored = {steps: fly(steps, 0)[2] for steps in (16, 64)}
    assert stored[64] / stored[16] == pytest.approx(4.0, rel=0.15)
    assert most[64] / most[16] == pytest.approx(2.0, rel=0.25)
    assert most[64] < 0.3 * stored[64]


def test_nothing_is_recorded_without_a_graph() -> None:
    x = block()
    params = ops.material_params(1e5, 0.3)
    state = ops.mpm_state(x, torch.zeros_like(x), law=law(0), params=params)
    end = ops.rollout(state, 3, **common(x, params, law(0), 1e-3))
    assert not end.position.requires_grad
    # free fall: v = -g t exactly, x by the symplectic sum
    torch.testing.assert_close(end.velocity[:, 2], torch.full((27,), -9.81e-3 * 3, dtype=F64))
    drop = 9.81e-6 * (1 + 2 + 3)
    torch.testing.assert_close(end.position[:, 2], x[:, 2] - drop, rtol=0, atol=1e-14)


# --- a fit ---


def test_fit_of_stiffness_and_velocity_from_a_bounce() -> None:
    """Young's modulus and initial velocity of a bouncing block from its trajectory, within 1 %."""
    x = block(4, low=0.42)
    dt, frames, per_frame = 2e-3, 6, 12

    def trajectory(v0: Tensor, log_young: Tensor) -> Tensor:
        params = ops.material_params(log_young.exp(), 0.3)
        state = ops.mpm_state(x, v0.expand(len(x), 3), law=law(0), params=params)
        options = common(x, params, law(0), dt, colliders=floor(0.375))
        seen = []
        for _ in range(frames):
            state = ops.rollout(state, per_frame, checkpoint_every=0, **options)
            seen.append(state.position)
        return torch.stack(seen)

    truth_v, truth_e = torch.tensor([1.0, -0.5, -3.0], dtype=F64), 4e4
    with torch.no_grad():
        target = trajectory(truth_v, torch.tensor(math.log(truth_e), dtype=F64))
    assert (target[-1, :, 2].mean() - target[2, :, 2].mean()) > 0.02  # it went up again
    v0 = torch.tensor([0.5, 0.0, -2.4], dtype=F64, requires_grad=True)
    log_young = number(math.log(1.6e4))
    optimizer = torch.optim.LBFGS(
        [v0, log_young], max_iter=25, history_size=8, line_search_fn="strong_wolfe"
    )

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = (trajectory(v0, log_young) - target).square().mean() / DX**2
        value.backward()
        return value

    optimizer.step(loss)
    assert abs(math.exp(log_young.item()) / truth_e - 1.0) < 0.01
    assert float((v0.detach() - truth_v).norm() / truth_v.norm()) < 0.01


# --- errors ---


def test_errors() -> None:
    x = block()
    params = ops.material_params(1e5, 0.3)
    with pytest.raises(ValueError, match="alpha must be given for material that is not elastic"):
        ops.mpm_state(x, torch.zeros_like(x), law=law(1), params=params)
    with pytest.raises(ValueError, match=r"velocity must have shape \[27, 3\]"):
        ops.mpm_state(x, torch.zeros(5, 3, dtype=F64), law=law(0), params=params)
    state = ops.mpm_state(x, torch.zeros_like(x), law=law(0), params=params)
    with pytest.raises(ValueError, match="steps must be >= 0, got -1"):
        ops.rollout(state, -1, **common(x, params, law(0), 1e-3))
    with pytest.raises(ValueError, match="checkpoint_every must be >= 0, got -2"):
        ops.rollout(state, 3, checkpoint_every=-2, **common(x, params, law(0), 1e-3))
    with pytest.raises(ValueError, match=r"numbers or have one length, got \[2\], \[3\]"):
        ops.material_params(torch.ones(2), torch.ones(3))
