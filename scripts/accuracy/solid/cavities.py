"""Hollow things whose inside is known, photographed, reconstructed and filled; filling.md.

    python scripts/accuracy/solid/cavities.py --cache out/cavities [--only "drawn bowl"] [--closed]

Every run is a line of docs/measured/data/cavities.jsonl and a row of docs/measured/filling.md.
--closed starts on the whole visual hull, as it was before cavities were carved out of it. The
meshes come from GSFLUENT_DATA, or ../shared/data beside the checkout; the bowl is drawn.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch
from fill import HOLLOW, PAGE, compared, true_solid
from mesh_captures import capture_of, things
from torch import Tensor

from gsfluent.data import Capture
from gsfluent.demo.capture import make_capture, make_object
from gsfluent.figure.markdown import enter
from gsfluent.io import load_capture
from gsfluent.io.atomic import atomic_path
from gsfluent.pipeline import Reconstruct
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.solid.field import SignedDistance

LINES = PAGE.parent / "data" / "cavities.jsonl"
DRAWN = "drawn bowl"
THINGS = {
    DRAWN: "",
    "white cup": "tea set 4 white",
    "white saucer": "tea set 3 white",
    "pot": "tea set 5",
    "plate": "tea set 7",
}
HEAD = ("thing", "photographs", "start", "PSNR", "carved", "IoU", "cavity found")


class _Drawn:
    """The truth of a demo object, asked like that of a mesh."""

    def __init__(self, name: str) -> None:
        self.object = make_object(name)

    def at(self, points: Tensor) -> Tensor:
        """Negative inside, [N]."""
        return self.object.level(points.double())


def photographed(name: str, given: argparse.Namespace) -> tuple[Capture, SignedDistance | _Drawn]:
    """Photographs of a thing, taken once, and its truth."""
    if name == DRAWN:
        folder = given.cache / "drawn_bowl"
        if not (folder / "transforms.json").is_file():
            make_capture("bowl", folder, size=given.size)
        return load_capture(folder), _Drawn("bowl")
    label = THINGS[name]
    known = things([label, label.split(" white")[0]])
    thing = next(thing for thing in known if thing.name == label)
    folder = given.cache / label.replace(" ", "_")
    return capture_of(thing, folder, given.views, given.size), true_solid(thing, given.cache)


def measured(name: str, given: argparse.Namespace) -> dict[str, str | float]:
    """One line: reconstruct, fill, compare."""
    capture, truth = photographed(name, given)
    stage = Reconstruct(given.steps, image_size=given.size, carve=not given.closed)
    gaussians = stage(capture)
    solid = Fill(given.resolution, refine_views=0)(gaussians, capture)
    found = compared(solid, truth)
    matter = float(found["true"].sum()) * solid.voxel**3
    assert found["cavity"] > HOLLOW * matter  # all of them are hollow
    hull = gaussians.report["hull"] or {"carved": 0.0}
    return {
        "thing": name,
        "photographs": len(capture),
        "start": "hull" if given.closed else "carved hull",
        "PSNR": round(gaussians.report["psnr"], 2),
        "carved": f"{100 * hull['carved']:.0f} %",
        "IoU": round(found["iou"], 3),
        "cavity found": f"{100 * (solid.report['cavity_volume'] / found['cavity'] - 1):+.1f} %",
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder of photographs")
    parser.add_argument("--only", nargs="*", default=list(THINGS), choices=list(THINGS))
    parser.add_argument("--closed", action="store_true", help="carve no cavities")
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--size", type=int, default=256, help="side of a photograph [px]")
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--resolution", type=int, default=96)
    given = parser.parse_args()
    for name in given.only:
        line = measured(name, given)
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
        kept = LINES.read_text(encoding="utf-8").splitlines() if LINES.is_file() else []
        key = (line["thing"], line["start"])
        rows = [row for row in map(json.loads, kept) if (row["thing"], row["start"]) != key]
        order = list(THINGS)
        rows = sorted([*rows, line], key=lambda row: (order.index(row["thing"]), row["start"]))
        with atomic_path(LINES) as part:
            part.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        table = ["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD)]
        table += ["| " + " | ".join(str(row[key]) for key in HEAD) + " |" for row in rows]
        text = enter(PAGE.read_text(encoding="utf-8"), "cavities", "\n".join(table))
        with atomic_path(PAGE) as part:
            part.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
