"""What stood behind the object when it was photographed, kept behind it while it breaks.

The background splats keep their captured colours, take the shadows that the moving matter casts,
and hide it where they are nearer. Where the object stood nobody saw the table: the hole is covered
by flat splats in the colours around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import BACKGROUND, Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.pipeline.light.shade import arriving, surface_points, to_display, to_linear
from gsfluent.pipeline.light.shadow_maps import Lit

_NEAREST = 24  # splats that colour a covered spot
_COLUMN = 0.9  # of the object's half width: the column whose inside nobody saw
_PATCH = 40  # spots along the diameter of the covered disc
_ALPHA_FLOOR = 1e-4


@dataclass(frozen=True)
class Backdrop:
    """Background splats in the scene frame.

    Attributes:
        gaussians: The splats, captured colours.
        radius: Size of the object [m]; its shadow is a little soft on that scale.
    """

    gaussians: Gaussians
    radius: float

    @torch.no_grad()
    def draw(self, camera: Camera, lit: Lit | None) -> tuple[Tensor, Tensor, Tensor]:
        """Display values times opacity [H, W, 3], opacity [H, W] and median camera z [m] [H, W].

        ``lit`` is the light that the matter leaves; None draws no shadows.
        """
        splats = self.gaussians
        viewmat, intrinsics = camera.viewmat.to(splats.means), camera.K.to(splats.means)
        # Median depth: haze before a surface pulls the mean depth off it.
        near = 1e-3 * max(self.radius, 1e-6)
        seen = draw(splats, camera, median_depth=True, near=near)
        image, alpha, surface = seen.image, seen.alpha, seen.median_depth
        assert surface is not None  # asked for
        if lit is None or lit.maps is None:
            return image, alpha, surface
        points, _ = surface_points(surface, viewmat, intrinsics)
        up = torch.zeros_like(points)
        up[..., 2] = 1.0
        # the captured colour is that of an open place in this light
        open_light = arriving(points, up, lit.lamps, lit.environment, None, None)
        left = arriving(points, up, lit.lamps, lit.environment, None, lit.maps)
        share = left / open_light.clamp(min=_ALPHA_FLOOR)
        cover = alpha[..., None]
        shaded = to_display(to_linear(image / cover.clamp(min=_ALPHA_FLOOR)) * share) * cover
        return torch.where(cover > 0.5, shaded, image), alpha, surface


def no_background() -> InputError:
    """What to raise when a shot asks for a captured backdrop and there is none."""
    return InputError(
        "output.backdrop: captured: nothing but the object is there",
        "masks and isolated splats have no background; use studio",
    )


def covered_floor(background: Gaussians, object_points: Tensor, height: float) -> Gaussians:
    """Cover the hole that the object leaves in what it stood on.

    Nothing is believed of the background in the column where the object stood: no photograph saw
    it. Spots of a disc under the object that no other splat covers get a flat splat, coloured by
    the nearest ones of the plane.

    Args:
        background: Background splats, scene frame.
        object_points: Points of the object [N, 3].
        height: z of the plane [m].

    Returns:
        The background less that column, with the added splats (``BACKGROUND``) at its end;
        unchanged when fewer than two dozen splats lie on the plane around the object.
    """
    from scipy.spatial import cKDTree

    points = object_points.double().cpu().numpy()
    low, high = np.quantile(points[:, :2], [0.01, 0.99], axis=0)
    middle, radius = 0.5 * (low + high), 0.75 * float(np.hypot(*(high - low)))
    if not radius > 0:
        return background
    step = 2.0 * radius / _PATCH
    means = background.means.double().cpu().numpy()
    off_axis = np.hypot(*(means[:, :2] - middle).T)
    column = off_axis < _COLUMN * 0.5 * float((high - low).min())
    column &= (means[:, 2] > height - radius) & (means[:, 2] < points[:, 2].max())
    solid = (background.opacities > 0.2).cpu().numpy()
    near = solid & (np.abs(means[:, 2] - height) < 2.0 * step)
    near &= (off_axis < 3.0 * radius) & ~column
    if int(near.sum()) < _NEAREST:
        return background
    size = background.scales.amax(1).double().cpu().numpy()[near]
    paint = background.colors().double().cpu().numpy()[near]
    background = background.select(torch.from_numpy(~column).to(background.device))
    axis = (np.arange(_PATCH) + 0.5) * step - radius
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) < radius] + middle
    tree = cKDTree(means[near][:, :2])
    distance, index = tree.query(grid, k=_NEAREST)
    open_spot = (distance > np.maximum(step, 1.5 * size[index])).all(axis=1)
    if not open_spot.any():
        return background
    color = paint[index[open_spot]]
    weight = 1.0 / (distance[open_spot] + 0.25 * step) ** 2
    weight /= weight.sum(1, keepdims=True)
    mixed = np.einsum("nk,nkc->nc", weight, color)
    count = int(open_spot.sum())
    # half a splat below the plane, so that the object never sinks into the cover
    place = np.column_stack([grid[open_spot], np.full(count, height - 0.1 * step)])
    patch = Gaussians.from_colors(
        torch.from_numpy(place).to(background.means),
        torch.tensor([0.8 * step, 0.8 * step, 0.08 * step]).repeat(count, 1).to(background.means),
        torch.from_numpy(mixed).to(background.means).clamp(0.0, 1.0),
        opacities=0.95,
        label=BACKGROUND,
    )
    return Gaussians.cat([background, patch])


def object_radius(points: Tensor) -> float:
    """Half the diagonal of the box of points [N, 3], less stray ones [m]."""
    low, high = points.double().quantile(torch.tensor([0.01, 0.99]).to(points).double(), dim=0)
    return 0.5 * math.sqrt(float((high - low).square().sum()))
