"""Meshes of the data folder as things to photograph, reconstruct and compare with.

Used by fill.py. Things can be kept in one .npz, so that a machine without trimesh or the
data folder can photograph and reconstruct them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from gsfluent.data import Capture, Gaussians
from gsfluent.io.images import load_view
from gsfluent.lab.truth.photograph import Mesh, around, marbled, photograph, textured

ROOT = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get("GSFLUENT_DATA", ROOT.parent / "shared" / "data")) / "meshes"
FILES = {
    "armadillo": "armadillo/armadillo.obj",
    "bell pepper": "bell_pepper/yellow_bell_pepper_no_stem_low.gltf",
    "bowl": "bowl/evo_bowl.gltf",
    "mango": "mango/mango-v1.glb",
    "penguin": "penguin/penguin.obj",
    "skull": "skull/skull_low_resolution.obj",
    "tea set": "tea_set/tea_set_01_1k.gltf",
    "teapot": "teapot/teapot.obj",
}
PLAIN = "tea set"  # white porcelain, which shows a camera nothing: photographed marbled ...
WHITE = ("tea set 3", "tea set 4")  # ... and these as they are as well


@dataclass(frozen=True)
class Thing:
    """One object of the data folder.

    Attributes:
        name: Of the file, with a number where the file holds several.
        corners: Triangles, float64 [F, 3, 3].
        normals: Unit normals at the corners, float32 [F, 3, 3].
        uv: Texture coordinates at the corners, float32 [F, 3, 2], or empty.
        texture: uint8 [H, W, 3], or empty.
    """

    name: str
    corners: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    texture: np.ndarray

    def mesh(self, device: torch.device | str = "cpu") -> Mesh:
        """Ready for its photograph."""
        corners = torch.from_numpy(self.corners).float().to(device)
        if self.texture.size:
            image = torch.from_numpy(self.texture / np.float32(255.0)).to(device)
            color = textured(image, torch.from_numpy(self.uv).to(device))
        else:
            extent = float(np.ptp(self.corners.reshape(-1, 3), axis=0).max())
            color = marbled(extent, device=device)
        return Mesh(corners, torch.from_numpy(self.normals).to(device), color)

    def surface(self):  # type: ignore[no-untyped-def]
        """The mesh with its seams welded, of trimesh."""
        import trimesh

        faces = np.arange(3 * len(self.corners)).reshape(-1, 3)
        mesh = trimesh.Trimesh(self.corners.reshape(-1, 3), faces, process=False)
        mesh.merge_vertices()
        return mesh


def things(names: list[str] | None = None) -> list[Thing]:
    """All objects of the data folder; the tea set is its parts, without copies of one shape.

    Its texture is white porcelain. It gets the procedural colour of the meshes without texture, and
    two of its parts come in white as well.
    """
    import trimesh

    found: list[Thing] = []
    for name, file in FILES.items():
        if not (DATA / file).is_file():
            continue
        scene = trimesh.load(str(DATA / file))
        parts = scene.dump() if isinstance(scene, trimesh.Scene) else [scene]
        volumes: list[float] = []
        for part in parts:
            if any(abs(part.volume / other - 1.0) < 1e-4 for other in volumes):
                continue
            volumes.append(float(part.volume))
            label = f"{name} {len(volumes)}" if len(parts) > 1 else name
            made = _thing(label, part)
            variants = [made]
            if name == PLAIN:
                variants = [replace(made, uv=made.uv[:0], texture=made.texture[:0, :0])]
                if label in WHITE:
                    variants.append(replace(made, name=f"{label} white"))
            for thing in variants:
                if names is None or thing.name in names or name in names:
                    found.append(thing)
    return found


def _thing(name: str, part) -> Thing:  # type: ignore[no-untyped-def]
    faces = np.asarray(part.faces)
    picture = getattr(getattr(part.visual, "material", None), "baseColorTexture", None)
    uv, texture = np.zeros((0, 3, 2), np.float32), np.zeros((0, 0, 3), np.uint8)
    if picture is not None:
        uv = np.asarray(part.visual.uv, dtype=np.float32)[faces]
        texture = np.array(picture.convert("RGB").resize((1024, 1024)))
    normals = np.asarray(part.vertex_normals, dtype=np.float32)[faces]
    return Thing(name, np.asarray(part.vertices, dtype=np.float64)[faces], normals, uv, texture)


def pack(path: Path, kept: list[Thing]) -> None:
    """Write things to one .npz."""
    values = {}
    for thing in kept:
        for part in ("corners", "normals", "uv", "texture"):
            values[f"{thing.name}/{part}"] = getattr(thing, part)
    np.savez_compressed(path, **values)


def unpack(path: Path, names: list[str] | None = None) -> list[Thing]:
    """Read what :func:`pack` wrote."""
    with np.load(path) as values:
        known = list(dict.fromkeys(key.split("/")[0] for key in values.files))
        return [
            Thing(name, *(values[f"{name}/{p}"] for p in ("corners", "normals", "uv", "texture")))
            for name in known
            if names is None or name in names or name.split(" ")[0] in names
        ]


def capture_of(
    thing: Thing, folder: Path, views: int, size: int, device: torch.device | str = "cpu"
) -> Capture:
    """Photographs with masks from all around, kept in ``folder`` and taken only once."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    kept = sorted(folder.glob("*.webp"))
    if kept:  # what was photographed before, as many and as large as they were
        views = len(kept)
        with Image.open(kept[0]) as first:
            size = first.width
    mesh = thing.mesh(device)
    cameras = []
    for camera in around(mesh, views, size):
        path = folder / camera.name
        if not path.is_file():
            pixels = photograph(mesh, camera).cpu().numpy()
            picture = Image.fromarray((255.0 * pixels + 0.5).astype(np.uint8))
            picture.save(path, quality=90, method=2)  # its alpha is lossless
        cameras.append(camera.replace(image_path=path))
    return Capture(
        cameras, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), folder, load_view
    )


def save_splats(gaussians: Gaussians, path: Path) -> None:
    """Positions in float32, the rest in half precision: a third of a .ply."""
    half = {
        name: getattr(gaussians, name).cpu().half().numpy()
        for name in ("scales", "quats", "opacities", "sh")
    }
    half["scales"] = gaussians.scales.cpu().float().log().half().numpy()
    np.savez(path, means=gaussians.means.cpu().float().numpy(), **half)


def load_splats(path: Path) -> Gaussians:
    """Read what :func:`save_splats` wrote."""
    with np.load(path) as values:
        part = {name: torch.from_numpy(values[name]).float() for name in values.files}
    return Gaussians(
        means=part["means"],
        quats=part["quats"],
        scales=part["scales"].exp(),
        opacities=part["opacities"],
        sh=part["sh"],
    )
