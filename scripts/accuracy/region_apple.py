"""Parts of the real apple, red and pale skin, told by a colour rule; docs/measured/regions.md.

    python scripts/accuracy/region_apple.py [--splats apple.ply] [--write]

Every second photograph votes; the others say how well the projected parts, drawn in their cameras,
fit their own masks. Without --splats the apple is reconstructed first (minutes).
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from gsfluent.data import Capture, Frame, Solid
from gsfluent.draw import draw
from gsfluent.figure.markdown import enter
from gsfluent.inspection.parts import solid_regions
from gsfluent.inspection.parts_picture import save_parts_picture
from gsfluent.io import load_capture, load_splats
from gsfluent.io.segmentation.masks import LabelView, Segmentation, load_segmentation
from gsfluent.pipeline import Fill, Isolate, Reconstruct, Regions
from gsfluent.pipeline.capture.orient import orient, upright_rotation
from gsfluent.pipeline.regions.project import SkinLabels, project_labels

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data"))
PAGE = ROOT / "docs" / "measured" / "regions.md"
PICTURE = ROOT / "docs" / "images" / "regions_apple.jpg"
SHEET = ROOT / "docs" / "images" / "regions_apple_masks.jpg"
HUES = {"red": (330, 18), "pale": (18, 95)}  # degrees
DIAMETER = 0.075  # of such an apple [m]; it was not measured


def rule(photograph: np.ndarray) -> np.ndarray:
    """1 where the hue is red, 2 where it is yellow to green; dark, grey and glossy pixels 0."""
    import cv2

    hsv = cv2.cvtColor(cv2.GaussianBlur(photograph, (0, 0), 1.0), cv2.COLOR_RGB2HSV)
    hue, strong = hsv[..., 0].astype(int) * 2, (hsv[..., 1] > 60) & (hsv[..., 2] > 40)
    labels = np.zeros(hue.shape, np.uint8)
    for number, (low, high) in enumerate(HUES.values(), 1):
        inside = (hue >= low) & (hue < high) if low < high else (hue >= low) | (hue < high)
        labels[inside & strong] = number
    return cv2.medianBlur(labels, 5)


def write_masks(capture: Capture, folder: Path) -> None:
    from PIL import Image

    for camera in capture.cameras:
        photograph = np.asarray(Image.open(camera.image_path).convert("RGB"))
        Image.fromarray(rule(photograph)).save(folder / f"{Path(camera.name).stem}.png")
    (folder / "labels.json").write_text('{"1": "red", "2": "pale"}')


def drawn_labels(found: SkinLabels, view: LabelView) -> np.ndarray:
    """The projected labels as a camera sees them, 0 off the object."""
    names = found.segmentation.names
    colors = torch.zeros(found.skin.splats.count, len(names) + 1)
    row = np.flatnonzero(found.label >= 0)
    colors[row, found.label[row]] = 1.0
    seen = draw(found.skin.splats, view.camera, colors=colors)
    return np.where(seen.alpha.numpy() > 0.5, seen.image.argmax(dim=-1).numpy(), 0)


def held_out(solid: Solid, whole: Segmentation) -> list[str]:
    """Project every second photograph and compare with the others; a table."""
    fit = Segmentation("fit", whole.views[::2], whole.names)
    found = project_labels(solid, fit)
    rows = ["| part | votes that agree | IoU in held-out photographs |", "| --- | --- | --- |"]
    both = [(drawn_labels(found, view), view.labels) for view in whole.views[1::2]]
    for number, name in whole.names.items():
        # both maps only where the object is and the rule says something
        pairs = [(a == number, b == number, (a > 0) & (b > 0)) for a, b in both]
        common = sum(int((a & b & on).sum()) for a, b, on in pairs)
        either = sum(int(((a | b) & on).sum()) for a, b, on in pairs)
        share = found.report()["agreement"][str(number)]
        rows.append(f"| {name} | {100 * share:.0f} % | {common / max(either, 1):.3f} |")
    return rows


def sheet(solid: Solid, whole: Segmentation, capture: Capture) -> None:
    """Photograph, mask and projected parts, of four photographs."""
    from PIL import Image

    found = project_labels(solid, whole)
    colors = np.array([[40, 40, 40], [214, 48, 49], [253, 203, 110]], np.uint8)
    columns = []
    for index in np.linspace(0, len(whole.views) - 1, 4).round().astype(int):
        view = whole.views[index]
        photograph = capture.view(int(index), max(view.labels.shape)).image.numpy()
        drawn = drawn_labels(found, view)
        rows, across = np.nonzero(drawn)
        half = int(0.65 * max(np.ptp(rows), np.ptp(across)))
        y, x = int(np.mean(rows)), int(np.mean(across))
        box = (slice(max(y - half, 0), y + half), slice(max(x - half, 0), x + half))
        tiles = ((photograph[box] * 255).astype(np.uint8), colors[view.labels[box]])
        tiles = (*tiles, colors[drawn[box]])
        columns.append(
            np.concatenate([np.asarray(Image.fromarray(t).resize((220, 220), 0)) for t in tiles])
        )
    Image.fromarray(np.concatenate(columns, axis=1)).save(SHEET, quality=88)


def apple(capture: Capture, path: Path | None) -> Solid:
    if path is None:
        splats = Reconstruct(3000, 60_000, image_size=800)(capture)
    else:
        splats = load_splats(path)
    return Fill(resolution=96)(Isolate()(splats, capture), capture)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splats", type=Path, help="the capture, reconstructed before")
    parser.add_argument("--write", action="store_true", help="enter table and pictures into docs")
    given = parser.parse_args()
    folder = DATA / "captures" / "apple"
    if not folder.is_dir():
        sys.stderr.write(f"no capture at {folder}: set GSFLUENT_DATA\n")
        return 0
    capture = load_capture(folder)
    solid = apple(capture, given.splats)
    with tempfile.TemporaryDirectory() as masks:
        write_masks(capture, Path(masks))
        whole = load_segmentation(masks, capture)
        labelled = Regions([{"labels": masks}])(solid, capture)
    table = "\n".join(held_out(solid, whole))
    sys.stdout.write(table + "\n")
    if given.write:
        up = orient(solid.gaussians, capture).up
        low, high = solid.voxel_centers().amin(0), solid.voxel_centers().amax(0)
        scale = DIAMETER / float((high - low).max())
        rotation = torch.from_numpy(upright_rotation(up))
        frame = Frame(rotation, torch.zeros(3, dtype=torch.float64), scale)
        placed = labelled.replace(frame=frame)
        save_parts_picture(solid_regions(placed), PICTURE, "the real apple")
        sheet(solid, whole, capture)
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "apple", table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
