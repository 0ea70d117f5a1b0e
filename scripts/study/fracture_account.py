"""Where the energy of a fall goes: torn, pressed, relaxed, or taken between points and nodes.

    python scripts/study/fracture_account.py               # ten minutes of one core; resumable
    python scripts/study/fracture_account.py --cells 16 --heights 3
    python scripts/study/fracture_account.py --cells 20,32,40 --device cuda    # three minutes
    python scripts/study/fracture_account.py --paths       # what matter takes by how it is strained

The watermelon of ``fracture_resolution.py``, step by step. The law's stress and that of the
relaxing spring work on the velocity gradient of every point; what of the work is not stored is
plastic, or relaxed. A spring that the yield surface brings back loses plastic work, too. It is told
apart by the sign of the pressure under which it is done.
What the ledger of energies lacks beyond that is lost between points and nodes and on the floor.
One JSON line per fall; the table is entered into the page of the resolution.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from fracture_resolution import LINES, MELON, PAGE, Trial, link_area
from rows import NAMES, Row, add_law, append, law_of, numbers, preset_of, put, read, table
from torch import Tensor

from gsfluent import ops
from gsfluent.lab.charts.record import machine
from gsfluent.lab.problems.fracture.energy import rows_of
from gsfluent.ops.plasticity import LAWS
from gsfluent.pipeline.matter.crack_band import BAND_CELLS
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.matter.weld import crushed
from gsfluent.pipeline.simulate.stage import Simulate

OUT = LINES.with_name("fracture_account.jsonl")
ROUNDING = 16.0
"""Units of the last place by which strains of springs may differ and are the same."""


class Account:
    """Works of the stress on every point, and what of them is stored.

    Hand it to a simulation as its ``step_hook``.

    Attributes:
        torn: Plastic work of each point while all of its stress pulls [J], float64 [N]; by
            Rankine's surface that of opening until it is broken, whatever presses beside it.
        pressed: All other plastic work: under pressure; by Rankine's surface of sliding and of
            what is broken.
        relaxed: What the spring of each point lost [J].
    """

    def __init__(self) -> None:
        self.matter: Matter | None = None
        self._last: State | None = None

    def begin(self, matter: Matter, state: State) -> None:
        """Take the points that are to be watched."""
        self.matter = matter
        none = torch.zeros_like(matter.particles.mass, dtype=torch.float64)
        self.torn, self.pressed, self.relaxed = none, none.clone(), none.clone()
        self._elastic = torch.full_like(matter.law, LAWS["elastic"])
        self._plain = torch.zeros_like(matter.params)
        self._plain[:, :2] = matter.params[:, :2]
        self._cut_off = matter.params[matter.particles.material.long(), 5] < 0.0
        self._last = state
        self._held, self._stress = self._energies(state), self._shared(self._stresses(state), state)

    def __call__(self, state: State) -> State:
        """Add the work of the step just made: stress before it on the gradient after it."""
        if self._last is None:
            return state
        after, dt = state.particles, state.time - self._last.time
        c = after.affine
        rate = torch.stack(
            [
                c[:, 0, 0], c[:, 1, 1], c[:, 2, 2], c[:, 0, 1] + c[:, 1, 0],
                c[:, 0, 2] + c[:, 2, 0], c[:, 1, 2] + c[:, 2, 1],
            ],
            dim=1,
        )  # fmt: skip
        raw = self._stresses(state)
        held, stress = self._energies(state), self._shared(raw, state)
        volume = dt * after.volume.double()
        law, spring = ((s * rate).sum(dim=1).double() * volume for s in self._stress)
        plastic = law - (held[0] - self._held[0])
        lost = spring - (held[1] - self._held[1])
        yielded, faded = self._yielding(self._last, state, rate=c * dt, law=raw[0], dt=dt)
        let_go = torch.where(yielded, lost - faded, 0.0)
        tension = (self._stress[0] + self._stress[1])[:, :3].sum(dim=1) > 0.0
        torn = torch.where(tension, plastic + let_go, 0.0)
        if bool(self._cut_off.any()):
            was = self._last.particles.alpha
            grown = (after.alpha > was) & (was < 0.0)
            opened = self._strength_left(self._last) - self._strength_left(state)
            opened += torch.where(grown, let_go, 0.0)
            torn = torch.where(self._cut_off, opened, torn)
        self.torn += torn
        self.pressed += plastic + let_go - torn
        self.relaxed += lost - let_go
        self._last, self._held, self._stress = state, held, stress
        return state

    def _energies(self, state: State) -> tuple[Tensor, Tensor]:
        """Stored by law and spring of each point [J], float64 [N] each."""
        assert self.matter is not None
        p, m = state.particles, self.matter
        share, spring = self._shares(state)
        law = ops.elastic_energy(p.strain, law=m.law, params=m.params, material=p.material)
        held = ops.elastic_energy(
            spring, law=self._elastic, params=self._plain, material=p.material
        )
        volume = p.volume.double()
        return volume * ((1.0 - share) * law).double(), volume * (share * held).double()

    def _strength_left(self, state: State) -> Tensor:
        """What Rankine's surface takes yet until nothing is left [J], float64 [N]."""
        assert self.matter is not None
        p = state.particles
        row = self.matter.params[p.material.long()].double()
        size = row[:, 3] * row[:, 1] / row[:, 4].clamp(min=1e-30)
        left = torch.cosh(row[:, 4] * (-p.alpha.double()).clamp(min=0.0)) - 1.0
        return (1.0 - self._shares(state)[0].double()) * p.volume.double() * size * left

    def _shares(self, state: State) -> tuple[Tensor, Tensor]:
        """Share of the stiffness that relaxes [N], strain of its spring [N, 6]."""
        p = state.particles
        if p.viscous is None:
            return torch.zeros_like(p.alpha), torch.zeros_like(p.strain)
        return p.viscous[:, 6], p.viscous[:, :6]

    def _stresses(self, state: State) -> tuple[Tensor, Tensor]:
        """Stress of law and spring, as if each had all of the stiffness [Pa]."""
        assert self.matter is not None
        p, m = state.particles, self.matter
        still = torch.zeros_like(p.affine)
        law = ops.return_mapping(
            p.strain, p.alpha, still, law=m.law, params=m.params, material=p.material, dt=1.0
        )[2]
        return law, self._elastic_stress(self._shares(state)[1], state)

    def _elastic_stress(self, strain: Tensor, state: State) -> Tensor:
        """Of springs [Pa]."""
        p = state.particles
        return ops.return_mapping(
            strain, torch.zeros_like(p.alpha), torch.zeros_like(p.affine), law=self._elastic,
            params=self._plain, material=p.material, dt=1.0,
        )[2]  # fmt: skip

    def _shared(self, stress: tuple[Tensor, Tensor], state: State) -> tuple[Tensor, Tensor]:
        """The same, each with its share of the stiffness."""
        share = self._shares(state)[0][:, None]
        return (1.0 - share) * stress[0], share * stress[1]

    def _yielding(
        self, before: State, after: State, *, rate: Tensor, law: Tensor, dt: float
    ) -> tuple[Tensor, Tensor]:
        """Springs that the yield surface brought back in a step, and what they relaxed besides.

        A spring holds no more than broken matter does (docs/theory/viscous.md): what it loses there
        is plastic work.

        Args:
            before: State before the step.
            after: After it.
            rate: Velocity gradient times the step, [N, 3, 3].
            law: Stress of the law after it, with all of the stiffness [Pa], [N, 6].
            dt: [s].

        Returns:
            Whether a spring yielded, bool [N]; what relaxed of it in the step [J], float64 [N].
        """
        assert self.matter is not None
        p, q = before.particles, after.particles
        if p.viscous is None or q.viscous is None:
            none = torch.zeros_like(p.mass, dtype=torch.float64)
            return none > 0.0, none
        options: dict[str, Any] = {"law": self._elastic, "params": self._plain}
        options["material"] = p.material
        old, now = p.viscous[:, :6].contiguous(), q.viscous[:, :6].contiguous()
        y = 0.5 * dt * p.viscous[:, 7:8].clamp(min=0.0)
        half = old / (1.0 + y * (1.0 + 0.5 * y))
        moved = ops.return_mapping(half, torch.zeros_like(p.alpha), rate, dt=dt, **options)[0]
        trial = ops.viscous_step(
            p.viscous, p.strain, p.alpha, rate, (q.strain, q.alpha, law), dt=dt, **options
        )[0][:, :6].contiguous()
        yielded = (trial - now).abs().amax(dim=1) > ROUNDING * torch.finfo(now.dtype).eps
        options["params"] = self._plain.double()
        stored = [ops.elastic_energy(e.double(), **options) for e in (old, half, moved, trial)]
        volume = q.viscous[:, 6].double() * q.volume.double()
        faded = volume * (stored[0] - stored[1] + stored[2] - stored[3])
        return yielded, faded


def study(trial: Trial, cells: int, seed: int, device: str = "cpu") -> Row:
    """A fall and its account."""
    begun = time.perf_counter()
    account = Account()
    sim = Simulate(
        dx=2.0 * max(trial.half) / cells, seed=seed, repair=False, splats=False, device=device,
        step_hook=account,
    )  # fmt: skip
    steps = sim(trial.scene(), fps=100.0, seconds=trial.begins + trial.seconds + 0.011)
    frame = next(steps)
    account.begin(steps.run.matter, steps.run.state)
    for later in steps:
        frame = later
    run, report = steps.run, steps.report
    matter, state = run.matter, run.state
    ever = state.ever | (state.peak >= 0.0)
    powder = ever & crushed(matter, state.lowest)
    volume = matter.particles.volume.double()
    labels, (a, b) = frame.fragments, run.links.unbind(dim=1)
    between = (labels[a] != labels[b]) & (labels[a] >= 0) & (labels[b] >= 0)
    area = int(between.sum()) * link_area(run.links, matter.rest, float(volume.sum()))
    shares = frame.pieces.mass_fractions
    return {
        "law": law_of(trial.matter), "height": trial.height, "cells": cells, "seed": seed,
        "device": device, "machine": machine(device), "dx": matter.dx,
        "points": matter.particles.count,
        "dissipated": report["per_frame"]["dissipated"][-1],
        "torn": float(account.torn[ever].sum()), "pressed": float(account.pressed[ever].sum()),
        "yielded": float((account.torn + account.pressed)[~ever].sum()),
        "relaxed": float(account.relaxed.sum()), "broken_volume": float(volume[ever].sum()),
        "crushed_volume": float(volume[powder].sum()),
        "area": area, "pieces_over_1_percent": int((shares > 0.01).sum()),
        "largest": float(shares[0]), "wall": round(time.perf_counter() - begun, 1),
    }  # fmt: skip


SPACINGS = {
    "fruit.watermelon": 0.0125, "fruit.apple": 0.0025, "glass": 5e-4, "plaster": 2e-3,
    "bread": 5e-3,
}  # fmt: skip
"""Node spacings of the table of paths [m], on which strengths are kept."""
OPENED = (1.0, 0.0, 0.0)


def energy_of_path(
    row: Tensor, alpha: Tensor, before: tuple[float, float, float], steps: int = 4000
) -> float:
    """What a point takes that is strained until it yields and then opened until it is broken.

    A crack is a band of which the sides are held by what is beside it, so once it yields it opens
    along x alone.

    Args:
        row: Of NACC, float64 [1, 8].
        alpha: Its alpha0, float64 [1].
        before: Strains along x, y and z until it yields, in units of that along x.
        steps: That the opening takes, about.

    Returns:
        Work less what is stored at the end [J/m^3].

    Raises:
        ValueError: It does not yield, or does not break.
    """
    law = torch.tensor([LAWS["nacc"]], dtype=torch.int32)
    strain, stress, now = torch.zeros(1, 6).double(), torch.zeros(1, 6).double(), alpha
    work, way = 0.0, torch.tensor(before, dtype=torch.float64)
    # what it holds over its stiffness; 20 times the opening that uses up alpha0
    limit = float(row[0, 3] * torch.sinh(-row[0, 4] * alpha[0]))
    size = min(limit / 500.0, -float(alpha[0]) / steps)
    for _ in range(40 * steps):
        increment = torch.diag(torch.expm1(size * way))[None]
        strain, later, after, _ = ops.return_mapping(
            strain, now, increment, law=law, params=row, dt=1.0
        )
        work += 0.5 * size * float(((stress + after)[0, :3] * way).sum())
        if bool(later != now):
            way, size = torch.tensor(OPENED, dtype=torch.float64), -float(alpha[0]) / steps
        now, stress = later, after
        if float(now) >= 0.0:
            return work - float(ops.elastic_energy(strain, law=law, params=row))
    raise ValueError(f"energy_of_path: not broken by strains {before}; take other ones")


def paths_table(laws: Sequence[str], steps: int = 4000) -> str:
    """Markdown: energies of presets over the one that G_c stands for, by how they are strained."""
    head = (
        "material", "law", "Poisson's ratio", "sides held", "sides free, then held",
        "one side free, then held", "pulled along two axes, then held", "sheared, then opened",
    )  # fmt: skip
    out = []
    for (name, dx), law in itertools.product(SPACINGS.items(), laws):
        preset = preset_of(name, law)
        row, _, alpha = rows_of(preset, torch.ones(1, dtype=torch.float64), dx)
        nu = float(preset.poisson_ratio)  # type: ignore[arg-type]
        free = -2.0 * nu / (1.0 - nu)
        ways = (
            OPENED, (1.0, -nu, -nu), (1.0, -nu / (1.0 - nu), 0.0), (1.0, 1.0, free),
            (1.0, -1.0, 0.0),
        )  # fmt: skip
        found = [energy_of_path(row, alpha, way, steps) for way in ways]
        target = float(preset.fracture_energy or 0.0) / (BAND_CELLS * dx)
        ratios = (f"{energy / target:.2f}" for energy in found)
        out.append([name, law_of(preset), f"{nu:g}", *ratios])
    return table(head, out)


def page_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: every fall."""
    head = (
        "from m", "law", "cells", "device", "lost J", "relaxed", "broken matter, torn",
        "broken matter, pressed", "whole matter", "points and nodes, floor", "broken", "crushed",
        "pieces over 1 %", "torn / (A G_c)",
    )  # fmt: skip
    energy = float(MELON.matter.fracture_energy or 0.0)
    out = []
    keys = ("height", "law", "cells", "device", "seed")
    for r in sorted(rows, key=lambda r: [r[k] for k in keys]):
        parts = [r[k] for k in ("relaxed", "torn", "pressed", "yielded")]
        parts.append(r["dissipated"] - sum(parts))
        area = r["broken_volume"] / (2.0 * r["dx"])
        whole = 4.0 / 3.0 * torch.pi * float(torch.tensor(MELON.half).prod())
        out.append(
            [
                f"{r['height']:g}", r["law"], str(r["cells"]), r["device"],
                f"{r['dissipated']:.1f}",
                *(f"{100.0 * part / r['dissipated']:.1f} %" for part in parts),
                *(f"{100.0 * r[k] / whole:.1f} %" for k in ("broken_volume", "crushed_volume")),
                str(r["pieces_over_1_percent"]),
                f"{r['torn'] / (area * energy):.2f}" if area else "-",
            ]
        )  # fmt: skip
    return table(head, out)


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    parser.add_argument("--cells", type=numbers, default=(12, 16, 20, 24))
    parser.add_argument("--heights", type=float, nargs="+", default=[0.75, 3.0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    add_law(parser)
    parser.add_argument("--paths", action="store_true", help="only the table of paths")
    args = parser.parse_args(argv)
    if args.paths:
        put(PAGE, "fracture resolution paths", paths_table([args.law] if args.law else NAMES))
        return 0
    keys = ("law", "height", "cells", "seed", "device")
    done = {tuple(r[k] for k in keys) for r in read(args.out)}
    for cells in args.cells:
        for height in args.heights:
            for seed in range(args.seeds):
                trial = dataclasses.replace(MELON, height=height, law=args.law)
                if (law_of(trial.matter), height, cells, seed, args.device) in done:
                    continue
                row = study(trial, cells, seed, args.device)
                sys.stderr.write(f"{json.dumps(row)}\n")
                append(args.out, row)
    if args.out == OUT:
        put(PAGE, "fracture resolution account", page_table(read(args.out)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
