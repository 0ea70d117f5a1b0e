"""Measure sources of the solid against meshes whose inside is known; docs/measured/solid.md.

    python scripts/accuracy/solid/sources.py [--resolution 96] [--only torus skull] [--write]

Analytic shapes always; the meshes of the data folder (GSFLUENT_DATA, or ../shared/data beside the
checkout) when it is there. Splats are 40 000 discs on the true surface; masks are the mesh's own
silhouettes from 48 cameras. The last row is a demo melon trained on its photographs.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent import demo
from gsfluent.data import Capture, Gaussians
from gsfluent.figure.markdown import enter
from gsfluent.io import load_capture
from gsfluent.io.images import load_view
from gsfluent.pipeline import Reconstruct
from gsfluent.pipeline.reconstruct.init import _quats_of
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.source import find_solid
from gsfluent.pipeline.solid.tsdf import ring_of_cameras
from gsfluent.spatial.mesh_distance import load_mesh

ROOT = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data")) / "meshes"
SIZE = 400  # pixels of the masks
TRAINED = "watermelon, trained"
METHODS = (("hull", True), ("density", False), ("tsdf", False), ("auto", True))
PAGE = ROOT / "docs" / "measured" / "solid.md"
FILES = {
    "skull": "skull/skull_low_resolution.obj",
    "armadillo": "armadillo/armadillo.obj",
    "penguin": "penguin/penguin.obj",
    "bowl": "bowl/evo_bowl.gltf",
    "bell pepper": "bell_pepper/yellow_bell_pepper_no_stem_low.gltf",
    "mango": "mango/mango-v1.glb",
}


def shapes() -> dict[str, Any]:
    import trimesh

    made = trimesh.creation
    found = {
        "sphere": made.icosphere(subdivisions=4),
        "torus": made.torus(1.0, 0.4, major_sections=64, minor_sections=32),
        "box": made.box((1.0, 0.7, 0.5)),
    }
    for name, file in FILES.items():
        if (DATA / file).is_file():
            mesh = load_mesh(DATA / file)
            if mesh.is_watertight:
                found[name] = mesh
    return found


def discs(mesh: Any, count: int = 40_000) -> Gaussians:
    """Flat splats on the surface of a mesh."""
    import trimesh

    points, face = trimesh.sample.sample_surface_even(mesh, count, seed=0)
    if len(points) < 0.5 * count:  # rejection leaves too few on slivers
        points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    normal = torch.from_numpy(mesh.face_normals[face].copy()).float()
    radius = float(np.sqrt(mesh.area / len(points)))
    scales = torch.tensor([0.5 * radius, 0.5 * radius, 0.15 * radius]).repeat(len(points), 1)
    colors = torch.full((len(points), 3), 0.6)
    means = torch.from_numpy(points.copy()).float()
    return Gaussians.from_colors(means, scales, colors, opacities=0.95, quats=_quats_of(normal))


def masked_capture(mesh: Any, folder: Path) -> Capture:
    """Silhouettes of a mesh from a sphere of cameras, as photographs with an alpha channel."""
    import cv2
    from PIL import Image

    vertices = torch.from_numpy(np.asarray(mesh.vertices, dtype=np.float64))
    low, high = vertices.amin(0), vertices.amax(0)
    cameras = []
    for index, near in enumerate(
        ring_of_cameras(0.5 * (low + high), 0.5 * float((high - low).norm()))
    ):
        camera, large = near.resized(SIZE, SIZE), near.resized(4 * SIZE, 4 * SIZE)
        pixel, _ = large.project(vertices)
        # OpenCV's pixel centres are whole numbers; four more bits of position
        corners = ((pixel.numpy() - 0.5) * 16).round().astype(np.int32)[np.asarray(mesh.faces)]
        mask = np.zeros((4 * SIZE, 4 * SIZE), dtype=np.uint8)
        for triangle in corners:
            cv2.fillConvexPoly(mask, triangle, 255, shift=4)
        mask = cv2.resize(mask, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        picture = np.full((SIZE, SIZE, 4), 128, dtype=np.uint8)
        picture[..., 3] = mask
        path = folder / f"{index:03d}.png"
        Image.fromarray(picture).save(path)
        cameras.append(camera.replace(image_path=path, name=path.name))
    return Capture(
        cameras, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), folder, load_view
    )


def trained() -> tuple[Gaussians, SignedDistance, Any]:
    """A melon reconstructed from photographs, its true solid, and the folder of them."""
    folder = tempfile.TemporaryDirectory()
    demo.make_capture("watermelon", folder.name, views=42, size=160)
    gaussians = Reconstruct(400, 20_000, image_size=160)(load_capture(folder.name))
    fruit = demo.make_object("watermelon", 0)
    low, high = fruit.bounds()
    voxel = float((high - low).max()) / 128
    axes = [torch.arange(low[i] + 0.5 * voxel, high[i] + voxel, voxel) for i in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    inside = fruit.inside(grid.reshape(-1, 3).double()).reshape(grid.shape[:3])
    truth = SignedDistance.of_voxels(inside.numpy(), low.double().numpy(), voxel, "truth")
    return gaussians, truth, folder


def compared(field: SignedDistance, truth: SignedDistance) -> tuple[float, float]:
    """Intersection over union at the voxel centres of the truth, and relative volume error."""
    size = torch.tensor(truth.values.shape)
    axes = [torch.arange(int(n)) + 0.5 for n in size]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    guess = field.at(truth.origin + grid * truth.voxel) <= 0
    true = truth.inside.reshape(-1)
    union = float((guess | true).sum())
    return float((guess & true).sum()) / union, field.volume / truth.volume - 1.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--resolution", type=int, default=96)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--write", action="store_true", help="enter the table into the page")
    given = parser.parse_args()
    names = [
        method + (" + masks" if masks and method != "hull" else "") for method, masks in METHODS
    ]
    head = "| shape | " + " | ".join(f"{name}: IoU | volume | s" for name in names) + " | mesh s |"
    rows = [head, "| --- " * (3 * len(METHODS) + 2) + "|"]
    for name, mesh in (shapes() | {TRAINED: None}).items():
        if given.only and name not in given.only:
            continue
        if mesh is None:
            splats, truth, kept = trained()
            folder, exact = kept.name, "-"
            capture = load_capture(folder)
        else:
            began = time.process_time()
            truth = find_solid(mesh=mesh, resolution=given.resolution)
            exact = f"{time.process_time() - began:.1f}"
            splats, kept = discs(mesh), tempfile.TemporaryDirectory()
            capture = masked_capture(mesh, Path(kept.name))
        cells = [name]
        for method, masks in METHODS:
            began = time.process_time()
            field = find_solid(
                None if method == "hull" else splats,
                capture if masks else None,
                method=method,
                resolution=given.resolution,
            )
            spent = time.process_time() - began
            iou, volume = compared(field, truth)
            cells += [f"{iou:.3f}", f"{100 * volume:+.1f} %", f"{spent:.1f}"]
        kept.cleanup()
        rows.append("| " + " | ".join([*cells, exact]) + " |")
        sys.stderr.write(rows[-1] + "\n")
    table = "\n".join(rows)
    sys.stdout.write(table + "\n")
    if given.write:
        PAGE.write_text(enter(PAGE.read_text(encoding="utf-8"), "accuracy", table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
