"""Every reader of files that come from elsewhere, each with a small valid file."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
import signal
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import capture_files
import fuzz_containers as containers
import numpy as np
import torch
import viewer_scene
from PIL import Image

from gsfluent.config import Select, load_shot
from gsfluent.config.physgaussian.read import convert
from gsfluent.data import Frame, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.io import DeltaReader, load_capture, load_image, load_solid, load_splats, save_splats
from gsfluent.io.capture import load_poses
from gsfluent.io.segmentation import load_masks, load_segmentation
from gsfluent.io.solid import save_solid
from gsfluent.io.splats.delta import DeltaFrame
from gsfluent.io.splats.delta_write import Roster, steps, write_delta
from gsfluent.io.splats.splat import save_splat
from gsfluent.pipeline.light.environment import of_file
from gsfluent.pipeline.render.camera import read_path
from gsfluent.pipeline.texture.photo.parts import read_parts
from gsfluent.pipeline.texture.photo.read import read_pixels
from gsfluent.results.frames import load_frame, save_frame
from gsfluent.results.partition import SavedPartition, SavedSplit, load_partition, save_partition
from gsfluent.results.record import read_frame, shot_of
from gsfluent.run.report import read_run as read_record
from gsfluent.spatial.mesh_file import load_mesh, mesh_files
from gsfluent.spatial.mesh_surface import surface_points
from gsfluent.stages.select import select_mask
from gsfluent.stages.solids import _with_labels
from gsfluent.viewer.model.source import RunSource

SIZE = (24, 18)


@dataclasses.dataclass(frozen=True)
class Reader:
    """One reader and what it reads."""

    make: Callable[[Path], None]  # fills a folder
    target: str  # the file that is changed
    read: Callable[[Path], Any]  # of the folder
    take: Callable[[bytes], tuple[containers.Parts, containers.Join]] = containers.plain


def some_gaussians(count: int = 12, degree: int = 1) -> Gaussians:
    random = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    return Gaussians(
        normal(count, 3), normal(count, 4), normal(count, 3).exp(),
        torch.rand(count, generator=random), normal(count, (degree + 1) ** 2, 3),
        torch.ones(count, dtype=torch.int32),
    )  # fmt: skip


def cameras() -> list[Any]:
    return capture_files.ring(3, *SIZE)


def photographs(folder: Path) -> None:
    capture_files.write_images(folder / "images", cameras())


def colmap(text: bool) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        photographs(folder)
        params = [20.0, 20.0, 12.0, 9.0, 0.01, 0.0, 0.0, 0.0]
        place = folder / "sparse" / "0"
        capture_files.write_colmap(place, cameras(), "OPENCV", params, text)

    return make


def transforms(folder: Path) -> None:
    photographs(folder)
    shared = {"fl_x": 20.0, "w": SIZE[0], "h": SIZE[1], "k1": 0.01, "ply_file_path": "points.ply"}
    (folder / "points.ply").write_text(POINTS)
    capture_files.write_transforms(folder / "transforms.json", cameras(), shared)


def capture_and(**extra: Callable[[Path], None]) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        transforms(folder)
        for write in extra.values():
            write(folder)

    return make


POINTS = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
1 0 0.5 0 255 0
0 1e-1 0 0 0 255
3 0 1 2
"""


def labels() -> np.ndarray:
    table = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    table[3:9, 4:12] = 1
    table[10:15, 4:12] = 2
    return table


def picture(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def colors(width: int = 24, height: int = 18) -> np.ndarray:
    return (np.arange(height * width * 3) * 7 % 256).astype(np.uint8).reshape(height, width, 3)


def write(name: str, values: Any) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        text = values if isinstance(values, str) else json.dumps(values)
        (folder / name).write_text(text)

    return make


def image(name: str, values: np.ndarray | None = None) -> Callable[[Path], None]:
    return lambda folder: picture(folder / name, colors() if values is None else values)


def hdr(folder: Path) -> None:
    import cv2

    cv2.imwrite(str(folder / "sky.hdr"), colors(48, 24).astype(np.float32) / 255.0)


def delta(folder: Path) -> None:
    random = np.random.default_rng(2)
    frames = []
    for index in range(3):
        count = 9 - index
        quats = random.normal(size=(count, 4)).astype(np.float32)
        frames.append(
            DeltaFrame(
                index, index / 24, np.arange(count), np.arange(count, dtype=np.int32) % 2,
                random.normal(size=(count, 3)).astype(np.float32),
                quats / np.linalg.norm(quats, axis=1, keepdims=True),
                np.full((count, 3), 0.01, np.float32), np.full(count, 0.5, np.float32),
                random.normal(size=(count, 3)).astype(np.float32),
            )
        )  # fmt: skip
    roster = Roster()
    for frame in frames:
        roster.meet(frame)
    times = [frame.time for frame in frames]
    write_delta(folder / "a.gsd", frames, roster, times=times, fps=24.0, step=steps(1e-3),
                key_every=2)  # fmt: skip


def read_delta(folder: Path) -> list[Any]:
    reader = DeltaReader(folder / "a.gsd")
    return [reader.frame(index) for index in range(min(len(reader), 8))]


def solid(folder: Path) -> None:
    occupancy = torch.zeros(3, 4, 5, dtype=torch.bool)
    occupancy[1:, 1:3, 1:4] = True
    color = torch.rand(3, 4, 5, 3, generator=torch.Generator().manual_seed(3))
    save_solid(
        Solid(some_gaussians(), occupancy, 0.1 * occupancy, torch.zeros(3), 0.1, color=color,
              frame=Frame.identity()),
        folder / "a.ply",
    )  # fmt: skip


def small_frame(index: int) -> Any:
    whole = viewer_scene.frame(index)
    few = torch.arange(0, whole.gaussians.count, 40)
    return dataclasses.replace(
        whole, gaussians=whole.gaussians.select(few), carried=len(few), groups=whole.groups[few],
        ids=whole.ids[few], anchor=whole.anchor[few],
    )  # fmt: skip


def frames(folder: Path) -> None:
    place = folder / "stages" / "simulate"
    place.mkdir(parents=True)
    for index in range(2):
        save_frame(place, small_frame(index))
    write("stages/simulate/stage.json", {"fingerprint": "a", "complete": True})(folder)
    write("run.json", {"verdict": "clean", "render": {"hole_fraction": [0.0, 0.1]}})(folder)


def read_run(folder: Path) -> list[Any]:
    source = RunSource(folder)
    return [source.facts(0), source.running, source.revision, source.state()]


def partition(folder: Path) -> None:
    save_partition(
        folder,
        SavedPartition(
            rest=torch.rand(6, 3, generator=torch.Generator().manual_seed(4)),
            body=torch.zeros(6, dtype=torch.int64), carries=torch.ones(6, dtype=torch.bool),
            crumbs=torch.zeros(0, dtype=torch.int64), regions=1, bodies=(),
            splits=(SavedSplit(0, 1, torch.arange(6), torch.arange(6) % 2),),
        ),
    )  # fmt: skip


SHOT = """# a shot with most kinds of values
splats: a.ply
size: 1e-1
up: -y
gravity: [0, 0, -9.81]
objects:
  melon: &melon {material: fruit.watermelon, density: 950, young_modulus: 2e5}
events:
  - {type: drop, height: 1.0}
  - {type: bullet, at: 0.2, speed: 30, radius: 0.01, from: [2, 0, 0.2], toward: [0, 0, 0.05]}
solve: {quality: preview}
output: {seconds: 0.5, fps: 24, size: [320, 240]}
"""

SAM = [
    {"segmentation": {"size": [18, 24], "counts": [40, 60, 332]}, "area": 60, "predicted_iou": 0.9},
    {"segmentation": {"size": [18, 24], "counts": [100, 20, 312]}, "stability_score": 0.95},
]
COCO = {
    "images": [{"id": 1, "file_name": "0.png"}, {"id": 2, "file_name": "1.png"}],
    "categories": [{"id": 7, "name": "rind"}, {"id": 8, "name": "flesh"}],
    "annotations": [
        {"image_id": 1, "category_id": 7, "segmentation": SAM[0]["segmentation"]},
        {"image_id": 2, "category_id": 8, "segmentation": {"size": [18, 24], "counts": "X1l1\\:"}},
    ],
}
PATH = {"fov": 32, "frames": [{"eye": [1, 0, 1], "target": [0, 0, 0]}, {"eye": [0, 1, 1],
        "target": [0, 0, 0.1]}]}  # fmt: skip
PHYSGAUSSIAN = {
    "material": "jelly", "E": 2e4, "nu": 0.3, "density": 200, "g": [0, 0, -9.8], "n_grid": 40,
    "substep_dt": 1e-4, "frame_dt": 0.02, "frame_num": 10, "rotation_degree": [90.0],
    "rotation_axis": [0], "default_camera_index": 0,
    "boundary_conditions": [{"type": "bounding_box"},
                            {"type": "surface_collider", "point": [1, 1, 0.2],
                             "normal": [0, 0, 1], "surface": "sticky", "friction": 0,
                             "start_time": 0, "end_time": 1e3}],
}  # fmt: skip
CAMERAS = [
    {
        "id": 0,
        "width": 96,
        "height": 64,
        "fx": 90.0,
        "fy": 90.0,
        "position": [0, -7.0, 0.3],
        "rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    }
]


def physgaussian(folder: Path) -> None:
    place = folder / "point_cloud" / "iteration_7"
    place.mkdir(parents=True)
    save_splats(some_gaussians(40, 0), place / "point_cloud.ply")
    write("config.json", PHYSGAUSSIAN)(folder)
    write("cameras.json", CAMERAS)(folder)


def read_physgaussian(folder: Path) -> Any:
    with tempfile.TemporaryDirectory() as made:
        return convert(folder, folder / "config.json", Path(made)).shot


def splats(folder: Path, **options: Any) -> None:
    save_splats(some_gaussians(), folder / "a.ply", **options)


def foreign(name: str) -> Callable[[Path], None]:
    """A splat file that another program wrote; the folder of tests/io is on the path."""
    source = Path(capture_files.__file__).parent / "foreign" / name
    return lambda folder: (folder / name).write_bytes(source.read_bytes()) and None


def checkpoint(folder: Path) -> None:
    some = some_gaussians()
    values = {
        "means": some.means, "quats": some.quats, "scales": some.scales.log(),
        "opacities": torch.logit(some.opacities), "sh0": some.sh[:, :1], "shN": some.sh[:, 1:],
    }  # fmt: skip
    torch.save({"step": 1, "splats": values}, folder / "a.pt")


def read_splats(name: str) -> Callable[[Path], Any]:
    return lambda folder: load_splats(folder / name)


def read_capture(folder: Path) -> list[Any]:
    capture = load_capture(folder)
    # only what is small: that large pictures are refused is tested elsewhere
    return [capture.cameras, capture.points, capture.point_colors, capture.view(0, 32)]


def zipped(folder: Path) -> None:
    transforms(folder / "raw")
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted((folder / "raw").rglob("*")):
            archive.write(file, file.relative_to(folder / "raw"))


def read_zipped(folder: Path) -> Any:
    shutil.rmtree(folder / "a_unpacked", ignore_errors=True)
    return load_capture(folder / "a.zip").cameras


def polycam(folder: Path) -> None:
    photographs(folder / "keyframes")
    place = folder / "keyframes" / "cameras"
    place.mkdir()
    lens = {"fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 9.0, "width": SIZE[0], "height": SIZE[1]}
    pose = {f"t_{row}{column}": float(row == column) for row in range(3) for column in range(4)}
    for name in ("0", "1"):
        (place / f"{name}.json").write_text(json.dumps(pose | lens))


def read_labels(name: str) -> Callable[[Path], Any]:
    return lambda folder: [
        view.labels for view in load_segmentation(folder / name, load_capture(folder)).views
    ]


def npz_labels(folder: Path) -> None:
    np.savez_compressed(folder / "maps.npz", **{"0.png": labels(), "1.png": labels()})


def sam_folder(folder: Path) -> None:
    place = folder / "sam" / "0"
    picture(place / "0.png", (labels() == 1).astype(np.uint8) * 255)
    picture(place / "1.png", (labels() == 2).astype(np.uint8) * 255)
    (place / "metadata.csv").write_text("id,area,predicted_iou\n0,48,0.9\n1,40,0.8\n")


def ply_labels(folder: Path) -> None:
    """A mesh with lists before what is wanted, in big-endian."""
    head = POINTS.split("end_header")[0].replace("ascii", "binary_big_endian")
    head = head.replace("element vertex", "element none 0\nproperty int a\nelement vertex")
    rows = np.zeros(3, dtype=[(n, ">f4") for n in "xyz"] + [(n, "u1") for n in ("r", "g", "b")])
    face = np.array([3], np.uint8).tobytes() + np.arange(3, dtype=">i4").tobytes()
    (folder / "points.ply").write_bytes((head + "end_header\n").encode() + rows.tobytes() + face)


def mesh(kind: str) -> Callable[[Path], None]:
    """A coloured box, with a texture where the format has one."""

    def make(folder: Path) -> None:
        import trimesh

        folder.mkdir(exist_ok=True)
        box = trimesh.creation.box((1.0, 2.0, 3.0))
        if kind in ("obj", "glb"):
            paint = trimesh.visual.material.PBRMaterial(
                baseColorTexture=Image.fromarray(colors(8, 6))
            )
            box.visual = trimesh.visual.TextureVisuals(box.vertices[:, :2], material=paint)
        if kind == "gltf":
            for name, data in trimesh.exchange.gltf.export_gltf(box.scene()).items():
                (folder / name.replace("model", "a")).write_bytes(data)
        else:
            box.export(folder / f"a.{kind}")

    return make


def read_mesh(name: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> list[Any]:
        whole = load_mesh(folder / name)
        shown = surface_points(folder / name, 50)
        return [np.asarray(whole.vertices), mesh_files(folder / name) and shown]

    return read


def chosen(folder: Path) -> None:
    splats(folder)
    np.save(folder / "labels.npy", np.arange(load_splats(folder / "a.ply").count) % 2)


def read_chosen(folder: Path) -> Any:
    select = Select(labels=folder / "labels.npy", label=1)
    return select_mask(load_splats(folder / "a.ply"), select, Frame.identity())


def regions(folder: Path) -> None:
    solid(folder)
    np.savez_compressed(folder / "r.npz", regions=np.ones((3, 4, 5), np.int32))
    write("r.json", {"regions": {"rind": 0}, "region_sources": [{"labels": "a"}]})(folder)


def read_regions(folder: Path) -> Any:
    return _with_labels(load_solid(folder / "a.ply"), folder / "r").regions


READERS: dict[str, Reader] = {
    "ply": Reader(splats, "a.ply", lambda f: load_splats(f / "a.ply")),
    "ply_packed": Reader(
        lambda f: splats(f, compressed=True), "a.ply", lambda f: load_splats(f / "a.ply")
    ),
    "splat": Reader(
        lambda f: save_splat(some_gaussians(), f / "a.splat"), "a.splat", read_splats("a.splat")
    ),
    "spz": Reader(
        foreign("forty.spz"), "forty.spz", read_splats("forty.spz"), containers.gzipped
    ),
    "spz_bytes": Reader(foreign("forty.spz"), "forty.spz", read_splats("forty.spz")),
    **{
        f"ksplat_{level}": Reader(
            foreign(f"forty_{level}.ksplat"), f"forty_{level}.ksplat",
            read_splats(f"forty_{level}.ksplat"),
        )
        for level in range(3)
    },
    "sog": Reader(
        foreign("forty.sog"), "forty.sog", read_splats("forty.sog"), containers.archive
    ),
    "sog_zip": Reader(foreign("forty.sog"), "forty.sog", read_splats("forty.sog")),
    "checkpoint": Reader(checkpoint, "a.pt", read_splats("a.pt"), containers.archive),
    "checkpoint_zip": Reader(checkpoint, "a.pt", read_splats("a.pt")),
    "ply_text": Reader(transforms, "points.ply", read_capture),
    "ply_lists": Reader(capture_and(points=ply_labels), "points.ply", read_capture),
    "solid": Reader(solid, "a.volume.npz", lambda f: load_solid(f / "a.ply"), containers.archive),
    "solid_zip": Reader(solid, "a.volume.npz", lambda f: load_solid(f / "a.ply")),
    "gsd": Reader(delta, "a.gsd", read_delta, containers.delta),
    "gsd_bytes": Reader(delta, "a.gsd", read_delta),
    **{
        f"colmap_{name}_{kind}": Reader(
            colmap(kind == "txt"), f"sparse/0/{name}.{kind}", read_capture
        )
        for name in ("cameras", "images", "points3D")
        for kind in ("bin", "txt")
    },
    "transforms": Reader(transforms, "transforms.json", read_capture),
    "poses": Reader(transforms, "transforms.json", lambda f: load_poses(f / "transforms.json")),
    "zip_bytes": Reader(zipped, "a.zip", read_zipped),
    "zip": Reader(zipped, "a.zip", read_zipped, containers.archive),
    "polycam": Reader(polycam, "keyframes/cameras/0.json", read_capture),
    "photograph": Reader(transforms, "images/0.png", read_capture, containers.png),
    **{
        f"image_{kind}": Reader(
            image(f"a.{kind}"), f"a.{kind}", lambda f, kind=kind: load_image(f / f"a.{kind}")
        )
        for kind in ("png", "jpg", "tif", "bmp", "webp")
    },
    "image_float": Reader(
        image("a.tif", np.linspace(0, 1, 192, dtype=np.float32).reshape(12, 16)),
        "a.tif",
        lambda f: load_image(f / "a.tif"),
    ),
    "exemplar": Reader(
        image("a.png"),
        "a.png",
        lambda f: read_pixels(f / "a.png", str(f / "a.png")),
        containers.png,
    ),
    "exemplar_parts": Reader(
        image("a.png", labels()),
        "a.png",
        lambda f: read_parts(str(f / "a.png"), _Photo(colors())),
        containers.png,
    ),
    "sky": Reader(hdr, "sky.hdr", lambda f: of_file(f / "sky.hdr")),
    "sky_png": Reader(
        image("sky.png", colors(48, 24)), "sky.png", lambda f: of_file(f / "sky.png")
    ),
    "label_png": Reader(
        capture_and(a=image("seg/0.png", labels())), "seg/0.png", read_labels("seg"), containers.png
    ),
    "label_names": Reader(
        capture_and(a=image("seg/0.png", labels()), b=write("seg/labels.json", {"1": "rind"})),
        "seg/labels.json",
        read_labels("seg"),
    ),
    "label_npy": Reader(
        capture_and(a=lambda f: np.save(f / "maps.npy", np.stack([labels()] * 3))),
        "maps.npy",
        read_labels("maps.npy"),
    ),
    "label_npz": Reader(
        capture_and(a=npz_labels), "maps.npz", read_labels("maps.npz"), containers.archive
    ),
    "label_npz_zip": Reader(capture_and(a=npz_labels), "maps.npz", read_labels("maps.npz")),
    "sam_json": Reader(capture_and(a=write("0.json", SAM)), "0.json", read_labels("0.json")),
    "coco_json": Reader(
        capture_and(a=write("c.json", COCO)), "c.json", read_labels("c.json")
    ),
    "sam_table": Reader(
        capture_and(a=sam_folder), "sam/0/metadata.csv", read_labels("sam")
    ),
    "mask": Reader(
        capture_and(a=image("rind/0.png", labels() * 100)),
        "rind/0.png",
        lambda f: [v.labels for v in load_masks(f / "rind", load_capture(f)).views],
        containers.png,
    ),
    "shot": Reader(
        lambda f: (splats(f), write("shot.yaml", SHOT)(f))[0],
        "shot.yaml",
        lambda f: load_shot(f / "shot.yaml").resolved(),
    ),
    "camera_path": Reader(
        write("path.json", PATH), "path.json", lambda f: read_path(f / "path.json", 3, (64, 48))
    ),
    "physgaussian": Reader(physgaussian, "config.json", read_physgaussian),
    "inria_cameras": Reader(physgaussian, "cameras.json", read_physgaussian),
    "frame": Reader(
        frames,
        "stages/simulate/frame_0001.npz",
        lambda f: load_frame(f / "stages/simulate", 0),
        containers.archive,
    ),
    "frame_zip": Reader(
        frames, "stages/simulate/frame_0001.npz", lambda f: load_frame(f / "stages/simulate", 0)
    ),
    "viewed_frame": Reader(frames, "stages/simulate/frame_0001.npz", read_run, containers.archive),
    "viewed_marker": Reader(frames, "stages/simulate/stage.json", read_run),
    "viewed_record": Reader(frames, "run.json", read_run),
    "partition": Reader(partition, "partition.npz", load_partition, containers.archive),
    "run_shot": Reader(
        lambda f: (splats(f), write("run.json", {"shot": {"splats": "a.ply", "size": 0.1}})(f))[0],
        "run.json",
        lambda f: shot_of(f).resolved(),
    ),
    "run_record": Reader(
        write("run.json", {"verdict": "clean", "stages": [{"name": "fill", "seconds": 1.5}]}),
        "run.json",
        read_record,
    ),
    "select_labels": Reader(chosen, "labels.npy", read_chosen),
    "region_labels": Reader(regions, "r.npz", read_regions, containers.archive),
    "region_table": Reader(regions, "r.json", read_regions),
    **{
        f"mesh_{kind}": Reader(mesh(kind), f"a.{kind}", read_mesh(f"a.{kind}"))
        for kind in ("obj", "stl", "off", "ply", "glb", "gltf")
    },
    "scene_frame": Reader(
        write("frame.json", Frame.identity().to_dict()), "frame.json", lambda f: read_frame(f)
    ),
}  # fmt: skip


def _mute(folder: Path) -> None:
    raise InputError("wrong")


WRONG: dict[str, Callable[[Path], Any]] = {
    "_spins": lambda folder: sum(iter(int, 1)),
    "_eats": lambda folder: bytearray(1 << 30),
    "_dies": lambda folder: os.kill(os.getpid(), signal.SIGSEGV),
    "_raises": lambda folder: {}["a"],
    "_lies": lambda folder: {"a": [torch.tensor([1.0, math.nan])]},
    "_mute": _mute,
}
"""Readers that do what none may do: they show that it is noticed."""


@dataclasses.dataclass
class _Photo:
    """As much of an exemplar as the reader of its parts asks for."""

    image: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        return np.ones(self.image.shape[:2], bool)


def prepare(name: str, folder: Path) -> tuple[containers.Parts, containers.Join]:
    """Write a reader's files into a folder; the parts of its target and what joins them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    reader = READERS[name]
    reader.make(folder)
    return reader.take((folder / reader.target).read_bytes())
