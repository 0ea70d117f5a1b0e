"""Rotations, covariances, spherical harmonics and cameras as plain tensor functions.

Conventions (those of every 3DGS program): quaternions are ``wxyz``; covariances are packed ``xx,
yy, zz, xy, xz, yz``; real spherical harmonics carry the Condon-Shortley sign, so degree 1 reads
``-y, z, -x`` times 0.4886; cameras look along +z with +y down (OpenCV). All functions accept
leading batch dimensions and are differentiable.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.ops import turns

SH0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""


def normalize_quaternions(quats: Tensor) -> Tensor:
    """Scale quaternions [..., 4] to length one; a zero quaternion becomes the identity."""
    length = quats.norm(dim=-1, keepdim=True)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    tiny = torch.finfo(quats.dtype).tiny
    return torch.where(length > tiny, quats / length.clamp_min(tiny), identity)


def quaternion_to_matrix(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (``wxyz``, normalised here)."""
    if turns.served(quats):
        made = turns.quats_to_matrices(quats.reshape(-1, 4))
        return made.view(*quats.shape[:-1], 3, 3)
    w, x, y, z = normalize_quaternions(quats).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Quaternions [..., 4] (``wxyz``, w >= 0) of rotation matrices [..., 3, 3].

    The four squared components follow from the diagonal; dividing by the largest of them keeps
    every case well conditioned (Shepperd 1978).
    """
    if turns.served(matrix):
        made = turns.matrices_to_quats(matrix.reshape(-1, 3, 3))
        return made.view(*matrix.shape[:-2], 4)
    m = matrix
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], dim=-1
    )
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], dim=-1),
            torch.stack([a, squares[..., 1], d, e], dim=-1),
            torch.stack([b, d, squares[..., 2], f], dim=-1),
            torch.stack([c, e, f, squares[..., 3]], dim=-1),
        ],
        dim=-2,
    )
    best = squares.argmax(dim=-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quats = functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def quaternion_multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product [..., 4]: rotate by ``right`` first, then by ``left``."""
    if left.shape == right.shape and turns.served(left, right):
        return turns.quat_products(left.reshape(-1, 4), right.reshape(-1, 4)).view(left.shape)
    w1, x1, y1, z1 = left.unbind(-1)
    w2, x2, y2, z2 = right.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )


def pack_symmetric(matrix: Tensor) -> Tensor:
    """Pack symmetric [..., 3, 3] into [..., 6] in the order ``xx, yy, zz, xy, xz, yz``."""
    m = matrix
    return torch.stack(
        [m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], m[..., 0, 1], m[..., 0, 2], m[..., 1, 2]],
        dim=-1,
    )


def unpack_symmetric(packed: Tensor) -> Tensor:
    """Inverse of :func:`pack_symmetric`: [..., 6] to [..., 3, 3]."""
    xx, yy, zz, xy, xz, yz = packed.unbind(-1)
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).unflatten(-1, (3, 3))


def covariance(quats: Tensor, scales: Tensor) -> Tensor:
    """Packed covariances R diag(scales^2) R^T [..., 6] of quaternions and standard deviations."""
    root = quaternion_to_matrix(quats) * scales[..., None, :]
    return pack_symmetric(root @ root.mT)


def sh_degree(coefficients: int) -> int:
    """Degree d of ``coefficients`` = (d + 1)^2 spherical-harmonic coefficients.

    Raises:
        ValueError: The count is not a perfect square.
    """
    root = math.isqrt(max(coefficients, 0))
    if root * root != coefficients or root == 0:
        raise ValueError(
            f"sh: coefficient count must be 1, 4, 9 or 16 (degree 0 to 3), got {coefficients}"
        )
    return root - 1


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit directions [..., 3] up to ``degree``: [..., (degree + 1)^2].

    Ordered by degree l, then m = -l..l, with the Condon-Shortley sign. ``P_l^m`` (without its
    (1-z^2)^(m/2) factor) comes from the three-term recurrence ``(l-m) P_l^m = (2l-1) z P_{l-1}^m -
    (l+m-1) P_{l-2}^m``; the factor is carried by ``(x + i y)^m``, so the result is a polynomial
    with no special case at the poles.
    """
    x, y, z = directions.unbind(-1)
    columns: dict[tuple[int, int], Tensor] = {}
    cosine, sine = torch.ones_like(x), torch.zeros_like(x)
    diagonal = 1.0  # P_m^m = (-1)^m (2m - 1)!!
    for m in range(degree + 1):
        previous, current = torch.zeros_like(z), torch.full_like(z, diagonal)
        for order in range(m, degree + 1):
            if order > m:
                upper = ((2 * order - 1) * z * current - (order + m - 1) * previous) / (order - m)
                previous, current = current, upper
            norm = math.sqrt(
                (2 * order + 1)
                / (4 * math.pi)
                * math.factorial(order - m)
                / math.factorial(order + m)
            )
            if m == 0:
                columns[order, 0] = norm * current
            else:
                columns[order, m] = math.sqrt(2) * norm * cosine * current
                columns[order, -m] = math.sqrt(2) * norm * sine * current
        cosine, sine = cosine * x - sine * y, cosine * y + sine * x
        diagonal *= -(2 * m + 1)
    return torch.stack([columns[n, m] for n in range(degree + 1) for m in range(-n, n + 1)], dim=-1)


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """Constant SH coefficient of a colour: ``(rgb - 0.5) / 0.28209``."""
    return (rgb - 0.5) / SH0


def sh0_to_rgb(sh0: Tensor) -> Tensor:
    """Colour of a constant SH coefficient, cut at zero as the rasterizer does."""
    return (sh0 * SH0 + 0.5).clamp_min(0.0)


@functools.cache
def _sh_samples(degree: int) -> tuple[Tensor, Tensor]:
    """Well spread directions [M, 3] and the inverse [2 degree + 1, M] of the basis on them."""
    count = 4 * (2 * degree + 1)
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = index * (math.pi * (3 - math.sqrt(5)))
    radius = (1 - height * height).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=-1)
    basis = sh_basis(directions, degree)[:, degree * degree :]
    return directions, torch.linalg.pinv(basis)


def rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    """Rotate spherical-harmonic colours with the object.

    The rotated function is ``f'(R d) = f(d)``. Each degree is closed under rotation, so its
    coefficients transform by a (2l+1) x (2l+1) matrix, found exactly (to round-off) by sampling the
    basis at more than 2l+1 fixed directions.

    Args:
        sh: Coefficients [N, K, 3], K = (degree + 1)^2.
        rotation: One rotation [3, 3] or one per row [N, 3, 3].

    Returns:
        Rotated coefficients [N, K, 3].
    """
    degree = sh_degree(sh.shape[-2])
    parts = [sh[..., :1, :]]
    for order in range(1, degree + 1):
        directions, inverse = (part.to(sh) for part in _sh_samples(order))
        # Row vectors: (R^T d)^T = d^T R.
        basis = sh_basis(directions @ rotation.to(sh), order)[..., order * order :]
        block = inverse @ basis
        parts.append(block @ sh[..., order * order : (order + 1) ** 2, :])
    return torch.cat(parts, dim=-2)


def trilinear(grid: Tensor, place: Tensor) -> Tensor:
    """Values [N] of a grid [X, Y, Z] between its points, at places [N, 3] in steps; 0 outside.

    One operation at a time, which rounds alike on every device.
    """
    flat = grid.reshape(-1)
    axes = []
    for axis, stride in enumerate((grid.shape[1] * grid.shape[2], grid.shape[2], 1)):
        base = place[:, axis].floor()
        fraction, most = place[:, axis] - base, grid.shape[axis] - 1
        low, ends = base.to(torch.int64), []
        for index, share in ((low, 1 - fraction), (low + 1, fraction)):
            held = index.clamp(0, most)
            # what lies outside has no share
            ends.append((held * stride, share * (held == index)))
        axes.append(ends)
    total = grid.new_zeros(len(place))
    for a, u in axes[0]:
        for b, v in axes[1]:
            corner, share = a + b, u * v
            for c, w in axes[2]:
                total += (share * w).to(grid) * flat.index_select(0, corner + c)
    return total


def ascending(values: Tensor) -> Tensor:
    """Values sorted along their first axis, [N, ...].

    On a CPU by NumPy, whose vector instructions take a tenth to a twentieth of ``Tensor.sort``.
    """
    if values.device.type != "cpu" or values.requires_grad:
        return values.sort(0).values
    return torch.from_numpy(np.sort(values.numpy(), axis=0))


def quantiles(values: Tensor, shares: Sequence[float]) -> Tensor:
    """What ``torch.quantile(values, shares, dim=0)`` gives for finite float64 values, [S, ...]."""
    ordered = ascending(values)
    place = torch.tensor(shares, dtype=torch.float64) * (len(ordered) - 1)
    low = place.floor()
    weight = (place - low).reshape(-1, *[1] * (values.dim() - 1)).expand(-1, *values.shape[1:])
    return torch.lerp(ordered[low.long()], ordered[place.ceil().long()], weight.to(values))


def product(values: Tensor) -> Tensor:
    """Product along the last axis, [..., K] to [...], of few numbers.

    ``Tensor.prod`` is compiled at its first use on a GPU, which takes 0.7 s for each dtype.
    """
    return functools.reduce(torch.mul, values.unbind(-1))


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrix [4, 4] (OpenCV axes) of a camera at ``eye`` facing ``target``, [3].

    Raises:
        ValueError: Eye and target coincide.
    """
    eye, target, up = (part.to(torch.float64) for part in (eye, target, up))
    forward = target - eye
    if not float(forward.norm()) > 0:
        raise ValueError(f"look_at: eye and target must differ, got {eye.tolist()} twice")
    forward = functional.normalize(forward, dim=0)
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6 * float(
        up.norm()
    ):  # looking straight along up: any horizontal axis will do
        right = torch.linalg.cross(
            forward, torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())]
        )
    right = functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64, device=eye.device)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return viewmat


def rotation_between(source: Tensor, target: Tensor) -> Tensor:
    """Smallest rotation [3, 3] (float64) that carries direction ``source`` onto ``target``."""
    a, b = (functional.normalize(part.to(torch.float64), dim=0) for part in (source, target))
    if float(a @ b) < -1 + 1e-12:  # opposite: half a turn about any perpendicular axis
        axis = functional.normalize(
            torch.linalg.cross(a, torch.eye(3, dtype=a.dtype)[int(a.abs().argmin())]), dim=0
        )
        return 2 * torch.outer(axis, axis) - torch.eye(3, dtype=a.dtype)
    half = a + b
    return (
        torch.eye(3, dtype=a.dtype) - torch.outer(half, half) / (1 + a @ b) + 2 * torch.outer(b, a)
    )
