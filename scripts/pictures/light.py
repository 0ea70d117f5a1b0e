"""Pictures of light: a run under four lights, and a splat file whose capture is relit.

python scripts/pictures/light.py --run OUT --frame 11 -o docs/images/light_broken.jpg
python scripts/pictures/light.py --splats apple.ply -o docs/images/light_apple.jpg
python scripts/pictures/light.py --penumbra -o docs/images/light_penumbra.jpg
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.io import load_splats, save_image
from gsfluent.lab.truth import light as truth
from gsfluent.pipeline.light.albedo import to_albedo
from gsfluent.pipeline.light.environment import sky_and_ground
from gsfluent.pipeline.light.from_shot import light_of
from gsfluent.pipeline.light.lamps import Lamp, Lighting
from gsfluent.pipeline.light.shadow_maps import bulk
from gsfluent.pipeline.render.film import Film
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio
from gsfluent.results.record import shot_of

WARM, COOL = (1.0, 0.82, 0.6), (0.55, 0.72, 1.0)


def two_sides(scale: float, center: tuple[float, float, float]) -> Lighting:
    """A warm low lamp on the left, a cool point lamp on the right, a dim sky."""
    x, y, z = center
    return Lighting(
        lamps=(
            Lamp(direction=(-1.0, -0.6, 0.7), intensity=1.0, color=WARM, size=8.0),
            Lamp(
                position=(x + 3.0 * scale, y - 1.0 * scale, z + 1.5 * scale),
                intensity=0.8,
                distance=3.0 * scale,
                color=COOL,
                size=0.5 * scale,
            ),
        ),
        ambient=0.1,
        environment=sky_and_ground((0.15, 0.17, 0.2), (0.1, 0.09, 0.08)),
    )


def run_pictures(out: Path, index: int, size: tuple[int, int]) -> Tensor:
    """The shot's light, without occlusion, two lamps from the sides, a low sun."""
    shot = shot_of(out)
    shot = replace(shot, output=replace(shot.output, size=size))
    usual = light_of(shot)
    frame = Film(out, shot, usual, torch.device("cpu")).frame(index)
    center, radius, _ = bulk(frame.gaussians)
    lights = [
        usual,
        replace(usual, occlusion=0.0),
        two_sides(radius, center),
        replace(
            usual, ambient=0.15, lamps=(Lamp(direction=(1, 0.3, 0.35), intensity=1.2, size=2),)
        ),
    ]
    pictures = []
    for light in lights:
        film = Film(out, shot, light, torch.device("cpu"))
        pictures.append(film.picture(frame).image)
    return torch.cat([torch.cat(pictures[:2], 1), torch.cat(pictures[2:], 1)])


def splat_pictures(path: Path, up: Tensor, front: Tensor, size: tuple[int, int]) -> Tensor:
    """As captured, lit from left and right; below, with the captured light divided out."""
    splats = load_splats(path)
    center, radius, _ = bulk(splats)
    above = up / up.norm()
    front = front - (front @ above) * above
    front = front / front.norm()
    side = torch.linalg.cross(above, front)
    eye = torch.tensor(center) + radius * (2.3 * front + 0.6 * above)
    camera = Camera.look_at(
        eye.tolist(), center, width=size[0], height=size[1], fov=40.0, up=above.tolist()
    )
    bare = to_albedo(splats)
    rows = [[Render(camera)(splats).image], [Render(camera)(bare).image]]
    for sign in (-1.0, 1.0):
        x, y, z = (sign * side + 0.5 * above + 0.6 * front).tolist()
        light = Lighting((Lamp(direction=(x, y, z), intensity=0.9),), ambient=0.25)
        for row, matter in zip(rows, (splats, bare), strict=True):
            row.append(Render(camera, light)(matter).image)
    return torch.cat([torch.cat(row, 1) for row in rows])


def penumbra_pictures(size: tuple[int, int]) -> Tensor:
    """Lamps of growing width over a ball and a box."""
    ball = truth.surface_splats(truth.Ball((-0.08, 0.0, 0.16), 0.07), 40_000, 0.55)
    box = truth.solid_splats(truth.Box((0.05, -0.06, 0.0), (0.17, 0.06, 0.16)), 0.003, 0.55)
    matter = Gaussians.cat([ball, box])
    camera = Camera.look_at((0.2, -0.75, 0.5), (0, 0, 0.07), width=size[0], height=size[1], fov=38)
    studio = Studio(0.0, (0.0, 0.0), 0.2, 0.4)
    pictures = [
        Render(
            camera,
            Lighting((Lamp(direction=(0.6, -0.2, 1.0), size=width, intensity=0.7),), ambient=0.4),
            studio=studio,
        )(matter).image
        for width in (0.5, 6.0, 20.0)
    ]
    return torch.cat(pictures, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, help="folder of a finished run")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--splats", type=Path, help="splat file of an object")
    parser.add_argument("--up", default="0,0,1", help="its up axis")
    parser.add_argument("--front", default="1,0,0", help="where they are seen from")
    parser.add_argument("--penumbra", action="store_true", help="lamps of growing width")
    parser.add_argument("--size", default="480x360", help="of each picture")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    width, height = (int(side) for side in options.size.split("x"))
    if options.run is not None:
        image = run_pictures(options.run, options.frame, (width, height))
    elif options.splats is not None:
        up, front = (
            torch.tensor([float(part) for part in text.split(",")])
            for text in (options.up, options.front)
        )
        image = splat_pictures(options.splats, up, front, (width, height))
    elif options.penumbra:
        image = penumbra_pictures((width, height))
    else:
        parser.error("give --run, --splats or --penumbra")
    save_image(image.cpu().clamp(0.0, 1.0), options.out)


if __name__ == "__main__":
    main()
