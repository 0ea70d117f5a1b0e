"""Bad input on the command line: a clear message, exit code 2 (or 1), nothing half-written."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest

from gsfluent.cli import main
from gsfluent.demo import make_capture
from gsfluent.io import read_ply, write_ply

pytestmark = pytest.mark.timeout(120)


def refused(words: list[str], capsys: pytest.CaptureFixture[str], code: int = 2) -> str:
    assert main(words) == code
    text = capsys.readouterr().err
    assert "hint:" in text
    assert "Traceback" not in text
    return text


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Four tiny photographs."""
    root = tmp_path / "capture"
    make_capture("watermelon", root, views=4, size=32)
    return root


def reconstruct(folder: Path, out: Path) -> list[str]:
    return ["reconstruct", str(folder), "-o", str(out), "--iterations", "2"]


def test_empty_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    out = tmp_path / "model.ply"
    assert "empty" in refused(reconstruct(folder, out), capsys)
    assert not out.exists()


def test_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = refused(reconstruct(tmp_path / "nowhere", tmp_path / "model.ply"), capsys)
    assert "CAPTURE" in text and "nowhere" in text


def test_truncated_image(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = sorted((capture / "images").iterdir())[1]
    image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
    assert image.name in refused(reconstruct(capture, tmp_path / "model.ply"), capsys)
    assert list(tmp_path.glob("model*")) == []


def test_missing_pose(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = capture / "transforms.json"
    values = json.loads(file.read_text())
    del values["frames"][2]["transform_matrix"]
    file.write_text(json.dumps(values))
    text = refused(reconstruct(capture, tmp_path / "model.ply"), capsys)
    assert "transform_matrix" in text


def spoil(source: Path, target: Path, name: str, value: float) -> None:
    cloud = read_ply(source)
    table = cloud["vertex"] if isinstance(cloud, dict) else cloud
    table[name][3] = value
    write_ply(target, cloud)


def test_nan_means(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad, out = tmp_path / "bad.ply", tmp_path / "solid.ply"
    spoil(ball, bad, "x", float("nan"))
    text = refused(["fill", str(bad), "-o", str(out)], capsys)
    assert "means" in text and "1 of 1500" in text
    assert list(tmp_path.glob("solid*")) == []


def test_zero_scale(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad, out = tmp_path / "bad.ply", tmp_path / "solid.ply"
    spoil(ball, bad, "scale_1", float("-inf"))  # files hold logarithms
    text = refused(["fill", str(bad), "-o", str(out)], capsys)
    assert "scale" in text
    assert not out.exists()


def test_zero_gaussians(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    header = ball.read_bytes().split(b"end_header\n")[0].replace(b"vertex 1500", b"vertex 0")
    bad, out = tmp_path / "bad.ply", tmp_path / "solid.ply"
    bad.write_bytes(header + b"end_header\n")
    assert "0" in refused(["fill", str(bad), "-o", str(out)], capsys)
    assert not out.exists()


def test_truncated_splat(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.ply"
    bad.write_bytes(ball.read_bytes()[:5000])
    assert "bad.ply" in refused(["fill", str(bad), "-o", str(tmp_path / "solid.ply")], capsys)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.obj", b"", "the file is empty"),
        ("empty.ply", b"", "it is empty"),
        ("splat.obj", b"ply\nformat ascii 1.0\n", "rename it splat.ply"),
    ],
)
def test_a_file_that_is_not_what_its_name_says(
    name: str, content: bytes, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    assert main(["plan", str(tmp_path / name)]) == 2
    assert said in capsys.readouterr().err


def test_a_file_where_the_results_should_go(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "film.mp4").write_bytes(b"kept")
    assert main(["run", str(ball), "-o", str(tmp_path / "film.mp4")]) == 2
    assert "film.mp4 is a file" in capsys.readouterr().err
    assert (tmp_path / "film.mp4").read_bytes() == b"kept"


def test_wrong_key_names_the_nearest(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot.write_text(shot.read_text().replace("splats:", "splat:"))
    text = refused(["run", str(shot), "-o", str(tmp_path / "out")], capsys)
    assert "splat: unknown key" in text and "splats" in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("quality: preview", "quality: best", "quality"),
        ("height: 0.3", "height: -1", "height"),
        ("type: drop", "type: dropp", "drop"),
        ("type: drop", "type: blade", "path"),
        ("material: bread", "material: brad", "bread"),
        ("- 96", "- 95", "size"),
    ],
)
def test_wrong_values_name_their_key(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    text = shot.read_text()
    assert old in text
    shot.write_text(text.replace(old, new))
    assert said in refused(["plan", str(shot)], capsys)


def test_not_yaml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "shot.yaml"
    path.write_text("events: [\n")
    assert "shot.yaml" in refused(["plan", str(path)], capsys)


def test_unknown_export_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = refused(["export", str(tmp_path), "--to", "teapot"], capsys)
    assert "teapot" in text and "ply-seq" in text


def test_render_without_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "run.json" in refused(["render", str(tmp_path)], capsys)


def test_unknown_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "watermelon" in refused(["demo", "brick", "-o", str(tmp_path / "out")], capsys)
    assert not (tmp_path / "out").exists()


def test_full_disk_leaves_nothing_half_written(
    ball: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    folder = tmp_path / "full"
    folder.mkdir()
    words = ["fill", str(ball), "-o", str(folder / "solid.ply"), "--resolution", "16"]
    text = refused(words, capsys, code=1)
    assert os.strerror(errno.ENOSPC) in text
    assert list(folder.iterdir()) == []


def test_folder_that_cannot_be_made(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    refused(["run", str(shot), "-o", str(tmp_path / "file" / "out")], capsys)


def test_label_file_that_does_not_fit(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "labels.npy", np.zeros(3))
    text = shot.read_text().replace(
        "material: bread",
        f"material: bread\n    select: {{labels: {tmp_path / 'labels.npy'}}}",
    )
    shot.write_text(text)
    assert "labels" in refused(["run", str(shot), "-o", str(tmp_path / "out")], capsys)


def test_plan_refuses_an_empty_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "nothing").mkdir()
    shot = tmp_path / "shot.yaml"
    shot.write_text("capture: nothing\nevents: [{type: drop, height: 1}]\n")
    assert "empty" in refused(["plan", str(shot)], capsys)


def test_plan_measures_a_capture_with_masks_only(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = tmp_path / "shot.yaml"
    shot.write_text(
        "capture: capture\nscale: 1.0\nup: +z\nsolve: {quality: preview}\n"
        "events: [{type: drop, height: 1}]\n"
    )
    assert main(["plan", str(shot), "--json", "--no-probe"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert max(plan["size_m"]) == pytest.approx(0.26, rel=0.3)  # the melon is 0.26 m long
