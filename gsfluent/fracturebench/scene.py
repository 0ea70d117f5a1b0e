"""What a simulator is given: points, materials, walls, drives and the times to answer for."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT = 1
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
BROKEN = (
    OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, NotImplementedError,
    RuntimeError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What reading a file that is cut, or that is something else, may raise."""
_ARRAYS = ("x", "v", "volume", "material", "body", "affine", "times")


class SceneError(ValueError):
    """A scene or a run that is not what it should be; the message says what, where and the mend."""


def quantised(value: NDArray[Any]) -> NDArray[np.int64]:
    """Return an array in whole parts of 1/2^24 of its largest number.

    Sines and sums differ in the last digit from one processor to the next; this does not.
    """
    if value.dtype.kind in "iu":
        return value.astype(np.int64)
    top = float(np.abs(value).max(initial=0.0))
    return (
        np.rint(value * (2.0**24 / top)).astype(np.int64) if top > 0.0 else value.astype(np.int64)
    )


def wave_speed(material: Mapping[str, Any]) -> float:
    """Speed of the pressure wave [m/s]."""
    young, nu = float(material["young_modulus"]), float(material["poisson_ratio"])
    modulus = young * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return math.sqrt(modulus / float(material["density"]))


@dataclasses.dataclass(frozen=True)
class Scene:
    """One problem at one resolution, in SI units.

    Attributes:
        name: Case it belongs to (:mod:`gsfluent.fracturebench.registry`).
        dx: Node spacing it was made for [m].
        x: Positions [m], float64 [N, 3].
        v: Velocities [m/s], float64 [N, 3].
        volume: Volume of each point at rest [m^3], [N].
        material: Row of ``materials`` of each point, int32 [N].
        body: Body of each point, int32 [N]; points of different bodies are not glued together.
        affine: Velocity gradients at the start [1/s], [N, 3, 3]: APIC's C. A method without them
            leaves them out.
        times: When positions and velocities are asked for [s], rising, [T].
        materials: ``law`` (``elastic`` or ``nacc``), ``young_modulus`` [Pa], ``poisson_ratio``,
            ``density`` [kg/m^3]; for ``nacc`` also ``friction``, ``cohesion``, ``hardening`` and
            ``alpha`` (at the start).
        gravity: [m/s^2].
        colliders: Planes: ``{"point", "normal", "kind": "sticky" | "slip" | "separate",
            "friction"}``, moving where there is a ``velocity`` [m/s]. A grid node that lies on a
            plane belongs to the wall.
        drives: What acts on groups of points. ``points`` is a list of indices or ``"all"``, and
            one of: ``velocity`` [vx, vy, vz], prescribed in place of what the method would give
            them (null: this component is free); ``force``, [[fx, fy, fz], ...] in N on each of the
            points, added; ``damping`` in 1/s, the force ``-damping m v``. ``start`` and ``end`` [s]
            bound it (default always); over ``ramp`` seconds from the start velocity and force
            grow linearly from 0 (default at once).
        friction: Coulomb coefficient between bodies.
        facts: Numbers that the judge needs and a simulator does not.
        asks: Further fields of :class:`~gsfluent.fracturebench.run.Run` that the case is judged
            by, such as ``deformation``.
        strain: Elastic strain b - I at the start as xx, yy, zz, xy, xz, yz, [N, 6]; None: none.
    """

    name: str
    dx: float
    x: Floats
    v: Floats
    volume: Floats
    material: Ints
    body: Ints
    affine: Floats
    times: Floats
    materials: tuple[Mapping[str, Any], ...]
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    colliders: tuple[Mapping[str, Any], ...] = ()
    drives: tuple[Mapping[str, Any], ...] = ()
    friction: float = 0.0
    facts: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    asks: tuple[str, ...] = ()
    strain: Floats | None = None

    def __post_init__(self) -> None:
        n, t = self.x.shape[0], self.times.shape[0]
        shapes = {
            "x": (n, 3), "v": (n, 3), "volume": (n,), "material": (n,), "body": (n,),
            "affine": (n, 3, 3), "times": (t,),
        }  # fmt: skip
        if self.strain is not None:
            shapes["strain"] = (n, 6)
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise SceneError(f"{self.name}: {name} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise SceneError(f"{self.name}: {name} holds numbers that are not finite")
        if n == 0 or t == 0 or self.times[0] < 0.0 or (np.diff(self.times) <= 0.0).any():
            raise SceneError(f"{self.name}: needs points and rising times")
        if self.material.min() < 0 or self.material.max() >= len(self.materials):
            raise SceneError(f"{self.name}: material must be 0 to {len(self.materials) - 1}")

    @property
    def count(self) -> int:
        """Number of points."""
        return self.x.shape[0]

    @property
    def mass(self) -> Floats:
        """Mass of each point [kg], [N]."""
        density = np.array([float(m["density"]) for m in self.materials])
        return density[self.material] * self.volume

    @property
    def wave_speed(self) -> float:
        """Fastest pressure wave [m/s]."""
        return max(wave_speed(row) for row in self.materials)

    @property
    def seconds(self) -> float:
        """Simulated time [s]."""
        return float(self.times[-1])

    def header(self) -> dict[str, Any]:
        """Everything but the arrays, as plain values: what the YAML file beside them says."""
        arrays = {*_ARRAYS, "strain"}
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {"format": FORMAT} | {k: v for k, v in plain.items() if k not in arrays}

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of the arrays that it has."""
        return _ARRAYS if self.strain is None else (*_ARRAYS, "strain")

    def digest(self) -> str:
        """SHA-256 of all arrays, each :func:`quantised`: the same on every machine."""
        found = hashlib.sha256()
        for name in self.arrays:
            value = quantised(np.asarray(getattr(self, name)))
            found.update(f"{name} {value.shape}".encode())
            found.update(np.ascontiguousarray(value, dtype="<i8").tobytes())
        return found.hexdigest()

    def save(self, path: str | Path) -> Path:
        """Write an ``.npz`` that holds all of it, under a temporary name until it is whole."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        arrays = {name: getattr(self, name) for name in self.arrays}
        with temporary.open("wb") as file:
            np.savez(file, header=np.array(json.dumps(self.header())), **arrays)
        return temporary.replace(path)

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read what :meth:`save` wrote.

        Raises:
            SceneError: The file is not such a file, or of another format.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                header = dict(json.loads(str(data["header"])))
                arrays = {name: data[name] for name in _ARRAYS}
                arrays |= {name: data[name] for name in ("strain",) if name in data}
        except BROKEN as error:
            raise SceneError(f"{path}: not a scene of FractureBench ({_said(error)})") from error
        if header.pop("format", None) != FORMAT:
            raise SceneError(f"{path}: not of format {FORMAT}; make the scenes again")
        try:
            for key in ("materials", "colliders", "drives", "gravity", "asks"):
                header[key] = tuple(header.get(key, ()))
            return cls(**header, **arrays)
        except BROKEN as error:
            raise SceneError(f"{path}: {_said(error)}") from error


def _said(error: BaseException) -> str:
    """What an error says, or its name where it says nothing."""
    return str(error) or type(error).__name__
