"""`gsfluent run` with the captured backdrop: the table stays where it was."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from ball_shot import write_shot
from PIL import Image

from gsfluent.cli import main
from gsfluent.data import BACKGROUND, Gaussians
from gsfluent.io import load_splats
from gsfluent.io.splats.load import save_splats

OUTPUT = {"fps": 20, "seconds": 0.2, "size": [96, 64]}


@pytest.fixture
def ball_on_table(ball: Path, tmp_path: Path) -> Path:
    """The ball on a red table, as one labelled splat file."""
    axis = torch.linspace(-4.0, 4.0, 81)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, -1.0)], -1).reshape(-1, 3)
    means = means[means[:, :2].norm(dim=1) > 0.4]
    scales = torch.tensor([0.08, 0.08, 0.01]).repeat(len(means), 1)
    red = torch.tensor([0.9, 0.05, 0.05]).repeat(len(means), 1)
    behind = Gaussians.from_colors(means, scales, red, opacities=0.95, label=BACKGROUND)
    whole = Gaussians.cat([load_splats(ball), behind])
    save_splats(whole, tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def redness(path: Path) -> float:
    image = np.asarray(Image.open(path).convert("RGB"), dtype=float) / 255.0
    return float((image[..., 0] > 2.0 * image[..., 1]).mean())


def test_the_table_stays_in_the_picture(ball_on_table: Path, tmp_path: Path) -> None:
    shares = {}
    for backdrop in ("studio", "captured"):
        shot = write_shot(
            tmp_path / f"{backdrop}.yaml", ball_on_table, output=OUTPUT | {"backdrop": backdrop}
        )
        assert main(["run", str(shot), "-o", str(tmp_path / "out")]) == 0
        shares[backdrop] = redness(tmp_path / "out" / "poster.png")
        record = json.loads((tmp_path / "out" / "run.json").read_text())
        resumed = {stage["name"]: stage["resumed"] for stage in record["stages"]}
    assert shares["studio"] < 0.01 and shares["captured"] > 0.2
    # only the picture is made again
    assert resumed == {
        "isolate": True, "fill": True, "texture": True, "simulate": True, "render": False
    }  # fmt: skip
    assert record["isolation"]["gaussians_removed"] > 1000
    thin = record["simulation"]["thin"]["ball"]
    assert thin["limit"] == pytest.approx(3 * record["simulation"]["dx"]) and thin["share"] < 0.2


def test_a_backdrop_that_is_not_there_is_refused(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = write_shot(tmp_path / "shot.yaml", ball, output=OUTPUT | {"backdrop": "captured"})
    assert main(["run", str(shot), "-o", str(tmp_path / "out")]) == 2
    assert "nothing but the object" in capsys.readouterr().err
