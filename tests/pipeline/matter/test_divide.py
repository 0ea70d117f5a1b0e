"""Wide splats made of narrow ones look the same."""

import pytest
import torch

from gsfluent.data import INTERIOR, Camera, Gaussians
from gsfluent.draw import draw_at
from gsfluent.pipeline.matter import divide
from gsfluent.pipeline.matter.divide import divide_wide


def picture(splats: Gaussians) -> torch.Tensor:
    camera = Camera.look_at(
        torch.tensor([0.0, 0.4, 3.0]), torch.zeros(3), width=96, height=96, fov=40.0
    )
    seen = draw_at(splats, camera.viewmat.float(), camera.K.float(), (96, 96), depth=False)
    return torch.cat([seen.image, seen.alpha[..., None]], dim=2)


def flat(opacity: float, wide: tuple[float, float]) -> Gaussians:
    turn = torch.nn.functional.normalize(torch.tensor([[1.0, 0.2, -0.1, 0.3]]), dim=1)
    return Gaussians.from_colors(
        torch.tensor([[0.05, -0.02, 0.0]]),
        torch.tensor([[*wide, 0.01]]),
        torch.tensor([[0.8, 0.4, 0.1]]),
        opacities=opacity,
        quats=turn,
        label=0,
    )


@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.97])
@pytest.mark.parametrize(
    ("wide", "most"), [((0.3, 0.12), 0.05), ((0.2, 0.02), 0.1), ((0.11, 0.25), 0.05)]
)
def test_the_parts_look_like_the_whole(
    opacity: float, wide: tuple[float, float], most: float
) -> None:
    """Less than one level on average, 5 % somewhere (a needle less than a pixel wide 10 %)."""
    whole = flat(opacity, wide)
    parts = divide_wide(whole, 0.1)
    assert parts.count > 1
    assert float(parts.scales.max()) <= 0.1
    away = (picture(parts) - picture(whole)).abs()
    assert float(away.max()) < most
    assert float(away.mean()) < 1 / 255


def test_what_is_narrow_is_left_alone() -> None:
    """Nothing wide: the same object; else the others keep rows and values."""
    narrow = flat(0.9, (0.08, 0.05))
    assert divide_wide(narrow, 0.1) is narrow
    both = divide_wide(Gaussians.cat([flat(0.9, (0.3, 0.05)), narrow]), 0.1)
    assert torch.equal(both.means[0], narrow.means[0])
    assert both.labels is not None
    assert int(both.labels.sum()) == 0


def test_the_inside_is_left_alone_and_the_parts_have_a_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Faces hide what is inside; a skin of giants on tiny points does not fill the memory."""
    inside = flat(0.9, (0.3, 0.3)).labelled(INTERIOR)
    assert divide_wide(inside, 0.01) is inside
    monkeypatch.setattr(divide, "MOST", 500)
    both = Gaussians.cat([flat(0.9, (0.3, 0.3)), flat(0.9, (0.1, 0.1))])
    parts = divide_wide(both, 0.001)
    assert 1 < parts.count <= 501
