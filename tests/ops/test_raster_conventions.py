"""The same picture as gsplat: its published formulas, written out here, against our kernels.

The formulas are those of the ecosystem's 3D Gaussian splatting (Kerbl et al. 2023, gsplat's
"classic" mode): EWA projection with 0.3 px^2 added, alpha = min(0.99, o exp(-power)), contributions
below 1/255 skipped, a pixel closed before its transmittance reaches 1e-4, colours from spherical
harmonics + 0.5. Every splat is evaluated at every pixel: no radius, no tiles, so that a wrong
extent or tile list shows. Nothing here is shared with gsfluent's own reference.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gsfluent.ops import rasterize

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
BAR = 50.0  # dB of the difference, peak 1


def colors_of(sh: Tensor, direction: Tensor) -> Tensor:
    """INRIA's spherical harmonics up to degree 3 of [N, 16, 3], clamped at zero."""
    x, y, z = direction.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    weights = [
        torch.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    ]
    basis = torch.stack(weights[: sh.shape[1]], 1)
    return ((basis[..., None] * sh).sum(1) + 0.5).clamp_min(0.0)


def published(splats: dict[str, Tensor], viewmat: Tensor, K: Tensor, size: int) -> Tensor:
    """The picture [size, size, 3] before black, in float64."""
    s = {k: v.double() for k, v in splats.items()}
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    p = s["means"] @ R.T + t
    front = p[:, 2] > 0.01
    s, p = {k: v[front] for k, v in s.items()}, p[front]
    w, x, y, z = (s["quats"] / s["quats"].norm(dim=1, keepdim=True)).unbind(1)
    entries = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    entries += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    entries += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    M = torch.stack(entries, 1).reshape(-1, 3, 3) * s["scales"][:, None, :]
    sigma = R @ (M @ M.mT) @ R.T
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * size / fx, 0.3 * 0.5 * size / fy
    tx = p[:, 2] * (p[:, 0] / p[:, 2]).clamp(-cx / fx - margin_x, (size - cx) / fx + margin_x)
    ty = p[:, 2] * (p[:, 1] / p[:, 2]).clamp(-cy / fy - margin_y, (size - cy) / fy + margin_y)
    J = torch.zeros(len(p), 2, 3, dtype=torch.float64)
    J[:, 0, 0], J[:, 0, 2] = fx / p[:, 2], -fx * tx / p[:, 2] ** 2
    J[:, 1, 1], J[:, 1, 2] = fy / p[:, 2], -fy * ty / p[:, 2] ** 2
    conic = torch.linalg.inv(J @ sigma @ J.mT + 0.3 * torch.eye(2, dtype=torch.float64))
    mean2d = torch.stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy], 1)
    view = s["means"] + R.T @ t
    color = colors_of(s["sh"], view / view.norm(dim=1, keepdim=True))

    grid = torch.arange(size, dtype=torch.float64) + 0.5
    pixels = torch.stack(torch.meshgrid(grid, grid, indexing="xy"), -1).reshape(-1, 2)
    image = torch.zeros(size * size, 3, dtype=torch.float64)
    transmittance = torch.ones(size * size, dtype=torch.float64)
    is_open = torch.ones(size * size, dtype=torch.bool)
    for block in torch.argsort(p[:, 2].float(), stable=True).split(64):
        d = pixels[:, None] - mean2d[block]
        form = 0.5 * (conic[block, 0, 0] * d[..., 0] ** 2 + conic[block, 1, 1] * d[..., 1] ** 2)
        power = form + conic[block, 0, 1] * d[..., 0] * d[..., 1]
        alphas = (s["opacities"][block] * torch.exp(-power)).clamp_max(0.99)
        for alpha, rgb in zip(alphas.unbind(1), color[block], strict=True):
            counts = is_open & (alpha >= 1 / 255)
            left = transmittance * (1 - alpha)
            is_open = is_open & ~(counts & (left <= 1e-4))
            counts = counts & is_open
            image += torch.where(counts, alpha * transmittance, 0.0)[:, None] * rgb
            transmittance = torch.where(counts, left, transmittance)
    return image.reshape(size, size, 3)


def camera(size: int, distance: float) -> tuple[Tensor, Tensor]:
    """Looking at the origin along +z from `distance`, turned a little; vertical fov 50 degrees."""
    angle = torch.tensor([0.3, 0.2], dtype=torch.float64)
    (ca, cb), (sa, sb) = angle.cos().tolist(), angle.sin().tolist()
    yaw = torch.tensor([[ca, 0, sa], [0, 1, 0], [-sa, 0, ca]], dtype=torch.float64)
    pitch = torch.tensor([[1, 0, 0], [0, cb, -sb], [0, sb, cb]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = pitch @ yaw
    viewmat[2, 3] = distance
    focal = 0.5 * size / math.tan(math.radians(25.0))
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    return viewmat, K


def difference(splats: dict[str, Tensor], size: int, distance: float, device: str) -> float:
    """PSNR [dB] of our picture against the formulas."""
    viewmat, K = camera(size, distance)
    moved = {k: v.float().to(device) for k, v in splats.items()}
    ours = rasterize(viewmat=viewmat, K=K, width=size, height=size, depth=False, **moved)
    want = published(splats, viewmat, K, size)
    assert want.amax() > 0.5  # something is in the picture
    error = (ours.image.double().cpu() - want).square().mean()
    return float(-10 * torch.log10(error))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("count", "distance"), [(400, 4.0), (1200, 4.0), (800, 0.5)])
def test_random_scenes_equal_the_published_formulas(
    count: int, distance: float, device: str
) -> None:
    """Sizes follow the spacing; at distance 0.5 the camera stands inside the cloud."""
    g = torch.Generator().manual_seed(count)
    spacing = 0.7 * (8 / count) ** (1 / 3)
    sh = 0.1 * torch.randn(count, 16, 3, generator=g)
    sh[:, 0] = 3 * torch.rand(count, 3, generator=g) - 1.5
    splats = {
        "means": 2 * torch.rand(count, 3, generator=g) - 1,
        "scales": spacing * (0.4 * torch.randn(count, 3, generator=g)).exp(),
        "quats": torch.randn(count, 4, generator=g),
        "opacities": torch.sigmoid(1.5 * torch.randn(count, generator=g)),
        "sh": sh,
    }
    assert difference(splats, 64, distance, device) >= BAR


@pytest.mark.data
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "name",
    ["playbot/playbot_robot_lod1_sh3.ply", "plush_dog/point_cloud_29999_clean.ply"],
)
def test_real_splats_equal_the_published_formulas(name: str, device: str, data_root: Path) -> None:
    """Every sixteenth splat, scaled to the unit ball."""
    from gsfluent.io.splats.load import load_splats

    path = data_root / "splats" / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    full = load_splats(path)
    centre = full.means.median(0).values
    scale = 1 / float((full.means - centre).norm(dim=1).quantile(0.98))
    some = full.select(torch.arange(0, len(full), 16))
    splats = {
        "means": (some.means - centre) * scale,
        "scales": some.scales * scale * 16 ** (1 / 3),  # as dense as the whole
        "quats": some.quats,
        "opacities": some.opacities,
        "sh": some.sh,
    }
    assert difference(splats, 72, 2.5, device) >= BAR
