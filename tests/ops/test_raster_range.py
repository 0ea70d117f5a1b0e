"""Any finite input gives finite pictures and gradients; scenes that do not fit are refused."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsfluent.ops import _memory, _raster_grad, rasterize

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
COUNT = 6

finite = st.floats(allow_nan=False, allow_infinity=False, width=32)
# Where it hurts: squares overflow beyond 1.8e19, underflow below 1e-19; the camera's own centre.
edges = st.sampled_from([0.0, 1e-30, -1e-13, 1e-7, 0.01, -1.0, 1e4, 1e18, -2e19, 1e30, 3e38])


@st.composite
def scenes(draw: Any) -> dict[str, Any]:
    """An ordinary scene, any number of whose values are replaced."""
    g = torch.Generator().manual_seed(draw(st.integers(0, 2**16)))
    covariances = draw(st.booleans())
    scene = {
        "means": torch.randn(COUNT, 3, generator=g) + torch.tensor([0.0, 0.0, 2.0]),
        "opacities": torch.rand(COUNT, generator=g),
        "normals": torch.randn(COUNT, 3, generator=g),
        "background": torch.rand(3, generator=g),
        "means2d_offset": torch.zeros(COUNT, 2),
        "sh": torch.randn(COUNT, 9, 3, generator=g),
        "viewmat": torch.eye(4),
        "K": torch.tensor([[20.0, 0, 9], [0, 21.0, 8], [0, 0, 1]]),
    }
    if covariances:
        root = torch.randn(COUNT, 3, 3, generator=g)
        full = (root @ root.mT).flatten(1)
        scene["covars"] = full[:, [0, 4, 8, 1, 2, 5]].contiguous()
    else:
        scene["quats"] = torch.randn(COUNT, 4, generator=g)
        scene["scales"] = torch.rand(COUNT, 3, generator=g)
    if draw(st.booleans()):
        del scene["sh"]
        scene["colors"] = torch.rand(COUNT, 3, generator=g)
    for _ in range(draw(st.integers(1, 8))):
        values = scene[draw(st.sampled_from(sorted(scene)))].view(-1)
        index = draw(st.integers(0, values.numel() - 1))
        end = draw(st.sampled_from([index + 1, index + 3, values.numel()]))
        values[index:end] = draw(finite | edges)
    options = {"antialiased": draw(st.booleans()), "near": draw(st.sampled_from([1e-6, 0.01]))}
    return scene | options


@pytest.mark.parametrize("device", DEVICES)
@settings(
    max_examples=400, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
@given(scene=scenes())
def test_finite_inputs_give_finite_pictures_and_gradients(
    device: str, scene: dict[str, Any]
) -> None:
    leaves = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in scene.items()}
    inputs = [k for k, v in leaves.items() if isinstance(v, Tensor) and k not in ("viewmat", "K")]
    for name in inputs:
        leaves[name].requires_grad_()
    absolute = torch.zeros(COUNT, 2, device=device, requires_grad=True)
    options = {"means2d_absgrad": absolute, "median_depth": True}
    out = rasterize(width=19, height=17, **leaves, **options)
    for value in out[:4]:
        assert torch.isfinite(value).all()
    (out.image.sum() + out.alpha.sum() + out.depth.sum() + out.normal.sum()).backward()
    for name in inputs:
        assert torch.isfinite(leaves[name].grad).all(), name
    assert torch.isfinite(absolute.grad).all()


def test_a_scene_that_does_not_fit_is_refused_with_the_bytes_it_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_memory, "available_memory", lambda: 25 * 10**8)
    count = 20_000_000

    def rows(*shape: int, grad: bool = False) -> Tensor:
        """As large as asked for, in the memory of one row."""
        return torch.zeros(1, *shape).expand(count, *shape).requires_grad_(grad)

    def call(width: int = 800, grad: bool = True) -> None:
        rasterize(
            rows(3, grad=grad),
            rows(),
            torch.eye(4),
            torch.eye(3),
            width,
            800,
            quats=rows(4, grad=grad),
            scales=rows(3, grad=grad),
            sh=rows(16, 3, grad=grad),
        )

    with pytest.raises(MemoryError, match="20000000 Gaussians in 1 images of 800 x 800") as error:
        call()
    # the gradients alone: 58 numbers each
    need = int(re.search(r"at least (\d+) bytes", str(error.value))[1])
    assert need > count * 58 * 4 and "2500000000 bytes are available" in str(error.value)
    with torch.no_grad(), pytest.raises(MemoryError) as without:
        call(width=60_000)
    assert int(re.search(r"at least (\d+) bytes", str(without.value))[1]) < need


def test_gradients_of_too_many_pairs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 3000
    colors = torch.rand(count, 3, requires_grad=True)
    out = rasterize(
        torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3),
        torch.full((count,), 0.9),
        torch.eye(4),
        torch.tensor([[900.0, 0, 900], [0, 900.0, 900], [0, 0, 1]]),
        1800,
        1800,
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        scales=torch.full((count, 3), 10.0),  # every splat on every tile
        colors=colors,
    )
    pairs = count * 113**2
    monkeypatch.setattr(_memory, "available_memory", lambda: 10**9)
    with pytest.raises(MemoryError, match=f"{pairs} .splat, tile. pairs need"):
        out.image.sum().backward()


def test_an_allocation_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_memory, "available_memory", lambda: None)
    with pytest.raises(MemoryError, match="3 Gaussians in 1 images of 65536 x 65536 px need"):
        rasterize(
            torch.zeros(3, 3),
            torch.zeros(3),
            torch.eye(4),
            torch.eye(3),
            65536,
            65536,
            quats=torch.zeros(3, 4),
            scales=torch.zeros(3, 3),
            colors=torch.zeros(3, 32),  # half a terabyte of image
        )


def test_gradients_that_cannot_be_allocated_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The operator's allocator fails in the adjoint as it does above in the forward pass."""
    means = torch.rand(3, 3, requires_grad=True)
    camera, size = (torch.eye(4), torch.eye(3)), 8
    shape = {"quats": torch.ones(3, 4), "scales": torch.ones(3, 3), "colors": torch.ones(3, 1)}
    out = rasterize(means, torch.ones(3), *camera, size, size, **shape)

    def fail(*_: object) -> None:
        torch.ops.gsfluent.rasterize(
            *(torch.zeros(1, 3), torch.zeros(1), *camera, torch.zeros(1, 4), torch.zeros(1, 3)),
            *(None, None, torch.zeros(1, 32), None, None, None, None, None),
            *(65536, 65536, False, False, False, False, 0.01, 1e6),
        )

    monkeypatch.setattr(_raster_grad, "backward", fail)
    with pytest.raises(MemoryError, match="gradients of 3 Gaussians need at least 36 bytes"):
        out.image.sum().backward()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("cameras", [None, 2])
def test_no_gaussians_give_empty_gradients(device: str, cameras: int | None) -> None:
    lead = () if cameras is None else (cameras,)
    inputs = {
        "means": torch.zeros(0, 3),
        "opacities": torch.zeros(0),
        "quats": torch.zeros(0, 4),
        "scales": torch.zeros(0, 3),
        "sh": torch.zeros(0, 4, 3),
        "normals": torch.zeros(0, 3),
        "means2d_offset": torch.zeros(*lead, 0, 2),
        "means2d_absgrad": torch.zeros(*lead, 0, 2),
        "background": torch.rand(3),
    }
    leaves = {k: v.to(device).requires_grad_() for k, v in inputs.items()}
    out = rasterize(
        viewmat=torch.eye(4).expand(*lead, 4, 4),
        K=torch.eye(3).expand(*lead, 3, 3),
        width=20,
        height=30,
        contribution=True,
        median_depth=True,
        **leaves,
    )
    assert torch.equal(out.image.cpu(), inputs["background"].expand(*lead, 30, 20, 3))
    for name in ("alpha", "depth", "median_depth", "normal"):
        assert (getattr(out, name) == 0).all(), name
    (out.image.sum() + out.depth.sum()).backward()
    assert leaves["means"].grad.shape == (0, 3)
    pixels = 600.0 * (cameras or 1)
    assert torch.allclose(leaves["background"].grad.cpu(), torch.full((3,), pixels))
