"""The rasterizer against its reference: values and gradients, float32 and float64."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scene import relative_error, render, scene
from torch import Tensor

from gsfluent.ops import rasterize
from gsfluent.ops.reference import raster as reference

# float64 differs by rounding; float32 by the projection's rounding (1e-5 of the largest value).
FORWARD = {torch.float64: 1e-12, torch.float32: 1e-5}
BACKWARD = {torch.float64: 1e-11, torch.float32: 1e-4}
OUTPUTS = ("image", "alpha", "depth", "normal")


def variants() -> dict[str, tuple[dict[str, Tensor], dict[str, Any]]]:
    """Name -> (inputs, options)."""
    full = scene(48)
    plain = {k: full[k] for k in ("means", "opacities", "quats", "scales")}
    g = torch.Generator().manual_seed(5)

    def features(channels: int) -> Tensor:
        return torch.rand(48, channels, generator=g, dtype=torch.float64)

    covariance = reference.world_covariances(full["quats"], full["scales"], None)
    covars = torch.stack(
        [covariance[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], -1
    )
    groups = torch.randint(-1, 12, (48,), generator=g, dtype=torch.int32)
    small = plain | {"scales": full["scales"] * 0.05, "colors": features(3)}
    return {
        "full": (full, {}),
        "antialiased": (small, {"antialiased": True}),
        "groups": (full, {"groups": groups}),
        "sh0": (plain | {"sh": full["sh"][:, :1]}, {}),
        "sh1": (plain | {"sh": full["sh"][:, :4]}, {}),
        "sh2": (plain | {"sh": full["sh"][:, :9]}, {}),
        "one channel": (plain | {"colors": features(1)}, {}),
        "32 channels": (plain | {"colors": features(32), "normals": full["normals"]}, {}),
        "covars": (
            {"means": full["means"], "opacities": full["opacities"], "covars": covars}
            | {"colors": features(3)},
            {"antialiased": True},
        ),
        "near cut": (full, {"near": 2.8, "far": 3.5}),
        "single": ({k: v if k == "background" else v[:1] for k, v in full.items()}, {}),
    }


VARIANTS = variants()


def cast(inputs: dict[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    return {k: v.detach().to(dtype).requires_grad_() for k, v in inputs.items()}


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("dtype", FORWARD, ids=str)
def test_forward_and_gradients_equal_reference(name: str, dtype: torch.dtype) -> None:
    inputs, options = VARIANTS[name]
    ours, theirs = cast(inputs, dtype), cast(inputs, torch.float64)
    result = render(rasterize, ours, contribution=True, **options)
    expected = render(reference.rasterize, theirs, **options)
    g = torch.Generator().manual_seed(7)
    loss, expected_loss = torch.zeros((), dtype=dtype), torch.zeros((), dtype=torch.float64)
    for output, value, want in zip(OUTPUTS, result[:4], expected[:4], strict=True):
        if want is None:
            assert value is None
            continue
        # Depth is divided by alpha, which float32 resolves to 3e-8 of 1.
        slack = 2 if output == "depth" else 1
        assert relative_error(value.detach(), want.detach()) < slack * FORWARD[dtype], output
        weight = torch.randn(want.shape, generator=g, dtype=torch.float64)
        loss = loss + (value * weight.to(dtype)).sum()
        expected_loss = expected_loss + (want * weight).sum()
    assert relative_error(result.contribution, expected[4]) < FORWARD[dtype]
    loss.backward()
    expected_loss.backward()
    for key, value in ours.items():
        assert relative_error(value.grad, theirs[key].grad) < BACKWARD[dtype], key


@pytest.mark.parametrize("output", OUTPUTS)
def test_gradient_of_each_output_alone_equals_reference(output: str) -> None:
    inputs = scene(60)
    ours, theirs = cast(inputs, torch.float32), cast(inputs, torch.float64)
    index = OUTPUTS.index(output)
    value, want = render(rasterize, ours)[index], render(reference.rasterize, theirs)[index]
    weight = torch.randn(want.shape, dtype=torch.float64)
    (value * weight.float()).sum().backward()
    (want * weight).sum().backward()
    for key in ("means", "opacities", "quats", "scales", "means2d_offset"):
        assert relative_error(ours[key].grad, theirs[key].grad) < BACKWARD[torch.float32], key
