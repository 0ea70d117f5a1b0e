"""The ablation of interior texturing: exemplar, colour copy, 2-D inpainting, diffusion.

Known interiors are textured from their surface and one photographed slice, and judged on planes
that no method has seen, beside other draws of the same class (the floor). The diffusion rows run
a tiny pipeline with random weights: they show that the path works end to end, nothing else; a real
model's folder goes with --model. With --write tables and pictures go into docs/.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsfluent.figure.markdown import enter
from gsfluent.lab.truth.interiors import KnownInterior, known_interior
from gsfluent.lab.truth.interiors_judge import Judge
from gsfluent.pipeline.texture.baselines import color_copy, telea_slices
from gsfluent.pipeline.texture.inpaint.method import InpaintOptions, diffusion_texture
from gsfluent.pipeline.texture.photo.exemplar import load_exemplars
from gsfluent.pipeline.texture.photo.metrics import lab_histogram_distance, patch_distance
from gsfluent.pipeline.texture.synthesis.method import exemplar_texture
from gsfluent.pipeline.texture.volume.domain import options_of

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "inpainting.md"
SHOWN = (2, 4, 7)  # planes of the sheet: across y, across z, oblique

Maker = Callable[[KnownInterior], np.ndarray]


def slices(model: str | None = None, photo: bool = True, **options: Any) -> Maker:
    """The slice method with some options, with the photograph or without."""

    def make(known: KnownInterior) -> np.ndarray:
        given = {"slices": known.domain.inside.shape[0], **options}
        texture = diffusion_texture(
            known.domain,
            model,
            prompt=f"cross section of a {known.name}",
            options=options_of(InpaintOptions, "inpaint", given),
            exemplar=load_exemplars(known.exemplars()) if photo else None,
        )
        return texture.rgb

    return make


def patches(known: KnownInterior) -> np.ndarray:
    """The default method."""
    photos = load_exemplars(known.exemplars())
    return exemplar_texture(known.domain, photos, **known.settings).rgb


def methods(model: str) -> dict[str, Maker]:
    """Name to method, in the order of the table."""
    own = {"backend": "exemplar"}
    sdxl = {"slices": 16, "refine": [0.3], "steps": 4, "size": 64, "tile": 2, "batch": 4}
    return {
        "colour copy": lambda k: color_copy(k.domain).rgb,
        "Telea, slices along X": lambda k: telea_slices(k.domain, (0,)).rgb,
        "Telea, mean of X, Y, Z": lambda k: telea_slices(k.domain).rgb,
        "colour diffusion, X then XYZ": slices(photo=False, backend="color", refine=[0.3]),
        "2-D patches, slices along X": slices(**own, refine=[]),
        "2-D patches, X then XYZ once": slices(**own, refine=[0.3]),
        "2-D patches, X then XYZ twice": slices(**own, refine=[0.3, 0.2]),
        "2-D patches, X then XYZ four times": slices(**own, refine=[0.3, 0.3, 0.2, 0.2]),
        "2-D patches, coupled from the coarsest level": slices(
            **own, schedule="coupled", refine=[0.5, 0.3]
        ),
        "**exemplar (default)**": patches,
        "diffusion, random weights (plumbing only)": slices(model, photo=False, **sdxl),
    }


def tiny(folder: Path) -> str:
    """The random pipeline of the tests."""
    sys.path.insert(0, str(ROOT / "tests" / "pipeline" / "texture"))
    import tiny_diffusers

    return str(tiny_diffusers.save_sdxl(folder))


def row(name: str, figures: dict[str, Any], seconds: float | None) -> str:
    """A line of the table."""
    near = " / ".join(f"{v:.2f}" for v in figures["neighbour"])
    ratio = figures["ratio"]["patch"] if "ratio" in figures else 1.0
    cost = "-" if seconds is None else f"{seconds:.1f}"
    cells = [f"{figures[k]:.2f}" for k in ("patch", "hist", "sharp", "radial")]
    return f"| {name} | {cells[0]} | {ratio:.1f} | {' | '.join(cells[1:])} | {near} | {cost} |"


def photograph(known: KnownInterior, judge: Judge) -> str:
    """The line of the photographs alone: what they know is all that a method can take from them."""
    cut = [(p[..., :3], p[..., 3] > 0.5) for p in known.exemplars().values()]
    colors = [np.concatenate([image[mask] for image, mask in set_]) for set_ in (cut, judge.truth)]
    patch = patch_distance(cut, judge.truth)
    ratio = patch / judge.floor["patch"]
    hist = lab_histogram_distance(*colors)
    return f"| *the photograph itself* | {patch:.2f} | {ratio:.1f} | {hist:.2f} | - | - | - | - |"


def sheet(pictures: dict[str, list[np.ndarray]], path: Path) -> None:
    """One row per method, one column per plane."""
    from PIL import Image, ImageDraw

    edge, label, gap = 132, 190, 3
    rows = len(pictures)
    width = label + len(SHOWN) * (edge + gap)
    paper = Image.new("RGB", (width, rows * (edge + gap)), "white")
    draw = ImageDraw.Draw(paper)
    for r, (name, planes) in enumerate(pictures.items()):
        words = name.replace("*", "").replace(", ", ",\n").replace(" (", "\n(")
        draw.text((6, r * (edge + gap) + edge // 3), words, fill="black")
        for c, picture in enumerate(planes):
            pixels = Image.fromarray((picture.clip(0, 1) * 255).astype(np.uint8))
            paper.paste(
                pixels.resize((edge, edge), Image.Resampling.LANCZOS),
                (label + c * (edge + gap), r * (edge + gap)),
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    paper.save(path, quality=88)


def ablate(
    name: str, size: int, draws: int, makers: dict[str, Maker]
) -> tuple[str, dict[str, list[np.ndarray]]]:
    """Table and pictures of one class."""
    known = known_interior(name, size, seed=0)
    others = [known_interior(name, size, seed=s + 1) for s in range(draws)]
    judge = Judge(known, others)
    inside = known.domain.inside
    pictures: dict[str, list[np.ndarray]] = {}

    def shown(rgb: np.ndarray) -> list[np.ndarray]:
        planes = judge.slices(known, np.where(inside[..., None], rgb, 1.0))
        seen = [np.where(mask[..., None], image, 1.0) for image, mask in planes]
        rim = max(1, round(0.08 * size))
        return [seen[i][rim:-rim, rim:-rim] for i in SHOWN]

    pictures["truth"] = shown(known.rgb)
    rows = [row("*another draw (floor)*", judge.floor, None)]
    rows.append(photograph(known, judge))
    print(*rows, sep="\n", flush=True)
    for label, make in makers.items():
        began = time.process_time()
        rgb = make(known)
        seconds = time.process_time() - began
        rgb = np.where(known.domain.shell[..., None], known.domain.skin, rgb)
        rows.append(row(label, judge(rgb), seconds))
        pictures[label] = shown(rgb)
        print(rows[-1], flush=True)
    head = (
        f"{name}, {size}^3, floor from {draws} other draws\n\n"
        "| method | patches | times the floor | colours | sharpness | radial | "
        "neighbour slices X / Y / Z | CPU s |\n| --- | --- | --- | --- | --- | --- | --- | --- |\n"
    )
    return head + "\n".join(rows), pictures


def main() -> None:
    """Measure; print; write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--names", nargs="+", default=["watermelon", "marble"])
    parser.add_argument("--size", type=int, default=64, help="voxels along an edge")
    parser.add_argument("--draws", type=int, default=3, help="other draws behind the floor")
    parser.add_argument("--model", help="diffusers inpainting model (folder or hub id)")
    parser.add_argument("--only", help="only methods whose name holds this text")
    parser.add_argument("--sheets", type=Path, help="folder for the pictures (default docs/images)")
    parser.add_argument("--write", action="store_true", help="enter tables and pictures in docs/")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        makers = methods(given.model or tiny(Path(folder)))
        if given.only:
            makers = {k: v for k, v in makers.items() if given.only in k}
        for name in given.names:
            table, pictures = ablate(name, given.size, given.draws, makers)
            if given.sheets:
                sheet(pictures, given.sheets / f"inpainting_{name}.jpg")
            if given.write:
                sheet(pictures, ROOT / "docs" / "images" / f"inpainting_{name}.jpg")
                text = enter(PAGE.read_text(encoding="utf-8"), f"ablation-{name}", table)
                PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
