"""Fixtures of the pipeline's tests that are worth making once."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def tiny_sdxl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a random SD-XL inpainting pipeline (9 inputs)."""
    pytest.importorskip("diffusers")
    pytest.importorskip("transformers")
    import tiny_diffusers

    return tiny_diffusers.save_sdxl(tmp_path_factory.mktemp("sdxl"))


@pytest.fixture(scope="session")
def tiny_sdxl_base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a random SD-XL base pipeline (4 inputs, not made for inpainting)."""
    pytest.importorskip("diffusers")
    pytest.importorskip("transformers")
    import tiny_diffusers

    return tiny_diffusers.save_sdxl(tmp_path_factory.mktemp("sdxl_base"), channels=4)
