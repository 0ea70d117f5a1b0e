"""`gsfluent carry`: a mesh animation of a hundred frames on splats, and all stages after it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent.cli import main
from gsfluent.io import load_splats, read_ply
from gsfluent.results.frames import load_frame

FRAMES = 100


def turned(points: np.ndarray, k: int) -> np.ndarray:
    a = 0.03 * k
    map = np.array(
        [[np.cos(a), -np.sin(a), 0.1 * a], [np.sin(a), np.cos(a), 0], [0, 0, 1 + 0.2 * a]]
    )
    return np.asarray(points @ map.T + [0.0, 0.01 * k, 0.0])


def test_a_hundred_frames_are_carried_rendered_and_exported(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the axes of Blender's glTF (+y up) and in its units; compared with the closed form."""
    axis = np.linspace(-1.1, 1.1, 9)
    points = np.stack(np.meshgrid(axis, axis[2:-2], axis[2:-2], indexing="ij"), -1).reshape(-1, 3)
    frames = np.stack([turned(points, k) for k in range(FRAMES)])
    y_up = 0.5 * np.stack([frames[..., 0], frames[..., 2], -frames[..., 1]], axis=-1)
    np.savez(tmp_path / "move.npz", positions=y_up, fps=25.0)
    out = tmp_path / "out"
    words = ["carry", str(ball), "--by", str(tmp_path / "move.npz"), "-o", str(out)]
    words += ["--up", "y", "--scale", "2", "--no-film", "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)["simulation"]
    assert (result["frames"], result["carriers"], result["far"]) == (FRAMES, len(points), 0)
    rest = load_splats(ball)
    for k in (0, 41, FRAMES - 1):
        saved = load_frame(out / "stages" / "simulate", k)
        wanted = turned(rest.means.double().numpy(), k)
        np.testing.assert_allclose(saved.gaussians.means.numpy(), wanted, atol=1e-5)
        assert saved.time == pytest.approx(k / 25.0)
    assert main(["export", str(out), "--to", "ply-seq", "--frames", "99"]) == 0
    rows = read_ply(out / "frames" / "frame_0100.ply")["vertex"]
    np.testing.assert_allclose(rows["x"], saved.gaussians.means[:, 0], atol=1e-6)
    picture = tmp_path / "one.png"
    assert main(["render", str(out), "--frame", "50", "--size", "64x48", "-o", str(picture)]) == 0
    assert picture.stat().st_size > 500


def test_holes_are_measured_and_a_second_run_does_nothing(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rest = load_splats(ball).means.double()
    apart = rest + 0.7 * torch.sign(rest[:, :1]) * torch.tensor([1.0, 0.0, 0.0])
    np.savez(tmp_path / "move.npz", positions=torch.stack([rest, apart]).numpy())
    out = tmp_path / "out"
    words = ["carry", str(ball), "--by", str(tmp_path / "move.npz"), "-o", str(out)]
    words += ["--size", "64x48", "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    assert (out / "video.mp4").is_file() and (out / "report.html").is_file()
    assert "carriers part" in " ".join(first["simulation"]["notes"])
    assert len(first["render"]["hole_fraction"]) == 2
    assert main(words) == 0
    again = json.loads(capsys.readouterr().out)
    assert [stage["resumed"] for stage in again["stages"]] == [True, True]


@pytest.mark.parametrize(
    ("more", "what"),
    [
        (["--scale", "0"], "--scale 0"),
        (["--scale", "90"], "no splat is near"),
        (["--rest", "7"], "rest is 7"),
    ],
)
def test_what_cannot_be_is_said(
    more: list[str], what: str, ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "move.npy", load_splats(ball).means[None].repeat(2, 1, 1).numpy() + 0.1)
    words = ["carry", str(ball), "--by", str(tmp_path / "move.npy"), "-o", str(tmp_path / "out")]
    assert main([*words, *more]) == 2
    assert what in capsys.readouterr().err
