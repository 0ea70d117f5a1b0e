"""The Render stage: Gaussians, a camera and light in; a picture with shadows and a floor out.

Shading is deferred: one pass of the rasterizer gives colour, opacity, depth and blended normals per
pixel, a second one from the lamps their shadow maps, and
:mod:`gsfluent.pipeline.light.shade` then lights
each pixel once. Siblings that repair created are composited nearest-only through ``groups``
(equations.md section 14).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.errors import InputError
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.light.lamps import (
    SHININESS,
    SPECULAR,
    Light,
    Lighting,
    lighting_of,
    pack_lamps,
)
from gsfluent.pipeline.light.normals import Grid, grid_for, splat_normals
from gsfluent.pipeline.light.occlusion import Occupancy
from gsfluent.pipeline.light.shadow_maps import Bulk, Lit, bulk, faces_of, shadow_maps
from gsfluent.pipeline.render.backdrop import Backdrop
from gsfluent.pipeline.render.studio import Studio
from gsfluent.pipeline.stage import Stage

# Pictures whose longest side is above this get shadow maps of the second size.
_LARGE = 800
_RESOLUTIONS = (512, 1024)
# Room of the occupancy grid for matter that flies apart; beyond, a new one is laid out.
_ROOM = 1.25


@dataclass(frozen=True)
class Layers:
    """One rendered frame in layers.

    Attributes:
        image: Finished picture, display values, shape [H, W, 3].
        alpha: Opacity of the splats, shape [H, W].
        depth: Expected depth of the splats [m], 0 where there is none, shape [H, W].
        blended: Blended normals of the splats and what stands beside them, [H, W, K]; None when
            nothing was lit.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    blended: Tensor | None

    @property
    def normal(self) -> Tensor:
        """Unit normals of the splats, zero where there is none, shape [H, W, 3]."""
        if self.blended is None:
            return torch.zeros_like(self.image)
        return normalize(self.blended[..., :3], dim=-1)


class Render(Stage):
    """Gaussians to a picture.

    Args:
        camera: Default camera; a call may bring its own.
        light: The light; None leaves the captured colours as they are.
        studio: Floor and backdrop; None composites over ``background``.
        backdrop: Captured surroundings before the studio; None for none.
        background: Display colour behind the splats when there is no studio.
        antialiased: Antialiased splatting (opacity compensation for the pixel filter).
        normal_cell: Spacing [m] of the grid behind normals and occlusion; found anew every few
            pictures when None (a video fixes it with
            :func:`gsfluent.pipeline.light.normals.occupancy_cell` of its first frame).
        seed: Unused; rendering has no randomness.
    """

    name = "render"

    def __init__(
        self,
        camera: Camera | None = None,
        light: Light | Lighting | None = None,
        *,
        studio: Studio | None = None,
        backdrop: Backdrop | None = None,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        antialiased: bool = False,
        normal_cell: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        self.camera = camera
        self.light = light
        self.studio = studio
        self.backdrop = backdrop
        self.background = background
        self.antialiased = antialiased
        self.normal_cell = normal_cell
        self._size: _Size | None = None

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera | None = None,
        *,
        groups: Tensor | None = None,
        gloss: Tensor | None = None,
        time: float = 0.0,
    ) -> Tensor:
        """Render one picture.

        Args:
            gaussians: Scene frame.
            camera: Overrides the stage's camera.
            groups: int32 [N], siblings of which only the nearest shades a pixel; -1 for none.
            gloss: k_s and n_s of Blinn-Phong per splat, [N, 2]; the default plastic when None. Not
                read when the light says what everything is like.
            time: Moment [s], for lamps that move.

        Returns:
            Display values in [0, 1], shape [H, W, 3].

        Raises:
            InputError: No camera, or a camera with lens distortion.
        """
        return self.layers(gaussians, camera, groups=groups, gloss=gloss, time=time).image

    @torch.no_grad()
    def layers(
        self,
        gaussians: Gaussians,
        camera: Camera | None = None,
        *,
        groups: Tensor | None = None,
        gloss: Tensor | None = None,
        time: float = 0.0,
    ) -> Layers:
        """As :meth:`forward`, with opacity, depth and normals."""
        camera = self._camera(camera)
        means = gaussians.means
        viewmat, intrinsics = _moved(camera.viewmat, means), _moved(camera.K, means)
        lighting = lighting_of(self.light)
        lit, extras = None, None
        if lighting is not None:
            lit = self._light(gaussians, camera, lighting.at(time), groups)
            eye = -(viewmat[:3, 3] @ viewmat[:3, :3])
            extras = splat_normals(gaussians, lit.grid, eye)
            if gloss is not None and (lighting.specular is None or lighting.shininess is None):
                extras = torch.cat([extras, gloss.to(extras)], 1)
        seen = ops.rasterize(
            means,
            gaussians.opacities,
            viewmat,
            intrinsics,
            camera.width,
            camera.height,
            quats=gaussians.quats,
            scales=gaussians.scales,
            sh=gaussians.sh,
            antialiased=self.antialiased,
            normals=extras,
            groups=groups,
        )
        assert seen.depth is not None  # asked for
        front = seen.image
        behind = _constant(self.background, means.dtype, means.device)
        if lit is not None and lighting is not None and seen.normal is not None:
            vectors, gloss = _gloss(lighting, seen.normal, seen.alpha)
            whole = self.backdrop is None  # object, floor and backdrop at once
            front = self._shaded(
                seen.image,
                seen.alpha,
                seen.depth,
                vectors,
                gloss,
                (viewmat, intrinsics),
                lit,
                behind if whole else torch.zeros_like(behind),
                whole,
            )
            if whole:
                return Layers(front, seen.alpha, seen.depth, seen.normal)
        image = self._over_backdrop(front, behind, seen, (viewmat, intrinsics), camera, lit)
        return Layers(image.clamp(0.0, 1.0), seen.alpha, seen.depth, seen.normal)

    def _shaded(
        self,
        image: Tensor,
        alpha: Tensor,
        depth: Tensor,
        vectors: Tensor,
        gloss: Tensor | None,
        view: tuple[Tensor, Tensor],
        lit: Lit,
        background: Tensor,
        studio: bool,
    ) -> Tensor:
        """The lit picture, over the studio if that is wanted."""
        floor = self.studio if studio else None
        maps, grid = lit.maps, lit.grid
        return ops.shade(
            image,
            alpha,
            depth,
            vectors,
            *view,
            lit.lamps,
            lit.environment,
            background,
            gloss=gloss,
            maps=None if maps is None else tuple(maps),
            grid=tuple(grid) if lit.occlusion > 0.0 else None,
            occlusion=lit.occlusion,
            studio=None if floor is None else floor.packed(image),
        )

    def _over_backdrop(
        self,
        front: Tensor,
        behind: Tensor,
        seen: Rendered,
        view: tuple[Tensor, Tensor],
        camera: Camera,
        lit: Lit | None,
    ) -> Tensor:
        """The matter, times its opacity, over the studio and the captured surroundings."""
        assert seen.depth is not None  # asked for
        alpha = seen.alpha[..., None]
        if self.studio is not None:
            nothing = torch.zeros_like(front)
            behind = self._shaded(
                nothing,
                torch.zeros_like(seen.alpha),
                torch.zeros_like(seen.alpha),
                nothing,
                _constant((0.0, 1.0), front.dtype, front.device),
                view,
                _plain_light(front) if lit is None else lit,
                behind,
                True,
            )
        if self.backdrop is None:
            return front + behind * (1.0 - alpha)
        captured = self.backdrop.draw(camera, lit)
        cover = captured.alpha[..., None]
        behind = captured.image + behind * (1.0 - cover)
        image = front + behind * (1.0 - alpha)
        # what is nearer than the matter hides it
        before = (cover > 0.5) & (captured.depth < seen.depth)[..., None] & (alpha > 0.0)
        return torch.where(before, captured.image + image * (1.0 - cover), image)

    def _camera(self, camera: Camera | None) -> Camera:
        camera = camera or self.camera
        if camera is None:
            raise InputError("render: no camera", "give Render(camera) or call it with camera=")
        if any(camera.distortion):
            raise InputError(
                f"render: camera {camera.name!r} has lens distortion",
                "render with the undistorted pinhole camera that Capture.image() returns",
            )
        return camera

    def _light(
        self, gaussians: Gaussians, camera: Camera, lighting: Lighting, groups: Tensor | None
    ) -> Lit:
        """Shadow maps and occupancy of this state of the matter."""
        matter = bulk(gaussians)
        size = self._size
        if size is None or not size.fits(gaussians.count, matter):
            size = self._size = _Size.of(gaussians, matter, self.normal_cell)
        lamps = lighting.drawn()
        faces = faces_of(lamps, matter)
        large = max(camera.width, camera.height) > _LARGE
        texels = lighting.resolution or _RESOLUTIONS[large]
        return Lit(
            pack_lamps(lamps, faces, gaussians.means),
            lighting.around(gaussians.means),
            shadow_maps(gaussians, lamps, faces, texels, matter, groups=groups),
            size.grid.of(gaussians.means, matter.center),
            lighting.occlusion,
        )


@dataclass(frozen=True)
class _Size:
    """The occupancy grid, and the matter it was made for.

    Attributes:
        grid: Its size.
        radius: Largest radius of the matter [m] it has room for.
        count: Splats at that time.
    """

    grid: Grid
    radius: float
    count: int

    @classmethod
    def of(cls, gaussians: Gaussians, matter: Bulk, cell: float | None) -> _Size:
        radius = _ROOM * matter.radius
        return cls(grid_for(gaussians, cell=cell, radius=radius), radius, gaussians.count)

    def fits(self, count: int, matter: Bulk) -> bool:
        """Whether it will do for this matter too."""
        alike = self.count < _ROOM * count and count < _ROOM * self.count
        return alike and 0.5 * self.radius < matter.radius <= self.radius


def _gloss(lighting: Lighting, given: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor | None]:
    """Vectors and ``gloss`` for :func:`gsfluent.ops.shade`: k_s, n_s per pixel, or of all."""
    specular, shininess = lighting.specular, lighting.shininess
    if given.shape[-1] < 5 or (specular is not None and shininess is not None):
        specular = SPECULAR if specular is None else specular
        shininess = SHININESS if shininess is None else shininess
        return given, _constant((specular, shininess), given.dtype, given.device)
    for column, value in ((3, specular), (4, shininess)):
        if value is not None:
            given[..., column] = value * alpha
    return given, None


def _moved(values: Tensor, like: Tensor) -> Tensor:
    """Host values on the device of ``like``, without waiting for it."""
    return values.to(like.dtype).to(like.device, non_blocking=True)


@functools.lru_cache(maxsize=64)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype).to(device)


def _plain_light(like: Tensor) -> Lit:
    """The light of a floor under captured colours: even."""
    plain = Lighting(lamps=())
    grid = Occupancy(like.new_zeros(0), like.new_zeros(4), 0)
    return Lit(pack_lamps((), (), like), plain.around(like), None, grid, 0.0)
