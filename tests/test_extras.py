"""Every package that an extra brings is named by what misses it, and pyproject.toml agrees."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent.choose.shot import _write
from gsfluent.cli import main
from gsfluent.demo import make_splats
from gsfluent.errors import EXTRAS, MissingPackage
from gsfluent.inspection.compare_weights import clip_scores
from gsfluent.inspection.doctor import examine
from gsfluent.io.splats.load import save_forged
from gsfluent.io.usd import open_usd
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.mesh import closed_mesh
from gsfluent.pipeline.texture.inpaint.diffusers import DiffusersInpainter, InpaintOptions
from gsfluent.posing.colmap import find_poses
from gsfluent.run.report import report_page
from gsfluent.sweep.ray_pool import RayPool
from gsfluent.sweep.slurm import SlurmPool
from gsfluent.viewer.guard import Guard
from gsfluent.viewer.server import start_server

CPU = torch.device("cpu")
PROJECT = tomllib.loads(
    (Path(__file__).resolve().parents[1] / "pyproject.toml").read_text(encoding="utf-8")
)["project"]
NOT_OF_DEVELOPERS = ("ray", "s3")
"""Extras whose tests are skipped where nobody has installed them."""
Blocker = Callable[[str], None]


def poses(tmp_path: Path) -> None:
    find_poses(tmp_path, tmp_path / "out")


def surface(tmp_path: Path) -> None:
    closed_mesh(SignedDistance(-torch.ones(4, 4, 4), torch.zeros(3), 1.0, "test"))


def page(tmp_path: Path) -> None:
    start_server("127.0.0.1", 0, "test", Guard("127.0.0.1"))


def stage(tmp_path: Path) -> None:
    with open_usd(tmp_path / "scene.usda", fps=24.0):
        raise AssertionError("opened without usd-core")


def packed(tmp_path: Path) -> None:
    save_forged(make_splats("orange", spacing=0.02), tmp_path / "a.sog")


def prompt(tmp_path: Path) -> None:
    clip_scores([np.zeros((8, 8, 3), np.uint8)], "a melon", tmp_path, CPU)


def inpaint(tmp_path: Path) -> None:
    DiffusersInpainter(tmp_path, InpaintOptions(memory="high"))


def inpaint_from_memory(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    DiffusersInpainter(tmp_path, InpaintOptions(memory="balanced"))


def cluster(tmp_path: Path) -> None:
    SlurmPool(tmp_path, open, jobs=1, minutes=None, threads=1)


def ray_cluster(tmp_path: Path) -> None:
    RayPool(tmp_path, open, jobs=1, minutes=None, threads=1)


@pytest.mark.parametrize(
    ("act", "module", "extra"),
    [
        (poses, "pycolmap", "poses"),
        (surface, "skimage", "mesh"),
        (page, "viser", "viewer"),
        (stage, "pxr", "usd"),
        (packed, "gaussforge", "formats"),
        (cluster, "submitit", "slurm"),
        (ray_cluster, "ray", "ray"),
        (prompt, "transformers", "inpaint"),
        (inpaint, "transformers", "inpaint"),
        (inpaint, "diffusers", "inpaint"),
        (inpaint_from_memory, "accelerate", "inpaint"),
    ],
)
def test_what_is_missing_is_named(
    act: Callable[[Path], None], module: str, extra: str, tmp_path: Path, without: Blocker
) -> None:
    if module == "diffusers":
        pytest.importorskip("transformers")  # asked for first
    (tmp_path / "model_index.json").write_text("{}")
    without(module)
    with pytest.raises(MissingPackage, match=f" needs {module}, ") as said:
        act(tmp_path)
    assert said.value.hint == f'pip install "gsfluent[{extra}]"'


@pytest.mark.parametrize("words", [["chart", "--quick"], ["stability", "--quick"]])
def test_charts_say_before_the_work_what_would_draw_them(
    words: list[str], tmp_path: Path, without: Blocker, capsys: pytest.CaptureFixture[str]
) -> None:
    without("matplotlib")
    assert main([*words, "-o", str(tmp_path / "out"), "--device", "cpu"]) == 2
    assert f"{words[0]} needs matplotlib, " in (said := capsys.readouterr().err)
    assert 'pip install "gsfluent[figures]"' in said and not (tmp_path / "out").exists()


def test_a_report_without_matplotlib_lacks_its_curves_alone(
    tmp_path: Path, without: Blocker
) -> None:
    without("matplotlib")
    frames = {"time": [0.0, 0.1], "fragments": [1, 7]}
    values = {
        "verdict": "clean", "device": "cpu", "simulation": {"per_frame": frames},
        "render": {"hole_fraction": [0.0, 0.1]}, "stages": [{"name": "fill", "seconds": 1.0}],
    }  # fmt: skip
    text = report_page(tmp_path, values).render()
    assert "<svg" not in text and text.count("gsfluent[figures]") == 2
    for head in ("Motion", "Pictures", "Where the time went"):
        assert f"<h2>{head}</h2>" in text


def test_a_choice_without_matplotlib_lacks_its_picture_alone(
    tmp_path: Path, without: Blocker, caplog: pytest.LogCaptureFixture
) -> None:
    without("matplotlib")
    assert not _write({"settings": []}, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["chart.json"]
    assert "gsfluent[figures]" in caplog.text


def test_the_doctor_knows_every_extra() -> None:
    extras = examine(CPU)["extras"]
    assert {extra: tuple(found) for extra, found in extras.items()} == EXTRAS
    assert all(
        version is None or version[0].isdigit() for v in extras.values() for version in v.values()
    )


def test_pyproject_has_these_extras_and_nothing_of_them_in_its_core() -> None:
    def names(requirements: list[str]) -> tuple[str, ...]:
        return tuple(re.split(r"[\[<>=!~ ]", r)[0] for r in requirements)

    extras = PROJECT["optional-dependencies"]
    assert {k: names(v) for k, v in extras.items() if k != "dev"} == EXTRAS
    # a cluster's share of a gigabyte is not for every machine that runs the tests
    mine = [name for name in EXTRAS if name not in NOT_OF_DEVELOPERS]
    assert f"gsfluent[{','.join(mine)}]" in extras["dev"]
    core = names(PROJECT["dependencies"])
    build = ("ninja", "pybind11", "setuptools", "wheel")
    assert not set(core) & {*build, *(name for v in EXTRAS.values() for name in v)}


def test_every_module_loads_without_the_extras() -> None:
    code = """
import importlib, pkgutil, sys
sys.modules |= dict.fromkeys(
    ["pycolmap", "skimage", "viser", "pxr", "transformers", "accelerate", "matplotlib",
     "submitit", "ray", "s3fs", "gaussforge"])
import gsfluent
names = [m.name for m in pkgutil.walk_packages(gsfluent.__path__, "gsfluent.")]
for name in names:
    if not name.rpartition(".")[2].startswith(("_C", "_core", "__main__")):
        importlib.import_module(name)
print(len(names))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 300, done.stderr
