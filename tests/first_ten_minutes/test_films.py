"""One command without a written shot, from what people have to a film.

The looks of the film and the errors on the way are tested elsewhere; here it is that each kind of
input gets there: splats, a model folder, a textured mesh. Sizes are tiny. A PhysGaussian folder
with its config: tests/cli/test_physgaussian_run.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
import trimesh
from physgaussian_model import write_model
from PIL import Image

import gsfluent.run.from_input as from_input
from gsfluent.cli import main
from gsfluent.config import load_shot
from gsfluent.data import Gaussians
from gsfluent.io import save_splats

FRAMES = 4
Maker = Callable[[Path], Path]
RADIUS = 0.3


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Few voxels, few cells, few frames, a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    output = {"fps": 20, "seconds": FRAMES / 20, "size": [64, 48]}
    small = {"fill": {"resolution": 24}, "solve": {"cells": 8}, "output": output}
    monkeypatch.setattr(from_input, "SETTINGS", small)


def shell() -> Gaussians:
    """Splats on a ball with red and white stripes."""
    count = 1500
    index = torch.arange(count) + 0.5
    polar, turn = torch.acos(1 - 2 * index / count), math.pi * (1 + math.sqrt(5)) * index
    unit = torch.stack([turn.cos() * polar.sin(), turn.sin() * polar.sin(), polar.cos()], dim=-1)
    stripe = (unit[:, :1] * 9).sin() > 0
    colors = torch.where(stripe, torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.9, 0.9, 0.9]))
    size = torch.full((count,), 0.6 * RADIUS * math.sqrt(4 * math.pi / count))
    return Gaussians.from_colors(RADIUS * unit, size, colors, opacities=0.95)


def splat(folder: Path) -> Path:
    save_splats(shell(), folder / "thing.ply")
    return folder / "thing.ply"


def compressed_splat(folder: Path) -> Path:
    save_splats(shell(), folder / "thing.compressed.ply", compressed=True)
    return folder / "thing.compressed.ply"


def model_folder(folder: Path) -> Path:
    """A model of the INRIA trainer, as PhysGaussian takes it, without a config."""
    return write_model(folder / "model")


def textured_mesh(folder: Path) -> Path:
    """An OBJ with a texture."""
    box = trimesh.creation.box((0.4, 1.0, 0.5))
    picture = np.zeros((16, 16, 3), dtype=np.uint8)
    picture[:8] = [200, 30, 30]
    picture[8:] = [230, 230, 230]
    at = np.clip(box.vertices[:, :2] + 0.5, 0.0, 1.0)
    skin = trimesh.visual.TextureVisuals(uv=at, image=Image.fromarray(picture))
    box.visual = skin
    box.export(folder / "crate.obj")
    return folder / "crate.obj"


@pytest.mark.parametrize(
    "make",
    [splat, compressed_splat, model_folder, textured_mesh],
)
def test_one_command_makes_a_film(
    make: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "in"
    place.mkdir()
    out = tmp_path / "out"
    assert main(["run", str(make(place)), "-o", str(out)]) == 0
    shown, said = capsys.readouterr()
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(out / "video.mp4"))
    assert frames == FRAMES
    poster = np.asarray(Image.open(out / "poster.png").convert("RGB"), dtype=float)
    assert poster.std() > 3.0  # something is seen
    record = json.loads((out / "run.json").read_text())
    assert record["verdict"] == "clean"
    # what was guessed is said, and stands in a shot that can be edited and run
    for words in ("material: ", "front: ", "event: ", "up is ["):
        assert words in said, words
    shot = load_shot(out / "shot.yaml")
    assert len(shot.events) >= 1
    # a table ends it
    assert str(out / "video.mp4") in shown and "clean" in shown
    # and every warning stood in the log before the list of them at its end
    lines = said.splitlines()
    for warning in record["warnings"]:
        assert f"  ! {warning}" in lines and warning in lines
