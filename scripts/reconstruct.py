"""Photographs to splats, in Python: the Reconstruct and Isolate stages. `gsfluent reconstruct` does
the same with checks.

    python scripts/reconstruct.py CAPTURE OUT.ply
"""

from __future__ import annotations

import sys

import gsfluent as gf


def main(capture_folder: str, out: str) -> None:
    capture = gf.load_capture(capture_folder)
    gaussians, report = gf.pipeline.Reconstruct()(capture)
    thing = gf.pipeline.Isolate()(gaussians, capture)
    thing.save(out)
    sys.stdout.write(f"{thing.count} Gaussians, held-out PSNR {report['psnr']:.2f} dB: {out}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
