"""Video and animated pictures on disk, written whole or not at all.

H.264 through imageio-ffmpeg (a wheel that carries its own ffmpeg), because a browser plays H.264
with yuv420p and little else; GIF and WebP through Pillow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsfluent.errors import InputError, RunError
from gsfluent.io import atomic_path
from gsfluent.results.behind import Behind

# Constant rate factor of x264: 18 is the usual "visually lossless" setting, and splat noise
# punishes higher ones.
_CRF = 18


def to_bytes(image: Tensor) -> np.ndarray:
    """Return an sRGB image [H, W, 3] in [0, 1] as contiguous uint8 [H, W, 3] (rounded, clamped)."""
    scaled = image.detach().clamp(0.0, 1.0).mul(255.0).round()
    return np.ascontiguousarray(scaled.to(device="cpu", dtype=torch.uint8).numpy())


def write_video(
    path: Path, frames: Iterable[np.ndarray], *, fps: float, size: tuple[int, int]
) -> int:
    """Encode uint8 frames [H, W, 3] as H.264 (yuv420p, faststart), atomically.

    Args:
        path: Target, ending in ``.mp4``.
        frames: Images of the same size, consumed one at a time.
        fps: Frames per second.
        size: (width, height) in pixels; both even, which yuv420p needs.

    Returns:
        The number of frames written.

    Raises:
        InputError: An odd size, no frame, or a frame of another size.
        RunError: The encoder could not write (disk full, no permission); nothing is left behind.
    """
    import imageio_ffmpeg

    width, height = size
    if width % 2 or height % 2:
        raise InputError(
            f"size: {width} x {height}", "give even numbers; H.264 with yuv420p has no odd ones"
        )
    count = 0
    with atomic_path(path) as part:
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
        try:
            writer.send(None)
            with Behind() as encoder:  # whose pipe holds less than a frame
                for frame in frames:
                    if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
                        raise InputError(
                            f"video frame {count}: {frame.dtype} {frame.shape}",
                            f"give uint8 ({height}, {width}, 3)",
                        )
                    encoder.do(writer.send, frame)
                    count += 1
        except OSError as error:
            raise _encoder_stopped(path) from error
        finally:
            writer.close()
        if count == 0:
            raise InputError("video: no frame at all", "give at least one image")
        if _frames_in(part) != count:
            raise _encoder_stopped(path)
    return count


def write_animation(path: Path, frames: Iterable[np.ndarray], *, fps: float) -> int:
    """Write uint8 frames as an endless GIF or WebP, atomically.

    GIF counts time in hundredths of a second and browsers slow down below two of them, so its
    rate is the nearest that can be shown, 50 a second at most; each frame has a palette of its
    own.

    Args:
        path: Ends in ``.gif`` ([H, W, 3] only) or ``.webp`` ([H, W, 3], or [H, W, 4] with alpha).
        frames: Images of the same size, consumed one at a time.
        fps: Frames per second.

    Returns:
        The number of frames written.

    Raises:
        InputError: Another ending, or no frame.
        RunError: The disk is full.
    """
    from PIL import Image

    kind = path.suffix.lower()
    if kind not in (".gif", ".webp"):
        raise InputError(f"{path}: not an animation", "end the name with .gif or .webp")
    count = 0

    def pictures() -> Iterator[Image.Image]:
        nonlocal count
        for frame in frames:
            count += 1
            picture = Image.fromarray(frame)
            if kind == ".gif":
                picture = picture.quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
            yield picture

    images = pictures()
    first = next(images, None)
    if first is None:
        raise InputError("animation: no frame at all", "give at least one image")
    if kind == ".gif":
        options = {"duration": max(2, round(100.0 / fps)) * 10, "optimize": False, "disposal": 1}
    else:
        options = {"duration": max(1, round(1000.0 / fps)), "quality": 85, "method": 4}
    with atomic_path(path) as part:
        first.save(part, save_all=True, append_images=images, loop=0, **options)  # type: ignore[arg-type]
    return count


def _frames_in(path: Path) -> int:
    """Frames that can be read from a video: ffmpeg ends a film on a full disk without a word."""
    import imageio_ffmpeg

    try:
        return int(imageio_ffmpeg.count_frames_and_secs(str(path))[0])
    except (OSError, RuntimeError):
        return 0


def _encoder_stopped(path: Path) -> RunError:
    return RunError(
        f"{path}: the video encoder stopped; is the disk full?",
        "the simulated frames",
        "free some space and run the same command again",
    )
