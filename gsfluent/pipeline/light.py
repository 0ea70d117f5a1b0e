"""One directional light: Blinn-Phong on linear radiance, with a shadow map of our rasterizer.

equations.md section 16: ``L = c_0 (I_a + T I_L (D + S))`` with ``D = max(0, n.l)``,
``S = k_s max(0, n.h)^{n_s}`` and ``h = (l + v) / |l + v|``. The captured colour ``c_0`` already
holds the light of the photographs, so the default is mild: a surface that faces the light keeps its
colour, the far side loses about a fifth of its display value.

The shadow transmittance ``T`` comes from a depth-and-opacity image seen from the light (the derived
alternative to counting neighbours in a cone, which is quadratic). The light is directional; a
perspective camera far away stands in for the orthographic one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Gaussians
from gsfluent.errors import InputError

# Distance of the light's camera in scene radii; at 40 the rays differ by 1.4 degrees from parallel.
_LIGHT_DISTANCE = 40.0
_DISPLAY_GAMMA = 2.2
# Free border of the map, as a share of the scene's radius: the blurred shadow must fade out before
# the map ends.
_BORDER = 1.3


@dataclass(frozen=True)
class Light:
    """A directional key light and an ambient term.

    Attributes:
        direction: From the scene toward the light, scene frame; any length but zero.
        intensity: I_L of the key light.
        ambient: I_a.
        specular: k_s of Blinn-Phong.
        shininess: n_s of Blinn-Phong.
        shadow: Whether the key light is occluded by the object.
    """

    direction: tuple[float, float, float] = (1.0, -1.0, 2.0)
    intensity: float = 0.55
    ambient: float = 0.6
    specular: float = 0.08
    shininess: float = 24.0
    shadow: bool = True

    def __post_init__(self) -> None:
        length = sum(x * x for x in self.direction) ** 0.5
        if not (length > 0.0 and length < float("inf")):
            raise InputError(
                f"light.key.direction: {list(self.direction)}", "give three numbers, not all zero"
            )
        for name in ("intensity", "ambient", "specular", "shininess"):
            value = getattr(self, name)
            if not 0.0 <= value < float("inf"):
                raise InputError(f"light.{name}: {value}", "give a number of at least 0")

    def toward(self, like: Tensor) -> Tensor:
        """Unit vector toward the light, shape [3], dtype and device of ``like``."""
        direction = torch.tensor(self.direction, dtype=like.dtype, device=like.device)
        return direction / direction.norm()


def to_linear(color: Tensor) -> Tensor:
    """Display colour [0, 1] to linear radiance (pure power 2.2)."""
    return color.clamp(min=0.0).pow(_DISPLAY_GAMMA)


def to_display(radiance: Tensor) -> Tensor:
    """Linear radiance to display colour, inverse of :func:`to_linear`."""
    return radiance.clamp(min=0.0).pow(1.0 / _DISPLAY_GAMMA)


def blinn_phong(light: Light, normal: Tensor, view: Tensor, transmittance: Tensor) -> Tensor:
    """Irradiance factor of each point: ``I_a + T I_L (D + S)`` (equations.md section 16).

    Args:
        light: The light.
        normal: Unit normals, shape [..., 3].
        view: Unit vectors from the points toward the camera, shape [..., 3].
        transmittance: Share of the key light that arrives, shape [...].

    Returns:
        Factor on the linear colour, shape [...].
    """
    toward = light.toward(normal)
    diffuse = (normal @ toward).clamp(min=0.0)
    half = torch.nn.functional.normalize(toward + view, dim=-1)
    # light below the surface's horizon gives no highlight either
    highlight = (normal * half).sum(-1).clamp(min=0.0).pow(light.shininess) * (diffuse > 0)
    return light.ambient + transmittance * light.intensity * (diffuse + light.specular * highlight)


@dataclass(frozen=True)
class ShadowMap:
    """What the light sees: depth and opacity per texel.

    Attributes:
        viewmat: Scene to light camera, shape [4, 4].
        focal: Focal length in texels (square map, principal point in the centre).
        depth: Expected depth of the splats [m], shape [S, S]; 0 where nothing is.
        alpha: Opacity, shape [S, S].
        texel: Width of one texel at the object [m].
    """

    viewmat: Tensor
    focal: float
    depth: Tensor
    alpha: Tensor
    texel: float

    @classmethod
    def of(cls, gaussians: Gaussians, light: Light, *, resolution: int = 384) -> ShadowMap:
        """Render the map of ``gaussians`` from ``light`` with ``resolution`` squared texels."""
        means = gaussians.means
        center = (means.amin(0) + means.amax(0)) / 2
        # three mean scales of margin keep the rim of the outermost splats inside
        margin = 3.0 * float(gaussians.scales.amax(-1).mean())
        radius = float((means - center).norm(dim=-1).amax()) + margin + 1e-9
        distance = _LIGHT_DISTANCE * radius
        eye = center + light.toward(means) * distance
        viewmat = geometry.look_at(eye, center, means.new_tensor([0.0, 0.0, 1.0])).to(means)
        focal = 0.5 * resolution * _LIGHT_DISTANCE / _BORDER
        intrinsics = torch.tensor(
            [[focal, 0.0, resolution / 2], [0.0, focal, resolution / 2], [0.0, 0.0, 1.0]],
            dtype=means.dtype,
            device=means.device,
        )
        seen = ops.rasterize(
            means,
            gaussians.opacities,
            viewmat,
            intrinsics,
            resolution,
            resolution,
            quats=gaussians.quats,
            scales=gaussians.scales,
            colors=torch.zeros_like(means[:, :1]),
            near=0.1 * radius,
        )
        return cls(viewmat, focal, seen.depth, seen.alpha, 2.0 * _BORDER * radius / resolution)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Texel coordinates [P, 2] (texel centres at +0.5) and depth [P] of scene points [P, 3]."""
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = local[:, 2]
        return local[:, :2] / depth[:, None] * self.focal + self.alpha.shape[0] / 2, depth

    def transmittance(self, points: Tensor, *, bias: float) -> Tensor:
        """Share of the light that reaches points on the object (3 x 3 percentage-closer filter).

        Args:
            points: Scene points [m], shape [P, 3].
            bias: Depth [m] by which an occluder must be nearer to the light; about the thickness of
                a splat.

        Returns:
            Values in [0, 1], shape [P]; 1 outside the map.
        """
        texel, depth = self.project(points)
        size = self.alpha.shape[0]
        inside = ((texel >= 1.0) & (texel < size - 1.0)).all(dim=-1)
        base = texel.long().clamp(1, size - 2)
        first = base[:, 1] * size + base[:, 0]
        flat_depth, flat_alpha = self.depth.flatten(), self.alpha.flatten()
        limit = depth - bias
        blocked = torch.zeros_like(depth)
        for step in (-1 - size, -size, 1 - size, -1, 0, 1, size - 1, size, size + 1):
            index = first + step
            blocked += torch.where(flat_depth[index] < limit, flat_alpha[index], 0.0)
        return torch.where(inside, 1.0 - blocked / 9.0, 1.0)

    def cast(self, points: Tensor, *, softness: float) -> Tensor:
        """Share of the light that reaches a receiver behind everything, such as the floor.

        No depth test is needed there, so the opacity itself is blurred: a smooth penumbra without
        acne.

        Args:
            points: Scene points on the receiver [m], shape [P, 3].
            softness: Standard deviation of the penumbra [m].
        """
        alpha = gaussian_blur(self.alpha, softness / self.texel)
        texel, _ = self.project(points)
        grid = (texel / self.alpha.shape[0] * 2.0 - 1.0)[None, None]
        sampled = torch.nn.functional.grid_sample(
            alpha[None, None], grid, mode="bilinear", padding_mode="zeros", align_corners=False
        )
        return 1.0 - sampled.flatten().clamp(0.0, 1.0)


def gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Blur an image [H, W] with a Gaussian of ``sigma`` pixels (zero outside the image)."""
    if sigma <= 0.0:
        return image
    reach = max(1, min(int(3.0 * sigma + 0.5), max(image.shape)))
    x = torch.arange(-reach, reach + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    kernel = kernel / kernel.sum()
    conv2d = torch.nn.functional.conv2d
    blurred = conv2d(image[None, None], kernel[None, None, None, :], padding=(0, reach))
    blurred = conv2d(blurred, kernel[None, None, :, None], padding=(reach, 0))
    return blurred[0, 0]
