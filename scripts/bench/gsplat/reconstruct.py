"""Photographs to splats by the Reconstruct stage, with held-out quality on one JSON line.

    python scripts/bench/gsplat/reconstruct.py CAPTURE [-o OUT.ply] [--device cuda] ...
    python scripts/bench/gsplat/reconstruct.py demo:watermelon --iterations 600
    python scripts/bench/gsplat/reconstruct.py captures/fox --iterations 7000 --whole-scene \\
        --image-size 800 --device cuda

CAPTURE is a folder (COLMAP, or transforms.json), or demo:watermelon, demo:orange (floating, with
masks) or demo:watermelon-table (on a table, without masks): photographs of a built-in object are
made first. The JSON line can be put beside that of train.py: both hold out every
eighth photograph of the same capture at the same size. `seconds` covers reading, training and
judging, `train_seconds` leaves out reading and judging.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

# Threads that spin at their barriers cost ten times the work itself on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

import gsfluent as gf
from gsfluent import demo
from gsfluent.data import Capture
from gsfluent.errors import GsfluentError
from gsfluent.pipeline.reconstruct.evaluate import write_report


def opened(options: argparse.Namespace, scratch: str) -> tuple[str, Capture]:
    """The capture asked for, and its name."""
    if not options.capture.startswith("demo:"):
        folder = Path(options.capture)
        return folder.name, gf.load_capture(folder)
    name, _, support = options.capture.removeprefix("demo:").partition("-")
    demo.make_capture(
        name,
        scratch,
        views=options.demo_views,
        size=options.demo_size,
        support=support or "none",
        masks=not support,
    )
    return options.capture, gf.load_capture(scratch)


def stage_of(options: argparse.Namespace) -> gf.pipeline.Reconstruct:
    """The stage as the options want it."""
    return gf.pipeline.Reconstruct(
        options.iterations,
        options.max_gaussians,
        options.kernel,
        options.scale_regularization,
        options.image_size,
        sh_degree=options.sh_degree,
        start_gaussians=options.start_gaussians,
        gradient_threshold=options.gradient_threshold,
        absgrad=options.absgrad,
        recipe=options.preset,
        densify=options.densify,
        target_psnr=options.target_psnr,
        exposure=options.exposure,
        checkpoint=options.checkpoint,
        separate=not options.whole_scene,
        clean=not options.no_clean,
        device=options.device,
        seed=options.seed,
    )


def parsed(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("capture", help="folder with photographs, or demo:NAME")
    add("-o", "--out", type=Path, help="write the splats here (.ply)")
    add("--report", type=Path, help="folder for reconstruct.json, .md, .png (held-out views)")
    add("--iterations", type=int, default=800)
    add("--image-size", type=int, help="longer side while training and judging [px]")
    add("--preset", default="auto", help="auto, quick, long or classic (Kerbl et al. 2023)")
    add("--densify", default="adc", help="adc or mcmc")
    add("--sh-degree", type=int, default=0, help="bands of view-dependent colour, 0 to 3")
    add("--whole-scene", action="store_true", help="do not learn the object apart")
    add("--no-clean", action="store_true", help="leave floaters in the object")
    add("--isolate", action="store_true", help="write only the object")
    add("--max-gaussians", type=int, help="cap, and the budget of mcmc")
    add("--start-gaussians", type=int)
    add("--gradient-threshold", type=float)
    add("--absgrad", action=argparse.BooleanOptionalAction, help="sum of absolute gradients")
    add("--target-psnr", type=float, help="enough on the training photographs [dB]")
    add("--exposure", action="store_true", help="learn an affine colour change per photograph")
    add("--kernel", default="anisotropic", help="anisotropic or isotropic")
    add("--scale-regularization", type=float, help="1 for objects, 0 for scenes when not given")
    add("--checkpoint", type=Path, help="save to and resume from this file")
    add("--device", default="cpu", help="cpu or cuda")
    add("--seed", type=int, default=0)
    add("--demo-views", type=int, default=60)
    add("--demo-size", type=int, default=200)
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> int:
    options = parsed(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with tempfile.TemporaryDirectory() as scratch:
        name, capture = opened(options, scratch)
        stage = stage_of(options)

        def show(done: int, total: int, note: str) -> None:
            if done % 500 == 0 or done == total:
                sys.stderr.write(f"{done}/{total} {note}\n")

        gaussians = stage(capture, progress=show)
        report = gaussians.report
        if options.report is not None:
            write_report(options.report, gaussians, capture)
    if options.out is not None:
        if options.isolate:
            gaussians = gf.pipeline.Isolate()(gaussians, capture)
        gf.save(gaussians, options.out)
    line: dict[str, Any] = {
        "capture": name,
        "trainer": f"gsfluent {report['recipe']} {report['densify']}",
        "iterations": report["iterations"],
        "gaussians": report["gaussians"],
        "psnr": report["psnr"],
        "ssim": report["ssim"],
        "seconds": report["seconds"],
        "train_seconds": report["train_seconds"],
        "image_size": report["image_size"],
        "held_out": report["held_out"],
        "psnr_views": report.get("psnr_views"),
        "region": report["psnr_region"],
        "train_psnr": report["history"][-1][2] if report["history"] else None,
        "device": torch.cuda.get_device_name() if stage.device.type == "cuda" else "cpu",
    }
    sys.stdout.write(json.dumps(line) + "\n")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except GsfluentError as error:
        sys.exit(f"error: {error}")
