"""Every Python block of README and documents runs as it stands: new interpreter, empty folder."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from page_blocks import ROOT, blocks_of, run_blocks

import gsfluent as gf

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
GIVEN = {"export.md": ["out"], "inpainting.md": ["models"]}
"""What a page reads that its own blocks do not make: a finished run, weights of a model."""

NEEDS = {"inpainting.md": "transformers"}
BENCH = "fracturebench.md"  # test_commands.py runs it between the commands that it stands between
PAGES = [page for page in DOCUMENTS if page.name != BENCH and blocks_of(page, "python")]


def test_every_block_says_what_it_is() -> None:
    fence = re.compile(r"^```(.*)$", re.MULTILINE)
    for page in DOCUMENTS:
        opened = fence.findall(page.read_text(encoding="utf-8"))[::2]
        assert set(opened) <= {"bash", "python", "yaml", "json", "text"}, page.name


def marked(page: Path) -> object:
    """The page, as slow where it reconstructs, paints or needs a whole run."""
    slow = page.name in ("first-run.md", *GIVEN)
    return pytest.param(page, marks=[pytest.mark.slow] if slow else [], id=page.name)


@pytest.mark.parametrize("page", [marked(page) for page in PAGES])
def test_blocks_run(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if page.name in NEEDS:
        pytest.importorskip(NEEDS[page.name])
    for name in GIVEN.get(page.name, []):
        (tmp_path / name).symlink_to(request.getfixturevalue("place") / name)
    before = set(tmp_path.rglob("*"))
    assert run_blocks(page, tmp_path).strip() or set(tmp_path.rglob("*")) - before


def test_a_saved_solid_is_loaded_as_a_solid(tmp_path: Path) -> None:
    solid = gf.pipeline.Fill(resolution=16)(gf.demo.make_splats("orange", spacing=0.006))
    gf.save(solid, tmp_path / "solid.ply")
    again = gf.load(tmp_path / "solid.ply")
    assert isinstance(again, gf.Solid) and again.occupancy.equal(solid.occupancy)
    gf.save(again.gaussians, tmp_path / "solid.ply")  # splats in its place leave no volume behind
    assert isinstance(gf.load(tmp_path / "solid.ply"), gf.Gaussians)
