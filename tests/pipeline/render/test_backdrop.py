"""The captured backdrop: what is nearer hides, shadows fall, the object's place is covered."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gsfluent import demo
from gsfluent.config import Shot
from gsfluent.data import BACKGROUND, Camera, Capture, Gaussians
from gsfluent.errors import InputError
from gsfluent.io import load_capture
from gsfluent.io.images import load_view
from gsfluent.pipeline.capture.orient import make_frame, orient
from gsfluent.pipeline.light.lamps import key_light
from gsfluent.pipeline.render.backdrop import Backdrop, covered_floor, object_radius
from gsfluent.pipeline.render.stage import Render

RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)


def sheet(x: float, color: tuple[float, float, float], half: float = 1.0) -> Gaussians:
    """An upright wall of splats at this x."""
    axis = torch.linspace(-half, half, 25)
    y, z = torch.meshgrid(axis, axis, indexing="ij")
    means = torch.stack([torch.full_like(y, x), y, z], -1).reshape(-1, 3)
    scales = torch.tensor([0.01, 0.06 * half, 0.06 * half]).repeat(len(means), 1)
    colors = torch.tensor(color).repeat(len(means), 1)
    return Gaussians.from_colors(means, scales, colors, opacities=0.95)


def table(hole: float = 0.0, color: tuple[float, float, float] = RED) -> Gaussians:
    """Splats on z = 0, with a hole around the origin."""
    axis = torch.linspace(-1.5, 1.5, 61)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    means = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    means = means[means[:, :2].norm(dim=1) > hole]
    scales = torch.tensor([0.04, 0.04, 0.005]).repeat(len(means), 1)
    colors = torch.tensor(color).repeat(len(means), 1)
    return Gaussians.from_colors(means, scales, colors, opacities=0.95, label=BACKGROUND)


CAMERA = Camera.look_at((4.0, 0.0, 0.0), (0.0, 0.0, 0.0), width=64, height=48, fov=20.0)


@pytest.mark.parametrize(("wall", "seen"), [(-1.0, BLUE), (1.0, RED)])
def test_what_is_nearer_hides_what_is_behind(wall: float, seen: tuple[float, float, float]) -> None:
    backdrop = Backdrop(sheet(wall, RED), 1.0)
    image = Render(CAMERA)(sheet(0.0, BLUE, half=0.4), backdrop=backdrop).image
    assert torch.allclose(image[24, 32], torch.tensor(seen), atol=0.06)
    # beside the object the backdrop shows, and it covers the white behind it
    assert torch.allclose(image[24, 6], torch.tensor(RED), atol=0.06)


def test_without_matter_in_the_way_the_captured_colours_are_kept() -> None:
    above = Camera.look_at((0.1, 0.0, 4.0), (0.0, 0.0, 0.0), width=48, height=48, fov=20.0)
    ball = sheet(0.0, BLUE, half=0.05)
    image = Render(above, key_light())(ball, backdrop=Backdrop(table(), 0.1)).image
    assert torch.allclose(image[4, 4], torch.tensor(RED), atol=0.05)


def test_the_matter_throws_its_shadow_on_the_table() -> None:
    light = key_light(direction=(0.2, 0.0, 1.0), ambient=0.3, intensity=0.7)
    lid = sheet(0.0, BLUE, half=0.5)
    # laid flat, half a metre above the table
    raised = lid.means[:, [2, 1, 0]] + torch.tensor([0.0, 0.0, 0.5])
    lid = lid.replace(means=raised, scales=lid.scales[:, [2, 1, 0]])
    camera = Camera.look_at((0.0, -3.0, 1.2), (0.0, 0.0, 0.0), width=64, height=64, fov=60.0)
    backdrop = Backdrop(table(), 0.5)
    lit = Render(camera, key_light(shadow=False))(lid, backdrop=backdrop).image
    dark = Render(camera, light)(lid, backdrop=backdrop).image
    pixel, _ = camera.project(torch.tensor([[-0.1, 0.0, 0.0], [1.3, 0.0, 0.0]]))
    (u, v), (a, b) = pixel.floor().long().tolist()
    # 0.3 of the light stays there: 0.3^(1/2.2) of the display value
    assert float(dark[v, u, 0] / lit[v, u, 0]) == pytest.approx(0.3 ** (1 / 2.2), abs=0.08)
    assert float(dark[b, a, 0] / lit[b, a, 0]) == pytest.approx(1.0, abs=0.05)


def test_the_hole_under_the_object_is_covered_in_the_colours_around_it() -> None:
    holed = table(hole=0.4)
    stood = 0.3 * torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    covered = covered_floor(holed, stood, 0.0)
    # the table's own splats outside of the hole stay, in their order
    assert torch.equal(covered.means[: holed.count], holed.means)
    added = covered.select(torch.arange(covered.count) >= holed.count)
    assert added.count > 20 and covered.labels is not None
    assert float(added.means[:, :2].norm(dim=1).max()) < 0.5
    assert torch.allclose(added.colors(), torch.tensor(RED).expand_as(added.means), atol=0.02)
    assert float(added.means[:, 2].abs().max()) < 0.01
    assert bool((covered.labels == BACKGROUND).all())
    # what the training left where the object stood goes, and the table is closed again
    residue = Gaussians.from_colors(
        torch.tensor([[0.0, 0.0, 0.1], [0.1, 0.0, 0.05]]), torch.full((2,), 0.05),
        torch.tensor([[0.0, 1.0, 0.0]] * 2), label=BACKGROUND,
    )  # fmt: skip
    again = covered_floor(Gaussians.cat([residue, holed]), stood, 0.0)
    assert not bool((again.colors()[:, 1] > 0.5).any())
    assert bool(((again.means[:, :2].norm(dim=1) < 0.1) & (again.means[:, 2].abs() < 0.01)).any())
    # nothing happens where there is no table
    assert covered_floor(sheet(-3.0, RED), stood, 0.0).count == sheet(-3.0, RED).count
    assert object_radius(stood) == pytest.approx(0.3 * 3**0.5, rel=0.1)


def test_the_floor_can_be_the_plane_that_the_object_stood_on(tmp_path: Path) -> None:
    demo.make_capture("watermelon", tmp_path, views=6, size=40, support="table", masks=False)
    capture = load_capture(tmp_path)
    lower, upper = demo.make_object("watermelon", 0).bounds()
    draw = torch.rand(2000, 3, dtype=torch.float64)
    # the lowest fifth of the object is missing, as where isolation cuts it off its table
    points = (lower + draw * (upper - lower)).float()
    up = torch.from_numpy(orient(None, capture).up).float()
    points = points[points @ up > (points @ up).quantile(0.2)]
    splats = Gaussians.from_colors(points, torch.full((len(points),), 0.01), points * 0 + 0.5)
    values = {"capture": str(tmp_path), "size": 0.2, "events": [{"type": "drop", "height": 0.1}]}
    plane = make_frame(splats, capture, Shot.from_dict(values | {"floor": "plane"}))
    auto = make_frame(splats, capture, Shot.from_dict(values))
    low_plane = float(plane.apply(points.double())[:, 2].min())
    low_auto = float(auto.apply(points.double())[:, 2].quantile(0.005))
    assert abs(low_auto) < 0.004  # auto puts what is left of it on the floor
    assert 0.01 < low_plane < 0.08  # the plane stays where it was, below the missing part
    table_points = capture.points[capture.points @ up.double() < orient(None, capture).floor + 0.01]
    assert float(plane.apply(table_points)[:, 2].abs().median()) < 0.005


def test_a_floor_without_a_plane_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"")
    with pytest.raises(InputError, match="found in a capture"):
        Shot.from_dict({"splats": str(tmp_path / "a.ply"), "floor": "plane"})
    capture = Capture([CAMERA], torch.zeros(0, 3).double(), torch.zeros(0, 3), tmp_path, load_view)
    splats = Gaussians.from_colors(torch.rand(500, 3), torch.full((500,), 0.01), torch.rand(500, 3))
    shot = Shot.from_dict({"capture": str(tmp_path), "floor": "plane"})
    with pytest.raises(InputError, match="no plane"):
        make_frame(splats, capture, shot)
