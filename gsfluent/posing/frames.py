"""Photographs out of a video: of each stretch of it the sharpest frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsfluent.errors import InputError
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.pictures import check_pixels
from gsfluent.progress import Progress, report_progress

SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
# a playlist could name other files, and addresses: only these containers are opened, only as files
_ONLY = ["-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi"]
_JUDGED = 320  # pixels along the longer side at which sharpness is compared


def take_frames(
    video: Path, folder: Path, count: int, progress: Progress | None = None
) -> list[Path]:
    """Write ``count`` frames of a video as ``0000.jpg``, ...: blurred ones are passed over.

    The video is cut into so many stretches of equal length; the sharpest frame of each is kept.

    Args:
        video: The file, see :data:`SUFFIXES`.
        folder: Where they go; it exists.
        count: How many, at least 3; all there are when the video has fewer.
        progress: Called as ``progress(done, total, message)``.

    Returns:
        The files.

    Raises:
        InputError: No video, or one that ffmpeg cannot read, or ``count`` below 3.
    """
    import imageio_ffmpeg

    if count < 3:
        raise InputError(f"frames must be at least 3, got {count}", "60 to 150 suit an object")
    regular_file(video, "video")
    hint = "convert it to .mp4 (H.264)"
    try:
        reader = imageio_ffmpeg.read_frames(str(video), pix_fmt="rgb24", input_params=_ONLY)
        about = next(reader)
        (width, height), total = about["size"], round(about["duration"] * about["fps"])
    except (OSError, RuntimeError, KeyError, ValueError, StopIteration) as error:
        raise InputError(f"{video}: ffmpeg cannot read it", hint) from error
    try:
        if total < 1:
            raise InputError(f"{video}: does not say how long it is", hint)
        check_pixels(width, height, video)
        written: list[Path] = []
        best: tuple[float, bytes] | None = None
        for index, data in enumerate(reader):
            stretch = min(index * count // total, count - 1)
            if best is not None and stretch > len(written):
                written.append(_write(best[1], width, height, folder, len(written)))
                report_progress(progress, len(written), count, "frames")
                best = None
            sharp = _sharpness(data, width, height)
            if best is None or sharp > best[0]:
                best = (sharp, data)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{video}: ffmpeg stopped reading it", hint) from error
    finally:
        reader.close()
    if best is not None:
        written.append(_write(best[1], width, height, folder, len(written)))
    if not written:
        raise InputError(f"{video}: there is no frame in it", hint)
    report_progress(progress, count, count, "frames")
    return written


def _pixels(data: bytes, width: int, height: int) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8).reshape(height, width, 3)


def _sharpness(data: bytes, width: int, height: int) -> float:
    """Variance of the Laplacian of the brightness (Pech-Pacheco et al. 2000)."""
    import cv2

    step = max(1, max(width, height) // _JUDGED)
    gray: Any = cv2.cvtColor(
        np.ascontiguousarray(_pixels(data, width, height)[::step, ::step]), cv2.COLOR_RGB2GRAY
    )
    return float(cv2.Laplacian(gray, cv2.CV_64F).var())


def _write(data: bytes, width: int, height: int, folder: Path, number: int) -> Path:
    from PIL import Image

    path = folder / f"{number:04d}.jpg"
    Image.fromarray(_pixels(data, width, height)).save(path, quality=95)
    return path
