"""Depth, flow and labels against pieces of which all three are known."""

from __future__ import annotations

import itertools

import numpy as np
import torch

from gsfluent.data import Camera, Gaussians
from gsfluent.dataset.channels import LOOSE, NOTHING, RIGID, Channels, Pieces, channels_of
from gsfluent.export.frames import Moment
from gsfluent.results.frames import SavedFrame

STEP = 0.1  # s between frames
CAMERA = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=64, height=48, fov=40.0)
FOCAL = float(CAMERA.K[0, 0])


def plate(left: float, right: float, y: float, count: int = 14) -> torch.Tensor:
    """Centres on a plate before the camera, at a distance of 2 + y."""
    x, z = torch.linspace(left, right, count), torch.linspace(-0.3, 0.3, 20)
    return torch.stack([*torch.meshgrid(x, z, indexing="ij"), torch.full((count, 20), y)], -1)[
        ..., [0, 2, 1]
    ].reshape(-1, 3)


def moment(
    plates: list[torch.Tensor],
    fragments: list[int],
    *,
    time: float = 0.0,
    ids: torch.Tensor | None = None,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Moment:
    """Plates whose splats follow a point each, but for those of fragment -2, which are rigid."""
    means = torch.cat(plates)
    count = len(means)
    of_splat = torch.cat([torch.full((len(p),), f) for p, f in zip(plates, fragments, strict=True)])
    rigid = of_splat == -2
    splats = Gaussians.from_colors(means, torch.full((count,), 0.02), torch.ones(count, 3))
    whole = torch.zeros(count, dtype=torch.int32)
    saved = SavedFrame(
        index=0, time=time, gaussians=splats, groups=whole - 1, carried=count,
        ids=torch.arange(count) if ids is None else ids,
        anchor=torch.where(rigid, -1, torch.arange(count)).int(),
        positions=means, volumes=torch.ones(count), damage=torch.zeros(count),
        fragments=of_splat.int(), velocity=torch.tensor(velocity).expand(count, 3),
        body=torch.where(of_splat == 7, 1, 0).int(), material=whole, facts={},
    )  # fmt: skip
    return Moment(saved, torch.where(rigid, -1, of_splat).int(), whole)


def at(values: np.ndarray, x: float, y: float) -> np.ndarray:
    """The value of the pixel that shows a place of height 0."""
    return values[24, int(32 + FOCAL * x / (2 + y))]


def test_each_plate_has_its_depth_its_way_and_its_label() -> None:
    before = [plate(-0.5, -0.1, 0.0), plate(0.1, 0.5, 0.5)]
    after = [before[0] + torch.tensor([0.0, 0.0, 0.1]), before[1]]
    # the second plate's splats are others in the next frame: its points say where it goes
    others = torch.cat([torch.arange(280), torch.arange(1000, 1280)])
    now = moment(before, [4, 7], velocity=(1.0, 0.0, 0.0))
    then = moment(after, [4, 7], time=STEP, ids=others)
    pieces = Pieces()
    found = channels_of(now, CAMERA, (then.saved, CAMERA), pieces)
    assert [a.shape for a in (found.depth, found.flow, found.labels)] == [
        (48, 64),
        (48, 64, 2),
        (48, 64),
    ]
    left, right = (-0.3, 0.0), (0.3, 0.5)
    np.testing.assert_allclose(at(found.depth, *left), 2.0, atol=0.01)
    np.testing.assert_allclose(at(found.depth, *right), 2.5, atol=0.01)
    # up in the world is up in the picture, whose y goes down
    np.testing.assert_allclose(at(found.flow, *left), [0.0, -FOCAL * 0.1 / 2.0], atol=0.02)
    np.testing.assert_allclose(at(found.flow, *right), [FOCAL * STEP / 2.5, 0.0], atol=0.02)
    assert (at(found.labels, *left), at(found.labels, *right)) == (3, 4)
    assert pieces.label == {4: 3, 7: 4} and pieces.body == {3: 0, 4: 1}
    nothing = at(found.labels, 0.0, 0.0)
    assert (
        nothing == NOTHING and at(found.depth, 0.0, 0.0) == 0 and not at(found.flow, 0.0, 0.0).any()
    )
    last = channels_of(now, CAMERA, None, pieces)
    assert not last.flow.any() and (last.labels == found.labels).all()


def test_a_camera_that_moves_makes_everything_flow() -> None:
    now = moment([plate(-0.5, 0.5, 0.0, 34)], [0])
    moved = Camera.look_at((0.1, -2.0, 0.0), (0.1, 0.0, 0.0), width=64, height=48, fov=40.0)
    found = channels_of(now, CAMERA, (now.saved, moved), Pieces())
    np.testing.assert_allclose(at(found.flow, 0.0, 0.0), [-FOCAL * 0.1 / 2.0, 0.0], atol=0.02)


def test_a_piece_keeps_its_label_and_what_is_none_has_its_own() -> None:
    edges = torch.linspace(-0.6, 0.6, 4).tolist()
    plates = [plate(a + 0.03, b - 0.03, 0.0) for a, b in itertools.pairwise(edges)]
    pieces = Pieces()
    first = channels_of(moment(plates, [5, -1, -2]), CAMERA, None, pieces)
    later = channels_of(moment(plates, [9, 5, -2]), CAMERA, None, pieces)

    def row(found: Channels) -> list[int]:
        return [int(at(found.labels, x, 0.0)) for x in (-0.4, 0.0, 0.4)]

    assert row(first) == [3, LOOSE, RIGID] and row(later) == [4, 3, RIGID]


def test_more_pieces_than_a_call_of_the_rasterizer_has_channels() -> None:
    wide = Camera.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=512, height=32, fov=4.0)
    edges = torch.linspace(-0.6, 0.6, 41).tolist()
    plates = [plate(a, b, 0.0, 3)[::7] for a, b in itertools.pairwise(edges)]
    found = channels_of(moment(plates, list(range(100, 140))), wide, None, Pieces())
    seen = [label for label in dict.fromkeys(found.labels[16].tolist()) if label != NOTHING]
    assert seen == sorted(seen) and set(seen) <= set(range(3, 43)) and len(seen) > 33
