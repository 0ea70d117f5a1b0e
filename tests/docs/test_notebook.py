"""The notebook of the examples: kept without outputs, and run from nothing as it stands."""

from __future__ import annotations

import json

import numpy as np
from page_blocks import ROOT, run_python
from PIL import Image

NOTEBOOK = ROOT / "examples" / "first_break.ipynb"


def test_the_notebook_breaks_its_melon(tmp_path) -> None:
    book = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert book["nbformat"] == 4
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert [cell for cell in code if cell["outputs"] or cell["execution_count"]] == []
    said = run_python("\n".join("".join(cell["source"]) for cell in code), tmp_path, NOTEBOOK.name)
    pieces = [int(line.split()[2]) for line in said.splitlines() if line.endswith("pieces")]
    assert pieces[0] == 1 and pieces[-1] > 1  # whole before it lands, broken at the end
    assert "clean" in said
    pictures = [np.asarray(Image.open(path)) for path in sorted(tmp_path.glob("break_*.png"))]
    assert len(pictures) == len(pieces) and (tmp_path / "break.webp").is_file()
    # the red inside is seen at the end and not before
    red = [(p[..., 0] > 120) & (p[..., 1] < 90) & (p[..., 2] < 90) for p in pictures]
    assert red[0].sum() < 20 < red[-1].sum()
