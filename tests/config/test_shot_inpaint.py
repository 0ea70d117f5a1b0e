"""``texture.inpaint:`` reaches the stage, and is refused where nobody reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsfluent.config import Shot
from gsfluent.config.settings_inpaint import read_inpaint
from gsfluent.errors import InputError
from gsfluent.pipeline.texture import Texture


def shot(folder: Path, texture: dict[str, Any]) -> Shot:
    (folder / "melon.ply").write_bytes(b"")
    return Shot.from_dict(
        {
            "splats": "melon.ply",
            "texture": texture,
            "objects": {"melon": {"material": "fruit.watermelon"}},
            "events": [{"type": "drop", "object": "melon", "height": 1.0}],
        },
        folder,
    )


def test_options_reach_the_stage(tmp_path: Path) -> None:
    inpaint = {"backend": "telea", "refine": [0.4], "tile": 2, "schedule": "coupled"}
    read = shot(tmp_path, {"method": "inpaint", "inpaint": inpaint, "polish": True})
    stage = Texture(**read.texture.given())
    assert stage.inpaint.backend == "telea" and stage.inpaint.refine == (0.4,)
    assert stage.inpaint.tile == 2 and stage.inpaint.schedule == "coupled" and stage.polish
    plain = Texture(**shot(tmp_path, {"method": "color_copy"}).texture.given())
    assert plain.inpaint.backend == "diffusers" and not plain.polish


def test_misplaced_and_missing_keys_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"texture\.inpaint does nothing with method profile"):
        shot(tmp_path, {"method": "profile", "inpaint": {"tile": 2}})
    with pytest.raises(InputError, match=r"texture\.model is missing"):
        shot(tmp_path, {"method": "inpaint"})
    with pytest.raises(InputError, match=r"texture\.inpaint\.backend"):
        shot(tmp_path, {"method": "inpaint", "inpaint": {"backend": "photoshop"}})
    with pytest.raises(InputError, match="tile"):
        Texture(
            **shot(
                tmp_path, {"method": "inpaint", "inpaint": {"backend": "telea", "tile": 3}}
            ).texture.given()
        )


def test_words_of_a_command_line() -> None:
    words = ["tile=2", "refine=[0.3, 0.1]", "command=run {folder}", "offline=true"]
    assert read_inpaint(words) == {
        "tile": 2,
        "refine": (0.3, 0.1),
        "command": "run {folder}",
        "offline": True,
    }
    assert read_inpaint([]) == {}
    for wrong in ("tile", "tile=", "tile: 2", "tile=[", "tyle=2", "tile=two"):
        with pytest.raises(InputError):
            read_inpaint([wrong])
