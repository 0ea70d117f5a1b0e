"""Light baked into exported colours, against the lit picture of the same frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from export_run import add_record, make_run

from gsfluent.config import Shot
from gsfluent.data import SURFACE, Camera, Gaussians
from gsfluent.errors import InputError
from gsfluent.export.write import ExportOptions, export
from gsfluent.io import load_splats
from gsfluent.metrics import psnr
from gsfluent.pipeline import Render
from gsfluent.pipeline.light.from_shot import light_of
from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.results.frames import load_frame, save_frame
from gsfluent.results.record import shot_of

CPU = torch.device("cpu")


def ball() -> Gaussians:
    """A grey ball of solid matter, 0.2 m wide, at 0.4 m."""
    axis = torch.arange(-11, 12) * 0.01
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    grid = grid[grid.norm(dim=1) < 0.101] + torch.tensor([0.0, 0.0, 0.4])
    grey = torch.full((len(grid), 3), 0.6)
    return Gaussians.from_colors(
        grid, torch.full((len(grid),), 0.007), grey, opacities=0.95, label=SURFACE
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = add_record(make_run(tmp_path_factory.mktemp("relit"), degree=0))
    folder = out / "stages" / "simulate"
    gaussians = ball()
    none = torch.full((gaussians.count,), -1, dtype=torch.int32)
    saved = load_frame(folder, 0)
    save_frame(
        folder,
        replace(
            saved, gaussians=gaussians, groups=none, anchor=none, carried=gaussians.count,
            ids=torch.arange(gaussians.count),
        ),
    )  # fmt: skip
    return out


def test_baked_light_looks_like_the_lit_picture(run: Path, tmp_path: Path) -> None:
    options = ExportOptions(relit=True, frames="0", light="-1,-0.5,1")
    export(run, ["ply-seq"], device=CPU, to=tmp_path, options=options)
    baked = load_splats(tmp_path / "frames" / "frame_0001.ply")
    plain = ball()
    camera = Camera.look_at((0.6, -0.5, 0.6), (0, 0, 0.4), width=120, height=120, fov=18.0)
    shot: Shot = shot_of(run)
    lighting: Lighting = light_of(shot)
    key = replace(lighting.lamps[0], direction=(-1.0, -0.5, 1.0))
    lighting = replace(lighting, lamps=(key, *lighting.lamps[1:]), specular=0.0)
    lit = Render(camera, lighting, normal_cell=occupancy_cell(plain))(plain)
    unlit = Render(camera, None)
    solid = lit.alpha > 0.9
    assert solid.float().mean() > 0.2
    assert psnr(unlit(baked).image, lit.image, solid) > 45.0
    assert psnr(unlit(plain).image, lit.image, solid) < 22.0
    # lit from the left and above, in the shade below
    shade = baked.colors().mean(dim=1)
    low = baked.means[:, 2] < 0.33
    toward = (baked.means - torch.tensor([0.0, 0.0, 0.4])) @ torch.tensor([-1.0, -0.5, 1.0]) > 0.14
    assert float(shade[toward].mean()) > 1.25 * float(shade[low].mean())


def test_a_packed_sequence_has_no_normals_to_light(run: Path, tmp_path: Path) -> None:
    export(run, ["delta"], device=CPU, to=tmp_path, options=ExportOptions())
    with pytest.raises(InputError, match="--relit"):
        options = ExportOptions(relit=True)
        export(tmp_path / "splats.gsd", ["spz"], device=CPU, options=options)


def test_a_light_that_cannot_be_read(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--light"):
        options = ExportOptions(relit=True, light="up")
        export(run, ["spz"], device=CPU, to=tmp_path, options=options)
