"""Cut views: a solid sliced open and looked at, for ``interior.png`` and for eyes."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent._lazy import ndimage
from gsfluent.data import SURFACE, Camera, Solid
from gsfluent.draw import draw
from gsfluent.io import save_image
from gsfluent.pipeline.solid.colors import skin_colors, skin_weights
from gsfluent.spatial.voxels import distance_transform, nearest_empty

_GREY = 0.55  # of matter without colour
_SMOOTH = 3.0  # voxels; whole voxels seen at their own size are stairs and terraces
_MOST = 1.0  # voxels by which smoothing may move the outline
_SHEET = 0.005  # share of the matter; thin parts larger than this are walls, smaller ones fuzz
_WALL = 0.1  # voxels by which smoothing may move the outline of a wall
_HIT = 0.02  # voxels
_STEPS = 160
_FAR = 60.0  # object sizes to the camera that draws the splats: nearly parallel rays
_LIGHT = (-0.45, 0.65, -0.62)  # right, up, forward: over the viewer's left shoulder
_AMBIENT = 0.5
_BEHIND = 0.82  # of the skin beside the cut face, so that the face stands out


@dataclass(frozen=True)
class _Eye:
    """Parallel projection: pixel (row, column) looks along ``forward``."""

    middle: np.ndarray
    right: np.ndarray
    up: np.ndarray
    forward: np.ndarray
    pixel: float
    width: int
    height: int

    def rays(self) -> Tensor:
        """Points [H * W, 3] of the plane through ``middle`` that the pixels lie on."""
        u = (torch.arange(self.width, dtype=torch.float64) + 0.5 - 0.5 * self.width) * self.pixel
        v = (0.5 * self.height - 0.5 - torch.arange(self.height, dtype=torch.float64)) * self.pixel
        plane = v[:, None, None] * torch.from_numpy(self.up) + u[None, :, None] * torch.from_numpy(
            self.right
        )
        return (plane + torch.from_numpy(self.middle)).reshape(-1, 3)


def cut_view(
    solid: Solid | CutBody,
    axis: int | str | Sequence[float] | np.ndarray = 0,
    offset: float | None = None,
    size: int = 512,
    *,
    background: float = 1.0,
    up: Sequence[float] | np.ndarray | None = None,
    tilt: float = 0.0,
    splats: bool = True,
) -> np.ndarray:
    """Look at the solid with everything before a cutting plane taken away.

    The outline is that of the solid's surface between its voxels, anti-aliased. The cut face shows
    the interior colour (grey before texturing); what lies behind the plane shows its skin, shaded
    so that the eye reads the shape.

    Args:
        solid: The solid; ``color`` may be None. A :class:`CutBody` when there are several views.
        axis: 0, 1, 2 or "x", "y", "z", the axis the cut is perpendicular to; or the plane's normal
            [3], which points into the matter that is left, in the solid's own frame.
        offset: Position of the plane along the normal, world units; None cuts through the middle of
            the matter.
        size: Longest side of the image [pixels].
        background: Grey value of the ground.
        up: What is up in the picture when ``axis`` is a normal, [3]; +z when None.
        tilt: Angle [degrees] by which the viewer stands above the normal of the plane, below 80.
        splats: Draw the skin behind the plane with the splats themselves; False takes averaged
            colours.

    Returns:
        Image float32 [H, W, 3] in 0..1. For a named axis the first remaining axis runs right, the
        second up.

    Raises:
        ValueError: Unknown axis, a size below 16 or a tilt out of range.
    """
    body = solid if isinstance(solid, CutBody) else CutBody(solid)
    view = _view(body, axis, up, offset, size, tilt)
    return _pictures(body, [view], size, background, splats)[0]


def _view(
    body: CutBody,
    axis: int | str | Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray | None,
    offset: float | None,
    size: int,
    tilt: float,
) -> _Trace | None:
    """What :func:`cut_view` is asked for; None of a solid that is empty."""
    normal, right, top = _directions(axis, up)
    if size < 16:
        raise ValueError(f"cut_view: size must be at least 16 pixels, got {size}")
    if not abs(tilt) < 80.0:
        raise ValueError(f"cut_view: tilt must be below 80 degrees, got {tilt}")
    if not len(body.centers):
        return None
    place = body.centers @ normal
    voxel = body.solid.voxel
    half = 0.5 * voxel * np.abs(normal).sum()
    low, high = float(place.min()) - half, float(place.max()) + half
    plane = 0.5 * (low + high) if offset is None else min(max(offset, low), high)
    eye = _eye(body.centers[place >= plane - half], normal, right, top, tilt, size, voxel)
    return _Trace(body, normal, plane, eye)


def _pictures(
    body: CutBody, views: Sequence[_Trace | None], size: int, background: float, splats: bool
) -> list[np.ndarray]:
    """The pictures of some views; their rays run side by side."""
    traces = [view for view in views if view is not None]
    if not traces:
        return [np.full((size, size, 3), background, np.float32) for _ in views]
    first = [view.value(view.start) for view in traces]
    forward = [view.forward.expand_as(view.start) for view in traces]
    rays = torch.cat([view.start for view in traces]), torch.cat(forward), torch.cat(first)
    hit, nearest = (found.split([len(f) for f in first]) for found in _march(body, *rays))
    made = []
    for view, *met in zip(traces, first, hit, nearest, strict=True):
        image, covered = view.shaded(splats, *met)
        image = image * covered[..., None] + background * (1.0 - covered[..., None])
        image = image.reshape(view.eye.height, view.eye.width, 3)
        made.append(image.numpy().clip(0.0, 1.0).astype(np.float32))
    return made


def _directions(
    axis: int | str | Sequence[float] | np.ndarray, up: Sequence[float] | np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal of the plane, right and up of the picture, unit vectors [3]."""
    names: dict[object, int] = {"x": 0, "y": 1, "z": 2, 0: 0, 1: 1, 2: 2}
    if isinstance(axis, str | int):
        if axis not in names:
            raise ValueError(f"cut_view: axis must be 0, 1, 2 or x, y, z, got {axis!r}")
        first = names[axis]
        others = [i for i in range(3) if i != first]
        unit = np.eye(3)
        return unit[first], unit[others[0]], unit[others[1]]
    normal = np.asarray(axis, dtype=float).reshape(-1)
    length = float(np.linalg.norm(normal))
    if normal.shape != (3,) or not (math.isfinite(length) and length > 0):
        raise ValueError(f"cut_view: axis must be a vector of three numbers, got {axis!r}")
    normal = normal / length
    top = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, dtype=float)
    top = top - (top @ normal) * normal
    if np.linalg.norm(top) < 1e-6:
        top = np.eye(3)[int(np.abs(normal).argmin())]
        top = top - (top @ normal) * normal
    top = top / np.linalg.norm(top)
    return normal, np.cross(normal, top), top


def _eye(
    points: np.ndarray,
    normal: np.ndarray,
    right: np.ndarray,
    top: np.ndarray,
    tilt: float,
    size: int,
    voxel: float,
) -> _Eye:
    """A picture that just holds the points, with a border of two voxels."""
    angle = math.radians(tilt)
    forward = math.cos(angle) * normal - math.sin(angle) * top
    above = math.cos(angle) * top + math.sin(angle) * normal
    across, along = points @ right, points @ above
    border = 2.5 * voxel
    wide = float(np.ptp(across)) + 2.0 * border
    tall = float(np.ptp(along)) + 2.0 * border
    pixel = max(wide, tall) / size
    middle = (
        0.5 * (across.min() + across.max()) * right
        + 0.5 * (along.min() + along.max()) * above
        + (points @ forward).mean() * forward
    )
    count = (max(2, round(wide / pixel)), max(2, round(tall / pixel)))
    return _Eye(middle, right, above, forward, pixel, *count)


@dataclass(frozen=True)
class CutBody:
    """A solid of which several views are asked for, with what they share."""

    solid: Solid

    @functools.cached_property
    def field(self) -> Tensor:
        """Signed distance [voxels] without the stairs of voxels, float32 [X, Y, Z]."""
        return _smooth_field(self.solid.occupancy.cpu().numpy())

    @functools.cached_property
    def matter(self) -> Tensor:
        """Colours, continued outward, float32 [1, 3, X, Y, Z]."""
        return _spread(self.solid)

    @functools.cached_property
    def weights(self) -> np.ndarray:
        """How much each splat shows, [N]."""
        return skin_weights(self.solid)

    @functools.cached_property
    def centers(self) -> np.ndarray:
        """Centres of the occupied voxels [world units], float64 [M, 3]."""
        found: np.ndarray = self.solid.voxel_centers().double().cpu().numpy()
        return found


class _Trace:
    """One picture: rays against the solid's surface and the plane."""

    def __init__(self, body: CutBody, normal: np.ndarray, plane: float, eye: _Eye) -> None:
        self.body, self.eye, self.plane = body, eye, plane
        self.solid = solid = body.solid
        self.normal = torch.from_numpy(normal)
        self.field = body.field
        self.origin = solid.origin.cpu().double()
        self.start = eye.rays()
        self.forward = torch.from_numpy(eye.forward)
        # everything before the plane is gone, so every ray begins on it
        slope = float(self.normal @ self.forward)
        along = (plane - self.start @ self.normal) / slope
        self.start = self.start + along[:, None] * self.forward
        self.pixel = eye.pixel / solid.voxel

    def value(self, points: Tensor) -> Tensor:
        """Signed distance [voxels] at world points [N, 3]."""
        return _at(self.field, (points - self.origin) / self.solid.voxel)

    def shaded(
        self, splats: bool, first: Tensor, hit: Tensor, nearest: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Colours [N, 3] and coverage [N] of all pixels.

        Args:
            splats: As for :func:`cut_view`.
            first: Signed distance [voxels] where each ray begins, [N].
            hit: See :func:`_march`.
            nearest: See there.
        """
        # by its slope in the picture: a plane that grazes the surface has no half covered pixels
        rows, columns = np.gradient(first.view(self.eye.height, self.eye.width).numpy())
        slope = torch.from_numpy(np.hypot(rows, columns)).reshape(-1).clamp_min(1e-3 * self.pixel)
        face = (0.5 - first / slope).clamp(0.0, 1.0)
        skin = (0.5 - nearest / self.pixel).clamp(0.0, 1.0)
        skin = torch.where(hit >= 0, torch.ones_like(skin), skin)
        covered = torch.maximum(face, skin)
        image = torch.zeros(len(face), 3)
        rows = (face > 0).nonzero()[:, 0]
        image[rows] = self._face_colors(self.start[rows])
        # beside the face, and under its rim
        rows = ((face < 1) & (covered > 0)).nonzero()[:, 0]
        if len(rows):
            points = self.start[rows] + hit[rows].clamp_min(0.0)[:, None] * self.forward
            beside = self._skin(points, rows, splats)
            share = face[rows][:, None]
            image[rows] = torch.where(
                hit[rows, None] >= 0, share * image[rows] + (1.0 - share) * beside, beside
            )
            only = (hit[rows] < 0) & (face[rows] > 0)
            image[rows[only]] = self._face_colors(self.start[rows[only]])
        return image, covered

    def _face_colors(self, points: Tensor) -> Tensor:
        """Colours of the matter at points [N, 3] of the plane."""
        if self.solid.color is None:
            return torch.full((len(points), 3), _GREY)
        place = (points - self.origin) / self.solid.voxel
        size = torch.tensor(self.field.shape)
        where = (2.0 * place / size - 1.0).flip(-1).float()[None, None, None]
        found = functional.grid_sample(
            self.body.matter, where, padding_mode="border", align_corners=False
        )
        return found[0, :, 0, 0].T

    def _skin(self, points: Tensor, rows: Tensor, splats: bool) -> Tensor:
        """Shaded colours of the skin at points [N, 3], seen through the pixels ``rows``."""
        weights = self.body.weights
        flat = torch.from_numpy(skin_colors(self.solid, points.numpy(), weights=weights))
        if splats:
            drawn, alpha = self._drawn(weights)
            # thin spots in the splats show what lies beside them, not the ground
            trust = ((alpha[rows] - 0.5) / 0.4).clamp(0.0, 1.0)[:, None]
            shown = drawn[rows] / alpha[rows].clamp_min(1e-3)[:, None]
            flat = trust * shown.clamp(0.0, 1.0) + (1.0 - trust) * flat
        step = 0.75 * self.solid.voxel
        unit = torch.eye(3, dtype=torch.float64) * step
        slope = torch.stack(
            [self.value(points + unit[i]) - self.value(points - unit[i]) for i in range(3)], 1
        )
        normal = functional.normalize(slope.double(), dim=1)
        eye = self.eye
        light = _LIGHT[0] * eye.right + _LIGHT[1] * eye.up + _LIGHT[2] * eye.forward
        toward = torch.from_numpy(light / np.linalg.norm(light))
        lit = _AMBIENT + (1.0 - _AMBIENT) * (normal @ toward).clamp_min(0.0)
        return flat * (_BEHIND * lit)[:, None].float()

    @torch.no_grad()
    def _drawn(self, weights: np.ndarray) -> tuple[Tensor, Tensor]:
        """The splats of the skin behind the plane: colours [N, 3] before black, coverage [N]."""
        gaussians, eye = self.solid.gaussians, self.eye
        labels = gaussians.labels
        assert labels is not None  # Solid checks it; narrows the type
        behind = (gaussians.means.double().cpu() @ self.normal) > self.plane
        kept = (labels.cpu() == SURFACE) & behind & torch.from_numpy(weights > 0)
        if not bool(kept.any()):
            return torch.zeros(len(self.start), 3), torch.zeros(len(self.start))
        extent = max(eye.width, eye.height) * eye.pixel
        far = _FAR * extent
        position = eye.middle - far * eye.forward
        # a mirrored picture (named axes) is drawn unmirrored and flipped
        flip = float(np.cross(eye.forward, eye.up) @ eye.right) < 0
        across = -eye.right if flip else eye.right
        rotation = np.stack([across, -eye.up, eye.forward])
        view = torch.eye(4, dtype=torch.float64)
        view[:3, :3] = torch.from_numpy(rotation)
        view[:3, 3] = torch.from_numpy(-rotation @ position)
        focal = far / eye.pixel
        K = torch.tensor(
            [[focal, 0.0, 0.5 * eye.width], [0.0, focal, 0.5 * eye.height], [0.0, 0.0, 1.0]],
            dtype=torch.float64,
        )
        camera = Camera(view, K, eye.width, eye.height)
        drawn = draw(gaussians.select(kept.to(gaussians.device)), camera, antialiased=True)
        image, alpha = drawn.image.cpu().float(), drawn.alpha.cpu().float()
        if flip:
            image, alpha = image.flip(1), alpha.flip(1)
        return image.reshape(-1, 3), alpha.reshape(-1)


def _march(body: CutBody, start: Tensor, forward: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """How far rays run to the skin [world units], -1 for a miss; least distance met [voxels].

    Args:
        body: What they meet.
        start: Where they begin, float64 [N, 3].
        forward: Unit vectors, float64 [N, 3].
        first: Signed distance [voxels] where they begin, [N].
    """
    voxel, device = body.solid.voxel, body.solid.occupancy.device
    field, origin, first = (
        x.to(device) for x in (body.field, body.solid.origin.cpu().double(), first)
    )
    hit = torch.full_like(first, -1.0, dtype=torch.float64)
    nearest = first.clamp_min(0.0).clone()
    # those on the face have arrived
    live = (first > _HIT).nonzero()[:, 0]
    hit[first <= _HIT] = 0.0
    start, forward = start.to(device)[live], forward.to(device)[live]
    gone = torch.zeros(len(live), dtype=torch.float64, device=device)
    reach = float(np.linalg.norm(field.shape)) * voxel
    value = first[live]
    for _ in range(_STEPS):
        if not len(live):
            break
        # a trilinear, smoothed field overstates distances a little
        gone = gone + (0.8 * value.clamp_min(0.1)).double() * voxel
        value = _at(field, (start + gone[:, None] * forward - origin) / voxel)
        nearest[live] = torch.minimum(nearest[live], value)
        arrived = value <= _HIT
        hit[live] = torch.where(arrived, gone, -1.0)
        kept = (~arrived & (gone < reach)).nonzero()[:, 0]
        live, start, forward, gone, value = (x[kept] for x in (live, start, forward, gone, value))
    return hit.cpu(), nearest.cpu()


def _smooth_field(occupied: np.ndarray) -> Tensor:
    """Signed distance [voxels], negative inside, without the stairs and hairs of voxels."""
    outer = np.maximum(distance_transform(~occupied) - 0.5, 0.0)
    inner = np.maximum(distance_transform(occupied) - 0.5, 0.0)
    signed = outer - inner
    soft = ndimage.gaussian_filter(signed, _SMOOTH, mode="nearest")
    field = np.clip(soft, signed - _MOST, signed + _MOST)
    # what smoothing takes away altogether is fuzz, unless there is much of it in one piece: a wall
    reach = ndimage.binary_dilation(field <= 0, iterations=2)
    label, count = ndimage.label(occupied & ~reach, np.ones((3, 3, 3)))
    if count:
        large = np.bincount(label.ravel()) >= max(32.0, _SHEET * occupied.sum())
        large[0] = False
        wall = ndimage.binary_dilation(large[label], iterations=3)
        field = np.where(wall, np.clip(soft, signed - _WALL, signed + _WALL), field)
        crumb = ndimage.binary_dilation((label > 0) & ~large[label]) & ~wall
        field = np.where(crumb, np.maximum(field, 0.5), field)
    return torch.from_numpy(field.astype(np.float32))


def _spread(solid: Solid) -> Tensor:
    """Colours of the matter, continued outward by the nearest, float32 [1, 3, X, Y, Z]."""
    assert solid.color is not None
    occupied = solid.occupancy.cpu().numpy()
    nearest = nearest_empty(~occupied)[1]
    color = solid.color.float().cpu().numpy()[tuple(nearest)]
    return torch.from_numpy(color).permute(3, 0, 1, 2)[None].contiguous()


def _at(field: Tensor, place: Tensor) -> Tensor:
    """Trilinear values [N] at positions [N, 3] in voxels; distance is added off the grid."""
    size = _size(field.shape, place.dtype, place.device)
    held = torch.minimum(place.clamp_min(0.5), size - 0.5)
    where = (2.0 * held / size - 1.0).flip(-1).to(field)[None, None, None]
    value = functional.grid_sample(
        field[None, None], where, padding_mode="border", align_corners=False
    )
    return value[0, 0, 0, 0] + (place - held).norm(dim=1).to(field)


@functools.lru_cache(maxsize=8)
def _size(shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(shape, dtype=dtype, device=device)


_HEIGHT, _GAP, _GROUND = 360, 12, 0.96  # of the sheet: pixels, pixels, grey
_TILT = 25.0  # degrees that the viewer of the last cut stands above it


def save_cut_views(solid: Solid, path: Path) -> None:
    """Write four cuts through the middle side by side: across x, y, z (from above), and aslant.

    The axes are those of the scene where the solid has a frame, else its own.

    Raises:
        RunError: The disk is full.
    """
    body = CutBody(solid)
    turn = np.eye(3) if solid.frame is None else solid.frame.rotation.numpy()
    x, y, z = turn  # scene axes in the solid's own frame
    aslant = 0.8 * x + 0.6 * y
    asked = [(x, z, 0.0), (y, z, 0.0), (-z, y, 0.0), (aslant, z, _TILT)]
    looks = [_view(body, axis, up, None, _HEIGHT, tilt) for axis, up, tilt in asked]
    views = _pictures(body, looks, _HEIGHT, _GROUND, splats=True)
    height = max(view.shape[0] for view in views) + 2 * _GAP
    width = sum(view.shape[1] for view in views) + _GAP * (len(views) + 1)
    sheet = np.full((height, width, 3), _GROUND, np.float32)
    left = _GAP
    for view in views:
        top = (height - view.shape[0]) // 2
        sheet[top : top + view.shape[0], left : left + view.shape[1]] = view
        left += view.shape[1] + _GAP
    save_image(torch.from_numpy(sheet), path)
