"""docs/guide/shot-keys.md holds every key, as the program has it."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import yaml

from gsfluent.config import Shot, reference
from gsfluent.config.read import Place, key_name

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "guide"
PAGE = GUIDE / "shot-keys.md"
CASES = [
    (section, field)
    for section, cls in reference.SECTIONS.items()
    for field in dataclasses.fields(cls)
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (
        "melon.ply",
        "cut.jpg",
        "labels.npy",
        "bowl.obj",
        "side.png",
        "room.hdr",
        "vase.glb",
    ):
        (tmp_path / name).write_bytes(b"")
    for name in ("captures/apple", "parts/stem", "segmentation"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(("block", "wanted"), [
    ("parameters", reference.parameters()), ("tables", reference.tables()),
])  # fmt: skip
def test_page_holds_what_the_program_says(block: str, wanted: str) -> None:
    found = re.search(rf"<!-- {block}: [^\n]*-->\n(.*?)<!-- end -->", PAGE.read_text(), re.DOTALL)
    assert found is not None and found.group(1) == wanted


@pytest.mark.parametrize(("section", "field"), CASES, ids=[f"{s}.{key_name(f)}" for s, f in CASES])
def test_every_example_is_accepted(folder: Path, section: str, field: dataclasses.Field) -> None:  # type: ignore[type-arg]
    value = yaml.safe_load(field.metadata["example"])
    field.metadata["read"](value, Place(f"{section}.{key_name(field)}", folder))
    assert field.metadata["doc"].endswith(".")


def test_shots_on_the_page_read(folder: Path) -> None:
    shots = re.findall(r"```yaml\n(.*?)```", (GUIDE / "shot-file.md").read_text(), re.DOTALL)
    assert len(shots) == 4
    for text in shots:
        assert Shot.from_dict(yaml.safe_load(text), folder).events
