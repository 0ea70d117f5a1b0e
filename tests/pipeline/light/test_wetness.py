"""Skin that a liquid has touched stays wet: what that is, how it looks, when it is asked for."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch

from gsfluent.data import Camera, Gaussians
from gsfluent.pipeline.light.from_shot import clear_of, gloss_of
from gsfluent.pipeline.light.lamps import studio_light
from gsfluent.pipeline.light.wetness import (
    DRIES,
    INTERNAL,
    TOUCH,
    Wetness,
    wet_colors,
    wet_gloss,
)
from gsfluent.pipeline.render.film import Film
from gsfluent.pipeline.render.stage import Picture, Render
from gsfluent.results.frames import SavedFrame

H = 0.004
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
POOL = ("pool", "water")


def grid(side: int, z: float) -> torch.Tensor:
    line = H * torch.arange(side)
    x, y = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3)


def frame(
    index: int, above: float, time: float = 0.0, pool: tuple[str, str] = POOL, held: bool = False
) -> SavedFrame:
    """A plate of twenty by twenty, and a liquid over a corner of it, ``above`` spacings off."""
    plate, liquid = grid(20, 0.0), grid(8, above * H)
    points = torch.cat([plate, liquid])
    count, solid = len(points), len(plate)
    body = (torch.arange(count) >= solid).int()
    colors = torch.full((count, 3), 0.5)
    return SavedFrame(
        index=index,
        time=time,
        gaussians=Gaussians.from_colors(points, torch.full((count,), H), colors, opacities=0.9),
        groups=torch.full((count,), -1, dtype=torch.int32),
        carried=count,
        ids=torch.where(body > 0, -1 - torch.arange(count), torch.arange(count)),
        anchor=torch.arange(count, dtype=torch.int32),
        positions=points,
        volumes=torch.full((count,), H**3),
        damage=torch.zeros(count),
        fragments=torch.zeros(count, dtype=torch.int32),
        velocity=torch.zeros(count, 3),
        body=body,
        material=torch.zeros(count, dtype=torch.int32),
        facts={
            "bodies": [["plate", "wood"], list(pool)],
            "liquid_inside": [1] if held else [],
        },
    )


def wet_of(*frames: SavedFrame) -> Wetness:
    return Wetness(lambda index: frames[index], clear_of)


def plate_of(wet: torch.Tensor | None) -> torch.Tensor:
    assert wet is not None
    return wet[:400].view(20, 20)


@pytest.mark.parametrize("device", DEVICES)
def test_what_was_touched_stays_wet_and_dries(device: str) -> None:
    """Wet where the water lay, dry where it never was, and 1 / e of it after :data:`DRIES`."""
    touched, gone, later = (
        frame(0, 1.5).to(torch.device(device)),
        frame(1, 50.0, 0.1).to(torch.device(device)),
        frame(2, 50.0, DRIES).to(torch.device(device)),
    )
    found = wet_of(touched, gone, later)
    assert float(plate_of(found.at(touched))[:8, :8].min()) == 1.0
    after = plate_of(found.at(gone))
    assert float(after[:8, :8].min()) > 0.99
    assert float(after[11:].max()) == 0.0
    assert float(plate_of(found.at(later))[:8, :8].mean()) == pytest.approx(
        math.exp(-1.0), abs=0.002
    )
    # water itself is not wet
    last = found.at(gone)
    assert last is not None
    assert float(last[400:].max()) == 0.0


@pytest.mark.parametrize("above", [TOUCH[0] - 0.1, 0.5 * sum(TOUCH), TOUCH[1] + 0.1])
def test_contact_ends_gently(above: float) -> None:
    once = frame(0, above)
    wanted = min(max((TOUCH[1] - above) / (TOUCH[1] - TOUCH[0]), 0.0), 1.0)
    assert float(plate_of(wet_of(once).at(once))[3, 3]) == pytest.approx(wanted, abs=0.01)


def test_the_order_of_asking_changes_nothing() -> None:
    frames = [frame(k, above, 0.1 * k) for k, above in enumerate((50.0, 2.2, 1.9, 50.0, 2.0))]
    forth, back = wet_of(*frames), wet_of(*frames)
    first = [forth.at(one) for one in frames]
    second = [back.at(one) for one in reversed(frames)][::-1]
    for one, other in zip(first, second, strict=True):
        assert one is not None and other is not None
        assert torch.equal(one, other)


def test_wetness_goes_with_the_number_of_a_splat() -> None:
    """Where splats are gone and others are born, theirs is their own: a new face is dry."""
    before, after = frame(0, 1.5), frame(1, 50.0)
    order = torch.arange(after.gaussians.count).flip(0)
    ids = after.ids.clone()
    ids[0] = 5000  # was 0: it is another splat now
    turned = dataclasses.replace(
        after,
        gaussians=after.gaussians.select(order),
        ids=ids[order],
        anchor=after.anchor[order],
    )
    found = wet_of(before, turned).at(turned)
    straight = wet_of(before, after).at(after)
    assert found is not None and straight is not None
    assert float(straight[0]) > 0.99 and float(found[-1]) == 0.0
    assert torch.equal(found.flip(0)[1:], straight[1:])


def test_a_scene_without_a_liquid_asks_for_nothing() -> None:
    def load(index: int) -> SavedFrame:
        raise AssertionError("a frame was loaded")

    dry = frame(7, 1.5, pool=("ball", "wood"))
    found = Wetness(load, clear_of)
    assert found.at(dry) is None
    assert not found._states


def test_what_a_solid_holds_does_not_wet_it() -> None:
    held = frame(0, 1.5, pool=("egg", "wood"), held=True)
    wet = wet_of(held).at(held)
    assert wet is not None
    assert float(wet.max()) == 0.0


def test_what_is_wet_is_darker_by_lekner_and_dorf() -> None:
    color = torch.tensor([[0.9, 0.5, 0.1]] * 3)
    splats = Gaussians.from_colors(torch.zeros(3, 3), torch.ones(3), color, opacities=0.9)
    wet = torch.tensor([0.0, 0.5, 1.0])
    found = wet_colors(splats, wet).colors().pow(2.2)
    albedo = color[0].pow(2.2)
    soaked = albedo * (1.0 - INTERNAL) / (1.0 - INTERNAL * albedo)
    torch.testing.assert_close(found[2], soaked, atol=1e-4, rtol=0.0)
    torch.testing.assert_close(found[1], 0.5 * (albedo + soaked), atol=1e-4, rtol=0.0)
    assert wet_colors(splats, torch.zeros(3)) is splats
    gloss = torch.tensor([[0.1, 20.0], [0.9, 200.0]])
    assert torch.equal(wet_gloss(gloss, torch.tensor([0.0, 1.0])), gloss)
    assert bool((wet_gloss(gloss, torch.ones(2))[0] > gloss[0]).all())


def ball() -> Gaussians:
    row = torch.arange(4000) + 0.5
    height, angle = 1.0 - row / 2000, row * (math.pi * (3.0 - math.sqrt(5.0)))
    ring = (1.0 - height**2).sqrt()
    way = torch.stack([ring * angle.cos(), ring * angle.sin(), height], 1)
    brown = torch.tensor([0.5, 0.35, 0.2]).expand_as(way).contiguous()
    return Gaussians.from_colors(0.05 * way, torch.full((4000,), 0.0015), brown, opacities=0.95)


def test_wet_skin_glistens_and_dry_skin_is_as_it_was() -> None:
    """Darker where nothing is mirrored, brighter where the ceiling and the lamp are."""
    view = Camera.look_at((0.0, -0.4, 0.2), (0.0, 0.0, 0.0), width=96, height=96, fov=20.0)
    stage, splats = Render(view, studio_light()), ball()
    gloss = torch.tensor([0.1, 20.0]).expand(splats.count, 2).contiguous()
    dry = stage(splats, gloss=gloss).image
    still = stage(splats, gloss=gloss, wet=torch.zeros(splats.count)).image
    assert torch.equal(dry, still)
    soaked = torch.ones(splats.count)
    wet = stage(wet_colors(splats, soaked), gloss=wet_gloss(gloss, soaked), wet=soaked).image
    change = (wet - dry).mean(dim=2)
    assert float(change.min()) < -0.05 and float(change.max()) > 0.1
    # half of it wet: the other half is as it was
    half = (splats.means[:, 0] > 0.0).float()
    part = stage(wet_colors(splats, half), gloss=wet_gloss(gloss, half), wet=half).image
    assert float((part - dry)[:, :40].abs().max()) < 1e-5
    assert float((part - wet)[:, 56:].abs().max()) < 1e-5


@pytest.mark.parametrize("wet", [True, False])
def test_a_film_shows_what_is_wet_and_asks_nothing_where_nothing_is(wet: bool) -> None:
    """Its pictures get the darker splats, the gloss and the film of water; dry ones none of it."""
    before, shown = (
        frame(k, above, 0.1 * k, pool=POOL if wet else ("ball", "wood"))
        for k, above in enumerate((1.5, 50.0))
    )
    film = Film.__new__(Film)
    film.shot = SimpleNamespace(objects={})  # type: ignore[assignment]
    film.backdrop = film._room = None
    film._wetness = Wetness(lambda index: before if wet else pytest.fail("loaded"), clear_of)
    asked: dict[str, torch.Tensor] = {}

    def stage(splats: Gaussians, camera: Camera, **given: torch.Tensor) -> Picture:
        asked.update(given, colors=splats.colors())
        return Picture(*(torch.zeros(0),) * 3, None, None, {})

    film.render = stage  # type: ignore[assignment]
    film.drawn(shown.gaussians, shown, None)  # type: ignore[arg-type]
    colors, gloss = shown.gaussians.colors(), gloss_of(film.shot, shown)
    assert gloss is not None
    if wet:
        corner = torch.arange(400).view(20, 20)[:8, :8].flatten()
        assert float(asked["wet"][corner].min()) > 0.99
        assert bool((asked["colors"][corner] < colors[corner] - 0.03).all())
        assert bool((asked["gloss"][corner, 1] > gloss[corner, 1]).all())
    else:
        assert asked["wet"] is None
        assert torch.equal(asked["colors"], colors) and torch.equal(asked["gloss"], gloss)
