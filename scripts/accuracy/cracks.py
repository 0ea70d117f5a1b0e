"""Judge the picture of a fracture against the true one, method by method.

    python scripts/accuracy/cracks.py [--object melon ...] [--frames 15,18] [--only raw,default]
        [--size 400] [--cells 20] [--sheets FOLDER] [--lpips FOLDER] [--write]
    python scripts/accuracy/cracks.py --chunks [--object melon ...] [--write]
    python scripts/accuracy/cracks.py --cuts [--write]

An object whose inside is known is filled with splats of the true colours and broken by the
simulator; the truth is its solid, cut on fine voxels by the converged partition and moved piece by
piece (gsfluent.lab.truth.fracture_pictures). Simulations and true pictures are kept
in --cache, so a second call scores in seconds. Colours are unlit, over white.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from crack_cases import CASES, METHODS, Broken, Drawn
from crack_chunks import chunk_figures, chunk_table, cut_table, flat_cuts
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.draw import draw
from gsfluent.figure.markdown import enter
from gsfluent.inspection.compare_weights import Lpips
from gsfluent.io import save_image
from gsfluent.lab.truth.fracture_pictures import COVER, TruePicture, TrueSolid
from gsfluent.metrics import psnr, ssim
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.render.camera import Action, look_at
from gsfluent.pipeline.render.figures import RawCarry
from gsfluent.pipeline.render.film import Film
from gsfluent.pipeline.render.flicker import Flow, flicker
from gsfluent.pipeline.render.holes import REACH, Holes, MatterView, small
from gsfluent.results.record import shot_of
from gsfluent.stages.show import light_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "crack_accuracy.md"
VIEWS = ((-60.0, 20.0), (60.0, 20.0), (180.0, 20.0), (0.0, 55.0))
"""Azimuth and elevation of the cameras [degrees]."""
FIELD = 32.0
WHITE = (1.0, 1.0, 1.0)


def cameras(broken: Broken, size: tuple[int, int]) -> list[Camera]:
    """Cameras that stand still and see nine tenths of the matter of all broken frames."""
    frames = broken.broken_frames()
    action = Action.of([broken.moment(0).position, *(broken.moment(k).position for k in frames)])
    center = action.center[1:].mean(0)
    away = (action.center[1:] - center).norm(dim=1) + action.radius[1:]
    radius = min(float(away.max()), 2.2 * float(action.radius[0]))
    distance = 1.15 * radius / math.sin(math.radians(FIELD) / 2)
    return [look_at(center, distance, a, e, size) for a, e in VIEWS]


class Truth:
    """The truth in every camera at one moment: pieces that bend, and rigid ones."""

    def __init__(self, broken: Broken, solid: TrueSolid, index: int, views: list[Camera]) -> None:
        at = broken.moment(index).position
        self.index = index
        self.position = solid.moved(at, bent=True)
        # of other cameras than these there are other pictures
        seen = hashlib.sha256(b"".join(v.viewmat.numpy().tobytes() for v in views)).hexdigest()[:8]
        size = f"{views[0].width}x{views[0].height}_{len(solid.rest)}_{seen}"
        stored = broken.folder / f"truth_{index:03d}_{size}.npz"
        names = list(TruePicture.__annotations__)
        if not stored.exists():
            arrays = {}
            for kind, places in (("bent", self.position), ("rigid", solid.moved(at))):
                made = [solid.draw(places, camera, background=WHITE) for camera in views]
                for k in names:
                    part = torch.stack([getattr(seen, k) for seen in made])
                    arrays[f"{kind}_{k}"] = part.numpy().astype(np.float16)
            np.savez_compressed(stored, **arrays)
        with np.load(stored) as data:
            values = {k: torch.from_numpy(data[k]).float() for k in data.files}
        self.bent, self.rigid = (
            [
                TruePicture(*(values[f"{kind}_{k}"][c] for k in names))
                for c in range(len(views))
            ]
            for kind in ("bent", "rigid")
        )  # fmt: skip
        # its voxels as discs: what ought to be opaque, and where it goes
        volume = torch.full((len(self.position),), (COVER / REACH * solid.voxel) ** 3)
        self.matter = [MatterView.of(self.position, volume, camera) for camera in views]


def picture(drawn: Drawn, camera: Camera) -> Rendered:
    options: dict[str, Any] = {"near": 0.01, "depth": True, "groups": drawn.groups}
    return draw(drawn.gaussians, camera, background=torch.tensor(WHITE), **options)


def flows(
    before: Truth | None, now: Truth, views: list[Camera], spacing: float
) -> list[Flow | None]:
    """From the frame before, along the true motion; None where that was not seen.

    Every method is followed so, on the same pixels. Its own points are too coarse for it: nine
    tenths of the pixels look like a rim, as points lie deeper and less deep than their neighbours,
    and the skin before a point that turns moves otherwise than the point.
    """
    if before is None or before.index != now.index - 1:
        return [None] * len(views)
    moved = before.position, now.position
    pairs = zip(before.matter, now.matter, views, strict=True)
    return [Flow.of(a, b, moved, (view, view), spacing) for a, b, view in pairs]


class Score:
    """Figures of one method, one row for each frame and camera."""

    def __init__(self, lpips: Lpips | None) -> None:
        self.lpips = lpips
        self.rows: list[dict[str, float]] = []
        self._last: dict[int, Tensor] = {}

    def add(
        self, image: Tensor, truth: Truth, view: int, holes: Holes | None, flow: Flow | None
    ) -> None:
        true = truth.bent[view]
        row = {
            "psnr": psnr(image, true.image),
            "rigid": psnr(image, truth.rigid[view].image),
            "psnr_inside": psnr(image, true.image, (true.alpha > 0.5).float()),
            "ssim": float(ssim(image, true.image)),
        }
        if self.lpips is not None:
            pair = [(x.numpy() * 255).round().astype(np.uint8) for x in (image, true.image)]
            row["lpips"] = self.lpips(*pair)
        if holes is not None:
            row |= {"holes": 100 * holes.fraction, "through": 100 * holes.through}
        if flow is not None:
            change = flicker(self._last[view], image, flow)
            if change is not None:
                row["flicker"] = 100 * change
        self._last[view] = image
        self.rows.append(row)

    def means(self) -> dict[str, float]:
        names = dict.fromkeys(k for row in self.rows for k in row)
        found = {k: float(np.mean([row[k] for row in self.rows if k in row])) for k in names}
        if "holes" in names:
            found["most holes"] = max(row["holes"] for row in self.rows)
        return found


def judge(broken: Broken, given: argparse.Namespace) -> dict[str, Any]:
    """All methods over broken frames of one case, and the whole object for comparison."""
    size = (given.size, round(0.75 * given.size))
    views = cameras(broken, size)
    solid = broken.truth(given.finer)
    every = broken.broken_frames()
    # two frames shortly after the break, for flicker, and the last
    frames = given.frames or sorted({*every[2:4], every[-1]})
    lpips = Lpips(given.lpips, torch.device("cpu")) if given.lpips else None
    chosen = {k: v for k, v in METHODS.items() if given.only is None or k in given.only}
    scores = {name: Score(lpips) for name in ("truth", *chosen)}
    whole = Score(lpips)
    before = every[0] - 1
    points = broken.moment(before).points()
    first = Drawn(broken.carry.apply(broken.carry.follow(points)), None, points.position)
    truth = Truth(broken, solid, before, views)
    for number, camera in enumerate(views):
        image = picture(first, camera).image.clamp(0, 1)
        whole.add(image, truth, number, None, None)
    last: Truth | None = None
    spacing, volume = broken.matter.spacing[0], broken.matter.particles.volume
    for index in frames:
        truth, moment = Truth(broken, solid, index, views), broken.moment(index)
        along, last = flows(last, truth, views, spacing), truth
        rows: list[list[Tensor]] = [[true.image] for true in truth.bent]
        for number, true in enumerate(truth.bent):
            own = Holes.of(true.alpha, true.depth, truth.matter[number])
            scores["truth"].add(true.image, truth, number, own, along[number])
        for name, method in chosen.items():
            drawn = method(broken, moment)
            # what is not at its place yet is no hole
            matter = [MatterView.of(drawn.shown, volume, camera) for camera in views]
            for number, (row, camera) in enumerate(zip(rows, views, strict=True)):
                found = picture(drawn, camera)
                row.append(found.image.clamp(0.0, 1.0))
                holes = Holes.of(found.alpha, cast(Tensor, found.depth), matter[number])
                scores[name].add(row[-1], truth, number, holes, along[number])
        if given.sheets:
            titles = ["truth", *chosen]
            sheet(rows[given.view], titles, given.sheets / f"{broken.name}_{index:03d}.png")
        sys.stderr.write(f"{broken.name} frame {index}\n")
    return {
        "frames": frames,
        "cameras": len(views),
        "splats": broken.carry.gaussians.count,
        "points": broken.matter.particles.count,
        "whole": whole.means(),
        "methods": {name: score.means() for name, score in scores.items()},
        "rows": {name: score.rows for name, score in scores.items()},
    }


def promised(given: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Figures of chunks for every object."""
    found = {}
    for name in given.object:
        broken = Broken(name, given.cells, given.resolution, given.cache)
        views = cameras(broken, (given.size, round(0.75 * given.size)))
        every = broken.broken_frames()
        found[name] = chunk_figures(broken, given.frames or [every[2], every[-1]], views)
        sys.stderr.write(f"{name}: {found[name]}\n")
    return found


def sheet(pictures: list[Tensor], titles: list[str], path: Path) -> None:
    """Pictures side by side, cropped to what is not white, each under its title."""
    import cv2

    busy = (torch.stack(pictures).amin(-1) < 0.97).any(0)
    rows, columns = busy.any(1).nonzero()[:, 0], busy.any(0).nonzero()[:, 0]
    box = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    tiles = []
    for image, title in zip(pictures, titles, strict=True):
        tile = np.pad(image[box].numpy(), ((18, 2), (2, 2), (0, 0)), constant_values=1.0)
        tile = np.ascontiguousarray((tile * 255).round().astype(np.uint8))
        cv2.putText(tile, title, (3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(tile)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_image(torch.from_numpy(np.concatenate(tiles, 1)).float() / 255, path)


COLUMNS = {
    "psnr": ("bent truth [dB]", ".2f"),
    "rigid": ("rigid truth [dB]", ".2f"),
    "psnr_inside": ("silhouette", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "lpips": ("LPIPS", ".3f"),
    "holes": ("holes %", ".2f"),
    "most holes": ("most", ".2f"),
    "through": ("see-through %", ".2f"),
    "flicker": ("flicker %", ".2f"),
}


def table(name: str, found: dict[str, Any]) -> Iterator[str]:
    everything = found["methods"] | {"(before it breaks)": found["whole"]}
    columns = [k for k in COLUMNS if any(k in row for row in everything.values())]
    yield (
        f"**{name}**: {found['splats']} splats on {found['points']} points, "
        f"frames {', '.join(map(str, found['frames']))}, {found['cameras']} cameras"
    )
    yield ""
    yield "| method | " + " | ".join(COLUMNS[k][0] for k in columns) + " | over raw, bent | rigid |"
    yield "| --- " * (len(columns) + 3) + "|"
    base = found["methods"].get("raw")
    for method, row in everything.items():
        judged = method not in ("truth", "(before it breaks)")
        over = ["", ""]
        if base is not None and judged:
            over = [f"{row[k] - base[k]:+.2f}" for k in ("psnr", "rigid")]
        cells = [
            format(row[k], COLUMNS[k][1]) if k in row and (judged or math.isfinite(row[k])) else ""
            for k in columns
        ]
        yield "| " + " | ".join([method, *cells, *over]) + " |"


def of_run(out: Path) -> Iterator[str]:
    """Largest and mean figures of a finished run, before and after repair."""
    render = json.loads((out / "run.json").read_text(encoding="utf-8"))["render"]
    yield "| figure | before: largest | mean | drawn: largest | mean | frames |"
    yield "| --- " * 6 + "|"
    for name in ("hole_fraction", "hole_fraction_around", "see_through", "flicker"):
        # frames in which both were measured
        both = zip(render[f"{name}_before"], render[name], strict=True)
        pairs = [(a, b) for a, b in both if a is not None and b is not None]
        cells = [
            f"{100 * f(side):.3f} %" for side in zip(*pairs, strict=True) for f in (max, np.mean)
        ]
        yield "| " + " | ".join([name, *cells, str(len(pairs))]) + " |"
    yield ""
    yield from every_camera(out)


def every_camera(out: Path) -> Iterator[str]:
    """Holes in every frame of a finished run, in the film's camera and the three around."""
    shot = shot_of(out)
    film = Film(out, shot, light_of(shot), torch.device("cpu"))
    raw = RawCarry(film.frame(0))
    worst: dict[tuple[int, str], float] = {}
    for index in range(len(film)):
        frame = film.frame(index)
        shown = {
            "raw": Drawn(raw.at(frame), None, frame.positions),
            "drawn": Drawn(frame.gaussians, frame.groups, frame.shown),
        }
        for number, camera in enumerate([small(film.cameras[index]), *film.around]):
            for name, drawn in shown.items():
                matter = MatterView.of(drawn.shown, frame.volumes, camera)
                seen = picture(drawn, camera)
                found = Holes.of(seen.alpha, cast(Tensor, seen.depth), matter).fraction
                worst[number, name] = max(worst.get((number, name), 0.0), found)
    yield f"| camera, worst of all {len(film)} frames | raw | drawn |"
    yield "| --- | --- | --- |"
    for number in range(1 + len(film.around)):
        title = f"around {number}" if number else "film"
        cells = [f"{100 * worst[number, name]:.3f} %" for name in ("raw", "drawn")]
        yield f"| {title} | {' | '.join(cells)} |"


def main() -> int:
    def numbers(text: str) -> list[int]:
        return [int(part) for part in text.split(",")]

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--object", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--chunks", action="store_true", help="what chunks promise, instead")
    parser.add_argument("--cuts", action="store_true", help="flat cuts through a cube, instead")
    parser.add_argument("--run", type=Path, help="tabulate a finished run's run.json instead")
    parser.add_argument("--frames", type=numbers, help="default: two early, one late")
    parser.add_argument("--only", type=lambda s: s.split(","), help="methods, comma-separated")
    parser.add_argument("--size", type=int, default=400, help="width of the pictures [px]")
    parser.add_argument("--cells", type=int, default=20, help="grid cells along the object")
    parser.add_argument("--resolution", type=int, default=192, help="voxels of the fill")
    parser.add_argument(
        "--finer", type=float, default=6.0, help="voxels of the truth per point spacing"
    )
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir(), "gsfluent-crack"))
    parser.add_argument("--lpips", type=Path, help="folder with LPIPS' weights")
    parser.add_argument("--sheets", type=Path, help="folder for pictures side by side")
    parser.add_argument("--view", type=int, default=0, help="camera of the sheets")
    parser.add_argument("--json", type=Path, help="write every figure of every picture here")
    parser.add_argument("--write", action="store_true", help=f"enter the tables into {PAGE.name}")
    given = parser.parse_args()
    if given.run:
        text = "\n".join(of_run(given.run))
        sys.stdout.write(text + "\n")
        if given.write:
            PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "run", text))
        return 0
    if given.chunks or given.cuts:
        text = "\n".join(cut_table(flat_cuts()) if given.cuts else chunk_table(promised(given)))
        sys.stdout.write(text + "\n")
        if given.write:
            name = "cuts" if given.cuts else "chunks"
            PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), name, text))
        return 0
    lines: list[str] = []
    everything = {}
    for name in given.object:
        began = time.process_time()
        found = judge(Broken(name, given.cells, given.resolution, given.cache), given)
        everything[name] = found
        lines += [*table(name, found), ""]
        sys.stderr.write(f"{name}: {time.process_time() - began:.0f} s\n")
    text = "\n".join(lines).rstrip()
    sys.stdout.write(text + "\n")
    if given.json:
        given.json.write_text(json.dumps(everything, indent=1))
    if given.write:
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "pictures", text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
