"""How much of a wetted ball a liquid leaves uncovered, frame by frame, from finished runs.

    python scripts/accuracy/liquids.py RUN [RUN ...] [--name NAME ...]
        [--json docs/measured/data/liquids.jsonl] [--page docs/measured/liquids.md]

The ball is the first body of the run, the liquid the bodies of a fluid. Points of the
liquid that lie at most four spacings above the ball wet it: the directions to them from its middle,
dilated by four spacings and eroded by as much, so that gaps narrower than eight are closed and the
front is where the outermost points are. A wetted direction is uncovered where the splats let more
than half of a ray to the middle through: the splats of the run, and balls, one round splat of 0.6
spacings a point, on the same motion. Of every run the frames count in which a twentieth of the ball
is wet.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials
from gsfluent.figure.markdown import enter
from gsfluent.geometry import quaternion_to_matrix
from gsfluent.pipeline.liquid.sheet import CLOSED, Ellipsoids
from gsfluent.results.frames import SavedFrame, count_frames, load_frame
from gsfluent.spatial.neighbours import nearest_rows

DIRECTIONS = 10_000
ABOVE = 4.0
GAP = 4.0
LEAST = 0.05
"""Share of the ball that must be wet before a frame counts."""
_SPLATS = 48


def directions(count: int) -> Tensor:
    """Even directions, float64 [count, 3]."""
    row = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1.0 - 2.0 * row / count
    angle = row * (math.pi * (3.0 - math.sqrt(5.0)))
    ring = (1.0 - height**2).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)


def within(places: Tensor, queries: Tensor, reach: float) -> Tensor:
    """Which queries [M, 3] have a place [N, 3] within reach, bool [M]."""
    if places.shape[0] == 0:
        return torch.zeros(queries.shape[0], dtype=torch.bool)
    return nearest_rows(places, queries, 1, reach)[0][:, 0] < reach


def wetted(way: Tensor, touched: Tensor, gap: float) -> Tensor:
    """Directions [M, 3] among touched ones [N, 3]: dilated, eroded by ``gap`` [rad], bool [M]."""
    wide = within(touched, way, gap)
    return wide & ~within(way[~wide], way, gap)


def cover(way: Tensor, middle: Tensor, drawn: Ellipsoids, opacity: float) -> Tensor:
    """Opacity of splats on the ray from outside to the middle, float64 [M]."""
    arm = drawn.means.double() - middle
    far = arm.norm(dim=1, keepdim=True)
    size = float((drawn.scales[:, 0] / far[:, 0]).mean())
    _, index = nearest_rows(arm / far, way, min(_SPLATS, far.shape[0]), size)
    turn = quaternion_to_matrix(drawn.quats.double())[index]
    thin = 1.0 / drawn.scales.double()[index]
    # In the splat's own units: the line through the middle along the way, and its nearest point.
    start = torch.einsum("mkij,mki->mkj", turn, -arm[index]) * thin
    along = torch.einsum("mkij,mi->mkj", turn, way) * thin
    closest = (start * along).sum(2) / along.square().sum(2)
    left = start - closest[..., None] * along
    alpha = opacity * torch.exp(-0.5 * left.square().sum(2)) * (closest < 0.0)
    return 1.0 - (1.0 - alpha).prod(dim=1)


def figures(frame: SavedFrame) -> dict[str, float]:
    """Wetted share of the ball, and what of it is uncovered, drawn in both ways."""
    flows = [
        number
        for number, (_, preset) in enumerate(frame.facts["bodies"])
        if preset in materials.names() and materials.get(preset).law == "fluid"
    ]
    solid = frame.positions[frame.body == 0].double()
    middle = solid.mean(dim=0)
    radius = float((solid - middle).norm(dim=1).quantile(0.999))
    liquid = torch.isin(frame.body, torch.tensor(flows, dtype=frame.body.dtype))
    place, volume = frame.positions[liquid], frame.volumes[liquid]
    spacing = float(volume.double().pow(1.0 / 3.0).mean())
    arm = place.double() - middle
    far = arm.norm(dim=1)
    near = far < radius + ABOVE * spacing
    way = directions(DIRECTIONS)
    wet = wetted(way, arm[near] / far[near, None], GAP * spacing / radius)
    found = {
        "time": frame.time,
        "wetted": float(wet.double().mean()),
        "litres": 1e3 * float(volume.double().sum()),
    }
    if not bool(wet.any()):
        return found | {"balls": 0.0, "drawn": 0.0}
    mine = torch.isin(frame.anchor.long(), liquid.nonzero()[:, 0]) & (frame.ids < 0)
    splats = frame.gaussians.select(mine)
    shown = Ellipsoids(splats.means, splats.quats, splats.scales, splats.scales, splats.scales)
    edge = CLOSED * volume.pow(1.0 / 3.0)
    still = place.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(place.shape[0], 4)
    balls = Ellipsoids(place, still, edge[:, None].expand(-1, 3), place, place)
    for name, drawn in (("balls", balls), ("drawn", shown)):
        seen = (drawn.means.double() - middle).norm(dim=1) < radius + 2.0 * ABOVE * spacing
        kept = Ellipsoids(*(part[seen] for part in drawn))
        dark = cover(way[wet], middle, kept, 0.95)
        found[name] = float((dark < 0.5).double().mean())
    return found


def measured(run: Path, name: str) -> dict[str, Any]:
    """The line of one run."""
    folder = run / "stages" / "simulate"
    rows = [figures(load_frame(folder, index)) for index in range(count_frames(folder))]
    wet = [row for row in rows if row["wetted"] > LEAST]
    litres = [row["litres"] for row in rows]
    report = json.loads((run / "run.json").read_text(encoding="utf-8"))["simulation"]

    def of(key: str) -> dict[str, float]:
        values = [row[key] for row in wet] or [0.0]
        return {"mean": sum(values) / len(values), "worst": max(values)}

    return {
        "name": name,
        "frames": len(wet),
        "wetted": max(row["wetted"] for row in rows),
        "balls": of("balls"),
        "drawn": of("drawn"),
        "litres": litres[0],
        "litres_change": max(litres) - min(litres),
        "momentum_error": report["momentum_error"],
        "seconds": report["seconds"],
        "points": report["particles"],
    }


def table(lines: list[dict[str, Any]]) -> str:
    """The table of the page."""
    head = (
        "| run | frames | wetted, most | uncovered as balls: mean, worst | "
        "uncovered as drawn: mean, worst | litres, change | momentum error | simulation |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- |\n"
    )
    rows = []
    for line in lines:
        shares = [
            f"{100 * line[key]['mean']:.2f} %, {100 * line[key]['worst']:.2f} %"
            for key in ("balls", "drawn")
        ]
        rows.append(
            f"| {line['name']} | {line['frames']} | {100 * line['wetted']:.0f} % | {shares[0]} | "
            f"{shares[1]} | {line['litres']:.4f}, {line['litres_change']:.1g} | "
            f"{line['momentum_error']:.1g} | {line['seconds']:.0f} s |"
        )
    return head + "\n".join(rows)


def main(argv: list[str] | None = None) -> None:
    """Measure runs, keep their lines, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--name", action="append", default=[], help="of each run, in order")
    parser.add_argument("--json", type=Path, help="lines of runs, one of each name")
    parser.add_argument("--page", type=Path, help="page that gets the table")
    given = parser.parse_args(argv)
    names = [*given.name, *(run.name for run in given.runs[len(given.name) :])]
    lines: dict[str, dict[str, Any]] = {}
    if given.json is not None and given.json.is_file():
        old = given.json.read_text(encoding="utf-8").splitlines()
        lines = {line["name"]: line for line in map(json.loads, old)}
    for run, name in zip(given.runs, names, strict=True):
        lines[name] = measured(run, name)
        print(json.dumps(lines[name]))
    if given.json is not None:
        text = "".join(json.dumps(line) + "\n" for line in lines.values())
        given.json.write_text(text, encoding="utf-8")
    if given.page is not None:
        page = given.page.read_text(encoding="utf-8")
        page = enter(page, "liquids", table(list(lines.values())))
        given.page.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
