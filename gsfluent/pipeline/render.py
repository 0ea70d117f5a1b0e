"""The Render stage: Gaussians, a camera and a light in; a picture with shadows and a floor out.

Shading is deferred: one pass of the rasterizer gives colour, opacity, depth and blended normals per
pixel, a second one from the light gives its shadow map, and Blinn-Phong then runs once per pixel
instead of once per splat. Siblings that repair created are composited nearest-only through
``groups`` (equations.md section 14).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.data import Camera, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.light import Light, ShadowMap, blinn_phong, to_display, to_linear
from gsfluent.pipeline.render_backdrop import Backdrop
from gsfluent.pipeline.render_floor import Studio
from gsfluent.pipeline.render_normals import estimate_normals
from gsfluent.pipeline.stage import Stage

# Shadows start this many mean splat sizes behind the occluder, or a lit surface would shadow
# itself.
_BIAS_IN_SPLATS = 4.0
_ALPHA_FLOOR = 1e-4


@dataclass(frozen=True)
class Layers:
    """One rendered frame in layers.

    Attributes:
        image: Finished picture, display values, shape [H, W, 3].
        alpha: Opacity of the splats, shape [H, W].
        depth: Expected depth of the splats [m], 0 where there is none, shape [H, W].
        normal: Unit normals of the splats, zero where there is none, shape [H, W, 3].
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor


class Render(Stage):
    """Gaussians to a picture.

    Args:
        camera: Default camera; a call may bring its own.
        light: The light; None leaves the captured colours as they are.
        studio: Floor and backdrop; None composites over ``background``.
        backdrop: Captured surroundings before the studio; None for none.
        background: Display colour behind the splats when there is no studio.
        antialiased: Antialiased splatting (opacity compensation for the pixel filter).
        normal_cell: Grid spacing [m] of the normal estimate; found anew for each picture when None
            (a video fixes it with :func:`gsfluent.pipeline.render_normals.occupancy_cell` of its
            first frame).
        seed: Unused; rendering has no randomness.
    """

    name = "render"

    def __init__(
        self,
        camera: Camera | None = None,
        light: Light | None = None,
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

    def forward(
        self, gaussians: Gaussians, camera: Camera | None = None, *, groups: Tensor | None = None
    ) -> Tensor:
        """Render one picture.

        Args:
            gaussians: Scene frame.
            camera: Overrides the stage's camera.
            groups: int32 [N], siblings of which only the nearest shades a pixel; -1 for none.

        Returns:
            Display values in [0, 1], shape [H, W, 3].

        Raises:
            InputError: No camera, or a camera with lens distortion.
        """
        return self.layers(gaussians, camera, groups=groups).image

    @torch.no_grad()
    def layers(
        self, gaussians: Gaussians, camera: Camera | None = None, *, groups: Tensor | None = None
    ) -> Layers:
        """As :meth:`forward`, with opacity, depth and normals."""
        camera = self._camera(camera)
        means = gaussians.means
        viewmat = camera.viewmat.to(means)
        intrinsics = camera.K.to(means)
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
            normals=self._normals(gaussians),
            groups=groups,
        )
        alpha = seen.alpha[..., None]
        albedo = to_linear(seen.image / alpha.clamp(min=_ALPHA_FLOOR))
        eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
        rays = pixel_rays(viewmat, intrinsics, camera.width, camera.height)
        light = self.light
        shadow = ShadowMap.of(gaussians, light) if light is not None and light.shadow else None
        if light is None:
            normal = torch.zeros_like(seen.image)
            radiance = albedo
        else:
            normal = torch.nn.functional.normalize(seen.normal, dim=-1)
            radiance = self._lit(
                albedo, normal, seen.alpha, seen.depth, eye, rays, viewmat, shadow, gaussians
            )
        if self.studio is not None:
            lit = self.studio.shade(eye, rays, light or Light(shadow=False), shadow, gaussians)
            background = to_display(lit)
        else:
            background = means.new_tensor(self.background).expand_as(radiance)
        # splats were fitted by blending display values, so blending stays in display values
        image = to_display(radiance) * alpha + background * (1.0 - alpha)
        if self.backdrop is not None:
            behind = self.backdrop.draw(camera, rays, light, shadow)
            cover = behind.alpha[..., None]
            background = behind.image + background * (1.0 - cover)
            image = to_display(radiance) * alpha + background * (1.0 - alpha)
            # what is nearer than the matter hides it
            before = (cover > 0.5) & (behind.depth < seen.depth)[..., None] & (alpha > 0.0)
            image = torch.where(before, behind.image + image * (1.0 - cover), image)
        image = image.clamp(0.0, 1.0)
        return Layers(image, seen.alpha, seen.depth, normal)

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

    def _normals(self, gaussians: Gaussians) -> Tensor | None:
        if self.light is None:
            return None
        return estimate_normals(gaussians, cell=self.normal_cell)

    def _lit(
        self,
        albedo: Tensor,
        normal: Tensor,
        alpha: Tensor,
        depth: Tensor,
        eye: Tensor,
        rays: Tensor,
        viewmat: Tensor,
        shadow: ShadowMap | None,
        gaussians: Gaussians,
    ) -> Tensor:
        """Linear radiance of the splats after lighting, shape [H, W, 3]."""
        light = self.light or Light()
        covered = alpha > _ALPHA_FLOOR
        radiance = albedo.clone()
        if not bool(covered.any()):
            return radiance
        toward_eye = -rays[covered]
        surface = normal[covered]
        # expected depth is along the optical axis; rays are unit length
        along = depth[covered] / (rays[covered] @ viewmat[2, :3])
        points = eye + along[:, None] * rays[covered]
        arrives = torch.ones_like(along)
        if shadow is not None:
            bias = _BIAS_IN_SPLATS * float(gaussians.scales.mean()) + shadow.texel
            arrives = shadow.transmittance(points + 0.5 * bias * surface, bias=0.5 * bias)
        radiance[covered] = (
            albedo[covered] * blinn_phong(light, surface, toward_eye, arrives)[:, None]
        )
        return radiance


def pixel_rays(viewmat: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Unit rays in the scene through the pixel centres, shape [H, W, 3]."""
    x = torch.arange(width, dtype=viewmat.dtype, device=viewmat.device) + 0.5
    y = torch.arange(height, dtype=viewmat.dtype, device=viewmat.device) + 0.5
    u = (x - intrinsics[0, 2]) / intrinsics[0, 0]
    v = (y - intrinsics[1, 2]) / intrinsics[1, 1]
    local = torch.stack(
        [
            u.expand(height, width),
            v[:, None].expand(height, width),
            torch.ones(height, width).to(u),
        ],
        -1,
    )
    return torch.nn.functional.normalize(local @ viewmat[:3, :3], dim=-1)
