"""The scenes on which gsfluent and gsplat are timed (shared/spec/baselines.md, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

FIELDS = ("means", "quats", "scales", "opacities", "sh")
NEAR, FAR = 0.01, 100.0
_SH_DC = 0.28209479177387814  # Y_0


@dataclass(frozen=True)
class Scene:
    """Gaussians and one camera.

    Attributes:
        name: "nat", "heavy" or "garden".
        inputs: What gets gradients: means [N, 3], unit quats wxyz [N, 4], scales [N, 3],
            opacities [N] in [0, 1], sh of degree 3 [N, 16, 3].
        viewmat: World to camera [4, 4].
        K: Intrinsics [px], [3, 3].
        width: Of the image [px].
        height: Of the image [px].
    """

    name: str
    inputs: dict[str, Tensor]
    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.inputs["means"].shape[0])

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.inputs["means"].device


def random_scene(kind: str, count: int, width: int, height: int, device: torch.device) -> Scene:
    """N Gaussians uniform in [-1, 1]^3, seen from 4 away at a vertical field of view of 50 degrees.

    Scales are log-normal (sigma 0.4 per axis) about ``0.7 (8 / N)^(1/3)`` for ``nat``, whose sizes
    follow the spacing, or about 0.03 for ``heavy``. Opacity ``sigmoid(1.5 N(0, 1))``; SH constant
    part U(-1.5, 1.5), the rest 0.1 N(0, 1). Drawn on the CPU with seed 0: the same on any device.

    Raises:
        ValueError: ``kind`` is neither of the two.
    """
    focal = 0.5 * height / math.tan(math.radians(25.0))
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    inputs = _random_inputs(kind, count, device)
    return Scene(kind, inputs, viewmat.to(device), K.to(device), width, height)


@lru_cache(maxsize=1)  # drawing 4 million takes seconds, and several images show the same
def _random_inputs(kind: str, count: int, device: torch.device) -> dict[str, Tensor]:
    sizes = {"nat": 0.7 * (8.0 / count) ** (1.0 / 3.0), "heavy": 0.03}
    if kind not in sizes:
        raise ValueError(f"scene {kind!r} is not known; choose nat or heavy")
    g = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=g) * 2.0 - 1.0
    quats = torch.randn(count, 4, generator=g)
    scales = sizes[kind] * torch.exp(0.4 * torch.randn(count, 3, generator=g))
    opacities = torch.sigmoid(1.5 * torch.randn(count, generator=g))
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] = torch.rand(count, 3, generator=g) * 3.0 - 1.5
    quats = torch.nn.functional.normalize(quats, dim=-1)
    return _named(device, means, quats, scales, opacities, sh)


def _named(device: torch.device, *tensors: Tensor) -> dict[str, Tensor]:
    return {name: t.to(device) for name, t in zip(FIELDS, tensors, strict=True)}


def garden_scene(path: Path, width: int, height: int, device: torch.device) -> Scene:
    """The points of gsplat's ``assets/test_garden.npz``, cropped to [-2, 2]^3, as its tests do.

    Scales U(1e-4, 0.02), opacities U(0, 1), random rotations; colours become the constant part of
    the SH, the rest 0.1 N(0, 1). First camera, intrinsics rescaled to the image.

    Raises:
        ValueError: The file lacks an array.
    """
    with np.load(path) as data:
        missing = {"means3d", "colors", "viewmats", "Ks", "width", "height"} - set(data.files)
        if missing:
            raise ValueError(f"{path} lacks {', '.join(sorted(missing))}")
        means = torch.from_numpy(data["means3d"]).float()
        colors = torch.from_numpy(data["colors"]).float() / 255.0
        viewmat = torch.from_numpy(data["viewmats"][0]).float()
        K = torch.from_numpy(data["Ks"][0]).float()
        native = (float(data["width"]), float(data["height"]))
    inside = (means.abs() <= 2.0).all(-1)
    means, colors = means[inside], colors[inside]
    count = means.shape[0]
    g = torch.Generator().manual_seed(0)
    scales = torch.rand(count, 3, generator=g) * (0.02 - 1e-4) + 1e-4
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=-1)
    opacities = torch.rand(count, generator=g)
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] = (colors - 0.5) / _SH_DC
    K[0] *= width / native[0]
    K[1] *= height / native[1]
    inputs = _named(device, means, quats, scales, opacities, sh)
    return Scene("garden", inputs, viewmat.to(device), K.to(device), width, height)
