"""Light against ray-traced truth: lit balls, shadows, occlusion, captured light divided out.

    python scripts/accuracy/light.py [--page docs/measured/light.md]
        [--json FILE] [--pictures FOLDER]

Sphere: RMS of the difference of linear radiance over RMS of the truth, over the pixels whose
surface faces the camera by at least 0.3 (away from the silhouette's rim). Shadow: where the share
of the lamp that arrives crosses one half, and the distance between a tenth and nine tenths of it,
along a line across the shadow's edge; both as errors in percent of the object's size.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.figure.markdown import enter
from gsfluent.io import save_image
from gsfluent.lab.truth import light as truth
from gsfluent.pipeline.light import environment
from gsfluent.pipeline.light.albedo import to_albedo
from gsfluent.pipeline.light.bake import bake_light
from gsfluent.pipeline.light.lamps import Lamp, Lighting, pack_lamps
from gsfluent.pipeline.light.normals import grid_for
from gsfluent.pipeline.light.occlusion import ambient_occlusion
from gsfluent.pipeline.light.shade import to_display, to_linear
from gsfluent.pipeline.light.shadow import transmittance
from gsfluent.pipeline.light.shadow_maps import bulk, faces_of, shadow_maps
from gsfluent.pipeline.render.stage import Render

GREY = 0.5
ALBEDO = float(to_linear(torch.tensor(GREY)))
RADIUS = 0.1
SIZE = 256
FACING = 0.3
SURFACE_SPLATS = 80_000
SPACING = 0.0035  # of solids [m]
MAP = 512
SUN = (0.6, -0.8, 0.9)
NEAR = (-0.25, -0.35, 0.3)


def room() -> Tensor:
    """A made-up room: bright window on the right, warm floor, dim elsewhere; linear radiance."""
    image = torch.full((64, 128, 3), 0.15, dtype=torch.float64)
    image[36:] = torch.tensor([0.30, 0.22, 0.15], dtype=torch.float64)
    image[14:30, 84:104] = torch.tensor([3.0, 3.2, 3.6], dtype=torch.float64)
    return image


def evening() -> Tensor:
    """A made-up evening: blue above, orange low on the left, dark ground; linear radiance."""
    polar = (torch.arange(32, dtype=torch.float64) + 0.5)[:, None] * math.pi / 32
    turn = (torch.arange(64, dtype=torch.float64) + 0.5) / 32.0 * math.pi - math.pi
    up, left = polar.cos(), (-(polar.sin() * turn.sin())).clamp(min=0.0)
    sky = torch.tensor([0.25, 0.40, 0.75], dtype=torch.float64) * (0.6 + 0.4 * up)[..., None]
    glow = torch.tensor([1.6, 0.8, 0.3], dtype=torch.float64) * (left**2)[..., None]
    ground = torch.tensor([0.10, 0.09, 0.08], dtype=torch.float64)
    above = (0.5 + 2.0 * up).clamp(0.0, 1.0)[..., None]
    return above * (sky + glow) + (1.0 - above) * ground


def lit_cases() -> dict[str, tuple[Lighting, list[truth.TrueLamp], float, float]]:
    """Lightings with their truths, and k_s and n_s."""
    sun = Lamp(direction=SUN, intensity=0.9, size=0.0)
    bulb = Lamp(position=NEAR, intensity=0.6, distance=0.4, color=(1.0, 0.8, 0.6), size=0.0)
    back = Lamp(direction=(-1.0, 0.3, 0.4), intensity=0.5, color=(0.5, 0.7, 1.0), size=0.0)
    true_sun = truth.TrueLamp(direction=SUN, color=(0.9,) * 3)
    true_bulb = truth.TrueLamp(position=NEAR, color=(0.6, 0.48, 0.36), distance=0.4)
    true_back = truth.TrueLamp(direction=(-1.0, 0.3, 0.4), color=(0.25, 0.35, 0.5))
    none = Lighting(lamps=(), ambient=0.0, specular=0.0, shininess=20.0, occlusion=0.0)

    def make(*lamps: Lamp, **more: Any) -> Lighting:
        from dataclasses import replace

        return replace(none, lamps=lamps, **more)

    return {
        "directional": (make(sun, ambient=0.2), [true_sun], 0.0, 20.0),
        "point": (make(bulb, ambient=0.1), [true_bulb], 0.0, 20.0),
        "three lamps": (
            make(sun, bulb, back, ambient=0.1),
            [true_sun, true_bulb, true_back],
            0,
            20,
        ),
        "specular": (make(sun, ambient=0.2, specular=0.3, shininess=30.0), [true_sun], 0.3, 30.0),
        "environment, evening sky": (
            make(environment=environment.of_radiance(evening())),
            [],
            0.0,
            20.0,
        ),
        "environment, one small window": (
            make(environment=environment.of_radiance(room())),
            [],
            0.0,
            20.0,
        ),
    }


def sphere(splats: Gaussians, name: str) -> tuple[float, Tensor]:
    """Relative RMS error of a lit ball, and picture beside truth."""
    lighting, lamps, specular, shininess = lit_cases()[name]
    ball = truth.Ball((0.0, 0.0, 0.0), RADIUS)
    camera = Camera.look_at((0.15, -0.8, 0.25), (0.0, 0.0, 0.0), width=SIZE, height=SIZE, fov=15.5)
    layers = Render(camera, lighting, background=(0.0, 0.0, 0.0))(splats).image
    eye, rays = truth.rays_of(camera)
    reach = ball.hit(eye.expand_as(rays), rays)
    hit = torch.isfinite(reach)
    points = eye + torch.where(hit, reach, 0.0)[..., None] * rays
    normal = ball.normal(points)
    around = torch.full_like(points, lighting.ambient)
    if lighting.environment is not None:
        flat = normal[hit]
        around[hit] = truth.environment_irradiance(room() if "window" in name else evening(), flat)
    middle = torch.zeros(3, dtype=torch.float64)
    shares = [
        (lamp, truth.unblocked(points + 1e-7 * normal, lamp, [ball], middle, 1)) for lamp in lamps
    ]
    expected = truth.radiance(normal, -rays, points, ALBEDO, shares, around, specular, shininess)
    expected = torch.where(hit[..., None], expected, 0.0)
    inner = hit & ((normal * -rays).sum(-1) > FACING)
    error = (to_linear(layers.double()) - expected)[inner].square().mean().sqrt()
    error = error / expected[inner].square().mean().sqrt()
    return float(error), torch.cat([layers, to_display(expected).float().clamp(0, 1)], 1)


def shadow_cases() -> dict[str, tuple[Any, Gaussians, Lamp, truth.TrueLamp, Tensor, Tensor, float]]:
    """Object, splats, lamp, true lamp, line across the edge (from, to), size of the object."""
    ball = truth.Ball((0.0, 0.0, 0.3), RADIUS)
    box = truth.Box((-0.1, -0.1, 0.2), (0.1, 0.1, 0.26))
    balls, boxes = truth.surface_splats(ball, SURFACE_SPLATS, GREY), None
    boxes = truth.solid_splats(box, SPACING, GREY)
    cases: dict[str, Any] = {}
    for degrees in (0.0, 4.0, 12.0):
        spread = math.tan(math.radians(0.5 * degrees))
        lamp = Lamp(direction=(0.5, 0.0, 1.0), size=degrees)
        true = truth.TrueLamp(direction=(0.5, 0.0, 1.0), spread=spread)
        line = (torch.tensor([-0.4, 0.0, 0.0]), torch.tensor([-0.15, 0.0, 0.0]))
        cases[f"ball, directional, {degrees:g} degrees"] = (ball, balls, lamp, true, *line, 0.2)
        line = (torch.tensor([-0.35, 0.02, 0.0]), torch.tensor([-0.1, 0.02, 0.0]))
        cases[f"box, directional, {degrees:g} degrees"] = (box, boxes, lamp, true, *line, 0.2)
    for width in (0.0, 0.06):
        lamp = Lamp(position=(0.3, 0.0, 0.9), size=width)
        true = truth.TrueLamp(position=(0.3, 0.0, 0.9), spread=0.5 * width)
        line = (torch.tensor([-0.5, 0.0, 0.0]), torch.tensor([-0.12, 0.0, 0.0]))
        cases[f"ball, point, {100 * width:g} cm wide"] = (ball, balls, lamp, true, *line, 0.2)
        line = (torch.tensor([-0.42, 0.02, 0.0]), torch.tensor([-0.06, 0.02, 0.0]))
        cases[f"box, point, {100 * width:g} cm wide"] = (box, boxes, lamp, true, *line, 0.2)
    return cases


def shadow(name: str, *, samples: int = 1) -> dict[str, float]:
    """Errors of one shadow's edge, in percent of the object's size, and of the lamp's share."""
    thing, splats, lamp, true, start, end, size = shadow_cases()[name]
    steps = torch.linspace(0.0, 1.0, 801, dtype=torch.float64)[:, None]
    line = start.double() + steps * (end - start).double()
    where = (line - line[0]).norm(dim=-1)
    middle = splats.means.mean(0).double()
    expected = truth.unblocked(line, true, [thing], middle, 4000)
    lamps = Lighting(lamps=(replace_samples(lamp, samples),)).drawn()
    matter = bulk(splats)
    faces = faces_of(lamps, matter)
    maps = shadow_maps(splats, lamps, faces, MAP, matter)
    assert maps is not None
    up = torch.tensor([0.0, 0.0, 1.0]).expand(line.shape[0], 3)
    table = pack_lamps(lamps, faces, splats.means)
    shares = [transmittance(line.float(), up, row, maps, biased=0.0) for row in table]
    found = torch.stack(shares).mean(0).double()
    edges = {level: (_crossing(where, found, level), _crossing(where, expected, level))
             for level in (0.1, 0.5, 0.9)}  # fmt: skip
    width = abs(edges[0.9][0] - edges[0.1][0])
    true_width = abs(edges[0.9][1] - edges[0.1][1])
    return {
        "edge": 100.0 * abs(edges[0.5][0] - edges[0.5][1]) / size,
        "penumbra": 100.0 * abs(width - true_width) / size,
        "true_penumbra": 100.0 * true_width / size,
        "rms": 100.0 * float((found - expected).square().mean().sqrt()),
    }


def replace_samples(lamp: Lamp, samples: int) -> Lamp:
    from dataclasses import replace

    return replace(lamp, samples=samples)


def _crossing(where: Tensor, share: Tensor, level: float) -> float:
    """Where the share first falls through a level, linear between points."""
    below = (share < level).nonzero()
    if not below.numel() or int(below[0]) == 0:
        return math.nan
    i = int(below[0])
    part = float((share[i - 1] - level) / (share[i - 1] - share[i]).clamp(min=1e-12))
    return float(where[i - 1] + part * (where[i] - where[i - 1]))


def occlusion_cases() -> dict[str, tuple[list[Any], Gaussians, Tensor, Tensor]]:
    """Things, their splats, points and normals where the sky's share is asked for."""
    gap = 0.04
    walls = [
        truth.Box((-0.1, -0.1, 0.0), (-0.5 * gap, 0.1, 0.1)),
        truth.Box((0.5 * gap, -0.1, 0.0), (0.1, 0.1, 0.1)),
        truth.Box((-0.1, -0.1, -0.05), (0.1, 0.1, 0.0)),
    ]
    crack = Gaussians.cat([truth.solid_splats(wall, SPACING, GREY) for wall in walls])
    depth = torch.linspace(0.005, 0.095, 19, dtype=torch.float64)
    side = torch.stack([torch.full_like(depth, -0.5 * gap + 1e-4), 0 * depth, depth], -1)
    inward = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand_as(side)
    across = torch.linspace(-0.4 * gap, 0.4 * gap, 9, dtype=torch.float64)
    bed = torch.stack([across, 0 * across, 0 * across + 1e-4], -1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    ball = truth.Ball((0.0, 0.0, 0.105), RADIUS)
    away = torch.linspace(0.0, 0.4, 21, dtype=torch.float64)
    floor = torch.stack([away, 0 * away, 0 * away], -1)
    solid = truth.solid_splats(ball, SPACING, GREY)
    turn = torch.linspace(0.0, math.pi, 13, dtype=torch.float64)
    own = torch.stack([turn.sin(), 0 * turn, turn.cos()], -1)
    skin = torch.tensor(ball.center, dtype=torch.float64) + RADIUS * own
    return {
        "wall of a crack": (walls, crack, side, inward),
        "bed of a crack": (walls, crack, bed, up.expand_as(bed)),
        "floor beside a ball": ([ball], solid, floor, up.expand_as(floor)),
        "skin of a ball": ([ball], solid, skin + 1e-6 * own, own),
    }


def occlusion(name: str) -> tuple[float, Tensor, Tensor]:
    """RMS error of the sky's share, found and true values along the points."""
    things, splats, points, normals = occlusion_cases()[name]
    expected = truth.sky_share(points, normals, things, 4000)
    grid = grid_for(splats).of(splats, bulk(splats).center)
    found = ambient_occlusion(points.float(), normals.float(), grid).double()
    return float((found - expected).square().mean().sqrt()), found, expected


def paints(splats: Gaussians) -> dict[str, Gaussians]:
    """The ball in one grey, in two greens that wind around it, and in blotches of many colours."""
    place = splats.means / RADIUS
    turn = torch.atan2(place[:, 1], place[:, 0])
    dark = (torch.sin(9 * turn + 2 * torch.sin(4 * place[:, 2])) > 0.1).float()[:, None]
    stripes = dark * torch.tensor([0.35, 0.55, 0.2]) + (1 - dark) * torch.tensor([0.12, 0.25, 0.1])
    generator = torch.Generator().manual_seed(1)
    waves = 6.0 * torch.randn(12, 3, generator=generator)
    phases = 2.0 * math.pi * torch.rand(12, generator=generator)
    blotch = torch.sin(place @ waves.T + phases).mean(1, keepdim=True)
    blotches = (0.5 + blotch * torch.tensor([0.5, 0.4, 0.2])).clamp(0.05, 0.95)
    return {
        "one grey": splats,
        "green stripes": splats.with_colors(stripes),
        "blotches": splats.with_colors(blotches),
    }


def delighting(splats: Gaussians) -> dict[str, dict[str, float]]:
    """RMS error of the linear colours against the true paint, and of the ball relit, both ways.

    Relative to the RMS of the truth; of the paint after the best common factor, because the mean
    brightness of a capture's light cannot be known.
    """
    sun = Lamp(direction=(1.0, -1.0, 1.5), intensity=0.7, shadow=False)
    sky = environment.sky_and_ground((1.1, 1.1, 1.2), (0.35, 0.33, 0.3))
    days = {
        "sun": Lighting((sun,), 0.35, occlusion=0.0),
        "sky over dark ground": Lighting((), 0.0, sky, occlusion=0.0),
        "even": Lighting((), 1.0, occlusion=0.0),
    }
    lamp = Lamp(direction=(-1.0, 0.5, 0.3), shadow=False)
    other = Lighting((lamp,), 0.3, occlusion=0.0)

    def off(found: Gaussians, wanted: Gaussians) -> float:
        a, b = to_linear(found.colors()), to_linear(wanted.colors())
        a = a * (a * b).sum() / (a * a).sum()
        return float((a - b).square().mean().sqrt() / b.square().mean().sqrt())

    found = {}
    for day, lighting in days.items():
        for paint, true in paints(splats).items():
            captured = bake_light(true, lighting)
            bare = to_albedo(captured)
            wanted = bake_light(true, other)
            found[f"{paint}, {day}"] = {
                "paint_before": off(captured, true),
                "paint_after": off(bare, true),
                "relit_before": off(bake_light(captured, other), wanted),
                "relit_after": off(bake_light(bare, other), wanted),
            }
    return found


def figures(pictures: Path | None = None) -> dict[str, Any]:
    """All numbers."""
    ball = truth.Ball((0.0, 0.0, 0.0), RADIUS)
    kinds = {
        "flat splats on the surface": truth.surface_splats(ball, SURFACE_SPLATS, GREY),
        "round splats throughout": truth.solid_splats(ball, SPACING, GREY),
        "flat skin, filled": Gaussians.cat(
            [
                truth.surface_splats(ball, SURFACE_SPLATS // 2, GREY),
                truth.solid_splats(truth.Ball(ball.center, 0.97 * RADIUS), 0.005, GREY),
            ]
        ),
    }
    balls: dict[str, dict[str, float]] = {}
    rows = []
    for name in lit_cases():
        balls[name] = {}
        row = []
        for kind, splats in kinds.items():
            balls[name][kind], picture = sphere(splats, name)
            if kind != "flat skin, filled":
                row.append(picture)
        rows.append(torch.cat(row, 1))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        save_image(torch.cat(rows), pictures / "light_spheres.jpg")
    return {
        "sphere": balls,
        "shadow": {name: shadow(name) for name in shadow_cases()},
        "occlusion": {name: occlusion(name)[0] for name in occlusion_cases()},
        "delight": delighting(kinds["flat splats on the surface"]),
    }


def tables(found: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        "| lit ball, error of radiance | flat splats | round splats | flat skin, filled |",
        "| --- | --- | --- | --- |",
    ]
    for name, row in found["sphere"].items():
        lines.append(f"| {name} | " + " | ".join(f"{100 * v:.2f} %" for v in row.values()) + " |")
    lines += [
        "",
        "| shadow on the floor | edge off | true penumbra | penumbra off | RMS of the share |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, row in found["shadow"].items():
        cells = [row["edge"], row["true_penumbra"], row["penumbra"], row["rms"]]
        lines.append(f"| {name} | " + " | ".join(f"{v:.2f} %" for v in cells) + " |")
    lines += ["", "| occlusion | RMS error of the sky's share |", "| --- | --- |"]
    for name, value in found["occlusion"].items():
        lines.append(f"| {name} | {value:.3f} |")
    lines += [
        "",
        "| captured light divided out | paint before | after | relit before | after |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, row in found["delight"].items():
        lines.append(f"| {name} | " + " | ".join(f"{100 * v:.1f} %" for v in row.values()) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--page", type=Path, help="enter the tables into this page")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--pictures", type=Path, help="folder for pictures beside their truths")
    options = parser.parse_args()
    found = figures(options.pictures)
    print(tables(found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    if options.page:
        text = options.page.read_text(encoding="utf-8")
        options.page.write_text(enter(text, "light accuracy", tables(found)), encoding="utf-8")


if __name__ == "__main__":
    main()
