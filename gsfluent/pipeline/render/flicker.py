"""Flicker: how much of a picture changes from frame to frame without anything having moved there.

The material point that a pixel shows (:class:`gsfluent.pipeline.render.holes.MatterView`)
says
where the pixel is in the next frame; there the picture should have the same colour. The camera may
move as well. Matter that the next frame hides, or shows as something else, is left out, and so are
the rims of pieces and debris that turns: there a picture changes although nothing is wrong with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.pipeline.render.holes import MatterView, dilated

HIDDEN = 1.5
"""Matter found this many point spacings nearer or farther than expected is other matter."""
COHERENT = 1.0
"""Neighbouring pixels whose shifts differ by more [px] show matter that is coming apart."""
_RIM = 2


@dataclass(frozen=True)
class Flow:
    """Where the pixels of a frame are in the next.

    Attributes:
        target: Pixel coordinates in the next frame, [H, W, 2] (the first pixel's centre is 0.5).
        valid: Pixels whose matter is seen in both, bool [H, W].
    """

    target: Tensor
    valid: Tensor

    @classmethod
    def of(
        cls,
        before: MatterView,
        after: MatterView,
        positions: tuple[Tensor, Tensor],
        cameras: tuple[Camera, Camera],
        spacing: float,
    ) -> Flow:
        """Follow the matter from one frame to the next.

        Args:
            before: Matter of this frame.
            after: Matter of the next frame.
            positions: Material points in both [m], [P, 3], the same rows.
            cameras: Of both frames, at the size of the views.
            spacing: Distance between material points [m].
        """
        first, second = cameras
        device = before.depth.device
        height, width = before.depth.shape
        y, x = torch.meshgrid(
            torch.arange(height, device=device) + 0.5,
            torch.arange(width, device=device) + 0.5,
            indexing="ij",
        )
        # a place moves as its point does, on the plane of that point
        world = _unproject(first, x, y, before.depth)
        point = before.point.clamp(min=0)
        world = world + (positions[1] - positions[0])[point]
        target, z = _project(second, world)
        column, row = target[..., 0].floor().long(), target[..., 1].floor().long()
        valid = before.silhouette & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
        found = after.depth[row, column]
        valid &= after.silhouette[row, column] & ((found - z).abs() <= HIDDEN * spacing)
        # rims are soft: what lies beside other matter, or moves unlike its neighbours, is mixed
        far = HIDDEN * spacing
        seen = before.point >= 0
        valid &= seen & (_range(before.depth[..., None], seen) <= far)
        valid &= (_range(after.depth[..., None], after.point >= 0) <= far)[row, column]
        shift = target - torch.stack([x, y], -1)
        valid &= _range(shift, seen) <= COHERENT
        return cls(target, valid)


def flicker(before: Tensor, after: Tensor, flow: Flow) -> float | None:
    """Mean absolute change of colour along the motion.

    Both pictures are blurred a little (1, 2, 1), or the resampling of a fine texture would count.

    Args:
        before: Picture of a frame, display values, [H, W, 3].
        after: Picture of the next frame.
        flow: From one to the other.

    Returns:
        Mean over the followed pixels and the channels, 0 to 1; None where nothing can be followed.
    """
    if not bool(flow.valid.any()):
        return None
    change = (_sampled(_blurred(after), flow.target) - _blurred(before)).abs().mean(-1)
    return float(change[flow.valid].mean())


def _range(image: Tensor, seen: Tensor) -> Tensor:
    """Largest spread of a channel of [H, W, C] over the pixels seen around each, [H, W]."""
    planes = image.permute(2, 0, 1)
    high = dilated(torch.where(seen, planes, -torch.inf), _RIM)
    return (high + dilated(torch.where(seen, -planes, -torch.inf), _RIM)).amax(0)


def _unproject(camera: Camera, x: Tensor, y: Tensor, depth: Tensor) -> Tensor:
    viewmat, k = camera.viewmat.to(depth), camera.K.to(depth)
    local = torch.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], torch.ones_like(x)], -1)
    return (local * depth[..., None] - viewmat[:3, 3]) @ viewmat[:3, :3]


def _project(camera: Camera, world: Tensor) -> tuple[Tensor, Tensor]:
    viewmat, k = camera.viewmat.to(world), camera.K.to(world)
    local = world @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[..., 2]
    safe = z.clamp(min=1e-9)
    u = k[0, 0] * local[..., 0] / safe + k[0, 2]
    v = k[1, 1] * local[..., 1] / safe + k[1, 2]
    # far off the picture a whole number would not fit
    return torch.stack([u, v], -1).clamp(-1e6, 1e6), z


def _blurred(image: Tensor) -> Tensor:
    for axis in (0, 1):
        count = image.shape[axis]
        row = torch.arange(count, device=image.device)
        before = image.index_select(axis, (row - 1).clamp(min=0))
        after = image.index_select(axis, (row + 1).clamp(max=count - 1))
        image = 0.25 * before + 0.5 * image + 0.25 * after
    return image


def _sampled(image: Tensor, target: Tensor) -> Tensor:
    """Bilinear samples [H, W, 3] at pixel coordinates."""
    height, width = image.shape[:2]
    size = target.new_tensor([width, height])
    grid = (2.0 * target / size - 1.0)[None].to(image.dtype)
    planes = image.permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(
        planes, grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[0].permute(1, 2, 0)
