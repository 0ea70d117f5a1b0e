"""Flicker of the surface of a liquid over that of its truth, on a film whose motion is known.

    python scripts/accuracy/liquid_flicker.py [--json docs/measured/data/liquid_flicker.jsonl]
        [--page docs/measured/liquids.md]

A round film spreads on a floor and thins, and a ring of waves runs outward over it. Its points are
moved exactly. The truth is the same film of points a third as far apart: what it flickers, its own
light does. Both are drawn as the film stage draws them, lit, and compared along the true motion
(:mod:`gsfluent.pipeline.render.flicker`); *as splats* is the same points without a surface.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.data import Camera, Gaussians
from gsfluent.figure.markdown import enter
from gsfluent.pipeline.light.lamps import studio_light
from gsfluent.pipeline.liquid.clear import Clear
from gsfluent.pipeline.liquid.sheet import ellipsoids
from gsfluent.pipeline.render.flicker import Flow, flicker
from gsfluent.pipeline.render.holes import MatterView
from gsfluent.pipeline.render.stage import Render, Room
from gsfluent.pipeline.render.studio import Studio
from gsfluent.spatial.blue_noise import blue_cylinder

SPACING = 0.004
FINER = 3
RADIUS, DEEP = 0.06, 0.012
"""Of the film at first [m]: three spacings deep, one and a half in the end."""
FRAMES, STEP = 9, 1.0 / 160.0
STRETCH = 8.0
"""Rate at which it spreads [1/s]."""
WAVE, LENGTH, SPEED = 0.0012, 0.03, 0.4
SIZE = (200, 150)
PAINT = {"milk": (0.88, 0.87, 0.81), "water": (0.45, 0.6, 0.66)}


def moved(points: Tensor, time: float) -> Tensor:
    """The points [N, 3] of the film at rest at a time [s]."""
    wide = 1.0 + STRETCH * time
    far = points[:, :2].norm(dim=1)
    wave = WAVE * torch.sin(2.0 * math.pi * (far - SPEED * time) / LENGTH)
    height = (points[:, 2] + 0.5 * DEEP) * (1.0 + wave / DEEP) / wide**2
    return torch.cat([points[:, :2] * wide, height[:, None]], dim=1)


def splats(points: Tensor, volume: float, color: Tensor) -> Gaussians:
    """Its splats, as a frame of a simulation has them."""
    made = ellipsoids(points, points.new_full(points.shape[:1], volume))
    paint = color.expand_as(made.means).float()
    return Gaussians.from_colors(
        made.means.float(), made.scales.float(), paint, opacities=0.95
    ).replace(quats=made.quats.float())


def measured(liquid: str) -> dict[str, Any]:
    """The line of one liquid."""
    look = materials.get(liquid)
    color = torch.tensor(PAINT[liquid])
    camera = Camera.look_at((0.0, -0.42, 0.26), (0.0, 0.0, 0.0), width=SIZE[0], height=SIZE[1],
                            fov=17.0)  # fmt: skip
    stage = Render(camera, studio_light(), studio=Studio(0.0, (0.0, 0.0), RADIUS, 0.3, False))
    sets = {"truth": FINER, "surface": 1, "splats": 1}
    rest = {n: blue_cylinder(RADIUS, DEEP, SPACING / n, seed=3) for n in set(sets.values())}
    gloss = torch.tensor([look.specular, look.shininess])
    found: dict[str, list[float]] = {name: [] for name in sets}
    rooms: dict[str, Room | None] = {}
    last: tuple[MatterView, Tensor, dict[str, Tensor]] | None = None
    for index in range(FRAMES):
        time = index * STEP
        images = {}
        for name, finer in sets.items():
            points = moved(rest[finer], time)
            volume = (SPACING / finer) ** 3
            drawn = splats(points, volume, color)
            every = torch.ones(drawn.count, dtype=torch.bool)
            lets = -100.0 * math.log(look.transmission) if look.transmission else math.inf
            sizes = torch.full((drawn.count,), volume)
            clear = Clear(every, sizes, torch.full_like(sizes, lets), gloss)
            made = stage(
                drawn, clear=None if name == "splats" else clear, room=rooms.get(name), time=time
            )
            images[name], rooms[name] = made.image, made.room
        true = moved(rest[FINER], time).float()
        sizes = torch.full((len(true),), (SPACING / FINER) ** 3)
        matter = MatterView.of(true, sizes, camera)
        if last is not None:
            flow = Flow.of(last[0], matter, (last[1], true), (camera, camera), SPACING)
            for name, image in images.items():
                value = flicker(last[2][name], image, flow)
                assert value is not None
                found[name].append(value)
        last = matter, true, images
    mean = {name: sum(values) / len(values) for name, values in found.items()}
    return {"liquid": liquid, **mean, "ratio": mean["surface"] / mean["truth"]}


def table(lines: list[dict[str, Any]]) -> str:
    """The table of the page."""
    head = (
        "| liquid | flicker of the truth | as drawn | over the truth's "
        "| as splats, over the truth's |\n"
        "| --- | --- | --- | --- | --- |\n"
    )
    return head + "".join(
        f"| {line['liquid']} | {100 * line['truth']:.3f} % | {100 * line['surface']:.3f} % "
        f"| {line['ratio']:.2f} | {line['splats'] / line['truth']:.2f} |\n"
        for line in lines
    )


def main(argv: list[str] | None = None) -> None:
    """Measure milk and water, keep their lines, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--json", type=Path, help="lines of the liquids")
    parser.add_argument("--page", type=Path, help="page that gets the table")
    given = parser.parse_args(argv)
    lines = [measured(name) for name in PAINT]
    print(table(lines))
    if given.json is not None:
        text = "".join(json.dumps(line) + "\n" for line in lines)
        given.json.write_text(text, encoding="utf-8")
    if given.page is not None:
        page = given.page.read_text(encoding="utf-8")
        page = enter(page, "liquid flicker", table(lines))
        given.page.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
