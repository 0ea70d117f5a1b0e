"""The demo objects that are no fruit: loaf, cake, melons, tableware. Rays, layers agree."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from gsfluent import demo
from gsfluent.cli import main
from gsfluent.demo.baked import CREAM, ICING, JAM, SPONGE, Cake
from gsfluent.demo.capture import ring_cameras
from gsfluent.demo.shapes import walk
from gsfluent.demo.tableware import SHELL, WHITE, YOLK, Bowl, Chocolate, Egg, Pane

NAMES = ("bread", "cake", "melons", "pane", "bowl", "egg", "chocolate")


def rays(obj: demo.DemoObject, side: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """Eye and directions of a coarse photograph."""
    view = ring_cameras(obj, 6, on_table=False)[1]
    rotation, eye = view[:3, :3], -(view[:3, :3].T @ view[:3, 3])
    axis = torch.linspace(-0.3, 0.3, side)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    ray = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)
    return eye, ray @ rotation.to(torch.float32)


@pytest.mark.parametrize("name", NAMES)
def test_rays_end_on_the_surface_and_normals_face_them(name: str) -> None:
    obj = demo.make_object(name, 0)
    eye, direction = rays(obj)
    index, hit = obj.intersect(eye, direction)
    assert 50 < len(index) < len(direction)
    assert float(obj.depth(hit.double()).abs().max()) < 2e-4
    normal = obj.normal(hit.double())
    assert torch.allclose(normal.norm(dim=1), torch.ones(len(hit)).double(), atol=1e-6)
    assert float(((normal * direction[index].double()).sum(1) < 1e-3).double().mean()) > 0.99
    # nothing lies between the eye and the hit: what is passed is outside
    start = eye.float()
    for share in (0.5, 0.9, 0.99):
        assert not bool(obj.inside((start + share * (hit - start)).double()).any())


@pytest.mark.parametrize("name", NAMES)
def test_objects_rest_on_the_floor_and_lie_in_their_bounds(name: str) -> None:
    obj = demo.make_object(name, 0)
    low, high = obj.bounds()
    generator = torch.Generator().manual_seed(0)
    points = low - 0.02 + (high - low + 0.04) * torch.rand(40000, 3, generator=generator).double()
    inside = obj.inside(points)
    assert bool(((points[inside] >= low) & (points[inside] <= high)).all())
    assert 0.0 <= float(points[inside][:, 2].min()) < 0.004


def test_the_distance_of_the_cake_is_that_of_a_round_tin() -> None:
    cake = Cake(0)
    points = cake.center + torch.tensor([[0.0, 0, 0], [0.2, 0, 0], [0, 0, 0.1], [0.085, 0, 0.0]])
    expected = [-0.040, 0.110, 0.060, -0.005]
    assert cake.level(points.double()).numpy() == pytest.approx(expected, abs=1e-7)


def test_walking_by_distance_finds_a_sphere() -> None:
    """Against the closed form, for rays that pass it on all sides."""

    class Ball(demo.DemoObject):
        axes = (0.1, 0.1, 0.1)
        bump_amplitude = 0.0

        def _place_seeds(self, rng):  # type: ignore[no-untyped-def]
            return torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.ones(3)

        def level(self, points: torch.Tensor) -> torch.Tensor:
            return (points - self.center.to(points.dtype)).norm(dim=1) - 0.1

    ball = Ball()
    eye = ball.center + torch.tensor([0.5, 0.0, 0.0]).double()
    slope = torch.linspace(-0.3, 0.3, 41, dtype=torch.float64)
    way = torch.stack([-torch.ones_like(slope), slope, torch.zeros_like(slope)], dim=1)
    index, hit = walk(ball, eye, way)
    sine = slope.abs() / (1 + slope**2).sqrt()
    assert index.tolist() == torch.nonzero(sine < 0.1 / 0.5)[:, 0].tolist()
    along = 0.5 * (1 - sine[index] ** 2).sqrt() - (0.01 - (0.5 * sine[index]) ** 2).sqrt()
    assert (hit - eye).norm(dim=1).numpy() == pytest.approx(along.numpy(), abs=2e-4)


def test_the_cake_has_its_layers_in_order() -> None:
    cake = Cake(0)
    heights = torch.tensor([0.001, 0.012, 0.0235, 0.0375, 0.051, 0.065, 0.079])
    column = torch.stack([torch.zeros(7), torch.zeros(7), heights], dim=1).double()
    assert cake.labels(column).tolist() == [ICING, SPONGE, JAM, SPONGE, CREAM, SPONGE, ICING]
    color = cake.interior(column)
    assert color[2, 0] > 2.5 * color[2, 1]  # jam is red
    assert float(color[4].min()) > 0.8  # cream is white
    assert color[3, 2] < 0.75 * color[3, 0]  # sponge is yellow


def test_the_crumb_of_the_bread_is_paler_than_its_crust() -> None:
    bread = demo.make_object("bread", 0)
    index, hit = bread.intersect(*rays(bread))
    assert len(index)
    inner = bread.center + 0.5 * (hit.double() - bread.center)
    crust, crumb = bread.surface_color(hit), bread.interior(inner)
    assert float(crumb.mean()) > float(crust.mean()) + 0.3
    assert float(crumb.std(dim=0).mean()) > 0.03  # it has cells


def test_two_melons_are_two_and_their_exemplar_is_one() -> None:
    both = demo.make_object("melons", 0)
    assert not bool(both.inside(both.center[None]).any())
    middle = both.center.clone()
    middle[0] = both.bounds()[0][0] + 0.13
    assert set(both.labels(middle[None]).tolist()) <= {3, 4}
    cut, mask = demo.cut_photograph(both.one(), 48, supersample=1)
    assert 0.5 < float(mask.mean()) < 0.9
    assert float(cut[mask > 0.5].mean(dim=0)[0]) > 0.5
    left, right = (demo.make_object("watermelon", seed) for seed in (0, 77))
    assert math.prod(both.axes) > math.prod(left.axes) + math.prod(right.axes)


def test_photographs_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsfluent.run import demo as run_demo

    small = run_demo.DemoSize(3, 32, 1, 1, 1, "preview", (32, 32), 1.0, 1.0)
    monkeypatch.setitem(run_demo.SIZES, "preview", small)
    words = ["demo", "cake", "--size", "preview", "--photographs", str(tmp_path / "cake")]
    assert main(words) == 0
    assert len(list((tmp_path / "cake" / "photographs" / "images").glob("*.png"))) == 3
    assert (tmp_path / "cake" / "cut.png").is_file()
    assert demo.load_truth(tmp_path / "cake" / "truth.npz").name == "cake"
    assert main(["demo", "pie", "--photographs", str(tmp_path / "pie")]) == 2


def test_both_of_two_melons_are_rebuilt(tmp_path: Path) -> None:
    """The hull that the splats start from once kept its largest body only."""
    from gsfluent.io import load_capture
    from gsfluent.pipeline import Reconstruct

    paths = demo.make_capture("melons", tmp_path, views=14, size=48)
    splats = Reconstruct(iterations=5, max_gaussians=2000)(load_capture(paths.root))
    x = splats.means[:, 0]
    assert 0.3 < float((x > 0).float().mean()) < 0.7
    low, high = (float(torch.quantile(x, q)) for q in (0.02, 0.98))
    assert low < -0.2 and high > 0.2


def test_the_pane_is_10_mm_thick_and_green_where_one_looks_along_it() -> None:
    pane = Pane(0)
    around = torch.tensor([[0.03, 0, 0.0049], [0.03, 0, 0.0051], [0.0799, 0, 0], [0.0801, 0, 0]])
    assert pane.inside(pane.center + around.double()).tolist() == [True, False, True, False]
    face, edge = pane.surface_color(pane.center + torch.tensor([[0.03, 0, 0.005], [0.08, 0, 0]]))
    assert float(face.min()) > 0.6 > 0.5 > float(edge[0])
    assert edge[1] > 1.5 * edge[0]


def test_the_bowl_is_open_its_wall_is_9_mm_and_its_rim_is_round() -> None:
    bowl = Bowl(0)
    center = torch.tensor([0.0, 0.0, 0.061], dtype=torch.float64)  # of its spheres
    generator = torch.Generator().manual_seed(0)
    way = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    way = way / way.norm(dim=1, keepdim=True)
    way = way[(way[:, 2] < -0.3) & (way[:, 2] > -0.75)]  # between rim and foot
    assert len(way) > 50
    for radius, level in ((0.061, 0.0), (0.052, 0.0), (0.0565, -0.0045), (0.04, 0.012)):
        found = bowl.level(center + radius * way)
        assert found.numpy() == pytest.approx([level] * len(way), abs=1e-9)
    # what stands highest is the rim, half a wall across, and a ray from above ends inside
    points = torch.tensor([[0.0, 0.0, 0.03], [0.0, 0.0, 0.0105]], dtype=torch.float64)
    assert bowl.inside(points).tolist() == [False, True]
    index, hit = bowl.intersect(torch.tensor([0.0, 0.0, 0.4]), torch.tensor([[0.0, 0.0, -1.0]]))
    assert index.tolist() == [0] and float(hit[0, 2]) == pytest.approx(0.012, abs=1e-4)


def test_the_egg_is_thicker_at_its_blunt_end_and_has_shell_white_and_yolk() -> None:
    egg = Egg(0)
    y = torch.linspace(0, 0.03, 3001, dtype=torch.float64)
    wide = []
    for x in (-0.014, 0.014):
        line = torch.stack([torch.full_like(y, x), y, torch.zeros_like(y)], dim=1) + egg.center
        wide.append(float(y[egg.inside(line)].max()))
    assert wide[0] > 1.1 * wide[1]
    assert max(wide) < 0.022
    column = torch.tensor([[0.0, 0, 0.001], [0.0, 0, 0.004], [0, 0, 0.022]], dtype=torch.float64)
    assert egg.labels(column).tolist() == [SHELL, WHITE, YOLK]
    color = egg.interior(column)
    assert color[2, 2] < 0.3 * color[2, 0]  # the yolk is yellow
    assert float(color[1].min()) > 0.6


def test_the_chocolate_has_six_times_three_blocks() -> None:
    bar = Chocolate(0)
    x = torch.linspace(-0.06, 0.06, 4801, dtype=torch.float64)
    for axis, count in ((0, 6), (1, 3)):
        line = torch.zeros(len(x), 3, dtype=torch.float64)
        line[:, axis] = x
        line[:, 1 - axis] = 0.0 if axis == 0 else 0.010  # off the grooves of the other axis
        line[:, 2] = 0.005
        inside = bar.inside(bar.center + line)
        starts = int((inside[1:] & ~inside[:-1]).sum())
        assert starts == count
    deep = torch.tensor([[0.0, 0.0, 0.0015], [0.0, 0.0, 0.0005]], dtype=torch.float64)
    assert bar.inside(bar.center + deep).tolist() == [False, True]  # 7 of 12 mm are left


@pytest.mark.parametrize("name", ["cake", "chocolate", "pane", "bread"])
def test_silhouettes_leave_no_cone_on_level_faces(name: str) -> None:
    """A third of the eyes graze top or base by turns, all around; of round things none does."""
    obj = demo.make_object(name, 0)
    eyes = torch.stack([-(v[:3, :3].T @ v[:3, 3]) for v in ring_cameras(obj, 40, on_table=False)])
    for height in (0.0, 2.0 * obj.axes[2]):
        near = eyes[(eyes[:, 2] - height).abs() < 1e-6]
        assert len(near) >= 6
        turns = torch.atan2(near[:, 1], near[:, 0]).sort().values
        assert float(turns.diff().max()) < 2.0 * math.pi / 5
    melon = demo.make_object("watermelon", 0)
    views = ring_cameras(melon, 40, on_table=False)
    heights = torch.stack([-(v[:3, :3].T @ v[:3, 3]) for v in views])[:, 2]
    assert len(heights.mul(1e6).round().unique()) == 3


@pytest.mark.parametrize("name", NAMES)
def test_rays_that_graze_a_face_are_no_bites_in_the_silhouette(name: str) -> None:
    """What a ray meets two thousandths deep is seen, from eyes level with the top and the base."""
    obj = demo.make_object(name, 0)
    views = ring_cameras(obj, 40, on_table=False)
    reach = 2.0 * max(obj.axes)
    level = [
        view
        for view in views
        if min(abs(float(-(view[:3, :3].T @ view[:3, 3])[2]) - h) for h in (0.0, 2 * obj.axes[2]))
        < 1e-6
    ]
    for view in level[:2] or views[20:21]:
        eye = -(view[:3, :3].T @ view[:3, 3])
        axis = torch.linspace(-0.3, 0.3, 40)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        ray = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3) @ view[:3, :3].float()
        seen = torch.zeros(len(ray), dtype=torch.bool)
        seen[obj.intersect(eye, ray)[0]] = True
        unit = (ray / ray.norm(dim=1, keepdim=True)).double()
        along = float((eye - obj.center).norm()) + torch.linspace(-reach, reach, 300).double()
        points = eye + along[None, :, None] * unit[:, None]
        deepest = obj.depth(points.reshape(-1, 3)).view(len(ray), -1).amax(dim=1)
        assert not bool((~seen & (deepest > 2e-3 * reach)).any())
