"""Judge the picture of a fracture against the true one, method by method.

    python scripts/accuracy/cracks.py [--object melon ...] [--frames 15,18] [--only raw,default]
        [--size 400] [--cells 20] [--sheets FOLDER] [--lpips FOLDER] [--write]

An object whose inside is known is filled with splats of the true colours and broken by the
simulator; the truth is a dense cloud of voxels carried by the same material points
(gsfluent.lab.truth.fracture_pictures). Simulations and true pictures are kept in --cache, so a
second call scores in seconds. Colours are unlit, over white.
"""

from __future__ import annotations

import argparse
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
from crack_cases import CASES, METHODS, Broken, Drawn, Moment, ideal
from torch import Tensor

from gsfluent.data import Camera
from gsfluent.draw import draw
from gsfluent.figure.markdown import enter
from gsfluent.inspection.compare_weights import Lpips
from gsfluent.io import save_image
from gsfluent.lab.truth.fracture_pictures import PARTED, TrueCloud, TruePicture
from gsfluent.metrics import psnr, ssim
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.render.camera import Action, look_at
from gsfluent.pipeline.render.figures import RawCarry
from gsfluent.pipeline.render.film import Film
from gsfluent.pipeline.render.flicker import Flow, flicker
from gsfluent.pipeline.render.holes import Holes, MatterView, small
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


def true_pictures(
    broken: Broken, cloud: TrueCloud, index: int, views: list[Camera], voxels: int
) -> list[TruePicture]:
    """The truth in every camera, kept in the folder of the case."""
    size = f"{views[0].width}x{views[0].height}"
    stored = broken.folder / f"truth_{index:03d}_{size}_{voxels}_{cloud.parted:g}.npz"
    if not stored.exists():
        moment = broken.moment(index)
        seen = cloud.exposed(moment.position, moment.deformation, moment.fragments)
        made = [cloud.draw(seen, camera, background=WHITE) for camera in views]
        arrays = {
            k: torch.stack([getattr(p, k) for p in made]) for k in TruePicture.__annotations__
        }
        np.savez_compressed(stored, **{k: v.numpy().astype(np.float16) for k, v in arrays.items()})
    with np.load(stored) as data:
        parts = [torch.from_numpy(data[k]).float() for k in TruePicture.__annotations__]
    return [TruePicture(*(part[c] for part in parts)) for c in range(len(views))]


def picture(drawn: Drawn, camera: Camera) -> Rendered:
    gaussians, groups = drawn
    options: dict[str, Any] = {"near": 0.01, "depth": True, "groups": groups}
    return draw(gaussians, camera, background=torch.tensor(WHITE), **options)


class Score:
    """Figures of one method, one row for each frame and camera."""

    def __init__(self, lpips: Lpips | None) -> None:
        self.lpips = lpips
        self.rows: list[dict[str, float]] = []
        self._last: dict[int, Tensor] = {}

    def add(
        self, image: Tensor, truth: TruePicture, holes: Holes | None, view: int, flow: Flow | None
    ) -> None:
        row = {
            "psnr": psnr(image, truth.image),
            "psnr_inside": psnr(image, truth.image, (truth.alpha > 0.5).float()),
            "ssim": float(ssim(image, truth.image)),
        }
        if self.lpips is not None:
            pair = [(x.numpy() * 255).round().astype(np.uint8) for x in (image, truth.image)]
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


def methods(broken: Broken, cloud: TrueCloud, only: list[str] | None) -> dict[str, Any]:
    known = METHODS | {"ideal": lambda b, m: ideal(b, m, cloud)}
    return {k: v for k, v in known.items() if only is None or k in only}


def judge(broken: Broken, given: argparse.Namespace) -> dict[str, Any]:
    """All methods over broken frames of one case, and the whole object for comparison."""
    size = (given.size, round(0.75 * given.size))
    views = cameras(broken, size)
    cloud = broken.cloud(given.voxels, given.parted)
    every = broken.broken_frames()
    # two frames shortly after the break, for flicker, and the last
    frames = given.frames or sorted({*every[1:3], every[-1]})
    lpips = Lpips(given.lpips, torch.device("cpu")) if given.lpips else None
    chosen = methods(broken, cloud, given.only)
    scores = {name: Score(lpips) for name in ("truth", *chosen)}
    whole = Score(lpips)
    before = every[0] - 1
    first = broken.carry.apply(broken.moment(before).motion(broken.carry)), None
    truths = true_pictures(broken, cloud, before, views, given.voxels)
    for number, (camera, truth) in enumerate(zip(views, truths, strict=True)):
        whole.add(picture(first, camera).image.clamp(0, 1), truth, None, number, None)
    volume, spacing = broken.matter.particles.volume, broken.matter.spacing[0]
    last: tuple[int, Moment, list[MatterView]] | None = None
    for index in frames:
        truths = true_pictures(broken, cloud, index, views, given.voxels)
        moment = broken.moment(index)
        matter = [MatterView.of(moment.position, volume, camera) for camera in views]
        flows: list[Flow | None] = [None] * len(views)
        if last is not None and last[0] == index - 1:
            moved = last[1].position, moment.position
            flows = [
                Flow.of(old, new, moved, (camera, camera), spacing)
                for old, new, camera in zip(last[2], matter, views, strict=True)
            ]
        last = index, moment, matter
        rows: list[list[Tensor]] = [[truth.image] for truth in truths]
        for number, truth in enumerate(truths):
            own = Holes.of(truth.alpha, truth.depth, matter[number])
            scores["truth"].add(truth.image, truth, own, number, flows[number])
        for name, method in chosen.items():
            drawn = method(broken, moment)
            for number, (row, camera, truth) in enumerate(zip(rows, views, truths, strict=True)):
                seen = picture(drawn, camera)
                row.append(seen.image.clamp(0.0, 1.0))
                holes = Holes.of(seen.alpha, cast(Tensor, seen.depth), matter[number])
                scores[name].add(row[-1], truth, holes, number, flows[number])
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
    "psnr": ("PSNR image", ".2f"),
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
    yield "| method | " + " | ".join(COLUMNS[k][0] for k in columns) + " | over raw |"
    yield "| --- " * (len(columns) + 2) + "|"
    base = found["methods"].get("raw", {}).get("psnr")
    for method, row in everything.items():
        judged = method not in ("truth", "(before it breaks)")
        over = f"{row['psnr'] - base:+.2f}" if base is not None and judged else ""
        cells = [
            format(row[k], COLUMNS[k][1]) if k in row and (judged or math.isfinite(row[k])) else ""
            for k in columns
        ]
        yield "| " + " | ".join([method, *cells, over]) + " |"


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
        shown = {"raw": (raw.at(frame), None), "drawn": (frame.gaussians, frame.groups)}
        for number, camera in enumerate([small(film.cameras[index]), *film.around]):
            matter = MatterView.of(frame.positions, frame.volumes, camera)
            for name, drawn in shown.items():
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
    parser.add_argument("--run", type=Path, help="tabulate a finished run's run.json instead")
    parser.add_argument("--frames", type=numbers, help="default: two early, one late")
    parser.add_argument("--only", type=lambda s: s.split(","), help="methods, comma-separated")
    parser.add_argument("--size", type=int, default=400, help="width of the pictures [px]")
    parser.add_argument("--cells", type=int, default=20, help="grid cells along the object")
    parser.add_argument("--resolution", type=int, default=192, help="voxels of the fill")
    parser.add_argument("--voxels", type=int, default=300, help="voxels of the truth")
    parser.add_argument("--parted", type=float, default=PARTED, help="see TrueCloud")
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
