"""What the resident solver's fixed-point sums and its delayed time step cost.

python scripts/study/solver.py --markdown docs/measured/solver.md    # two minutes on one core
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.figure.markdown import enter
from gsfluent.materials import LAWS
from gsfluent.ops.reference import fixed_point as fixed

DX = 0.02
DENSITY = 1000.0
VOLUME = DX**3 / 8
YOUNG = 1e5
MU, KAPPA = YOUNG / 2.6, YOUNG / 1.2
FLOOR = [0.0, 2.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] + [0.0] * 7
ROWS = {
    "elastic": [MU, KAPPA, 0, 0, 0, 0, DENSITY, 0],
    "nacc": [MU, KAPPA, 1.85, 0.5, 3.0, 0.1, DENSITY, 0],
    "von_mises": [MU, KAPPA, 1e3, 0, 0, 0, DENSITY, 0],
    "corotated": [MU, KAPPA, 0, 0, 0, 0, DENSITY, 0],
    "fluid": [0, YOUNG, 1e-3, 0, 0, 0, DENSITY, 7],
}


def lattice(half: int, seed: int = 0) -> Tensor:
    """Jittered points, eight per cell, around the origin, float64 [64 half^3, 3]."""
    axis = (torch.arange(-2 * half, 2 * half, dtype=torch.float64) + 0.5) * (0.5 * DX)
    at = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    noise = torch.rand(at.shape, generator=torch.Generator().manual_seed(seed)) - 0.5
    return at + 0.3 * DX * noise.double()


# --- resolution of the sums ---


def resolution(ratio: float, strain: float, speed: float) -> dict[str, float]:
    """Error of one transfer to the nodes and back, relative to ``speed``.

    A cube of full homes (512 points each); with a ratio other than 1, points on one side of a plane
    through the middle of blocks are lighter by it.
    """
    position = lattice(4) + 8 * DX
    n, generator = position.shape[0], torch.Generator().manual_seed(1)
    light = position[:, 0] < 10.0 * DX
    mass = torch.where(light, DENSITY * VOLUME / ratio, DENSITY * VOLUME).float()
    velocity = speed * torch.tensor([0.78, 0.54, -0.31])
    given: dict[str, Any] = {
        "velocity": velocity + 0.01 * speed * torch.randn(n, 3, generator=generator),
        "mass": mass,
        "volume": torch.full((n,), VOLUME),
        "strain": strain * torch.randn(n, 6, generator=generator),
        "affine": 0.01 * speed / DX * torch.randn(n, 3, 3, generator=generator),
    }
    law, params = torch.zeros(1, dtype=torch.int32), torch.tensor([ROWS["elastic"]])
    solver = ops.Solver(position, **given, dx=DX, law=law, params=params)
    stress = solver.stress
    solver.advance(steps=1)
    clock = solver.clock()
    t = fixed.transfer(
        position, given["velocity"], given["affine"], stress, mass, given["volume"],
        dx=DX, dt=clock["dt"],
    )  # fmt: skip
    sums = fixed.node_sums(t, clock["momentum_unit"], clock["mass_unit"])
    error = sums.gathered(t.weight, sums.fixed) - sums.gathered(t.weight, sums.exact)
    mixed = torch.zeros(int(t.home.max()) + 1, dtype=torch.bool)
    mixed[t.home[light]] = True
    heavy = torch.zeros_like(mixed)
    heavy[t.home[~light]] = True
    seen = light & (mixed & heavy)[t.home] if ratio != 1.0 else torch.ones_like(light)
    relative = error[seen].norm(dim=1) / speed
    lost = (sums.fixed - sums.exact).sum(dim=0).abs() / sums.exact.sum(dim=0).abs()
    return {
        "bound": float((t.bound / mass).max()) / speed,
        "rms": float(relative.square().mean().sqrt()),
        "max": float(relative.max()),
        "momentum": float(lost[0]),
        "mass": float(lost[3]),
    }


def resolution_table() -> str:
    rows = [
        "| points | mass ratio in a home | largest bound / (m v) | error of v, rms | largest | "
        "momentum of all | mass of all |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    cases = [(1.0, 0.0, 3.0), (1.0, 0.01, 3.0), (1.0, 0.01, 0.03)]
    cases += [(ratio, 0.0, 3.0) for ratio in (10.0, 100.0, 1e3, 1e4)]
    for ratio, strain, speed in cases:
        r = resolution(ratio, strain, speed)
        what = "all" if ratio == 1.0 else "light ones beside heavy ones"
        rows.append(
            f"| {what}, strain {strain:g}, {speed:g} m/s | {ratio:g} | {r['bound']:.1f} | "
            f"{r['rms']:.1e} | {r['max']:.1e} | {r['momentum']:.0e} | {r['mass']:.0e} |"
        )
    return "\n".join(rows)


# --- delay of the time step ---


def courant(law: str, speed_over_wave: float, steps: int) -> dict[str, float]:
    """Largest true Courant number of any step of a ball that hits a floor."""
    at = lattice(6)
    position = at[at.norm(dim=1) < 6 * DX] + torch.tensor([0.0, 0.0, 6.3 * DX])
    n = position.shape[0]
    number = torch.tensor([LAWS[law]], dtype=torch.int32)
    params = torch.tensor([ROWS[law]])
    rest = ops.wave_speed(torch.zeros(1, 6), law=number, params=params)
    solver = ops.Solver(
        position, torch.tensor([0.0, 0.0, -speed_over_wave * float(rest)]).expand(n, 3).clone(),
        torch.full((n,), DENSITY * VOLUME), torch.full((n,), VOLUME), dx=DX, law=number,
        params=params, alpha=torch.full((n,), -0.02), colliders=torch.tensor([FLOOR]),
    )  # fmt: skip
    start, material = solver.snapshot(), torch.zeros(n, dtype=torch.int32)

    def fastest() -> float:
        wave = ops.wave_speed(solver.strain, law=number, params=params, material=material)
        return float(wave.max()) + float(solver.velocity.norm(dim=1).max())

    largest = growth = 0.0
    before = fastest()
    # From the start every time: a call begins by measuring, which would take the delay away.
    for k in range(1, steps + 1):
        solver.restore(start)
        solver.advance(steps=k)
        largest = max(largest, solver.dt * before / DX)
        now = fastest()
        growth, before = max(growth, now / before), now
    return {"courant": largest, "growth": growth}


def courant_table(steps: int) -> str:
    rows = [
        "| law | speed / wave speed | largest Courant number | largest growth of c + v in a step |",
        "| --- | --- | --- | --- |",
    ]
    cases = [("elastic", (0.1, 0.5, 1.0, 2.0)), ("corotated", (0.1, 0.5, 1.0)),
             ("nacc", (0.1, 0.5, 1.0)), ("von_mises", (0.5,)),
             ("fluid", (0.1, 0.5, 1.0))]  # fmt: skip
    for law, speeds in cases:
        for speed in speeds:
            r = courant(law, speed, steps)
            rows.append(f"| {law} | {speed:g} | {r['courant']:.2f} | {r['growth']:.2f} |")
    return "\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100, help="of each ball")
    parser.add_argument("--markdown", type=Path, help="enter the tables into this page")
    options = parser.parse_args()
    torch.set_num_threads(1)
    parts = {
        "solver resolution": resolution_table(),
        "solver courant": courant_table(options.steps),
    }
    for name, part in parts.items():
        sys.stdout.write(part + "\n\n")
        if options.markdown:
            page = options.markdown
            page.write_text(enter(page.read_text() if page.exists() else "", name, part))
    return 0


if __name__ == "__main__":
    sys.exit(main())
