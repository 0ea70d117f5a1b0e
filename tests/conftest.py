"""Fixtures shared by all tests: devices, the real data folder, seeds."""

from __future__ import annotations

import os
from pathlib import Path

# before torch starts its threads: spinning barriers crawl on a busy machine (see gsfluent/cli)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
import torch

REPO = Path(__file__).resolve().parent.parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    from gsfluent import has_cuda

    if not has_cuda():
        skip = pytest.mark.skip(reason="needs an NVIDIA GPU and gsfluent's CUDA library")
        for item in items:
            if "cuda" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real captures (GSFLUENT_DATA, default ../shared/data beside the checkout)."""
    root = Path(os.environ.get("GSFLUENT_DATA", REPO.parent / "shared" / "data"))
    if not (root / "README.md").exists():
        pytest.skip(f"real data not found at {root}; set GSFLUENT_DATA to its folder")
    return root
