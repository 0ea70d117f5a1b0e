"""Sizes of a first run here."""

from __future__ import annotations

from pathlib import Path

import pytest
from first_film import FRAMES

import gsfluent.run.from_input as from_input


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Few photographs' pixels, voxels, cells and frames, a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    small = {
        "fill": {"resolution": 24},
        "solve": {"cells": 8},
        "output": {"fps": 20, "seconds": FRAMES / 20, "size": [64, 48]},
    }
    monkeypatch.setattr(from_input, "SETTINGS", small)
