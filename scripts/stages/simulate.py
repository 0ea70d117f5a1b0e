"""Drop a solid and count the pieces, in Python: Scene and the Simulate stage.

    python scripts/stages/simulate.py SOLID.ply [MATERIAL] [HEIGHT] [SIZE] [SECONDS] [FPS]

HEIGHT and SIZE (largest extent) are in metres. In the end it says what that cost.
"""

from __future__ import annotations

import sys
import time

import gsfluent as gf
from gsfluent.pipeline.capture.orient import make_frame


def main(
    solid_file: str,
    material: str = "fruit.watermelon",
    height: str = "1.0",
    size: str = "0.25",
    seconds: str = "1.0",
    fps: str = "30",
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
    begun = time.process_time()
    states = gf.pipeline.Simulate(quality="preview")(scene, fps=float(fps), seconds=float(seconds))
    for state in states:
        pieces = state.stats["fragments"]
        kinetic = state.energy["kinetic"]
        sys.stdout.write(f"t = {state.time:.3f} s, {pieces} pieces, {kinetic:.3g} J moving\n")
    report = states.report
    sys.stdout.write(
        f"{report['substeps']} steps, {report['active_blocks_max']} blocks at most, "
        f"{report['active_blocks_mean']:.0f} on average, {time.process_time() - begun:.1f} CPU s\n"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
