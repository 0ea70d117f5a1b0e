"""A photographed cross-section carried through the object along its axis.

A cut across an orange shows segments, one across a log shows rings: structure that depth alone
does not know. Every voxel is given the place in the photograph at its own azimuth whose depth and
distance to the axis come closest to its own: near the skin the depth decides (the peel follows the
surface to the poles), in the core the distance (a core stays as wide as it is).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent._lazy import ndimage
from gsfluent.pipeline.texture.synthesis.guides import PlacedPhoto, explained
from gsfluent.pipeline.texture.synthesis.levels import trilinear

_TURNS, _RADII, _DEPTHS, _STEPS = 180, 64, 48, 160  # of the lookup
_FINE_TURNS, _FINE_STEPS = 1080, 256  # of pictures


class Section:
    """Lookup of photograph places by azimuth, distance to the axis and depth.

    Attributes:
        skin: How far the photograph's rim follows its depth, 0 to 1.

    Args:
        placed: Photograph of a cut across the object's axis (axis 2 of its frame).
        largest: Largest depth of the object [voxels].
        reach: Largest distance of matter to the axis [voxels].
        device: Where to compute.
        closed: The core closes towards the poles (an apple's), because the depth decides all the
            way in; otherwise it goes on from pole to pole (an orange's, a log's).
    """

    def __init__(
        self,
        placed: PlacedPhoto,
        largest: float,
        reach: float,
        device: torch.device,
        closed: bool = False,
    ) -> None:
        mask = placed.mask
        if placed.fitted:
            center = np.array(_pixel_of(placed, np.zeros(2)))
        else:
            deep = placed.depth >= 0.95 * placed.depth.max()
            center = np.argwhere(deep).mean(0)
        self.center, self.reach, self.largest = center, max(reach, 1.0), max(largest, 1e-6)
        self.placed = placed
        # bark and peel follow the surface; the faces of a sawn block do not
        rim = mask & (placed.depth < 0.2 * placed.depth.max())
        layered = explained(placed.depth[rim], placed.image[rim])
        self.skin = float(np.clip((layered - 0.1) / 0.2, 0.0, 1.0))
        longest = float(np.hypot(*mask.shape))
        steps = np.linspace(0.0, 1.0, _STEPS)
        angle = 2 * np.pi * np.arange(_TURNS) / _TURNS
        ray = np.stack([np.cos(angle), np.sin(angle)], -1)
        fine = np.linspace(0.0, longest, 4 * int(longest))
        line = center[:, None, None] + ray.T[:, :, None] * fine
        hit = ndimage.map_coordinates(mask.astype(np.float32), line, order=1) > 0.5
        last = np.where(hit.any(1), hit.shape[1] - 1 - hit[:, ::-1].argmax(1), 1)
        self.radius = torch.from_numpy(fine[last]).float().to(device)  # pixels, per azimuth
        spot = center[:, None, None] + ray.T[:, :, None] * (fine[last][:, None] * steps)
        depth = ndimage.map_coordinates(placed.depth, spot, order=1, mode="nearest")
        place = np.stack(
            [
                ndimage.map_coordinates(placed.local[..., k], spot, order=1, mode="nearest")
                for k in range(2)
            ]
        )
        if not placed.fitted:
            place = place - placed.local[tuple(np.rint(center).astype(int))][:2, None, None]
        distance = np.hypot(place[0], place[1])
        table = torch.empty(_TURNS, _RADII, _DEPTHS, device=device)
        want_r = torch.linspace(0, self.reach, _RADII, device=device)
        want_d = self._depth_guide(torch.linspace(0, 1, _DEPTHS, device=device), closed)
        pull = (0.3 if closed else 2.0) / self.largest
        unit = torch.linspace(0, 1, _STEPS, device=device)
        for k in range(_TURNS):
            have_r = torch.from_numpy(distance[k]).float().to(device)
            have_d = self._depth_guide(
                torch.from_numpy(depth[k]).float().to(device) / self.largest, closed
            )
            cost = ((want_d[:, None] - have_d) ** 2)[None] + (
                ((want_r[:, None] - have_r) * pull) ** 2
            )[:, None]
            # the weighted mean of near equals instead of the best one: no jumps
            table[k] = torch.softmax(-cost / 0.003, -1) @ unit
        self.table = torch.cat([table, table[:1]])[None]

    def _depth_guide(self, relative: Tensor, closed: bool) -> Tensor:
        """Steep in the outer tenth of the depth; below flat, or rising to the core."""
        near = 12.0 * self.skin * (1.0 - torch.exp(-relative / 0.1))
        return near + 4.0 * relative if closed else near

    def polar(self, image: Tensor, whole: bool) -> Tensor:
        """What of a picture [C, U, V] goes on along the axis: [C, azimuth, relative radius].

        Lines that run outwards (membranes) and lines that run around (rings, rind) go on; grains
        and cells in between do not. So: the mean along the radius plus the mean around, less the
        mean of both. With ``whole`` everything goes on (fibres).
        """
        device = image.device
        height, width = self.placed.mask.shape
        angle = 2 * torch.pi * torch.arange(_FINE_TURNS, device=device) / _FINE_TURNS
        turn = torch.arange(_FINE_TURNS, device=device) * (_TURNS / _FINE_TURNS)
        length = self._outline(turn)[:, None] * torch.linspace(0, 1, _FINE_STEPS, device=device)
        u = self.center[0] + 0.5 + length * angle.cos()[:, None]
        v = self.center[1] + 0.5 + length * angle.sin()[:, None]
        grid = torch.stack([2 * v / width - 1, 2 * u / height - 1], -1).float()
        found = functional.grid_sample(
            image[None], grid[None], padding_mode="border", align_corners=False
        )
        if whole:
            return found[0]
        outward = _blur(found, 0.10 * _FINE_STEPS, 3, "replicate")
        around = _blur(found, _FINE_TURNS / 15.0, 2, "circular")
        both = _blur(outward, _FINE_TURNS / 15.0, 2, "circular")
        return (outward + around - both)[0]

    def _outline(self, turn: Tensor) -> Tensor:
        """Distance of the outline from the axis [pixels] at azimuths counted in table rows."""
        low = turn.floor().long()
        share = turn - low
        first, second = self.radius[low % _TURNS], self.radius[(low + 1) % _TURNS]
        return first * (1 - share) + second * share

    def locate(self, local: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Azimuth [n] in turns and relative radius [n] of the places in the photograph.

        Args:
            local: Places in the object's frame [n, 3].
            depth: Depths [n], voxels of the solid.
        """
        turn = torch.atan2(local[:, 1], local[:, 0]) / (2 * torch.pi) % 1.0
        radius = torch.hypot(local[:, 0], local[:, 1])
        cell = torch.stack(
            [
                turn * _TURNS + 0.5,
                (radius / self.reach).clamp(0, 1) * (_RADII - 1) + 0.5,
                (depth / self.largest).clamp(0, 1) * (_DEPTHS - 1) + 0.5,
            ],
            -1,
        )
        return turn, trilinear(self.table, cell)[0]

    def color(self, turn: Tensor, relative: Tensor, polar: Tensor) -> Tensor:
        """Colours [n, C] of a polar picture (:meth:`polar`) at located places."""
        around = torch.cat([polar, polar[:, :1]], 1)
        rows, columns = around.shape[1:]
        place = [
            2 * (relative * (columns - 1) + 0.5) / columns - 1,
            2 * (turn * _FINE_TURNS + 0.5) / rows - 1,
        ]
        grid = torch.stack(place, -1)[None, None]
        values = functional.grid_sample(
            around[None], grid, padding_mode="border", align_corners=False
        )
        return values[0, :, 0].T


def _blur(image: Tensor, sigma: float, axis: int, mode: str) -> Tensor:
    """Gaussian blur of [1, C, H, W] along axis 2 or 3."""
    reach = int(2.5 * sigma)
    line = torch.arange(-reach, reach + 1, device=image.device).float()
    kernel = torch.exp(-0.5 * (line / sigma) ** 2)
    kernel = (kernel / kernel.sum()).reshape([1, 1, -1, 1] if axis == 2 else [1, 1, 1, -1])
    pad = (0, 0, reach, reach) if axis == 2 else (reach, reach, 0, 0)
    padded = functional.pad(image, pad, mode=mode).movedim(1, 0)
    return functional.conv2d(padded, kernel).movedim(0, 1)


def _pixel_of(placed: PlacedPhoto, place: np.ndarray) -> tuple[float, float]:
    """Pixel index (continuous, centres at whole numbers) of a place in the cut's plane."""
    first, last = placed.local[0, 0, :2], placed.local[-1, -1, :2]
    count = np.array(placed.mask.shape) - 1.0
    found = (place - first) / np.where(last == first, 1.0, last - first) * count
    return float(found[0]), float(found[1])
