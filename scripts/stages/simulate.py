"""Drop a solid and count the pieces, in Python: Scene and the Simulate stage.

    python scripts/stages/simulate.py SOLID.ply [MATERIAL] [HEIGHT] [SIZE]

HEIGHT and SIZE (largest extent) are in metres.
"""

from __future__ import annotations

import sys

import gsfluent as gf
from gsfluent.pipeline.capture.orient import make_frame


def main(
    solid_file: str,
    material: str = "fruit.watermelon",
    height: str = "1.0",
    size: str = "0.25",
) -> None:
    solid = gf.load(solid_file)
    frame = solid.frame or make_frame(solid.gaussians)
    low, high = solid.gaussians.bounds()
    if solid.frame is None:
        scale = float(size) / float((high - low).max())
        ratio = scale / frame.scale
        frame = gf.Frame(frame.rotation, frame.translation * ratio, scale)
    scene = gf.Scene(floor=0.0)
    scene.add(solid, material=material, frame=frame)
    scene.drop(float(height))
    for state in gf.pipeline.Simulate(quality="preview")(scene, fps=30, seconds=1.0):
        pieces = state.stats["fragments"]
        kinetic = state.energy["kinetic"]
        sys.stdout.write(f"t = {state.time:.3f} s, {pieces} pieces, {kinetic:.3g} J moving\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
