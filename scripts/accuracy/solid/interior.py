"""Interior Gaussians on objects whose inside is known: cut open, and checked by photographs.

    python scripts/accuracy/solid/interior.py --cache out/interior [--meshes out/fill] [--write]

Table one cuts the demo melon, wearing its true colours, through the middle and draws it from the
cut side: graded Gaussians beside a uniform lattice. Table two fills trained objects and counts what
lies outside the true solid, and what held-out photographs lose. --meshes is the cache folder of
fill.py, whose photographs and splats of the meshes in GSFLUENT_DATA are used.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent import demo
from gsfluent.data import INTERIOR, Camera, Capture, Gaussians
from gsfluent.draw import draw
from gsfluent.figure.markdown import enter
from gsfluent.io import load_capture, load_splats, save_splats
from gsfluent.pipeline import Isolate, Reconstruct, Texture
from gsfluent.pipeline.fill.interior import INTERIOR_OPACITY, interior_gaussians
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.reconstruct.init import _quats_of
from gsfluent.pipeline.texture.volume.domain import InteriorTexture

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "interior_gaussians.md"
SIZE = 512  # pixels of the cut
SPLATS = 30_000  # on the skin of the known melon
HELD = 8  # every eighth photograph is kept from training and from the refinement
DEMOS = (("watermelon", "none"), ("orange", "none"), ("watermelon", "table"), ("orange", "table"))


def lattice(inside: np.ndarray, depth: np.ndarray, spacing: float) -> tuple[np.ndarray, float]:
    """The uniform jittered lattice that fill used before: points and deviation [voxels]."""
    sigma = 0.55 * spacing
    low, high = (f(np.argwhere(inside), axis=0) for f in (np.min, np.max))
    lines = [np.arange(a, b + 1 + spacing, spacing) for a, b in zip(low, high, strict=True)]
    cell = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    shift = 0.5 + 0.6 * (np.random.default_rng(0).random(cell.shape) - 0.5)
    point = cell + shift * spacing
    at = np.minimum(point.astype(int), np.array(inside.shape) - 1)
    deep = inside & (depth > min(2.0 * sigma, 1.5))
    return point[deep[tuple(at.T)]], sigma


class Melon:
    """The demo melon as a volume and a skin of splats, and its true cuts."""

    def __init__(self, resolution: int) -> None:
        self.fruit = demo.make_object("watermelon", 0)
        low, high = self.fruit.bounds()
        self.voxel = float((high - low).max()) / resolution
        self.origin = (low - 3 * self.voxel).numpy()
        shape = [math.ceil(float(e) / self.voxel) + 6 for e in high - low]
        grid = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in shape], indexing="ij"), -1)
        points = torch.from_numpy(self.origin + grid.reshape(-1, 3) * self.voxel)
        self.inside = self.fruit.inside(points).reshape(shape).numpy()
        color = np.zeros((*shape, 3), np.float32)
        color[self.inside] = self.fruit.interior(points[self.inside.reshape(-1)]).numpy()
        self.volume = InteriorTexture(color, np.zeros(shape, np.int32))
        from scipy import ndimage

        edt = ndimage.distance_transform_edt(self.inside) - 0.5
        self.depth = np.where(self.inside, edt, 0.0).astype(np.float32)
        self.skin = self._skin()
        self.truth = [self._cut(axis) for axis in (0, 1)]

    def _skin(self) -> Gaussians:
        way = torch.randn(SPLATS, 3, generator=torch.Generator().manual_seed(0)).double()
        start = self.fruit.center + 3.0 * max(self.fruit.axes) * way / way.norm(dim=1)[:, None]
        hits = torch.cat([self.fruit.intersect(s, (self.fruit.center - s)[None])[1] for s in start])
        size = 0.6 * math.sqrt(0.14 / SPLATS)  # area of the melon: 0.14 m^2
        scales = torch.tensor([size, size, 0.2 * size]).repeat(len(hits), 1)
        turn = _quats_of(self.fruit.normal(hits).float())
        color = self.fruit.surface_color(hits)
        return Gaussians.from_colors(hits.float(), scales, color, opacities=0.95, quats=turn)

    def camera(self, axis: int) -> Camera:
        eye = self.fruit.center.clone()
        eye[axis] -= 0.6
        return Camera.look_at(eye, self.fruit.center, width=SIZE, height=SIZE, fov=27.0)

    def _cut(self, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """True picture [H, W, 3], coverage and depth below the skin [m], each [H, W]."""
        camera = self.camera(axis).resized(2 * SIZE, 2 * SIZE)
        line = torch.arange(2 * SIZE, dtype=torch.float64) + 0.5
        v, u = torch.meshgrid(line, line, indexing="ij")
        K, view = camera.K.double(), camera.viewmat.double()
        ray = torch.stack(
            [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1
        ).reshape(-1, 3)
        ray = ray @ view[:3, :3]
        eye = -(view[:3, :3].T @ view[:3, 3])
        along = (self.fruit.center[axis] - eye[axis]) / ray[:, axis]
        points = eye + along[:, None] * ray
        inside = self.fruit.inside(points)
        color = torch.zeros(len(points), 3)
        color[inside] = self.fruit.interior(points[inside])
        depth = torch.where(inside, self.fruit.depth(points), 0.0)

        def mean(value: Tensor) -> Tensor:
            return value.float().view(SIZE, 2, SIZE, 2, -1).mean((1, 3))

        cover = mean(inside)
        return mean(color) / cover.clamp_min(1e-6), cover[..., 0], mean(depth)[..., 0]

    def judged(self, points: np.ndarray, sigmas: Any) -> list[float]:
        """PSNR of the face and its rim, sharpness, holes and the least coverage, over two cuts."""
        from scipy import ndimage

        color = torch.from_numpy(self.volume.sample(points, self.inside))
        inner = Gaussians.from_colors(
            torch.from_numpy(self.origin + points * self.voxel).float(),
            torch.as_tensor(sigmas, dtype=torch.float32).expand(len(points)) * self.voxel,
            color,
            opacities=INTERIOR_OPACITY,
        )
        whole = Gaussians.cat([self.skin, inner])
        figures = []
        for axis, (image, cover, depth) in enumerate(self.truth):
            half = whole.select(whole.means[:, axis] >= float(self.fruit.center[axis]))
            drawn = draw(half, self.camera(axis), antialiased=True)
            face = torch.from_numpy(ndimage.binary_erosion((cover > 0.999).numpy(), iterations=2))
            error = (drawn.image - image).square().mean(-1)
            rim = face & (depth < 0.012)
            sharp = (
                gradient(drawn.image)[face[1:, 1:]].mean() / gradient(image)[face[1:, 1:]].mean()
            )
            alpha = drawn.alpha[face]
            figures.append(
                [psnr(error[face]), psnr(error[rim]), float(sharp)]
                + [100.0 * float((alpha < 0.99).float().mean()), float(alpha.min())]
            )
        return np.mean(figures, axis=0).tolist()


def psnr(error: Tensor) -> float:
    return float(-10.0 * torch.log10(error.mean()))


def gradient(image: Tensor) -> Tensor:
    grey = image.mean(-1)
    return (grey[1:, 1:] - grey[:-1, 1:]).hypot(grey[1:, 1:] - grey[1:, :-1])


def placement(resolution: int) -> str:
    """Table one."""
    melon = Melon(resolution)
    inside, depth = torch.from_numpy(melon.inside), torch.from_numpy(melon.depth)
    skin = float(melon.skin.scales.amax()) / melon.voxel

    def graded(core: float, bound: int) -> tuple[np.ndarray, Tensor]:
        found = interior_gaussians(
            inside, depth, torch.zeros(3), 1.0, skin=0.75 * skin / 0.45, core=core, max_count=bound
        )
        return found.centers.numpy(), found.sigmas

    cases: list[tuple[str, Callable[[], tuple[np.ndarray, Any]]]] = [
        ("uniform, 1.25 voxels (before)", lambda: lattice(melon.inside, melon.depth, 1.25)),
        ("uniform, 1 voxel", lambda: lattice(melon.inside, melon.depth, 1.0)),
        ("**graded, core 1.25 (default)**", lambda: graded(1.25, 10**9)),
        ("graded, as many as before", lambda: graded(1.25, len(cases[0][1]()[0]))),
        ("graded, core 1", lambda: graded(1.0, 10**9)),
        ("graded, at most 30 000", lambda: graded(1.25, 30_000)),
    ]
    rows = [
        "| placement | Gaussians | PSNR face | rim | sharpness | holes | least cover | CPU s |",
        "| --- " * 8 + "|",
    ]
    for name, make in cases:
        began = time.process_time()
        points, sigmas = make()
        spent = time.process_time() - began
        face, rim, sharp, holes, least = melon.judged(points, sigmas)
        rows.append(
            f"| {name} | {len(points)} | {face:.2f} | {rim:.2f} | {sharp:.2f} | {holes:.2f} % | "
            f"{least:.2f} | {spent:.2f} |"
        )
        sys.stderr.write(rows[-1] + "\n")
    return "\n".join(rows)


Case = tuple[str, Gaussians, Capture, Callable[[Tensor], Tensor], dict[str, Any]]


def demos(cache: Path) -> Iterator[Case]:
    """Trained demo fruit, floating with masks and on a table without."""
    for name, support in DEMOS:
        folder = cache / f"{name}_{support}"
        if not (folder / "transforms.json").is_file():
            demo.make_capture(
                name, folder, views=42, size=256, support=support, masks=support == "none"
            )
        capture = load_capture(folder)
        path = folder / "object.ply"
        if not path.is_file():
            whole = Reconstruct(800, 30_000)(capture)
            save_splats(Isolate().split(whole, capture)[0], path)
        label = f"{name}, " + ("masks" if support == "none" else "on a table, no masks")
        texture = {"exemplar": str(folder / "cut.png"), "quality": "preview"}
        yield label, load_splats(path), capture, demo.make_object(name, 0).depth, texture


def meshes(cache: Path, names: list[str]) -> Iterator[Case]:
    """Meshes that fill.py photographed and reconstructed."""
    from mesh_captures import capture_of, things
    from mesh_captures import load_splats as load_kept

    from gsfluent.pipeline.solid.source import find_solid

    for thing in things(names):
        kept = cache / f"{thing.name.replace(' ', '_')}.npz"
        if not kept.is_file():
            sys.stderr.write(f"{thing.name}: no {kept.name} in the cache, left out\n")
            continue
        capture = capture_of(thing, kept.with_suffix(""), 96, 640)
        truth = find_solid(mesh=thing.surface(), resolution=160)
        yield thing.name, load_kept(kept), capture, lambda x, t=truth: -t.at(x), {}


def held_out(gaussians: Gaussians, capture: Capture) -> float:
    """PSNR of the photographs kept back, before white where there are masks [dB]."""
    figures = []
    for index in range(0, len(capture), HELD):
        view = capture.view(index, 320)
        drawn = draw(gaussians, view.camera)
        if view.mask is None:
            image, truth, judged = drawn.image, view.image, drawn.alpha > 0.5
        else:
            white = 1.0 - view.mask[..., None]
            image = drawn.image + 1.0 - drawn.alpha[..., None]
            truth = view.image * view.mask[..., None] + white
            judged = torch.ones_like(view.mask, dtype=torch.bool)
        figures.append(psnr((image - truth).square().mean(-1)[judged]))
    return float(np.mean(figures))


def spill(gaussians: Gaussians, depth: Callable[[Tensor], Tensor]) -> tuple[float, float]:
    """Percent of the interior Gaussians outside, by centre and by one standard deviation."""
    assert gaussians.labels is not None
    inner = gaussians.select(gaussians.labels == INTERIOR)
    deep = depth(inner.means.double()).double()
    outside = [(deep < reach).double().mean() for reach in (0.0, inner.scales[:, 0].double())]
    return 100.0 * float(outside[0]), 100.0 * float(outside[1])


def refinement(cases: Iterator[Case], resolution: int) -> str:
    """Table two."""
    rows = [
        "| object | interior | spill before: centre (1 sigma) | after | removed | seen before "
        "| after | held out: skin alone | filled | textured | CPU s of the pass |",
        "| --- " * 11 + "|",
    ]
    for name, splats, capture, depth, texture in cases:
        shown = [c for i, c in enumerate(capture.cameras) if i % HELD]
        train = capture.replace(cameras=shown)
        times, solids = [], []
        for views in (0, 24):
            began = time.process_time()
            solids.append(Fill(resolution, refine_views=views)(splats, train))
            times.append(time.process_time() - began)
        before, after = (spill(solid.gaussians, depth) for solid in solids)
        report = solids[1].report
        alone, filled = held_out(splats, capture), held_out(solids[1].gaussians, capture)
        textured = "-"
        if texture:
            colored = Texture(**texture)(solids[1], train)
            textured = f"{held_out(colored.gaussians, capture) - alone:+.2f}"
        rows.append(
            f"| {name} | {report['interior_gaussians']} | {before[0]:.3f} % ({before[1]:.2f} %) | "
            f"{after[0]:.3f} % ({after[1]:.2f} %) | {report['pruned']} | "
            f"{100 * report['seen_before']:.1f} % | {100 * report['seen_after']:.1f} % | "
            f"{alone:.2f} dB | {filled - alone:+.2f} | {textured} | {times[1] - times[0]:.1f} |"
        )
        sys.stderr.write(rows[-1] + "\n")
    return "\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, required=True, help="folder of the demo captures")
    parser.add_argument("--meshes", type=Path, help="cache folder of fill.py")
    parser.add_argument("--only", nargs="*", default=["mango", "penguin", "armadillo", "bowl"])
    parser.add_argument("--resolution", type=int, default=96)
    parser.add_argument("--tables", nargs="*", default=["placement", "refinement"])
    parser.add_argument("--write", action="store_true", help=f"enter the tables into {PAGE.name}")
    given = parser.parse_args()
    text = PAGE.read_text(encoding="utf-8")
    for name in given.tables:
        if name == "placement":
            table = placement(given.resolution)
        else:
            cases = [demos(given.cache)] + (
                [meshes(given.meshes, given.only)] if given.meshes else []
            )
            table = refinement((case for part in cases for case in part), given.resolution)
        sys.stdout.write(table + "\n")
        text = enter(text, name, table)
    if given.write:
        PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
