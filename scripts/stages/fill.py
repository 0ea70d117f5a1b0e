"""Splats to a textured solid, in Python: the Fill and Texture stages.

python scripts/stages/fill.py MODEL.ply SOLID.ply [CUT.jpg]
"""

from __future__ import annotations

import sys

import gsfluent as gf


def main(model: str, out: str, exemplar: str | None = None) -> None:
    solid = gf.pipeline.Fill()(gf.load(model))
    method = {"method": "exemplar", "exemplar": exemplar} if exemplar else {}
    solid = gf.pipeline.Texture(**method)(solid)
    gf.save(solid, out)
    sys.stdout.write(f"{solid.gaussians.count} Gaussians, {solid.report}: {out}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
