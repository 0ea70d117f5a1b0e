"""Where reconstruction starts: on the visual hull of the masks, or at the sparse points."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.data import Capture, Gaussians
from gsfluent.errors import InputError
from gsfluent.geometry import matrix_to_quaternion
from gsfluent.pipeline.capture.hull import Hull, focus_point
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.pipeline.reconstruct.recipe import QUICK, Recipe

_log = logging.getLogger(__name__)

_FLATNESS = 0.35  # thickness of a starting disc over its radius


def hull_gaussians(
    hull: Hull, views: list[TrainView], count: int, degree: int, generator: torch.Generator
) -> Gaussians:
    """Flat Gaussians on the surface of the hull, coloured by the views that face them.

    Args:
        hull: The hull.
        views: Views to take colours from.
        count: How many.
        degree: SH degree of the result.
        generator: Draws the cells (CPU).

    Returns:
        ``count`` Gaussians: discs along the surface, opacity 0.6.
    """
    solid = functional.pad(hull.occupancy[None, None].float(), (1,) * 6)[0, 0]
    neighbours = functional.avg_pool3d(solid[None, None], 3, 1)[0, 0]
    cells = (hull.occupancy & (neighbours < 0.999)).nonzero()
    pick = torch.randint(len(cells), (count,), generator=generator).to(cells.device)
    jitter = (torch.rand(count, 3, generator=generator) - 0.5).to(cells.device)
    means = hull.centers(cells[pick] + jitter)
    normal = _outward(hull)[tuple(cells[pick].T)]
    # About 1.5 boundary cells meet each voxel-sized patch of a smooth surface.
    area = len(cells) * hull.voxel**2 / 1.5
    radius = math.sqrt(area / count)
    scales = means.new_tensor([radius, radius, radius * _FLATNESS]).expand(count, 3).contiguous()
    color = _facing_colors(means, normal, views)
    gaussians = Gaussians.from_colors(
        means, scales * 0.8, color, opacities=0.6, quats=_quats_of(normal)
    )
    return gaussians.with_sh_degree(degree)


def joined_start(hull: Hull, sampled: Gaussians, found: Gaussians) -> Gaussians:
    """Gaussians found earlier, where the hull allows them, and samples of the hull between them.

    The hull closes every hollow that no silhouette shows; what was found there knows better.
    """
    from scipy.spatial import cKDTree

    inside = found.select(hull.contains(found.means, slack=1) & (found.opacities > 0.1))
    if inside.count == 0:
        return sampled
    gap, _ = cKDTree(inside.means.cpu().numpy()).query(sampled.means.cpu().numpy())
    free = torch.from_numpy(gap).to(sampled.means) > 2.0 * sampled.scales.amax(1)
    return Gaussians.cat([inside.replace(labels=None), sampled.select(free)])


def _outward(hull: Hull) -> Tensor:
    """Outward normals from the blurred occupancy, [X, Y, Z, 3]."""
    soft = hull.occupancy[None, None].float()
    for _ in range(3):
        soft = functional.avg_pool3d(soft, 3, 1, 1)
    field = soft[0, 0]
    slopes = torch.gradient(field)
    return -functional.normalize(torch.stack(list(slopes), -1), dim=-1)


def _quats_of(normal: Tensor) -> Tensor:
    """Quaternions whose z axis is ``normal``, [N, 4]."""
    helper = torch.zeros_like(normal)
    helper.scatter_(1, normal.abs().argmin(1, keepdim=True), 1.0)
    first = functional.normalize(torch.linalg.cross(helper, normal), dim=1)
    second = torch.linalg.cross(normal, first)
    return matrix_to_quaternion(torch.stack([first, second, normal], -1)).to(normal)


def _facing_colors(points: Tensor, normal: Tensor, views: list[TrainView]) -> Tensor:
    """Mean colour seen at surface points [N, 3] by the views that face them, weighted by cos^4."""
    total, weight = torch.zeros_like(points), points.new_full((len(points), 1), 1e-6)
    mean = torch.stack([view.color.mean((0, 1)) for view in views]).mean(0)
    total += 1e-6 * mean
    for view in views:
        row, column, on, _ = view.locate(points)
        eye = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        facing = (functional.normalize(eye - points, dim=1) * normal).sum(1).clamp_min(0.0)
        trust = on.float() * facing**4
        if view.mask is not None:
            trust = trust * (view.mask[row, column] > 0.98)
        total += trust[:, None] * view.color[row, column]
        weight += trust[:, None]
    return (total / weight).clamp(0.0, 1.0)


def point_gaussians(
    capture: Capture,
    views: list[TrainView],
    count: int,
    degree: int,
    generator: torch.Generator,
    recipe: Recipe = QUICK,
) -> tuple[Gaussians, float]:
    """Round Gaussians at the sparse points, filtered to the scene, and a far shell behind it.

    Points farther from the focus than eight times the median camera distance, and points whose
    neighbours are ten times farther than usual, are dropped as triangulation errors.

    Args:
        capture: Whose points.
        views: Its photographs, for the colours of the shell.
        count: How many points at most.
        degree: SH degree of the result.
        generator: Draws points and shell (CPU).
        recipe: Says their opacity and size, and whether there is a shell.

    Returns:
        The Gaussians and the scene's extent [world units]: the median
        distance of the cameras from what they look at.

    Raises:
        InputError: Too few points are left.
    """
    from scipy.spatial import cKDTree

    device = views[0].color.device
    viewmats = torch.stack([view.viewmat for view in views]).cpu()
    middle = focus_point(viewmats)
    centers = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[..., 0]
    extent = float((centers.double() - middle).norm(dim=1).median())
    near = (capture.points.cpu().double() - middle).norm(dim=1) < 8.0 * extent
    points, colors = capture.points.cpu()[near].float(), capture.point_colors.cpu()[near].float()
    spacing = torch.empty(0)
    if len(points) >= 8:
        distance, _ = cKDTree(points.numpy()).query(points.numpy(), k=4)
        spacing = torch.from_numpy(distance[:, 1:].mean(1)).float()
        kept = (spacing < 10.0 * spacing.median()) & (spacing > 0)
        points, colors, spacing = points[kept], colors[kept], spacing[kept]
    if len(points) < 50:
        raise InputError(
            f"reconstruct: there are no masks, and only {len(points)} usable sparse points",
            "give masks (masks/ or an alpha channel), or a COLMAP model with its points",
        )
    if len(points) > count:
        pick = torch.randperm(len(points), generator=generator)[:count]
        spacing = spacing[pick] * math.sqrt(len(points) / count)
        points, colors = points[pick], colors[pick]
    scales = spacing.clamp_max(0.1 * extent) * recipe.start_scale
    if recipe.shell:
        shell, shell_color, shell_size = _far_shell(views, middle.float(), extent, generator)
        points, colors = torch.cat([points, shell]), torch.cat([colors, shell_color])
        scales = torch.cat([scales, shell_size])
    gaussians = Gaussians.from_colors(
        points.to(device), scales.to(device), colors.to(device), opacities=recipe.start_opacity
    )
    return gaussians.with_sh_degree(degree), extent


def _far_shell(
    views: list[TrainView], middle: Tensor, extent: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Large soft Gaussians on a sphere around the scene, coloured by the photographs that see them.

    Where structure from motion found nothing (a plain wall), something has to carry the background.
    """
    count, radius = 1200, 4.0 * extent
    direction = torch.randn(count, 3, generator=generator)
    direction = functional.normalize(direction, dim=1)
    points = middle + radius * direction
    device = views[0].color.device
    seen = torch.zeros(count, dtype=torch.bool, device=device)
    placed = points.to(device)
    for view in views:
        seen |= view.locate(placed)[2]
    color = _facing_colors(placed, -direction.to(device), views).cpu()
    kept = seen.cpu()
    size = torch.full((count,), radius * math.sqrt(4.0 * math.pi / count))
    return points[kept], color[kept], size[kept]
