"""Proxies of splats and meshes are made once, and again when what they hang on has changed."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import trimesh

import gsfluent.plan.proxy as module
from gsfluent.config import Shot
from gsfluent.plan.proxy import Proxy, proxy


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Shot]:
    """The shots whose proxies were made, in a cache of their own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    found, make = [], module._of_surface

    def counted(shot: Shot) -> Proxy:
        found.append(shot)
        return make(shot)

    monkeypatch.setattr(module, "_of_surface", counted)
    return found


def test_a_proxy_is_made_once(made: list[Shot], tmp_path: Path) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((0.4, 1.0, 0.5)).export(path)
    shot = Shot.from_dict({"mesh": str(path), "size": 0.5})
    first, again = proxy(shot, []), proxy(shot, [])
    assert len(made) == 1
    (name,) = first.solids
    one, two = first.solids[name], again.solids[name]
    assert torch.equal(one.occupancy, two.occupancy) and torch.equal(one.depth, two.depth)
    assert one.gaussians.count == two.gaussians.count and one.voxel == two.voxel
    assert torch.equal(first.frame.translation, again.frame.translation)
    assert (first.assumed, first.splats) == (again.assumed, again.splats)
    # another size, and another file of the same name, are other things
    assert proxy(Shot.from_dict({"mesh": str(path), "size": 0.6}), []).frame.scale == pytest.approx(
        0.6, rel=0.02
    )
    trimesh.creation.box((0.4, 0.7, 0.5)).export(path)
    assert proxy(shot, []).solids[name].volume != pytest.approx(one.volume, rel=0.1)
    assert len(made) == 3


def test_a_damaged_one_is_made_anew_and_old_ones_go(
    made: list[Shot], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_VOXELS", 16)
    path = tmp_path / "box.stl"
    trimesh.creation.box((1.0, 1.0, 1.0)).export(path)
    shot = Shot.from_dict({"mesh": str(path)})
    proxy(shot, [])
    (kept,) = (tmp_path / "cache" / "gsfluent" / "proxies").iterdir()
    (kept / "0.ply").write_bytes(b"ply")
    proxy(shot, [])
    assert len(made) == 2
    for number in range(9):
        proxy(Shot.from_dict({"mesh": str(path), "size": 1.0 + number}), [])
    assert len([*kept.parent.iterdir()]) == 8
