"""Splits come over some frames: the first picture shows nothing of them, the last all."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from test_chunks import apart, binding, drawn, halves, moment, picture

from gsfluent.pipeline.cracks.ease import FRAMES
from gsfluent.pipeline.cracks.stage import Repair, Repaired
from gsfluent.pipeline.matter.carry import Carry, Points


@pytest.fixture(scope="module")
def bound() -> Carry:
    return binding()


@pytest.fixture(scope="module")
def glass() -> Carry:
    return binding(material="glass")


def change(one: Repaired, two: Repaired) -> float:
    """Mean change of the picture over the matter, of 255."""
    a, b = picture(one.gaussians), picture(two.gaussians)
    return 255.0 * float((a.image - b.image).abs().mean(-1)[a.alpha > 0.5].mean())


def scene(bound: Carry, name: str) -> tuple[Points, Points]:
    """A moment of one piece, and the same of two."""
    spacing, rest = bound.matter.spacing[0], bound.matter.rest
    whole = torch.zeros(len(rest), dtype=torch.int64, device=rest.device)
    if name == "crack":  # open as a hinge before it is through
        move, bent = 3.0 * apart(bound, float(spacing)) * (rest[:, 2:] > -0.03), 0.0
    else:  # bent beyond what is drawn rigid, in halves that are not
        move, bent = None, 14.0 * float(spacing / rest[:, 0].abs().max() ** 2)
    return moment(bound, whole, move, bent), moment(bound, halves(bound), move, bent)


def told(bound: Carry, before: Points, after: Points) -> tuple[Any, list[Repaired]]:
    history = Repair().begin(bound)
    return history, [drawn(bound, history, p) for p in (before, *[after] * (FRAMES + 1))]


@pytest.mark.parametrize("name", ["crack", "glass"])
def test_a_split_comes_by_degrees(bound: Carry, glass: Carry, name: str) -> None:
    """A crack that is open changes its faces; halves of what is stiff cease to bend. At once that
    is a jump, in the frame in which two pieces are seen where there was one."""
    carry = glass if name == "glass" else bound
    before, after = scene(carry, name)
    history, films = told(carry, before, after)
    at_once = drawn(carry, Repair().begin(carry), after)
    steps = [change(a, b) for a, b in itertools.pairwise(films)]
    whole = change(films[0], at_once)
    assert whole > 3.0
    assert steps[0] < 0.05 * whole
    assert max(steps) < 0.5 * whole
    # and in the end it is what it would have been
    last = films[-1]
    assert "easing" not in history.state()
    if name == "crack":  # what has parted stays so for longer than what was never seen before
        assert torch.equal(last.ids, at_once.ids)
        for part in ("means", "scales", "opacities", "sh"):
            assert torch.equal(getattr(last.gaussians, part), getattr(at_once.gaussians, part))
    assert all(len(film.ids.unique()) == len(film.ids) for film in films)


def test_what_moves_on_takes_its_way_along(glass: Carry) -> None:
    """Pieces fly while they come to be: the picture of the first frame flies with them."""
    before, after = scene(glass, "glass")
    far = torch.tensor([0.4, 0.0, 0.2])
    gone = after._replace(position=after.position + far)
    history, films = told(glass, before, gone)
    assert history.state().get("easing") is None
    first = films[1].gaussians.means[: glass.gaussians.count] - far
    start = films[0].gaussians.means[: glass.gaussians.count]
    assert float((first - start).norm(dim=1).max()) < 0.05 * glass.matter.spacing[0]


def test_what_flies_apart_is_drawn_as_it_is(bound: Carry) -> None:
    """A film with few frames a second would show ragged faces for as long as they are seen."""
    before, after = scene(bound, "crack")
    spacing = bound.matter.spacing[0]
    for far, at_once in ((0.5, False), (5.0, True)):
        flown = after._replace(position=after.position + apart(bound, far * spacing))
        history = Repair().begin(bound)
        drawn(bound, history, before)
        film = [drawn(bound, history, flown)]
        assert ("easing" in history.state()) != at_once
        while "easing" in history.state():
            film.append(drawn(bound, history, flown))
        assert len(film) == (1 if at_once else 2)
        alone = drawn(bound, Repair().begin(bound), flown)
        assert torch.equal(film[-1].ids, alone.ids)


def test_a_run_is_taken_up_on_the_way(bound: Carry) -> None:
    before, after = scene(bound, "crack")
    history = Repair().begin(bound)
    for points in (before, after, after):
        drawn(bound, history, points)
    other = Repair().begin(bound)
    other.restore(history.state())
    for _ in range(FRAMES):
        want, got = (drawn(bound, one, after) for one in (history, other))
        assert torch.equal(got.ids, want.ids)
        for part in ("means", "scales", "opacities"):
            assert torch.equal(getattr(got.gaussians, part), getattr(want.gaussians, part)), part


def test_splits_in_every_frame_hold_nothing_up(bound: Carry) -> None:
    """What goes goes on going, and what moves comes nearer, while other regions split."""
    before, after = scene(bound, "crack")
    history = Repair().begin(bound)
    start = drawn(bound, history, before)
    rest, unit = bound.matter.rest, halves(bound).clone()
    height = rest[:, 1].sort()[0]
    for n in range(FRAMES + 1):
        # slices off the far side, one a frame
        row = len(rest) * (n + 1) // (2 * FRAMES)
        slab = (rest[:, 1] < height[row]) & (unit == halves(bound)) & (rest[:, 0] > 0.0)
        unit = torch.where(slab, int(slab.nonzero()[-1, 0]), unit)
        now = drawn(bound, history, after._replace(unit=unit, fragments=unit.to(torch.int32)))
        gone = ~torch.isin(start.ids, now.ids) & (start.gaussians.opacities > 0.0)
        if n == 0:
            assert int(gone.sum()) < 3 < 0.01 * start.added
    assert len(history.state()["splits"]) > FRAMES // 2
    assert int(gone.sum()) > 0.3 * start.added


@pytest.mark.cuda
def test_the_same_way_on_a_gpu() -> None:
    found = []
    for device in ("cpu", "cuda"):
        carry = binding(device)
        history = Repair().begin(carry)
        for points in (*scene(carry, "crack"), scene(carry, "crack")[1]):
            made = drawn(carry, history, points)
        order = made.ids.argsort()
        found.append((made.ids[order].cpu(), made.gaussians.select(order).to("cpu")))
    (ids, a), (others, b) = found
    assert torch.equal(ids, others)
    assert float((a.means - b.means).norm(dim=1).max()) < 1e-5
    assert float((a.opacities - b.opacities).abs().max()) < 1e-4
