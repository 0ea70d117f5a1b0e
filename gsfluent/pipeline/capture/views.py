"""Photographs made ready for training: read once, cropped to the object, kept at two sizes."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from gsfluent.data import Camera, Capture
from gsfluent.errors import InputError

_log = logging.getLogger(__name__)

_MARGIN = 8  # pixels kept around a mask; more than half an SSIM window
_SHORTEST = 12  # pixels; an SSIM window must fit
_SMALLEST = 24  # pixels; a side of a crop is never shorter


@dataclass(frozen=True)
class TrainView:
    """One photograph, or the part of it that shows the object."""

    color: Tensor  # colour times validity (times the mask once cropped), float32 [H, W, 3]
    mask: Tensor | None  # coverage of the object in [0, 1], [H, W]; None without masks
    valid: Tensor | None  # 1 where the photograph covers the pixel, [H, W]; None when everywhere
    viewmat: Tensor  # world to camera [4, 4], float32
    K: Tensor  # intrinsics of this crop [3, 3], float32
    full_width: int  # width of the uncropped photograph at this size [px]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return int(self.color.shape[1]), int(self.color.shape[0])

    def locate(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rows and columns of the pixels that show points [N, 3], kept within the picture.

        Returns:
            Row and column, int64 [N]; whether the point lies in the picture, bool [N]; depth [N].
        """
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = local[:, 2]
        pixel = (local @ self.K.T)[:, :2] / depth.clamp_min(1e-6)[:, None]
        width, height = self.size
        column, row = pixel.floor().long().unbind(1)
        on = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return row.clamp(0, height - 1), column.clamp(0, width - 1), on, depth


def read_views(
    capture: Capture, max_size: int, device: torch.device, *, crop: bool
) -> list[TrainView]:
    """Read every photograph of a capture.

    Args:
        capture: Posed photographs.
        max_size: Longer side of the images [px].
        device: Where the tensors go.
        crop: Keep only the surroundings of the mask (where there is one).

    Raises:
        InputError: Photographs are too small or all black, all masks are empty, or only some images
            have masks.
    """
    views, masked, brightest, covered = [], 0, 0.0, 0.0
    for index in range(len(capture)):
        view = capture.view(index, max_size)
        if min(view.image.shape[:2]) < _SHORTEST:
            raise InputError(
                f"reconstruct: {view.camera.name} has {view.camera.width} x {view.camera.height} "
                f"pixels at image_size {max_size}; both sides must be at least {_SHORTEST}",
                "choose a larger image_size, or larger photographs",
            )
        brightest = max(brightest, float(view.image.max()))
        masked += view.mask is not None
        if view.mask is not None:
            covered = max(covered, float(view.mask.max()))
        views.append(view)
    if brightest < 2.0 / 255.0:
        raise InputError(
            f"reconstruct: all {len(views)} photographs of {capture.root} are black",
            "check the exposure, or that the image files are the right ones",
        )
    if masked not in (0, len(views)):
        raise InputError(
            f"reconstruct: {masked} of {len(views)} photographs have masks",
            "give a mask for every photograph, or none",
        )
    if masked and covered < 0.5:
        raise InputError(
            "reconstruct: every mask is empty", "masks are white (or opaque) where the object is"
        )
    prepared = []
    for view in views:
        ready = _prepare(view.image, view.mask, view.valid, view.camera, device)
        if crop and ready.mask is not None:
            if float(ready.mask.max()) <= 0.02:
                _log.info("skipping %s: its mask is empty", view.camera.name)
                continue
            ready = cropped(ready)
        prepared.append(ready)
    return prepared


def cropped(view: TrainView) -> TrainView:
    """The surroundings of the mask (there must be one, not empty), colours multiplied by it."""
    assert view.mask is not None
    left, top, right, bottom = _mask_box(view.mask)
    rows, columns = slice(top, bottom), slice(left, right)
    mask = view.mask[rows, columns].contiguous()
    color = (view.color[rows, columns] * mask[..., None]).contiguous()
    valid = None if view.valid is None else view.valid[rows, columns].contiguous()
    K = view.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    return TrainView(color, mask, valid, view.viewmat, K, view.full_width)


def _mask_box(mask: Tensor) -> tuple[int, int, int, int]:
    """Box (left, top, right, bottom) around the mask with a margin."""
    rows = (mask > 0.02).any(1).nonzero()[:, 0]
    columns = (mask > 0.02).any(0).nonzero()[:, 0]
    box = []
    for line, size in ((columns, mask.shape[1]), (rows, mask.shape[0])):
        low, high = int(line[0]) - _MARGIN, int(line[-1]) + 1 + _MARGIN
        short = max(0, _SMALLEST - (high - low))
        low, high = max(0, low - short), min(size, high + short)
        box.append((low, high))
    return box[0][0], box[1][0], box[0][1], box[1][1]


def _prepare(
    image: Tensor, mask: Tensor | None, valid: Tensor | None, camera: Camera, device: torch.device
) -> TrainView:
    color = image.to(device)
    soft = None if mask is None else mask.to(device)
    share = None if valid is None else valid.float().to(device)
    if share is not None:
        color = color * share[..., None]
        soft = None if soft is None else soft * share
    return TrainView(
        color.contiguous(),
        soft,
        share,
        camera.viewmat.to(device, torch.float32),
        camera.K.to(device, torch.float32),
        camera.width,
    )


def halved(view: TrainView) -> TrainView:
    """The same view at half the size (means of 2 x 2 pixels; an odd last line is cut)."""
    height, width = (side // 2 * 2 for side in view.color.shape[:2])

    def half(value: Tensor) -> Tensor:
        value = value[:height, :width].reshape(height // 2, 2, width // 2, 2, -1)
        return value.mean(dim=(1, 3))

    color = half(view.color)
    K = view.K.clone()
    K[:2] *= 0.5
    mask = None if view.mask is None else half(view.mask[..., None])[..., 0]
    valid = None if view.valid is None else half(view.valid[..., None])[..., 0]
    return TrainView(color, mask, valid, view.viewmat, K, view.full_width // 2)
