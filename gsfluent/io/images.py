"""Photographs and masks: resized, undistorted to a pinhole, with errors that name the file."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.data.camera import Camera
from gsfluent.data.capture import View
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path
from gsfluent.io.checked.pictures import opened_image

if TYPE_CHECKING:
    from PIL import Image

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")

_ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect up to which an image counts as a resized copy."""

_ZOOM_LIMIT = 2.0
"""Most that undistortion may magnify to avoid pixels that no photograph covers."""


def read_array(path: str | Path) -> NDArray[np.float32]:
    """Read an image file as float32 [H, W, C] in 0..1 with C = 1, 3 or 4.

    Raises:
        InputError: The file is missing, truncated, not an image, too large, or holds NaN.
    """
    with _opened(path) as opened:
        opened.load()
        image: Image.Image = opened
        if image.mode.startswith("I") or image.mode == "F":
            deep = np.asarray(image, dtype=np.float32)
            if not np.isfinite(deep).all():
                raise InputError(f"{path}: holds NaN or infinity", "write the picture again")
            top = 65535.0 if image.mode.startswith("I") else 1.0
            return (deep / top).clip(0, 1)[..., None]
        if image.mode == "P" or image.mode == "LA":
            image = image.convert("RGBA")
        elif image.mode == "1":
            image = image.convert("L")
        elif image.mode not in ("L", "RGB", "RGBA"):
            image = image.convert("RGB")
        values = np.asarray(image, dtype=np.float32) / 255.0
    return values[..., None] if values.ndim == 2 else values


def load_image(path: str | Path) -> Tensor:
    """Read an image as float32 [H, W, 3] in 0..1 (alpha dropped, grey repeated).

    Raises:
        InputError: The file is missing, truncated, or not an image.
    """
    values = read_array(path)
    return torch.from_numpy(
        np.ascontiguousarray(
            np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values[..., :3]
        )
    )


def image_size(path: str | Path) -> tuple[int, int]:
    """Read (width, height) from an image's header without decoding it.

    Raises:
        InputError: The file is missing or not an image.
    """
    with _opened(path) as image:
        width, height = image.size
    return int(width), int(height)


def _opened(path: str | Path) -> AbstractContextManager[Image.Image]:
    """An image of a capture."""
    return opened_image(
        path,
        "copy it again as PNG or JPEG, or remove it from the capture",
        missing="restore the file or remove it from the capture",
    )


def save_image(image: Tensor, path: str | Path) -> None:
    """Write [H, W, 3] or [H, W] in 0..1 as an 8-bit image, atomically; the suffix names the format.

    Raises:
        ValueError: The shape is wrong.
        RunError: The disk is full or the folder cannot be written.
    """
    from PIL import Image

    if image.dim() not in (2, 3) or (image.dim() == 3 and image.shape[2] not in (3, 4)):
        raise ValueError(
            f"save_image: image must have shape [H, W, 3] or [H, W], got {list(image.shape)}"
        )
    values = (image.detach().cpu().nan_to_num(0.0).clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    with atomic_path(path) as temporary:
        # of a PNG: 4 % larger or smaller than by level 6, in less than half of its time
        Image.fromarray(values).save(temporary, compress_level=3)


def load_view(camera: Camera, max_size: int | None = None) -> View:
    """Read the photograph (and mask) of a camera as a pinhole view.

    The image is resized so that its longer side is at most ``max_size``, then undistorted. Lens
    distortion is removed about the same principal point, magnified just enough that every pixel is
    covered by the photograph; what a strong lens still leaves uncovered is told by ``valid``.

    Args:
        camera: Posed camera with ``image_path``.
        max_size: Largest side in pixels, or None to keep the file's size.

    Returns:
        The view.

    Raises:
        InputError: The image or mask is missing, damaged, or of another shape than its camera.
        ValueError: ``max_size`` is below 1, or the camera has no image.
    """
    if max_size is not None and max_size < 1:
        raise ValueError(f"load_view: max_size must be at least 1, got {max_size}")
    if camera.image_path is None:
        raise ValueError(f"load_view: camera {camera.name!r} has no image")
    pixels = read_array(camera.image_path)
    mask = pixels[..., 3] if pixels.shape[2] == 4 else None
    image = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]
    if camera.mask_path is not None:
        mask = read_mask(camera.mask_path)
    camera = _fitted(camera, image.shape[1], image.shape[0])
    factor = 1.0 if max_size is None else min(1.0, max_size / max(image.shape[:2]))
    if factor < 1.0:
        camera = camera.scaled(factor)
    image = _resize(image, camera.width, camera.height)
    if mask is not None:
        mask = _resize(mask, camera.width, camera.height)
    valid = None
    if any(camera.distortion):
        pinhole = undistorted(camera)
        image, covered = _remap(image, camera, pinhole)
        if mask is not None:
            mask = _remap(mask, camera, pinhole)[0] * covered
        valid = None if bool(covered.all()) else torch.from_numpy(covered)
        camera = pinhole
    return View(
        torch.from_numpy(np.ascontiguousarray(image.clip(0, 1))),
        None if mask is None else torch.from_numpy(np.ascontiguousarray(mask.clip(0, 1))),
        valid,
        camera.replace(distortion=()) if camera.distortion else camera,
    )


def pinhole_map(
    camera: Camera, labels: NDArray[np.int32], max_size: int | None = None
) -> tuple[Camera, NDArray[np.int32]]:
    """Bring a label map of a photograph to the pinhole view that :func:`load_view` makes of it.

    Args:
        camera: Camera of the photograph.
        labels: Label per pixel of the photograph, or of a resized copy, int32 [H, W].
        max_size: Largest side in pixels, or None to keep the map's size.

    Returns:
        The pinhole camera and the map, nearest neighbour, -1 where the photograph does not reach.
    """
    import cv2

    camera = camera.resized(labels.shape[1], labels.shape[0])
    if max_size is not None:
        camera = camera.scaled(min(1.0, max_size / max(labels.shape)))
    size = (camera.width, camera.height)
    if size != (labels.shape[1], labels.shape[0]):
        # the pixel that holds the centre of the new one (OpenCV's own nearest takes the corner)
        rows = ((np.arange(size[1]) + 0.5) * labels.shape[0] / size[1]).astype(np.int64)
        columns = ((np.arange(size[0]) + 0.5) * labels.shape[1] / size[0]).astype(np.int64)
        labels = labels[rows[:, None], columns[None, :]]
    if any(camera.distortion):
        pinhole = undistorted(camera)
        exact = labels.astype(np.float64)  # OpenCV does not remap int32
        moved, covered = _remap(exact, camera, pinhole, cv2.INTER_NEAREST)
        labels = np.where(covered, moved, -1).astype(np.int32)
        camera = pinhole
    return camera.replace(distortion=()), np.ascontiguousarray(labels)


def undistorted(camera: Camera) -> Camera:
    """Return the pinhole camera that :func:`load_view` resamples ``camera`` to, same size."""
    if not any(camera.distortion):
        return camera.replace(distortion=())
    low, high = 1.0, 1.0
    if not _covers(camera, 1.0):
        high = _ZOOM_LIMIT
        for _ in range(20):  # to 1e-6 of the focal length
            middle = 0.5 * (low + high)
            low, high = (low, middle) if _covers(camera, middle) else (middle, high)
    zoom = camera.K.new_tensor([high, high, 1.0])
    intrinsics = camera.K.clone()
    intrinsics[[0, 1], [0, 1]] *= zoom[:2]
    return camera.replace(K=intrinsics, distortion=())


def _covers(camera: Camera, zoom: float) -> bool:
    """Whether the border of the pinhole image magnified by ``zoom`` falls inside the photograph."""
    width, height = camera.width, camera.height
    along = torch.linspace(0, 1, 65, dtype=torch.float64)
    zero, one = torch.zeros_like(along), torch.ones_like(along)
    border = torch.cat(
        [
            torch.stack(pair, dim=1)
            for pair in ((along, zero), (along, one), (zero, along), (one, along))
        ]
    )
    border = border * torch.tensor([width, height], dtype=torch.float64)
    intrinsics = camera.K.to(torch.float64)
    rays = (border - intrinsics[:2, 2]) / (zoom * intrinsics.diagonal()[:2])
    points = torch.cat([rays, torch.ones(len(rays), 1, dtype=torch.float64)], dim=1)
    pixels, _ = camera.replace(viewmat=torch.eye(4, dtype=torch.float64), K=intrinsics).project(
        points
    )
    limit = torch.tensor([width, height], dtype=torch.float64)
    return bool(((pixels >= 0) & (pixels <= limit)).all())


def _fitted(camera: Camera, width: int, height: int) -> Camera:
    """Adapt a camera to an image file that is a resized copy of the one it was calibrated on."""
    if (width, height) == (camera.width, camera.height):
        return camera
    if abs(width * camera.height / (height * camera.width) - 1) > _ASPECT_TOLERANCE:
        raise InputError(
            f"{camera.image_path}: the image is {width} x {height}, but its camera describes "
            f"{camera.width} x {camera.height}",
            "use the images that were posed, or resized copies of them (not cropped or turned)",
        )
    return camera.resized(width, height)


def read_mask(path: Path) -> NDArray[np.float32]:
    """Read a mask, [H, W]; 1 is object."""
    return mask_of(read_array(path))


def mask_of(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mask of a picture [H, W, K]: its alpha channel if that says anything, else its first."""
    if values.shape[2] == 4 and values[..., 3].min() < 1:
        return values[..., 3]
    return values[..., 0]


def _resize(values: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    if values.shape[1] == width and values.shape[0] == height:
        return values
    import cv2

    shrinks = width <= values.shape[1]
    return cv2.resize(
        values, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )


def _remap(
    values: NDArray[Any], camera: Camera, pinhole: Camera, interpolation: int | None = None
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Resample to the pinhole image; also tell which pixels the photograph covers."""
    import cv2

    def opencv(intrinsics: Tensor) -> NDArray[np.float64]:
        matrix = intrinsics.to(torch.float64).numpy().copy()
        matrix[:2, 2] -= 0.5  # OpenCV counts from the centre of the first pixel, we from its corner
        return matrix

    size = (pinhole.width, pinhole.height)
    coefficients = np.array(camera.distortion, dtype=np.float64)
    across, down = cv2.initUndistortRectifyMap(
        opencv(camera.K), coefficients, np.eye(3), opencv(pinhole.K), size, cv2.CV_32FC1
    )
    inside = (
        (across >= -0.5)
        & (across <= camera.width - 0.5)
        & (down >= -0.5)
        & (down <= camera.height - 0.5)
    )
    chosen = cv2.INTER_LINEAR if interpolation is None else interpolation
    moved = cv2.remap(values, across, down, interpolation=chosen, borderMode=cv2.BORDER_REPLICATE)
    return moved, inside
