"""One posed camera."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data.frame import Frame


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A posed camera; OpenCV axes (+x right, +y down, +z forward), pixel centres at +0.5.

    Args:
        viewmat: World-to-camera matrix [4, 4], float64.
        K: Intrinsic matrix [3, 3] in pixels, float64.
        width: Image width in pixels.
        height: Image height in pixels.
        distortion: OpenCV coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for a pinhole.
        name: Image name as the capture lists it.
        image_path: Photograph, or None.
        mask_path: Mask image, or None.

    Raises:
        ValueError: A shape is wrong, the size is not positive, or the pose is not finite.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    name: str = ""
    image_path: Path | None = None
    mask_path: Path | None = None

    def __post_init__(self) -> None:
        """Check shapes and ranges."""
        for label, value, size in (("viewmat", self.viewmat, 4), ("K", self.K, 3)):
            if not isinstance(value, Tensor) or tuple(value.shape) != (size, size):
                got = list(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise ValueError(
                    f"Camera: {label} must be a tensor of shape [{size}, {size}], got {got}"
                )
            if not bool(torch.isfinite(value).all()):
                raise ValueError(
                    f"Camera: {label} of {self.name!r} must be finite, got NaN or infinity"
                )
        if self.width < 1 or self.height < 1:
            raise ValueError(f"Camera: size must be positive, got {self.width} x {self.height}")
        if not (float(self.K[0, 0]) > 0 and float(self.K[1, 1]) > 0):
            raise ValueError(
                f"Camera: focal lengths must be positive, got {self.K.diagonal()[:2].tolist()}"
            )
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(
                f"Camera: distortion must hold 0, 4, 5 or 8 numbers, got {len(self.distortion)}"
            )

    @staticmethod
    def look_at(
        eye: Sequence[float] | Tensor,
        target: Sequence[float] | Tensor,
        *,
        width: int,
        height: int,
        fov: float = 45.0,
        up: Sequence[float] | Tensor = (0.0, 0.0, 1.0),
        name: str = "",
    ) -> Camera:
        """Make a pinhole camera at ``eye`` facing ``target``; ``fov`` is vertical [degrees]."""
        points = [torch.as_tensor(part, dtype=torch.float64) for part in (eye, target, up)]
        focal = 0.5 * height / math.tan(math.radians(fov) / 2)
        intrinsics = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
        return Camera(
            geometry.look_at(points[0], points[1], points[2]),
            torch.tensor(intrinsics, dtype=torch.float64),
            width,
            height,
            name=name,
        )

    def center(self) -> Tensor:
        """Return the position of the camera in the world [3]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def forward(self) -> Tensor:
        """Return the viewing direction in the world [3], length one."""
        return self.viewmat[2, :3]

    def up(self) -> Tensor:
        """Return the direction of the top of the image in the world [3], length one."""
        return -self.viewmat[1, :3]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points [N, 3] to pixels [N, 2] and depths [N], lens distortion included.

        Points behind the camera get a negative depth; their pixels mean nothing. Radial and
        tangential model: OpenCV, "Camera Calibration and 3D Reconstruction".
        """
        return projected(points.to(self.viewmat), self.viewmat, self.K, self.distortion)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same view at another image size; each axis scales on its own."""
        stretch = self.K.new_tensor([width / self.width, height / self.height, 1.0])
        return self.replace(K=self.K * stretch[:, None], width=int(width), height=int(height))

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the image resized by ``factor``, rounded to whole pixels."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def transformed(self, frame: Frame) -> Camera:
        """Return the same view of the world moved by ``frame``; depths grow by ``frame.scale``."""
        viewmat = self.viewmat.clone()
        rotation = self.viewmat[:3, :3] @ frame.rotation.T.to(self.viewmat)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = frame.scale * self.viewmat[:3, 3] - rotation @ frame.translation.to(
            self.viewmat
        )
        return self.replace(viewmat=viewmat)

    def replace(self, **changes: object) -> Camera:
        """Return a copy with the named fields replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Camera:
        """Return a copy with both matrices on ``device`` and of ``dtype``."""
        return self.replace(
            viewmat=self.viewmat.to(device=device, dtype=dtype),
            K=self.K.to(device=device, dtype=dtype),
        )


def projected(
    points: Tensor, viewmat: Tensor, K: Tensor, distortion: Sequence[float] = ()
) -> tuple[Tensor, Tensor]:
    """As :meth:`Camera.project`, where the camera is two matrices on the device of the points.

    Args:
        points: World points [N, 3].
        viewmat: World to camera, [4, 4], of the same dtype.
        K: Intrinsics [px], [3, 3].
        distortion: Of the lens, as :class:`Camera` has it.
    """
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = local[:, 2]
    safe = torch.where(depth.abs() > 1e-12, depth, torch.full_like(depth, 1e-12))
    x, y = local[:, 0] / safe, local[:, 1] / safe
    if distortion:
        k1, k2, p1, p2, k3, k4, k5, k6 = (
            *distortion,
            *([0.0] * (8 - len(distortion))),
        )
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=1) @ K.T
    return pixels[:, :2], depth
