"""NACC parameters of brittle matter from what handbooks give, for one grid.

Uniaxial strengths in tension and compression fix cohesion and strength of the yield ellipse; the
fracture energy over the width of the band of cells in which a crack localises fixes how slowly the
strength is lost (crack band theory, Bazant and Oh 1983). Where the grid is so coarse that the
elastic energy of the band alone is more than the fracture energy, the strength is lowered until
both agree, as they propose: what counts at that scale is the energy.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gsfluent.materials import LARGEST, STEEPEST, Field, Material, opening, phase_field
from gsfluent.pipeline.matter.crack_band import ALPHA_MIN, BAND_CELLS, softening_energies

STEP = 0.04
"""Steps of the logarithm of strength in which it varies from place to place."""
_KNOWN_ROWS = 1000  # of a table whose solution is remembered; larger ones are fields of their own


def brittle_rows(
    material: Material, sample: Callable[[Field], Tensor], weakness: Tensor, dx: float
) -> tuple[Tensor, Tensor]:
    """Rows and alpha0 of points of a material on a grid.

    Args:
        material: NACC material; one without a fracture energy, or with softening given by hand
            (``alpha0``, ``hardening``), is taken as it is.
        sample: Turns a parameter into its values at the points.
        weakness: Factor on the strength of each point, [N].
        dx: Node spacing [m].

    Returns:
        ``(rows, alpha0)``: float64 [N, 8] and [N].
    """
    rows, alpha0 = material.parameters(sample), material.start_alphas(sample)
    given = material.fracture_energy
    if given is None or material.energy_by_hand:
        return rows, alpha0 * weakness
    step = (weakness.clamp(min=1e-3).log() / STEP).round()
    energy = sample(given)
    key = torch.cat([rows, torch.stack([alpha0, energy, step], dim=1)], dim=1)
    kinds, which = distinct_rows(key)
    table, (alpha0, energy, step) = kinds[:, :8].clone(), kinds[:, 8:].unbind(dim=1)
    if material.surface == "rankine":
        table[:, 3], table[:, 4], alpha0, _ = _opening(
            material, table, alpha0, energy, (STEP * step).exp(), dx
        )
        return table[which], alpha0[which]
    strength = table[:, 1] * torch.sinh(table[:, 4] * alpha0.abs())
    hardening, alpha0, _ = softened(
        table, strength, energy, (STEP * step).exp(), dx, prefer=material.prefer
    )
    table[:, 4] = hardening
    return table[which], alpha0[which]


def distinct_rows(table: Tensor) -> tuple[Tensor, Tensor]:
    """What ``torch.unique(table, dim=0, return_inverse=True)`` gives, by sorts of whole numbers.

    Most columns hold one value, and to sort rows takes a hundred times longer than to sort numbers.

    Args:
        table: Rows without NaN, [N, K], at least one.

    Returns:
        ``(rows, which)``: the different rows in lexicographic order, [M, K], and the one of each
        row of the table, int64 [N].
    """
    which = torch.zeros(table.shape[0], dtype=torch.int64, device=table.device)
    for column in table.unbind(dim=1):
        if bool((column == column[0]).all()):
            continue
        values, rank = torch.unique(column, return_inverse=True)
        which = torch.unique(which * values.shape[0] + rank, return_inverse=True)[1]
    first = torch.zeros(int(which.max()) + 1, dtype=torch.int64, device=table.device)
    first[which] = torch.arange(which.shape[0], device=table.device)
    return table[first], which


def kept_strength(material: Material, dx: float) -> float:
    """Share of its strength that a material keeps on a grid; 1 where nothing asks for less.

    Args:
        material: Of any law; a parameter that varies in space counts where it keeps least.
        dx: Node spacing [m].
    """
    if material.law == "phase_field":
        return phase_field.kept(material, dx)[1]
    if material.law != "nacc" or material.energy_by_hand or material.prefer == "strength":
        return 1.0
    columns = (material.parameters(), material.start_alpha, material.fracture_energy)
    row, alpha0, energy = (torch.as_tensor(c, dtype=torch.float64) for c in columns)
    # not torch's, which imports SymPy
    shape = np.broadcast_shapes(row.shape[:-1], alpha0.shape, energy.shape)
    rows = row.expand(*shape, 8).reshape(-1, 8)
    table = torch.cat(
        [rows, alpha0.expand(shape).reshape(-1, 1), energy.expand(shape).reshape(-1, 1)], dim=1
    )
    table = distinct_rows(table)[0]
    if material.surface == "rankine":
        whole = torch.ones_like(table[:, 9])
        return float(_opening(material, table, table[:, 8], table[:, 9], whole, dx)[3].min())
    strength = table[:, 1] * torch.sinh(table[:, 4] * table[:, 8].abs())
    limit = _held_strength(table[:, :8], strength, table[:, 9] / (BAND_CELLS * dx))
    return float((limit / strength).clamp(max=1.0).min())


def _opening(
    material: Material, rows: Tensor, alpha0: Tensor, energy: Tensor, weakness: Tensor, dx: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What :func:`gsfluent.materials.opening` says of rows on a grid, [M] each."""
    mu, kappa, beta, xi = (rows[:, column] for column in (0, 1, 3, 4))
    tensile = beta * kappa * torch.sinh(xi * alpha0.abs()) * weakness
    return opening(mu, kappa, tensile, energy / (BAND_CELLS * dx), prefer=material.prefer)


def softened(
    rows: Tensor,
    strength: Tensor,
    energy: Tensor,
    weakness: Tensor,
    dx: float,
    *,
    prefer: str = "toughness",
) -> tuple[Tensor, Tensor, Tensor]:
    """Softening with a given fracture energy on a grid.

    Args:
        rows: NACC rows, of which all but the hardening are read, float64 [M, 8].
        strength: p0 [Pa], [M].
        energy: Fracture energy G_c [J/m^2], [M].
        weakness: Factor on the strength, [M]. What is then stronger than the grid can hold with
            this energy has the strength that it can hold.
        dx: Node spacing [m].
        prefer: ``strength`` leaves the strength as it is, and takes more energy where it must.

    Returns:
        ``(hardening, alpha0, kept)``, [M] each; the last is the share of the strength that is left.
    """
    target = energy / (BAND_CELLS * dx)
    limit = LARGEST * rows[:, 1]
    if prefer == "toughness":
        limit = _held_strength(rows, strength, target)
    kept = (limit / strength).clamp(max=1.0)
    strength = (strength * weakness).minimum(limit)
    alpha0 = _start(rows, strength, target)
    return torch.asinh(strength / rows[:, 1]) / alpha0.abs(), alpha0, kept


def _remembered(work: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """By value: a plan, its run and every session that begins anew ask for the same rows."""

    @functools.lru_cache(maxsize=256)
    def known(*cells: tuple[bytes, torch.Size]) -> Tensor:
        values = (torch.frombuffer(bytearray(data), dtype=torch.float64) for data, _ in cells)
        return work(*(v.view(shape) for v, (_, shape) in zip(values, cells, strict=True)))

    def asked(*given: Tensor) -> Tensor:
        if not 0 < len(given[0]) <= _KNOWN_ROWS:
            return work(*given)
        return known(*((value.numpy().tobytes(), value.shape) for value in given)).clone()

    return functools.wraps(work)(asked)


@_remembered
def _start(rows: Tensor, strength: Tensor, target: Tensor) -> Tensor:
    """alpha0 from which strength p0 takes so much energy to be lost, [M].

    The energy grows almost linearly with alpha0 at fixed strength beyond the steepest softening:
    secant steps.
    """
    least = _steepest(rows, strength)
    before, found = least, _dissipated(rows, strength, least, target)
    alpha0 = (least * (target / found).clamp(min=1.0)).clamp(min=ALPHA_MIN)
    for _ in range(10):
        now = _dissipated(rows, strength, alpha0, target)
        slope = (now - found) / (alpha0 - before)
        before, found = alpha0, now
        closer = alpha0 + (target - now) / slope
        # A slope that is no number: nothing moved. On very fine grids soft matter tears with less
        # energy, because the return map keeps no alpha below ALPHA_MIN.
        alpha0 = torch.where(slope < 0.0, closer.minimum(least), alpha0).clamp(min=ALPHA_MIN)
    return alpha0


@_remembered
def _held_strength(rows: Tensor, strength: Tensor, target: Tensor) -> Tensor:
    """The most strength that dissipates so much energy, at the steepest softening.

    Args:
        rows: NACC rows, of which all but the hardening are read, float64 [M, 8].
        strength: p0 to begin with [Pa], [M].
        target: Energy per volume [J/m^3], [M].

    Returns:
        p0 [Pa], float64 [M]: with more the band dissipates more energy than that.
    """
    held = strength
    for _ in range(8):  # the energy at the steepest softening goes as the strength squared
        found = _dissipated(rows, held, _steepest(rows, held), target)
        held = (held * (target / found).sqrt()).minimum(LARGEST * rows[:, 1])
    return held


def _steepest(rows: Tensor, strength: Tensor) -> Tensor:
    """alpha0 of the steepest softening, [M]."""
    return -torch.asinh(strength / rows[:, 1]) * rows[:, 3] / STEEPEST


def _dissipated(rows: Tensor, strength: Tensor, alpha0: Tensor, target: Tensor) -> Tensor:
    """Energy per volume that strength p0 with a start alpha0 dissipates [J/m^3], [M]."""
    table = rows.clone()
    table[:, 4] = torch.asinh(strength / rows[:, 1]) / alpha0.abs()
    # next to no strength: what is left of it when it is gone hides what it took
    return softening_energies(table, alpha0).nan_to_num(nan=0.0).clamp(min=1e-9 * target)
