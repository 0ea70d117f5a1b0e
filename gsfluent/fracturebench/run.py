"""What a simulator hands in: where the points of a scene were at the times that it asks for."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .scene import BROKEN, Floats, Scene, SceneError

_MUST, _MAY = ("scene", "method", "wall_seconds", "steps"), ("settings", "device", "failed")
_OPTIONAL = ("damage", "stress", "impulse", "deformation")


@dataclasses.dataclass(frozen=True)
class Measure:
    """One figure of a run beside its reference."""

    quantity: str  # what was measured
    value: float  # the figure
    reference: float  # what it should be
    error: float  # distance of the two in the measure of tolerance
    tolerance: float  # largest accepted error
    unit: str = ""  # of value and reference
    source: str = ""  # where the reference comes from

    @property
    def passed(self) -> bool:
        """Whether the error is a number within the tolerance."""
        return bool(np.isfinite(self.error) and self.error <= self.tolerance)


@dataclasses.dataclass(frozen=True)
class Run:
    """A simulator's answer to a :class:`~gsfluent.fracturebench.scene.Scene`."""

    scene: str  # name of the case
    method: str  # who computed it, such as gsfluent or physgaussian
    times: Floats  # times [s], those of the scene, [T]
    x: Floats  # positions [m], [T, N, 3]; a run that broke off leaves NaN from there on
    v: Floats  # velocities [m/s], [T, N, 3]
    wall_seconds: float  # time the steps took, without set-up, compilation and copying out [s]
    steps: int  # steps taken
    # what was chosen: dx, dt or cfl, precision, ... plain values; with sha256, that of the scene, a
    # run is never judged by another version of it
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    device: str = ""  # on what
    failed: str = ""  # why it broke off, or empty
    damage: Floats | None = None  # 0 intact to 1 broken, [T, N], if the method knows
    # Cauchy or Kirchhoff stress as xx, yy, zz, xy, xz, yz [Pa], [T, N, 6], if kept
    stress: Floats | None = None
    # given by each collider, and then by each drive, so far [N s], [T, K, 3], if kept
    impulse: Floats | None = None
    # deformation gradient of each point since the start, [T, N, 3, 3], if kept
    deformation: Floats | None = None

    @property
    def finite(self) -> bool:
        """Whether it went through: no reason to break off, and only numbers."""
        return not self.failed and bool(np.isfinite(self.x).all() and np.isfinite(self.v).all())

    def matched(self, scene: Scene) -> Run:
        """Return itself if it answers this scene.

        Raises:
            SceneError: Another case, other times or another number of points; or ``settings`` hold
                a ``sha256`` that is not the scene's: it answers another version of it.
        """
        if self.scene != scene.name:
            raise SceneError(f"a run of {self.scene!r} cannot be judged as {scene.name!r}")
        if self.settings.get("sha256", digest := scene.digest()) != digest:
            raise SceneError(
                f"{self.method}, {scene.name}: answers another version of the scene; run it again"
            )
        shape = (scene.times.shape[0], scene.count, 3)
        for name in ("x", "v"):
            value = getattr(self, name)
            if value.shape != shape:
                raise SceneError(
                    f"{self.method}, {scene.name}: {name} has shape {value.shape}, the scene asks "
                    f"for {shape} (times, points, 3)"
                )
        if self.times.shape != scene.times.shape or not np.allclose(
            self.times, scene.times, rtol=1e-6, atol=0.0
        ):
            raise SceneError(f"{self.method}, {scene.name}: other times than the scene asks for")
        each = (*shape[:2],)
        for name, wanted in (
            ("damage", each), ("stress", (*each, 6)), ("deformation", (*each, 3, 3)),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and value.shape != wanted:
                raise SceneError(
                    f"{self.method}, {scene.name}: {name} has shape {value.shape}, not {wanted}"
                )
        return self

    def save(self, path: str | Path) -> Path:
        """Write an ``.npz``, under a temporary name until it is whole."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        arrays: dict[str, Any] = {"times": self.times, "x": self.x, "v": self.v}
        arrays |= {k: getattr(self, k) for k in _OPTIONAL if getattr(self, k) is not None}
        plain = {
            k: getattr(self, k)
            for k in ("scene", "method", "wall_seconds", "steps", "settings", "device", "failed")
        }
        with temporary.open("wb") as file:
            np.savez(file, header=np.array(json.dumps(plain)), **arrays)
        return temporary.replace(path)

    @classmethod
    def load(cls, path: str | Path) -> Run:
        """Read what :meth:`save` wrote.

        Raises:
            SceneError: The file is not such a file.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                header = dict(json.loads(str(data["header"])))
                arrays: dict[str, Any] = {
                    k: np.asarray(data[k], dtype=np.float64) for k in ("times", "x", "v")
                }
                more: dict[str, Any] = {
                    k: np.asarray(data[k], np.float64) for k in _OPTIONAL if k in data
                }
            if missing := [k for k in _MUST if k not in header]:
                raise SceneError(f"{path}: the header lacks {', '.join(missing)}")
            header = {k: header[k] for k in (*_MUST, *_MAY) if k in header}
            header["wall_seconds"] = float(header["wall_seconds"])
            header["steps"] = int(header["steps"])
            for key in ("scene", "method", "device", "failed"):
                header[key] = str(header.get(key, ""))
            header["settings"] = dict(header.get("settings", {}))
            return cls(**header, **arrays, **more)
        except SceneError:
            raise
        except BROKEN as error:
            said = str(error) or type(error).__name__
            raise SceneError(f"{path}: not a run of FractureBench ({said})") from error
