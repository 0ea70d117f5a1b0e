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
from gsfluent.materials import laws, phase_field
from gsfluent.materials.laws import (
    BREAKS,
    DEFAULTS,
    DERIVED,
    HANDBOOK,
    LAWS,
    OPTIONAL,
    PARAMETERS,
    POSITIVE,
    RANGES,
    READS,
    WORDS,
)
from gsfluent.materials.strength import LARGEST, STEEPEST, ellipse, opening

Field = float | Tensor
"""A parameter: one number, or a grid of numbers over the solid's voxels (shape [X, Y, Z])."""

SCATTER: dict[str, tuple[float, float, str]] = {
    "variation": (0.0, 1.0, "no unit"),
    "grain": (0.0, math.inf, "m"),
    "weibull_modulus": (0.0, 1e3, "no unit"),
    "reference_volume": (0.0, math.inf, "m^3"),
}
WHOLE: dict[str, tuple[float, float, str]] = {
    "softening": (0.0, 1e9, "no unit"),
    "restitution": (0.0, 1.0, "no unit"),
    "dust": (0.0, 1.0, "no unit"),
}
"""What holds for the whole of a body and is one number: range and unit."""
LOOKS: dict[str, tuple[float, float, str]] = {
    "specular": (0.0, 10.0, "no unit"),
    "shininess": (1.0, 10_000.0, "no unit"),
    "transmission": (0.0, 1.0, "no unit"),
}
"""What only a picture needs: range and unit. No part of a simulation."""
SHEAR = 0.03
"""Shear damage of what is given by strengths: enough that crushed matter loses its tension, too,
and so little that what is pressed hard cracks before it is powder (a plaster ball that falls 0.75 m
is whole, with 0.5 it is crushed)."""
_PLAIN = {"variation": 0.0, "weibull_modulus": 0.0, "prefer": "toughness", "hysteresis": "pressed"}
"""What only brittle matter reads, as it is in other matter."""
_OPENED = (*DERIVED, "shear_damage")
"""What the strengths and the energy fix on Rankine's surface."""
_PLAIN_FIELD = {"split": "volumetric", "model": "at1"}
"""What only phase_field reads."""
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
            and ``phase_field`` break, ``drucker_prager`` is sand, ``von_mises`` is metal or clay,
            ``fluid`` pours, ``rigid`` does not deform, ``yeoh`` and ``ogden`` are rubber that
            stiffens.
        tensile_strength: nacc, phase_field: uniaxial strength of the real thing in tension [Pa].
        compressive_strength: nacc: its uniaxial strength in compression [Pa].
        fracture_energy: nacc: energy that a crack takes per area, G_c [J/m^2]. The three are given
            together or not at all; cohesion, hardening and alpha0 then follow from them and the
            grid (:mod:`gsfluent.pipeline.matter.brittle`), and one of those given by hand takes
            the place of what would follow.
        toughness: phase_field: energy that a crack takes per area, G_c [J/m^2].
        length: phase_field: half of the half width of a crack, l [m]; left out or ``auto`` it is
            what toughness and tensile strength ask for, and at least two cells.
        cohesion: nacc: tensile over compressive strength, beta in CD-MPM.
        hardening: nacc: how fast strength grows with compaction, xi in CD-MPM.
        friction_angle: nacc, drucker_prager: internal friction [degrees].
        alpha0: nacc: log plastic volume ratio at the start; negative is intact.
        shear_damage: nacc: how much plastic shear counts as damage, eta; 0 is the plain model.
        yield_stress: von_mises: stress [Pa] in a tension test at which flow begins.
        hardening_modulus: von_mises: growth of the yield stress per plastic strain [Pa]; below 0
            it falls, to zero at most.
        plastic_viscosity: von_mises: stress beyond yield per rate of flow [Pa s]; 0 flows at once.
        hardening_exponent: von_mises: n of Johnson and Cook's ``yield_stress + hardening_modulus
            strain^n``; 0 is linear hardening.
        rate_sensitivity: von_mises: their C: a flow e times as fast takes so much more stress, as
            a share of that at 1/s.
        melting_heat: von_mises: heat that plastic work would have to give to melt it [J/m^3],
            density times heat capacity times the way to the melting point over 0.9; the yield
            stress falls as its heat grows. 0: it does not.
        cohesion_pressure: drucker_prager: tensile pressure [Pa] that the grains hold; 0 is dry.
        bulk_modulus: fluid: density times the square of its speed of sound [Pa].
        viscosity: fluid: dynamic viscosity [Pa s].
        tait_exponent: fluid: gamma of p = K/gamma (J^-gamma - 1).
        yeoh_c20: yeoh: second coefficient of W [Pa]; the first is half of the shear modulus.
        yeoh_c30: yeoh: third coefficient of W [Pa].
        ogden_alpha1: ogden: exponent of the first term, whose modulus is what the others leave of
            the shear modulus (2 mu is the sum of mu_p alpha_p).
        ogden_mu2: ogden: modulus of the second term [Pa], of W = sum mu_p / alpha_p (...).
        ogden_alpha2: ogden: its exponent.
        ogden_mu3: ogden: modulus of the third term [Pa].
        ogden_alpha3: ogden: its exponent.
        relaxation_share: elastic, nacc: share of the stiffness that relaxes when a strain is held,
            g of a Prony series; what young_modulus says is the stiffness at once.
        relaxation_time: elastic, nacc: time in which that share falls to 1/e [s], of the real
            thing: a softened one takes longer, as its landing does.
        yield_time: nacc: time that a yield takes [s], likewise (Duvaut and Lions): what is strained
            fast holds more, by the stiffness times rate times this.
        variation: nacc, phase_field: relative scatter of strength in space (standard deviation of
            a smooth random factor on it); natural solids have weak and strong places, and that
            decides where cracks run and how many pieces survive a harder landing.
        grain: Length over which the strength varies [m].
        weibull_modulus: nacc, phase_field: Weibull modulus of the strength, small for scattered; 0
            for none.
        reference_volume: Volume of the specimens whose median strength is given [m^3].
        prefer: nacc, phase_field: what a grid keeps that is too coarse for both. ``toughness``
            keeps the fracture energy and lowers the strength (Bazant and Oh 1983), ``strength``
            keeps the strength, and a crack takes more energy than it should.
        surface: nacc: ``cam_clay`` is the ellipse of the papers, which counts volume that has grown
            as damage; ``rankine`` cuts off tension at its strength and counts what has opened, so
            that a crack takes its energy whichever way it is pulled.
        split: phase_field: what drives a crack. ``volumetric``: shear and opening (Amor et al.);
            ``none``: all that is stored, for tension alone; ``spectral``: principal extensions
            (Miehe et al.), for matter in compression; ``rankine``: the largest tensile stress,
            for bodies that fall, which landing must not crush.
        model: phase_field: ``at1`` is elastic up to its strength, ``at2`` softens from the start.
        softening: How many times softer than the real thing ``young_modulus`` is, for the sake of
            the time step. Strengths are divided by its root: the speed at which it breaks and the
            number of pieces stay (Bazant's size number E G_c / s^2 L does not change).
        restitution: Speed after over before of a body that lands on a hard floor and stays whole.
        hysteresis: nacc, phase_field: whether what springs back loses energy where it is
            ``pressed``, as dry matter, or in tension too (``both``), as wet tissue: cracks there
            are fed with less. ``unloading`` (nacc): once per landing, by a spring that is let go
            by what springs back within ``relaxation_time`` (docs/theory/viscous.md).
        dust: How much of a break is dust, 0 to 1; sets the most mass that may come loose.
        specular: Strength of its highlights, k_s of Blinn-Phong.
        shininess: Narrowness of its highlights, n_s of Blinn-Phong.
        transmission: Share of the light that one face lets through where it is seen face on; of a
            liquid, that a centimetre of it does.
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
    tensile_strength: Field | None = None
    compressive_strength: Field | None = None
    fracture_energy: Field | None = None
    toughness: Field | None = None
    length: Field | None = None
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
    plastic_viscosity: Field | None = None
    hardening_exponent: Field | None = None
    rate_sensitivity: Field | None = None
    melting_heat: Field | None = None
    yeoh_c20: Field | None = None
    yeoh_c30: Field | None = None
    ogden_alpha1: Field | None = None
    ogden_mu2: Field | None = None
    ogden_alpha2: Field | None = None
    ogden_mu3: Field | None = None
    ogden_alpha3: Field | None = None
    relaxation_share: Field | None = None
    relaxation_time: Field | None = None
    yield_time: Field | None = None
    variation: float = 0.0
    grain: float = 0.025
    weibull_modulus: float = 0.0
    reference_volume: float = 1e-6
    prefer: str = "toughness"
    hysteresis: str = "pressed"
    surface: str = "cam_clay"
    split: str = "volumetric"
    model: str = "at1"
    softening: float = 1.0
    restitution: float = 1.0
    dust: float = 0.5
    # not in the repr, from which a simulation is known again
    specular: float = dataclasses.field(default=0.03, repr=False)
    shininess: float = dataclasses.field(default=24.0, repr=False)
    transmission: float = dataclasses.field(default=0.0, repr=False)
    parts: tuple[Mapping[str, Any], ...] = ()
    sources: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in defaults; check the law and every number."""
        for field, words in WORDS.items():
            word = getattr(self, field)
            if word not in words:
                raise InputError(
                    f"material {self.name!r}: unknown {field} {word!r}",
                    hint=nearest(str(word), words),
                )
        if isinstance(self.length, str) and self.length == "auto":
            object.__setattr__(self, "length", None)
        reads, defaults = READS[self.law], DEFAULTS.get(self.law, {})
        for field in RANGES:
            if getattr(self, field) is not None and field not in reads:
                raise InputError(
                    f"material {self.name!r}: {field} does nothing under law {self.law!r}",
                    hint=f"remove it, or use law {_readers(field)}",
                )
        missing = [name for name in HANDBOOK if getattr(self, name) is None]
        if self.law == "nacc" and missing and len(missing) < len(HANDBOOK):
            raise InputError(
                f"material {self.name!r}: {', '.join(HANDBOOK)} go together, but "
                f"{', '.join(missing)} is missing",
                hint="give all three, or none of them and alpha0, hardening and cohesion",
            )
        if self.hysteresis == "unloading" and (
            self.law != "nacc" or self.relaxation_time is None or self.relaxation_share is not None
        ):
            raise InputError(
                f"material {self.name!r}: hysteresis 'unloading' takes law 'nacc' and "
                "relaxation_time, and no relaxation_share",
                hint="the share is 1 - restitution^2; take 'pressed' to go without",
            )
        if self.hysteresis != "unloading" and (
            (self.relaxation_share is None) != (self.relaxation_time is None)
        ):
            raise InputError(
                f"material {self.name!r}: {' and '.join(laws.RELAXATION)} go together",
                hint="give both, or none: then nothing relaxes",
            )
        by_handbook = not missing
        if self.surface == "rankine":
            by_hand = [f for f in _OPENED if getattr(self, f) is not None]
            if self.law != "nacc" or missing or by_hand:
                raise InputError(
                    f"material {self.name!r}: surface 'rankine' takes law 'nacc' with "
                    f"{', '.join(HANDBOOK)}, and none of {', '.join(_OPENED)}",
                    hint="take 'cam_clay' to give them by hand",
                )
        for field, (low, high, unit) in RANGES.items():
            value = getattr(self, field)
            left = field in HANDBOOK or field in OPTIONAL.get(self.law, ())
            if value is None and (left or (by_handbook and field in DERIVED)):
                continue
            if value is None and field in defaults:
                shear = by_handbook and field == "shear_damage"
                if shear and self.surface == "rankine":
                    continue
                object.__setattr__(self, field, SHEAR if shear else defaults[field])
            elif value is None and field in reads:
                raise InputError(
                    f"material {self.name!r}: law {self.law!r} needs {field}", hint=f"give {unit}"
                )
            if value is not None:
                _check_number(self.name, field, value, low, high, unit)
        for field, (low, high, unit) in (SCATTER | WHOLE | LOOKS).items():
            value = getattr(self, field)
            if isinstance(value, Tensor):
                raise InputError(f"material {self.name!r}: {field} must be one number")
            _check_number(self.name, field, value, low, high, unit)
        unread = _PLAIN if self.law not in BREAKS else {}
        for field, nothing in (
            unread | (_PLAIN_FIELD if self.law != "phase_field" else {})
        ).items():
            if getattr(self, field) != nothing:
                readers = BREAKS if field in _PLAIN else ("phase_field",)
                raise InputError(
                    f"material {self.name!r}: {field} does nothing under law {self.law!r}",
                    hint=f"remove it, or use law {' or '.join(readers)}",
                )
        thick = self.law == "von_mises" and bool((self._at("plastic_viscosity") > 0.0).any())
        for field in laws.JOHNSON_COOK if thick else ():
            if bool((self._at(field) > 0.0).any()):
                raise InputError(
                    f"material {self.name!r}: {field} and plastic_viscosity are two laws of rate",
                    hint="keep one of them",
                )
        if self.law in ("von_mises", "yeoh", "ogden"):
            wrong = laws.unstable(self.law, self.parameters())
            if wrong:
                raise InputError(f"material {self.name!r}: {wrong}", hint="mend the number")
        object.__setattr__(self, "sources", MappingProxyType(dict(self.sources)))

    def __getstate__(self) -> dict[str, Any]:
        """What travels to another process: a view of ``sources`` cannot."""
        return self.__dict__ | {"sources": dict(self.sources)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """See :meth:`__getstate__`."""
        self.__dict__.update(state, sources=MappingProxyType(state["sources"]))

    @property
    def by_handbook(self) -> bool:
        """Whether strengths and fracture energy are given, from which the grid derives the rest."""
        return self.fracture_energy is not None

    @property
    def energy_by_hand(self) -> bool:
        """Whether softening is as given: without a fracture energy, or with alpha0 or hardening."""
        return not self.by_handbook or self.alpha0 is not None or self.hardening is not None

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the parameters that the law reads."""
        return READS[self.law]

    def override(self, **changes: Any) -> Material:
        """Return a copy with fields changed; an unknown one is an error naming the nearest.

        A change of law drops the parameters of this material that the new law does not read. A
        new ``young_modulus`` of a softened material is another softening of the same thing; a new
        ``variation`` takes the place of the Weibull modulus.

        Raises:
            InputError: An unknown field, a number outside its range, a parameter the law does not
                read, or one that it needs and this material does not have.
        """
        known = [*PARAMETERS, *SCATTER, *WHOLE, *LOOKS, *WORDS, "name", "parts"]
        for key in changes:
            if key not in known:
                raise InputError(
                    f"material {self.name!r}: unknown parameter {key!r}", hint=nearest(key, known)
                )
        law = changes.get("law", self.law)
        if law != self.law and law in LAWS:
            dropped = [f for f in PARAMETERS if f not in READS[law] and f not in changes]
            changes = {**dict.fromkeys(dropped), **changes}
            if law not in BREAKS:
                changes = {**_PLAIN, **changes}
            if law != "nacc":  # what parts change are parameters of nacc
                changes = {"parts": (), "surface": "cam_clay", **changes}
            if law == "phase_field" and self.fracture_energy is not None:
                changes = {"toughness": self.fracture_energy, **changes}
            else:
                changes = {**_PLAIN_FIELD, **changes}
        if self.hysteresis == "unloading" and (
            law != self.law or changes.get("hysteresis", "unloading") != "unloading"
        ):
            changes = {"hysteresis": "pressed", "relaxation_time": None, **changes}
        if changes.get("surface") == "rankine":
            changes = {**dict.fromkeys(_OPENED), **changes}
        if "variation" in changes:
            changes = {"weibull_modulus": 0.0, **changes}
        changes = self._softened(changes)
        sources = {k: v for k, v in self.sources.items() if k not in changes}
        return dataclasses.replace(self, sources=sources, **changes)

    def _softened(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Changes with stiffness and softening in step: they are those of one real thing."""
        stiff, soft = changes.get("young_modulus"), changes.get("softening")
        mine = self.young_modulus
        if not isinstance(mine, int | float) or not (
            self.by_handbook or self.toughness is not None
        ):
            return changes
        if soft is None and isinstance(stiff, int | float) and stiff > 0.0:
            return {**changes, "softening": max(1.0, self.softening * mine / stiff)}
        if stiff is None and isinstance(soft, int | float) and soft > 0.0:
            return {**changes, "young_modulus": mine * self.softening / soft}
        return changes

    def source(self, field: str) -> str:
        """Say where a number is from.

        Returns:
            ``measured: ...``, ``derived: ...``, ``estimate: ...`` or ``chosen by eye``.

        Raises:
            InputError: No such field.
        """
        if field not in (*PARAMETERS, *SCATTER, *WHOLE, *LOOKS):
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
        if self.law == "phase_field":
            return phase_field.failure_strain(self)
        if self.law != "nacc":
            return math.inf
        by_hand = [f for f in DERIVED if getattr(self, f) is not None]
        if self.by_handbook and not by_hand:
            strength, young = self._at("tensile_strength"), self._at("young_modulus")
            return float((strength / (self.softening**0.5 * young)).min())
        found = self._nacc(_tensor)
        alpha, xi, beta = (found[f] for f in DERIVED[::-1])
        ratio = torch.sinh((xi * (-alpha).clamp(min=0.0)).clamp(max=5.0)) + 1e-5
        return float((0.5 * torch.log1p(2.0 * beta * ratio.clamp(max=0.495))).min())

    @property
    def breaking_speed(self) -> float:
        """Speed of the slowest strike that starts to break it [m/s]; infinite when none does.

        ``wave_speed * failure_strain``: a strike at v strains what it meets by v / c in one
        dimension (docs/theory/fracture.md): right to an order of magnitude, since an edge or a
        corner gathers strain and a soft thing spreads it.
        """
        return self.wave_speed * self.failure_strain if self.law in BREAKS else math.inf

    @property
    def start_alpha(self) -> Field:
        """State ``alpha`` of a fresh point: ``alpha0`` for nacc, else 0 or, unused, -1."""
        found = self.start_alphas(_tensor)
        return float(found) if found.ndim == 0 else found

    def start_alphas(self, sample: Callable[[Field], Tensor]) -> Tensor:
        """:attr:`start_alpha` at chosen points; ``sample`` as in :meth:`parameters`."""
        if self.law == "nacc":
            return self._nacc(sample)["alpha0"]
        return sample(0.0 if self.law in ("drucker_prager", "von_mises") else UNBROKEN)

    def parameters(self, sample: Callable[[Field], Tensor] | None = None) -> Tensor:
        """Return rows for :func:`gsfluent.ops.return_mapping`, [8] or [..., 8], float64.

        Args:
            sample: Turns a parameter into its values at chosen points; default: the parameter as
                it is.
        """
        at = sample or _tensor
        values = self._nacc(at) if self.law == "nacc" else {}
        if self.law == "phase_field":  # what a grid makes of it: materials.phase_field
            values = phase_field.columns(self, at, 0.0)
        row = laws.row(
            self.law, lambda field: values[field] if field in values else self._at(field, at)
        )
        if self.hysteresis == "both":
            row[..., 7] += row[..., 7] > 0.0
        elif self.hysteresis == "unloading":
            row[..., 7] = 0.0  # a matter of viscosities
        return row

    @property
    def viscous(self) -> bool:
        """Whether it relaxes, lets go of a spring, or yields in its own time."""
        return self.relaxation_time is not None or self.yield_time is not None

    def viscosities(self, sample: Callable[[Field], Tensor] | None = None) -> Tensor:
        """Share of the stiffness that relaxes, rate 1 / tau [1/s], time of a yield [s], [..., 3].

        A softened material takes longer by the root of its softening, as its waves do. A negative
        rate is that of ``hysteresis: unloading`` (:func:`gsfluent.ops.viscous_step`). Float64.

        Args:
            sample: As in :meth:`parameters`.
        """
        at, slower = sample or _tensor, self.softening**0.5
        share, tau, time = self.relaxation_share, self.relaxation_time, self.yield_time
        sign = 1.0
        if self.hysteresis == "unloading":
            share, sign = 1.0 - self.restitution**2, -1.0
        columns = (
            at(0.0) if share is None else at(share),
            at(0.0) if tau is None else sign / (slower * at(tau)),
            at(0.0) if time is None else slower * at(time),
        )
        return torch.stack(torch.broadcast_tensors(*columns), dim=-1)

    def strengths(self, sample: Callable[[Field], Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Uniaxial strengths of the softened material in tension and compression [Pa], float64.

        Args:
            sample: As in :meth:`parameters`.
        """
        root = self.softening**0.5
        return self._at(HANDBOOK[0], sample) / root, self._at(HANDBOOK[1], sample) / root

    def _nacc(self, at: Callable[[Field], Tensor]) -> dict[str, Tensor]:
        """Cohesion, hardening and alpha0; of strengths, with the steepest softening.

        What a grid makes of the fracture energy is softer: :mod:`gsfluent.pipeline.matter.brittle`.
        """
        given = {f: self._at(f, at) for f in DERIVED if getattr(self, f) is not None}
        if len(given) == len(DERIVED):
            return given
        none = torch.zeros((), dtype=torch.float64)
        open_yet = _OPENED if self.surface == "rankine" else DERIVED
        plain = laws.row("nacc", lambda f: none if f in open_yet else self._at(f, at))
        kappa = plain[..., 1]
        tensile, compressive = torch.broadcast_tensors(*self.strengths(at), kappa)[:2]
        if self.surface == "rankine":
            mu, no_energy = plain[..., 0], torch.zeros_like(tensile)
            beta, hardening, alpha0, _ = opening(mu, kappa, tensile, no_energy, prefer="strength")
            found = {"cohesion": beta, "hardening": hardening, "alpha0": alpha0}
            return found | {"shear_damage": -compressive / tensile}
        beta, p0 = ellipse(plain[..., 2], tensile, compressive, LARGEST * kappa)
        beta = given.get("cohesion", beta)
        size = torch.asinh(p0 / kappa)
        hardening = given.get("hardening", STEEPEST / beta)
        if "alpha0" in given and "hardening" not in given:
            hardening = size / given["alpha0"].abs()
        return {"cohesion": beta, "hardening": hardening, "alpha0": -size / hardening} | given

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
    if not isinstance(value, Tensor):  # without a tensor: presets hold thousands of numbers
        above = value > 0.0 or field not in POSITIVE
        if above and low <= value <= high and math.isfinite(value):
            return
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
