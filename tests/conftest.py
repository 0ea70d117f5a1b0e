"""Fixtures shared by all tests: devices, the real data folder, seeds."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

# before torch starts its threads: spinning barriers crawl on a busy machine (see gsfluent/cli)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
import torch

from gsfluent.demo import capture
from gsfluent.pipeline.simulate.stage import QUALITY

REPO = Path(__file__).resolve().parent.parent

# a shell starts what it puts in the background with Ctrl-C ignored, and every process that a test
# starts and interrupts would inherit that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


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


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Calibrations of the machine that tests run on are neither read nor taught by them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _one_glance() -> Iterator[None]:
    """The look at a new machine, which the first run into each cache takes, once and not thrice."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsfluent.plan.quick._TRIES", 1)
        yield


@pytest.fixture(autouse=True, scope="session")
def _small_cuts() -> Iterator[None]:
    """The four cuts that every textured solid leaves, in few pixels: 1 s of work each time else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsfluent.pipeline.render.cuts._HEIGHT", 72)
        yield


@pytest.fixture(autouse=True, scope="session")
def _small_truth() -> Iterator[None]:
    """A drawn capture brings a volume and a cut of its inside: in few pixels, else 2 s of work."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture.save_truth, "__defaults__", (48,))
        patch.setattr(capture.cut_photograph, "__defaults__", (128,))
        yield


@pytest.fixture(scope="module")
def small_quality() -> Iterator[None]:
    """Where a shot leaves voxels and cells to its quality, few of both."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsfluent.pipeline.fill.stage._PICTURE", 48)
        patch.setitem(QUALITY, "preview", 12)
        yield


@pytest.fixture(autouse=True, scope="session")
def _share_bytecode(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Where Python writes no bytecode, every new process would compile torch anew: one does."""
    with pytest.MonkeyPatch.context() as patch:
        if sys.dont_write_bytecode:
            patch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
            root = tmp_path_factory.getbasetemp()
            if "PYTEST_XDIST_WORKER" in os.environ:  # the folder of all workers
                root = root.parent
            patch.setenv("PYTHONPYCACHEPREFIX", str(root / "bytecode"))
        yield


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real captures (GSFLUENT_DATA, default ../shared/data beside the checkout)."""
    root = Path(os.environ.get("GSFLUENT_DATA", REPO.parent / "shared" / "data"))
    if not (root / "README.md").exists():
        pytest.skip(f"real data not found at {root}; set GSFLUENT_DATA to its folder")
    return root


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Make a package look as if it were not installed."""

    def block(package: str) -> None:
        for name in list(sys.modules):
            if name.startswith(package + "."):
                monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, package, None)

    return block
