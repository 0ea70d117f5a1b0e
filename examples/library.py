"""What `gsfluent run` does, in Python: photographs of an orange to pictures of it breaking.

    python examples/library.py [--out FOLDER] [--device cpu] [--views 26] [--frames 12]

Nothing is downloaded: the photographs are drawn by gsfluent from an orange whose inside it knows.
Every stage is an nn.Module-style call on plain containers of tensors; leave one out, put your own
in its place, or keep the tensors on the GPU and go on from there.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import gsfluent as gf
from gsfluent.demo import make_capture
from gsfluent.pipeline.light.lamps import key_light
from gsfluent.pipeline.render.studio import Studio


def main() -> int:
    """Photograph, rebuild, fill, colour, drop, render."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("library_out"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--views", type=int, default=26)
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--frames", type=int, default=12)
    options = parser.parse_args()

    paths = make_capture("orange", options.out / "photographs", views=options.views,
                         size=options.image_size)  # fmt: skip
    capture = gf.load_capture(paths.root)

    # photographs -> Gaussians -> a solid with an inside -> colours for the inside
    reconstruct = gf.pipeline.Reconstruct(
        iterations=options.iterations, max_gaussians=8000, device=options.device
    )
    gaussians = reconstruct(capture)
    report = gaussians.report
    gaussians = gf.pipeline.Isolate()(gaussians, capture)
    solid = gf.pipeline.Fill()(gaussians.to(options.device), capture)
    texture = gf.pipeline.Texture(method="exemplar", exemplar=paths.cut, device=options.device)
    solid = texture(solid, capture)

    # what happens: it falls from 0.7 m; the material is a preset with one number changed
    scene = gf.Scene(floor=0.0)
    scene.add(solid, material=gf.materials.fruit.orange.override(cohesion=0.08), name="orange")
    scene.drop(0.7)

    camera = gf.Camera.look_at((0.42, -0.5, 0.34), (0.0, 0.0, 0.05), width=320, height=240)
    studio = Studio(height=0.0, center=(0.0, 0.0), radius=0.05, extent=0.3)
    render = gf.pipeline.Render(camera, key_light(direction=(1.0, -1.0, 2.0)), studio=studio)
    fps = 30.0
    fall = round(fps * 0.37)  # it lands after 0.38 s; pictures are made from then on
    simulate = gf.pipeline.Simulate(quality="preview", device=options.device)
    simulation = simulate(scene, fps=fps, seconds=(fall + options.frames) / fps)
    for frame in simulation:
        if frame.index < fall:
            continue
        image = render(frame.gaussians, groups=frame.groups).image  # [H, W, 3], on the device
        gf.io.save_image(image.cpu(), options.out / f"frame_{frame.index:03d}.png")
        sys.stdout.write(
            f"t = {frame.time:.3f} s: {frame.stats['fragments']} pieces, "
            f"{frame.energy['kinetic']:.3f} J, {frame.gaussians.count} splats\n"
        )
    gf.save(frame.gaussians, options.out / "last.ply")  # opens in any splat viewer
    sys.stdout.write(f"{report['psnr']:.1f} dB held out; {simulation.report['verdict']}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
