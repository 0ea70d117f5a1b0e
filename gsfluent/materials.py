"""Materials: the numbers of one solid, named presets, and where each number comes from.

A :class:`Material` is frozen; :meth:`Material.override` gives a changed copy. Presets live in
groups (``materials.fruit.watermelon``, ``materials.glass``) and can be found by name with
:func:`get`.

Strength follows the non-associated Cam-Clay model of Wolper et al. 2019 (CD-MPM, section 4): the
yield pressure is ``p0 = kappa * sinh(hardening * max(-alpha, 0))`` and tension fails at
``cohesion * p0``. ``alpha`` is the log plastic volume ratio: negative is intact, zero and above
is broken. The volumetric strain at which a material fails in tension is
:attr:`Material.failure_strain`; a body starts to break when it lands faster than about
``wave_speed * failure_strain``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from gsfluent.errors import InputError

LAWS = {"elastic": 0, "nacc": 1}
"""Constitutive laws that run now, and their number in :func:`gsfluent.ops.return_mapping`."""

LATER_LAWS = ("drucker_prager", "von_mises", "fluid", "rigid")
LATER_FIELDS = ("yield_stress", "viscosity", "bulk_modulus")

Field = float | Tensor
"""A parameter: one number, or a grid of numbers over the solid's voxels (shape [X, Y, Z])."""

_RANGES: dict[str, tuple[float, float, str]] = {
    "young_modulus": (0.0, math.inf, "Pa"),
    "poisson_ratio": (-0.99, 0.495, "no unit"),
    "density": (0.0, math.inf, "kg/m^3"),
    "cohesion": (0.0, 1e3, "no unit"),
    "hardening": (0.0, 1e3, "no unit"),
    "friction_angle": (0.0, 89.0, "degrees"),
    "alpha0": (-10.0, 0.5, "no unit"),
    "shear_damage": (0.0, 10.0, "no unit"),
}
_POSITIVE = ("young_modulus", "density", "grain")
_SCATTER: dict[str, tuple[float, float, str]] = {
    "variation": (0.0, 1.0, "no unit"),
    "grain": (0.0, math.inf, "m"),
}
PARAMETERS = tuple(_RANGES)
"""The fields of a material that may vary in space."""


@dataclasses.dataclass(frozen=True)
class Material:
    """What a solid is made of.

    Args:
        name: Name of the preset or of the user's own material.
        young_modulus: Stiffness E [Pa].
        poisson_ratio: Lateral contraction nu, in (-1, 0.495].
        density: Mass per volume [kg/m^3].
        law: ``"elastic"`` (never breaks) or ``"nacc"`` (breaks).
        cohesion: Tensile over compressive strength, beta in CD-MPM.
        hardening: How fast strength grows with compaction, xi in CD-MPM.
        friction_angle: Internal friction [degrees]; sets the slope M of the yield surface.
        alpha0: Log plastic volume ratio at the start; negative is intact.
        shear_damage: How much plastic shear counts as damage, eta; 0 is the plain model.
        variation: Relative scatter of strength in space (standard deviation of a smooth random
            factor on ``alpha0``); natural solids have weak and strong places, and that decides
            where cracks run and how many pieces survive a harder landing.
        grain: Length over which the strength varies [m].
        parts: Default parts (for :meth:`gsfluent.Scene.add`), e.g. the rind of a melon.
        sources: Field name -> where the number is from. A field that is not named was chosen by
            eye.

    Raises:
        InputError: An unknown law, a number outside its range, or a law that is not here yet.
    """

    name: str
    young_modulus: Field
    poisson_ratio: Field
    density: Field
    law: str = "nacc"
    cohesion: Field = 0.6
    hardening: Field = 3.0
    friction_angle: Field = 45.0
    alpha0: Field = -0.04
    shear_damage: Field = 0.0
    variation: float = 0.0
    grain: float = 0.025
    parts: tuple[Mapping[str, Any], ...] = ()
    sources: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the law and every number."""
        if self.law in LATER_LAWS:
            raise InputError(
                f"material {self.name!r}: law {self.law!r} is not in gsfluent yet; "
                "it arrives with a later issue",
                mend="use 'elastic' or 'nacc'",
            )
        if self.law not in LAWS:
            raise InputError(
                f"material {self.name!r}: unknown law {self.law!r}",
                mend=_nearest(self.law, [*LAWS, *LATER_LAWS]),
            )
        for field, (low, high, unit) in _RANGES.items():
            _check_number(self.name, field, getattr(self, field), low, high, unit)
        for field, (low, high, unit) in _SCATTER.items():
            if isinstance(getattr(self, field), Tensor):
                raise InputError(f"material {self.name!r}: {field} must be one number")
            _check_number(self.name, field, getattr(self, field), low, high, unit)
        object.__setattr__(self, "sources", MappingProxyType(dict(self.sources)))

    def override(self, **changes: Any) -> Material:
        """Return a copy with fields changed; an unknown one is an error naming the nearest.

        Raises:
            InputError: An unknown field or a number outside its range.
        """
        known = [*PARAMETERS, *_SCATTER, "law", "name", "parts"]
        for key in changes:
            if key in LATER_FIELDS:
                raise InputError(
                    f"material {self.name!r}: {key!r} belongs to a law that arrives with a "
                    "later issue",
                    mend="use law 'elastic' or 'nacc', which do not read it",
                )
            if key not in known:
                raise InputError(
                    f"material {self.name!r}: unknown parameter {key!r}", mend=_nearest(key, known)
                )
        sources = {k: v for k, v in self.sources.items() if k not in changes}
        return dataclasses.replace(self, sources=sources, **changes)

    def source(self, field: str) -> str:
        """Say where a number is from: ``measured: ...``, ``derived: ...`` or ``chosen by eye``."""
        if field not in (*PARAMETERS, *_SCATTER):
            raise InputError(
                f"material {self.name!r}: unknown parameter {field!r}",
                mend=_nearest(field, PARAMETERS),
            )
        return self.sources.get(field, "chosen by eye")

    @property
    def wave_speed(self) -> float:
        """Fastest elastic wave sqrt((kappa + 4 mu / 3) / density) [m/s] (largest over a field)."""
        row = self.parameters()
        return float(torch.sqrt((row[..., 1] + 4.0 / 3.0 * row[..., 0]) / row[..., 6]).max())

    @property
    def failure_strain(self) -> float:
        """Smallest volumetric strain at which tension fails; infinite when elastic."""
        if self.law == "elastic":
            return math.inf
        alpha, xi, beta = (_tensor(v) for v in (self.alpha0, self.hardening, self.cohesion))
        ratio = torch.sinh((xi * (-alpha).clamp(min=0.0)).clamp(max=5.0)) + 1e-5
        return float((0.5 * torch.log1p(2.0 * beta * ratio.clamp(max=0.495))).min())

    def parameters(self, sample: Callable[[Field], Tensor] | None = None) -> Tensor:
        """Return rows for :func:`gsfluent.ops.return_mapping`, [8] or [..., 8], float64.

        Columns: mu [Pa], kappa [Pa], M, cohesion, hardening, shear_damage, density [kg/m^3],
            reserved (0).

        Args:
            sample: Turns a parameter into its values at chosen points; default: the parameter as
                it is.
        """
        at = sample or _tensor
        young, nu, density = at(self.young_modulus), at(self.poisson_ratio), at(self.density)
        mu = young / (2.0 * (1.0 + nu))
        kappa = young / (3.0 * (1.0 - 2.0 * nu))
        sine = torch.sin(torch.deg2rad(at(self.friction_angle)))
        slope = 6.0 * sine / (3.0 - sine)
        rest = [at(self.cohesion), at(self.hardening), at(self.shear_damage)]
        columns = torch.broadcast_tensors(
            mu, kappa, slope, *rest, density, torch.zeros_like(density)
        )
        return torch.stack(columns, dim=-1)


def _tensor(value: Field) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).cpu()


def _check_number(name: str, field: str, value: Any, low: float, high: float, unit: str) -> None:
    """Refuse a parameter that is not a finite number (or grid of numbers) in its range."""
    where = f"material {name!r}: {field}"
    if isinstance(value, bool) or not isinstance(value, int | float | Tensor):
        raise InputError(
            f"{where} must be a number or a tensor, got {type(value).__name__}", mend=f"give {unit}"
        )
    data = _tensor(value)
    if data.ndim not in (0, 3):
        raise InputError(
            f"{where} must be one number or a grid [X, Y, Z] over the solid's voxels, "
            f"got shape {list(data.shape)}",
            mend="sample the field on the solid's occupancy grid",
        )
    inside = torch.isfinite(data) & (data >= low) & (data <= high)
    if field in _POSITIVE:
        inside &= data > 0.0
    if not bool(inside.all()):
        worst = float(data[~inside].reshape(-1)[0])
        edge = "above" if field in _POSITIVE else "at least"
        raise InputError(
            f"{where} must be {edge} {low:g} and at most {high:g} ({unit}), got {worst:g}",
            mend="mend the number",
        )


def _nearest(word: str, known: Any) -> str:
    close = difflib.get_close_matches(str(word), list(known), n=1, cutoff=0.4)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}known: {', '.join(sorted(known))}"


# --- presets ---
# ----------------- Explicit time steps cost one wave transit per cell, so a solid at its true
# stiffness (glass: 5400 m/s) would need a million steps per second. Stiff presets are therefore
# softened by a factor that `sources` states; strength is given as a strain, so the landing speed
# at which they break is wave_speed * failure_strain of the softened solid.

_DENSITY = "measured: handbook density"
_POISSON = "measured: handbook Poisson ratio"


def _softened(true_young: float, factor: float, what: str) -> str:
    return (
        f"derived: handbook {true_young:g} Pa for {what}, softened {factor:g} times for time steps"
    )


_RIND = {
    "name": "rind",
    "where": {"depth_below": 0.0175},
    "young_modulus": 9.6e5,
    "cohesion": 0.015,
    "hardening": 2.33,
    "alpha0": -0.21,
}
_PEEL = {"name": "peel", "where": {"depth_below": 0.004}, "cohesion": 0.12, "young_modulus": 5e5}

_PRESETS: dict[str, Material] = {
    m.name: m
    for m in (
        Material(
            "fruit.watermelon",
            4e5,
            0.32,
            950.0,
            cohesion=0.095,
            hardening=4.65,
            friction_angle=60.0,
            alpha0=-0.105,
            shear_damage=0.025,
            variation=0.35,
            parts=(_RIND,),
            sources={"density": _DENSITY + ", a melon just floats"},
        ),
        Material(
            "fruit.apple",
            2.5e5,
            0.35,
            840.0,
            cohesion=0.1,
            hardening=5.0,
            friction_angle=60.0,
            alpha0=-0.1,
            shear_damage=0.025,
            variation=0.3,
            grain=0.008,
            sources={
                "density": _DENSITY + ", an apple floats with a sixth above water",
                "young_modulus": _softened(3e6, 12, "apple flesh"),
            },
        ),
        Material(
            "fruit.orange",
            2e5,
            0.4,
            950.0,
            cohesion=0.1,
            hardening=5.0,
            friction_angle=60.0,
            alpha0=-0.1,
            shear_damage=0.025,
            variation=0.3,
            grain=0.008,
            parts=(_PEEL,),
            sources={"density": _DENSITY},
        ),
        Material("fruit.pumpkin", 6e5, 0.35, 800.0, cohesion=0.15, hardening=10.0, alpha0=-0.06),
        Material(
            "glass",
            7e7,
            0.22,
            2500.0,
            cohesion=0.05,
            hardening=10.0,
            alpha0=-0.03,
            friction_angle=60.0,
            sources={
                "young_modulus": _softened(7e10, 1000, "soda-lime glass"),
                "density": _DENSITY,
                "poisson_ratio": _POISSON,
            },
        ),
        Material(
            "ceramic",
            6e7,
            0.22,
            2400.0,
            cohesion=0.06,
            hardening=10.0,
            alpha0=-0.03,
            friction_angle=60.0,
            sources={
                "young_modulus": _softened(6e10, 1000, "porcelain"),
                "density": _DENSITY,
                "poisson_ratio": _POISSON,
            },
        ),
        Material(
            "bone",
            1.7e7,
            0.3,
            1900.0,
            cohesion=0.2,
            hardening=10.0,
            alpha0=-0.04,
            friction_angle=50.0,
            sources={
                "young_modulus": _softened(1.7e10, 1000, "cortical bone"),
                "density": _DENSITY,
                "poisson_ratio": _POISSON,
            },
        ),
        Material(
            "chocolate",
            1e7,
            0.35,
            1300.0,
            cohesion=0.08,
            hardening=10.0,
            alpha0=-0.03,
            friction_angle=50.0,
            sources={"density": _DENSITY},
        ),
        Material(
            "bread",
            3e4,
            0.1,
            250.0,
            cohesion=0.5,
            hardening=3.0,
            alpha0=-0.15,
            sources={"density": _DENSITY + " of a white loaf"},
        ),
        Material(
            "jelly", 3e4, 0.45, 1000.0, law="elastic", sources={"density": _DENSITY + " of water"}
        ),
        Material("plush", 2e4, 0.2, 150.0, law="elastic"),
        Material(
            "rubber",
            1e6,
            0.45,
            1100.0,
            law="elastic",
            sources={
                "young_modulus": "measured: handbook, soft rubber 1 to 5 MPa",
                "density": _DENSITY,
                "poisson_ratio": "derived: rubber has 0.49 or above; 0.45 slows the pressure wave",
            },
        ),
        Material("elastic", 1e5, 0.3, 1000.0, law="elastic"),
    )
}

fruit = SimpleNamespace(
    **{
        name.split(".", 1)[1]: value
        for name, value in _PRESETS.items()
        if name.startswith("fruit.")
    }
)
glass = _PRESETS["glass"]
ceramic = _PRESETS["ceramic"]
bone = _PRESETS["bone"]
chocolate = _PRESETS["chocolate"]
bread = _PRESETS["bread"]
jelly = _PRESETS["jelly"]
plush = _PRESETS["plush"]
rubber = _PRESETS["rubber"]
elastic = _PRESETS["elastic"]


def names() -> tuple[str, ...]:
    """Return the names of all presets."""
    return tuple(sorted(_PRESETS))


def get(name: str) -> Material:
    """Return the preset called ``name``; the group may be left out (``"watermelon"``).

    Raises:
        InputError: No preset has that name; the message gives the nearest one and all names.
    """
    if name in _PRESETS:
        return _PRESETS[name]
    short = {key.split(".")[-1]: value for key, value in _PRESETS.items()}
    if name in short:
        return short[name]
    raise InputError(f"unknown material {name!r}", mend=_nearest(name, _PRESETS))
