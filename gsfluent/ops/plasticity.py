"""Constitutive update of material points: elastic (neo-Hookean) and NACC, on strain e = b - I."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from gsfluent._check import check_tensor
from gsfluent.ops import _plasticity_grad  # noqa: F401  (registers the gradient)
from gsfluent.ops.reference import plasticity as reference

LAW_ELASTIC, LAW_NACC = 0, 1
LAWS = {"elastic": LAW_ELASTIC, "nacc": LAW_NACC}
PARAM_COLUMNS = (
    "mu",
    "kappa",
    "friction",
    "cohesion",
    "hardening",
    "shear_damage",
    "density",
    "reserved",
)

# Tables already read and found right: tensor -> (version, rows it was checked against). Reading a
# table on a GPU waits for the device, so it happens once per table and not once per step.
_checked: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def _is_new(tensor: Tensor, rows: int) -> bool:
    if tensor.is_inference():  # carries no version counter
        return True
    state = (tensor._version, rows)
    if _checked.get(tensor) == state:
        return False
    _checked[tensor] = state
    return True


def _check_values(op: str, law: Tensor, params: Tensor, material: Tensor | None) -> None:
    rows = int(law.shape[0])
    if law.numel() and _is_new(law, rows):
        known = torch.zeros_like(law, dtype=torch.bool)
        for value in LAWS.values():
            known |= law == value
        if not bool(known.all()):
            _checked.pop(law, None)
            names = ", ".join(f"{v} ({k})" for k, v in LAWS.items())
            raise ValueError(
                f"{op}: law must be one of {names}, got {int(law[~known][0])}; "
                "other laws are not built yet"
            )
    if params.numel() and _is_new(params, rows):
        used = params.detach()[:, :6]  # checking is not part of any graph
        wrong = ~torch.isfinite(used) | (used < 0)
        wrong[:, 1] |= used[:, 1] == 0  # without bulk stiffness there is no pressure
        if bool(wrong.any()):
            _checked.pop(params, None)
            row, column = (int(i) for i in wrong.nonzero()[0])
            need = "positive and finite" if column == 1 else "finite and not negative"
            raise ValueError(
                f"{op}: params[{row}] {PARAM_COLUMNS[column]} must be {need}, "
                f"got {float(params[row, column]):g}"
            )
    if material is not None and material.numel() and _is_new(material, rows):
        low, high = (int(v) for v in torch.aminmax(material))
        if low < 0 or high >= rows:
            _checked.pop(material, None)
            raise ValueError(
                f"{op}: material must hold rows 0 to {rows - 1} of params, got {low} to {high}"
            )


def _check_material(
    op: str, count: int, like: Tensor, law: Tensor, params: Tensor, material: Tensor | None
) -> None:
    check_tensor(op, "law", law, shape=("M",), dtype=torch.int32, like=like)
    rows = law.shape[0]
    check_tensor(op, "params", params, shape=(rows, len(PARAM_COLUMNS)), like=like)
    if material is not None:
        check_tensor(op, "material", material, shape=(count,), dtype=torch.int32, like=like)
    elif rows not in (1, count):
        raise ValueError(
            f"{op}: params must have 1 or N = {count} rows when material is not given, got {rows}"
        )
    if not torch.compiler.is_compiling():
        _check_values(op, law, params, material)


def return_mapping(
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    *,
    law: Tensor,
    params: Tensor,
    material: Tensor | None = None,
    k: float = 2.0,
    epsilon: float = 0.1,
    implicit: bool = True,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Advance elastic strain by one step and return it to the yield surface.

    The trial strain ``e + A + A^T + A A^T + A e + e A^T + A e A^T`` (b pushed forward by I + A) is
    kept if elastic; under NACC it is projected to the surface
    ``q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0``,
    ``p0 = kappa (1e-5 + sinh(xi max(-alpha, 0)))``, along the line to the dynamic centre, and alpha
    follows. The stored energy never increases. See docs/return-mapping.md.

    Args:
        strain: Elastic strain e = b - I of every particle, order xx, yy, zz, xy, xz, yz, [N, 6].
        alpha: Log plastic volume ratio, [N]; negative is intact, >= 0 fully softened.
        increment: A = dt grad v, [N, 3, 3].
        law: int32 [M], 0 elastic (neo-Hookean of Borden), 1 nacc.
        params: [M, 8]: shear modulus mu [Pa], bulk modulus kappa [Pa], friction M, cohesion beta,
            hardening xi, shear damage eta, density (not used here), reserved.
        material: int32 [N], row of ``law`` and ``params`` per particle. None: row 0 for all if
            M = 1, row i for particle i if M = N.
        k: Exponent of the dynamic centre; 2 is GaussianFluent's, infinity the fixed centre of
            CD-MPM.
        epsilon: Lipschitz regularisation of the dynamic centre, 0 (the paper's) to below 1.
        implicit: Solve alpha together with the surface it moves, so that the result lies on the
            *updated* surface; False takes the surface of the old alpha.

    Returns:
        ``(strain, alpha, stress, info)``: the new strain [N, 6] and alpha [N], the Kirchhoff stress
        [Pa] [N, 6], and int32 [4] counts of plastic, guarded (volume ratio outside [0.05, 20] or
        stretch beyond about 10: pulled back), inverted (det(I + A) <= 0) and invalid (non-finite,
        reset to rest) particles.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device, law, parameter or material row is wrong, k < 0, or epsilon is
            outside [0, 1). Table contents are read once per table (again after in-place changes).

    Gradient: with respect to strain, alpha, increment and params; in closed form where the map is
    elastic, by the differentiable reference elsewhere. Not differentiable at the kinks of the map.
    Source: Wolper et al. 2019 (NACC); GaussianFluent, Eq. 6 (dynamic centre, epsilon = 0).
    """
    op = "return_mapping"
    check_tensor(op, "strain", strain, shape=("N", 6))
    count = strain.shape[0]
    check_tensor(op, "alpha", alpha, shape=(count,), like=strain)
    check_tensor(op, "increment", increment, shape=(count, 3, 3), like=strain)
    _check_material(op, count, strain, law, params, material)
    if not (k >= 0.0):
        raise ValueError(f"{op}: k must not be negative, got {k}")
    if not (0.0 <= epsilon < 1.0):
        raise ValueError(f"{op}: epsilon must be in [0, 1), got {epsilon}")
    wants_gradient = any(t.requires_grad for t in (strain, alpha, increment, params))
    if math.isinf(k) and wants_gradient and torch.is_grad_enabled():
        raise NotImplementedError(f"{op}: no gradient for the fixed centre (k = infinity)")
    result = torch.ops.gsfluent.return_mapping.default(
        strain, alpha, increment, law, params, material, float(k), float(epsilon), bool(implicit)
    )
    return result[0], result[1], result[2], result[3]


@torch.library.register_fake("gsfluent::return_mapping")
def _return_mapping_fake(
    strain: Tensor,
    alpha: Tensor,
    increment: Tensor,
    law: Tensor,
    params: Tensor,
    material: Tensor | None,
    k: float,
    epsilon: float,
    implicit: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    n = strain.shape[0]
    return (
        strain.new_empty((n, 6)),
        strain.new_empty((n,)),
        strain.new_empty((n, 6)),
        strain.new_empty((4,), dtype=torch.int32),
    )


def elastic_energy(
    strain: Tensor, *, law: Tensor, params: Tensor, material: Tensor | None = None
) -> Tensor:
    """Stored elastic energy per initial volume.

    ``mu/2 (J^(-2/3) tr b - 3) + kappa/2 ((J^2 - 1)/2 - ln J)`` with b = I + e, evaluated in float64
    (both laws store energy the same way).

    Args:
        strain: Elastic strain e = b - I, [N, 6].
        law: int32 [M], see :func:`return_mapping`.
        params: [M, 8], see :func:`return_mapping`.
        material: int32 [N] or None, see :func:`return_mapping`.

    Returns:
        Energy density [J/m^3], [N], in the dtype of ``strain``.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device, law, parameter or material row is wrong.

    Gradient: with respect to strain and params (plain PyTorch).
    """
    check_tensor("elastic_energy", "strain", strain, shape=("N", 6))
    count = strain.shape[0]
    _check_material("elastic_energy", count, strain, law, params, material)
    columns = reference.gather_material(params.double(), material, count)
    return reference.elastic_energy(strain.double(), columns).to(strain.dtype)
