"""What breaks, against the node spacing: dropped and torn bodies, and statistics of fragments.

    python scripts/study/fracture_resolution.py [--device cuda] [--only drop,seeds] [--estimate]
    python scripts/study/fracture_resolution.py --page          # tables and picture from the lines

Every run is a line of docs/measured/data/fracture_resolution.jsonl; what is there is not run again.
Afterwards the tables of docs/measured/fracture_resolution.md and the picture
docs/images/fracture_resolution.png are made anew. Sizes are options; ``--estimate`` says how much
work they are, ``--quick`` takes the smallest.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rows import Row, add_law, append, law_of, numbers, preset_of, read, table
from torch import Tensor

from gsfluent import ops
from gsfluent.data import SURFACE, Frame, Gaussians, Solid
from gsfluent.figure.markdown import enter
from gsfluent.figure.style import COLORS, OURS, new_figure, save_png
from gsfluent.fracturebench.registry import Case
from gsfluent.fracturebench.scene import Scene as BenchScene
from gsfluent.fracturebench.scenes.rows import shape_noise
from gsfluent.fracturebench.scenes.shatter import lattice_ball
from gsfluent.fracturebench.shapes import free, plane
from gsfluent.fracturebench.statistics import MEASURES, Figures, distance, ensemble
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.charts.record import commit, machine
from gsfluent.lab.frozen.answer import run_case
from gsfluent.materials import Material
from gsfluent.pipeline.matter.brittle import brittle_rows
from gsfluent.pipeline.matter.crack_band import BAND_CELLS
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.scene.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
LINES = ROOT / "docs" / "measured" / "data" / "fracture_resolution.jsonl"
PAGE = ROOT / "docs" / "measured" / "fracture_resolution.md"
PICTURE = ROOT / "docs" / "images" / "fracture_resolution.png"
GRAVITY = 9.81
VOXELS = 128  # along the longest edge: finer than what is told apart here
PARTS = ("drop", "balls", "seeds", "loose", "bench")


# --- bodies ---


def solid(half: Sequence[float], inside: Callable[[Tensor], Tensor]) -> Solid:
    """A body around the origin, without a look of its own.

    Args:
        half: Half of its edges [m], [3].
        inside: Which places, [..., 3] in units of ``half``, are matter.
    """
    edge = torch.tensor(half, dtype=torch.float32)
    voxel = float(2.0 * edge.max()) / VOXELS
    counts = torch.ceil(2.0 * edge / voxel).to(torch.int64) + 2
    origin = -0.5 * counts * voxel
    axes = [origin[d] + (torch.arange(int(counts[d])) + 0.5) * voxel for d in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1) / edge
    matter = inside(grid) & (grid.abs() <= 1.0).all(dim=-1)
    # Depth is that of an ellipsoid: only the melon has parts that go by it.
    depth = ((1.0 - grid.norm(dim=-1)) * edge.min()).clamp(min=0.0)
    color = torch.full((*matter.shape, 3), 0.5)
    splats = Gaussians.from_colors(
        torch.zeros(8, 3), torch.full((8, 3), voxel), torch.full((8, 3), 0.5), opacities=0.9
    )
    splats = splats.replace(labels=torch.full((8,), SURFACE, dtype=torch.int32))
    return Solid(splats, matter, depth, origin, voxel, color, None, {}, None)


def ball(place: Tensor) -> Tensor:
    """An ellipsoid."""
    return place.norm(dim=-1) <= 1.0


def disc(place: Tensor) -> Tensor:
    """A cylinder along y."""
    return place[..., [0, 2]].norm(dim=-1) <= 1.0


def notched(place: Tensor) -> Tensor:
    """A bar along y with a notch around its middle, a quarter of its thickness deep."""
    deep = place[..., [0, 2]].abs().amax(dim=-1) > 0.5
    return ~(deep & (place[..., 1].abs() < 0.05))


@dataclasses.dataclass(frozen=True)
class Trial:
    """A scene that can be run at any resolution."""

    material: str
    half: tuple[float, float, float]  # half of the edges of the body [m]
    seconds: float  # after it was touched
    height: float = 0.0  # it falls from [m]
    shape: Callable[[Tensor], Tensor] = ball
    grips: float = 0.0  # speed at which its ends are pulled apart [m/s]
    plates: float = 0.0  # speed at which it is pressed onto the floor [m/s]
    law: str = ""  # by which it breaks; that of its preset when empty

    def scene(self) -> Scene:
        """The scene; the body touches the floor when it falls or is pressed."""
        made = Scene(floor=0.0)
        up = self.half[2] if not self.grips else 4.0 * self.half[2]
        frame = Frame(torch.eye(3), torch.tensor([0.0, 0.0, up]), 1.0)
        made.add(solid(self.half, self.shape), self.matter, frame=frame)
        if self.height:
            made.add_event({"type": "drop", "height": self.height})
        if self.plates:
            made.press(self.plates, self.plates * self.seconds, (0.0, 0.0, -1.0))
        for side in (-1.0, 1.0) if self.grips else ():
            made.add_collider(
                "box", at=(0.0, side * self.half[1], up), mode="sticky",
                size=(4.0 * self.half[0], 0.5 * self.half[1], 4.0 * self.half[2]),
                velocity=(0.0, side * self.grips, 0.0),
            )  # fmt: skip
        return made

    @property
    def matter(self) -> Material:
        """What it is made of."""
        return preset_of(self.material, self.law)

    @property
    def begins(self) -> float:
        """When it lands, or 0 [s]."""
        return math.sqrt(2.0 * self.height / GRAVITY)

    def work(self, cells: int) -> tuple[float, float]:
        """Points and steps of a run, about."""
        sizes = np.array(self.half) / max(self.half)
        share = math.pi / 6.0 if self.shape is ball else 1.0
        points = 8.0 * share * float(sizes.prod()) * cells**3
        dx = 2.0 * max(self.half) / cells
        return points, self.seconds * 2.5 * self.matter.wave_speed / dx


MELON = Trial("fruit.watermelon", (0.125, 0.125, 0.115), 0.2, height=0.75)
DROPS = {  # cracked, but whole; and in pieces
    "watermelon": MELON,
    "watermelon, 3 m": dataclasses.replace(MELON, height=3.0),
}
BALLS = {  # a ball of bread does not break, from wherever it falls: it is torn below
    "glass": Trial("glass", (0.03, 0.03, 0.03), 0.01, height=4.0),
}
LOOSE = {
    "bread torn": Trial("bread", (0.05, 0.14, 0.05), 0.2, grips=0.3),
    "notched bar": Trial("chocolate", (0.02, 0.08, 0.02), 0.1, shape=notched, grips=0.2),
    "Brazilian disc": Trial("plaster", (0.05, 0.02, 0.05), 0.1, shape=disc, plates=0.1),
}


def link_area(links: Tensor, rest: Tensor, volume: float) -> float:
    """Area that one cut link stands for [m^2].

    A plane of normal m is crossed by ``sum |d . m| / V`` links per area, d their vectors; over all
    directions of m the mean of ``|d . m|`` is ``|d| / 2``. On a cubic lattice this is 1 / 5.74 of
    h^2; for planes along the lattice 1 / 5 would be right.
    """
    length = (rest[links[:, 0]] - rest[links[:, 1]]).double().norm(dim=1)
    return volume / float(0.5 * length.sum())


def run_trial(trial: Trial, cells: int, seed: int, device: str) -> Row:
    """Run a trial and measure it."""
    begun = time.perf_counter()
    sim = Simulate(
        dx=2.0 * max(trial.half) / cells, seed=seed, repair=False, splats=False, device=device
    )
    steps = sim(trial.scene(), fps=100.0, seconds=trial.begins + trial.seconds + 0.011)
    frame = next(steps)  # there is always a first one
    for later in steps:
        frame = later
    report, run = steps.report, steps.run
    matter = run.matter
    volume = float(matter.particles.volume.double().sum())
    labels, (a, b) = frame.fragments, run.links.unbind(dim=1)
    between = (labels[a] != labels[b]) & (labels[a] >= 0) & (labels[b] >= 0)
    area = int(between.sum()) * link_area(run.links, matter.rest, volume)
    per_frame = report["per_frame"]
    shares = frame.pieces.mass_fractions
    energy = float(trial.matter.fracture_energy or math.nan)
    broken = float(per_frame["broken_fraction"][-1])
    start = per_frame["kinetic"][0] + per_frame["gravity"][0] + per_frame["elastic"][0]
    return {
        "dx": matter.dx, "points": matter.particles.count, "steps": report["substeps"],
        "seconds": round(report["seconds"], 2), "wall": round(time.perf_counter() - begun, 2),
        "verdict": report["verdict"], "loose": float(per_frame["loose_fraction"][-1]),
        "pieces": frame.pieces.count, "pieces_over_1_percent": int((shares > 0.01).sum()),
        "largest": float(shares[0]) if len(shares) else 0.0, "broken": broken,
        "broken_volume": broken * volume, "area": area,
        # grips and plates do work, which is not counted
        "energy": per_frame["dissipated"][-1] / (area * energy) if area and trial.height else None,
        "band": broken * volume / (area * matter.dx) if area else None,
        "dissipated": per_frame["dissipated"][-1], "at_start": start,
        "blocks": max(per_frame["active_blocks"]), "blocks_max": report["active_blocks_max"],
        "blocks_intact": ops.build_blocks(matter.rest, matter.dx).coords.shape[0],
    }  # fmt: skip


# --- statistics of fragments ---

THROWN = {"watermelon": "fruit.watermelon", "chocolate": "chocolate", "glass": "glass"}
SPEED = 5.0
"""Of the thrown ball, over the one at which its material breaks."""
_SCATTER, _LEVELS = 0.3, 16


def thrown(
    name: str, radius: float, dx: float, per_cell: int, speed: float = SPEED, *, law: str = ""
) -> BenchScene:  # fmt: skip
    """A ball of a preset, of scattered strength, thrown on a plane.

    Args:
        name: Of :data:`THROWN`, or of a brittle preset.
        radius: [m].
        dx: Node spacing [m].
        per_cell: Points per cell.
        speed: Over the one at which the material breaks; a quarter of its wave speed at most.
        law: By which it breaks; that of its preset when empty.
    """
    preset = preset_of(THROWN.get(name, name), law)
    points = lattice_ball(radius, dx, per_cell)
    factor = np.clip(1.0 + _SCATTER * shape_noise(points, 0.8 * radius, 3), 0.4, 1.6)
    low, high = float(factor.min()), float(factor.max())
    edge = (high - low) / _LEVELS
    index = np.minimum((factor - low) / edge, _LEVELS - 1).astype(np.int32)
    weakness = torch.from_numpy(low + edge * (np.arange(_LEVELS) + 0.5))

    def everywhere(value: float | Tensor) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64).expand(_LEVELS)

    table, alpha = brittle_rows(preset, everywhere, weakness, dx)
    young, poisson, density = (
        float(torch.as_tensor(value).mean())
        for value in (preset.young_modulus, preset.poisson_ratio, preset.density)
    )
    rows = tuple(
        {
            "law": "nacc", "young_modulus": young,
            "poisson_ratio": poisson, "density": density,
            "friction": float(row[2]), "cohesion": float(row[3]), "hardening": float(row[4]),
            "shear_damage": float(row[5]), "alpha": float(start),
        }
        for row, start in zip(table, alpha, strict=True)
    )  # fmt: skip
    c = preset.wave_speed
    fall = min(0.25, speed * preset.failure_strain) * c
    return free(
        f"thrown {name}", points, [0.0, 0.0, -fall], dx, per_cell,
        np.linspace(0.0, 30.0 * radius / c, 21)[1:], rows, material=index,
        asks=("stress",), colliders=(plane(2, -radius, kind="separate", friction=0.3),),
    )  # fmt: skip


RADII = {"watermelon": 0.12, "chocolate": 0.03, "glass": 0.03}


def run_bench(name: str, cells: int, seeds: int, device: str, law: str = "") -> Row:
    """An ensemble of throws on shifted grids."""
    radius = RADII[name]
    build = partial(thrown, name, radius, law=law)
    case = Case(f"thrown {name}", "fracture", "", radius / cells, build, lambda *_: (), ())
    begun = time.perf_counter()
    player = partial(run_case, device=device, cfl=0.5, dtype=torch.float32)
    members = ensemble(case, radius / cells, 8, range(seeds), player)
    return {
        "dx": radius / cells, "points": members[0].scene.count,
        "steps": sum(m.run.steps for m in members), "wall": round(time.perf_counter() - begun, 2),
        "seconds": round(sum(m.run.wall_seconds for m in members), 2),
        "runs": [m.figures.plain() for m in members],
    }  # fmt: skip


# --- lines ---


@dataclasses.dataclass(frozen=True)
class Job:
    """One line to be: what it is known by, its work, and how it is made."""

    key: Row
    points: float
    steps: float
    make: Callable[[], Row]


def jobs(args: argparse.Namespace) -> list[Job]:
    """All that is asked for, cheap ones first within a part."""
    found: list[Job] = []

    def trial(part: str, name: str, one: Trial, cells: int, seed: int = 0) -> None:
        one = dataclasses.replace(one, law=args.law)
        key = {"part": part, "name": name, "law": law_of(one.matter), "cells": cells, "seed": seed}
        points, steps = one.work(cells)
        found.append(Job(key, points, steps, partial(run_trial, one, cells, seed, args.device)))

    only = args.only.split(",") if args.only else list(PARTS)
    if unknown := set(only) - set(PARTS):
        raise SystemExit(f"--only: unknown {', '.join(sorted(unknown))}; {', '.join(PARTS)}")
    if "drop" in only:
        for name, one in DROPS.items():
            for cells in args.cells:
                trial("drop", name, one, cells)
    if "balls" in only:
        for name, one in BALLS.items():
            for cells in args.ball_cells:
                trial("balls", name, one, cells)
    if "seeds" in only:  # seed 0 is that of part "drop"
        for cells in args.seed_cells:
            for seed in range("drop" in only and cells in args.cells, args.seeds):
                trial("drop", "watermelon, 3 m", DROPS["watermelon, 3 m"], cells, seed)
    if "loose" in only:
        for name, one in LOOSE.items():
            for cells in args.ball_cells if name == "bread torn" else args.loose_cells:
                trial("loose", name, one, cells)
    if "bench" in only:
        for name in THROWN:
            for cells in args.bench_cells:
                key = {
                    "part": "bench", "name": name, "law": law_of(preset_of(THROWN[name], args.law)),
                    "cells": cells, "seeds": args.bench_seeds,
                }  # fmt: skip
                points = 8.0 * 4.0 / 3.0 * math.pi * cells**3
                make = partial(run_bench, name, cells, args.bench_seeds, args.device, args.law)
                found.append(Job(key, points, 80.0 * cells * args.bench_seeds, make))
    return found


def known(row: Row, key: Row) -> bool:
    """Whether a line is of a job."""
    return all(row.get(k) == v for k, v in key.items())


def run_all(todo: Sequence[Job], out: Path, device: str) -> None:
    """Run what is not there yet, one line each."""
    rows = [r for r in read(out) if r.get("device") == device]
    for number, job in enumerate(todo, 1):
        name = " ".join(f"{k}={v}" for k, v in job.key.items())
        if any(known(row, job.key) for row in rows):
            sys.stderr.write(f"{number}/{len(todo)} {name}: there\n")
            continue
        sys.stderr.write(f"{number}/{len(todo)} {name}\n")
        row = {
            **job.key, "device": device, "machine": machine(device), "commit": commit(),
            "band_cells": BAND_CELLS, **job.make(),
        }  # fmt: skip
        shown = {k: v for k, v in row.items() if k not in ("runs", "machine", "commit")}
        sys.stderr.write(f"    {json.dumps(shown)}\n")
        append(out, row)


# --- page ---


def exponent(rows: Sequence[Row], what: str) -> float:
    """Least-squares exponent of a figure over dx; NaN where there are not two of it."""
    pairs = [(r["dx"], r[what]) for r in rows if r[what]]
    if len(pairs) < 2:
        return math.nan
    x, y = np.log(np.array(pairs)).T
    return float(((x - x.mean()) * (y - y.mean())).sum() / ((x - x.mean()) ** 2).sum())


def percent(value: float) -> str:
    """A share in per cent."""
    return f"{100.0 * value:.2g} %"


def ratio(value: float | None) -> str:
    """A ratio, or that there is none: nothing has parted."""
    return "-" if value is None else f"{value:.2f}"


_HEAD = (
    "body", "law", "cells", "points", "steps", "s", "loose", "pieces", "over 1 %", "largest",
    "broken", "energy lost / (A G_c)", "broken / (A dx)", "blocks / intact",
)  # fmt: skip


def line(row: Row) -> list[str]:
    """A run as a line of a table."""
    return [
        row["name"], row["law"], str(row["cells"]), str(row["points"]), str(row["steps"]),
        f"{row['seconds']:.1f}", percent(row["loose"]), str(row["pieces"]),
        str(row["pieces_over_1_percent"]), f"{row['largest']:.3f}", f"{row['broken']:.3f}",
        ratio(row["energy"]), ratio(row["band"]), f"{row['blocks'] / row['blocks_intact']:.2f}",
    ]  # fmt: skip


def exponents(rows: Sequence[Row]) -> str:
    """Broken volume over dx, for every body."""
    out = []
    for name, law in dict.fromkeys((r["name"], r["law"]) for r in rows):
        mine = sorted(
            (r for r in rows if (r["name"], r["law"]) == (name, law)), key=lambda r: r["cells"]
        )
        grids = ", ".join(str(r["cells"]) for r in mine)
        out.append((name, law, grids, f"{exponent(mine, 'broken_volume'):.2f}"))
    return table(("body", "law", "cells", "exponent of the broken volume over dx"), out)


def seeds_table(rows: Sequence[Row]) -> str:
    """Pieces over a hundredth of the mass, means over seeds."""
    out = []
    for law, cells in sorted({(r["law"], r["cells"]) for r in rows}):
        mine = [r for r in rows if (r["law"], r["cells"]) == (law, cells)]
        counts = np.array([r["pieces_over_1_percent"] for r in mine], dtype=float)
        largest = np.array([r["largest"] for r in mine])
        loose = np.array([r["loose"] for r in mine])
        out.append(
            (
                law, str(cells), str(len(mine)), f"{counts.mean():.2f}", f"{counts.std():.2f}",
                f"{largest.mean():.3f}", f"{largest.std():.3f}", percent(float(loose.mean())),
            )
        )  # fmt: skip
    head = ("law", "cells", "seeds", "pieces over 1 %", "+-", "largest", "+-", "loose")
    return table(head, out)


def ladder(rows: Sequence[Row], kind: tuple[str, str]) -> list[tuple[Row, list[Figures]]]:
    """The ensembles of a material and law, finest last."""
    mine = sorted((r for r in rows if (r["name"], r["law"]) == kind), key=lambda r: r["cells"])
    return [(r, [Figures.of_plain(p) for p in r["runs"]]) for r in mine]


def kinds(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Materials and laws, in the order of :data:`THROWN`."""
    laws = sorted({r["law"] for r in rows})
    return [(name, law) for name in THROWN for law in laws if ladder(rows, (name, law))]


def bench_table(rows: Sequence[Row]) -> str:
    """Distances of coarser grids from the finest."""
    out = []
    for kind in kinds(rows):
        steps = ladder(rows, kind)
        if not steps or len(steps[-1][1]) < 3:
            continue
        reference = steps[-1][1]
        for row, runs in steps:
            found = distance(reference, runs)
            last = row is steps[-1][0]
            cells = [f"band {found[m].band:.3f}" if last else str(found[m]) for m in MEASURES]
            count = float(np.median([(f.pieces > 0.01).sum() for f in runs]))
            out.append((*kind, f"R / {row['cells']}", *cells, f"{count:.0f}"))
    return table(("material", "law", "dx", *MEASURES, "pieces over 1 %"), out)


def draw(rows: Sequence[Row]) -> None:
    """Mass over pieces with the run-to-run band, and distances over dx, of every material."""
    names = [kind for kind in kinds(rows) if len(ladder(rows, kind)) > 1]
    if not names:
        return
    places = np.geomspace(1e-4, 1.0, 200)

    def below(f: Figures) -> Any:
        return np.array([f.pieces[f.pieces <= m].sum() for m in places])

    with new_figure(3.2 * len(names), 5.6) as figure:
        grid = figure.subplots(2, len(names), squeeze=False)
        for column, name in enumerate(names):
            steps = ladder(rows, name)
            row, reference = steps[-1]
            upper, lower = grid[0][column], grid[1][column]
            reach = np.array([below(f) for f in reference])
            upper.fill_between(places, reach.min(0), reach.max(0), color=OURS, alpha=0.35, lw=0,
                               label=f"R / {row['cells']}, {len(reference)} runs")  # fmt: skip
            for color, (other, runs) in zip(COLORS, steps[:-1], strict=False):
                upper.plot(places, np.median([below(f) for f in runs], axis=0), color=color,
                           lw=1.2, label=f"R / {other['cells']}")  # fmt: skip
            upper.set(
                title=", ".join(name).capitalize(),
                xscale="log",
                ylim=(0.0, 1.02),
                xlabel="mass of a piece over the whole",
                ylabel="mass in lighter pieces",
            )
            upper.legend()
            for color, measure in zip(COLORS, MEASURES, strict=False):
                at = [other["cells"] for other, _ in steps[:-1]]
                found = [distance(reference, runs)[measure] for _, runs in steps[:-1]]
                band = max(found[0].band, 1e-4)
                lower.plot(at, [d.value / band for d in found], "o-", color=color, lw=1.2, ms=3,
                           label=measure)  # fmt: skip
            lower.axhspan(0.0, 1.0, color=OURS, alpha=0.25, lw=0)
            lower.set(
                xlabel="cells along the radius", ylabel="distance over the band", yscale="log"
            )
            if column == 0:
                lower.legend()
        save_png(figure, PICTURE)


def page(lines: Path, device: str) -> int:
    """Enter the tables into the page and draw the picture, of the lines of a device."""
    rows = [row for row in read(lines) if row["device"] == device]
    if not rows:
        sys.stderr.write(f"{lines}: no lines of {device}; run without --page first\n")
        return 1

    def of(*parts: str) -> list[Row]:
        return sorted(
            (r for r in rows if r["part"] in parts), key=lambda r: (r["name"], r["law"], r["cells"])
        )

    text = PAGE.read_text(encoding="utf-8")
    machines = ", ".join(dict.fromkeys(f"{r['machine']} ({r['device']})" for r in rows))
    bands = ", ".join(f"{b:g}" for b in dict.fromkeys(r["band_cells"] for r in rows))
    entered = {"machine": f"Machine: {machines}. Band assumed: {bands} cells."}
    runs = [r for r in of("drop", "balls", "loose") if r["seed"] == 0]
    if runs:
        entered["runs"] = table(_HEAD, [line(r) for r in runs])
    if falls := [r for r in runs if r["part"] != "loose" or r["name"] == "bread torn"]:
        entered["exponents"] = exponents(falls)
    parted = [r for r in of("drop") if any(o["name"] == r["name"] and o.get("seed") for o in rows)]
    if parted:
        entered["seeds"] = seeds_table(parted)
    if bench := of("bench"):
        entered["bench"] = bench_table(bench)
        draw(bench)
    for name, part in entered.items():
        where = name if device == "cuda" else f"{name} {device}"
        text = enter(text, f"fracture resolution {where}", part)
    with atomic_path(PAGE) as file:
        file.write_text(text, encoding="utf-8")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, default=LINES)
    parser.add_argument("--only", default="", help=f"of {','.join(PARTS)}")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    add_law(parser)
    parser.add_argument("--cells", type=numbers, default=(20, 40, 80, 120))
    parser.add_argument("--ball-cells", type=numbers, default=(20, 32, 48, 64))
    parser.add_argument("--seed-cells", type=numbers, default=(20, 40, 80))
    parser.add_argument("--loose-cells", type=numbers, default=(20, 40))
    parser.add_argument("--bench-cells", type=numbers, default=(5, 7, 10, 14))
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--bench-seeds", type=int, default=6)
    parser.add_argument("--quick", action="store_true", help="smallest sizes")
    parser.add_argument("--estimate", action="store_true", help="say how much work it is")
    parser.add_argument("--page", action="store_true", help="only tables and picture")
    args = parser.parse_args(argv)
    if args.quick:
        args.cells = args.ball_cells = args.seed_cells = args.loose_cells = (12, 16)
        args.bench_cells, args.seeds, args.bench_seeds = (4, 5), 2, 3
    if args.page:
        return page(args.out, args.device)
    todo = jobs(args)
    work = 0.0
    for job in todo:
        work += job.points * job.steps
        name = " ".join(f"{k}={v}" for k, v in job.key.items())
        sys.stderr.write(f"{name}: about {job.points:.2g} points, {job.steps:.2g} steps\n")
    sys.stderr.write(
        f"{len(todo)} runs, {work:.3g} point steps: at 2e9 a second (H200) {work / 2e9:.0f} s, at "
        f"2e6 (one core) {work / 2e6:.0f} s; small runs take longer on a GPU, about 0.1 ms a step: "
        f"{sum(j.steps for j in todo) * 1e-4:.0f} s at least\n"
    )
    if args.estimate:
        return 0
    run_all(todo, args.out, args.device)
    return page(args.out, args.device) if args.out == LINES else 0


if __name__ == "__main__":
    sys.exit(main())
