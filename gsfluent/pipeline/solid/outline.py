"""How far the skin lies from the centres of its splats: one number, read off the silhouettes.

Trained splats are as thick as the training left them; what one sees of an object reaches beyond
their centres by a length that no rule knows. The outline of the solid has to be the outline in the
masks, or of the splats when drawn, so the solid is grown (or shrunk) by the distance for which it
is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.data import Camera, Capture, Gaussians
from gsfluent.draw import draw
from gsfluent.pipeline.solid.field import SignedDistance

_SIZE = 400  # pixels of the pictures
_CAMERAS = 8  # evenly chosen
_BAND = 8  # pixels on both sides of an outline
_STEP = 1.0  # voxels along a ray
_LEAST, _MOST, _TRIES = -1.0, 2.0, 61  # offsets tried [voxels]; the rim of a field is three wide
_SOLID = 0.5


Outline = tuple[Camera, Tensor]
"""A pinhole camera and where its picture shows the object, bool [H, W]."""


@torch.no_grad()
def drawn_outlines(gaussians: Gaussians, cameras: Sequence[Camera]) -> Iterator[Outline]:
    """Outlines of splats as cameras see them, without the blur of a pixel that widens them.

    Args:
        gaussians: Splats of one object.
        cameras: Pinhole cameras that hold the object in their picture.
    """
    step = max(1, len(cameras) // _CAMERAS)
    for given in cameras[::step]:
        camera = given.scaled(_SIZE / max(given.width, given.height))
        flat = torch.zeros_like(gaussians.means[:, :1])
        alpha = draw(gaussians, camera, colors=flat, antialiased=True).alpha
        yield camera, alpha > _SOLID


def mask_outlines(capture: Capture) -> Iterator[Outline]:
    """Outlines that the masks of a capture show, as photographed."""
    step = max(1, len(capture) // _CAMERAS)
    for index in range(0, len(capture), step):
        view = capture.view(index, _SIZE)
        if view.mask is not None:
            yield view.camera, view.mask > _SOLID


@torch.no_grad()
def match_outline(
    field: SignedDistance, outlines: Iterable[Outline], *, trust: float = 1.0
) -> tuple[SignedDistance, float]:
    """Grow a solid until its outline is the one that was seen.

    A ray meets ``{phi <= c}`` when the smallest distance along it is at most c, so one march per
    pixel serves every c; the c with the fewest pixels on the wrong side is taken. Only pixels near
    an outline are looked at.

    Args:
        field: The solid.
        outlines: Cameras and what they saw.
        trust: Share of the offset that is applied.

    Returns:
        The solid grown by the offset, and the offset [voxels], at most two; 0 without outlines.
    """
    nearest, covered = [], []
    for camera, seen in outlines:
        on = seen.to(field.values)[None, None]
        seen = seen.to(field.values.device)
        grown = functional.max_pool2d(on, 2 * _BAND + 1, 1, _BAND)
        kept = -functional.max_pool2d(-on, 2 * _BAND + 1, 1, _BAND)
        row, column = (grown > kept)[0, 0].nonzero().unbind(1)
        if len(row):
            nearest.append(_nearest_along(field, camera, row, column))
            covered.append(seen[row, column])
    if not nearest:
        return field, 0.0
    distance, inside = torch.cat(nearest) / field.voxel, torch.cat(covered)
    tried = torch.linspace(_LEAST, _MOST, _TRIES)
    wrong = torch.stack([((distance <= float(c)) != inside).sum() for c in tried])
    offset = round(trust * float(tried[int(wrong.argmin())]), 3)
    return field.replace(values=field.values - offset * field.voxel), offset


def _nearest_along(field: SignedDistance, camera: Camera, row: Tensor, column: Tensor) -> Tensor:
    """Smallest signed distance along the rays of some pixels, [N]."""
    like = field.values
    view, K = camera.viewmat.to(like), camera.K.to(like)
    eye = -view[:3, :3].T @ view[:3, 3]
    x = (column + 0.5 - K[0, 2]) / K[0, 0]
    y = (row + 0.5 - K[1, 2]) / K[1, 1]
    ray = torch.stack([x, y, torch.ones_like(x)], 1) @ view[:3, :3]
    size = like.new_tensor(field.values.shape) * field.voxel
    middle = field.origin.to(like) + 0.5 * size
    reach = 0.5 * float(size.norm())
    depth = float((view[:3, :3] @ middle + view[:3, 3])[2])
    count = max(2, int(2.0 * reach / (_STEP * field.voxel)))
    along = torch.linspace(max(depth - reach, 1e-3 * reach), depth + reach, count).to(like)
    best = torch.full_like(x, float("inf"))
    for part in along.split(32 if like.device.type == "cpu" else 256):
        points = eye + ray[:, None] * part[None, :, None]
        place = 2.0 * (points - field.origin.to(like)) / size - 1.0
        value = functional.grid_sample(
            field.values[None, None],
            place.flip(-1)[None, None],
            padding_mode="border",
            align_corners=False,
        )
        outside = (place.abs() > 1.0).any(-1)
        best = torch.minimum(best, torch.where(outside, torch.inf, value[0, 0, 0]).amin(1))
    return best
