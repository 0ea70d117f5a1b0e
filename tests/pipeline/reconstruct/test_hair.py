"""What sticks out of a hull is counted, and cut."""

import pytest
import torch

from gsfluent.data import Gaussians
from gsfluent.pipeline.capture.hull import Hull, lattice
from gsfluent.pipeline.reconstruct.density import clamp_aspect, contained, ends
from gsfluent.pipeline.reconstruct.evaluate import hair
from gsfluent.pipeline.reconstruct.model import SplatModel
from gsfluent.pipeline.reconstruct.recipe import QUICK

RADIUS, SIDE = 0.4, 64


@pytest.fixture(scope="module")
def ball() -> Hull:
    points = lattice((SIDE,) * 3) / SIDE - 0.5
    inside = (points.norm(dim=1) < RADIUS).reshape((SIDE,) * 3)
    return Hull(inside, torch.full((3,), -0.5), 1.0 / SIDE)


def splats(count: int = 400) -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    means = means * RADIUS * (0.5 + 0.7 * torch.rand(count, 1, generator=generator))
    scales = 0.002 * 60.0 ** torch.rand(count, 3, generator=generator)
    quats = torch.randn(count, 4, generator=generator)
    return Gaussians.from_colors(
        means, scales, torch.rand(count, 3, generator=generator), opacities=0.7, quats=quats
    )


def test_distance_beyond_a_ball(ball: Hull) -> None:
    generator = torch.Generator().manual_seed(0)
    points = 1.6 * (torch.rand(2000, 3, generator=generator) - 0.5)
    true = (points.norm(dim=1) - RADIUS).clamp_min(0.0)
    found = ball.beyond(points)
    near = points.abs().amax(1) < 0.5  # off the grid it is a bound from above
    assert float((found - true)[near].abs().max()) < 1.5 * ball.voxel
    assert bool((found > true - 1.5 * ball.voxel).all())
    assert bool((found[points.norm(dim=1) < RADIUS - 1.5 * ball.voxel] == 0).all())


def test_one_needle_is_counted(ball: Hull) -> None:
    means = torch.tensor([[0.38, 0.0, 0.0], [0.0, 0.0, 0.0]])
    needle = torch.tensor([[0.1, 0.005, 0.005], [0.1, 0.005, 0.005]])
    made = Gaussians.from_colors(means, needle, torch.rand(2, 3), opacities=0.9)
    assert hair(made, ball) == {"sticking_out": 1, "needles": 1, "slivers": 1}
    faint = made.replace(opacities=torch.full((2,), 0.01))  # nobody sees where it ends
    assert hair(faint, ball)["sticking_out"] == 0


def test_what_is_contained_sticks_out_nowhere(ball: Hull) -> None:
    before = splats()
    assert hair(before, ball)["slivers"] > 20
    after, gone = contained(before, ball)
    assert hair(after, ball) == {"sticking_out": 0, "needles": 0, "slivers": 0}
    assert 0 < gone < before.count
    # what ends within the hull is left as it is
    tips = ends(before.means, before.quats, before.scales, before.opacities)
    fits = (ball.beyond(tips.reshape(-1, 3)) == 0).reshape(-1, 6).all(1)
    kept = (after.means[:, None] == before.means[fits][None]).all(-1)
    assert bool(kept.any(0).all())
    assert torch.equal(after.scales[kept.any(1)], before.scales[fits])


def test_contained_is_idempotent(ball: Hull) -> None:
    once, _ = contained(splats(), ball)
    twice, gone = contained(once, ball)
    assert gone == 0
    assert torch.equal(once.scales, twice.scales)


def test_no_needle_is_left_and_discs_stay() -> None:
    given = splats()
    model = SplatModel(given, 1.0, isotropic=False, rates=QUICK.object_rates)
    clamp_aspect(model)
    axes, before = (value.detach().sort(dim=1).values for value in (model.scales(), given.scales))
    assert float((axes[:, 2] / axes[:, 1]).max()) < 2.001
    assert float((axes[:, 2] / axes[:, 0]).max()) > 8.0
    disc = before[:, 2] < 2.0 * before[:, 1]
    assert torch.allclose(axes[disc], before[disc])
    assert torch.allclose(axes[:, :2], before[:, :2])
