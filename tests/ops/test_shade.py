"""The fused shading kernel against its model in plain PyTorch, and what it does with bad input."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from shade_model import shade_image
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops import shade
from gsfluent.pipeline.light.occlusion import Occupancy
from gsfluent.pipeline.light.shadow import ShadowMaps

HEIGHT, WIDTH, TEXELS, NODES = 37, 53, 48, 32
CUDA = pytest.param("cuda", marks=pytest.mark.cuda)


def rand(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cameras() -> Tensor:
    """One map from above and the six faces of a cube around a lamp near the matter, [7, 15]."""
    origin = torch.zeros(3, dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    eye = torch.tensor([10.0, 5.0, 30.0], dtype=torch.float64)
    views = [geometry.look_at(eye, origin, up)]
    lamp = torch.tensor([0.6, -1.2, 1.5], dtype=torch.float64)
    for axis in range(3):
        for sign in (1.0, -1.0):
            ahead = torch.zeros(3, dtype=torch.float64)
            ahead[axis] = sign
            side = torch.roll(ahead.abs(), 1)
            views.append(geometry.look_at(lamp, lamp + ahead, side))
    rows = [torch.cat([v.double()[:3].flatten(), torch.zeros(3).double()]) for v in views]
    packed = torch.stack(rows)
    packed[:, 12] = TEXELS / 2 / 1.15
    packed[0, 12] = TEXELS * 32.0 / 4.0
    packed[:, 13], packed[:, 14] = 0.2, 0.03
    packed[0, 13] = 29.0
    return packed


def scene(gloss: bool) -> dict[str, Any]:
    """A wavy surface, three lamps, random maps with blockers before and behind it, a floor."""
    alpha = rand(HEIGHT, WIDTH, seed=1)
    alpha[:4], alpha[-3:], alpha[:, :2] = 0.0, 0.9995, 5e-5
    normal = 2.0 * rand(HEIGHT, WIDTH, 3, seed=2) - 1.0
    normal[10] = 0.0
    shine = torch.stack([rand(HEIGHT, WIDTH, seed=3), 40.0 * rand(HEIGHT, WIDTH, seed=4)], -1)
    lamps = torch.zeros(3, 12, dtype=torch.float64)
    lamps[0] = torch.tensor([0, 0.31, 0.16, 0.94, 0.9, 0.8, 0.7, 0, 0, 0.05, 0, 1])
    lamps[1] = torch.tensor([1, 0.6, -1.2, 1.5, 0.2, 0.5, 0.9, 1.5, 2, 0.1, 1, 6])
    lamps[2] = torch.tensor([1, -2.0, 0.0, 3.0, 0.4, 0.3, 0.3, 2.0, 0, 0.0, -1, 1])
    lamps[0, 1:4] /= lamps[0, 1:4].norm()
    view = geometry.look_at(
        torch.tensor([0.0, -4.0, 1.5], dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),
    ).double()
    depth = torch.where(alpha > 0, 3.6 + rand(HEIGHT, WIDTH, seed=5), 0.0)
    maps = cameras()
    blockers = 3.0 * rand(7, TEXELS, TEXELS, seed=6)
    blockers[0] += maps[0, 11] - 2.0
    cells = sum((NODES >> level) ** 3 for level in range(5))
    return {
        "image": rand(HEIGHT, WIDTH, 3, seed=7) * alpha[..., None],
        "alpha": alpha,
        "depth": depth,
        "normal": normal if gloss else torch.cat([normal, shine * alpha[..., None]], -1),
        "viewmat": view,
        "K": torch.tensor([[60.0, 0, 27.0], [0, 62.0, 18.0], [0, 0, 1]], dtype=torch.float64),
        "lamps": lamps,
        "environment": 0.6 * rand(9, 3, seed=8) - 0.1,
        "background": torch.tensor([0.9, 0.5, 0.1], dtype=torch.float64),
        "gloss": torch.tensor([0.3, 20.0], dtype=torch.float64) if gloss else None,
        "maps": (blockers, rand(7, TEXELS, TEXELS, seed=9).round() * 0.9, maps),
        "grid": (
            rand(cells, seed=10),
            torch.tensor([-1.2, -1.3, -0.9, 2.5 / NODES], dtype=torch.float64),
            NODES,
        ),
        "occlusion": 0.8,
        "studio": torch.tensor(
            [-0.6, 0.1, 0.0, 6.0, 0.46, 0.46, 0.47, 0.5, 0.5, 0.51, 0.27, 0.28, 0.3],
            dtype=torch.float64,
        ),
    }


def move(value: Any, device: str, dtype: torch.dtype) -> Any:
    if isinstance(value, Tensor):
        return value.to(device, dtype)
    return tuple(move(v, device, dtype) for v in value) if isinstance(value, tuple) else value


def drawn(inputs: dict[str, Any], device: str, dtype: torch.dtype) -> Tensor:
    return shade(**{k: move(v, device, dtype) for k, v in inputs.items()}).cpu().double()


def model(inputs: dict[str, Any]) -> Tensor:
    """The same picture by the model, float64."""
    values = dict(inputs)
    gloss, maps, grid = (values.pop(name) for name in ("gloss", "maps", "grid"))
    vectors = values.pop("normal")
    if gloss is None:
        gloss = vectors[..., 3:5] / values["alpha"][..., None].clamp(min=1e-4)
    return shade_image(
        normal=vectors[..., :3],
        gloss=gloss,
        maps=None if maps is None else ShadowMaps(*maps),
        grid=None if grid is None else Occupancy(*grid),
        **values,
    )


@pytest.mark.parametrize("left_out", ["", "maps", "grid", "studio", "gloss", "lamps"])
@pytest.mark.parametrize(
    ("device", "dtype", "bar"),
    [
        ("cpu", torch.float64, 1e-9),
        ("cpu", torch.float32, 2e-4),
        pytest.param("cuda", torch.float64, 1e-9, marks=pytest.mark.cuda),
        pytest.param("cuda", torch.float32, 4e-4, marks=pytest.mark.cuda),
    ],
)
def test_picture_equals_model(left_out: str, device: str, dtype: torch.dtype, bar: float) -> None:
    inputs = scene(gloss=left_out != "gloss")
    if left_out == "lamps":
        inputs["lamps"] = inputs["lamps"][:0]
    elif left_out not in ("", "gloss"):
        inputs[left_out] = None
    error = (drawn(inputs, device, dtype) - model(inputs)).abs().amax(-1)
    if dtype == torch.float64:
        assert error.max() < bar
    else:
        # a tap beside a blocker's edge may fall on its other side in float32
        assert error.quantile(0.98) < bar and error.max() < 0.05


def test_every_part_is_seen() -> None:
    """What the comparison above leaves out in turn changes the picture: it is in the scene."""
    whole = model(scene(True))
    for name in ("maps", "grid", "studio"):
        assert (whole - model(scene(True) | {name: None})).abs().max() > 0.05
    fewer = scene(True)
    for lamp in range(3):
        rest = [k for k in range(3) if k != lamp]
        other = model(fewer | {"lamps": fewer["lamps"][rest]})
        assert (whole - other).abs().max() > 0.02


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30, -1e30])
def test_bad_numbers_stay_in_their_memory(device: str, bad: float) -> None:
    for name, value in scene(False).items():
        parts = value if isinstance(value, tuple) else (value,)
        for part in range(len(parts)):
            if not isinstance(parts[part], Tensor):
                continue
            inputs = scene(False)
            spoilt = parts[part].clone()
            spoilt.view(-1)[::3] = bad
            fresh = [*parts[:part], spoilt, *parts[part + 1 :]]
            inputs[name] = tuple(fresh) if isinstance(value, tuple) else spoilt
            assert drawn(inputs, device, torch.float32).shape == (HEIGHT, WIDTH, 3)


def test_errors_name_the_argument() -> None:
    good = scene(True)
    with pytest.raises(ValueError, match="lamps must have shape"):
        shade(**good | {"lamps": torch.zeros(2, 5, dtype=torch.float64)})
    with pytest.raises(ValueError, match="normal must have 5 columns"):
        shade(**good | {"gloss": None})
    with pytest.raises(ValueError, match="occlusion must be in"):
        shade(**good | {"occlusion": float("nan")})
    with pytest.raises(RuntimeError, match="nodes must be a multiple of 16"):
        shade(**good | {"grid": (*good["grid"][:2], 8)})
    with pytest.raises(RuntimeError, match="occupancy must have shape"):
        shade(**good | {"grid": (*good["grid"][:2], 64)})
    with pytest.raises(TypeError, match="depth"):
        shade(**good | {"depth": good["depth"].float()})


def test_empty_picture_and_registration() -> None:
    good = scene(True)
    empty = {"image": torch.zeros(0, 5, 3), "alpha": torch.zeros(0, 5), "depth": torch.zeros(0, 5)}
    rest = {k: move(v, "cpu", torch.float32) for k, v in good.items()}
    assert shade(**rest | empty | {"normal": torch.zeros(0, 5, 3)}).shape == (0, 5, 3)
    torch.library.opcheck(
        torch.ops.gsfluent.shade.default,
        (
            *(good[k] for k in ("image", "alpha", "depth", "normal", "gloss", "viewmat", "K")),
            *(good[k] for k in ("lamps", "environment", "background")),
            *good["maps"],
            *good["grid"],
            0.5,
            good["studio"],
        ),
        test_utils=("test_schema", "test_faketensor"),
    )
