"""One picture of a splat file with light, shadow and floor, in Python: the Render stage.

python scripts/stages/render.py MODEL.ply OUT.png [AZIMUTH]
"""

from __future__ import annotations

import sys

import gsfluent as gf
from gsfluent.io import save_image
from gsfluent.pipeline.capture.orient import make_frame
from gsfluent.pipeline.light.lamps import key_light
from gsfluent.pipeline.render.camera import look_at
from gsfluent.pipeline.render.studio import Studio


def main(model: str, out: str, azimuth: str = "-60") -> None:
    gaussians = gf.load(model)
    gaussians = gaussians.transformed(make_frame(gaussians))
    low, high = gaussians.bounds()
    radius = 0.5 * float((high - low).norm())
    camera = look_at((low + high) / 2, 4.0 * radius, float(azimuth), 20.0, (800, 600))
    studio = Studio(0.0, (0.0, 0.0), radius, radius)
    save_image(gf.pipeline.Render(camera, key_light(), studio=studio)(gaussians).image, out)


if __name__ == "__main__":
    main(*sys.argv[1:])
