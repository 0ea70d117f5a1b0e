"""A real splat model carried by a mesh animation, against the same motion in closed form.

python scripts/accuracy/carry.py /tmp/carried --splats dog.ply

A hull of triangles about the model turns, moves along an arc and grows, for 100 frames: a
similarity, which a mesh carries exactly. `gsfluent carry` does the work from files, the frames that
it leaves are opened again, and held against centres, covariances and colours moved by the formulas
of 3DGS; one camera draws both.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent import geometry
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.figure.markdown import enter
from gsfluent.io import load_splats
from gsfluent.io.sequences import Sequence, read_sequence
from gsfluent.pipeline import Carry
from gsfluent.results.frames import load_frame

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "carry.md"
DOG = "splats/plush_dog/point_cloud_29999_clean.ply"
FRAMES, FPS = 100, 25.0


def similarity(k: int) -> tuple[float, torch.Tensor, torch.Tensor]:
    """Size, rotation and shift of a frame; the last turns by 200 degrees about a skew axis."""
    part = k / (FRAMES - 1)
    axis = torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64)
    x, y, z = (math.radians(200.0) * part * axis / axis.norm()).tolist()
    spin = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    shift = torch.tensor([part, 0.5 * math.sin(math.pi * part), part * part], dtype=torch.float64)
    return 1.0 + 0.4 * part, torch.linalg.matrix_exp(spin), shift


def animation(model: Gaussians, path: Path) -> int:
    """Write a moving hull about the model; how many triangles it has."""
    import trimesh

    hull = trimesh.convex.convex_hull(model.means.double().numpy()[::10])
    hull = hull.subdivide().subdivide()
    rest = torch.from_numpy(np.asarray(hull.vertices))
    frames = []
    for k in range(FRAMES):
        size, turn, shift = similarity(k)
        frames.append((size * rest @ turn.T + shift).numpy())
    np.savez(path, positions=np.stack(frames), faces=np.asarray(hull.faces), fps=FPS)
    return len(hull.faces)


def closed(model: Gaussians, k: int) -> Gaussians:
    """The model in a frame, by the formulas."""
    size, turn, shift = similarity(k)
    quats = geometry.quaternion_multiply(
        geometry.matrix_to_quaternion(turn[None]), model.quats.double()
    )
    return model.replace(
        means=(size * model.means.double() @ turn.T + shift).float(),
        scales=(size * model.scales.double()).float(),
        quats=quats.float(),
        sh=geometry.rotate_sh(model.sh, turn.float().expand(model.count, 3, 3)),
    )


def spread(model: Gaussians) -> torch.Tensor:
    """Covariances, [N, 6]."""
    return geometry.covariance(model.quats.double(), model.scales.double())


def apart(found: Gaussians, wanted: Gaussians, size: float, picture: bool) -> list[float]:
    """Largest difference of centres, covariances, colours and pixels."""
    means, own = wanted.means.double(), spread(wanted)
    gap = (spread(found) - own).abs().amax(dim=1) / own.abs().amax(dim=1)
    shown = 0.0
    if picture:
        middle = means.mean(dim=0)
        eye = middle + 1.6 * size * torch.tensor([0.8, -0.6, 0.3], dtype=torch.float64)
        camera = Camera.look_at(eye, middle, width=320, height=240)
        shown = float((draw(found, camera).image - draw(wanted, camera).image).abs().max())
    return [
        float((found.means.double() - means).abs().max()) / size,
        float(gap.max()), float((found.sh - wanted.sh).abs().max()), shown,
    ]  # fmt: skip


def compare(out: Path, model: Gaussians, motion: Sequence) -> list[list[float]]:
    """Largest differences over all frames: of what the stage gives, of what lies in the folder."""
    size = float((model.means.amax(dim=0) - model.means.amin(dim=0)).max())
    worst = np.zeros((2, 4))
    for k, frame in enumerate(Carry()(model, motion)):
        wanted = closed(model, k)
        kept = load_frame(out / "stages" / "simulate", k).gaussians
        both = [apart(g, wanted, size, k % 11 == 0) for g in (frame.gaussians, kept)]
        worst = np.maximum(worst, both)
    return worst.tolist()


def table(facts: dict[str, Any]) -> str:
    """What was measured, in lines."""
    lines = ["| largest difference of | from Python | in the folder | bar |", "| --- " * 4 + "|"]
    words = (
        "centres, of the size of the model", "covariances, of their own",
        "coefficients of colour", "pixels, of 1, ten frames",
    )  # fmt: skip
    for word, here, kept in zip(words, *facts["apart"], strict=True):
        lines.append(f"| {word} | {here:.1e} | {kept:.1e} | 1e-5 |")
    lines += ["", f"{facts['splats']} splats, {facts['triangles']} triangles, {FRAMES} frames."]
    return "\n".join(lines)


def main() -> None:
    """Carry, compare, enter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    data = Path(os.environ.get("GSFLUENT_DATA", "../shared/data"))
    parser.add_argument("--splats", type=Path, default=data / DOG)
    parser.add_argument("--markdown", type=Path, default=PAGE)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    model = load_splats(options.splats)
    moving, out = options.out / "hull.npz", options.out / "carried"
    triangles = animation(model, moving)
    words = ["carry", str(options.splats), "--by", str(moving), "-o", str(out)]
    subprocess.run([sys.executable, "-m", "gsfluent", *words], check=True)
    facts = {"splats": model.count, "triangles": triangles,
             "apart": compare(out, model, read_sequence(moving, None))}  # fmt: skip
    page: Path = options.markdown
    text = page.read_text(encoding="utf-8") if page.is_file() else "# Carried splats\n"
    page.write_text(enter(text, "carry", table(facts)), encoding="utf-8")
    print(table(facts))


if __name__ == "__main__":
    main()
