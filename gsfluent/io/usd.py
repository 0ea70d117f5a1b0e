"""A simulation over time in one USD file: splats, material points, and meshes of fragments.

Splats are a ``ParticleField3DGaussianSplat`` (UsdVol; linear scale, opacity 0..1, SH grouped per
particle), points a ``UsdGeom.Points``, meshes one ``UsdGeom.Mesh`` per fragment that is visible
while the fragment exists. Needs usd-core (``pip install "gsfluent[usd]"``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.colors import srgb_to_linear
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError, need
from gsfluent.io.atomic import atomic_path
from gsfluent.io.rigid import RigidMesh

_THREE_SIGMA = 3.0


@contextlib.contextmanager
def open_usd(path: str | Path, *, fps: float, up: str = "z") -> Iterator[UsdWriter]:
    """Open a USD file for writing; it appears, whole, when the block ends well.

    Args:
        path: ``.usdc``, ``.usda``, ``.usd`` or ``.usdz``.
        fps: Time codes per second; the first frame is time code 1.
        up: ``z`` or ``y``, written as the stage's up axis.

    Yields:
        Takes the frames in order.

    Raises:
        InputError: Another ending or up axis, no usd-core, or nothing was written.
        RunError: The disk is full.
    """
    path = Path(path)
    if path.suffix.lower() not in (".usdc", ".usda", ".usd", ".usdz"):
        raise InputError(f"{path}: not a USD name", "end it with .usdc, .usda or .usdz")
    if up not in ("z", "y"):
        raise InputError(f"USD has no up axis {up}", "choose z or y")
    need("pxr", "usd", "usd: a USD file")
    from pxr import Usd, UsdUtils

    with atomic_path(path) as part:
        zipped = part.suffix.lower() == ".usdz"
        crate = part.with_suffix(".usdc") if zipped else part
        try:
            writer = UsdWriter(Usd.Stage.CreateNew(str(crate)), fps, up)
            yield writer
            writer.finish()
            if zipped and not UsdUtils.CreateNewUsdzPackage(str(crate), str(part)):
                raise OSError(f"{path}: the package could not be written")
        finally:
            if zipped:
                crate.unlink(missing_ok=True)


class UsdWriter:
    """Fills a stage frame by frame; made by :func:`open_usd`."""

    def __init__(self, stage: Any, fps: float, up: str) -> None:
        from pxr import UsdGeom

        self.stage = stage
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if up == "z" else UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        self.root = UsdGeom.Xform.Define(stage, "/scene")
        stage.SetDefaultPrim(self.root.GetPrim())
        self.times: list[float] = []
        self._splats: Any = None
        self._sh: NDArray[Any] | None = None
        self._sh_moves = False
        self._points: Any = None
        self._meshes: dict[str, Any] = {}
        self._seen: dict[str, set[float]] = {}

    def _at(self, time: float) -> None:
        if not self.times or time != self.times[-1]:
            self.times.append(time)

    def splats(self, time: float, gaussians: Gaussians) -> None:
        """Author the splats of one time code."""
        from pxr import Gf, UsdVol, Vt

        self._at(time)
        if self._splats is None:
            self._splats = UsdVol.ParticleField3DGaussianSplat.Define(self.stage, "/scene/splats")
            self._splats.CreateSortingModeHintAttr().Set("zDepth")
            self._splats.CreateRadianceSphericalHarmonicsDegreeAttr().Set(gaussians.sh_degree)
        host = gaussians.to("cpu", torch.float64)
        prim, means = self._splats, _floats(host.means)
        prim.CreatePositionsAttr().Set(Vt.Vec3fArray.FromNumpy(means), time)
        quats = geometry.normalize_quaternions(host.quats)
        # the array's memory order is x, y, z, w
        turned = Vt.QuatfArray.FromNumpy(_floats(quats[:, [1, 2, 3, 0]]))
        prim.CreateOrientationsAttr().Set(turned, time)
        prim.CreateScalesAttr().Set(Vt.Vec3fArray.FromNumpy(_floats(host.scales)), time)
        prim.CreateOpacitiesAttr().Set(Vt.FloatArray.FromNumpy(_floats(host.opacities)), time)
        self._radiance(time, _floats(host.sh.reshape(-1, 3)))
        reach = _THREE_SIGMA * host.scales.amax(dim=1, keepdim=True).numpy()
        low, high = (means - reach).min(axis=0), (means + reach).max(axis=0)
        extent = Vt.Vec3fArray([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())])
        prim.CreateExtentAttr().Set(extent, time)

    def _radiance(self, time: float, sh: NDArray[Any]) -> None:
        """SH once as long as it stays the same, in every frame from then on."""
        from pxr import Vt

        attribute = self._splats.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        if self._sh is None:
            self._sh = sh
            attribute.Set(Vt.Vec3fArray.FromNumpy(sh))
        if not self._sh_moves and not np.array_equal(sh, self._sh):
            self._sh_moves = True
            for earlier in self.times[:-1]:
                attribute.Set(Vt.Vec3fArray.FromNumpy(self._sh), earlier)
        if self._sh_moves:
            attribute.Set(Vt.Vec3fArray.FromNumpy(sh), time)

    def points(
        self,
        time: float,
        positions: NDArray[Any],
        volumes: NDArray[Any],
        velocity: NDArray[Any],
        properties: dict[str, NDArray[Any]],
    ) -> None:
        """Author the material points of one time code.

        Args:
            time: Time code.
            positions: [P, 3] in metres.
            volumes: [P] in cubic metres; the widths are those of spheres of that volume.
            velocity: [P, 3] in metres per second.
            properties: Name to values [P], float or int; become primvars per point.
        """
        from pxr import Sdf, UsdGeom, Vt

        self._at(time)
        if self._points is None:
            self._points = UsdGeom.Points.Define(self.stage, "/scene/particles")
            # splats are the picture; the points are there to be picked up
            self._points.CreatePurposeAttr().Set(UsdGeom.Tokens.guide)
        prim, where = self._points, _floats(positions)
        widths = 2.0 * np.cbrt(3.0 * np.asarray(volumes, np.float64) / (4.0 * np.pi))
        prim.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(where), time)
        # in every frame, as a jet pours more of them; the same array is stored once
        prim.CreateIdsAttr().Set(Vt.Int64Array.FromNumpy(np.arange(len(where))), time)
        prim.CreateWidthsAttr().Set(Vt.FloatArray.FromNumpy(_floats(widths)), time)
        prim.CreateVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(_floats(velocity)), time)
        prim.CreateExtentAttr().Set(_box(where, float(widths.max()) / 2.0), time)
        api = UsdGeom.PrimvarsAPI(prim)
        for name, values in properties.items():
            whole = np.issubdtype(np.asarray(values).dtype, np.integer)
            kind = Sdf.ValueTypeNames.IntArray if whole else Sdf.ValueTypeNames.FloatArray
            primvar = api.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
            array = np.ascontiguousarray(values, np.int32 if whole else np.float32)
            primvar.Set((Vt.IntArray if whole else Vt.FloatArray).FromNumpy(array), time)

    def mesh(
        self,
        time: float,
        name: str,
        vertices: NDArray[Any],
        faces: NDArray[Any],
        colors: NDArray[Any],
    ) -> None:
        """Author one closed triangle mesh of one time code; it is hidden where it is not given.

        Args:
            time: Time code.
            name: Of the prim, a valid identifier.
            vertices: [V, 3] in metres.
            faces: [F, 3].
            colors: [V, 3] in 0..1, display values.
        """
        from pxr import UsdGeom, Vt

        self._at(time)
        if name not in self._meshes:
            if not self._meshes:
                UsdGeom.Scope.Define(self.stage, "/scene/fragments")
            prim = UsdGeom.Mesh.Define(self.stage, f"/scene/fragments/{name}")
            prim.CreateSubdivisionSchemeAttr().Set(UsdGeom.Tokens.none)
            prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
            # seen instead of the splats when guides or proxies are switched on
            prim.CreatePurposeAttr().Set(UsdGeom.Tokens.proxy)
            self._meshes[name], self._seen[name] = prim, set()
        prim = self._meshes[name]
        where = _floats(vertices)
        prim.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(where), time)
        counts = np.full(len(faces), 3, dtype=np.int32)
        prim.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts), time)
        corners = np.ascontiguousarray(faces.reshape(-1), np.int32)
        prim.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(corners), time)
        # display colours of a stage are linear light
        prim.GetDisplayColorPrimvar().Set(Vt.Vec3fArray.FromNumpy(srgb_to_linear(colors)), time)
        prim.CreateExtentAttr().Set(_box(where, 0.0), time)
        self._seen[name].add(time)

    def rigid(self, times: Sequence[float], meshes: Sequence[RigidMesh]) -> None:
        """Author meshes that only move rigidly, at all time codes at once.

        Args:
            times: Time codes, K, ascending.
            meshes: In the axes of the stage.
        """
        from pxr import Gf, UsdGeom, Vt

        for time in times:
            self._at(time)
        UsdGeom.Scope.Define(self.stage, "/scene/pieces")
        for mesh in meshes:
            prim = UsdGeom.Mesh.Define(self.stage, f"/scene/pieces/{mesh.name}")
            prim.CreateSubdivisionSchemeAttr().Set(UsdGeom.Tokens.none)
            prim.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(_floats(mesh.vertices)))
            counts = np.full(len(mesh.faces), 3, dtype=np.int32)
            prim.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(counts))
            corners = np.ascontiguousarray(mesh.faces.reshape(-1), np.int32)
            prim.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(corners))
            normals = _floats(mesh.corner_normals.reshape(-1, 3))
            prim.CreateNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(normals))
            prim.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
            colors = Vt.Vec3fArray.FromNumpy(_floats(srgb_to_linear(mesh.colors)))
            prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(colors)
            prim.CreateExtentAttr().Set(_box(mesh.vertices, 0.0))
            shift = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
            turn = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
            seen, before = prim.CreateVisibilityAttr(), None
            for k, time in enumerate(times):
                w, x, y, z = mesh.rotation[k].tolist()
                shift.Set(Gf.Vec3d(*mesh.translation[k].tolist()), time)
                turn.Set(Gf.Quatd(w, x, y, z), time)
                if before is None or mesh.shown[k] != before:  # holds until the next one
                    before = mesh.shown[k]
                    word = UsdGeom.Tokens.inherited if before else UsdGeom.Tokens.invisible
                    seen.Set(word, time)

    def finish(self) -> None:
        """Set the time range and visibilities and save.

        Raises:
            InputError: Nothing was authored.
        """
        from pxr import UsdGeom

        if not self.times:
            raise InputError("usd: no frame at all", "give at least one")
        self.stage.SetStartTimeCode(self.times[0])
        self.stage.SetEndTimeCode(self.times[-1])
        for name, prim in self._meshes.items():
            visibility = prim.CreateVisibilityAttr()
            for time in self.times:
                there = time in self._seen[name]
                visibility.Set(
                    UsdGeom.Tokens.inherited if there else UsdGeom.Tokens.invisible, time
                )
        self.stage.Save()


def _floats(values: Any) -> NDArray[np.float32]:
    array = values.numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
    return np.ascontiguousarray(array, dtype=np.float32)


def _box(points: NDArray[Any], margin: float) -> Any:
    from pxr import Gf, Vt

    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    return Vt.Vec3fArray([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())])
