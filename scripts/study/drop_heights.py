"""The height of a fall that breaks half of the specimens, against the literature.

python scripts/study/drop_heights.py --device cuda     # everything, renews the page
python scripts/study/drop_heights.py --quick --only plaster_ball apple    # two cores, minutes

All specimens of a call fall side by side in one scene, each at its own speed: first one from every
height of a ladder of factors of two, then all seeds around the height at which that one broke, in
steps of root two. A fall begins on the floor with the speed of the landing, and ends when all have
left the floor or broken. One JSON line per object and stiffness; what is there is not run again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time as clock
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from drop_shapes import Shape, ball, bowl, box, egg, solid, tumbler, turned
from rows import FIRST, add_law, law_of, preset_of

from gsfluent import materials, ops
from gsfluent.data import Frame, Particles, Solid
from gsfluent.figure.markdown import enter
from gsfluent.materials import Material
from gsfluent.pipeline import Simulate
from gsfluent.pipeline.matter.brittle import kept_strength
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.simulate.run import Run
from gsfluent.progress import reporter
from gsfluent.scene.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "docs" / "measured" / "data"
PAGE = ROOT / "docs" / "measured" / "drop_heights.md"
GRAVITY = 9.81
WHOLE = 0.95
"""Largest share of the mass in one piece of what counts as broken."""
CRUSHED = 0.5
"""Share of the mass that ever broke from which a specimen is broken, in however many pieces."""
HAIRLINE = 0.005
"""Share of an egg's shell or of a pane that ever broke from which it is cracked."""
PASSED = 0.01
"""Share of a fruit's matter above its middle that ever broke from which it is cracked."""
SHELL = 4.0
"""How many times thicker the shell of the egg is made; see :func:`thicker`."""
FRAME = 8.0
"""Thickness of a frame, and how far it reaches beyond its plate [cells]."""
LEAST = 6
"""Traversals that a fall lasts at least, and that a body has to lie still that does not rebound."""
Vector = tuple[float, float, float]
STIFFNESS = ("preset", "real")
LADDER = (0.25, 0.5, 1.0, 2.0, 4.0)
FURTHER = 3
"""Times that a ladder is carried on where all of it, or nothing, broke."""
STEP_POINTS = {"cpu": 5e5, "cuda": 2e9}
"""Points moved in a second, for the estimate of the work."""


@dataclasses.dataclass(frozen=True)
class Case:
    """An object, and how it is simulated.

    Attributes:
        name: Its name in the file of heights.
        shape: Its body, as it lands.
        cells: Cells across its wall or, where it is solid, across its longest side.
        limit: Longest time of a fall, in traversals of the longest side by the wave.
        hairline: Whether a crack is enough.
        fruit: Whether a crack that has passed the middle is enough.
        prefer: What a grid keeps that is too coarse for both; a height is a matter of strength.
        rabbet: Width of the ledge of a frame on which its edges lie [m], or None: it falls free.
    """

    name: str
    shape: Shape
    cells: float
    limit: float
    hairline: bool = False
    fruit: bool = False
    prefer: str = "toughness"
    rabbet: float | None = None

    def spacing(self, coarse: bool) -> float:
        """Node spacing [m]; ``coarse`` is half the cells."""
        across = self.shape.wall or 2.0 * max(self.shape.half)
        return across / (self.cells / 2 if coarse else self.cells)


def case_of(name: str, given: dict[str, Any]) -> Case:
    """The case of an entry of the file of heights."""
    if name.startswith("egg"):
        shell = egg(given["length_m"], given["diameter_m"], SHELL * given["wall_m"])
        lies = turned(shell, "y", 90.0) if name == "egg_on_side" else shell
        return Case(name, lies, 2.0, 40.0, hairline=True, prefer="strength")
    if name == "glass_plate_framed":
        return Case(
            name, box(tuple(given["size_m"])), 3.0, 40.0, hairline=True, prefer="strength",
            rabbet=given["rabbet_m"],
        )  # fmt: skip
    if name == "glass_tumbler":
        keys: tuple[str, ...] = ("diameter_m", "length_m", "wall_m", "base_m")
        return Case(
            name,
            turned(tumbler(*(given[k] for k in keys)), "y", 85.0),
            2.0,
            50.0,
            prefer="strength",
        )
    if name == "ceramic_bowl":
        keys = ("diameter_m", "height_of_bowl_m", "wall_m")
        return Case(
            name, turned(bowl(*(given[k] for k in keys)), "y", 90.0), 3.0, 50.0, prefer="strength"
        )
    if name == "bread":
        return Case(name, turned(box(tuple(given["size_m"])), "y", 5.0), 32.0, 40.0)
    fruit = given["preset"].startswith("fruit.")
    return Case(name, ball(given["diameter_m"]), 32.0, 40.0, fruit=fruit)


def number(field: float | torch.Tensor | None) -> float:
    """A field of a material that is the same everywhere."""
    return float(torch.as_tensor(field))


def thicker(material: Material, factor: float, mass: float, volume: float) -> Material:
    """A shell that is thicker than the real one and as stiff and strong under a load at a point.

    Its stiffness there goes as ``E h^2``, the stress as the load over ``h^2``, the energy of a
    crack as ``G h`` (Reissner 1946; thin shells). The inside has no grid: its mass is the shell's.
    """
    square = factor**2
    return material.override(
        young_modulus=number(material.young_modulus) / square, softening=material.softening,
        tensile_strength=number(material.tensile_strength) / square,
        compressive_strength=number(material.compressive_strength) / square,
        fracture_energy=number(material.fracture_energy) / factor,
        reference_volume=material.reference_volume * square, density=mass / volume,
    )  # fmt: skip


def stiff(material: Material, how: str) -> Material:
    """The material as the preset softens it, or as stiff as it is."""
    if how == "preset" or material.softening == 1.0:
        return material
    parts = tuple(
        {**part, "young_modulus": part["young_modulus"] * material.softening}
        if "young_modulus" in part else part
        for part in material.parts
    )  # fmt: skip
    return material.override(softening=1.0, parts=parts)


@dataclasses.dataclass(frozen=True)
class Fall:
    """What became of one specimen; speeds over that of the landing, energies over its."""

    height: float
    seed: int
    broken: bool
    parted: bool
    largest: float
    pieces: int
    ever: float
    above: float
    loose: float
    restitution: float
    shaking: float
    elastic: float
    left: bool


class Drop:
    """One object with one stiffness on one grid."""

    def __init__(
        self, case: Case, given: dict[str, Any], how: str, device: str, coarse: bool, law: str = ""
    ) -> None:
        self.case, self.device, self.how = case, device, how
        self.dx = case.spacing(coarse)
        self.body: Solid = solid(case.shape, 0.5 * self.dx)
        self.material = stiff(preset_of(given["preset"], law), how).override(prefer=case.prefer)
        if case.name.startswith("egg"):
            self.material = thicker(self.material, SHELL, given["mass_kg"], self.body.volume)
        self.points = round(8 * self.body.volume / self.dx**3)
        self.traversal = 2.0 * max(case.shape.half) / self.material.wave_speed
        self.falls: list[Fall] = []
        self._specimens: dict[int, Matter] = {}
        self.seconds = self.simulated = 0.0
        self.steps = self.calls = 0
        self.verdicts: list[str] = []

    def work(self, specimens: int) -> float:
        """Estimate of the seconds that so many specimens take."""
        steps = 2.0 * self.case.limit * 2.0 * max(self.case.shape.half) / self.dx
        kind = "cuda" if self.device.startswith("cuda") else "cpu"
        return 2.0 + 0.5 * steps * max(self.points * specimens / STEP_POINTS[kind], 1e-4)

    def fall(self, wanted: Iterable[tuple[float, int]], most: float) -> None:
        """Let specimens fall that have not yet; ``most`` points in a call."""
        done = {(f.height, f.seed) for f in self.falls}
        todo = [pair for pair in wanted if pair not in done]
        size = max(1, int(most / self.points))
        for i in range(0, len(todo), size):
            self._together(todo[i : i + size])

    def _add(self, scene: Scene, seed: int, place: Vector, velocity: Vector) -> None:
        # Strength is fixed in a body's own coordinates: another place there, another specimen.
        away = 40.0 * max(self.material.grain, 2.0 * self.dx) * seed
        shift = self.body.origin.new_tensor([away, 0.0, 0.0])
        frame = Frame(torch.eye(3), torch.tensor([place[0] - away, *place[1:]]), 1.0)
        scene.add(
            self.body.replace(origin=self.body.origin + shift), self.material,
            frame=frame, velocity=velocity,
        )  # fmt: skip

    def _ledges(self, scene: Scene, place: Vector) -> None:
        """The frame below the edges of a plate. It has stopped: the plate falls on into it."""
        width = self.case.rabbet
        if width is None:
            return
        half = [0.5 * n * self.body.voxel for n in self.body.occupancy.shape[:2]]
        beyond = deep = FRAME * self.dx
        for axis, across in ((0, 1), (1, 0)):
            size = [deep, deep, deep]
            size[axis], size[across] = width + beyond, 2.0 * (half[across] + beyond)
            for side in (-1.0, 1.0):
                at = [place[0], place[1], place[2] - 0.5 * deep]
                at[axis] += side * (half[axis] - width + 0.5 * size[axis])
                scene.add_collider("box", at=at, size=size)

    def _matter(self, places: list[Vector], speeds: list[float], seeds: list[int]) -> Matter:
        """The points of specimens, of which each strength field is made once."""
        for seed in set(seeds) - set(self._specimens):
            scene = Scene()
            self._add(scene, seed, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            stage = Simulate(dx=self.dx, device="cpu", splats=False)
            self._specimens[seed] = stage.prepare(scene)
        groups, laws, params, ranges, rows, done = [], [], [], [], 0, 0
        for i, (place, speed, seed) in enumerate(zip(places, speeds, seeds, strict=True)):
            one = self._specimens[seed]
            p = one.particles
            groups.append(p.replace(
                position=p.position + p.position.new_tensor(place),
                velocity=p.velocity - p.velocity.new_tensor([0.0, 0.0, speed]),
                body=torch.full_like(p.body, i), material=p.material + rows,
            ))  # fmt: skip
            laws.append(one.law)
            params.append(one.params)
            ranges.append((done, done + p.count))
            rows, done = rows + len(one.law), done + p.count
        return Matter(
            Particles.cat(groups).to(self.device), torch.cat(laws).to(self.device),
            torch.cat(params).to(self.device), tuple(ranges),
            tuple(self._specimens[seed].spacing[0] for seed in seeds), self.dx,
        )  # fmt: skip

    def _together(self, specimens: list[tuple[float, int]]) -> None:
        begun = clock.perf_counter()
        framed = self.case.rabbet is not None
        low = -max(self.case.shape.half) if framed else 0.0
        scene = Scene(gravity=(0.0, 0.0, -GRAVITY), floor=low)
        margin = 12 + 2 * math.ceil(FRAME) * framed
        wide = [
            math.ceil(n * self.body.voxel / self.dx) + margin for n in self.body.occupancy.shape
        ]
        columns = math.ceil(math.sqrt(len(specimens) * wide[1] / wide[0]))
        speeds = [math.sqrt(2.0 * GRAVITY * height) for height, _ in specimens]
        places = [
            (i % columns * wide[0] * self.dx, i // columns * wide[1] * self.dx, 0.0)
            for i in range(len(specimens))
        ]
        for place, speed, (_, seed) in zip(places, speeds, specimens, strict=True):
            self._add(scene, seed, place, (0.0, 0.0, -speed))
            self._ledges(scene, place)
        matter = self._matter(places, speeds, [seed for _, seed in specimens])
        run = Run(scene, matter, 1.0 / self.traversal)
        count, p = len(specimens), run.matter.particles
        body, mass = p.body.long(), p.mass.double()

        def each(values: torch.Tensor) -> torch.Tensor:
            zeros = torch.zeros(count, dtype=torch.float64, device=values.device)
            return zeros.index_add_(0, body, values.double())

        total, landing = each(mass), torch.tensor(speeds, dtype=torch.float64, device=mass.device)
        before, left = -landing, torch.zeros(count, dtype=torch.bool, device=mass.device)
        rebound, frame = torch.zeros_like(landing), 0
        still = torch.zeros(count, dtype=torch.int64, device=mass.device)
        while frame < self.case.limit and run.advance_to(frame, None):
            now = each(mass * run.state.particles.velocity[:, 2]) / total
            calm = (now - before + GRAVITY * self.traversal).abs() < 2e-3 * landing
            gone = calm & (now > 0.0) & (frame >= 2) & ~left
            rebound, left = torch.where(gone, now, rebound), left | gone
            slow = (now.abs() < 0.05 * landing) & ((now - before).abs() < 0.01 * landing)
            before, still = now, torch.where(slow, still + 1, 0)
            frame += 1
            if frame > LEAST and bool((left | (still >= LEAST)).all()):
                break
        rebound = torch.where(left, rebound, before)
        state, pieces = run.state, run.record(frame, run.state.time)[1]
        moving = each(0.5 * mass * state.particles.velocity.double().square().sum(dim=1))
        mean = torch.stack([each(mass * v) for v in state.particles.velocity.double().T])
        shaking = moving - 0.5 * mean.square().sum(dim=0) / total
        stored = each(p.volume.double() * ops.elastic_energy(
            state.particles.strain, law=run.matter.law, params=run.matter.params,
            material=state.particles.material,
        ).double())  # fmt: skip
        energy = 0.5 * total * landing**2
        ever, loose = each(mass * state.ever) / total, each(mass * (pieces.labels < 0)) / total
        high = mass * (run.matter.particles.position[:, 2] > max(self.case.shape.half))
        above = each(high * state.ever) / each(high)
        for i, (height, seed) in enumerate(specimens):
            mine = (body == i) & (pieces.labels >= 0)
            shares = torch.zeros_like(mass).index_add_(0, pieces.labels[mine].long(), mass[mine])
            shares = shares / total[i]
            largest, large = float(shares.max()), int((shares > 0.01).sum())
            parted = largest < WHOLE or large >= 2
            enough = HAIRLINE if self.case.hairline else CRUSHED
            broken = parted or float(ever[i]) > enough
            broken = broken or (self.case.fruit and float(above[i]) > PASSED)
            self.falls.append(Fall(
                height, seed, broken, parted, largest, large,
                float(ever[i]), float(above[i]), float(loose[i]),
                float(rebound[i] / landing[i]), float(shaking[i] / energy[i]),
                float(stored[i] / energy[i]), bool(left[i]),
            ))  # fmt: skip
        self.verdicts.append(run.report()["verdict"])
        self.steps += run.stepper.counters.steps
        self.calls += 1
        self.simulated += state.time
        self.seconds += clock.perf_counter() - begun


def median(falls: list[Fall]) -> tuple[float | None, float, float]:
    """Height at which half break, with the highest all-whole and lowest all-broken one.

    Shares over heights are made monotone (pooling neighbours), then interpolated in the logarithm
    of the height. None where no share crosses one half.
    """
    heights = sorted({f.height for f in falls})
    groups = [[f.broken for f in falls if f.height == h] for h in heights]
    pools: list[list[float]] = []  # sum, weight, heights
    for group in groups:
        pools.append([float(sum(group)), float(len(group)), 1.0])
        while len(pools) > 1 and pools[-2][0] * pools[-1][1] > pools[-1][0] * pools[-2][1]:
            last = pools.pop()
            pools[-1] = [a + b for a, b in zip(pools[-1], last, strict=True)]
    shares = [s / n for s, n, many in pools for _ in range(int(many))]
    low = max((h for h, s in zip(heights, shares, strict=True) if s == 0.0), default=0.0)
    high = min((h for h, s in zip(heights, shares, strict=True) if s == 1.0), default=math.inf)
    for k in range(1, len(heights)):
        a, b = shares[k - 1], shares[k]
        if a < 0.5 <= b:
            return (
                heights[k - 1] * (heights[k] / heights[k - 1]) ** ((0.5 - a) / (b - a)),
                low,
                high,
            )
    return None, low, high


def search(drop: Drop, start: float, ladder: tuple[float, ...], seeds: int, most: float) -> None:
    """Let specimens fall until those at two neighbouring heights are around one half.

    Args:
        drop: The object.
        start: Height that the ladder is about [m].
        ladder: Factors on it.
        seeds: Specimens at each height of the second round.
        most: Points in a call.
    """
    factor = ladder[1] / ladder[0]
    drop.fall([(start * f, 0) for f in ladder], most)
    for _ in range(FURTHER):
        heights = sorted(f.height for f in drop.falls)
        if not any(f.broken for f in drop.falls):
            drop.fall([(heights[-1] * factor, 0)], most)
        elif all(f.broken for f in drop.falls):
            drop.fall([(heights[0] / factor, 0)], most)
        else:
            break
    middle = median(drop.falls)[0]
    if middle is None:
        return
    around = [middle * 2.0 ** (k / 2.0) for k in (-1.5, -0.5, 0.5, 1.5)]
    for _ in range(1 + FURTHER):
        drop.fall([(h, seed) for h in around for seed in range(seeds)], most)
        dense = [f for f in drop.falls if f.height in around]
        if median(dense)[0] is not None:
            return
        lowest = [f.broken for f in dense if f.height == min(around)]
        down = 2 * sum(lowest) >= len(lowest)
        around.append(min(around) / 2**0.5 if down else max(around) * 2**0.5)


def study(
    case: Case, given: dict[str, Any], how: str, options: argparse.Namespace
) -> dict[str, Any] | None:
    """The record of one object with one stiffness; None where only the work is asked for."""
    drop = Drop(case, given, how, options.device, options.quick, options.law)
    start = float(given["height_m"] if "height_m" in given else given["survives_m"])
    ladder = LADDER[::2] if options.quick else LADDER
    work = drop.work(len(ladder)) + drop.work(4 * options.seeds)
    sys.stdout.write(
        f"{case.name}, {how} stiffness: dx {1e3 * drop.dx:.3g} mm, {drop.points} points each, "
        f"wave {drop.material.wave_speed:.0f} m/s, about {work:.0f} s\n"
    )
    sys.stdout.flush()
    if options.estimate:
        return None
    most = options.points or (3e5 if options.device == "cpu" else 6e6)
    search(drop, start, ladder, options.seeds, most)
    middle, low, high = median(drop.falls)
    gentle = 1.01 * min(start, middle or start) / 2.0
    whole = [f for f in drop.falls if not f.broken and f.left and f.height <= gentle]
    whole = [f for f in whole if f.height == max(g.height for g in whole)]
    return {
        "object": case.name, "law": law_of(drop.material), "stiffness": how,
        "device": name_of(options.device), "quick": options.quick,
        "seeds": options.seeds, "height": middle, "low": low,
        "high": None if math.isinf(high) else high,
        "restitution": sum(f.restitution for f in whole) / len(whole) if whole else None,
        "restitution_at": whole[0].height if whole else None,
        "cells": round(2.0 * max(case.shape.half) / drop.dx), "dx": drop.dx,
        "points": drop.points, "mass": number(drop.material.density) * drop.body.volume,
        "kept": kept_strength(drop.material, drop.dx),
        "wave_speed": drop.material.wave_speed, "softening": drop.material.softening,
        "steps": drop.steps, "calls": drop.calls, "simulated": drop.simulated,
        "seconds": drop.seconds, "verdicts": drop.verdicts,
        "falls": [dataclasses.asdict(f) for f in sorted(drop.falls, key=lambda f: f.height)],
    }  # fmt: skip


def name_of(device: str) -> str:
    """The device in words."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU"


def records(path: Path) -> list[dict[str, Any]]:
    """The lines of a file, if it is there."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [{"law": FIRST, **json.loads(line)} for line in lines if line.strip()]


def height_cell(row: dict[str, Any]) -> str:
    """The height, or the bound of it."""
    if row["height"] is not None:
        return f"{row['height']:.3g}"
    return f"> {row['low']:.3g}" if row["high"] is None else f"< {row['high']:.3g}"


def ratio_cell(row: dict[str, Any], given: dict[str, Any]) -> str:
    """Our height over that of the literature; of what survives: whether it does."""
    if "height_m" in given:
        if row["height"] is not None:
            return f"{row['height'] / given['height_m']:.2g}"
        bound = row["low"] if row["high"] is None else row["high"]
        return f"{height_cell(row)[0]} {bound / given['height_m']:.2g}"
    reached = row["height"] if row["height"] is not None else row["low"]
    return "whole" if reached > given["survives_m"] else "breaks"


def table(rows: list[dict[str, Any]], heights: dict[str, dict[str, Any]]) -> str:
    """Markdown: every object and stiffness."""
    head = ("object", "law", "stiffness", "literature m (kind)", "ours m", "ratio", "restitution",
            "literature", "broken mass below, above", "parted", "cells", "points", "kept", "steps",
            "seconds")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    order = {name: i for i, name in enumerate(heights)}

    def place(row: dict[str, Any]) -> tuple[int, int, str]:
        return order[row["object"]], STIFFNESS.index(row["stiffness"]), row["law"]

    for row in sorted(rows, key=place):
        given = heights[row["object"]]
        asked = given.get("height_m", given.get("survives_m"))
        ever = [
            [f["ever"] for f in row["falls"] if f["broken"] == broken] for broken in (False, True)
        ]
        parted = [f["parted"] for f in row["falls"] if f["broken"]]
        bounce = row["restitution"]
        soft = "real" if row["softening"] == 1.0 else f"1/{row['softening']:g}"
        cells = [
            row["object"].replace("_", " "), row["law"], soft,
            f"{'' if 'height_m' in given else '> '}{asked:g} ({given['kind']})",
            height_cell(row), ratio_cell(row, given), "-" if bounce is None else f"{bounce:.2f}",
            f"{given['restitution']:g}",
            ", ".join(f"{sum(e) / len(e):.1%}" if e else "-" for e in ever),
            f"{sum(parted)} of {len(parted)}",
            str(row["cells"]), str(row["points"]), f"{row['kept']:.2f}", str(row["steps"]),
            f"{row['seconds']:.0f}",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    if rows:
        lines += ["", f"{', '.join(sorted({r['device'] for r in rows}))}; "
                  f"{'half the cells; ' if any(r['quick'] for r in rows) else ''}"
                  f"seeds: {max(r['seeds'] for r in rows)}."]  # fmt: skip
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    heights = tomllib.loads((DATA / "drop_heights.toml").read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=sorted(heights), help="these objects")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    add_law(parser)
    parser.add_argument("--seeds", type=int, default=3, help="specimens at a height, at most 5")
    parser.add_argument("--stiffness", nargs="+", choices=STIFFNESS, default=list(STIFFNESS))
    parser.add_argument("--quick", action="store_true", help="half the cells, every second height")
    parser.add_argument("--cells", type=float, help="cells across, in place of an object's own")
    parser.add_argument("--points", type=float, help="most points of all specimens in a call")
    parser.add_argument("--budget", type=float, help="begin no object after so many seconds")
    parser.add_argument("-o", "--output", type=Path, help="JSON lines; default: beside the page")
    parser.add_argument("--markdown", type=Path, default=PAGE, help="page to enter the table into")
    parser.add_argument("--estimate", action="store_true", help="say the work, run nothing")
    parser.add_argument("--only-table", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    if not 1 <= options.seeds <= 5:
        parser.error("--seeds must lie in 1..5")
    kind = "cuda" if options.device.startswith("cuda") else "cpu"
    output = options.output or DATA / f"drop_heights_{kind}.jsonl"
    begun = clock.perf_counter()
    done = {(r["object"], r["law"], r["stiffness"], r["quick"]) for r in records(output)}

    def breaks_by(given: dict[str, Any]) -> str:
        return law_of(preset_of(given["preset"], options.law))

    todo = [
        (name, how)
        for how in options.stiffness
        for name in options.only or heights
        if not options.only_table
        and (name, breaks_by(heights[name]), how, options.quick) not in done
        and heights[name].get("stiffness", how) == how
        and (how == "preset" or materials.get(heights[name]["preset"]).softening > 1.0)
    ]  # fmt: skip
    output.parent.mkdir(parents=True, exist_ok=True)
    with reporter() as bars:
        report = bars.task("drops")
        for i, (name, how) in enumerate(todo):
            if options.budget and clock.perf_counter() - begun > options.budget:
                sys.stdout.write(f"out of budget, {len(todo) - i} left: run it again\n")
                break
            report(i, len(todo), f"{name}, {how}")
            case = case_of(name, heights[name])
            case = dataclasses.replace(case, cells=options.cells or case.cells)
            row = study(case, heights[name], how, options)
            if row is None:
                continue
            with output.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            sys.stdout.write(table([row], heights) + "\n")
            sys.stdout.flush()
        report(len(todo), len(todo), "")
    if options.estimate:
        return 0
    found = {(r["object"], r["law"], r["stiffness"]): r for r in records(output)}
    page = options.markdown
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    page.write_text(enter(text, f"drops_{kind}", table(list(found.values()), heights)), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
