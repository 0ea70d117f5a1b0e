"""Time per picture of the viewer, from a frame in memory to the JPEG that is sent.

    python scripts/bench/viewer.py --device cuda --splats 200000 1000000

A ball of splats in two halves, lit, with floor and shadow; the camera turns between pictures.
Prints one table, and the resolution that the viewer's own pace would choose while something moves.
On the CPU it is the process's time, so that other work on the machine does not count.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch

from gsfluent.data import INTERIOR, SURFACE, Gaussians
from gsfluent.figure.markdown import enter
from gsfluent.pipeline.render.camera import look_at
from gsfluent.results.frames import SavedFrame
from gsfluent.viewer.draw.artist import BUDGETS
from gsfluent.viewer.draw.picture import PictureMaker
from gsfluent.viewer.model.look import FRAGMENT, Look
from gsfluent.viewer.model.pace import Pace
from gsfluent.viewer.model.timeline import Timeline

RADIUS, HEIGHT = 0.1, 0.13
PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "viewer.md"


class Ball:
    """A source with one frame: a ball of ``count`` splats that has come apart."""

    title, shot, running, revision = "ball", None, False, "1"

    def __init__(self, count: int) -> None:
        random = torch.Generator().manual_seed(0)
        place = torch.randn(count, 3, generator=random)
        outward = place / place.norm(dim=1, keepdim=True)
        depth = torch.rand(count, 1, generator=random)
        skin = torch.arange(count) % 3 == 0
        shell = torch.where(skin[:, None], torch.ones_like(depth), 0.97 * depth ** (1 / 3))
        means = RADIUS * shell * outward
        side = torch.where(means[:, :1] < 0, -1.0, 1.0)
        means += torch.cat([0.03 * side, torch.zeros(count, 2)], 1)
        means += torch.tensor([0.0, 0.0, HEIGHT])
        size = RADIUS * 1.2 * (4.0 / count) ** (1 / 3)
        paint = torch.tensor([[0.8, 0.2, 0.2], [0.2, 0.5, 0.2]])
        labels = torch.where(skin, SURFACE, INTERIOR).to(torch.int32)
        gaussians = Gaussians.from_colors(
            means, torch.full((count,), size), paint[skin.long()], opacities=0.95
        ).replace(labels=labels)
        anchor = (torch.arange(count) // 2).to(torch.int32)
        points = means[::2]
        pieces = (side[::2, 0] > 0).to(torch.int32)
        zero = torch.zeros(len(points))
        self._frame = SavedFrame(
            index=0,
            time=0.0,
            gaussians=gaussians,
            groups=torch.full((count,), -1, dtype=torch.int32),
            carried=count,
            ids=torch.arange(count),
            anchor=anchor,
            positions=points,
            volumes=torch.full((len(points),), 4.19e-3 / len(points)),
            damage=zero,
            fragments=pieces,
            velocity=torch.zeros_like(points),
            body=pieces,
            material=pieces,
            facts={},
        )

    def count(self) -> int:
        return 1

    def frame(self, index: int) -> SavedFrame:
        return self._frame

    def facts(self, index: int) -> dict[str, Any]:
        return {"time": 0.0}

    def state(self) -> str:
        return ""


def measure(
    maker: PictureMaker, size: tuple[int, int], look: Look, pace: Pace, repeats: int
) -> dict[str, float]:
    """Milliseconds of a picture and of its JPEG, over ``repeats`` views."""
    import cv2

    clock = time.process_time if maker.device.type == "cpu" else time.perf_counter
    drawing = packing = 0.0
    weight = 0
    for turn in range(repeats + 2):
        target = torch.tensor([0.0, 0.0, HEIGHT])
        camera = look_at(target, 0.75, 7.0 * turn, 20.0, size)
        start = clock()
        picture = maker.picture(0, camera, look)
        middle = clock()
        _, packed = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
        end = clock()
        if turn >= 2:  # the first ones allocate
            drawing += middle - start
            packing += end - middle
            weight += packed.size
            pace.measured(size[0] * size[1], end - start)
    return {
        "picture_ms": 1e3 * drawing / repeats,
        "jpeg_ms": 1e3 * packing / repeats,
        "kB": weight / repeats / 1e3,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--splats", type=int, nargs="+", default=[50_000, 200_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--enter", metavar="NAME", help="enter into the page under this name")
    parser.add_argument("--read", type=Path, help="a table printed before, instead of measuring")
    arguments = parser.parse_args()
    if arguments.read is not None:
        table = arguments.read.read_text(encoding="utf-8")
    else:
        table = run(arguments.device, arguments.splats, arguments.repeats)
        print(table)
    if arguments.enter:
        lines = [line for line in table.splitlines() if "| fragment |" not in line]
        page = PAGE.read_text(encoding="utf-8")
        name = f"pictures on {arguments.enter}"
        PAGE.write_text(
            enter(page, name, "\n".join(lines), arguments.enter + ":"), encoding="utf-8"
        )


def run(device: str, splats: list[int], repeats: int) -> str:
    """The table for a device."""
    head = "| splats | picture | coloured by | picture [ms] | JPEG [ms] | size [kB] |"
    lines, notes = [head, "| --- | --- | --- | --- | --- | --- |"], []
    for count in splats:
        maker = PictureMaker(Timeline(Ball(count), torch.device(device)))
        pace = Pace()
        for size in ((640, 360), (1280, 720), (1920, 1080)):
            for name, look in (("appearance", Look()), ("fragment", Look(FRAGMENT))):
                found = measure(maker, size, look, pace, repeats)
                times = f"{found['picture_ms']:.1f} | {found['jpeg_ms']:.1f} | {found['kB']:.0f}"
                lines.append(f"| {count} | {size[0]}x{size[1]} | {name} | {times} |")
        share = pace.scale(1280, 720, BUDGETS[0])
        notes.append(f"{count} splats: {share:.2f} of the sides of 1280x720 while moving")
    return "\n".join([*lines, "", "; ".join(notes) + "."])


if __name__ == "__main__":
    main()
