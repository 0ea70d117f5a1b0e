"""What the first film of a stranger must be like."""

from __future__ import annotations

import json
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from gsfluent.cli import main
from gsfluent.config import load_shot

FRAMES = 4


def first_film(source: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """``gsfluent run SOURCE -o OUT`` leaves a film, says what it guessed and warns in time.

    Returns:
        What it said on the way.
    """
    assert main(["run", str(source), "-o", str(out)]) == 0
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
    return said
