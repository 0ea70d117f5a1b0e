"""One folder for all commands of the pages: inputs, a finished run, a filled solid."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from guide_folder import write_inputs

from gsfluent.cli import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "guide" / "light-and-video.md"


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder; tests go on in what others left there, as a person who reads along does."""
    folder = tmp_path_factory.mktemp("guide")
    write_inputs(folder)
    text = PAGE.read_text(encoding="utf-8")  # the files that this page shows
    for name, kind in (("night.yaml", "yaml"), ("path.json", "json")):
        found = re.search(rf"`{name}`:\n\n```{kind}\n(.*?)```", text, re.DOTALL)
        assert found is not None, f"{PAGE.name} no longer shows {name}"
        (folder / name).write_text(found.group(1))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (
            "run shot.yaml -o out",
            "fill melon.ply -o solid.ply --resolution 24",
            "texture solid.ply -o textured.ply --method color_copy",
            "export out --to delta",
        ):
            assert main(line.split()) == 0, line
    return folder
