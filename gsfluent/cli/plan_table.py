"""A plan as a person reads it: passes, bounds, stages, warnings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text


def plan_text(plan: Mapping[str, Any]) -> str:
    """The plan as lines of text."""
    calibrated = plan["calibrated"]
    size = " x ".join(f"{100 * side:.3g}" for side in plan["size_m"])
    total = seconds_text(plan["seconds"]) if calibrated else "not calibrated"
    lines = [
        f"{total} and {_bytes(plan['memory_bytes'])} on {plan['device']}; {size} cm "
        f"({plan['assumed']})",
        "",
        "passes",
        *table([["+" if row["needed"] else "-", row["pass"], row["why"]]
                 for row in plan["passes"]]),
        "",
        f"grid: {plan['cells']} cells along the largest body, dx = {1000 * plan['dx']:.3g} mm, "
        f"dt = {1e6 * plan['dt']:.3g} us, {plan['substeps']} steps in {plan['frames']} frames",
        f"      {plan['particles']} points, {plan['particles_per_cell']} a cell, about "
        f"{plan['active_blocks']:.0f} active blocks; contact at {plan['contact']}",
        f"      waves at {plan['wave_speed']:.3g} m/s, strikes at {plan['impact_speed']:.3g} m/s",
        "",
        f"bounds of dx: {plan['binding']} binds",
        *table([["ok" if row["kept"] else "!", row["bound"], f"{row['side']} "
                  f"{1000 * row['dx']:.3g} mm", row["why"]] for row in plan["bounds"]]),
        "",
        "what breaks",
        *table(
            [[row["object"], row["material"], _speed("lands with", row["lands_with"]),
              _speed("breaks from", row["breaks_from"]), _height(row["height"]),
              "breaks" if row["breaks"] else f"whole; {row['hint']} would break it"
              if row["hint"] else "whole"]
             for row in plan["breaking"]]
        ),
        "",
        "stages",
        *table(
            [[name, seconds_text(row["seconds"]), _bytes(row["memory_bytes"])]
             for name, row in plan["stages"].items()]
            + [["in all", seconds_text(plan["seconds"]), _bytes(plan["memory_bytes"])]],
            right=(1, 2),
        ),
    ]  # fmt: skip
    if calibrated:
        taught = plan["model"]
        factors = ", ".join(f"{n} x{f:.2f}" for n, f in taught["corrections"].items())
        after = f"; corrected by the last {taught['runs']} runs: {factors}" if factors else ""
        lines += ["", f"costs measured {taught['measured']}{after}"]
    else:
        lines += ["", "no times: not calibrated; gsfluent plan without --no-probe measures them"]
    if plan["warnings"]:
        lines += ["", "warnings", *(f"  ! {warning}" for warning in plan["warnings"])]
    return "\n".join(lines)


def table(rows: list[list[str]], right: tuple[int, ...] = ()) -> list[str]:
    """Rows in columns."""
    if not rows:
        return ["  none"]
    grid = Table.grid(padding=(0, 2, 0, 0))
    for column in range(len(rows[0])):
        grid.add_column(justify="right" if column in right else "left", no_wrap=True)
    for row in rows:
        grid.add_row(*map(Text, row))
    console = Console(width=sum(map(len, map("".join, rows))) + 100)
    with console.capture() as drawn:
        console.print(grid)
    return [f"  {line}".rstrip() for line in drawn.get().splitlines()]


def _speed(said: str, value: float | None) -> str:
    return f"{said} {'-' if value is None else f'{value:.2g} m/s'}"


def _height(value: float | None) -> str:
    return "" if value is None else f"({value:.2g} m)"


def seconds_text(value: float | None) -> str:
    """Seconds with what can be trusted of them."""
    if value is None:
        return "-"
    return f"{value:.2g} s" if value < 10 else f"{value:.0f} s"


def _bytes(value: float) -> str:
    return f"{value / 2**20:.0f} MiB" if value < 2**30 else f"{value / 2**30:.2f} GiB"
