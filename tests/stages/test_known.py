"""Meshes and filled solids keep the inside that they have."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import trimesh

from gsfluent.config import Shot
from gsfluent.data import Solid
from gsfluent.errors import InputError
from gsfluent.io import load_splats, save_solid
from gsfluent.pipeline.fill.mesh_skin import mesh_gaussians
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.stages.known import extended, known_solid, parted, source_digest


def filled(path: Path, resolution: int = 24) -> Solid:
    return Fill(resolution)(mesh_gaussians(path, 800), solid=path)


@pytest.fixture
def figure(tmp_path: Path) -> Path:
    """Two balls that overlap: one body, although its surfaces pass through each other."""
    low = trimesh.creation.icosphere(2, radius=1.0)
    high = trimesh.creation.icosphere(2, radius=0.6)
    high.apply_translation([0.0, 1.2, 0.0])
    trimesh.util.concatenate([low, high]).export(tmp_path / "figure.stl")
    return tmp_path / "figure.stl"


def test_overlapping_parts_are_one_body(figure: Path) -> None:
    solid = filled(figure, 32)
    where = torch.tensor([[0.0, 0.8, 0.0], [0.0, -0.5, 0.0], [0.0, 1.5, 0.0], [0.9, 0.9, 0.0]])
    assert solid.contains(where).tolist() == [True, True, True, False]


@pytest.mark.parametrize("thickness", [0.05, 0.11, 0.13, 0.5])
def test_the_volume_of_a_plate_is_that_of_its_mesh(tmp_path: Path, thickness: float) -> None:
    """At 24 voxels the plate of 0.11 is two and a half of them: two or three are 20 % off."""
    plate = trimesh.creation.box((1.0, 0.9, thickness))
    plate.export(tmp_path / "plate.obj")
    solid = filled(tmp_path / "plate.obj")
    assert solid.volume == pytest.approx(plate.volume, rel=0.01)
    assert solid.report["volume_of_mesh"] == pytest.approx(plate.volume)


def test_a_filled_solid_is_taken_as_it_is(figure: Path) -> None:
    solid = filled(figure)
    path = figure.parent / "solid.ply"
    save_solid(solid, path)
    shot = Shot.from_dict({"splats": str(path)})
    again = known_solid(shot, load_splats(path), {})
    assert again is not None and torch.equal(again.occupancy, solid.occupancy)
    assert again.report["volume"] == solid.volume
    with pytest.raises(InputError, match="is a filled solid"):
        known_solid(
            Shot.from_dict({"splats": str(path), "fill": {"resolution": 50}}), solid.gaussians, {}
        )
    before = source_digest(shot)
    save_solid(filled(figure, 20), path)
    assert source_digest(shot) != before
    path.with_suffix(".volume.npz").unlink()
    assert known_solid(shot, solid.gaussians, {}) is None


def test_objects_share_the_matter_out(figure: Path) -> None:
    solid = filled(figure)
    skin = mesh_gaussians(figure, 800)
    upper = skin.means[:, 1] > 0.95
    masks = {
        name: extended(mask, skin, solid.gaussians)
        for name, mask in {"head": upper, "body": ~upper}.items()
    }
    parts = parted(solid, masks)
    assert not (parts["head"].occupancy & parts["body"].occupancy).any()
    assert torch.equal(parts["head"].occupancy | parts["body"].occupancy, solid.occupancy)
    assert parts["head"].gaussians.count + parts["body"].gaussians.count == solid.gaussians.count
    # depth grows from the cut: a cut is a surface
    assert float(parts["body"].depth.max()) <= float(solid.depth.max()) + solid.voxel
    assert (parts["head"].depth[parts["head"].occupancy] > 0).all()
    with pytest.raises(InputError, match="no matter"):
        parted(solid, {"none": torch.zeros_like(masks["head"]), "all": masks["head"]})
