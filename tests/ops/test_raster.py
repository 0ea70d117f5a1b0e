"""The rasterizer against its reference on every device: values, gradients, hard scenes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scene import HARD, hard_scene, relative_error, render, scene
from torch import Tensor

from gsfluent.ops import rasterize
from gsfluent.ops.reference import raster as reference

# Largest error of a value and of a gradient, over the largest value: float64 differs by rounding,
# float32 by the projection's rounding; a GPU divides and takes roots to 2 ulp.
BARS = {
    ("cpu", torch.float64): (1e-12, 1e-11),
    ("cpu", torch.float32): (1e-5, 1e-4),
    ("cuda", torch.float64): (1e-10, 1e-9),
    ("cuda", torch.float32): (2e-4, 1e-3),
}
DEVICES = [
    pytest.param(device, dtype, id=f"{device}-{str(dtype)[6:]}", marks=marks)
    for device, marks in (("cpu", ()), ("cuda", pytest.mark.cuda))
    for dtype in (torch.float64, torch.float32)
]
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
        "no normals": (plain | {"sh": full["sh"], "background": full["background"]}, {}),
        "five channels": (plain | {"colors": features(5), "background": features(5)[0]}, {}),
        "six features": (plain | {"colors": features(2), "normals": full["normals"]}, {}),
        "light": (full | {"normals": torch.cat([full["normals"], features(3)], 1)}, {}),
        "much beside": (full | {"normals": torch.cat([full["normals"], features(29)], 1)}, {}),
        "light, groups": (
            full | {"normals": torch.cat([full["normals"], features(3)], 1)},
            {"groups": groups},
        ),
        "single": ({k: v if k == "background" else v[:1] for k, v in full.items()}, {}),
    }


VARIANTS = variants()


def cast(inputs: dict[str, Tensor], dtype: torch.dtype, device: str = "cpu") -> dict[str, Tensor]:
    return {k: v.detach().to(device, dtype).requires_grad_() for k, v in inputs.items()}


def compare(
    inputs: dict[str, Tensor], options: dict[str, Any], device: str, dtype: torch.dtype
) -> tuple[float, float]:
    """Largest relative error of the outputs and of the gradients of a weighted sum of them."""
    ours, theirs = cast(inputs, dtype, device), cast(inputs, torch.float64)
    moved = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in options.items()}
    result = render(rasterize, ours, contribution=True, **moved)
    expected = render(reference.rasterize, theirs, **options)
    g = torch.Generator().manual_seed(7)
    loss = torch.zeros((), dtype=dtype, device=device)
    expected_loss = torch.zeros((), dtype=torch.float64)
    errors = [relative_error(result.contribution.cpu(), expected[4])]
    for output, value, want in zip(OUTPUTS, result[:4], expected[:4], strict=True):
        if want is None:
            assert value is None
            continue
        # Depth is divided by alpha, which float32 resolves to 3e-8 of 1.
        slack = 2 if output == "depth" else 1
        errors.append(relative_error(value.detach().cpu(), want.detach()) / slack)
        weight = torch.randn(want.shape, generator=g, dtype=torch.float64)
        loss = loss + (value * weight.to(device, dtype)).sum()
        expected_loss = expected_loss + (want * weight).sum()
    loss.backward()
    expected_loss.backward()
    gradients = [relative_error(v.grad.cpu(), theirs[k].grad) for k, v in ours.items()]
    return max(errors), max(gradients)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize(("device", "dtype"), DEVICES)
def test_forward_and_gradients_equal_reference(name: str, device: str, dtype: torch.dtype) -> None:
    inputs, options = VARIANTS[name]
    value, gradient = compare(inputs, options, device, dtype)
    assert value < BARS[device, dtype][0] and gradient < BARS[device, dtype][1]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", HARD)
@pytest.mark.parametrize(("device", "dtype"), DEVICES)
def test_hard_scenes_equal_reference(
    kind: str, antialiased: bool, device: str, dtype: torch.dtype
) -> None:
    value, gradient = compare(hard_scene(kind), {"antialiased": antialiased}, device, dtype)
    tight = dtype == torch.float64
    assert value < (1e-9 if tight else 2e-4) and gradient < (1e-8 if tight else 1e-3)


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize(("device", "dtype"), DEVICES)
def test_gradient_of_each_output_alone_equals_reference(
    output: str, device: str, dtype: torch.dtype
) -> None:
    inputs = scene(60)
    ours, theirs = cast(inputs, dtype, device), cast(inputs, torch.float64)
    index = OUTPUTS.index(output)
    value, want = render(rasterize, ours)[index], render(reference.rasterize, theirs)[index]
    weight = torch.randn(want.shape, dtype=torch.float64)
    (value * weight.to(device, dtype)).sum().backward()
    (want * weight).sum().backward()
    for key in ("means", "opacities", "quats", "scales", "means2d_offset"):
        error = relative_error(ours[key].grad.cpu(), theirs[key].grad)
        assert error < BARS[device, dtype][1], key
