"""Accuracy of ops.mvee_lens over families of pairs, entered into docs/measured/mvee.md.

`outside`: how far the overlap reaches out of the result at worst, over 4000 rays and the points of
a dense search, relative to the result's size (negative: inside). `volume`: smallest and largest
ratio to the float64 optimum found by dense sampling (ops/reference/mvee_dense.py), over the pairs
where that sampling itself converged to 5e-4. `ms`: CPU milliseconds per thousand pairs.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch
from speed import family, reach, volume

from gsfluent import ops
from gsfluent.figure.markdown import enter
from gsfluent.ops.reference import mvee as reference
from gsfluent.ops.reference.mvee_dense import mvee_lens_dense

FAMILIES = ("ratio 4", "ratio 40", "thin", "near balls")


def row(name: str, pairs: int, dense: int, dtype: torch.dtype) -> str:
    """One line of the table."""
    stored = tuple(t.to(dtype) for t in family(name, pairs))
    wide = tuple(t.double() for t in stored)
    begin = time.process_time()
    mean, cov, overlap = ops.mvee_lens(*stored)
    spent = time.process_time() - begin
    points, _ = reference.lens_points(*wide, radius=2.0, count=4000)
    outside = reach(points[overlap], mean[overlap], 4.0 * cov[overlap]) - 1.0
    _, shape, excess, met = mvee_lens_dense(*(t[:dense] for t in wide))
    tight = excess < 5e-4
    ratio = volume(4.0 * cov[:dense])[tight] / volume(shape)[tight]
    far = (reach(met, mean[:dense], 4.0 * cov[:dense]) - 1.0).max()
    return (
        f"| {name} | {str(dtype)[6:]} | {pairs} | {max(float(outside.max()), float(far)):.1e} | "
        f"{int(tight.sum())} of {dense} | {float(ratio.min()):.5f} to {float(ratio.max()):.5f} | "
        f"{1e6 * spent / pairs:.0f} |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pairs", type=int, default=500, help="pairs per family")
    parser.add_argument("--dense", type=int, default=12, help="of them with a dense optimum")
    parser.add_argument("--page", type=Path, help="enter the table here (default: print)")
    args = parser.parse_args()
    lines = [
        "| pairs | type | number | outside | dense optimum of | volume | ms per 1000 |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        row(name, args.pairs, args.dense, dtype)
        for name in FAMILIES
        for dtype in (torch.float32, torch.float64)
    ]
    table = "\n".join(lines)
    if args.page is None:
        sys.stdout.write(table + "\n")
    else:
        args.page.write_text(enter(args.page.read_text(), "mvee accuracy", table))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
