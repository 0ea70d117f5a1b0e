"""Constitutive update of material points, by their laws, on strain e = b - I."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from gsfluent._check import check_tensor
from gsfluent.materials.laws import LAWS, unstable
from gsfluent.materials.phase_field import MODELS, SPLITS
from gsfluent.ops import _plasticity_grad  # noqa: F401  (registers the gradient)
from gsfluent.ops._register import fakes, no_gradient
from gsfluent.ops.reference import phase_field as phase_reference
from gsfluent.ops.reference import plasticity as reference

WEAKENING = 0.02
"""Range of alpha past zero over which a broken point (NACC) loses its cohesion (``kWeakening``)."""

INSTANT = 1e-9
"""Step [s] of the stress that points begin with: what flows with a viscosity has not flown yet."""

PHASE_CODES = [float(split + model) for split in SPLITS.values() for model in MODELS.values()]
"""What column 5 of a phase_field row may hold."""

PARAM_COLUMNS = (
    "mu",
    "kappa",
    "strength",
    "cohesion",
    "hardening",
    "shear_damage",
    "density",
    "exponent",
)

# Tables already read and found right: tensor -> (version, rows it was checked against). Reading a
# table on a GPU waits for the device, so it happens once per table and not once per step.
_checked: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
_table_facts: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


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
        known = torch.isin(law, law.new_tensor(list(LAWS.values())))
        if not bool(known.all()):
            _checked.pop(law, None)
            names = ", ".join(f"{v} ({k})" for k, v in LAWS.items())
            raise ValueError(f"{op}: law must be one of {names}, got {int(law[~known][0])}")
    if params.numel() and _is_new(params, rows):
        given, params = params, params.detach()  # checking is not part of any graph
        negative = params < 0
        negative[:, 4] &= law != LAWS["von_mises"]
        negative[:, 2] &= law != LAWS["yeoh"]
        negative[:, 2:] &= (law != LAWS["ogden"])[:, None]
        negative[:, 5] &= law != LAWS["nacc"]  # Rankine's surface
        negative[:, 6] = params[:, 6] < 0
        wrong = ~torch.isfinite(params) | negative
        # Without bulk stiffness there is no pressure; a rigid body needs none.
        wrong[:, 1] |= (params[:, 1] == 0) & (law != LAWS["rigid"])
        fluid, nacc = law == LAWS["fluid"], law == LAWS["nacc"]
        phase = law == LAWS["phase_field"]
        wrong[:, 7] |= fluid & (params[:, 7] > 0) & (params[:, 7] < 1)  # energy needs gamma >= 1
        wrong[:, 7] |= (nacc | phase) & (params[:, 7] > 2)  # a loss
        wrong[:, 2] |= phase & (params[:, 2] == 0)
        wrong[:, 3] |= phase & (params[:, 3] > 1)
        wrong[:, 4] |= phase & (params[:, 4] == 0)
        wrong[:, 5] |= phase & ~torch.isin(params[:, 5], params.new_tensor(PHASE_CODES))
        if bool(wrong.any()):
            _checked.pop(given, None)
            row, column = (int(i) for i in wrong.nonzero()[0])
            need = {
                1: "positive and finite",
                7: "0 or at least 1 (fluid), 0 to 2 (nacc, phase_field)",
            }
            if bool(phase[row]):
                need |= {
                    2: "positive (threshold of psi+)",
                    3: "0 to 1 (damage)",
                    4: "positive (length)",
                    5: f"one of {PHASE_CODES} (split and model)",
                }
            raise ValueError(
                f"{op}: params[{row}] {PARAM_COLUMNS[column]} must be "
                f"{need.get(column, 'finite and not negative')}, got {float(params[row, column]):g}"
            )
        apart = compiled_apart(law, params)
        if bool(apart.any()):
            try:
                _check_apart(op, law[apart], params[apart])
            except ValueError:
                _checked.pop(given, None)
                raise
    if material is not None and material.numel() and _is_new(material, rows):
        low, high = (int(v) for v in torch.aminmax(material))
        if low < 0 or high >= rows:
            _checked.pop(material, None)
            raise ValueError(
                f"{op}: material must hold rows 0 to {rows - 1} of params, got {low} to {high}"
            )


def compiled_apart(law: Tensor, params: Tensor) -> Tensor:
    """Rows whose law is in csrc/core/material/more_laws.h, bool [M].

    Args:
        law: int32 [M].
        params: [M, 8].
    """
    flows = (params[:, 4] < 0) | (params[:, 5] > 0) | (params[:, 7] > 0)
    flows = (law == LAWS["von_mises"]) & flows
    return flows | (law == LAWS["yeoh"]) | (law == LAWS["ogden"])


def _check_apart(op: str, law: Tensor, params: Tensor) -> None:
    for name in ("von_mises", "yeoh", "ogden"):
        rows = law == LAWS[name]
        if not bool(rows.any()):
            continue
        wrong = unstable(name, params[rows])
        if wrong:
            raise ValueError(f"{op}: {wrong}")


def _facts(law: Tensor, params: Tensor) -> tuple[bool, bool]:
    """Whether a row has a viscosity, and whether one's law is compiled apart.

    Reads the tables when they are new.
    """
    versions = None
    if not (law.is_inference() or params.is_inference()):
        versions = (params._version, law.data_ptr(), law._version)
        known = _table_facts.get(params)
        if known is not None and known[0] == versions:
            return known[1]
    flows = (law == LAWS["fluid"]) & (params[:, 2] > 0)
    thick = (law == LAWS["von_mises"]) & (params[:, 5] > 0) & (params[:, 7] == 0)
    rows = torch.stack([flows | thick, compiled_apart(law, params)])
    viscous, apart = rows.any(dim=1).tolist()
    if versions is not None:
        _table_facts[params] = (versions, (viscous, apart))
    return viscous, apart


def check_params(op: str, law: Tensor, params: Tensor) -> None:
    """Refuse laws and parameters that are none.

    Raises:
        ValueError: An unknown law, or a parameter out of its range.
    """
    _check_values(op, law, params, None)


SLOW_UNLOADING = 60.0
"""Cells that a wave crosses while slow unloading begins to lose (``kSlowUnloading``)."""


def unloading_share(
    stress: Tensor, affine: Tensor, *, law: Tensor, params: Tensor, material: Tensor, dx: float
) -> Tensor:
    """Share of the stress of points that acts while they give back what they stored, [N].

    What ``csrc/core/material/loss.h`` does in the resident solver, for the composed operators.

    Args:
        stress: Kirchhoff stress [Pa], [N, 6].
        affine: Velocity gradient [1/s], [N, 3, 3].
        law: Law of each row, int32 [M].
        params: Parameters of each row, [M, 8]; column 7 of NACC and phase field is the loss,
            1 - e^2, and one more where it acts in tension too.
        material: Row of each point, int32 [N].
        dx: Node spacing [m].
    """
    row = material.long()
    loses = (law == LAWS["nacc"]) | (law == LAWS["phase_field"])
    loss = torch.where(loses, params[:, 7], 0.0)[row]
    modulus = params[:, 1] + 4.0 / 3.0 * params[:, 0]
    pace = (SLOW_UNLOADING * dx * (params[:, 6] * modulus).sqrt())[row]
    xx, yy, zz, xy, xz, yz = stress.unbind(dim=1)
    size = xx**2 + yy**2 + zz**2 + 2.0 * (xy**2 + xz**2 + yz**2) + 1e-30
    rate = affine + affine.transpose(1, 2)
    power = 0.5 * (xx * rate[:, 0, 0] + yy * rate[:, 1, 1] + zz * rate[:, 2, 2])
    power = power + xy * rate[:, 0, 1] + xz * rate[:, 0, 2] + yz * rate[:, 1, 2]
    anyhow = (loss > 1.0).to(loss.dtype)
    pressed = (-(xx + yy + zz) / size.sqrt()).clamp(0.0, 1.0).maximum(anyhow)
    return 1.0 - (loss - anyhow) * pressed * (-pace * power / size).clamp(0.0, 1.0)


def weakened(law: Tensor, params: Tensor, material: Tensor, peak: Tensor) -> tuple[Tensor, Tensor]:
    """Law and parameters of each point, of broken ones with the cohesion they have left.

    Phase-field points get their damage.

    Args:
        law: Law of each row, int32 [M].
        params: Parameters of each row, [M, 8].
        material: Row of each point, int32 [N].
        peak: Largest alpha each point ever had, [N]; of phase-field points d - 0.95.

    Returns:
        Law, int32 [N], and parameters, [N, 8]; for :func:`return_mapping` without ``material``.
    """
    row = material.long()
    law, params = law[row], params[row]
    left = params[:, 3] * (1.0 - (peak / WEAKENING).clamp(0.0, 1.0))
    params[:, 3] = torch.where(law == LAWS["nacc"], left, params[:, 3])
    damage = (peak + phase_reference.BROKEN).clamp(0.0, 1.0)
    params[:, 3] = torch.where(law == LAWS["phase_field"], damage, params[:, 3])
    return law, params


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
    dt: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Advance elastic strain by one step and return it to the yield surface.

    The trial strain ``e + A + A^T + A A^T + A e + e A^T + A e A^T`` (b pushed forward by I + A) is
    kept bit for bit if elastic and otherwise returned to the yield surface of its law:

    * 0 ``elastic``: neo-Hookean (Borden); 6 ``corotated``: fixed corotated. Never yield.
    * 1 ``nacc``: ``q^2 (1 + 2 beta) + M^2 (p + beta p0)(p - p0) = 0``,
      ``p0 = kappa (1e-5 + sinh(xi max(-alpha, 0)))``, along the line to the dynamic centre. With
      ``-c`` for a shear damage Rankine's surface: principal stresses up to
      ``f = beta kappa sinh(xi max(-alpha, 0))``, alpha by what opens, ``q <= max(c f, M p)``.
    * 2 ``drucker_prager``: Hencky elasticity, ``|dev tau| <= 3 alpha_DP (p + c)``, no tension
      beyond ``p = -c``, with volume correction.
    * 3 ``von_mises``: Hencky elasticity, ``|dev tau| <= sqrt(2/3) (sigma_y + H alpha)``; with a
      plastic viscosity what is beyond flows back at a rate; with an exponent n the surface is
      ``sqrt(2/3) (sigma_y + H alpha^n) (1 + C ln rate) exp(-W / Q)`` (Johnson and Cook).
    * 4 ``fluid``: ``p = max(K/gamma (J^-gamma - 1), 0)`` and Newtonian viscosity; the strain is
      ``(J^(2/3) - 1) I`` and J follows ``det(I + A)``.
    * 9 ``phase_field``: neo-Hookean with psi+ degraded by the damage d of column 3,
      ``g = (1 - k)(1 - d)^2 + k``; alpha is the history, max psi+ / psi_t - 1
      (docs/theory/phase-field.md). The damage is a field: :func:`gsfluent.ops.damage_solve`.
    * 5 ``rigid``: no strain, no stress; how the body moves is the solver's matter.
    * 7 ``yeoh``, 8 ``ogden``: rubber that stiffens. Never yield.

    The stored energy never increases. See docs/theory/return-mapping.md and docs/theory/laws.md.

    Args:
        strain: Elastic strain e = b - I of every particle, order xx, yy, zz, xy, xz, yz, [N, 6].
        alpha: State of the law, [N]. nacc: log plastic volume ratio, negative is intact, >= 0 fully
            softened. drucker_prager: log volume opened in tension, 0 to 0.5. von_mises: accumulated
            plastic strain. phase_field: largest psi+ so far over its threshold, less one; -1 for
            none. Others: not used, kept.
        increment: A = dt grad v, [N, 3, 3].
        law: int32 [M], number of the law, see above and :data:`LAWS`.
        params: [M, 8]: shear modulus mu [Pa]; bulk modulus kappa [Pa]; strength (nacc: friction M,
            drucker_prager: alpha_DP, von_mises: yield stress sigma_y [Pa], fluid: viscosity
            [Pa s]); cohesion (nacc: beta, drucker_prager: tensile pressure c [Pa]); hardening
            (nacc: xi, von_mises: modulus H [Pa]); shear damage (nacc: eta, or below zero -c of
            Rankine's surface; von_mises: plastic viscosity [Pa s]); density [kg/m^3], not used
            here; exponent (fluid: gamma, 0 means 7; von_mises: n of Johnson and Cook, whose rate
            factor C is then column 3 and whose heat Q [J/m^3] is column 5).
            yeoh: C20 and C30 [Pa] in columns 2 and 3; ogden: alpha_1, mu_2 [Pa], alpha_2, mu_3
            [Pa] in columns 2 to 5, alpha_3 in column 7. phase_field: columns 2 to 5 are the
            threshold psi_t [J/m^3], the damage d, the length l [m], and split (0 volumetric, 1
            none, 2 spectral, 3 rankine) plus 4 for AT2.
        material: int32 [N], row of ``law`` and ``params`` per particle. None: row 0 for all if
            M = 1, row i for particle i if M = N.
        k: Exponent of the dynamic centre; 2 is GaussianFluent's, infinity the fixed centre of
            CD-MPM.
        epsilon: Lipschitz regularisation of the dynamic centre, 0 (the paper's) to below 1.
        implicit: Solve alpha together with the surface it moves, so that the result lies on the
            *updated* surface; False takes the surface of the old alpha.
        dt: Time step [s]; only viscosity reads it (grad v = A / dt).

    Returns:
        ``(strain, alpha, stress, info)``: the new strain [N, 6] and alpha [N], the Kirchhoff stress
        [Pa] [N, 6], and int32 [4] counts of plastic, guarded (volume ratio outside [0.05, 20] or
        stretch beyond about 10, fluid: J below 0.6 or a step beyond a factor 1.25: pulled back),
        inverted (det(I + A) <= 0) and invalid (non-finite, reset to rest) particles.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device, law, parameter or material row is wrong, k < 0, epsilon is
            outside [0, 1), dt is negative, or a viscous fluid comes without dt. Table contents are
            read once per table (again after in-place changes).

    Gradient: with respect to strain, alpha, increment and params; in closed form where the map is
    elastic, by the differentiable reference elsewhere. Not differentiable at the kinks of the map.
    Source: Wolper et al. 2019 (NACC); GaussianFluent, Eq. 6 (dynamic centre, epsilon = 0); Klar et
    al. 2016 and Tampubolon et al. 2017 (sand); Simo and Hughes 1998, box 3.1 (metal); Tait's
    equation after Monaghan 1994 (fluid); Stomakhin et al. 2012 (fixed corotated); Yeoh 1993, Ogden
    1972 (rubber); Li et al. 2023, PAC-NeRF (plastic viscosity); Amor et al. 2009 and Miehe et al.
    2010 (phase field).
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
    if not (0.0 <= dt < math.inf):
        raise ValueError(f"{op}: dt must be finite and not negative, got {dt}")
    viscous, apart = (False, True) if torch.compiler.is_compiling() else _facts(law, params)
    if dt == 0.0 and viscous:
        raise ValueError(f"{op}: matter with viscosity needs dt, the time step in seconds")
    wants_gradient = any(t.requires_grad for t in (strain, alpha, increment, params))
    if math.isinf(k) and wants_gradient and torch.is_grad_enabled():
        raise NotImplementedError(f"{op}: no gradient for the fixed centre (k = infinity)")
    result = torch.ops.gsfluent.return_mapping.default(
        strain,
        alpha,
        increment,
        law,
        params,
        material,
        float(k),
        float(epsilon),
        bool(implicit),
        float(dt),
        apart,
    )
    return result[0], result[1], result[2], result[3]


def softening_paths(
    params: Tensor, alpha: Tensor, stretch: Tensor, *, steps: int
) -> tuple[Tensor, Tensor]:
    """Work of uniaxial straining until the strength of NACC points is gone.

    Paths of ``steps`` equal steps of :func:`return_mapping` up to ``exp(stretch)`` along x, the
    other directions held, each summed by the trapezium rule: ``sum of (tau_0 + tau_1) / 2 dln l``.

    Args:
        params: NACC rows of :func:`return_mapping`, float64 [M, 8], on the CPU.
        alpha: Where each begins, float64 [M].
        stretch: Logarithm of the stretch at the end, float64 [M].
        steps: Steps, at least 1.

    Returns:
        ``(work, strain)``: [J/m^3], float64 [M], NaN where strength is left at the end; and the
        elastic strain at which it went, float64 [M, 6], 0 where it did not.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device or parameter is wrong, or ``steps``.

    Gradient: none.
    """
    op = "softening_paths"
    check_tensor(op, "params", params, shape=("M", len(PARAM_COLUMNS)), dtype=torch.float64)
    for name, value in (("alpha", alpha), ("stretch", stretch)):
        check_tensor(op, name, value, shape=(len(params),), dtype=torch.float64, like=params)
    if params.device.type != "cpu":
        raise ValueError(f"{op}: params must lie on the CPU, got {params.device}")
    if steps < 1:
        raise ValueError(f"{op}: steps must be at least 1, got {steps}")
    check_params(op, params.new_full((len(params),), LAWS["nacc"], dtype=torch.int32), params)
    found: tuple[Tensor, Tensor] = torch.ops.gsfluent.softening_paths.default(
        params, alpha, stretch, torch.expm1(stretch / steps), steps
    )
    return found


fakes(
    softening_paths=lambda params, alpha, stretch, first, steps: (
        params.new_empty(alpha.shape),
        params.new_empty((len(alpha), 6)),
    ),
    return_mapping=lambda strain, alpha, *rest: (
        strain.new_empty(strain.shape),
        strain.new_empty(alpha.shape),
        strain.new_empty(strain.shape),
        strain.new_empty((4,), dtype=torch.int32),
    ),
    neo_hookean_energy=lambda strain, params, material: strain.new_empty(strain.shape[:1]),
)
no_gradient("softening_paths: no gradient", "softening_paths")
_NEO_HOOKEAN = {LAWS["elastic"], LAWS["nacc"]}


def elastic_energy(
    strain: Tensor, *, law: Tensor, params: Tensor, material: Tensor | None = None
) -> Tensor:
    """Stored elastic energy per initial volume.

    Evaluated in float64. With b = I + e = V V: elastic and nacc
    ``mu/2 (J^(-2/3) tr b - 3) + kappa/2 ((J^2 - 1)/2 - ln J)``; drucker_prager and von_mises
    ``mu |dev ln V|^2 + kappa/2 (ln J)^2``; corotated ``mu |V - I|^2 + lambda/2 (J - 1)^2``; fluid
    ``K/gamma (J^(1-gamma)/(gamma-1) + J - gamma/(gamma-1))`` below J = 1 and 0 above; rigid 0;
    yeoh ``mu/2 x + C20 x^2 + C30 x^3``, ``x = J^(-2/3) tr b - 3``, and ogden ``sum of mu_p/alpha_p
    tr(V^alpha_p - I)`` of the isochoric V, both with the volumetric part of elastic.

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

    Gradient: with respect to strain and params (plain PyTorch); without one the laws elastic and
    nacc are compiled.
    """
    check_tensor("elastic_energy", "strain", strain, shape=("N", 6))
    count = strain.shape[0]
    _check_material("elastic_energy", count, strain, law, params, material)
    fine, table = strain.double(), params.double()
    gradient = torch.is_grad_enabled() and (strain.requires_grad or params.requires_grad)
    if not gradient:
        energy = torch.ops.gsfluent.neo_hookean_energy.default(fine, table, material)
        if set(law.tolist()) <= _NEO_HOOKEAN:
            return energy.to(strain.dtype)
    columns = reference.gather_material(table, material, count)
    if gradient:
        energy = reference.neo_hookean_energy(fine, columns)
    laws = law[material.long()] if material is not None else law.expand(count)
    return reference.of_other_laws(energy, fine, columns, laws).to(strain.dtype)


def wave_speed(
    strain: Tensor, *, law: Tensor, params: Tensor, material: Tensor | None = None
) -> Tensor:
    """Speed of the fastest small wave in the present state: what bounds an explicit time step.

    Args:
        strain: Elastic strain e = b - I, [N, 6].
        law: int32 [M], see :func:`return_mapping`.
        params: [M, 8], see :func:`return_mapping`; density must be positive.
        material: int32 [N] or None, see :func:`return_mapping`.

    Returns:
        Wave speed [m/s], [N]: exact at rest, an upper bound (by a few percent at moderate strain)
        of the speed along any direction elsewhere; 0 for rigid particles and lost states.

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape, device, law, parameter or material row is wrong.

    Gradient: with respect to strain and params (plain PyTorch).
    Source: csrc/core/material/wave_speed.h, which the solver's kernels use.
    """
    check_tensor("wave_speed", "strain", strain, shape=("N", 6))
    count = strain.shape[0]
    _check_material("wave_speed", count, strain, law, params, material)
    columns = reference.gather_material(params, material, count)
    laws = law[material.long()] if material is not None else law.expand(count)
    return reference.wave_speed_squared(strain, columns, laws).sqrt()
