"""Videos, animations and camera paths, opened by OpenCV and Pillow."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from export_run import FPS, FRAMES, SIZE, add_record, make_run
from PIL import Image

from gsfluent.data import Camera
from gsfluent.errors import InputError
from gsfluent.export.pictures import straight
from gsfluent.export.write import ExportOptions, export
from gsfluent.pipeline.render.camera import Action, cameras_for, orbit
from gsfluent.pipeline.render.path import freeze
from gsfluent.pipeline.render.video import write_animation

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return add_record(make_run(tmp_path_factory.mktemp("pictures"), degree=0))


def write(run: Path, to: Path, kinds: str, **options: object) -> Path:
    given = ExportOptions(**options)  # type: ignore[arg-type]
    export(run, kinds.split(","), device=CPU, to=to, options=given)
    return to


def test_every_kind_shows_the_same_film(run: Path, tmp_path: Path) -> None:
    import cv2

    write(run, tmp_path, "mp4,gif,webp,png")
    stills = [np.array(Image.open(p)) for p in sorted((tmp_path / "pictures").glob("*.png"))]
    assert len(stills) == FRAMES and stills[0].shape == (SIZE[1], SIZE[0], 3)
    assert np.abs(stills[0].astype(int) - stills[-1]).mean() > 1.0  # something moves
    video = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(FPS)

    def shows(picture: np.ndarray, index: int) -> bool:
        off = [np.abs(picture.astype(int) - still).mean() for still in stills]
        return int(np.argmin(off)) == index and off[index] < 8.0  # confetti under 4:2:0 chroma

    for index in range(FRAMES):
        good, picture = video.read()
        assert good and shows(picture[..., ::-1], index)
    assert not video.read()[0]
    for name in ("gif", "webp"):
        moving = Image.open(tmp_path / f"video.{name}")
        assert moving.n_frames == FRAMES and moving.info["loop"] == 0
        for index in range(FRAMES):
            moving.seek(index)
            moving.load()
            assert moving.info["duration"] == 40
            assert shows(np.array(moving.convert("RGB")), index), name


def test_alpha_leaves_only_the_object(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "png,webp", alpha=True, frames="0:2")
    picture = np.array(Image.open(tmp_path / "pictures" / "picture_0001.png"))
    assert picture.shape == (SIZE[1], SIZE[0], 4)
    assert picture[0, 0, 3] == 0 and picture[..., 3].max() > 200
    moving = Image.open(tmp_path / "video.webp")
    assert moving.n_frames == 2 and moving.mode == "RGBA"
    with pytest.raises(InputError, match="png"):
        write(run, tmp_path, "mp4", alpha=True)


def test_straight_alpha_composites_back() -> None:
    random = torch.Generator().manual_seed(0)
    color, alpha = torch.rand(8, 8, 3, generator=random), torch.rand(8, 8, generator=random)
    over = straight(color * alpha[..., None], alpha)
    assert torch.allclose(over[..., :3] * over[..., 3:], color * alpha[..., None], atol=1e-6)


def test_a_shorter_film_leaves_no_old_pictures(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path, "png")
    write(run, tmp_path, "png", frames="1:3", size=(32, 32))
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2


def action() -> Action:
    center = torch.tensor([[0.1 * i, 0.0, 1.0] for i in range(9)], dtype=torch.float64)
    return Action(center, torch.full((9,), 0.2, dtype=torch.float64))


def angle(camera: Camera, pivot: torch.Tensor) -> float:
    eye = camera.center() - pivot
    return math.degrees(math.atan2(float(eye[1]), float(eye[0])))


def sees(camera: Camera, point: torch.Tensor) -> bool:
    pixel, depth = camera.project(point[None])
    inside = (pixel[0] > 0) & (pixel[0] < torch.tensor([camera.width, camera.height]))
    return bool(inside.all()) and float(depth) > 0


def test_a_turntable_goes_once_around() -> None:
    still = Action(torch.zeros(9, 3, dtype=torch.float64), action().radius)
    cameras = cameras_for("turntable", still, SIZE)
    angles = np.unwrap([angle(c, still.center[0]) for c in cameras], period=360.0)
    assert np.allclose(np.diff(angles), 360.0 / 9, atol=1e-6)
    assert all(
        float(c.center()[2]) == pytest.approx(float(cameras[0].center()[2])) for c in cameras
    )
    moving = action()
    cameras = cameras_for("turntable", moving, SIZE)
    assert all(sees(c, p) for c, p in zip(cameras, moving.center, strict=True))


def test_a_dolly_comes_nearer_and_never_looks_away() -> None:
    moving = action()
    cameras = cameras_for("dolly", moving, SIZE)
    away = [float((c.center() - p).norm()) for c, p in zip(cameras, moving.center, strict=True)]
    assert away[-1] < 0.45 * away[0]
    assert all(sees(c, p) for c, p in zip(cameras, moving.center, strict=True))


def test_frozen_time_returns_to_where_it_stopped() -> None:
    moving = action()
    cameras = orbit(moving, SIZE)
    cuts = freeze(cameras, moving.center, 4, fps=10.0, seconds=2.0)
    assert [cut.frame for cut in cuts] == [0, 1, 2, 3, 4] + [4] * 19 + [4, 5, 6, 7, 8]
    angles = np.unwrap([angle(c.camera, moving.center[4]) for c in cuts[4:25]], period=360.0)
    assert abs(angles[-1] - angles[0]) == pytest.approx(360.0)
    assert all(sees(cut.camera, moving.center[cut.frame]) for cut in cuts)
    with pytest.raises(InputError, match="0 to 8"):
        freeze(cameras, moving.center, 9, fps=10.0, seconds=2.0)


def test_the_poses_of_a_capture_are_a_path(tmp_path: Path) -> None:
    eyes = [(1.0, 0.0, 0.5), (0.0, 1.0, 0.5), (-1.0, 0.0, 0.5)]
    views = [Camera.look_at(eye, (0, 0, 0), width=80, height=60) for eye in eyes]
    frames = []
    for view in views:
        pose = torch.linalg.inv(view.viewmat)
        pose[:3, 1:3] *= -1.0  # OpenGL axes
        frames.append({"transform_matrix": pose.tolist()})
    focal = float(views[0].K[0, 0])
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 80, "h": 60, "fl_x": focal, "fl_y": focal, "frames": frames}))
    still = Action(torch.zeros(5, 3, dtype=torch.float64), action().radius[:5])
    cameras = cameras_for(str(path), still, (160, 120))
    for camera, eye in zip(cameras[::2], eyes, strict=True):
        assert torch.allclose(camera.center(), torch.tensor(eye, dtype=torch.float64), atol=1e-9)
    assert float(cameras[0].K[0, 0]) == pytest.approx(2 * focal)
    assert torch.allclose(cameras[1].center(), torch.tensor([0.5, 0.5, 0.5]).double(), atol=1e-9)
    assert all(sees(camera, torch.zeros(3).double()) for camera in cameras)


def test_another_light_shows(run: Path, tmp_path: Path) -> None:
    write(run, tmp_path / "a", "png", frames="0")
    write(run, tmp_path / "b", "png", frames="0", light="-1,1,0.5", environment="none")
    a, b = (np.array(Image.open(tmp_path / n / "pictures" / "picture_0001.png")) for n in "ab")
    assert np.abs(a.astype(int) - b).mean() > 5.0


@pytest.mark.parametrize(
    ("camera", "said"),
    [("freeze:99", "0 to 3"), ("freeze:x", "freeze:12"), ("nowhere.json", "turntable")],
)
def test_bad_cameras(run: Path, tmp_path: Path, camera: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        write(run, tmp_path, "png", camera=camera)


def test_an_animation_needs_pictures(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no frame"):
        write_animation(tmp_path / "a.gif", iter([]), fps=10.0)
    with pytest.raises(InputError, match="webp"):
        write_animation(tmp_path / "a.avi", iter([]), fps=10.0)
    assert list(tmp_path.iterdir()) == []


def test_a_tall_object_is_whole_in_the_picture_while_it_falls() -> None:
    """Nine tenths of a pole lie near its middle where it is thick; its tip counts as well."""
    generator = torch.Generator().manual_seed(0)
    height = torch.cat([0.1 * torch.rand(2000, generator=generator), torch.tensor([0.8])])
    pole = torch.stack([0 * height, 0 * height, height], 1).double()
    falls = [pole + torch.tensor([0.0, 0.0, 2.0 - 4.9 * (i / 30) ** 2]) for i in range(18)]
    cameras = orbit(Action.of(falls), (320, 240))
    for index in (0, 6, 12, 17):
        pixel, depth = cameras[index].project(falls[index])
        assert (depth > 0).all()
        assert (pixel >= 0).all() and (pixel <= torch.tensor([320.0, 240.0])).all()


def test_a_film_passes_the_front_in_its_middle() -> None:
    still = Action.of([torch.rand(50, 3).double() - 0.5] * 9)
    ahead = orbit(still, (320, 240))[4].forward()
    assert abs(float(ahead[0])) < 1e-6 and float(ahead[1]) > 0.9
