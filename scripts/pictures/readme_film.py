"""The film of the README: a run's video as a small animated picture.

gsfluent demo -o out --device cuda
python scripts/pictures/readme_film.py out/video.mp4     # writes docs/images/demo.webp
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from gsfluent.io.atomic import atomic_path

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "demo.webp"


def main(arguments: list[str] | None = None) -> int:
    """Read a video, write the picture."""
    import cv2

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=PICTURE)
    parser.add_argument("--first", type=int, default=14, help="frame that it begins with")
    parser.add_argument("--width", type=int, default=480, help="of the picture [px]")
    parser.add_argument("--low", type=float, default=0.2, help="share cut off at the top")
    parser.add_argument("--slower", type=float, default=2.6, help="than the video")
    options = parser.parse_args(arguments)
    rate = iio.immeta(options.video)["fps"]
    frames = []
    for frame in list(iio.imiter(options.video))[options.first :]:
        tall, wide = frame.shape[:2]
        picture = frame[round(options.low * tall) :]
        size = (options.width, round(options.width * len(picture) / wide))
        frames.append(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    if not frames:
        parser.error(f"{options.video} has no frame {options.first}")
    lasting = [round(1000 * options.slower / rate)] * (len(frames) - 1) + [1500]
    with atomic_path(options.output) as part:
        iio.imwrite(
            part, np.stack(frames), extension=".webp", plugin="pillow", duration=lasting, loop=0,
            quality=80, method=6,
        )  # fmt: skip
    sys.stdout.write(f"{options.output}: {len(frames)} frames, {options.output.stat().st_size} B\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
