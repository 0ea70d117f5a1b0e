"""What FractureBench's fracture cases depend on, measured and entered into docs.

    python scripts/fracturebench/loads.py [--quick] [--only NAME,...]
    python scripts/fracturebench/loads.py --only grid_place --cases rock_press   # one row anew
    python scripts/fracturebench/loads.py --only cantilever_account --cases "on each side"

Speed of the notch's crack with light and heavy grips at two CFL numbers and two speeds of
tearing, energy that the cantilever's crack takes at three speeds of opening and where it goes in
other settings, all cases with the grid moved, strength of pressed rock beside the experiment's,
shapes of the pieces of struck rock on three grids (six minutes on one core).
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.figure.markdown import enter
from gsfluent.fracturebench.registry import cases, find, judge
from gsfluent.fracturebench.run import Measure
from gsfluent.fracturebench.scenes.cantilever import (
    cantilever,
    crack_length,
    crack_tip,
    per_area,
)
from gsfluent.fracturebench.scenes.plane import notch
from gsfluent.fracturebench.scenes.rock import experiment
from gsfluent.io.atomic import atomic_path
from gsfluent.lab.frozen.answer import run_case
from gsfluent.lab.problems.fracture.dissipation import Dissipation
from gsfluent.lab.problems.fracture.energy import TENSILE, open_slowly
from gsfluent.lab.world.driver import World
from gsfluent.lab.world.stepper import Stepper

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "measured" / "fracturebench_fracture.md"


def speeds(quick: bool) -> list[str]:
    """Rows of the table of the notch."""
    rows = ["| grips | speed of a grip | CFL 0.5 | CFL 0.25 |", "|---|---|---|---|"]
    for weight, pull in ((1.0, 5e-5), (30.0, 3e-5), (30.0, 6e-6))[: 1 if quick else 3]:
        found = []
        for cfl in (0.5, 0.25):
            scene = notch(1 / 32, 8, pull, weight)
            fastest, mean, _ = judge(scene, run_case(scene, cfl=cfl))
            found.append(f"{mean.value:.2f}, fastest tenth {fastest.value:.2f}")
        rows.append(f"| {weight:g} times as heavy | {pull:g} c | {found[0]} | {found[1]} |")
    return rows


def energies(quick: bool) -> list[str]:
    """Rows of the table of the cantilever."""
    rows = ["| speed of an arm | energy gone per area | that of the row |", "|---|---|---|"]
    for speed, seconds in ((0.004, 8.0), (0.002, 10.0), (0.001, 14.0))[: 1 if quick else 3]:
        scene = cantilever(1 / 32, 8, speed, seconds)
        (energy,) = judge(scene, run_case(scene))
        rows.append(f"| {speed:g} c | {energy.value:.0f} J/m^2 | {energy.reference:.0f} J/m^2 |")
    return rows


class Account:
    """Where the energy of a run goes, and a transfer that keeps more of it: wrap a world in it.

    A step takes kinetic energy, with that of the affine velocities, from the points to the nodes,
    and after the forces back to the points. What is missing afterwards, both ways, is what the
    transfer takes; each point's share is counted where it is.

    Args:
        world: A world on the composable ops, before its first step.
        keep: Share of what the transfer took off a point's velocity that it gets back: 0 is APIC,
            1 is FLIP with affine velocities (Fei et al. 2021); points still move by the nodes'.
        sides: Give both sides of a crack a field (:class:`Sides`).

    Raises:
        TypeError: The world runs in the solver.
    """

    def __init__(self, world: World, keep: float = 0.0, *, sides: bool = False) -> None:
        if not isinstance(world.stepper, Stepper):
            raise TypeError("Account: the world must run on the ops; give it engine='ops'")
        self.plastic = Dissipation(world)
        self.transfer = torch.zeros_like(world.position[:, 0], dtype=torch.float64)
        self._world, self._keep, self._step = world, keep, world.stepper.advance
        self._fields = Sides(world) if sides else contextlib.nullcontext
        world.stepper.advance = self._advance  # type: ignore[method-assign]

    def _kinetic(self) -> Tensor:
        """Kinetic energy of the points [J], float64 [N]."""
        world, scene = self._world, self._world.scene
        spin = 0.25 * scene.dx**2 * (world.affine.double() ** 2).sum((1, 2))
        return 0.5 * scene.mass.double() * ((world.velocity.double() ** 2).sum(1) + spin)

    def _advance(self, dt: float) -> None:
        with self._fields():
            self._accounted(dt)

    def _accounted(self, dt: float) -> None:
        world, scene = self._world, self._world.scene
        v, x, where = world.velocity, world.position, {"dx": scene.dx, "dt": dt}
        blocks = ops.build_blocks(x, scene.dx)

        def nodes(**forces: Any) -> Tensor:
            grid, _ = ops.p2g(x, v, world.affine, scene.mass, blocks=blocks, **where, **forces)
            walls = scene.colliders if forces else None
            return ops.grid_update(
                grid, blocks=blocks, gravity=(0.0, 0.0, 0.0), colliders=walls, **where
            )[0]

        def gathered(field: Tensor) -> Tensor:
            return ops.g2p(field, x, blocks=blocks, **where)[1]

        def on_nodes(field: Tensor) -> Tensor:
            square = torch.zeros_like(field)
            square[..., 0] = (field**2).sum(-1)
            return 0.5 * scene.mass.double() * gathered(square)[:, 0].double()

        before = nodes()
        there = on_nodes(nodes(stress=world.stress, volume=scene.volume))
        self.transfer += self._kinetic() - on_nodes(before) + there
        self._step(dt)
        if self._keep:
            world.velocity = world.velocity + self._keep * (v - gathered(before))
        self.transfer -= self._kinetic()
        world.dt = dt
        self.plastic(world)


class Sides:
    """A velocity field on each side of a crack that runs along x, up to its tip.

    What fields told apart by the gradient of damage would do (Homel and Herbold 2017), with the
    crack's place known: a point is above or below the broken points of its column. Ahead of the tip
    both fields have one velocity at every node, and meet by contact behind it.

    Args:
        world: A world on the composable ops, before its first step.
    """

    def __init__(self, world: World) -> None:
        self._world, self._rest = world, world.position.clone()
        y = self._rest[:, 1]
        self._middle = 0.5 * (y.min() + y.max())
        self._column = torch.floor(self._rest[:, 0] / world.scene.dx).long()
        self._plain = {name: getattr(ops, name) for name in ("p2g", "g2p")}

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """Transfers by two fields, for one step."""
        dx, y = self._world.scene.dx, self._rest[:, 1]
        broken = ((self._world.peak >= 0.0) & (self._world.scene.material == 1)).nonzero()[:, 0]
        column, least = self._column[broken], int(self._column.min())
        count = torch.bincount(column - least, minlength=int(self._column.max()) - least + 1)
        total = torch.zeros_like(count, dtype=y.dtype).index_add(0, column - least, y[broken])
        line = torch.where(count > 0, total / count.clamp(min=1), self._middle)
        self._body = (y > line[self._column - least]).int()
        self._tip = dx * float(column.max() + 1) if len(broken) else -math.inf
        with patch.object(ops, "p2g", self._to_nodes), patch.object(ops, "g2p", self._to_points):
            yield

    def _to_nodes(self, *points: Any, **options: Any) -> Any:
        options |= {"body": self._body, "fields": 2, "contact": True}
        grid, moments = self._plain["p2g"](*points, **options)
        place = options["blocks"].node_positions(options["dx"], grid.dtype)[..., 0]
        ahead = place >= self._tip
        both = grid.sum(0)
        shared = both[..., :3] / both[..., 3:].clamp(min=1e-30)
        grid = grid.clone()
        grid[..., :3] = torch.where(ahead[..., None], grid[..., 3:] * shared, grid[..., :3])
        return grid, moments

    def _to_points(self, *nodes: Any, **options: Any) -> Any:
        return self._plain["g2p"](*nodes, **{**options, "body": self._body})


@dataclasses.dataclass(frozen=True)
class Balance:
    """Energy per area of the cantilever's crack [J/m^2], each the slope over the crack's length."""

    gone: float  # as the case judges it
    plastic: float  # plastic work of the points beyond the section
    transfer: float  # kinetic energy that the transfer took from them
    near: float  # the latter, of the points that can break
    reference: float  # of the row
    cracks: float  # side by side: their length over the way of the tip


def balance(dx: float, *, place: float = 0.0, band: float = 2.0, keep: float = 0.0,
            sides: bool = False, **options: Any) -> Balance:  # fmt: skip
    """Open the cantilever and say where its energy went.

    Args:
        dx: Node spacing [m].
        place: Of the points on the grid across the crack [dx].
        band: Cells that the softening is spread over: the row's own is 2.
        keep: Of :class:`Account`.
        sides: Likewise.
        **options: Of :func:`gsfluent.lab.frozen.answer.run_case`.
    """
    scene = find("double_cantilever").build(dx, 8)
    rows = list(scene.materials)
    rows[1] = {
        **rows[1], "alpha": rows[1]["alpha"] * 2.0 / band,
        "hardening": rows[1]["hardening"] * band / 2.0,
    }  # fmt: skip
    shift = np.array([0.0, place * dx, 0.0])
    played = dataclasses.replace(scene, x=scene.x + shift, materials=tuple(rows))
    accounts: list[Account] = []
    rows_of_samples: list[np.ndarray] = []
    share = np.clip((scene.x[:, 0] - 0.125) / 0.0625, 0.0, 1.0)
    near = share * (scene.material == 1)

    def look(_world: World, _i: int) -> None:
        lost = accounts[0].transfer.cpu().numpy()
        work = accounts[0].plastic.of_points().cpu().numpy()
        rows_of_samples.append(np.array([work @ share, lost @ share, lost @ near]))

    run = run_case(
        played, engine="ops", watch=look, **options,
        setup=lambda world: accounts.append(Account(world, keep, sides=sides)),
    )  # fmt: skip
    run = dataclasses.replace(run, x=run.x - shift)
    (judged,) = judge(scene, run)
    damage = np.zeros((0, scene.count)) if run.damage is None else run.damage
    tip, length = (f(scene, damage, 0.1875, 0.0625) for f in (crack_tip, crack_length))
    plastic, transfer, close = (
        per_area(tip, energy, dx, length) for energy in np.stack(rows_of_samples).T
    )
    there = (tip > 0.25) & (tip <= 0.5)
    side = float(length[there][-1] / (tip[there][-1] - 0.25))
    return Balance(judged.value, plastic, transfer, close, judged.reference, side)


SETTINGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("as in the table", {}),
    *((f"grid {p:g} cells off", {"place": p}) for p in (0.125, 0.25, 0.375, 0.5)),
    *((f"CFL {c:g}", {"cfl": c}) for c in (0.25, 0.8)),
    *((f"dx = 1/{n} m", {"dx": 1.0 / n}) for n in (48, 64)),
    ("dx = 1/64 m, grid 0.25 cells off", {"dx": 1.0 / 64.0, "place": 0.25}),
    ("softening for a band of 3 cells", {"band": 3.0}),
    *((f"transfer keeps {k:.0%}", {"keep": k}) for k in (0.9, 0.99)),
    *((f"transfer keeps 90%, grid {p:g} cells off", {"keep": 0.9, "place": p})
      for p in (0.25, 0.5)),
    ("softening for a band of 3 cells, transfer keeps 99%", {"band": 3.0, "keep": 0.99}),
    *((f"a field on each side of the crack, grid {p:g} cells off", {"sides": True, "place": p})
      for p in (0.125, 0.25, 0.375)),
    ("a field on each side of the crack, grid 0.25 cells off, dx = 1/48 m",
     {"sides": True, "place": 0.25, "dx": 1.0 / 48.0}),
    ("a field on each side of the crack, grid 0.25 cells off, softening for a band of 1.5 cells",
     {"sides": True, "place": 0.25, "band": 1.5}),
)  # fmt: skip


def accounts(quick: bool, only: Sequence[str] = ()) -> list[str]:
    """Rows of the table of where the cantilever's energy goes; arguments as of :func:`places`."""
    known = {row.split(" | ")[0]: row for row in PAGE.read_text(encoding="utf-8").splitlines()}
    rows = [
        "| setting | cracks | energy gone | over that of the row | plastic work | taken by the "
        "transfer | of it where matter can break |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, options in SETTINGS[: 1 if quick else None]:
        if only and f"| {name}" in known and not any(part in name for part in only):
            rows.append(known[f"| {name}"])
            continue
        b = balance(**{"dx": 1.0 / 32.0, **options})
        rows.append(
            f"| {name} | {b.cracks:.1f} | {b.gone:.0f} J/m^2 | {b.gone / b.reference:.2f} | "
            f"{b.plastic:.0f} J/m^2 | {b.transfer:.0f} J/m^2 | {b.near:.0f} J/m^2 |"
        )
        sys.stderr.write(f"{rows[-1]}\n")
    return rows


def places(quick: bool, only: Sequence[str] = ()) -> list[str]:
    """Rows of every case with the points where they are and a quarter of a cell off.

    Args:
        quick: One case is enough.
        only: Names of cases that are run; the rows of the others are those of the page. None: all.
    """
    known = {row.split(" | ")[0]: row for row in PAGE.read_text(encoding="utf-8").splitlines()}
    rows = ["| case | tolerance | error | a quarter of a cell off |", "|---|---|---|---|"]
    for case in cases()[: 1 if quick else None]:
        if only and case.name not in only and f"| {case.name}" in known:
            rows.append(known[f"| {case.name}"])
            continue
        scene = case.build(case.dx, 8)
        here, there = (judge(scene, run_case(scene, place=place))[0] for place in (0.0, 0.25))
        said = [f"**{m.error:.2g}**" if m.passed else f"{m.error:.2g}" for m in (here, there)]
        rows.append(f"| {case.name} | {here.tolerance:.3g} | {' | '.join(said)} |")
        sys.stderr.write(f"{rows[-1]}\n")
    return rows


def verdict(measures: Iterable[Measure]) -> str:
    """How many of some measures pass."""
    passed = [m.passed for m in measures]
    return f"{sum(passed)} of {len(passed)} pass"


def flanks(quick: bool) -> list[str]:
    """Rows of the table of what matter beside the cantilever's crack takes."""
    rows = [
        "| strength in compression over that in tension | dx | energy over G_c | of matter that "
        "broke | of matter beside it |",
        "|---|---|---|---|---|",
    ]
    for ratio, cells in ((10.0, (32, 48, 64, 96)), (2.0, (32, 48, 64))):
        for n in cells[: 1 if quick else None]:
            crack = open_slowly(n, shift=0.25, compressive=ratio * TENSILE)
            rows.append(
                f"| {ratio:g} | 1/{n} m | {crack.energy:.2f} | "
                f"{crack.energy - crack.beside:.2f} | {crack.beside:.2f} |"
            )
            sys.stderr.write(f"{rows[-1]}\n")
    return rows


def strengths(quick: bool) -> list[str]:
    """Rows of the table of pressed rock, and what a strength without a rate can reach."""
    case = find("rock_press")
    grids = case.ladder[:1] if quick else case.ladder
    found = {dx: judge(s, run_case(s)) for dx in grids for s in [case.build(dx, 8)]}
    scene = case.build(grids[0] if quick else case.dx, 8)
    fast, slow, rise = judge(scene, run_case(scene, viscous=None))
    rows = ["| | at 180 1/s | at 50 1/s | ratio | allowed |", "|---|---|---|---|---|"]
    low, high = ((1.0 + s * rise.tolerance) * rise.reference for s in (-1.0, 1.0))
    lines = [
        ("experiment", fast.reference, slow.reference, rise.reference, f"{low:.2f} to {high:.2f}"),
        ("without `yield_time`", fast.value, slow.value, rise.value, verdict((fast, slow, rise))),
    ]
    for dx, late in found.items():
        a, b, r = (m.value for m in late)
        lines.append((f"gsfluent, dx {1e3 * dx:.1f} mm", a, b, r, verdict(late)))
    for name, a, b, r, allowed in lines:
        rows.append(f"| {name} | {a / 1e6:.0f} MPa | {b / 1e6:.0f} MPa | {r:.2f} | {allowed} |")
    least, most = (
        [(1.0 + s * m.tolerance) * m.reference / m.value for m in (fast, slow)] for s in (-1.0, 1.0)
    )
    exponent = np.log(rise.reference) / np.log(180.0 / 50.0)
    rows += [
        "",
        f"The experiment's strength goes as the rate to the power {exponent:.2f}. Both strengths "
        f"would be within their tolerance with the rock's static strength times "
        f"{max(least):.2f} to {min(most):.2f}; the ratio would stay {rise.value:.2f}.",
    ]
    return rows


def shapes(quick: bool) -> list[str]:
    """Rows of the table of struck rock."""
    found = experiment()["pieces"]
    rows = ["| points | Rosin-Rammler modulus | mean aspect ratio |", "|---|---|---|"]
    case = find("struck_rock")
    for dx in case.ladder[: 1 if quick else None]:
        scene = case.build(dx, 8)
        modulus, aspect = judge(scene, run_case(scene))
        rows.append(f"| {scene.count} | {modulus.value:.2f} | {aspect.value:.2f} |")
    (a, b), (c, d) = found["modulus"], found["aspect"]
    rows.append(f"| rocks | {a:.2f} to {b:.2f} | {c:.2f} to {d:.2f} |")
    return rows


CHOSEN: dict[str, Callable[[bool, Sequence[str]], list[str]]] = {
    "cantilever_account": accounts, "grid_place": places,
}  # fmt: skip
"""Tables of which some rows may be run, the others being those of the page."""
TABLES: dict[str, Callable[[bool], list[str]]] = {
    "notch_loads": speeds, "cantilever_loads": energies, "cantilever_account": accounts,
    "cantilever_flanks": flanks, "grid_place": places, "rock_strength": strengths,
    "rock_shapes": shapes,
}  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one row of each, printed only")
    parser.add_argument("--only", default=",".join(TABLES), help="some of %(default)s")
    parser.add_argument("--cases", default="", help=f"of {', '.join(CHOSEN)}: only these are run")
    args = parser.parse_args(argv)
    names = args.only.split(",")
    if unknown := set(names) - set(TABLES):
        parser.error(
            f"--only: no table {', '.join(sorted(unknown))}; there are {', '.join(TABLES)}"
        )
    some = [name for name in args.cases.split(",") if name]
    tables = {
        name: CHOSEN[name](args.quick, some) if name in CHOSEN else TABLES[name](args.quick)
        for name in names
    }
    if args.quick:
        for rows in tables.values():
            sys.stdout.write("\n".join(rows) + "\n\n")
        return 0
    text = PAGE.read_text(encoding="utf-8")
    for name, rows in tables.items():
        text = enter(text, name, "\n".join(rows))
    with atomic_path(PAGE) as file:
        file.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
