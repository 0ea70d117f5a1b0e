"""The numbers that are learnt: how each is written as a free coordinate, and what is believed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.materials.laws import RANGES, READS
from gsfluent.materials.material import Material, nearest
from gsfluent.scene.scene import Scene

Array = NDArray[np.float64]
VECTORS = ("velocity", "angular_velocity")
"""What of a body is three numbers."""
OFFSET = "floor.offset"
"""How much lower than the floor matter is held up, in cells: the grid feels a floor early."""
LOGITS = "logits"
"""Of an object: how much more the matter at its nodes is of each law than of the first."""
FINER = "grid.extrapolation"
"""How far a motion goes on from the coarser grid through the finer one."""
_NU, _ANGLE = 0.49, 60.0
_FIXED = ("density", "cohesion", "hardening", "alpha0", "shear_damage", "poisson_ratio")
_SPREAD = {"velocity": 5.0, "angular_velocity": 10.0}
WIDE = 1.5
"""Standard deviation of what is believed beforehand, in decades or units of a sigmoid."""
LIMITS = {"log": 0.3, "poisson_ratio": 0.1, "friction_angle": 6.0, "velocity": 0.5,
          "angular_velocity": 2.0}  # fmt: skip
"""Widest standard deviation of a number that counts as found: decades, none, degrees, m/s, 1/s."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One number or vector that is learnt.

    Attributes:
        key: ``OBJECT.NAME``, or ``OBJECT/PART.NAME``.
        start: Where the search begins, in its unit; of a vector the three numbers.
        low, high: Bounds from which starts are drawn, or None.
        spread: Standard deviation of the prior, in the free coordinate.
    """

    key: str
    start: tuple[float, ...]
    low: float | None = None
    high: float | None = None
    spread: float = WIDE

    @property
    def name(self) -> str:
        """Without its object."""
        return self.key.partition(".")[2]

    @property
    def object(self) -> str:
        """Its object."""
        return self.key.partition(".")[0]

    @property
    def size(self) -> int:
        """How many numbers it is."""
        return len(self.start)

    @property
    def kind(self) -> str:
        """``log``, ``poisson_ratio``, ``friction_angle``, ``plain`` or the name of a vector."""
        if self.name in ("poisson_ratio", "friction_angle", *VECTORS):
            return self.name
        return "plain" if self.key in (OFFSET, FINER) or self.name == LOGITS else "log"

    def free(self, value: Sequence[float]) -> Array:
        """The free coordinates of a value."""
        given = np.asarray(value, np.float64)
        if self.kind == "log":
            return np.log10(np.maximum(given, 1e-300))
        if self.kind in ("poisson_ratio", "friction_angle"):
            most = _NU if self.kind == "poisson_ratio" else _ANGLE
            share = np.clip(given / most, 1e-4, 1 - 1e-4)
            return np.asarray(np.log(share / (1 - share)))
        return given

    def value(self, free: Array) -> Array:
        """The value at free coordinates."""
        if self.kind == "log":
            return np.asarray(10.0 ** np.clip(free, -12.0, 15.0))
        if self.kind in ("poisson_ratio", "friction_angle"):
            most = _NU if self.kind == "poisson_ratio" else _ANGLE
            return np.asarray(most / (1.0 + np.exp(-np.clip(free, -30.0, 30.0))))
        return np.asarray(free, np.float64)

    def slope(self, free: Array) -> Array:
        """By how much what is reported changes: decades of a logarithm, else units."""
        if self.kind in ("poisson_ratio", "friction_angle"):
            most = _NU if self.kind == "poisson_ratio" else _ANGLE
            found = self.value(free)
            return np.asarray(found * (1.0 - found / most))
        return np.ones_like(free)


class Unknowns:
    """All numbers of a fit, as one vector.

    Args:
        parameters: In the order of the vector.
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self.parameters = tuple(parameters)
        self.start = np.concatenate([p.free(p.start) for p in parameters])
        self.spread = np.concatenate([np.full(p.size, p.spread) for p in parameters])

    def __len__(self) -> int:
        """How many numbers."""
        return len(self.start)

    def slices(self) -> dict[str, slice]:
        """Where each parameter is."""
        found, at = {}, 0
        for p in self.parameters:
            found[p.key] = slice(at, at + p.size)
            at += p.size
        return found

    def labels(self) -> list[str]:
        """A name for each number."""
        found = []
        for p in self.parameters:
            found += [p.key] if p.size == 1 else [f"{p.key}.{axis}" for axis in "xyz"[: p.size]]
        return found

    def values(self, free: Array) -> dict[str, Any]:
        """Values by key: a number, or a list of three."""
        found: dict[str, Any] = {}
        for p, part in zip(self.parameters, self.slices().values(), strict=True):
            value = p.value(free[part])
            found[p.key] = float(value[0]) if p.size == 1 else [float(v) for v in value]
        return found

    def slope(self, free: Array) -> Array:
        """See :meth:`Parameter.slope`."""
        parts = zip(self.parameters, self.slices().values(), strict=True)
        return np.concatenate([p.slope(free[part]) for p, part in parts])

    def motion_only(self) -> NDArray[np.bool_]:
        """Which numbers say how things start to move, not what they are."""
        marks = [np.full(p.size, p.name in VECTORS) for p in self.parameters]
        return np.concatenate(marks)

    def starts(self, count: int, seed: int) -> list[Array]:
        """The start, and more by a Latin hypercube over bounds, or over the prior's middle."""
        random = np.random.default_rng(seed)
        found = [self.start.copy()]
        if count < 2:
            return found
        cells = np.stack([random.permutation(count - 1) for _ in range(len(self))], axis=1)
        share = (cells + random.random(cells.shape)) / (count - 1)
        for row in share:
            at = self.start.copy()
            for p, part in zip(self.parameters, self.slices().values(), strict=True):
                if p.name in VECTORS or p.key in (OFFSET, FINER):
                    continue  # seen before contact, and small
                low, high = self.start[part] - 1.0, self.start[part] + 1.0
                if p.low is not None and p.high is not None:
                    low, high = p.free([p.low]), p.free([p.high])
                at[part] = low + row[part] * (high - low)
            found.append(at)
        return found


def places(scene: Scene) -> dict[str, Material]:
    """What has a material of its own: objects by name, and their parts as ``OBJECT/PART``."""
    found = {}
    for body in scene.bodies:
        found[body.name] = body.material
        for part in body.parts:
            found[f"{body.name}/{part.name}"] = part.material(body.material)
    return found


def flat(learn: Mapping[str, Mapping[str, Any]] | Sequence[str]) -> dict[str, Any]:
    """Bounds by ``OBJECT.NUMBER``.

    Raises:
        InputError: Not of either form.
    """
    if not isinstance(learn, Mapping):
        return dict.fromkeys(learn, True)
    wanted: dict[str, Any] = {}
    for name, values in learn.items():
        if not isinstance(values, Mapping):
            raise InputError(f"learn.{name} is {values!r}", "give {young_modulus: true, ...}")
        wanted |= {f"{name}.{key}": bounds for key, bounds in values.items()}
    return wanted


def read_learn(scene: Scene, learn: Mapping[str, Mapping[str, Any]] | Sequence[str]) -> Unknowns:
    """What is to be learnt.

    Args:
        scene: Has the objects, and where the search starts.
        learn: ``{"melon": {"young_modulus": (1e4, 1e7), "velocity": True}}``, or
            ``["melon.young_modulus", "melon/rind.young_modulus", "melon.velocity"]``.

    Raises:
        InputError: An unknown object, a number that its law does not read or that cannot be learnt
            from motion, bounds that are none, or nothing at all.
    """
    wanted = flat(learn)
    made = places(scene)
    bodies = {body.name: body for body in scene.bodies}
    found = []
    for key, bounds in wanted.items():
        name, _, field = str(key).partition(".")
        if name not in made:
            raise InputError(f"learn: no object {name!r}", nearest(name, made))
        if field in VECTORS and name in bodies:
            motion = tuple(float(v) for v in getattr(bodies[name], field))
            found.append(Parameter(f"{name}.{field}", motion, spread=_SPREAD[field]))
            continue
        found.append(parameter(name, made[name], field, bounds))
    if not found:
        raise InputError("learn: nothing is to be learnt", "name melon.young_modulus and others")
    if sum(p.size for p in found) > 12:
        raise InputError(
            f"learn: {sum(p.size for p in found)} numbers are more than 12",
            "differences take a run each: learn fewer at a time",
        )
    return Unknowns(found)


def parameter(place: str, material: Material, field: str, bounds: Any) -> Parameter:
    """One number of a material.

    Args:
        place: What it is called before the point.
        material: Where it starts.
        field: Its name.
        bounds: True, or lowest and highest.

    Raises:
        InputError: The law does not read it, it cannot be learnt, or the bounds are none.
    """
    where, law = f"learn: {place}.{field}", material.law
    known = [f for f in READS[law] if f not in _FIXED or f == "poisson_ratio"]
    if law in ("nacc", "rigid") or field not in known:
        hint = nearest(field, [*known, *VECTORS])
        if law == "nacc":
            hint = "what breaks is not learnt from motion: give the object a law that does not"
        elif field == "density":
            hint = "motion shows stiffness over density: give the density, learn the stiffness"
        raise InputError(f"{where}: cannot be learnt under law {law}", hint)
    value = getattr(material, field)
    if not isinstance(value, int | float):
        raise InputError(f"{where}: is a field", "give one number to start from")
    low = high = None
    if isinstance(bounds, Sequence) and not isinstance(bounds, str) and len(bounds) == 2:
        low, high = (float(b) for b in bounds)
        least, most, unit = RANGES[field]
        if not least <= low < high <= most or (
            field not in ("poisson_ratio", "friction_angle") and low <= 0
        ):
            raise InputError(f"{where}: bounds are {low:g} and {high:g}", f"give two in {unit}")
    elif bounds is not True:
        raise InputError(f"{where}: is {bounds!r}", "give true, or [lowest, highest]")
    start = float(value)
    if low is not None and high is not None and not low <= start <= high:
        start = math.sqrt(low * high) if low > 0 else 0.5 * (low + high)
    if field not in ("poisson_ratio", "friction_angle") and start <= 0.0:
        start = 1.0  # Pa or Pa s: a logarithm has no 0
    spread = WIDE
    if low is not None and high is not None:
        made = Parameter(f"{place}.{field}", (start,))
        spread = max(float(made.free([high])[0] - made.free([low])[0]) / 2.0, 1e-3)
    return Parameter(f"{place}.{field}", (start,), low, high, spread)
