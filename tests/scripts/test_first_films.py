"""scripts/pictures/first_films.py: what leaves the picture is seen, and the page holds its data."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from loaded_scripts import load_script

from gsfluent.config import load_shot
from gsfluent.data import Gaussians
from gsfluent.io import save_splats
from gsfluent.results.frames import SavedFrame, save_frame


def moved(points: torch.Tensor, index: int) -> SavedFrame:
    count = len(points)
    splats = Gaussians.from_colors(points, torch.full((count,), 0.01), torch.full((count, 3), 0.5))
    none = torch.full((count,), -1, dtype=torch.int32)
    return SavedFrame(
        index=index, time=0.1 * index, gaussians=splats, ids=torch.arange(count), groups=none,
        anchor=torch.arange(count), positions=points, velocity=torch.zeros_like(points),
        fragments=(torch.arange(count) >= count - 5).int(), damage=torch.zeros(count),
        volumes=torch.full((count,), 1e-6), material=torch.zeros(count, dtype=torch.int32),
        body=torch.zeros(count, dtype=torch.int32), carried=count, facts={},
    )  # fmt: skip


def test_the_page_holds_its_data() -> None:
    films = load_script("pictures/first_films")
    rows = {row["name"]: row for row in map(json.loads, films.DATA.open(encoding="utf-8"))}
    assert films.table(rows) in films.PAGE.read_text(encoding="utf-8")
    # what the page says of all films
    assert len(rows) == 10 and all(row["piece_outside"] == 0.0 for row in rows.values())


def test_what_is_thrown_out_of_the_picture_is_seen(tmp_path: Path) -> None:
    """Five points of two hundred are one piece, which a still camera loses."""
    films = load_script("pictures/first_films")
    ball = torch.nn.functional.normalize(torch.randn(200, 3), dim=1) * 0.1 + 0.1
    save_splats(moved(ball, 0).gaussians, tmp_path / "ball.ply")
    (tmp_path / "eye.json").write_text(
        json.dumps({"fov": 40, "frames": [{"eye": [0, -1, 0.2], "target": [0.1, 0.1, 0.1]}]})
    )
    (tmp_path / "shot.yaml").write_text(
        "splats: ball.ply\nevents: [{type: drop, height: 1.0}]\n"
        "output: {camera: eye.json, size: [64, 48]}\n"
    )
    folder = tmp_path / "stages" / "simulate"
    folder.mkdir(parents=True)
    assert load_shot(tmp_path / "shot.yaml").objects
    for index in range(3):
        thrown = ball.clone()
        thrown[-5:, 0] += float(index)
        save_frame(folder, moved(thrown, index))
    most, piece = films.outside(tmp_path)
    assert most == pytest.approx(5 / 200) and piece == 1.0
