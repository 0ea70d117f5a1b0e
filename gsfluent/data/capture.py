"""A set of posed photographs with the sparse points that posing them left behind."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.data.camera import Camera
from gsfluent.data.frame import Frame


class View(NamedTuple):
    """One photograph made ready for a pinhole renderer.

    Attributes:
        image: sRGB values as photographed, float32 [H, W, 3] in 0..1.
        mask: Share of each pixel that shows the object, float32 [H, W] in 0..1; None when the
            capture has no masks.
        valid: Pixels that the photograph covers after undistortion, bool [H, W]; None when all of
            them.
        camera: Pinhole camera of this image at this size.
    """

    image: Tensor
    mask: Tensor | None
    valid: Tensor | None
    camera: Camera


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """Posed photographs of one thing.

    Args:
        cameras: Posed cameras, ordered by image name.
        points: Sparse points [P, 3], float64, world units; P may be 0.
        point_colors: Their colours [P, 3], float32 in 0..1.
        root: Folder the capture was read from.
        reader: ``reader(camera, max_size)`` reads the photograph of a camera; None:
            they are not to be read; of files, :func:`gsfluent.io.images.load_view`.
    """

    cameras: list[Camera]
    points: Tensor
    point_colors: Tensor
    root: Path
    reader: Callable[[Camera, int | None], View] | None = None

    def __post_init__(self) -> None:
        """Check shapes."""
        if not self.cameras:
            raise ValueError("Capture: cameras must hold at least one camera, got none")
        if (
            self.points.dim() != 2
            or self.points.shape[1] != 3
            or self.point_colors.shape != self.points.shape
        ):
            got = f"{list(self.points.shape)} and {list(self.point_colors.shape)}"
            raise ValueError(
                f"Capture: points and point_colors must both have shape [P, 3], got {got}"
            )

    def __len__(self) -> int:
        """Return the number of photographs."""
        return len(self.cameras)

    @property
    def has_masks(self) -> bool:
        """Whether any photograph has a mask file (an alpha channel shows only on reading)."""
        return any(camera.mask_path is not None for camera in self.cameras)

    def shows_masks(self) -> bool:
        """Tell whether there are masks, as files or as the alpha channel of the first photograph.

        Raises:
            InputError: That photograph cannot be read.
        """
        return self.has_masks or self.view(0, 64).mask is not None

    def split(self, every: int = 8) -> tuple[Capture, Capture | None]:
        """Hold out every ``every``-th photograph: (train, held out or None when there are too few).

        Raises:
            ValueError: ``every`` is below 2.
        """
        if every < 2:
            raise ValueError(f"Capture.split: every must be at least 2, got {every}")
        held = [camera for index, camera in enumerate(self.cameras) if index % every == every - 1]
        train = [camera for index, camera in enumerate(self.cameras) if index % every != every - 1]
        return self.replace(cameras=train), self.replace(cameras=held) if held else None

    def view(self, index: int, max_size: int | None = None) -> View:
        """Read photograph ``index``, undistorted, with its longer side at most ``max_size`` pixels.

        Raises:
            InputError: The file is missing, truncated, or not an image.
            ValueError: The capture was made without a reader.
        """
        if self.reader is None:
            raise ValueError(
                "Capture.view: the capture has no reader; make it with gf.load_capture or pass"
                " reader=gsfluent.io.images.load_view"
            )
        return self.reader(self.cameras[index], max_size)

    def views(self, indices: Iterable[int], max_size: int | None = None) -> list[View]:
        """Read several photographs as :meth:`view` does, by as many threads as there are cores.

        Raises:
            InputError: As :meth:`view`.
        """
        with ThreadPoolExecutor(min(16, os.cpu_count() or 1)) as pool:
            return list(pool.map(lambda index: self.view(index, max_size), indices))

    def image(
        self, index: int, max_size: int | None = None
    ) -> tuple[Tensor, Tensor | None, Camera]:
        """Read a photograph: (image [H, W, 3], mask [H, W] or None, camera); see :meth:`view`."""
        view = self.view(index, max_size)
        return view.image, view.mask, view.camera

    def centers(self) -> Tensor:
        """Return the camera positions [C, 3], float64."""
        return torch.stack([camera.center() for camera in self.cameras])

    def transformed(self, frame: Frame) -> Capture:
        """Return the capture in another frame."""
        cameras = [camera.transformed(frame) for camera in self.cameras]
        return self.replace(cameras=cameras, points=frame.apply(self.points))

    def replace(self, **changes: object) -> Capture:
        """Return a copy with the named fields replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]
