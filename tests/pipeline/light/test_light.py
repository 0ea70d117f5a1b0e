"""Lamps, environments, baked light, light divided out, and what a shot says about them."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import materials
from gsfluent.config import Shot
from gsfluent.data import SPRAY, SURFACE, Camera, Gaussians
from gsfluent.errors import InputError
from gsfluent.lab.truth import light as truth
from gsfluent.pipeline.fill.skin import facing
from gsfluent.pipeline.light import environment
from gsfluent.pipeline.light.albedo import Albedo, estimate_shading, to_albedo
from gsfluent.pipeline.light.bake import bake_light
from gsfluent.pipeline.light.from_shot import (
    JUICE,
    changed,
    clear_of,
    gloss_of,
    light_of,
    plates_of,
    transmission_of,
)
from gsfluent.pipeline.light.glass import as_seen, on_a_face, see_through
from gsfluent.pipeline.light.lamps import Lamp, Lighting, key_light, pack_lamps, studio_light
from gsfluent.pipeline.light.normals import grid_for
from gsfluent.pipeline.light.shade import irradiance, to_linear
from gsfluent.pipeline.light.shadow import FADE, NORMAL_OFFSET, ShadowMaps, transmittance
from gsfluent.pipeline.light.shadow_maps import Bulk, bulk, faces_of, shadow_maps
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio
from gsfluent.results.frames import DUST

BALL = truth.Ball((0.0, 0.0, 0.0), 0.1)


@pytest.fixture(scope="module")
def skin() -> Gaussians:
    return truth.surface_splats(BALL, 20_000, 0.5)


def directions(count: int = 200) -> Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).double()
    return normalize(points, dim=1)


def at(coefficients: environment.Coefficients, ways: Tensor) -> Tensor:
    return irradiance(torch.tensor(coefficients, dtype=torch.float64), ways)


def test_even_sky_and_ground_are_exact() -> None:
    found = at(environment.sky_and_ground((1.0, 0.8, 0.6), (0.2, 0.1, 0.0)), directions())
    rise = 0.5 + 0.5 * directions()[:, 2:]
    sky, ground = torch.tensor([1.0, 0.8, 0.6]).double(), torch.tensor([0.2, 0.1, 0.0]).double()
    torch.testing.assert_close(found, rise * sky + (1 - rise) * ground)


def test_picture_that_is_even_lights_evenly() -> None:
    found = at(environment.of_radiance(torch.full((32, 64, 3), 0.7)), directions())
    torch.testing.assert_close(found, torch.full_like(found, 0.7), atol=1e-3, rtol=0)


def test_picture_is_summed_as_an_independent_sum_says() -> None:
    rows = (torch.arange(64, dtype=torch.float64) + 0.5) / 64 * math.pi
    columns = (torch.arange(128, dtype=torch.float64) + 0.5) / 64 * math.pi - math.pi
    smooth = 0.6 + 0.3 * rows.cos()[:, None] + 0.25 * rows.sin()[:, None] * columns.sin()
    image = smooth[..., None] * torch.tensor([1.0, 0.9, 0.7]).double()
    found = at(environment.of_radiance(image), directions())
    expected = truth.environment_irradiance(image, directions())
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)


def test_turned_environment_is_seen_from_turned_normals() -> None:
    image = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(1))
    coefficients = environment.of_radiance(image)
    angle = math.radians(37.0)
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]).double()
    ways = directions()
    torch.testing.assert_close(
        at(environment.turned(coefficients, 37.0), ways @ turn.T),
        at(coefficients, ways),
        atol=1e-6,
        rtol=0,
    )


def test_environment_files_are_read_in_linear_light(tmp_path: Path) -> None:
    values = np.full((32, 64, 3), 128, np.uint8)
    cv2.imwrite(str(tmp_path / "grey.png"), values)
    found = at(environment.of_file(tmp_path / "grey.png"), directions(5))
    assert float(found.mean()) == pytest.approx((128 / 255) ** 2.2, rel=1e-3)
    cv2.imwrite(str(tmp_path / "bright.hdr"), np.full((32, 64, 3), 3.0, np.float32))
    assert float(at(environment.of_file(tmp_path / "bright.hdr"), directions(5)).mean()) == (
        pytest.approx(3.0, rel=0.01)
    )


@pytest.mark.parametrize("name", ["square.png", "text.png", "gone.png", "notes.txt"])
def test_bad_environment_files_are_named(tmp_path: Path, name: str) -> None:
    cv2.imwrite(str(tmp_path / "square.png"), np.zeros((32, 32, 3), np.uint8))
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "notes.txt").write_text("no picture")
    with pytest.raises(InputError, match=name):
        environment.of_file(tmp_path / name)


def test_cube_and_single_map_of_a_point_lamp_agree(skin: Gaussians) -> None:
    lamps, matter = (Lamp(position=(0.25, 0.1, 0.3), size=0.03),), bulk(skin)
    spots = torch.cartesian_prod(torch.linspace(-0.5, 0.1, 25), torch.linspace(-0.4, 0.2, 25))
    points = torch.cat([spots, torch.full_like(spots[:, :1], -0.15)], 1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
    found = []
    for faces, size in (((1,), 512), ((6,), 1024)):
        maps = shadow_maps(skin, lamps, faces, size, matter)
        assert maps is not None and maps.depth.shape[0] == faces[0]
        row = pack_lamps(lamps, faces, points)[0]
        found.append(transmittance(points, up, row, maps, biased=0.0))
    assert float(found[0].min()) < 0.05 and float(found[0].max()) == 1.0
    assert float((found[0] - found[1]).abs().mean()) < 0.01


def test_mist_shades_nothing_and_chips_do(skin: Gaussians) -> None:
    lamps = (Lamp(direction=(0.3, -0.4, 1.0)),)
    faces = faces_of(lamps, matter := bulk(skin))
    round_ = torch.full_like(skin.scales, 0.1 * float(skin.scales.mean()))
    mist = skin.replace(means=1.3 * skin.means, scales=round_).labelled(SPRAY)
    alone = shadow_maps(skin, lamps, faces, 128, matter)
    both = shadow_maps(Gaussians.cat([skin, mist]), lamps, faces, 128, matter)
    assert alone is not None and both is not None
    assert torch.equal(both.alpha, alone.alpha)
    flat = round_ * torch.tensor([1.0, 1.0, 0.1])
    sides = mist.replace(scales=flat)
    for shading in (mist.labelled(0), sides):
        maps = shadow_maps(Gaussians.cat([skin, shading]), lamps, faces, 128, matter)
        assert maps is not None and not torch.equal(maps.alpha, alone.alpha)


@pytest.mark.parametrize("radius", [0.8, 1.6, 3.2])
def test_a_chip_shades_about_its_own_outline_however_fine_it_is(radius: float) -> None:
    """``radius`` in texels: a map draws what is small larger, and light passes two sides."""
    texel = 2.3 / 128  # of a scene of radius 1
    number = torch.arange(24) + 0.5
    height, angle = 1.0 - number / 12, 2.39996 * number
    ring = (1.0 - height * height).sqrt()
    normal = torch.stack([ring * angle.cos(), ring * angle.sin(), height], 1)
    wide = 0.47 * radius * texel * math.sqrt(4.0 * math.pi / 24)
    chip = Gaussians.from_colors(
        radius * texel * normal, torch.tensor([wide, wide, 0.22 * wide]).repeat(24, 1),
        torch.ones(24, 3), opacities=0.97, label=SPRAY, quats=facing(normal),
    )  # fmt: skip
    lamps, matter = (Lamp(direction=(0.0, 0.0, 1.0)),), Bulk((0.0, 0.0, 0.0), 1.0, 1e-3)
    areas = []
    for shown in (chip, chip.labelled(SURFACE)):
        maps = shadow_maps(shown, lamps, faces_of(lamps, matter), 128, matter)
        assert maps is not None
        areas.append(float(maps.alpha.sum()) / (math.pi * radius**2))
    assert 0.8 < areas[0] < 2.2
    assert areas[0] < areas[1]


def test_what_flew_onto_the_border_of_a_map_shades_nothing_beyond(skin: Gaussians) -> None:
    lamps, matter = (Lamp(direction=(0.0, 0.0, 1.0)),), bulk(skin)
    wide = 8.0 * matter.radius
    sheet = skin.select(torch.arange(1)).replace(
        means=torch.tensor([[*matter.center[:2], matter.center[2] + 0.5 * matter.radius]]),
        scales=torch.tensor([[wide, wide, 1e-3]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.ones(1),
    )
    maps = shadow_maps(Gaussians.cat([skin, sheet]), lamps, (1,), 128, matter)
    assert maps is not None
    opaque = maps.alpha[0] > 0.9
    assert opaque[1:-1, 1:-1].all()
    opaque[1:-1, 1:-1] = False
    assert not opaque.any()


def test_haze_before_a_skin_is_no_matter(skin: Gaussians) -> None:
    # a skin that is divided, or one from photographs: many splats, each of which hides little
    haze = skin.replace(means=1.2 * skin.means, opacities=torch.full_like(skin.opacities, 0.1))
    grid, center = grid_for(skin, radius=0.2), (0.0, 0.0, 0.0)
    alone = grid.of(skin.labelled(SURFACE), center).values
    faint = grid.of(Gaussians.cat([skin, haze]).labelled(SURFACE), center).values
    solid = haze.replace(opacities=torch.full_like(haze.opacities, 0.9))
    dense = grid.of(Gaussians.cat([skin, solid]).labelled(SURFACE), center).values
    assert torch.equal(faint, alone) and not torch.equal(dense, alone)


def test_lamp_inside_the_matter_gets_a_cube(skin: Gaussians) -> None:
    near = (Lamp(position=(0.0, 0.0, 0.05)), Lamp(position=(0.0, 0.0, 2.0)), Lamp(shadow=False))
    assert faces_of(near, bulk(skin)) == (6, 1, 0)


def test_a_blocker_counts_in_full_from_some_biases_on() -> None:
    # a wall at depth 5 fills the map; points behind it face the lamp, k biases away from the wall
    bias, depth = 0.01, 5.0
    row = torch.tensor([1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 500.0, 4.9, bias])
    maps = ShadowMaps(torch.full((1, 64, 64), depth), torch.ones(1, 64, 64), row[None])
    lamp = torch.zeros(12)
    lamp[3], lamp[9], lamp[11] = -1.0, 0.05, 1.0
    k = torch.linspace(0.0, 12.0, 49)
    points = torch.stack([0 * k, 0 * k, depth + bias * k], 1)
    toward = torch.tensor([0.0, 0.0, -1.0]).expand_as(points)
    found = transmittance(points, toward, lamp, maps)
    # lifted off by one bias, and one bias is the surface itself
    expected = 1.0 - ((k - NORMAL_OFFSET - 1.0) / FADE).clamp(0.0, 1.0)
    torch.testing.assert_close(found, expected, atol=2e-4, rtol=0)
    # of what is not in the maps every blocker counts
    floor = transmittance(points, toward, lamp, maps, biased=0.0)
    torch.testing.assert_close(floor, (k == 0).float(), atol=1e-6, rtol=0)


def test_map_moves_in_whole_texels(skin: Gaussians) -> None:
    # what does not move looks the same from one frame to the next
    lamps = (Lamp(),)
    local, texel = [], 0.0
    for step in range(4):
        moved = skin.replace(means=skin.means + 0.00013 * step)
        matter = bulk(moved)
        maps = shadow_maps(moved, lamps, (1,), 256, matter)
        assert maps is not None
        row = maps.cameras[0]
        texel = float((row[13] + matter.radius) / row[12])
        local.append(row[:8].view(2, 4)[:, 3].double() / texel)
    steps = torch.stack(local) - local[0]
    assert float((steps - steps.round()).abs().max()) < 0.02


def test_lamp_of_many_parts_has_the_same_light() -> None:
    lamp = Lamp(position=(0.0, 0.0, 1.0), size=0.2, samples=9, intensity=0.9)
    parts = lamp.parts()
    assert len(parts) == 9
    assert sum(part.intensity for part in parts) == pytest.approx(0.9)
    places = torch.tensor([part.position for part in parts])
    assert float(places.mean(0)[:2].norm()) < 0.02
    assert float((places - torch.tensor([0.0, 0.0, 1.0])).norm(dim=1).amax()) < 0.1 + 1e-6


def test_spinning_lamp_turns_about_the_vertical() -> None:
    turned = Lighting(lamps=(Lamp(direction=(1.0, 0.0, 1.0), spin=90.0),)).at(1.0)
    assert turned.lamps[0].direction == pytest.approx((0.0, 1.0, 1.0))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Lamp(direction=(0.0, 0.0, 0.0)),
        lambda: Lamp(intensity=-1.0),
        lambda: Lamp(intensity=math.nan),
        lambda: Lamp(size=130.0),
        lambda: Lamp(samples=0),
        lambda: Lamp(position=(math.inf, 0.0, 0.0)),
        lambda: Lighting(occlusion=1.5),
        lambda: Lighting(ambient=math.inf),
        lambda: Lighting(environment=((1.0, 1.0, 1.0),)),
        lambda: key_light(specular=-0.1),
    ],
)
def test_bad_lights_are_refused(make: Any) -> None:
    with pytest.raises(InputError, match="light"):
        make()


def test_a_shot_that_says_nothing_has_key_fill_and_rim(tmp_path: Path) -> None:
    (tmp_path / "melon.ply").write_bytes(b"")
    bare = {k: v for k, v in SHOT.items() if k != "light"}
    usual = light_of(Shot.from_dict(bare, tmp_path))
    assert usual == studio_light()
    key, rim = usual.lamps
    # a surface that faces the key light keeps its colour; the rim comes from behind
    towards = torch.tensor([key.toward], dtype=torch.float64)
    from_key = float(irradiance(usual.around(towards), towards).mean()) + key.intensity
    assert 1.0 < from_key < 1.1  # of linear radiance: 4 % of the display value
    assert sum(a * b for a, b in zip(key.toward[:2], rim.toward[:2], strict=True)) < 0
    # the fill comes from the side that the key light leaves, towards the camera
    side = torch.tensor([[-1.0, -0.8, 0.0], [1.0, 0.8, 0.0]], dtype=torch.float64)
    left, behind = irradiance(usual.around(side), normalize(side, dim=1)).mean(1)
    assert float(left) > 1.5 * float(behind) > 0.3
    turned = light_of(
        Shot.from_dict({**bare, "light": {"key": {"direction": [0, 0, 1]}}}, tmp_path)
    )
    assert turned.lamps[1:] == (rim,) and turned.environment == usual.environment
    for own in ({"ambient": 0.3}, {"lights": []}):
        found = light_of(Shot.from_dict({**bare, "light": own}, tmp_path))
        assert len(found.lamps) == 1 and found.environment is None


def test_short_form_of_light_means_the_same(skin: Gaussians) -> None:
    camera = Camera.look_at((0.3, -0.6, 0.2), (0, 0, 0), width=48, height=48, fov=22.0)
    light = key_light(direction=(1.0, 0.0, 1.0), specular=0.2)
    long = Lighting((Lamp(direction=(1.0, 0.0, 1.0)),), specular=0.2, shininess=24.0)
    torch.testing.assert_close(Render(camera, light)(skin).image, Render(camera, long)(skin).image)


def test_specular_follows_the_splats(skin: Gaussians) -> None:
    camera = Camera.look_at((0.0, -0.8, 0.0), (0, 0, 0), width=64, height=64, fov=16.0)
    light = Lighting(lamps=(Lamp(direction=(0.0, -1.0, 0.0), shadow=False),), occlusion=0.0)
    left = skin.means[:, 0] < 0
    gloss = torch.stack([torch.where(left, 0.8, 0.0), torch.full_like(left, 4.0, dtype=skin.dtype)])
    image = Render(camera, light)(skin, gloss=gloss.T.contiguous()).image
    assert float(image[32, 24].mean()) > float(image[32, 40].mean()) + 0.1
    flat = Render(camera, Lighting(light.lamps, occlusion=0.0, specular=0.0))(
        skin, gloss=gloss.T.contiguous()
    ).image
    assert float(flat[32, 24].mean()) == pytest.approx(float(flat[32, 40].mean()), abs=0.01)


def test_baked_light_is_what_the_lamp_gives(skin: Gaussians) -> None:
    lamp = Lamp(direction=(0.0, 0.0, 1.0), intensity=0.8, color=(1.0, 0.5, 0.25), shadow=False)
    lit = bake_light(skin, Lighting(lamps=(lamp,), ambient=0.2, occlusion=0.0))
    up = normalize(skin.means, dim=1)[:, 2:].clamp(min=0.0)
    expected = 0.5**2.2 * (0.2 + 0.8 * up * torch.tensor([1.0, 0.5, 0.25]))
    error = (to_linear(lit.colors()) - expected).square().mean().sqrt()
    assert float(error / expected.square().mean().sqrt()) < 0.02
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(lit, name), getattr(skin, name))


def test_baked_shadow_falls_on_another_body(skin: Gaussians) -> None:
    above = skin.replace(means=0.4 * skin.means + torch.tensor([0.0, 0.0, 0.2]))
    above = above.replace(scales=0.4 * above.scales)
    lamp = Lamp(direction=(0.0, 0.0, 1.0), intensity=0.8)
    dull = Lighting(lamps=(lamp,), ambient=0.1, occlusion=0.0)
    lit = bake_light(Gaussians.cat([skin, above]), dull).colors()[: skin.count].mean(1)
    off = skin.means[:, :2].norm(dim=1)
    top = skin.means[:, 2] > 0.05
    assert float(lit[top & (off < 0.02)].mean()) < 0.5 * float(lit[top & (off > 0.06)].mean())


def painted(skin: Gaussians) -> Gaussians:
    """Green stripes that wind around the ball."""
    place = skin.means / 0.1
    turn = torch.atan2(place[:, 1], place[:, 0])
    dark = (torch.sin(9 * turn + 2 * torch.sin(4 * place[:, 2])) > 0.1).float()[:, None]
    paint = dark * torch.tensor([0.35, 0.55, 0.2]) + (1 - dark) * torch.tensor([0.12, 0.25, 0.1])
    return skin.with_colors(paint)


def off(found: Gaussians, wanted: Gaussians) -> float:
    """RMS difference of linear colours over RMS, after the best common factor."""
    a, b = to_linear(found.colors()), to_linear(wanted.colors())
    return float(
        ((a * (a * b).sum() / (a * a).sum() - b).square().mean() / b.square().mean()) ** 0.5
    )


@pytest.mark.parametrize("kind", ["sun", "sky"])
def test_captured_light_is_divided_out(skin: Gaussians, kind: str) -> None:
    true = painted(skin)
    sun = Lamp(direction=(1.0, -1.0, 1.5), intensity=0.7, shadow=False)
    sky = environment.sky_and_ground((1.1, 1.1, 1.2), (0.35, 0.33, 0.3))
    day = Lighting((sun,), 0.35) if kind == "sun" else Lighting((), 0.0, sky)
    captured = bake_light(true, day)
    restored = to_albedo(captured)
    assert off(captured, true) > 0.25
    assert off(restored, true) < 0.4 * off(captured, true)
    # and it helps when the object is lit from elsewhere
    other = Lighting((Lamp(direction=(-1.0, 0.5, 0.3), shadow=False),), 0.3)
    wanted = bake_light(true, other)
    assert off(bake_light(restored, other), wanted) < 0.6 * off(bake_light(captured, other), wanted)


def test_evenly_lit_capture_is_left_alone(skin: Gaussians) -> None:
    true = painted(skin)
    assert estimate_shading(true).strength < 0.02
    assert off(to_albedo(true), true) < 0.02


def frame(skin: Gaussians, colors: Gaussians, extra: int = 0) -> Any:
    """What delighting and gloss read of a saved frame: each splat follows a point of its own."""
    count = skin.count
    return SimpleNamespace(
        gaussians=colors,
        ids=torch.arange(count + extra),
        anchor=torch.cat([torch.arange(count), torch.arange(extra)]).int(),
        positions=skin.means,
        body=torch.zeros(count, dtype=torch.int32),
        facts={"bodies": [["melon", "fruit.watermelon"]]},
        dust=None,
    )


def test_film_keeps_the_light_out_while_things_move_and_splats_are_born(skin: Gaussians) -> None:
    captured = bake_light(painted(skin), Lighting((Lamp(shadow=False),), 0.3))
    albedo = Albedo(frame(skin, captured), 1.0)
    whole = albedo.apply(frame(skin, captured))
    torch.testing.assert_close(whole.colors(), to_albedo(captured).colors(), atol=1e-5, rtol=1e-4)
    born = Gaussians.cat([captured, captured.select(torch.arange(7))])
    later = albedo.apply(frame(skin, born, extra=7)).colors()
    torch.testing.assert_close(later[-7:], whole.colors()[:7], atol=1e-5, rtol=1e-4)


SHOT = {
    "splats": "melon.ply",
    "size": 0.2,
    "objects": {"melon": {"material": "fruit.watermelon", "specular": 0.5}},
    "light": {
        "ambient": 0.2,
        "key": {"direction": [0, 0, 1], "intensity": 0.4, "size": 2},
        "lights": [{"position": [0.3, 0, 0.5], "color": [1, 0.5, 0.2], "distance": 0.4}],
        "environment": {"sky": [0.5, 0.6, 0.8], "ground": [0.2, 0.2, 0.2], "intensity": 0.5},
        "occlusion": 0.7,
    },
}


def shot(tmp_path: Path, **light: Any) -> Shot:
    (tmp_path / "melon.ply").write_bytes(b"")
    return Shot.from_dict({**SHOT, "light": {**SHOT["light"], **light}}, tmp_path)  # type: ignore[dict-item]


def test_shot_says_the_light(tmp_path: Path) -> None:
    found = light_of(shot(tmp_path))
    assert found.lamps[0] == Lamp(direction=(0.0, 0.0, 1.0), intensity=0.4, size=2.0)
    assert found.lamps[1].position == (0.3, 0.0, 0.5) and found.lamps[1].distance == 0.4
    half = environment.sky_and_ground((0.25, 0.3, 0.4), (0.1, 0.1, 0.1))
    torch.testing.assert_close(torch.tensor(found.environment), torch.tensor(half))
    assert (found.ambient, found.occlusion, found.specular) == (0.2, 0.7, None)


@pytest.mark.parametrize(
    ("light", "named"),
    [
        ({"lights": [{"intensity": 1}]}, "direction"),
        ({"lights": [{"position": [0, 0, 1], "direction": [0, 0, 1]}]}, "both"),
        ({"lights": [{"direction": [0, 0, 1], "falloff": 2}]}, "falloff"),
        ({"lights": [{"direction": [0, 0, 1], "size": 200}]}, "size"),
        ({"environment": {"sky": [1, 1, 1]}}, "ground"),
        ({"environment": {}}, "none"),
        ({"environment": {"image": "gone.hdr"}}, "gone.hdr"),
        ({"occlusion": 2}, "occlusion"),
    ],
)
def test_bad_light_sections_are_named(tmp_path: Path, light: Any, named: str) -> None:
    with pytest.raises(InputError, match=named):
        shot(tmp_path, **light)


def test_command_line_moves_the_light(tmp_path: Path) -> None:
    base = light_of(shot(tmp_path))
    moved = changed(base, light="key=1,-1,2", ambient=0.5, intensity=0.9, spin=90.0)
    assert moved.lamps[0].direction == (1.0, -1.0, 2.0) and moved.lamps[0].intensity == 0.9
    assert moved.lamps[1:] == base.lamps[1:] and moved.ambient == 0.5
    more = changed(base, lamps=("point=0.3,0,0.5;intensity=2;color=1,0.8,0.6", "sun=0,0,1;size=9"))
    assert more.lamps[2].color == (1.0, 0.8, 0.6) and more.lamps[3].size == 9.0
    assert changed(base, surroundings="none").environment is None
    (tmp_path / "night.yaml").write_text("light: {ambient: 0.05, key: {intensity: 0.1}}")
    night = changed(base, light=str(tmp_path / "night.yaml"))
    assert night.ambient == 0.05 and night.lamps[0].intensity == 0.1 and len(night.lamps) == 1


@pytest.mark.parametrize(
    "given",
    [
        {"light": "1,2"},
        {"light": "gone.yaml"},
        {"lamps": ("point=1,2",)},
        {"lamps": ("intensity=2",)},
        {"lamps": ("sun=0,0,1;bright=2",)},
        {"surroundings": "gone.hdr"},
        {"occlusion": 3.0},
    ],
)
def test_bad_light_flags_are_named(given: Any) -> None:
    with pytest.raises(InputError):
        changed(Lighting(), **given)


def test_materials_say_how_shiny_splats_are(tmp_path: Path, skin: Gaussians) -> None:
    found = gloss_of(shot(tmp_path), frame(skin, skin))
    assert found is not None
    torch.testing.assert_close(found[0], torch.tensor([0.5, 28.0]))  # the override, the preset's
    loose = frame(skin, skin)
    loose.anchor = loose.anchor.clone()
    loose.anchor[3] = -1  # a blade
    assert float(gloss_of(shot(tmp_path), loose)[3, 0]) > 0.5  # type: ignore[index]
    loose.ids[5], loose.dust = DUST + 7, torch.tensor([5])  # a drop of its juice
    drop = torch.tensor(JUICE)
    torch.testing.assert_close(gloss_of(shot(tmp_path), loose)[5], drop)  # type: ignore[index]
    assert plates_of(loose).nonzero()[:, 0].tolist() == [3, 5]
    loose.facts = {}
    assert gloss_of(shot(tmp_path), loose) is None


def test_every_liquid_is_drawn_as_one_and_solids_are_not(skin: Gaussians) -> None:
    """Milk, too: drawn by single splats its pool had the normals of single points."""
    seen = frame(skin, skin)
    assert clear_of(seen) is None
    seen.facts = {"bodies": [["melon", "fruit.watermelon"], ["pour", "milk"], ["pool", "water"]]}
    seen.volumes = torch.linspace(1e-9, 2e-9, skin.count)
    seen.body[5:9], seen.body[9:11] = 1, 2
    seen.ids[5:11] = -seen.ids[5:11]
    found = clear_of(seen)
    assert found is not None and found.rows.nonzero()[:, 0].tolist() == [*range(5, 11)]
    assert found.attenuation[:4].isinf().all()
    torch.testing.assert_close(found.attenuation[4:], torch.full((2,), -100.0 * math.log(0.75)))
    assert torch.equal(found.volume, seen.volumes[5:11])


@pytest.mark.parametrize("degrees", [0.0, 40.0, 75.0, 88.0])
def test_a_face_of_glass_is_as_opaque_as_its_angle_says(degrees: float) -> None:
    angle = math.radians(degrees)
    eye = torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    flat = torch.tensor([[0.01, 0.01, 0.001], [0.01, 0.01, 0.01], [0.01, 0.01, 0.001]])
    paint = torch.tensor([[0.2, 0.6, 0.4]]).expand(3, 3).contiguous()
    bare = Gaussians.from_colors(torch.zeros(3, 3), flat, paint, opacities=1.0)
    assert on_a_face(bare).tolist() == [True, False, True]
    seen = see_through(bare, torch.tensor([0.8, 0.8, 0.0]), eye)
    mirror = 0.04 + 0.96 * (1.0 - math.cos(angle)) ** 5  # Schlick, index 1.5
    pane = mirror + 0.2 * (1.0 - mirror)
    # three splats that overlap make one face
    assert 1.0 - (1.0 - float(seen.opacities[0])) ** 3 == pytest.approx(pane, rel=1e-3)
    mixed = (mirror * 0.92 + (pane - mirror) * paint[0]) / pane
    torch.testing.assert_close(seen.colors()[0], mixed, atol=1e-3, rtol=0)
    # what fills the inside only tints, what is not clear stays
    assert float(seen.opacities[1]) == pytest.approx(0.04, rel=1e-3)
    assert float(seen.opacities[2]) == 1.0
    torch.testing.assert_close(seen.colors()[1:], paint[1:], atol=1e-6, rtol=0)


def test_glass_shows_the_floor_and_keeps_its_rim_and_highlight(skin: Gaussians) -> None:
    camera = Camera.look_at((0.0, -0.8, 0.0), (0, 0, 0), width=96, height=96, fov=18.0)
    light = Lighting(lamps=(Lamp(direction=(0.0, -1.0, 0.0), shadow=False),), occlusion=0.0)
    gloss = torch.tensor([[0.6, 160.0]]).expand(skin.count, 2).contiguous()
    clear = torch.full((skin.count,), 0.85)
    dark = skin.with_colors(torch.full((skin.count, 3), 0.1))
    glass, shine = as_seen(dark, gloss, clear, camera)
    made = Render(camera, light, background=(0.0, 1.0, 0.0))(glass, gloss=shine)
    row = made.alpha[48]
    inside = (made.alpha[48] > 0.02).nonzero()[:, 0]
    middle, rim = float(row[58]), float(row[inside[0] + 2 : inside[0] + 5].max())
    assert middle < 0.7 < 0.9 < rim
    assert float(made.image[48, 58, 1]) > 0.3  # the green behind it
    assert float(made.image[48, 48].min()) > 0.6  # the lamp, straight ahead


def test_materials_say_what_is_clear(tmp_path: Path, skin: Gaussians) -> None:
    assert transmission_of(shot(tmp_path), frame(skin, skin)) is None
    pane = frame(skin, skin)
    pane.facts = {"bodies": [["pane", "glass"]]}
    pane.anchor = pane.anchor.clone()
    pane.anchor[3] = -1  # a blade
    pane.ids[5] = DUST + 7
    (tmp_path / "melon.ply").write_bytes(b"")
    objects = {"pane": {"material": "glass"}}
    found = transmission_of(Shot.from_dict({**SHOT, "objects": objects}, tmp_path), pane)
    assert found is not None
    assert float(found[0]) == pytest.approx(materials.get("glass").transmission)
    assert float(found[3]) == float(found[5]) == 0.0
    dull = {"pane": {"material": "glass", "transmission": 0}}
    assert transmission_of(Shot.from_dict({**SHOT, "objects": dull}, tmp_path), pane) is None


@pytest.mark.cuda
@pytest.mark.parametrize("position", [None, (0.2, -0.2, 0.1), (0.0, -0.12, 0.02)])
def test_picture_is_the_same_on_the_gpu(skin: Gaussians, position: Any) -> None:
    lamps = (Lamp(), Lamp(position=position, size=0.03, distance=0.3)) if position else (Lamp(),)
    light = Lighting(lamps, environment=environment.sky_and_ground((0.4,) * 3, (0.1,) * 3))
    camera = Camera.look_at((0.3, -0.6, 0.3), (0, 0, 0), width=160, height=120, fov=30.0)
    studio = Studio(-0.1, (0.0, 0.0), 0.1, 0.2)
    host = Render(camera, light, studio=studio)(skin).image
    device = Render(camera, light, studio=studio)(skin.to(torch.device("cuda"))).image.cpu()
    assert float((host - device).abs().mean()) < 2e-3


@pytest.mark.parametrize("nearest", [1.9, 1.0, 0.5])
@pytest.mark.parametrize("radius", [0.1, 0.3])
def test_what_lies_low_keeps_its_shadow_under_what_flies_high(
    radius: float, nearest: float
) -> None:
    """A plate 4 cm over a floor, below a lamp 2 m up; the highest thing is ``nearest`` from it."""
    side, focal, low = 512, 600.0, 1.96
    along = ((torch.arange(side) + 0.5 - 0.5 * side) / focal * low).abs() < 0.03
    plate = along[:, None] & along
    camera = torch.tensor([1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, -1.0, 2.0, focal, nearest, 0.004])
    maps = ShadowMaps(torch.where(plate, low, 1e6)[None], plate[None].float(), camera[None])
    lamp = torch.zeros(12)
    lamp[0], lamp[9], lamp[11] = 1.0, radius, 1.0
    floor = torch.tensor([[0.0, 0.0, 0.0], [0.02, -0.01, 0.0], [0.1, 0.1, 0.0]])
    up = torch.tensor([0.0, 0.0, 1.0]).expand(3, 3)
    light = transmittance(floor, up, lamp, maps)
    assert light[:2].tolist() == pytest.approx([0.0, 0.0], abs=1e-5) and float(light[2]) == 1.0
