"""What a solid, powder or liquid is made of."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.materials import laws
from gsfluent.materials.laws import DEFAULTS, LAWS, PARAMETERS, POSITIVE, RANGES, READS

Field = float | Tensor
"""A parameter: one number, or a grid of numbers over the solid's voxels (shape [X, Y, Z])."""

SCATTER: dict[str, tuple[float, float, str]] = {
    "variation": (0.0, 1.0, "no unit"),
    "grain": (0.0, math.inf, "m"),
}
LOOKS: dict[str, tuple[float, float, str]] = {
    "specular": (0.0, 10.0, "no unit"),
    "shininess": (1.0, 10_000.0, "no unit"),
}
"""What only a picture needs: range and unit. No part of a simulation."""
UNBROKEN = -1.0
"""``alpha`` of the points of laws that do not use it: below zero, so never counted as broken."""


@dataclasses.dataclass(frozen=True)
class Material:
    """What a body is made of.

    A parameter that the law does not read must not be given; one that it reads may be left out
    where :data:`gsfluent.materials.laws.DEFAULTS` has a value, and then holds that value.

    Args:
        name: Name of the preset or of the user's own material.
        young_modulus: Stiffness E [Pa].
        poisson_ratio: Lateral contraction nu, in (-1, 0.495].
        density: Mass per volume [kg/m^3].
        law: ``elastic`` (neo-Hookean) and ``corotated`` (fixed corotated) never break, ``nacc``
            breaks, ``drucker_prager`` is sand, ``von_mises`` is metal or clay, ``fluid`` pours,
            ``rigid`` does not deform.
        cohesion: nacc: tensile over compressive strength, beta in CD-MPM.
        hardening: nacc: how fast strength grows with compaction, xi in CD-MPM.
        friction_angle: nacc, drucker_prager: internal friction [degrees].
        alpha0: nacc: log plastic volume ratio at the start; negative is intact.
        shear_damage: nacc: how much plastic shear counts as damage, eta; 0 is the plain model.
        yield_stress: von_mises: stress [Pa] in a tension test at which flow begins.
        hardening_modulus: von_mises: growth of the yield stress per plastic strain [Pa].
        cohesion_pressure: drucker_prager: tensile pressure [Pa] that the grains hold; 0 is dry.
        bulk_modulus: fluid: density times the square of its speed of sound [Pa].
        viscosity: fluid: dynamic viscosity [Pa s].
        tait_exponent: fluid: gamma of p = K/gamma (J^-gamma - 1).
        variation: nacc: relative scatter of strength in space (standard deviation of a smooth
            random factor on ``alpha0``); natural solids have weak and strong places, and that
            decides where cracks run and how many pieces survive a harder landing.
        grain: Length over which the strength varies [m].
        specular: Strength of its highlights, k_s of Blinn-Phong.
        shininess: Narrowness of its highlights, n_s of Blinn-Phong.
        parts: Default parts (for :meth:`gsfluent.Scene.add`), e.g. the rind of a melon.
        sources: Field name -> where the number is from. A field that is not named was chosen by
            eye.

    Raises:
        InputError: An unknown law, a number outside its range, a parameter that the law needs and
            does not get, or one that it does not read.
    """

    name: str
    young_modulus: Field | None = None
    poisson_ratio: Field | None = None
    density: Field | None = None
    law: str = "nacc"
    cohesion: Field | None = None
    hardening: Field | None = None
    friction_angle: Field | None = None
    alpha0: Field | None = None
    shear_damage: Field | None = None
    yield_stress: Field | None = None
    hardening_modulus: Field | None = None
    cohesion_pressure: Field | None = None
    bulk_modulus: Field | None = None
    viscosity: Field | None = None
    tait_exponent: Field | None = None
    variation: float = 0.0
    grain: float = 0.025
    # not in the repr, from which a simulation is known again
    specular: float = dataclasses.field(default=0.03, repr=False)
    shininess: float = dataclasses.field(default=24.0, repr=False)
    parts: tuple[Mapping[str, Any], ...] = ()
    sources: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in defaults; check the law and every number."""
        if self.law not in LAWS:
            raise InputError(
                f"material {self.name!r}: unknown law {self.law!r}", hint=nearest(self.law, LAWS)
            )
        reads, defaults = READS[self.law], DEFAULTS.get(self.law, {})
        for field, (low, high, unit) in RANGES.items():
            value = getattr(self, field)
            if value is not None and field not in reads:
                raise InputError(
                    f"material {self.name!r}: {field} does nothing under law {self.law!r}",
                    hint=f"remove it, or use law {_readers(field)}",
                )
            if value is None and field in defaults:
                object.__setattr__(self, field, defaults[field])
            elif value is None and field in reads:
                raise InputError(
                    f"material {self.name!r}: law {self.law!r} needs {field}", hint=f"give {unit}"
                )
            if value is not None:
                _check_number(self.name, field, value, low, high, unit)
        for field, (low, high, unit) in (SCATTER | LOOKS).items():
            value = getattr(self, field)
            if isinstance(value, Tensor):
                raise InputError(f"material {self.name!r}: {field} must be one number")
            _check_number(self.name, field, value, low, high, unit)
        if self.variation > 0.0 and self.law != "nacc":
            raise InputError(
                f"material {self.name!r}: variation does nothing under law {self.law!r}",
                hint="remove it, or use law nacc",
            )
        object.__setattr__(self, "sources", MappingProxyType(dict(self.sources)))

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the parameters that the law reads."""
        return READS[self.law]

    def override(self, **changes: Any) -> Material:
        """Return a copy with fields changed; an unknown one is an error naming the nearest.

        A change of law drops the parameters of this material that the new law does not read.

        Raises:
            InputError: An unknown field, a number outside its range, a parameter the law does not
                read, or one that it needs and this material does not have.
        """
        known = [*PARAMETERS, *SCATTER, *LOOKS, "law", "name", "parts"]
        for key in changes:
            if key not in known:
                raise InputError(
                    f"material {self.name!r}: unknown parameter {key!r}", hint=nearest(key, known)
                )
        law = changes.get("law", self.law)
        if law != self.law and law in LAWS:
            dropped = [f for f in PARAMETERS if f not in READS[law] and f not in changes]
            changes = {**dict.fromkeys(dropped), **changes}
            if law != "nacc":
                changes = {"variation": 0.0, "parts": (), **changes}
        sources = {k: v for k, v in self.sources.items() if k not in changes}
        return dataclasses.replace(self, sources=sources, **changes)

    def source(self, field: str) -> str:
        """Say where a number is from: ``measured: ...``, ``derived: ...`` or ``chosen by eye``."""
        if field not in (*PARAMETERS, *SCATTER, *LOOKS):
            raise InputError(
                f"material {self.name!r}: unknown parameter {field!r}",
                hint=nearest(field, PARAMETERS),
            )
        return self.sources.get(field, "chosen by eye")

    @property
    def wave_speed(self) -> float:
        """Fastest wave at rest, sqrt((kappa + 4 mu / 3) / density) [m/s]; 0 when rigid."""
        row = self.parameters()
        return float(torch.sqrt((row[..., 1] + 4.0 / 3.0 * row[..., 0]) / row[..., 6]).max())

    @property
    def failure_strain(self) -> float:
        """Smallest volumetric strain at which tension breaks it; infinite when it never breaks."""
        if self.law != "nacc":
            return math.inf
        alpha, xi, beta = (self._at(f) for f in ("alpha0", "hardening", "cohesion"))
        ratio = torch.sinh((xi * (-alpha).clamp(min=0.0)).clamp(max=5.0)) + 1e-5
        return float((0.5 * torch.log1p(2.0 * beta * ratio.clamp(max=0.495))).min())

    @property
    def breaking_speed(self) -> float:
        """Speed of the slowest strike that starts to break it [m/s]; infinite when none does.

        ``wave_speed * failure_strain``: a strike at v strains what it meets by v / c in one
        dimension (docs/theory/fracture.md): right to an order of magnitude, since an edge or a
        corner gathers strain and a soft thing spreads it.
        """
        return self.wave_speed * self.failure_strain if self.law == "nacc" else math.inf

    @property
    def start_alpha(self) -> Field:
        """State ``alpha`` of a fresh point: ``alpha0`` for nacc, else 0 or, unused, -1."""
        if self.law == "nacc" and self.alpha0 is not None:
            return self.alpha0
        return 0.0 if self.law in ("drucker_prager", "von_mises") else UNBROKEN

    def parameters(self, sample: Callable[[Field], Tensor] | None = None) -> Tensor:
        """Return rows for :func:`gsfluent.ops.return_mapping`, [8] or [..., 8], float64.

        Args:
            sample: Turns a parameter into its values at chosen points; default: the parameter as
                it is.
        """
        return laws.row(self.law, lambda field: self._at(field, sample))

    def _at(self, field: str, sample: Callable[[Field], Tensor] | None = None) -> Tensor:
        return (sample or _tensor)(getattr(self, field))


def _readers(field: str) -> str:
    return " or ".join(law for law, reads in READS.items() if field in reads)


def _tensor(value: Field) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).cpu()


def _check_number(name: str, field: str, value: Any, low: float, high: float, unit: str) -> None:
    """Refuse a parameter that is not a finite number (or grid of numbers) in its range."""
    where = f"material {name!r}: {field}"
    if isinstance(value, bool) or not isinstance(value, int | float | Tensor):
        raise InputError(
            f"{where} must be a number or a tensor, got {type(value).__name__}", hint=f"give {unit}"
        )
    data = _tensor(value)
    if data.ndim not in (0, 3):
        raise InputError(
            f"{where} must be one number or a grid [X, Y, Z] over the solid's voxels, "
            f"got shape {list(data.shape)}",
            hint="sample the field on the solid's occupancy grid",
        )
    inside = torch.isfinite(data) & (data >= low) & (data <= high)
    if field in POSITIVE:
        inside &= data > 0.0
    if not bool(inside.all()):
        worst = float(data[~inside].reshape(-1)[0])
        edge = "above" if field in POSITIVE else "at least"
        raise InputError(
            f"{where} must be {edge} {low:g} and at most {high:g} ({unit}), got {worst:g}",
            hint="mend the number",
        )


def nearest(word: str, known: Any) -> str:
    """Hint with the nearest of the known names, and all of them."""
    close = difflib.get_close_matches(str(word), list(known), n=1, cutoff=0.4)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}known: {', '.join(sorted(known))}"
