"""Reference rasterizer: one loop over depth-sorted Gaussians, all pixels at once, autograd.

Written from the formulas, not from the kernels; meant for float64 and a few hundred Gaussians.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch import Tensor

SCREEN_BLUR = 0.3
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = float(torch.tensor(0.99))  # in float32, as in the kernels: two of them end a pixel
MIN_TRANSMITTANCE = 1e-4
MAX_POWER = 0.5 * 3.33**2
SIBLING_RING = 8


def sh_basis(degree: int, direction: Tensor) -> Tensor:
    """Real spherical harmonics of unit directions [N, 3] in splatting's order, [N, (d+1)^2]."""
    x, y, z = direction.unbind(-1)
    one = torch.ones_like(x)
    pi = math.pi
    c1 = math.sqrt(3 / (4 * pi))
    basis = [one * math.sqrt(1 / (4 * pi))]
    if degree >= 1:
        basis += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2 = math.sqrt(15 / (4 * pi))
        basis += [
            c2 * x * y,
            -c2 * y * z,
            math.sqrt(5 / (16 * pi)) * (2 * z * z - x * x - y * y),
            -c2 * x * z,
            c2 / 2 * (x * x - y * y),
        ]
    if degree >= 3:
        c3, c4 = math.sqrt(21 / (32 * pi)), math.sqrt(35 / (32 * pi))
        c5 = math.sqrt(105 / (4 * pi))
        basis += [
            -c4 * y * (3 * x * x - y * y),
            c5 * x * y * z,
            -c3 * y * (4 * z * z - x * x - y * y),
            math.sqrt(7 / (16 * pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c3 * x * (4 * z * z - x * x - y * y),
            c5 / 2 * z * (x * x - y * y),
            -c4 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4], normalised here."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def world_covariances(quats: Tensor | None, scales: Tensor | None, covars: Tensor | None) -> Tensor:
    """World covariances [N, 3, 3] from either form."""
    if covars is not None:
        xx, yy, zz, xy, xz, yz = covars.unbind(-1)
        return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)
    if quats is None or scales is None:
        raise ValueError("reference rasterize: pass quats and scales, or covars")
    factor = rotation_matrices(quats) * scales[:, None, :]
    return factor @ factor.transpose(1, 2)


class _PerPixel(torch.autograd.Function):
    """Zeros [N, H, W, 2] in place of [N, 2]; the gradient is the sum of absolute values."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, height: int, width: int) -> Tensor:
        return x.new_zeros(x.shape[0], height, width, 2)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        return grads[0].abs().sum((1, 2)), None, None


def rasterize(
    means: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    quats: Tensor | None = None,
    scales: Tensor | None = None,
    covars: Tensor | None = None,
    sh: Tensor | None = None,
    colors: Tensor | None = None,
    background: Tensor | None = None,
    antialiased: bool = False,
    normals: Tensor | None = None,
    groups: Tensor | None = None,
    means2d_offset: Tensor | None = None,
    means2d_absgrad: Tensor | None = None,
    near: float = 0.01,
    far: float = 1e6,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor]:
    """Image, alpha, depth, normal, contribution, median depth of finite Gaussians.

    See ops.rasterize; every output is computed, whether wanted or not.
    """
    if viewmat.dim() == 3:
        rest: dict[str, Any] = {"quats": quats, "scales": scales, "covars": covars, "sh": sh}
        rest |= {"colors": colors, "antialiased": antialiased, "normals": normals}
        rest |= {"groups": groups, "near": near, "far": far}
        views = []
        for c in range(viewmat.shape[0]):
            own: dict[str, Any] = {"background": background}
            own |= {"means2d_offset": means2d_offset, "means2d_absgrad": means2d_absgrad}
            for name, value in own.items():
                if value is not None and (name != "background" or value.dim() == 2):
                    own[name] = value[c]
            view = rasterize(means, opacities, viewmat[c], K[c], width, height, **own, **rest)
            views.append(view)

        def stacked(k: int) -> Tensor:
            return torch.stack([cast(Tensor, view[k]) for view in views])

        normal = None if normals is None else stacked(3)
        return stacked(0), stacked(1), stacked(2), normal, stacked(4).sum(0), stacked(5)
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = (means @ rotation.T + translation).unbind(-1)
    margin_u, margin_v = 0.15 * width / fx, 0.15 * height / fy
    u = torch.clamp(x / z, -cx / fx - margin_u, (width - cx) / fx + margin_u)
    v = torch.clamp(y / z, -cy / fy - margin_v, (height - cy) / fy + margin_v)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1)
    to_pixels = jacobian.reshape(-1, 2, 3) @ rotation
    sharp = to_pixels @ world_covariances(quats, scales, covars) @ to_pixels.transpose(1, 2)
    blurred = sharp + SCREEN_BLUR * torch.eye(2, dtype=means.dtype)
    conic = torch.linalg.inv(blurred)
    opacity = opacities
    if antialiased:
        ratio = torch.linalg.det(sharp) / torch.linalg.det(blurred)
        opacity = opacity * ratio.clamp(min=0.005**2).sqrt()
    centre = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    if means2d_offset is not None:
        centre = centre + means2d_offset
    if sh is not None:
        degree = math.isqrt(sh.shape[1]) - 1
        direction = means + rotation.T @ translation
        direction = direction / direction.norm(dim=-1, keepdim=True)
        features = (torch.einsum("nk,nkc->nc", sh_basis(degree, direction), sh) + 0.5).clamp(min=0)
    elif colors is not None:
        features = colors
    else:
        raise ValueError("reference rasterize: pass sh or colors")
    channels = features.shape[1]
    features = torch.cat([features, *([normals] if normals is not None else []), z[:, None]], -1)

    spread = None
    if means2d_absgrad is not None:
        spread = _PerPixel.apply(means2d_absgrad, height, width)
    rows = torch.arange(height, dtype=means.dtype) + 0.5
    columns = torch.arange(width, dtype=means.dtype) + 0.5
    left = means.new_ones(height, width)
    stopped = torch.zeros(height, width, dtype=torch.bool)
    ring = torch.full((SIBLING_RING, height, width), -1, dtype=torch.int64)
    blended = means.new_zeros(height, width, features.shape[1])
    contribution = means.new_zeros(means.shape[0])
    median = means.new_zeros(height, width)
    # Depths are compared in float32, like the kernels' sort keys; equal ones keep their order.
    for i in torch.sort(z.detach().float(), stable=True).indices.tolist():
        peak = float(opacity[i].detach())
        if not near <= float(z[i].detach()) <= far or peak < MIN_ALPHA:
            continue
        dx, dy = columns - centre[i, 0], rows[:, None] - centre[i, 1]
        if spread is not None:
            dx, dy = dx - spread[i, ..., 0], dy - spread[i, ..., 1]
        power = 0.5 * (conic[i, 0, 0] * dx * dx + conic[i, 1, 1] * dy * dy)
        power = power + conic[i, 0, 1] * dx * dy
        alpha = torch.clamp(opacity[i] * torch.exp(-power), max=MAX_ALPHA)
        cutoff = min(math.log(255.0 * peak), MAX_POWER)
        passes = power.detach() <= cutoff
        group = -1 if groups is None else int(groups[i])
        if group >= 0:
            passes = passes & ~(ring == group).any(0)
        passes = passes & ~stopped
        stops = passes & (left.detach() * (1 - alpha.detach()) <= MIN_TRANSMITTANCE)
        stopped = stopped | stops
        keep = passes & ~stops
        weight = torch.where(keep, alpha * left, 0.0)
        blended = blended + weight[..., None] * features[i]
        contribution[i] = weight.detach().sum()
        before, left = left, torch.where(keep, left * (1 - alpha), left)
        median = torch.where((before > 0.5) & (left <= 0.5), z[i], median).detach()
        if group >= 0:
            pushed = torch.cat([torch.full_like(ring[:1], group), ring[:-1]])
            ring = torch.where(keep, pushed, ring)
    alpha = 1 - left
    image = blended[..., :channels]
    if background is not None:
        image = image + left[..., None] * background
    covered = alpha > 0
    depth = torch.where(covered, blended[..., -1] / torch.where(covered, alpha, 1.0), 0.0)
    normal = blended[..., channels:-1] if normals is not None else None
    return image, alpha, depth, normal, contribution, median
