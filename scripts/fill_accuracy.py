"""Fill every mesh of the data folder after photographing and reconstructing it; docs/filling.md.

    python scripts/fill_accuracy.py --cache out/fill [--only bowl skull] [--write]

The meshes come from GSFLUENT_DATA, or ../shared/data beside the checkout. Photographs and splats
are kept in the cache folder and made only once; --device cuda and more --views, --size, --steps
make them better. --things makes or reads a file of the meshes, for a machine without the folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch
from mesh_captures import DATA, Thing, capture_of, load_splats, pack, save_splats, things, unpack

from gsfluent.data import Capture, Gaussians
from gsfluent.pipeline import Reconstruct


def reconstructed(
    thing: Thing, cache: Path, given: argparse.Namespace
) -> tuple[Gaussians, Capture, float]:
    """The splats of a thing, its photographs, and CPU seconds it took (0 when kept)."""
    name = thing.name.replace(" ", "_")
    capture = capture_of(thing, cache / name, given.views, given.size, given.device)
    path = cache / f"{name}.npz"
    if path.is_file():
        return load_splats(path), capture, 0.0
    began = time.process_time()
    stage = Reconstruct(given.steps, given.splats, image_size=given.size, device=given.device)
    gaussians, report = stage(capture)
    save_splats(gaussians, path)
    sys.stderr.write(f"{name}: {gaussians.count} splats, {report['psnr']:.2f} dB\n")
    return load_splats(path), capture, time.process_time() - began


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", type=Path, required=True, help="folder of photographs, splats")
    parser.add_argument("--only", nargs="*", default=None, help="names, or how they begin")
    parser.add_argument("--views", type=int, default=96)
    parser.add_argument("--size", type=int, default=640, help="side of a photograph [px]")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--splats", type=int, default=100_000, help="at most")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--things", type=Path, default=None, help=".npz of the meshes")
    parser.add_argument("--reconstruct", action="store_true", help="stop before filling")
    given = parser.parse_args()
    if given.things is not None and given.things.is_file():
        found = unpack(given.things, given.only)
    else:
        found = things(given.only)
        if given.things is not None:
            pack(given.things, found)
    if not found:
        sys.stderr.write(f"no meshes in {DATA}: set GSFLUENT_DATA\n")
        return 0
    for thing in found:
        reconstructed(thing, given.cache, given)
    return 0


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
