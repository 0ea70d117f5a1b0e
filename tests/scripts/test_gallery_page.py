"""scripts/study/shots/gallery.py: its shots are shots, its table says only what was recorded."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loaded_scripts import load_script

from gsfluent.config import Shot, load_shot
from gsfluent.demo.catalogue import OBJECTS

ROOT = Path(__file__).resolve().parents[2]
gallery = load_script("study/shots/gallery")


def line(**keys: Any) -> dict[str, Any]:
    made = {
        "scene": "cake_cut", "machine": "Some CPU, 2 cores", "device": "cpu", "quality": "preview",
        "verdict": "clean", "pieces": 2, "particles": 12_400, "hole_fraction": 0.00123,
        "stages": {"fill": 3.4, "simulate": 20.2, "export": 0.2},
    }  # fmt: skip
    return made | keys


def shot_of(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Shot:
    """The shot of a scene; files that it names need not be there for it to be read."""
    text = (ROOT / "examples" / f"{name}.yaml").read_text(encoding="utf-8")
    monkeypatch.setenv("GSFLUENT_DATA", str(folder))
    for word in text.replace(",", " ").replace("}", " ").split():
        path = word.removeprefix("$GSFLUENT_DATA/")
        if "/" in path and path.startswith(
            ("data/", "captures/", "exemplars/", "cameras/", "meshes/")
        ):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).touch()
    (folder / "shot.yaml").write_text(text, encoding="utf-8")
    return load_shot(folder / "shot.yaml")


@pytest.mark.parametrize("name", gallery.SCENES)
def test_every_scene_has_a_shot_that_reads(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "examples" / f"{name}.yaml").read_text(encoding="utf-8")
    drawn = gallery.SCENES[name].drawn
    assert not drawn or drawn in OBJECTS
    assert f"gsfluent run examples/{name}.yaml" in text
    assert not drawn or f"gsfluent demo {drawn} --photographs examples/data/{drawn}" in text
    shot = shot_of(name, tmp_path, monkeypatch)
    assert 1.0 <= shot.output.seconds * shot.output.slow <= 4.0  # what one watches


def test_the_table_has_the_recorded_times_and_the_machine() -> None:
    later = line(stages={"fill": 1.0, "simulate": 5.0})
    gpu = line(device="cuda", machine="NVIDIA X1", quality="shot", pieces=7, verdict="healed")
    text = gallery.table([line(), later, gpu])
    row = next(r for r in text.splitlines() if "cake_cut.yaml" in r)
    assert "6 s (fill 1, simulate 5; preview)" in row  # the last line counts
    assert "24 s (fill 3, simulate 20; shot, X1)" in row
    assert "| healed | 7 | 12 k | 0.12 % |" in row
    assert "2 cores: Some CPU, 2 cores." in text and "GPU: NVIDIA X1." in text
    empty = next(r for r in text.splitlines() if "milk_poured.yaml" in r)
    assert empty.endswith("| - | - | - | - | - | - |")


def test_two_that_photograph_at_once_leave_one_whole_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what a run that was cut short has left makes room."""

    def drawn(mine: str, meanwhile: bool) -> Any:
        def draw(name: str, folder: Path, *_: Any, **__: Any) -> None:
            (folder / "photographs").mkdir(parents=True)
            (folder / "cut.png").write_text(mine)
            if meanwhile:
                monkeypatch.setattr(gallery, "photograph_demo", drawn("quicker", False))
                gallery.photograph(name, tmp_path / "data" / name, "cpu")

        return draw

    (tmp_path / "data" / "orange" / "photographs").mkdir(parents=True)
    monkeypatch.setattr(gallery, "photograph_demo", drawn("slower", True))
    gallery.photograph("orange", tmp_path / "data" / "orange", "cpu")
    assert (tmp_path / "data" / "orange" / "cut.png").read_text() == "quicker"
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["orange"]


def test_a_strip_shows_the_moments_of_a_video(tmp_path: Path) -> None:
    from PIL import Image

    from gsfluent.pipeline.render.video import write_video

    shades = [np.full((48, 64, 3), 20 * i, np.uint8) for i in range(11)]
    write_video(tmp_path / "video.mp4", shades, fps=10, size=(64, 48))
    gallery.strip(tmp_path / "video.mp4", (0.0, 0.5, 1.0), tmp_path / "strip.jpg")
    picture = np.asarray(Image.open(tmp_path / "strip.jpg")).astype(float)
    assert picture.shape == (240, 960, 3)
    means = [picture[:, 320 * k : 320 * (k + 1)].mean() for k in range(3)]
    assert means == pytest.approx([0, 100, 200], abs=6)


def test_the_page_is_written_from_the_lines_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, lines = tmp_path / "gallery.md", tmp_path / "gallery.jsonl"
    page.write_text("# Gallery\n\n<!-- gallery: begin -->\nold\n<!-- gallery: end -->\n")
    lines.write_text(json.dumps(line()) + "\n")
    monkeypatch.setattr(gallery, "PAGE", page)
    monkeypatch.setattr(sys, "argv", ["gallery.py", "--page", "--lines", str(lines)])
    assert gallery.main() == 0
    text = page.read_text()
    assert "old" not in text and "24 s (fill 3, simulate 20; preview)" in text


@pytest.mark.parametrize("name", ["bread_torn", "cake_cut"])
def test_hands_that_nobody_sees_lift_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What they hold would hover; it is drawn and turned on the floor that it stands on."""
    hands = [c for c in shot_of(name, tmp_path, monkeypatch).colliders if not c.shown]
    assert hands
    for hand in hands:
        assert hand.velocity[2] == 0.0
        # turned over, it is turned about a point of the floor
        assert hand.spin[:2] == (0.0, 0.0) or hand.at[2] == 0.0
