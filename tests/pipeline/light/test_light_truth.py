"""Light against ray-traced truth, by the functions of scripts/accuracy/light.py."""

from __future__ import annotations

import pytest
import torch
from loaded_scripts import load_script

from gsfluent.data import Camera, Gaussians
from gsfluent.lab.truth import light as truth
from gsfluent.pipeline.light.lamps import Lamp, Lighting
from gsfluent.pipeline.light.shade import to_linear
from gsfluent.pipeline.render.stage import Render

light_accuracy = load_script("accuracy/light")

BAR = 0.02  # issue 6


@pytest.fixture(scope="module")
def skin() -> Gaussians:
    ball = truth.Ball((0.0, 0.0, 0.0), light_accuracy.RADIUS)
    return truth.surface_splats(ball, 80_000, light_accuracy.GREY)


@pytest.mark.parametrize(
    "name", ["directional", "point", "three lamps", "specular", "environment, evening sky"]
)
def test_lit_sphere_is_within_two_percent_of_truth(skin: Gaussians, name: str) -> None:
    error, _ = light_accuracy.sphere(skin, name)
    assert error < BAR


def test_solid_of_round_splats_finds_its_own_normals() -> None:
    ball = truth.Ball((0.0, 0.0, 0.0), light_accuracy.RADIUS)
    solid = truth.solid_splats(ball, 0.005, light_accuracy.GREY)
    error, _ = light_accuracy.sphere(solid, "directional")
    assert error < 0.03


@pytest.mark.parametrize(
    "name",
    [
        "ball, directional, 0 degrees",
        "ball, directional, 4 degrees",
        "box, directional, 12 degrees",
        "ball, directional, 12 degrees",
        "ball, point, 6 cm wide",
        "box, point, 6 cm wide",
    ],
)
def test_shadow_edge_and_penumbra_are_within_two_percent_of_the_object(name: str) -> None:
    found = light_accuracy.shadow(name)
    assert found["edge"] < 100.0 * BAR
    assert found["penumbra"] < 100.0 * BAR


def test_a_lamp_in_parts_makes_the_same_penumbra() -> None:
    found = light_accuracy.shadow("box, directional, 12 degrees", samples=16)
    assert found["edge"] < 100.0 * BAR
    assert found["penumbra"] < 200.0 * BAR  # 16 steps


@pytest.mark.parametrize("name", ["wall of a crack", "bed of a crack", "floor beside a ball"])
def test_occlusion_follows_the_share_of_the_sky(name: str) -> None:
    error, found, expected = light_accuracy.occlusion(name)
    assert error < 0.1
    # deep in a crack is darker than at its mouth, far from the ball lighter than under it
    rising = torch.corrcoef(torch.stack([found, expected]))[0, 1]
    assert name == "bed of a crack" or float(rising) > 0.95


def test_open_surfaces_are_not_occluded() -> None:
    _, found, _ = light_accuracy.occlusion("skin of a ball")
    assert float(found.min()) > 0.98


def test_truth_of_a_disc_lamp_is_the_share_of_its_area() -> None:
    # a half plane (a long box) whose edge runs through the middle of the lamp hides half of it
    lamp = truth.TrueLamp(direction=(0.0, 0.0, 1.0), spread=0.05)
    wall = truth.Box((-5.0, -5.0, 0.9), (0.0, 5.0, 1.0))
    points = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [-0.2, 0.0, 0.0]]).double()
    share = truth.unblocked(points, lamp, [wall], torch.zeros(3).double(), 4000)
    torch.testing.assert_close(share, torch.tensor([0.5, 1.0, 0.0]).double(), atol=0.01, rtol=0)


def test_truth_of_the_sky_above_a_floor_beside_a_wall() -> None:
    # at the foot of a wall that is long and high, half the cosine-weighted sky is left
    wall = truth.Box((-100.0, -1000.0, 0.0), (0.0, 1000.0, 1000.0))
    point = torch.tensor([[1e-6, 0.0, 0.0]]).double()
    up = torch.tensor([[0.0, 0.0, 1.0]]).double()
    share = truth.sky_share(point, up, [wall], 4000)
    assert float(share) == pytest.approx(0.5, abs=0.01)


def test_moving_matter_does_not_shimmer() -> None:
    # the same ball seen the same way, moved by parts of a cell and of a texel between pictures
    solid = truth.solid_splats(truth.Ball((0.0, 0.0, 0.0), 0.1), 0.005, 0.5)
    pictures = []
    for step in range(4):
        move = step * torch.tensor([0.0031, 0.0017, 0.0023])
        eye, target = move + torch.tensor([0.15, -0.8, 0.25]), move
        camera = Camera.look_at(eye, target, width=96, height=96, fov=15.5)
        light = Lighting((Lamp(),), ambient=0.3)
        layers = Render(camera, light)(solid.replace(means=solid.means + move))
        pictures.append(to_linear(layers.image)[layers.alpha > 0.999])
    for picture in pictures[1:]:
        change = (picture - pictures[0]).square().mean().sqrt() / pictures[0].square().mean().sqrt()
        assert float(change) < 0.01
