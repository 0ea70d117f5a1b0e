"""Texture solids from one real photograph and judge them by held-out ones.

    python scripts/accuracy/texture/photographs.py [--size 80] [--only apple kiwi]
        [--write] [--sheets]

Needs the photographs of the data folder (GSFLUENT_DATA, or ../shared/data beside the checkout).
One slice goes in; cuts through the solid are compared with photographs (or halves of photographs)
that did not. The floor is the distance between two photographs of the class. Every run leaves one
JSON line per class in docs/measured/data/real_interiors.jsonl; ``--write`` enters the table of
all lines, ``--sheets`` draws what was compared.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import cv2  # noqa: TID253
import numpy as np
from photograph_cases import CASES, Case, data_folder
from scipy import ndimage  # noqa: TID253

from gsfluent.figure.markdown import enter
from gsfluent.lab.truth.interiors_judge import Plane, sample_plane
from gsfluent.pipeline.texture.baselines import color_copy
from gsfluent.pipeline.texture.photo import metrics
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, load_exemplars
from gsfluent.pipeline.texture.photo.profile import depth_profile, profile_volume, surface_profile
from gsfluent.pipeline.texture.structure import take_apart, with_structure
from gsfluent.pipeline.texture.synthesis.method import exemplar_texture
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, blend_skin

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "real_interiors.md"
LINES = ROOT / "docs" / "measured" / "data" / "real_interiors.jsonl"
SHEET = ROOT / "docs" / "images" / "real_interiors.jpg"
METHODS = ("color_copy", "profile", "photo_profile", "preview", "default")
_RIM = 3  # voxels next to the outline where the surface's colour fades out


def texture(domain: InteriorDomain, case: Case, photo: Exemplar, method: str) -> np.ndarray:
    """Colours of the solid by one method, with its skin."""
    if method == "color_copy":
        rgb = color_copy(domain).rgb
    elif method == "profile":
        rgb = surface_profile(domain)
    elif method == "photo_profile":
        if photo.silhouette:
            position, color = depth_profile(photo)
            ratio = photo.max_depth / domain.max_depth
            rgb = profile_volume(domain.depth * ratio, position, color)
        else:
            rgb = np.broadcast_to(photo.image[photo.mask].mean(0), domain.skin.shape)
    else:
        quality = "preview" if method == "preview" else "fast"
        photos = load_exemplars(photo)
        opened, structure = take_apart(photos) if case.cut else (photos, None)
        found = exemplar_texture(domain, opened, quality=quality, seed=1, **case.settings)
        if structure is not None:
            found = with_structure(domain, found, structure, case.cut or "across")
        rgb = found.rgb
    return blend_skin(domain, np.asarray(rgb, np.float32))


def planes(domain: InteriorDomain, case: Case) -> list[Plane]:
    """Cuts that are compared: those that the held-out photographs show."""
    index = np.argwhere(domain.inside)
    low, high = index.min(0), index.max(0) + 1.0
    unit = np.eye(3)
    found: list[Plane] = []
    for axis in case.judged:
        columns, rows = (i for i in range(3) if i != axis)
        for place in (0.42, 0.5, 0.58) if len(case.judged) == 1 else (0.35, 0.6):
            point = np.floor(0.5 * (low + high)) + 0.5
            point[axis] = np.floor(low[axis] + place * (high - low)[axis]) + 0.5
            found.append((point, unit[columns], unit[rows]))
    return found


def oblique(domain: InteriorDomain) -> Plane:
    """A cut at an angle to all axes."""
    middle = np.argwhere(domain.inside).mean(0) + 0.5
    normal = np.array([0.5, 0.35, 0.79])
    u = np.cross([0.0, 1.0, 0.0], normal)
    u /= np.linalg.norm(u)
    return middle, u, np.cross(normal / np.linalg.norm(normal), u)


def inner(image: np.ndarray, mask: np.ndarray, outlined: bool) -> metrics.Slice:
    """A slice without its rim."""
    return image, ndimage.binary_erosion(np.pad(mask, 1), iterations=_RIM)[1:-1, 1:-1] if (
        outlined
    ) else mask


def profile(slices: list[metrics.Slice]) -> np.ndarray:
    """Mean Lab colour at sixteen equal ranges of relative depth below the outline."""
    total, count = np.zeros((16, 3)), np.zeros(16)
    for image, mask in slices:
        depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1][mask]
        which = np.clip((depth / depth.max() * 16).astype(int), 0, 15)
        lab = metrics.rgb_to_lab(image[mask])
        count += np.bincount(which, minlength=16)
        total += np.stack([np.bincount(which, lab[:, c], 16) for c in range(3)], 1)
    return total / np.maximum(count, 1)[:, None]


def figures(
    own: list[metrics.Slice], truth: list[metrics.Slice], outlined: bool
) -> dict[str, float]:
    """Distances of two sets of slices."""
    colors = [np.concatenate([i[m] for i, m in s]) for s in (own, truth)]
    found = {
        "patch": metrics.patch_distance(own, truth, samples=20000),
        "hist": metrics.lab_histogram_distance(*colors),
        "sharp": metrics.sharpness(own) / max(metrics.sharpness(truth), 1e-9),
    }
    if outlined:
        found["profile"] = float(np.linalg.norm(profile(own) - profile(truth), axis=1).mean())
    return found


def mean(rows: list[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}


def judge(case: Case, size: int) -> tuple[dict[str, Any], list[np.ndarray]]:
    """All figures of one class, and the pictures for its row of the sheet."""
    photo, held, raw = case.photographs(data_folder())
    domain = case.solid(size, photo)
    cuts = planes(domain, case)
    middle = sample_plane(domain, domain.skin, cuts[len(cuts) // 2])[1]
    if photo.silhouette:
        factors = [float(np.sqrt(middle.sum() / p.mask.sum())) for p in (photo, *held)]
    else:
        factors = [max(domain.inside.shape) / max(photo.mask.shape)] * (1 + len(held))
    outlined = photo.silhouette and all(h.silhouette for h in held)
    fitted = [p.resized(f) for p, f in zip((photo, *held), factors, strict=True)]
    shown = [inner(p.image, p.mask, p.silhouette) for p in fitted]
    truth = shown[1:]
    # two photographs that the method has not seen; with one held out, the exemplar is the other
    pairs = list(itertools.permutations(truth, 2)) or [(shown[0], truth[0])]
    record: dict[str, Any] = {
        "class": case.name,
        "size": size,
        "held_out": len(truth),
        "note": photo.note,
        "floor": mean([figures([a], [b], outlined) for a, b in pairs]),
        "exemplar": mean([figures(shown[:1], [t], outlined) for t in truth]),
    }
    pictures: list[np.ndarray] = []
    for method in METHODS:
        began = time.process_time()
        rgb = texture(domain, case, photo, method)
        seconds = time.process_time() - began
        own = [inner(*sample_plane(domain, rgb, cut), photo.silhouette) for cut in cuts]
        record[method] = mean([figures(own, [t], outlined) for t in truth]) | {"cpu_s": seconds}
        if method == "default":
            along = 0 if 2 in case.judged else 2
            views = [cuts[len(cuts) // 2], _through(domain, along), oblique(domain)]
            pictures = [_white(*sample_plane(domain, rgb, view)) for view in views]
    seen = [_white(p.image, p.mask) for p in (photo, *held[:2])]
    return record, [raw, *(seen + seen[1:] * (2 - len(held[:2])))[:3], *pictures]


def _through(domain: InteriorDomain, axis: int) -> Plane:
    middle = np.floor(np.argwhere(domain.inside).mean(0)) + 0.5
    unit = np.eye(3)
    columns, rows = (i for i in range(3) if i != axis)
    return middle, unit[columns], unit[rows]


def _white(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A picture on white, cropped to its mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return np.where(mask[..., None], image, 1.0)[box]


def sheet(rows: dict[str, list[np.ndarray]], edge: int = 150) -> np.ndarray:
    """One row of pictures per class."""
    lines = []
    for pictures in rows.values():
        tiles = []
        for picture in pictures:
            scale = (edge - 8) / max(picture.shape[:2])
            size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
            method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
            small = cv2.resize(picture.astype(np.float32), size, interpolation=method)
            tile = np.ones((edge, edge, 3), np.float32)
            top, left = (edge - size[1]) // 2, (edge - size[0]) // 2
            tile[top : top + size[1], left : left + size[0]] = small.clip(0, 1)
            tiles.append(tile)
        lines.append(np.concatenate(tiles, 1))
    return np.concatenate(lines, 0)


def table(lines: list[dict[str, Any]]) -> str:
    """Markdown of the figures."""
    head = ["class", "", "patches", "x floor", "histogram", "profile", "sharp", "CPU s"]
    out = ["| " + " | ".join(head) + " |", "| " + " | ".join(["---"] * len(head)) + " |"]
    for line in lines:
        # with one photograph held out the exemplar is the floor
        first = ("floor", "exemplar") if line["held_out"] > 1 else ("floor",)
        for method in (*first, *METHODS):
            row = line[method]
            ratio = row["patch"] / line["floor"]["patch"]
            cells = [
                f"{line['class']} ({line['held_out']} held out)" if method == "floor" else "",
                f"*{method}*" if method in ("floor", "exemplar") else f"`{method}`",
                f"{row['patch']:.2f}",
                "" if method == "floor" else f"{ratio:.2f}",
                f"{row['hist']:.2f}",
                f"{row['profile']:.1f}" if "profile" in row else "-",
                f"{row['sharp']:.2f}",
                f"{row['cpu_s']:.1f}" if "cpu_s" in row else "",
            ]
            out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--size", type=int, default=80, help="voxels along the cube (80)")
    parser.add_argument("--only", nargs="*", help=f"classes: {', '.join(CASES)}".replace("%", "%%"))
    parser.add_argument("--write", action="store_true", help="enter the table into the page")
    parser.add_argument("--sheets", action="store_true", help="draw docs/images/real_interiors.jpg")
    options = parser.parse_args()
    if not (data_folder() / "exemplars").is_dir():
        sys.exit(f"no photographs at {data_folder()}; set GSFLUENT_DATA to the data folder")
    known = {}
    if LINES.is_file():
        known = {r["class"]: r for r in map(json.loads, LINES.read_text().splitlines())}
    pictures = {}
    for name in options.only or CASES:
        if name not in CASES:
            sys.exit(f"unknown class {name!r}; known: {', '.join(CASES)}".replace("%", "%%"))
        record, pictures[name] = judge(CASES[name], options.size)
        known[name] = record
        ratio = record["default"]["patch"] / record["floor"]["patch"]
        sys.stdout.write(f"{name}: {ratio:.2f} x floor\n")
        sys.stdout.flush()
    ordered = [known[name] for name in CASES if name in known]
    LINES.parent.mkdir(exist_ok=True)
    LINES.write_text("".join(json.dumps(r) + "\n" for r in ordered))
    if options.sheets:
        pixels = (sheet(pictures)[..., ::-1] * 255).round().astype(np.uint8)
        cv2.imwrite(str(SHEET), pixels, [cv2.IMWRITE_JPEG_QUALITY, 78])
    if options.write:
        PAGE.write_text(enter(PAGE.read_text(), "figures", table(ordered)))


if __name__ == "__main__":
    main()
