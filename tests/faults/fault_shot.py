"""A shot of seconds that the tests of this folder damage, kill and starve."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import yaml

from gsfluent.config import load_shot
from gsfluent.data import SURFACE, Gaussians
from gsfluent.io import save_splats
from gsfluent.results.digests import file_digest
from gsfluent.results.frames import SavedFrame
from gsfluent.run.shot import run_shot
from gsfluent.stages import simulate

FRAMES = 3
SHOWN = ("video.mp4", "poster.png", "interior.png")


def write_shot(folder: Path, **changes: Any) -> Path:
    """Write a slender shell of splats and a shot that drops it; None leaves a key out."""
    count = 300
    index = torch.arange(count) + 0.5
    polar = torch.acos(1 - 2 * index / count)
    turn = math.pi * (1 + math.sqrt(5)) * index
    unit = torch.stack([turn.cos() * polar.sin(), turn.sin() * polar.sin(), polar.cos()], dim=-1)
    scales = torch.full((count,), 0.6 * math.sqrt(4 * math.pi / count))
    colors = torch.where((unit[:, :1] * 20).sin() > 0, torch.tensor([0.1, 0.4, 0.1]), 0.6)
    means = unit * torch.tensor([1.0, 0.4, 0.4])
    splats = Gaussians.from_colors(means, scales, colors, opacities=0.95, label=SURFACE)
    folder.mkdir(parents=True, exist_ok=True)
    save_splats(splats, folder / "ball.ply")
    values: dict[str, Any] = {
        "splats": str(folder / "ball.ply"),
        "scale": 1.0,
        "up": "+z",
        "fill": {"resolution": 16},
        "texture": {"method": "color_copy"},
        "objects": {"ball": {"material": "jelly"}},
        "events": [{"type": "drop", "height": 0.02}],
        "solve": {"cells": 8},
        "output": {"fps": 20, "seconds": FRAMES / 20, "size": [32, 32], "what": ["mp4"]},
    }
    path = folder / "shot.yaml"
    kept = {key: value for key, value in (values | changes).items() if value is not None}
    path.write_text(yaml.safe_dump(kept))
    return path


def no_report(out: Path, values: dict[str, Any]) -> None:
    """Of a run whose page nobody reads."""


def run(path: Path, out: Path) -> dict[str, Any]:
    """Run a shot without a plan and a page."""
    with mock.patch("gsfluent.run.shot.write_report", no_report):
        return run_shot(load_shot(path), out, plan=False)


def stop(path: Path, finished: Path, out: Path) -> None:
    """Leave a run with two of its frames on disk, as Ctrl-C would."""
    shutil.copytree(finished, out)
    for name in ("simulate", "render"):
        shutil.rmtree(out / "stages" / name)
    packed = simulate.packed_frame

    def stopping(frame: SavedFrame) -> Any:
        if frame.index == 2:
            raise KeyboardInterrupt
        return packed(frame)

    # its state is that of the last frame, however long it took to write
    patient = mock.patch.object(simulate, "PATIENCE", 0.0)
    with patient, mock.patch.object(simulate, "packed_frame", stopping):
        try:
            run(path, out)
        except KeyboardInterrupt as error:
            assert "resume" in str(error)
    assert (out / "stages" / "simulate" / "state.pt").is_file()


def results(out: Path) -> dict[str, str]:
    """Digests of all that a run leaves, but for what holds wall times."""
    files = [out / name for name in SHOWN]
    files += [p for p in (out / "stages").rglob("*") if p.is_file() and p.name != "stage.json"]
    return {file.relative_to(out).as_posix(): file_digest(file) for file in files}


def redone(values: dict[str, Any]) -> list[str]:
    """Stages of a run that were not believed."""
    return [stage["name"] for stage in values["stages"] if "redone" in stage]
