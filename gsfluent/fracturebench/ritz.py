"""Exact small motions of free elastic bodies, by the method of Ritz.

Displacements are sums of polynomials over the whole body; mass and stiffness are integrals by
Gauss's rule. The surface of a free body asks for nothing, so that the sums converge as fast as the
polynomials do: eight digits of the lowest modes of a beam with a few hundred unknowns. This is how
resonant ultrasound spectroscopy computes its spectra (Visscher, Migliori, Bell & Reinert 1991,
J. Acoust. Soc. Am. 90, 2154).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.polynomial import legendre

from .scene import Floats

Rule = tuple[Floats, Floats]


def box_rule(half: Sequence[float], counts: Sequence[int]) -> Rule:
    """Points [Q, 3] and weights [Q] of Gauss's rule in a box about the origin of half edges [m]."""
    axes = [legendre.leggauss(n) for n in counts]
    points = np.stack(np.meshgrid(*(a for a, _ in axes), indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", *(w for _, w in axes)).reshape(-1)
    return points * np.asarray(half), weights * float(np.prod(half))


def ball_rule(radius: float, count: int) -> Rule:
    """Points [Q, 3] and weights [Q] of a rule in a ball about the origin, exact to 2 count - 3."""
    r, wr = legendre.leggauss(count)
    r, wr = 0.5 * (r + 1.0), 0.5 * wr
    z, wz = legendre.leggauss(count)
    turn = 2.0 * math.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    flat = np.sqrt(1.0 - z * z)
    sphere = np.stack(
        [np.outer(flat, np.cos(turn)), np.outer(flat, np.sin(turn)),
         np.repeat(z[:, None], 2 * count, axis=1)], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    area = np.repeat(wz * math.pi / count, 2 * count)
    points = (radius * r)[:, None, None] * sphere
    weights = radius**3 * np.outer(wr * r * r, area)
    return points.reshape(-1, 3), weights.reshape(-1)


@dataclasses.dataclass(frozen=True)
class Modes:
    """Vibrations of a body about the origin, by rising frequency; rigid motions come first."""

    omega: Floats  # angular frequencies [1/s], [K]
    # of the terms, normed so that the integral of density times the square of a mode is 1, [terms,
    # K]
    coefficients: Floats
    # component of the displacement and degree on each axis of each term
    terms: tuple[tuple[int, int, int, int], ...]
    scale: tuple[float, float, float]  # lengths that make the coordinates dimensionless [m]

    def at(self, points: Floats, mode: int) -> tuple[Floats, Floats]:
        """Return a mode [N, 3] and its gradient [N, 3, 3] at points [m]."""
        values, slopes = _basis(points, self.terms, self.scale)
        part = np.array([t[0] for t in self.terms])
        shape, gradient = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
        for component in range(3):
            own = part == component
            chosen = self.coefficients[own, mode]
            shape[:, component] = values[:, own] @ chosen
            gradient[:, component] = np.einsum("ntj,t->nj", slopes[:, own], chosen)
        return shape, gradient


def _basis(
    points: Floats, terms: Sequence[tuple[int, int, int, int]], scale: Sequence[float]
) -> tuple[Floats, Floats]:
    """Values [N, terms] and gradients [N, terms, 3] of products of Legendre's polynomials."""
    top = max(max(t[1:]) for t in terms)
    value, slope = [], []
    for axis in range(3):
        s = points[:, axis] / scale[axis]
        value.append(legendre.legvander(s, top))
        steep = np.stack(
            [legendre.legval(s, legendre.legder(np.eye(top + 1)[i])) for i in range(top + 1)],
            axis=1,
        )
        slope.append(steep / scale[axis])
    i, j, k = (np.array([t[a] for t in terms]) for a in (1, 2, 3))
    x, y, z = value[0][:, i], value[1][:, j], value[2][:, k]
    gradient = np.stack(
        [slope[0][:, i] * y * z, x * slope[1][:, j] * z, x * y * slope[2][:, k]], -1
    )
    return x * y * z, gradient


def modes(
    rule: Rule,
    scale: Sequence[float],
    material: Mapping[str, Any],
    parity: Sequence[Sequence[int]],
    degree: Sequence[int],
) -> Modes:
    """Vibrations of one symmetry class of a free body of one isotropic material.

    Args:
        rule: Points and weights of integration over the body.
        scale: Half edges or radius on each axis [m].
        material: ``young_modulus``, ``poisson_ratio``, ``density``.
        parity: For each component of the displacement whether it is even (0) or odd (1) on each
            axis, 3 x 3.
        degree: Highest degree on each axis; the sum of degrees over these is at most one.
    """
    points, weights = rule
    terms = [
        (component, i, j, k)
        for component in range(3)
        for i, j, k in itertools.product(*(range(d + 1) for d in degree))
        if (i % 2, j % 2, k % 2) == tuple(parity[component])
        and i / degree[0] + j / degree[1] + k / degree[2] <= 1.0 + 1e-9
    ]
    values, slopes = _basis(points, terms, scale)
    part = np.array([t[0] for t in terms])
    young, nu = float(material["young_modulus"]), float(material["poisson_ratio"])
    mu, lam = young / (2.0 * (1.0 + nu)), young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    same = part[:, None] == part[None, :]
    mass = np.where(same, (values * weights[:, None]).T @ values, 0.0) * float(material["density"])
    # integrals of d_i phi_a d_j phi_b
    inner = np.einsum("q,qai,qbj->abij", weights, slopes, slopes, optimize=True)
    a, b = np.meshgrid(part, part, indexing="ij")
    rows, columns = np.indices(a.shape)
    stiff = lam * inner[rows, columns, a, b] + mu * inner[rows, columns, b, a]
    stiff += np.where(same, mu * np.einsum("abii->ab", inner), 0.0)
    lower = np.linalg.cholesky(mass)
    half = np.linalg.solve(lower, stiff)
    squares, vectors = np.linalg.eigh(0.5 * (s := np.linalg.solve(lower, half.T)) + 0.5 * s.T)
    coefficients = np.linalg.solve(lower.T, vectors)
    omega = np.sqrt(np.clip(squares, 0.0, None))
    return Modes(omega, coefficients, tuple(terms), (scale[0], scale[1], scale[2]))
