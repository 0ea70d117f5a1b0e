"""The Python face of the specification's interface page, as a user types it."""

from __future__ import annotations

import math
from types import ModuleType

import pytest
import torch

import gsfluent as gf
from gsfluent.errors import InputError
from gsfluent.io import save_splats
from gsfluent.pipeline.light.lamps import key_light


def shell(radius: float = 0.1, count: int = 4000) -> gf.Gaussians:
    """A ball's surface as flat green splats, far below the scene's floor."""
    index = torch.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    ring = (1 - height**2).sqrt()
    out = torch.stack([ring * angle.cos(), ring * angle.sin(), height], -1)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous()
    green = (torch.tensor([0.2, 0.6, 0.2]) - 0.5) / 0.28209479177387814
    return gf.Gaussians(
        means=radius * out - torch.tensor([0.0, 0.0, 0.4]),
        quats=quats,
        scales=torch.full((count, 3), 0.035 * radius),
        opacities=torch.full((count,), 0.95),
        sh=green.expand(count, 1, 3).contiguous(),
    )


def test_the_example_of_the_interface_page_runs(tmp_path) -> None:
    save_splats(shell(), tmp_path / "melon.ply")

    gaussians = gf.load(tmp_path / "melon.ply")
    solid = gf.pipeline.Fill(resolution=32)(gaussians)
    solid = gf.pipeline.Texture(method="color_copy")(solid)
    scene = gf.Scene(floor=0.0)
    scene.add(solid, material=gf.materials.fruit.watermelon)
    camera = gf.Camera.look_at((0.5, -0.5, 0.3), (0.0, 0.0, 0.1), width=64, height=48)
    render = gf.pipeline.Render(camera, key_light())
    simulation = gf.pipeline.Simulate(dx=0.025)(scene, fps=30, seconds=2 / 30)
    for frame in simulation:
        image = render(frame.gaussians).image
        assert image.shape == (48, 64, 3) and bool(image.isfinite().all())
        # the green ball is in the picture, before a white ground
        assert float((image[..., 1] - image[..., 0]).max()) > 0.1
        assert frame.damage.shape == frame.fragments.shape
        assert frame.energy["kinetic"] >= 0.0
    assert simulation.report["verdict"] == "clean"
    # a solid without a frame stands on the floor, not in the ground
    assert abs(float(frame.particles.position[:, 2].min())) < 0.03


@pytest.mark.parametrize("name", gf.ops.__all__)
def test_every_op_is_public(name: str) -> None:
    assert callable(getattr(gf.ops, name))


@pytest.mark.parametrize("package", [gf, gf.ops, gf.pipeline])
def test_a_package_lists_what_it_gives_and_refuses_the_rest(package: ModuleType) -> None:
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        assert getattr(package, name) is getattr(package, name)
    with pytest.raises(
        AttributeError, match=f"module '{package.__name__}' has no attribute 'teapot'"
    ):
        _ = package.teapot


def test_nothing_below_the_floor_is_accepted_with_a_frame() -> None:
    solid = gf.pipeline.Fill(resolution=24)(shell())
    scene = gf.Scene(floor=0.0)
    scene.add(solid, frame=gf.Frame.identity())
    with pytest.raises(InputError, match="below the floor"):
        next(iter(gf.pipeline.Simulate(dx=0.05)(scene, fps=30, seconds=0.1)))
