"""Lamps and the light from everywhere: what :class:`gsfluent.pipeline.Render` lights a scene with.

The captured colour already holds the light of the photographs, so no default is harsh: a surface
that faces the key light keeps its colour. A film is lit by :func:`studio_light`, whose far side
loses about a quarter to a third of its display value. The shading itself is
:mod:`gsfluent.pipeline.light.shade`.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.pipeline.light.shade import DIRECTIONAL, LAMP, POINT
from gsfluent.pipeline.light.shadow import disc

Vector = tuple[float, float, float]
AMBIENT, INTENSITY, SPECULAR, SHININESS = 0.6, 0.55, 0.03, 24.0
SOFTNESS = 4.0
"""Apparent width [degrees] of a directional lamp: a large lamp of a studio; the sun has 0.53."""
_BAND0 = 3.5449077018110318  # constant coefficient of an environment that is 1 everywhere
_BAND1 = 2.0466534158929770  # the three of the next band, where it is the normal's part
_MOST_SAMPLES = 64


@dataclass(frozen=True)
class Lamp:
    """A directional or a point lamp.

    Attributes:
        direction: From the scene toward a directional lamp, scene frame; any length but zero.
        position: Where a point lamp is [m]; None for a directional one.
        color: Linear colour.
        intensity: I_L: what a white surface that faces the lamp sends back. Of a point lamp, at
            ``distance``.
        distance: Distance [m] at which a point lamp has its intensity.
        falloff: Exponent e of a point lamp's falloff ``(distance / r)^e``; 2 is nature's.
        size: Apparent width of a directional lamp [degrees], diameter of a point lamp [m]; how
            soft its shadows are.
        shadow: Whether matter blocks it.
        samples: Parts that the lamp is drawn in, each with a shadow map; more make wide penumbrae
            right where blockers at several depths overlap, and cost as much.
        spin: Turn of the lamp about +z through the scene's origin [degrees per second].
    """

    direction: Vector = (1.0, -1.0, 2.0)
    position: Vector | None = None
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = INTENSITY
    distance: float = 1.0
    falloff: float = 2.0
    size: float | None = None
    shadow: bool = True
    samples: int = 1
    spin: float = 0.0

    def __post_init__(self) -> None:
        """Check ranges."""
        length = math.hypot(*self.direction)
        if not 0.0 < length < math.inf:
            raise InputError(
                f"light.key.direction: {list(self.direction)}", "give three numbers, not all zero"
            )
        for name in ("color", "position"):
            value = getattr(self, name)
            least = 0.0 if name == "color" else -math.inf
            if value is not None and not all(least <= v < math.inf for v in value):
                raise InputError(f"light: {name} {list(value)}", "give three finite numbers")
        for name, low in (("intensity", 0.0), ("falloff", 0.0), ("size", 0.0), ("distance", 1e-9)):
            value = getattr(self, name)
            if value is not None and not low <= value < math.inf:
                raise InputError(f"light.{name}: {value}", f"give a number of at least {low:g}")
        if self.position is None and self.size is not None and not self.size < 120.0:
            raise InputError(f"light.size: {self.size}", "a directional lamp is below 120 degrees")
        if not 1 <= self.samples <= _MOST_SAMPLES:
            raise InputError(f"light.samples: {self.samples}", f"give 1 to {_MOST_SAMPLES}")
        if not math.isfinite(self.spin):
            raise InputError(f"light.spin: {self.spin}", "give degrees per second")

    @property
    def softness(self) -> float:
        """Tangent of half the angle of a directional lamp, or radius [m] of a point lamp."""
        if self.position is not None:
            return 0.5 * (0.0 if self.size is None else self.size)
        return math.tan(math.radians(0.5 * (SOFTNESS if self.size is None else self.size)))

    @property
    def toward(self) -> Vector:
        """Unit vector toward a directional lamp."""
        length = math.hypot(*self.direction)
        x, y, z = (part / length for part in self.direction)
        return (x, y, z)

    def at(self, time: float) -> Lamp:
        """The lamp at ``time`` [s]."""
        if self.spin == 0.0 or time == 0.0:
            return self
        angle = math.radians(self.spin * time)
        moved = {"direction": _turned(self.direction, angle)}
        if self.position is not None:
            moved["position"] = _turned(self.position, angle)
        return replace(self, **moved)  # type: ignore[arg-type]

    def parts(self) -> list[Lamp]:
        """The lamps it is drawn as: itself, or ``samples`` smaller ones over its disc."""
        if self.samples == 1 or self.softness == 0.0 or not self.shadow:
            return [self]
        across, upward = _axes(self.toward)
        share = replace(self, samples=1, intensity=self.intensity / self.samples)
        width = 1.0 / math.sqrt(self.samples)
        found = []
        spots = disc(self.samples)
        middle = [sum(spot[axis] for spot in spots) / len(spots) for axis in (0, 1)]
        for a, b in ((a - middle[0], b - middle[1]) for a, b in spots):
            offset = [self.softness * (a * p + b * q) for p, q in zip(across, upward, strict=True)]
            if self.position is None:
                x, y, z = (t + o for t, o in zip(self.toward, offset, strict=True))
                size = math.degrees(2.0 * math.atan(self.softness * width))
                found.append(replace(share, direction=(x, y, z), size=size))
            else:
                x, y, z = (p + o for p, o in zip(self.position, offset, strict=True))
                found.append(replace(share, position=(x, y, z), size=2.0 * self.softness * width))
        return found


@dataclass(frozen=True)
class Lighting:
    """Lamps, the light from everywhere, and how surfaces answer.

    Attributes:
        lamps: Any number of lamps.
        ambient: I_a, light from everywhere, the same in all directions.
        environment: Irradiance over pi in spherical harmonics of degree 2, 9 x 3, added to
            ``ambient``; see :mod:`gsfluent.pipeline.light.environment`.
        occlusion: How much of the light from everywhere matter hides, 0 (none) to 1.
        specular: k_s of Blinn-Phong on everything; None takes each material's own.
        shininess: n_s of Blinn-Phong on everything; None takes each material's own.
        resolution: Texels along the side of a shadow map; from the picture's size when None.
        delight: Share of the captured shading that is divided out first, 0 to 1
            (:mod:`gsfluent.pipeline.light.albedo`).
    """

    lamps: tuple[Lamp, ...] = (Lamp(),)
    ambient: float = AMBIENT
    environment: tuple[Vector, ...] | None = None
    occlusion: float = 1.0
    specular: float | None = None
    shininess: float | None = None
    resolution: int | None = None
    delight: float = 0.0

    def __post_init__(self) -> None:
        """Check ranges."""
        limits = {"ambient": math.inf, "specular": math.inf, "shininess": math.inf}
        for name, most in {**limits, "occlusion": 1.0, "delight": 1.0}.items():
            value = getattr(self, name)
            if value is not None and not (0.0 <= value <= most and value < math.inf):
                hint = "of at least 0" if most == math.inf else "from 0 to 1"
                raise InputError(f"light.{name}: {value}", f"give a number {hint}")
        given = self.environment
        if given is not None:
            fine = len(given) == 9 and all(len(row) == 3 for row in given)
            if not fine or not all(math.isfinite(v) for row in given for v in row):
                raise InputError("light.environment: not 9 x 3 finite numbers", "give 9 rows of 3")
        if self.resolution is not None and not 16 <= self.resolution <= 8192:
            raise InputError(f"light.resolution: {self.resolution}", "give 16 to 8192")

    @property
    def shadow(self) -> bool:
        """Whether any lamp casts shadows."""
        return any(lamp.shadow for lamp in self.lamps)

    def at(self, time: float) -> Lighting:
        """The lighting at ``time`` [s]: lamps that spin have turned."""
        if all(lamp.spin == 0.0 for lamp in self.lamps):
            return self
        return replace(self, lamps=tuple(lamp.at(time) for lamp in self.lamps))

    def drawn(self) -> tuple[Lamp, ...]:
        """All parts of all lamps that shine."""
        shining = (lamp for lamp in self.lamps if lamp.intensity > 0.0)
        return tuple(part for lamp in shining for part in lamp.parts())

    def around(self, like: Tensor) -> Tensor:
        """Environment and ambient together, [9, 3], as :func:`gsfluent.ops.shade` takes them."""
        return _around(self.ambient, self.environment, like.dtype, like.device)


RIM = Lamp(direction=(-0.8, 1.0, 0.9), intensity=0.45, size=12.0)
"""From behind: it draws the edge of what is dark, and of what has the floor's colour."""
_KEY = Lamp(intensity=0.62, size=10.0)
_FILL_AMBIENT = 0.42
_FILL = (-0.095, -0.075, 0.06)
"""How the light from everywhere rises: from the side of the camera that the key light leaves."""


def studio_light() -> Lighting:
    """The light of a film that says nothing else: a soft key, a fill and a rim.

    The fill is light from everywhere: it needs no shadow map, and cracks stay dark.
    """
    x, y, z = _FILL
    none = (0.0, 0.0, 0.0)
    rise = tuple((_BAND1 * part,) * 3 for part in (y, z, x))
    return Lighting((_KEY, RIM), _FILL_AMBIENT, (none, *rise, none, none, none, none, none))


def key_light(
    direction: Vector = (1.0, -1.0, 2.0),
    intensity: float = INTENSITY,
    ambient: float = AMBIENT,
    specular: float = SPECULAR,
    shininess: float = SHININESS,
    shadow: bool = True,
) -> Lighting:
    """One directional key light and an ambient term: the short form of :class:`Lighting`."""
    lamp = Lamp(direction=direction, intensity=intensity, shadow=shadow)
    return Lighting((lamp,), ambient=ambient, specular=specular, shininess=shininess)


def pack_lamps(lamps: tuple[Lamp, ...], faces: tuple[int, ...], like: Tensor) -> Tensor:
    """Table of lamps for :mod:`gsfluent.pipeline.light.shade`, [L, LAMP]; cached per device.

    Args:
        lamps: What :meth:`Lighting.drawn` gives.
        faces: Shadow maps of each lamp: 0, 1, or 6.
        like: Gives dtype and device.
    """
    return _packed(lamps, faces, like.dtype, like.device)


@functools.lru_cache(maxsize=64)
def _packed(
    lamps: tuple[Lamp, ...], faces: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    rows, first = [], 0
    for lamp, count in zip(lamps, faces, strict=True):
        kind, place = (DIRECTIONAL, lamp.toward)
        if lamp.position is not None:
            kind, place = POINT, lamp.position
        radiance = [part * lamp.intensity for part in lamp.color]
        maps = [float(first) if count else -1.0, float(count)]
        reach = [lamp.distance, lamp.falloff, lamp.softness]
        rows.append([kind, *place, *radiance, *reach, *maps])
        first += count
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, LAMP).to(device, dtype)


@functools.lru_cache(maxsize=64)
def _around(
    ambient: float,
    environment: tuple[Vector, ...] | None,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    values = torch.zeros(9, 3, dtype=torch.float64)
    if environment is not None:
        values += torch.tensor(environment, dtype=torch.float64)
    values[0] += ambient * _BAND0
    return values.to(device, dtype)


def _axes(forward: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors across ``forward`` and each other."""
    x, y, z = forward
    other = (1.0, 0.0, 0.0) if abs(x) < 0.6 else (0.0, 1.0, 0.0)
    a = (y * other[2] - z * other[1], z * other[0] - x * other[2], x * other[1] - y * other[0])
    length = math.hypot(*a)
    a = (a[0] / length, a[1] / length, a[2] / length)
    return a, (y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0])


def _turned(vector: Vector, angle: float) -> Vector:
    """A vector turned about +z by ``angle`` [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    return (c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2])
