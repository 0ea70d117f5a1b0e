"""Materials and states for the tests of the constitutive laws."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsfluent.ops.plasticity import LAWS, return_mapping
from gsfluent.ops.reference.tensors import to_matrix, to_sym

MU, KAPPA, DENSITY = 4e4, 1e5, 1000.0
EYE = torch.eye(3, dtype=torch.float64)
# Columns 2, 3, 4, 5 and 7 of a row, by law; about half of the states below yield.
COLUMNS: dict[str, tuple[float, float, float, float, float]] = {
    "elastic": (0.0, 0.0, 0.0, 0.0, 0.0),
    "nacc": (1.85, 0.3, 3.0, 0.1, 0.0),
    "drucker_prager": (0.3, 800.0, 0.0, 0.0, 0.0),
    "von_mises": (4000.0, 0.0, 2e4, 0.0, 0.0),
    "fluid": (3.0, 0.0, 0.0, 0.0, 7.0),
    "rigid": (0.0, 0.0, 0.0, 0.0, 0.0),
    "corotated": (0.0, 0.0, 0.0, 0.0, 0.0),
    "yeoh": (-3e3, 4e3, 0.0, 0.0, 0.0),
    "ogden": (1.3, 2e2, 5.0, -1e3, -2.0),
    "phase_field": (500.0, 0.4, 0.04, 0.0, 0.0),
}
DT = 1e-3


def table(name: str, dtype: torch.dtype = torch.float64, **columns: float) -> dict[str, Tensor]:
    """One row of a law; ``columns`` replaces numbered columns, e.g. ``c2=5.0``."""
    c2, c3, c4, c5, c7 = COLUMNS[name]
    row = [MU, KAPPA, c2, c3, c4, c5, DENSITY, c7]
    for key, value in columns.items():
        row[int(key[1:])] = value
    law = torch.tensor([LAWS[name]], dtype=torch.int32)
    return {"law": law, "params": torch.tensor([row], dtype=dtype)}


def strained(count: int, scale: float, seed: int = 3) -> Tensor:
    """Strains b - I of F = I + scale randn, float64 [count, 6]."""
    generator = torch.Generator().manual_seed(seed)
    f = scale * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return to_sym(f + f.mT + f @ f.mT)


def states(name: str, count: int, scale: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """(strain, alpha, increment) in float64, about half of them beyond the surface of ``name``."""
    generator = torch.Generator().manual_seed(5)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    strain = strained(count, scale)
    if name == "fluid":
        j = 0.9 + 0.25 * random(count)
        same = (j ** (2.0 / 3.0) - 1.0)[:, None].expand(-1, 3)
        strain = torch.cat([same, torch.zeros(count, 3, dtype=torch.float64)], dim=1)
    if name == "rigid":
        strain = torch.zeros(count, 6, dtype=torch.float64)
    alpha = {
        "nacc": -0.06 * random(count) + 0.005,
        "drucker_prager": (0.02 * random(count) - 0.01).clamp(min=0.0),
        "von_mises": 0.1 * random(count),
    }.get(name, torch.zeros(count, dtype=torch.float64))
    increment = 0.4 * scale * (2.0 * random(count, 3, 3) - 1.0)
    return strain, alpha, increment


def rotations(count: int) -> Tensor:
    """Random rotations, [count, 3, 3]."""
    generator = torch.Generator().manual_seed(9)
    q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    q = q * r.diagonal(dim1=1, dim2=2).sign()[:, None, :]
    return q * torch.linalg.det(q)[:, None, None]


def rotate(q: Tensor, sym: Tensor) -> Tensor:
    """Q s Q^T, [N, 6]."""
    return to_sym(q @ to_matrix(sym.double()) @ q.mT)


def cast(dtype: torch.dtype, *values: Any) -> tuple[Any, ...]:
    """Tensors in another dtype."""
    return tuple(v.to(dtype) for v in values)


def assert_cuda_matches_cpu(row: dict[str, Tensor], dtype: torch.dtype) -> None:
    """4000 states of metal through a law, on a GPU as on the CPU."""
    s = cast(dtype, *states("von_mises", 4000))
    t = {"law": row["law"], "params": row["params"].to(dtype)}
    want = return_mapping(*s, **t, dt=DT)
    got = return_mapping(*(a.cuda() for a in s), **{k: v.cuda() for k, v in t.items()}, dt=DT)
    bound = 2e-4 if dtype == torch.float32 else 1e-10
    assert int(want[3][0]) > 100
    for g, w in zip(got[:3], want[:3], strict=True):
        assert (g.cpu() - w).abs().max() <= bound * float(w.abs().max())
    assert (got[3].cpu() - want[3]).abs().max() <= (8 if dtype == torch.float32 else 0)
