"""The rasterizer as a PyTorch operator: gradcheck, opcheck, compile, errors, CPU/CUDA parity."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from raster_scene import HEIGHT, WIDTH, camera, relative_error, render, scene
from torch import Tensor

from gsfluent.ops import rasterize
from gsfluent.ops.reference import raster as reference


def arguments(count: int, dtype: torch.dtype = torch.float32, **changes: Any) -> dict[str, Any]:
    """Keyword arguments of a valid call, changed as asked (None removes)."""
    viewmat, K = camera()
    tensors = {k: v.to(dtype) for k, v in scene(count, degree=1).items()}
    call = tensors | {"viewmat": viewmat, "K": K, "width": WIDTH, "height": HEIGHT} | changes
    return {k: v for k, v in call.items() if v is not None}


@pytest.mark.parametrize("op", [rasterize, reference.rasterize], ids=["kernels", "reference"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck(antialiased: bool, op: Any) -> None:
    inputs = scene(8, degree=2)
    # Large soft splats: no pixel sits on a threshold within the step of the finite differences.
    inputs["opacities"] = 0.2 + 0.5 * inputs["opacities"]
    inputs["scales"] = 2.0 + inputs["scales"]
    leaves = [v.requires_grad_() for v in inputs.values()]

    def call(*values: Tensor) -> tuple[Tensor, ...]:
        named = dict(zip(inputs, values, strict=True))
        return tuple(render(op, named, antialiased=antialiased)[:4])

    assert torch.autograd.gradcheck(call, leaves, fast_mode=True)


def raw_arguments(count: int, requires_grad: bool) -> tuple[Any, ...]:
    a = arguments(count)
    groups = torch.arange(count, dtype=torch.int32) % 5 - 1
    tensors = [
        *(a[k] for k in ("means", "opacities", "viewmat", "K", "quats", "scales")),
        None,
        a["sh"],
        None,
        *(a[k] for k in ("background", "normals")),
        groups,
        a["means2d_offset"],
        torch.zeros(count, 2),
    ]
    tensors[2], tensors[3] = tensors[2].float(), tensors[3].float()
    for k in (0, 1, 4, 5, 7, 9, 10, 12, 13):
        tensors[k] = tensors[k].requires_grad_(requires_grad)
    return (*tensors, WIDTH, HEIGHT, True, True, True, True, 0.01, 1e6)


@pytest.mark.parametrize("requires_grad", [False, True])
def test_opcheck(requires_grad: bool) -> None:
    torch.library.opcheck(torch.ops.gsfluent.rasterize.default, raw_arguments(12, requires_grad))


def test_compiled_equals_eager() -> None:
    a = arguments(30)

    def image(means: Tensor) -> Tensor:
        return rasterize(**(a | {"means": means})).image * 2

    def gradient(function: Any) -> tuple[Tensor, Tensor]:
        means = a["means"].clone().requires_grad_()
        out = function(means)
        out.square().sum().backward()
        return out.detach(), means.grad

    # The number of tile instances is only known at run time.
    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
        compiled = torch.compile(image, backend="aot_eager", fullgraph=True)
        result = gradient(compiled)
    for value, expected in zip(result, gradient(image), strict=True):
        assert torch.equal(value, expected)


ERRORS: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "list": ({"means": [1.0]}, TypeError, "means must be a torch.Tensor, got list"),
    "half": ({"means": torch.zeros(5, 3).half()}, TypeError, "means must be float32 or float64"),
    "means shape": ({"means": torch.zeros(5, 2)}, ValueError, "means must have shape [N, 3]"),
    "row count": (
        {"opacities": torch.zeros(4)},
        ValueError,
        "opacities must have shape [5], got [4]",
    ),
    "mixed dtype": ({"quats": torch.zeros(5, 4).double()}, TypeError, "quats must be float32"),
    "no scales": ({"scales": None}, ValueError, "scales must be given, got None"),
    "both forms": ({"covars": torch.zeros(5, 6)}, ValueError, "covars replaces quats and scales"),
    "no colour": ({"sh": None}, ValueError, "exactly one of sh and colors must be given"),
    "two colours": ({"colors": torch.zeros(5, 3)}, ValueError, "got both"),
    "sh count": ({"sh": torch.zeros(5, 5, 3)}, ValueError, "sh must hold 1, 4, 9 or 16"),
    "channels": (
        {"sh": None, "colors": torch.zeros(5, 33)},
        ValueError,
        "colors must have 1 to 32 channels, got [5, 33]",
    ),
    "background": ({"background": torch.zeros(4)}, ValueError, "background must have shape [3]"),
    "groups dtype": ({"groups": torch.zeros(5).long()}, TypeError, "groups must be int32"),
    "width": ({"width": 0}, ValueError, "width must lie in 1..65536, got 0"),
    "height": ({"height": -3}, ValueError, "height must lie in 1..65536, got -3"),
    "height type": ({"height": 3.5}, TypeError, "height must be an int, got float"),
    "viewmat": ({"viewmat": torch.eye(3)}, ValueError, "viewmat must have shape [4, 4]"),
    "near": ({"near": -1.0}, ValueError, "near and far must satisfy 0 < near < far, got -1.0"),
    "camera gradient": (
        {"viewmat": torch.eye(4).requires_grad_()},
        NotImplementedError,
        "no gradient with respect to viewmat",
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_wrong_arguments_are_named(name: str) -> None:
    changes, kind, message = ERRORS[name]
    with pytest.raises(kind, match=re.escape("rasterize: ") + ".*" + re.escape(message)):
        rasterize(**arguments(5, **changes))


def test_the_operator_itself_refuses_wrong_shapes() -> None:
    raw = list(raw_arguments(5, False))
    raw[1] = torch.zeros(3)
    with pytest.raises(RuntimeError, match=r"opacities must have shape \[5\], got \[3\]"):
        torch.ops.gsfluent.rasterize(*raw)


@pytest.mark.parametrize("change", ["shorter", "splat", "camera", "order", "ranges", "boxes"])
def test_the_adjoint_survives_state_of_another_call(change: str) -> None:
    raw = list(raw_arguments(12, False))
    for k in (2, 3, 12, 13):
        raw[k] = torch.stack([raw[k], raw[k]])  # two cameras
    out = [t.clone() for t in torch.ops.gsfluent.rasterize(*raw)]
    splats, order, tile_start, instances = out[7:]
    if change == "shorter":
        instances = instances[:-1]
    elif change == "splat":
        instances[3] = 10**6
    elif change == "camera":
        instances[0] = instances[-1]
    elif change == "order":
        order[0] = 10**6
    elif change == "ranges":
        tile_start[2] = 10**6
    else:
        splats[:12] = splats[:12].flip(0)  # other splats: they do not touch these tiles
    state = [out[k] for k in (0, 1, 2, 4)] + [splats, order, tile_start, instances]
    numbers = (WIDTH, HEIGHT, True, True, 0.01, 1e6)
    with pytest.raises(RuntimeError, match="saved state does not belong to these inputs"):
        torch.ops.gsfluent.rasterize_backward(
            torch.ones_like(out[0]), None, None, None, *state, *raw[:14], *numbers
        )


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("antialiased", [False, True])
def test_cuda_equals_cpu(dtype: torch.dtype, grouped: bool, antialiased: bool) -> None:
    inputs = {k: v.to(dtype) for k, v in scene(600).items()}
    groups = torch.arange(600, dtype=torch.int32) % 40 - 1 if grouped else None
    values, grads = [], []
    for device in ("cpu", "cuda"):
        leaves = {k: v.to(device).detach().requires_grad_() for k, v in inputs.items()}
        options = {} if groups is None else {"groups": groups.to(device)}
        out = render(rasterize, leaves, contribution=True, antialiased=antialiased, **options)
        (out.image.square().sum() + out.alpha.sum() + out.depth.sum() + out.normal.sum()).backward()
        values.append([t.detach().cpu() for t in out if t is not None])
        grads.append([v.grad.cpu() for v in leaves.values()])
    value_bar, gradient_bar = (2e-4, 1e-3) if dtype == torch.float32 else (1e-10, 1e-9)
    for cpu, cuda in zip(*values, strict=True):
        assert relative_error(cuda, cpu) < value_bar
    for cpu, cuda in zip(*grads, strict=True):
        assert relative_error(cuda, cpu) < gradient_bar


@pytest.mark.cuda
def test_cuda_handles_no_gaussians_and_many_channels() -> None:
    for count in (0, 50):
        g = torch.Generator().manual_seed(1)
        colors = torch.rand(count, 32, generator=g)
        a = arguments(count, sh=None, background=None, colors=colors)
        moved = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in a.items()}
        cpu, cuda = rasterize(**a).image, rasterize(**moved).image.cpu()
        torch.testing.assert_close(cuda, cpu, atol=2e-4, rtol=0)
