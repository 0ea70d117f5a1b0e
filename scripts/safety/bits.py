"""Digests of what the compiled half computes on the CPU, to compare two installations.

    python scripts/safety/bits.py            # a line per operator
    PYTHONPATH=. python scripts/safety/bits.py    # of the checkout one stands in

Same machine, same digests: a wheel then computes what the checkout does. scripts/wheel_try.sh asks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

import gsfluent
from gsfluent import ops

DX = 0.02


def digest(tensors: Iterable[Tensor]) -> str:
    """Of the bytes of tensors, in order."""
    found = hashlib.blake2b(digest_size=16)
    for tensor in tensors:
        found.update(tensor.detach().contiguous().numpy().tobytes())
    return found.hexdigest()


def drawn(*shape: int, seed: int = 0) -> Tensor:
    """Numbers in 0..1 that hang on no version of torch."""
    return torch.from_numpy(np.random.default_rng(seed).random(shape))


def fallen(dtype: torch.dtype) -> list[Tensor]:
    """An elastic and a brittle cube that fall on a floor and on one another."""
    points = torch.cat([0.1 + 0.12 * drawn(1500, 3), 0.1 + 0.12 * drawn(1500, 3, seed=1)])
    points[1500:, 2] += 0.125
    n = points.shape[0]
    body = (torch.arange(n) >= n // 2).to(torch.int32)
    young, nu = 2e4, 0.3
    mu, kappa = young / (2 * (1 + nu)), young / (3 * (1 - 2 * nu))
    rows = [[mu, kappa, 0, 0, 0, 0, 1000.0, 0], [mu, kappa, 1.85, 0.5, 3.0, 0.1, 1000.0, 0]]
    volume = torch.full((n,), DX**3 / 8, dtype=dtype)
    speed = torch.zeros(n, 3, dtype=dtype)
    speed[:, 2] = -3.0
    floor = torch.zeros(1, 16, dtype=dtype)
    floor[0, 1], floor[0, 2], floor[0, 5], floor[0, 8] = 2.0, 0.3, 0.09, 1.0
    solver = ops.Solver(
        points, speed, 1000.0 * volume, volume, dx=DX, body=body, material=body,
        law=torch.tensor([0, 1], dtype=torch.int32), params=torch.tensor(rows, dtype=dtype),
        alpha=torch.full((n,), -0.02, dtype=dtype), colliders=floor,
    )  # fmt: skip
    solver.advance(steps=60)
    return [
        solver.position, solver.velocity, solver.affine, solver.strain, solver.alpha, solver.peak,
        solver.stress, solver.impulse,
    ]  # fmt: skip


def drawn_splats() -> list[Tensor]:
    """A picture of splats, and the slopes of its sum."""
    n = 400
    means = (drawn(n, 3) * 2 - 1 + torch.tensor([0.0, 0.0, 3.0])).float().requires_grad_()
    quats = (drawn(n, 4, seed=1) - 0.5).float().requires_grad_()
    scales = (0.02 + 0.1 * drawn(n, 3, seed=2)).float().requires_grad_()
    colors = drawn(n, 3, seed=3).float().requires_grad_()
    focal = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])
    seen = ops.rasterize(
        means, drawn(n, seed=4).float(), torch.eye(4), focal, 64, 64,
        quats=quats, scales=scales, colors=colors,
    )  # fmt: skip
    loss = ops.photometric_loss(seen.image, drawn(64, 64, 3, seed=5).float()).loss
    slopes = torch.autograd.grad(loss, [means, quats, scales, colors])
    return [seen.image, seen.alpha, seen.depth, loss, *slopes]


def main() -> None:
    """Print a line per operator."""
    torch.set_num_threads(1)
    print(f"# {gsfluent.__file__}")
    center, shape = ops.mvee(drawn(8, 40, 3).float())
    for name, tensors in {
        "solver float32": fallen(torch.float32),
        "solver float64": fallen(torch.float64),
        "rasterize, photometric_loss": drawn_splats(),
        "mvee": [center, shape],
    }.items():
        print(f"{name}: {digest(tensors)}")


if __name__ == "__main__":
    main()
