"""Cavities carved out of a visual hull by the colours over their lids."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from gsfluent.demo.capture import make_object, photograph, ring_cameras
from gsfluent.demo.objects import DemoObject
from gsfluent.pipeline.capture.carve import carve_cavities
from gsfluent.pipeline.capture.hull import Hull, visual_hull
from gsfluent.pipeline.capture.views import TrainView, cropped

SIZE, VIEWS, VOXELS = 96, 20, 40
_SEEN = math.tan(math.radians(20.0))  # half of the demo's field of view


def views_of(obj: DemoObject, change: Callable[[Tensor, int], Tensor] | None = None):
    """Masked views of a demo object, their colours changed by a function of colour and number."""
    K = torch.tensor([[0.5 * SIZE / _SEEN, 0, 0.5 * SIZE], [0, 0.5 * SIZE / _SEEN, 0.5 * SIZE]])
    K = torch.cat([K, torch.tensor([[0.0, 0.0, 1.0]])])
    views = []
    for number, pose in enumerate(ring_cameras(obj, VIEWS, on_table=False)):
        color, mask = photograph(obj, pose, SIZE, supersample=1)
        color = color if change is None else change(color, number)
        view = TrainView(color * mask[..., None], mask, None, pose.float(), K, SIZE)
        views.append(cropped(view))
    return views


def inside(obj: DemoObject, hull: Hull) -> Tensor:
    points = hull.centers(torch.ones_like(hull.occupancy).nonzero())
    return (obj.level(points.double()) <= 0).view(hull.occupancy.shape)


def iou(one: Tensor, other: Tensor) -> float:
    return float((one & other).sum()) / float((one | other).sum())


@pytest.fixture(scope="module")
def bowl() -> tuple[list[TrainView], Hull]:
    views = views_of(make_object("bowl"))
    return views, visual_hull(views, VOXELS)


def test_a_bowl_is_carved_and_its_wall_stays(bowl: tuple[list[TrainView], Hull]) -> None:
    views, hull = bowl
    found, notes = carve_cavities(hull, views)
    true = inside(make_object("bowl"), hull)
    lost = float((true & ~found.occupancy).sum()) / float(true.sum())

    assert notes["cavities"] >= 1
    assert iou(found.occupancy, true) > iou(hull.occupancy, true) + 0.15
    assert lost < 0.06
    assert not bool((found.occupancy & ~hull.occupancy).any())


def test_what_has_no_cavity_is_not_eaten() -> None:
    views = views_of(make_object("watermelon"))
    hull = visual_hull(views, VOXELS)
    found, notes = carve_cavities(hull, views)
    assert found is hull
    assert notes["why"] == "no cavity shows in the colours"


def test_without_colour_and_light_nothing_is_said(
    bowl: tuple[list[TrainView], Hull],
) -> None:
    views = views_of(make_object("bowl"), lambda color, number: torch.full_like(color, 0.8))
    found, notes = carve_cavities(bowl[1], views)
    assert found is bowl[1]
    assert notes["why"] == "no cavity shows in the colours"
    assert notes["carved"] == 0.0


def test_a_lamp_that_moves_betrays_no_cavity(bowl: tuple[list[TrainView], Hull]) -> None:
    views = views_of(make_object("bowl"), lambda color, number: color * (0.4 + 0.6 * (number % 2)))
    found, notes = carve_cavities(bowl[1], views)
    assert found is bowl[1]
    assert "disagree on colours everywhere" in notes["why"]


def test_too_few_photographs_say_nothing(bowl: tuple[list[TrainView], Hull]) -> None:
    views, hull = bowl
    found, notes = carve_cavities(hull, views[:3])
    assert found is hull
    assert "too few photographs" in notes["why"]
