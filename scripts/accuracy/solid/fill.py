"""Fill every mesh of the data folder, photographed and reconstructed; docs/measured/filling.md.

    python scripts/accuracy/solid/fill.py --cache out/fill [--only bowl] [--write] [--cuts]

The meshes come from GSFLUENT_DATA, or ../shared/data beside the checkout. Photographs and splats
are kept in the cache folder and made only once; --device cuda and more --views, --size, --steps
make them better. --things makes or reads a file of the meshes, for a machine without the folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mesh_captures import DATA, Thing, capture_of, load_splats, pack, save_splats, things, unpack

from gsfluent.data import Capture, Gaussians, Solid
from gsfluent.figure.markdown import enter
from gsfluent.pipeline import Reconstruct, find_solid
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.hollow import cavity_volume

PAGE = Path(__file__).resolve().parents[3] / "docs" / "measured" / "filling.md"
SHEET = PAGE.parent / "images" / "filling_cuts.png"
TRUTH = 200  # voxels along the longest side
HOLLOW = 0.2  # a thing that holds over this share of its own volume in water is hollow
HEAD = (
    "| mesh | kind | splats | voxels | IoU | volume | cavity, true [of matter] | cavity found |"
    " wall, median and 5 % [of length] | leaks | CPU s |"
)


def reconstructed(
    thing: Thing, cache: Path, given: argparse.Namespace
) -> tuple[Gaussians, Capture]:
    """The splats of a thing and its photographs, made once."""
    name = thing.name.replace(" ", "_")
    capture = capture_of(thing, cache / name, given.views, given.size, given.device)
    path = cache / f"{name}.npz"
    if not path.is_file():
        stage = Reconstruct(given.steps, given.splats, image_size=given.size, device=given.device)
        gaussians = stage(capture)
        save_splats(gaussians, path)
        sys.stderr.write(f"{name}: {gaussians.count} splats, {gaussians.report['psnr']:.2f} dB\n")
    return load_splats(path), capture


def true_solid(thing: Thing, cache: Path) -> SignedDistance:
    """Distances to the mesh itself; an open one is closed by its winding numbers. Made once."""
    path = cache / f"truth_{thing.name.replace(' ', '_')}_{TRUTH}.pt"
    if path.is_file():
        kept = torch.load(path)
        return SignedDistance(kept["v"], kept["o"], kept["h"], "truth")
    mesh = thing.surface()
    field = find_solid(mesh=mesh, resolution=TRUTH if mesh.is_watertight else 128)
    torch.save({"v": field.values, "o": field.origin, "h": field.voxel}, path)
    return field


def compared(solid: Solid, truth: SignedDistance) -> dict[str, Any]:
    """Voxel centres of the solid against the truth; cavities of both on the same grid."""
    grid = torch.ones_like(solid.occupancy).nonzero()
    true = (truth.at(solid.voxel_centers(grid)) <= 0).reshape(solid.occupancy.shape)
    both, either = true & solid.occupancy, true | solid.occupancy
    return {
        "iou": float(both.sum()) / float(either.sum()),
        "volume": float(solid.occupancy.sum()) / float(true.sum()) - 1.0,
        "cavity": cavity_volume(true.numpy(), solid.voxel),
        "true": true,
    }


def row(thing: Thing, solid: Solid, found: dict[str, Any], seconds: float) -> str:
    """One line of the table."""
    report, matter = solid.report, float(found["true"].sum()) * solid.voxel**3
    hollow = found["cavity"] > HOLLOW * matter
    extent = float(np.ptp(thing.corners.reshape(-1, 3), axis=0).max())
    change = report["cavity_volume"] / found["cavity"] - 1.0 if hollow else None
    walls = [report["wall"][name] for name in ("median", "p5")]
    cells = [
        thing.name,
        "hollow" if hollow else "solid",
        f"{int((solid.gaussians.labels == 0).sum())}",
        f"{round(extent / solid.voxel)}",
        f"{found['iou']:.3f}",
        f"{100 * found['volume']:+.1f} %",
        f"{found['cavity'] / matter:.2f}" if hollow else "",
        "" if change is None else f"{100 * change:+.1f} %",
        ", ".join("thick" if w is None else f"{100 * w / extent:.1f} %" for w in walls),
        str(report["leaks"]),
        f"{seconds:.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def cut(solid: Solid, true: torch.Tensor, side: int = 240) -> np.ndarray:
    """A cut through the middle: grey where both are, red too much, blue missing; [S, S, 3]."""
    import cv2

    guess = solid.occupancy
    middle = int(true.nonzero()[:, 2].float().mean())
    planes = [part[:, :, middle].numpy() for part in (guess, true)]
    image = np.ones((*planes[0].shape, 3), dtype=np.float32)
    image[planes[0] & planes[1]] = 0.62
    image[planes[0] & ~planes[1]] = (0.85, 0.15, 0.15)
    image[~planes[0] & planes[1]] = (0.1, 0.3, 0.9)
    image = image.transpose(1, 0, 2)[::-1]
    scale = (side - 16) / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    canvas = np.ones((side, side, 3), dtype=np.float32)
    top, left = (side - small.shape[0]) // 2, (side - small.shape[1]) // 2
    canvas[top : top + small.shape[0], left : left + small.shape[1]] = small
    return canvas


def sheet(cuts: dict[str, np.ndarray], path: Path) -> None:
    """All cuts with their names, six to a row."""
    import cv2
    from PIL import Image

    tiles = []
    for name, picture in cuts.items():
        named = np.ascontiguousarray((255 * picture.clip(0, 1)).astype(np.uint8))
        cv2.putText(named, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, 16)
        tiles.append(named)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % 6)
    rows = [np.concatenate(tiles[i : i + 6], 1) for i in range(0, len(tiles), 6)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows, 0)).quantize(64).save(path)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder of photographs, splats")
    parser.add_argument("--only", nargs="*", default=None, help="names of files or parts")
    parser.add_argument("--views", type=int, default=96)
    parser.add_argument("--size", type=int, default=640, help="side of a photograph [px]")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--splats", type=int, default=100_000, help="at most")
    parser.add_argument("--resolution", type=int, default=96)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--things", type=Path, default=None, help=".npz of the meshes")
    parser.add_argument("--reconstruct", action="store_true", help="stop before filling")
    parser.add_argument("--write", action="store_true", help="enter the table into the docs")
    parser.add_argument("--cuts", action="store_true", help="make the picture of the docs")
    given = parser.parse_args()
    if given.things is not None and given.things.is_file():
        found = unpack(given.things, given.only)
    else:
        found = things(given.only)
        if given.things is not None:
            pack(given.things, found)
    if not found:
        sys.stderr.write(f"no meshes in {DATA}: set GSFLUENT_DATA\n")
        return 0
    rows, cuts = [HEAD, "| --- " * HEAD.count(" | ") + "| --- |"], {}
    for thing in found:
        gaussians, capture = reconstructed(thing, given.cache, given)
        if given.reconstruct:
            continue
        truth = true_solid(thing, given.cache)
        began = time.process_time()
        solid = Fill(given.resolution, refine_views=0)(gaussians, capture)
        spent = time.process_time() - began
        figures = compared(solid, truth)
        rows.append(row(thing, solid, figures, spent))
        cuts[thing.name] = cut(solid, figures["true"])
        sys.stderr.write(rows[-1] + "\n")
    if given.reconstruct:
        return 0
    table = "\n".join(rows)
    sys.stdout.write(table + "\n")
    if given.write:
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "accuracy", table))
    if given.cuts:
        sheet(cuts, SHEET)
    return 0


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
