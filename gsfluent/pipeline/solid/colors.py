"""Colours of an object's skin, from the splats that show on it and not from those that float."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import INTERIOR, SURFACE, Gaussians, Solid
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.geometry import rgb_to_sh0
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.tsdf import ring_of_cameras
from gsfluent.spatial.neighbours import nearest_rows

_NEIGHBOURS = 12
_FAINT = 0.1  # opacity below which a splat is fuzz
_OUTLIER = 0.2  # colour difference at which a splat counts half
_VIEWS = 16
_SIZE = 200  # pixels of the pictures that tell which splats show
_OUT, _IN = 1.5, 3.0  # voxels outside and below the skin that still belong to it
_HIDDEN = 0.02  # share of its size below which a splat says nothing about the skin
_SHOWS = 0.003  # share of its size by which an interior Gaussian shows from outside: it is skin
_REACH = 2.0  # voxels; farther from every splat, a wider surrounding gives the colour
_CHUNK = 8192  # points that are given such a surrounding at a time


def surface_colors(
    gaussians: Gaussians,
    points: np.ndarray,
    width: float,
    *,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """Colours of the surface around given points.

    The twelve nearest surface splats count with their opacity and a Gaussian of the distance;
    splats whose colour is unlike the others' count less (two steps of reweighting, Cauchy), so that
    a single odd one does not paint a spot. Where the nearest splat is far away, as on a side that
    nobody photographed, the average widens with the distance.

    Args:
        gaussians: Splats; with labels, only the SURFACE ones are used.
        points: [M, 3] world units, near the surface.
        width: Standard deviation of the averaging, world units (a voxel is usual).
        weights: How much each splat counts instead of its opacity, [N]; zero leaves it out.

    Returns:
        Colours float32 [M, 3] in 0..1.

    Raises:
        InputError: There are no surface splats.
    """
    where = torch.from_numpy(np.asarray(points, dtype=np.float64)).to(gaussians.device)
    found = surface_colors_at(gaussians, where, width, weights=weights)
    return np.asarray(found.to(torch.float32).cpu().numpy())


@torch.no_grad()
def surface_colors_at(
    gaussians: Gaussians, points: Tensor, width: float, *, weights: np.ndarray | None = None
) -> Tensor:
    """:func:`surface_colors` on the device of the splats.

    ``points`` and the colours are float64 [M, 3].
    """
    device = gaussians.device
    if gaussians.labels is None:
        rows = torch.arange(gaussians.count, device=device)
    else:
        rows = (gaussians.labels == SURFACE).nonzero()[:, 0]
    if len(rows) == 0:
        raise InputError("no surface Gaussians: labels hold none", hint="run fill on a splat first")
    if weights is None:
        weight = gaussians.opacities.double()[rows]
    else:
        weight = torch.from_numpy(np.asarray(weights, dtype=np.float64)).to(device)[rows]
    solid = weight > (_FAINT if weights is None else 0.0)
    if int(solid.sum()) >= min(_NEIGHBOURS, len(rows)):
        rows, weight = rows[solid], weight[solid]
    means = gaussians.means[rows].double()
    colors = gaussians.colors().double()[rows].clamp(0.0, 1.0)
    if len(points) == 0:
        return points.new_zeros(0, 3)
    count = min(_NEIGHBOURS, len(rows))
    parts, far = [], []
    for some in points.split(16 * _CHUNK):
        distance, rank = nearest_rows(means, some, count, width)
        parts.append(_robust_mean(distance, rank, weight, colors, width))
        far.append(distance[:, 0] > _REACH * width)
    result = torch.cat(parts)
    away = torch.cat(far).nonzero()[:, 0]
    if len(rows) > count:
        # from every direction at about the same distance, or the nearest rim would draw rays
        wide = min(16 * _NEIGHBOURS, len(rows))
        for part in away.split(_CHUNK) if len(away) else ():  # 10 kB a point
            distance, rank = nearest_rows(means, points[part], wide, 4.0 * width)
            spread = 0.35 * distance[:, :1] + width
            result[part] = _robust_mean(distance, rank, weight, colors, spread)
    return result


def _robust_mean(
    distance: Tensor, rank: Tensor, weight: Tensor, colors: Tensor, width: float | Tensor
) -> Tensor:
    """Weighted mean colours [M, 3] of neighbours [M, K], odd ones counting less."""
    # relative to the nearest one, so that points farther away still get a defined colour
    spread = (distance - distance[:, :1]) / width
    share = (weight[rank] + 1e-6) * torch.exp(-0.5 * spread.square())
    color = colors[rank]

    def mean(parts: Tensor) -> Tensor:
        # one operation at a time: a matrix product may round by the shape of its batch
        return (parts[..., None] * color).sum(dim=1) / parts.sum(dim=1, keepdim=True)

    found = mean(share)
    for _ in range(2):
        odd = (color - found[:, None]).square().sum(dim=2)
        found = mean(share / (1.0 + odd / _OUTLIER**2))
    return found


@torch.no_grad()
def outer_weights(gaussians: Gaussians) -> np.ndarray:
    """How much of each splat shows from outside, as a share of its own size.

    Pictures from 16 directions around the object; a splat buried under others has 0, whatever its
    opacity.

    Args:
        gaussians: Everything that hides something.

    Returns:
        Weights in 0..1, float64 [N].
    """
    if gaussians.count == 0:
        return np.zeros(0)
    ranked = gaussians.means.double().sort(dim=0).values
    low, high = ranked[gaussians.count // 100], ranked[-1 - gaussians.count // 100]
    middle, radius = 0.5 * (low + high), 0.55 * float((high - low).norm())
    best = torch.zeros(gaussians.count, dtype=torch.float64, device=gaussians.device)
    flat = torch.zeros_like(gaussians.means[:, :1])
    # the smaller two scales: a disc seen edge on still counts fully
    scale = gaussians.scales.sort(dim=1).values
    size = scale[:, 0] * scale[:, 1]
    for near in ring_of_cameras(middle, max(radius, 1e-9), _VIEWS):
        camera = near.resized(_SIZE, _SIZE)
        shown = draw(gaussians, camera, colors=flat, contribution=True).contribution
        assert shown is not None
        focal = float(camera.K[0, 0])
        view = camera.viewmat.to(gaussians.means)
        z = (gaussians.means @ view[2, :3] + view[2, 3]).clamp_min(1e-9)
        area = size * (focal / z) ** 2 + 0.3
        best = torch.maximum(best, (shown / (2.0 * np.pi * area)).double())
    result: np.ndarray = best.clamp(0.0, 1.0).cpu().numpy()
    return result


def stray_splats(solid: Solid) -> np.ndarray:
    """Surface splats that hang in the air or lie deep inside: they say nothing about the skin.

    Args:
        solid: A filled object.

    Returns:
        bool [N]: SURFACE splats more than 1.5 voxels outside the solid or 3 voxels below its skin.
    """
    labels = solid.gaussians.labels
    assert labels is not None  # Solid checks it; narrows the type
    field = SignedDistance.of_solid(solid)
    distance = (field.at(solid.gaussians.means.cpu().float()) / solid.voxel).numpy()
    stray: np.ndarray = (distance > _OUT) | (distance < -_IN)
    result: np.ndarray = stray & (labels == SURFACE).cpu().numpy()
    return result


def skin_colors(
    solid: Solid, points: np.ndarray, *, weights: np.ndarray | None = None
) -> np.ndarray:
    """Colours of the skin of a solid: from splats that lie on it and show.

    Args:
        solid: A filled object.
        points: [M, 3] world units, near its surface.
        weights: From :func:`skin_weights`, when there are several calls.

    Returns:
        Colours float32 [M, 3] in 0..1.

    Raises:
        InputError: There are no surface splats.
    """
    weights = skin_weights(solid) if weights is None else weights
    return surface_colors(solid.gaussians, points, solid.voxel, weights=weights)


def skin_weights(solid: Solid, shown: np.ndarray | None = None) -> np.ndarray:
    """How much each splat of a solid says about the colour of its skin, float64 [N].

    Args:
        solid: A filled object.
        shown: :func:`outer_weights` of its Gaussians, where they are known.
    """
    weight = outer_weights(solid.gaussians) if shown is None else shown.copy()
    weight[stray_splats(solid)] = 0.0
    weight[weight < _HIDDEN] = 0.0
    return weight


def keep_skin(solid: Solid, colored: Gaussians) -> Gaussians:
    """Give interior Gaussians that show from outside the colour of the skin.

    Trained skins let a few percent of light through. Seen from outside, matter close below shows
    through them; in the colour of the inside it would stain the skin.

    Args:
        solid: A filled object.
        colored: Its Gaussians after texturing.

    Returns:
        The Gaussians; colours fade from the skin's, where three thousandths of the size show, to
        their own, where nothing does.
    """
    if colored.labels is None or not bool((colored.labels == INTERIOR).any()):
        return colored
    shown = outer_weights(colored)
    share = torch.from_numpy(shown).to(colored.means) / _SHOWS
    share = torch.where(colored.labels == INTERIOR, share.clamp(max=1.0), 0.0)
    rows = (share > 0.05).nonzero()[:, 0]
    weights = skin_weights(solid.replace(gaussians=colored), shown)
    points = colored.means[rows].double().cpu().numpy()
    skin = surface_colors(colored, points, solid.voxel, weights=weights)
    part = share[rows, None]
    mixed = (1.0 - part) * colored.colors()[rows] + part * torch.from_numpy(skin).to(part)
    sh = colored.sh.clone()
    sh[rows] = 0.0
    sh[rows, 0] = rgb_to_sh0(mixed)
    return colored.replace(sh=sh)
