"""Crack-band scaling: softening that dissipates the same energy per crack area on every grid.

A crack in a local softening law is a band of cells, so what it dissipates per area is the energy
density of the law times a few ``dx``: finer grids break more easily, without end. Stretching the
softening by ``reference / dx`` at unchanged strength keeps the product (Bazant and Oh 1983, "Crack
band theory for fracture of concrete"). For NACC, whose strength is
``p0 = kappa sinh(xi max(-alpha, 0))`` and whose damage is a strain, that is
``alpha0 -> alpha0 s``, ``xi -> xi / s`` with ``s = reference / dx``. The measured
slopes with and without: ``softening_bar`` and ``double_cantilever`` of the lab.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.materials import LAWS

BAND_CELLS = 2.0
"""Cells in which a crack dissipates, mean over its places between the nodes: 2.5 to 3 where it lies
on nodes, 1.2 to 1.7 between them (gsfluent.lab.problems.fracture.energy). A hard blow breaks up to
four."""
ALPHA_MIN = -10.0
"""Smallest alpha the return map keeps."""


def crack_band(
    params: Tensor, alpha: Tensor, *, dx: float, reference: float
) -> tuple[Tensor, Tensor]:
    """Return NACC parameters and alpha that dissipate on ``dx`` what the given ones do elsewhere.

    Args:
        params: Rows of :func:`gsfluent.ops.return_mapping`, [M, 8] or [8]; only the hardening
            (column 4) changes. Pass rows of NACC material only.
        alpha: Log plastic volume ratio at the start, any shape; negative is intact.
        dx: Node spacing of the simulation [m].
        reference: Node spacing the parameters were chosen for [m].

    Returns:
        ``(params, alpha)``: new tensors; strength and stiffness are those of the input. Beyond
        :func:`brittle_spacing` the strength is lost in one step, and the energy is no longer kept.

    Raises:
        ValueError: A spacing is not positive, or alpha leaves the range of the return map.
    """
    if not (0.0 < dx < math.inf and 0.0 < reference < math.inf):
        raise ValueError(f"crack_band: dx and reference must be positive, got {dx} and {reference}")
    scale = reference / dx
    stretched = torch.where(alpha < 0, alpha * scale, alpha)
    if bool((stretched < ALPHA_MIN).any()):
        raise ValueError(
            f"crack_band: alpha becomes {float(stretched.min()):.3g}, below {ALPHA_MIN:g}: "
            f"dx = {dx:g} m is too far below the reference of {reference:g} m"
        )
    rows = params.clone()
    rows[..., 4] = rows[..., 4] / scale
    return rows, stretched


def brittle_spacing(params: Tensor, *, reference: float) -> Tensor:
    """Largest node spacing on which the softening is still slower than elastic unloading [m].

    ``reference / (beta xi)``: above it ``cohesion * hardening > 1`` after :func:`crack_band`, a
    point past the tensile tip has no neighbouring state to soften to, and loses its strength in one
    step (docs/theory/return-mapping.md).

    Args:
        params: [M, 8] or [8], as given to :func:`crack_band`.
        reference: Node spacing they were chosen for [m].

    Returns:
        [M] or a scalar; infinite where the product is zero.
    """
    return reference / (params[..., 3] * params[..., 4])


def softening_energy(params: Tensor, alpha: float, *, steps: int = 400) -> float:
    """Energy per volume that uniaxial straining dissipates until the strength is gone [J/m^3].

    Arguments and path as :func:`softening_energies`, for one row [8].

    Returns:
        The energy density. For softening slow against elastic unloading it grows linearly with
        ``|alpha|`` at fixed strength.

    Raises:
        ValueError: alpha is not negative, or the strength is not lost on the path (the row is not
            one of material that softens in tension).
    """
    if not alpha < 0.0:
        raise ValueError(f"softening_energy: alpha must be negative, got {alpha}")
    row = params.detach().double().cpu().reshape(1, 8)
    start = torch.tensor([alpha], dtype=torch.float64)
    energy = float(softening_energies(row, start, steps=steps))
    if not math.isfinite(energy):
        kappa, beta, xi = (float(row[0, i]) for i in (1, 3, 4))
        raise ValueError(
            f"softening_energy: strength is still left after a path of 1.5 |alpha| = "
            f"{-1.5 * alpha:.3g} beyond the elastic limit (kappa {kappa:g}, cohesion {beta:g}, "
            f"hardening {xi:g})"
        )
    return energy


def softening_energies(params: Tensor, alpha: Tensor, *, steps: int = 400) -> Tensor:
    """Energies per volume that uniaxial straining dissipates until the strength is gone [J/m^3].

    The work of the stress along the path of one point, stretched along x with the other directions
    held, less what is still stored at the end.

    Args:
        params: NACC rows, float64 [M, 8].
        alpha: Log plastic volume ratios at the start, negative, float64 [M].
        steps: Steps of each path, up to a stretch of ``1.5 |alpha|`` beyond the elastic limit.

    Returns:
        Float64 [M]; NaN where the strength is not lost on the path.
    """
    count = params.shape[0]
    law = torch.full((count,), LAWS["nacc"], dtype=torch.int32)
    beta, xi = params[:, 3], params[:, 4]
    elastic = beta.clamp(min=1.0) * torch.sinh((-xi * alpha).clamp(max=5.0))
    stretch = -1.5 * alpha + 3.0 * elastic.clamp(max=0.5)
    spent, left = ops.softening_paths(params, alpha, stretch, steps=steps)
    return spent - ops.elastic_energy(left, law=law, params=params)


def fracture_energy(params: Tensor, alpha: float, *, dx: float) -> float:
    """Energy per crack area of a NACC material on a grid of spacing ``dx`` [J/m^2].

    :func:`softening_energy` times a band of ``BAND_CELLS`` cells; one crack takes up to a half more
    or less, depending on how it lies on the grid (docs/theory/fracture.md).

    Raises:
        ValueError: As :func:`softening_energy`, or ``dx`` is not positive.
    """
    if not 0.0 < dx < math.inf:
        raise ValueError(f"fracture_energy: dx must be positive, got {dx}")
    return BAND_CELLS * dx * softening_energy(params, alpha)
