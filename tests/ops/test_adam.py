"""adam_step against torch.optim.Adam and its definition, what it leaves out, and its errors."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import adam as reference

DTYPES = (torch.float32, torch.float64)
ULPS = {torch.float32: 4e-6, torch.float64: 1e-14}
SHAPES = ((37, 3), (37,), (37, 15, 3), (37, 1, 3))


def state(dtype: torch.dtype) -> list[list[Tensor]]:
    """Parameters, gradients, first and second moments."""
    make = [[torch.randn(s, dtype=dtype) for s in SHAPES] for _ in range(3)]
    return [*make, [torch.rand(s, dtype=dtype) for s in SHAPES]]


@pytest.mark.parametrize("dtype", DTYPES)
def test_equals_torch_over_many_steps(dtype: torch.dtype) -> None:
    ours = [torch.randn(s, dtype=dtype) for s in SHAPES]
    theirs = [p.clone().requires_grad_() for p in ours]
    rates = [1e-2, 3e-3, 5e-4, 0.0]
    betas, eps = (0.9, 0.99), 1e-15
    optimizer = torch.optim.Adam(
        [{"params": [p], "lr": rate} for p, rate in zip(theirs, rates, strict=True)],
        betas=betas,
        eps=eps,
    )
    first, second = ([torch.zeros_like(p) for p in ours] for _ in range(2))
    for step in range(1, 41):
        gradients = [torch.randn_like(p) * 10.0 ** (step % 5 - 2) for p in ours]
        for p, g in zip(theirs, gradients, strict=True):
            p.grad = g.clone()
        optimizer.step()
        ops.adam_step(ours, gradients, first, second, lr=rates, step=step, betas=betas, eps=eps)
    for i, (p, q) in enumerate(zip(ours, theirs, strict=True)):
        kept = optimizer.state[q]
        assert float((p - q.detach()).abs().max()) < ULPS[dtype]
        assert torch.allclose(first[i], kept["exp_avg"], rtol=ULPS[dtype], atol=ULPS[dtype])
        assert torch.allclose(second[i], kept["exp_avg_sq"], rtol=ULPS[dtype], atol=0.0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["bool", "radii"])
def test_rows_left_out_are_untouched_and_others_do_not_notice(
    dtype: torch.dtype, kind: str
) -> None:
    p, g, m, v = state(dtype)
    visible = torch.rand(37) > 0.4
    bad = torch.tensor([3, 11, 36])
    g[0][bad, 1] = float("nan")
    g[2][bad[:2], 4, 2] = float("inf")
    before = [[t.clone() for t in group] for group in (p, m, v)]
    everything = [[t.clone() for t in group] for group in (p, m, v)]
    mark = visible if kind == "bool" else torch.where(visible, 7, -torch.randint(0, 2, (37,))).int()
    arguments: dict[str, Any] = {"lr": 0.01, "step": 3}
    ops.adam_step(p, g, m, v, visible=mark, **arguments)
    ops.adam_step(everything[0], g, everything[1], everything[2], **arguments)
    for i, gradient in enumerate(g):
        part = visible & gradient.reshape(37, -1).isfinite().all(1)
        assert 0 < int(part.sum()) < 37
        want = reference.adam_step(
            *(t.double() for t in (before[0][i], gradient, before[1][i], before[2][i])),
            visible=visible,
            **arguments,
        )
        for k, group in enumerate((p, m, v)):
            assert torch.equal(group[i][~part], before[k][i][~part])
            assert not torch.equal(group[i][part], before[k][i][part])
            # a row's bits do not depend on which other rows take part
            assert torch.equal(group[i][part], everything[k][i][part])
            assert float((group[i].double() - want[k]).abs().max()) < ULPS[dtype]


def test_any_number_of_threads_gives_the_same_bits() -> None:
    count = 30011
    p, g, m = torch.randn(3, count, 7)
    v = torch.rand(count, 7)
    g[torch.randperm(count)[:300], 2] = float("nan")
    visible = torch.rand(count) > 0.2
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            t = [x.clone() for x in (p, m, v)]
            ops.adam_step([t[0]], [g], [t[1]], [t[2]], lr=0.1, step=2, visible=visible)
            results.append(t)
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_first_step_moves_by_the_rate() -> None:
    # m / (1 - beta1) = g and v / (1 - beta2) = g^2: the step is lr sign(g) whatever the size of g
    p, m, v = torch.zeros(3, 5, 2, dtype=torch.float64)
    g = torch.tensor([1e-6, -1e-3, 1.0, -7.0, 1e5], dtype=torch.float64)[:, None].expand(5, 2)
    ops.adam_step([p], [g], [m], [v], lr=0.25, step=1, eps=0.0)
    assert float((p + 0.25 * g.sign()).abs().max()) < 1e-15


def test_nothing_to_do_is_fine() -> None:
    empty = torch.zeros(0, 3)
    ops.adam_step([empty], [empty.clone()], [empty.clone()], [empty.clone()], lr=0.1, step=1)
    seen = torch.zeros(0, dtype=torch.bool)
    ops.adam_step(
        [empty], [empty.clone()], [empty.clone()], [empty.clone()], lr=0.1, step=1, visible=seen
    )
    ops.adam_step([], [], [], [], lr=0.1, step=1)
    flat = torch.zeros(4, 0)
    ops.adam_step([flat], [flat.clone()], [flat.clone()], [flat.clone()], lr=0.1, step=1)
    p = torch.ones(4, 3)
    ops.adam_step([p], [None], [torch.zeros(4, 3)], [torch.zeros(4, 3)], lr=0.1, step=1)
    assert torch.equal(p, torch.ones(4, 3))


def test_many_tensors_in_one_call() -> None:
    groups = [[torch.randn(6, 2) for _ in range(19)] for _ in range(3)]
    second = [torch.rand(6, 2) for _ in range(19)]
    want = [
        reference.adam_step(p, g, m, v, lr=0.01 * i, step=4)[0]
        for i, (p, g, m, v) in enumerate(zip(*groups, second, strict=True))
    ]
    ops.adam_step(*groups, second, lr=[0.01 * i for i in range(19)], step=4)
    for p, q in zip(groups[0], want, strict=True):
        assert float((p - q).abs().max()) < 1e-6


def test_changing_a_saved_value_is_noticed_and_leaves_may_be_changed() -> None:
    leaf = torch.randn(4, 3, requires_grad=True)
    value = leaf.square().sum()
    zeros = [[torch.zeros(4, 3)] for _ in range(2)]
    ops.adam_step([leaf], [torch.ones(4, 3)], *zeros, lr=0.1, step=1)
    assert leaf.is_leaf and leaf.requires_grad
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        value.backward()


def test_registration() -> None:
    p, g, m, v = state(torch.float32)
    visible = torch.ones(37, dtype=torch.int32)
    torch.library.opcheck(
        torch.ops.gsfluent.adam_step.default,
        (p, g, m, v, [0.1] * 4, 0.9, 0.999, 1e-8, 1, visible),
    )


def test_errors_name_the_argument() -> None:
    p, g, m, v = state(torch.float32)
    step: Any = ops.adam_step

    def call(**changed: Any) -> None:
        given: dict[str, Any] = {"lr": 0.1, "step": 1, "g": g, "m": m, "p": p} | changed
        step(given.pop("p"), given.pop("g"), given.pop("m"), v, **given)

    kept = [t.clone() for t in p]
    with pytest.raises(ValueError, match="equally many, got 4, 3, 4, 4, 4"):
        call(g=g[:3])
    with pytest.raises(ValueError, match="equally many, got 4, 4, 4, 4, 2"):
        call(lr=[0.1, 0.2])
    with pytest.raises(TypeError, match=r"gradients\[1\] must be a torch.Tensor, got float"):
        call(g=[g[0], 0.5, *g[2:]])
    with pytest.raises(ValueError, match=r"gradients\[0\] must have shape .*, got \[36, 3\]"):
        call(g=[g[0][:36], *g[1:]])
    with pytest.raises(TypeError, match=r"exp_avg\[2\] must be float32"):
        call(m=[m[0], m[1], m[2].double(), m[3]])
    with pytest.raises(ValueError, match=r"parameters\[0\] must be contiguous"):
        call(p=[torch.randn(3, 37).T, *p[1:]])
    with pytest.raises(ValueError, match="at least one axis"):
        scalar = [torch.tensor(1.0)]
        step(scalar, scalar, scalar, scalar, lr=0.1, step=1)
    with pytest.raises(ValueError, match=r"visible must have shape \[37\]"):
        call(visible=torch.ones(36, dtype=torch.bool))
    with pytest.raises(TypeError, match="visible must be bool or int32, got float32"):
        call(visible=torch.ones(37))
    with pytest.raises(ValueError, match="lr must be finite"):
        call(lr=float("nan"))
    with pytest.raises(ValueError, match="betas must be"):
        call(betas=(0.9, 1.0))
    with pytest.raises(ValueError, match="eps must be"):
        call(eps=-1.0)
    with pytest.raises(ValueError, match="step must be at least 1"):
        call(step=0)
    with pytest.raises(TypeError, match="step must be an int"):
        call(step=1.0)
    assert all(torch.equal(a, b) for a, b in zip(kept, p, strict=True))
