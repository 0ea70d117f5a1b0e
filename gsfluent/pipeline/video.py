"""Images and video on disk, each written whole or not at all.

H.264 through imageio-ffmpeg (a wheel that carries its own ffmpeg), because a browser plays H.264 with yuv420p and
little else; PNG through Pillow. Both write beside the target and rename, so a full disk or Ctrl-C leaves no torso.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsfluent.errors import InputError

# Constant rate factor of x264: 18 is the usual "visually lossless" setting, and splat noise punishes higher ones.
_CRF = 18


def to_bytes(image: Tensor) -> np.ndarray:
    """Return an sRGB image [H, W, 3] in [0, 1] as contiguous uint8 [H, W, 3] (rounded, clamped)."""
    scaled = image.detach().clamp(0.0, 1.0).mul(255.0).round()
    return np.ascontiguousarray(scaled.to(device="cpu", dtype=torch.uint8).numpy())


def write_png(path: Path, image: Tensor | np.ndarray) -> Path:
    """Write an image [H, W, 3] (float in [0, 1], or uint8) as PNG, atomically.

    Raises:
        OSError: The file cannot be written (no space, no permission); nothing is left behind.
    """
    from PIL import Image

    pixels = to_bytes(image) if isinstance(image, Tensor) else image
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as stream:
            Image.fromarray(pixels).save(stream, format="PNG")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return path


def write_video(path: Path, frames: Iterable[np.ndarray], *, fps: float, size: tuple[int, int]) -> int:
    """Encode uint8 frames [H, W, 3] as H.264 (yuv420p, faststart), atomically.

    Args:
        path: Target, ending in ``.mp4``.
        frames: Images of the same size, consumed one at a time.
        fps: Frames per second.
        size: (width, height) in pixels; both even, which yuv420p needs.

    Returns:
        The number of frames written.

    Raises:
        InputError: An odd size, or a frame of another size.
        OSError: The encoder could not write (disk full, no permission); nothing is left behind.
    """
    import imageio_ffmpeg

    width, height = size
    if width % 2 or height % 2:
        raise InputError(
            f"size: {width} x {height}", "give even numbers; H.264 with yuv420p has no odd ones"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".part.{path.name}")
    writer = imageio_ffmpeg.write_frames(
        str(part),
        (width, height),
        fps=fps,
        codec="libx264",
        pix_fmt_out="yuv420p",
        macro_block_size=1,
        output_params=["-crf", str(_CRF), "-preset", "medium", "-movflags", "+faststart"],
        ffmpeg_log_level="error",
    )
    count = 0
    try:
        writer.send(None)
        for frame in frames:
            if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
                raise InputError(
                    f"video frame {count}: {frame.dtype} {frame.shape}",
                    f"give uint8 ({height}, {width}, 3)",
                )
            writer.send(frame)
            count += 1
        writer.close()
        if count == 0:
            raise InputError("video: no frame at all", "give at least one image")
        # ffmpeg can end without an exception and without a file when the disk is full
        if not part.is_file() or part.stat().st_size == 0:
            raise OSError(errno.ENOSPC, "the encoder wrote nothing; is the disk full?", str(path))
        os.replace(part, path)
    except OSError as error:
        if error.errno in (errno.EPIPE, None):
            raise OSError(errno.ENOSPC, f"the encoder stopped ({error}); is the disk full?", str(path)) from error
        raise
    finally:
        writer.close()
        part.unlink(missing_ok=True)
    return count
