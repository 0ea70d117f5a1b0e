"""What a run says of itself in words: walls too thin, what was struck and stayed whole, pieces."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from gsfluent.data import SURFACE, Solid
from gsfluent.materials import Material, phase_field
from gsfluent.pipeline.matter.brittle import kept_strength
from gsfluent.pipeline.matter.points import POINTS_PER_CELL, grid_spacing
from gsfluent.pipeline.simulate.stage import QUALITY
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.pipeline.solid.walls import WALL_CELLS, thin_shells
from gsfluent.scene.scene import Body, Scene

_log = logging.getLogger(__name__)

LOWERED = 0.9
"""Share of the strength from which on nobody is told that the grid has lowered it."""
THIN_BODY = 8.0
"""Phase-field lengths of a body from which its toughness decides how it breaks."""


def thin_walls(scene: Scene, dx: float, *, told: bool = False) -> dict[str, Any]:
    """Walls that a grid cannot carry, by body; a warning in the log for each body with some.

    Args:
        scene: The scene; only its solids have walls.
        dx: Grid spacing [m].
        told: :func:`walls_note` has said it already; of a scene of one solid nothing is repeated.

    Returns:
        By name what :func:`gsfluent.pipeline.solid.walls.thin_shells` reports in scene metres, and
        ``solve_cells``: the ``solve.cells`` with which the thinnest walls have
        :data:`WALL_CELLS` cells, and ``note``, the warning; None where they have.
    """
    found = {}
    solids = [body for body in scene.bodies if body.solid is not None]
    for body in solids:
        report = _walls(body, dx)
        if report["middle"] is not None:
            # measured from the corner of the grid, in metres
            assert body.solid is not None
            origin = SignedDistance.of_solid(body.solid).origin
            local = torch.tensor(report["middle"]) - origin
            report["middle"] = body.frame.apply(origin + local / body.frame.scale).tolist()
        report["solve_cells"] = report["note"] = None
        smeared = any(material.law == "phase_field" for material in body.materials)
        if report["warning"] and (smeared or len(solids) > 1 or not told):
            report["solve_cells"] = cells_for(scene, dx / report["cells_needed"])
            asked = setting(report["solve_cells"])
            report["hint"] = f"{asked}: {report['hint']}"
            report["note"] = (
                f"{body.name}: {report['warning']}, too few to break as walls do; hint: {asked} "
                f"gives them {WALL_CELLS:g} cells"
            )
            if smeared:
                report["note"] += (
                    "; cracks of law phase_field are wider than such walls, and what strikes "
                    "punches through: law: nacc cracks them"
                )
            _log.warning("%s", report["note"])
        found[body.name] = report
    return found


FINER = 8
"""How many times finer than a quality says cells are made for walls, at most."""

THIN = f"walls thinner than {WALL_CELLS:g} cells"
"""Begins what is said of cells that walls get."""

MOSTLY = 0.25
"""Share of its surface on thin walls from which a body is refined for them: a bowl, and no apple
with a ragged rim, which would take twelve times the points."""


def cells_for_walls(scene: Scene, quality: str, most: int) -> tuple[int, int]:
    """Cells along the largest solid with which walls have :data:`WALL_CELLS` cells.

    Args:
        scene: The scene.
        quality: Name of a quality, whose cells are the fewest.
        most: Most material points; with 0 the cells are those of the quality.

    Returns:
        ``(cells, wanted)``: as many as ``most`` and :data:`FINER` allow, and as the walls want.
    """
    least = QUALITY[quality]
    if not most or all(body.solid is None for body in scene.bodies):
        return least, least
    dx = grid_spacing(scene, least)
    reports = [_walls(body, dx) for body in scene.bodies if body.solid is not None]
    finer = max((r["cells_needed"] for r in reports if r["share"] >= MOSTLY), default=1.0)
    wanted = cells_for(scene, dx / finer)
    volume = sum(body.volume for body in scene.bodies)
    held = int(grid_spacing(scene, 1) * (most / (POINTS_PER_CELL * volume)) ** (1.0 / 3.0))
    return max(least, min(wanted, held, FINER * least)), wanted


def walls_note(quality: str, cells: int, wanted: int, most: int) -> str:
    """What finer cells for walls cost and what they do not reach; empty where nothing is finer."""
    least = QUALITY[quality]
    if wanted <= least:
        return ""
    times = cells / least
    said = (
        f"{THIN}: {cells} cells instead of the {least} of "
        f"quality: {quality}, {times**3:.2g} times the points and {times:.2g} times the steps"
    )
    if cells == least:
        said = f"{THIN}, and no finer cells are allowed"
    if cells < wanted:
        said += (
            f"; the thinnest then have {WALL_CELLS * cells / wanted:.2g} cells, too few to bend "
            f"and break as walls do; {wanted} would hold them for {(wanted / cells) ** 4:.2g} "
            f"times the work, more than solve.max_points: {most} and {FINER} times the cells of "
            f"the quality allow; hint: solve.cells: {wanted}, or a thicker object"
        )
    else:
        said += f"; hint: solve.cells: {least} if they may bend as one"
    return said


def _walls(body: Body, dx: float) -> dict[str, Any]:
    """Of the walls of a solid, in scene metres; see :func:`thin_walls`."""
    assert body.solid is not None  # asked for solids only
    return dict(_shells(body.solid, body.frame.scale, dx))


@functools.lru_cache(maxsize=4)  # the cells are chosen by what is then said of them
def _shells(solid: Solid, scale: float, dx: float) -> dict[str, Any]:
    splats = solid.gaussians
    assert splats.labels is not None  # a solid has labels
    skin = splats.select(splats.labels.eq(SURFACE))
    field = SignedDistance.of_solid(solid)
    return thin_shells(
        field.replace(values=field.values * scale, voxel=field.voxel * scale),
        dx,
        gaussian_size=scale * float(skin.scales.amax(1).median()) if skin.count else None,
        unit=" m",
    )


def lowered(scene: Scene, dx: float) -> list[str]:
    """Materials whose strength a grid lowers to keep their fracture energy, a sentence each.

    Args:
        scene: The scene.
        dx: Grid spacing [m].
    """
    found: dict[tuple[str, str], str] = {}
    for body in scene.bodies:
        for material in body.materials:
            if material.law == "phase_field":
                said = bound_length(body.name, material, body.volume ** (1 / 3), dx)
                found |= {(body.name, material.name): said} if said else {}
                continue
            kept = kept_strength(material, dx)
            if kept < LOWERED:
                found[body.name, material.name] = (
                    f"{body.name}: cells of {1000 * dx:.3g} mm are too coarse for the strength and "
                    f"the fracture energy of {material.name} both; {_percent(kept)} of the "
                    f"strength are left, so it breaks from {_percent(kept)} of its speed; hint: "
                    f"solve.cells: {cells_for(scene, dx * kept**2)} keeps both, prefer: strength "
                    "keeps the strength and makes cracks tougher"
                )
    return list(found.values())


def bound_length(name: str, material: Material, size: float, dx: float) -> str:
    """What a grid makes of a phase-field material where something gives way; else empty.

    Args:
        name: Of the body.
        material: Of law ``phase_field``.
        size: Of the body, the cube root of its volume [m].
        dx: Grid spacing [m].
    """
    length, strong, tough = phase_field.kept(material, dx)
    said = f"{name}: cracks of {material.name} are {4000 * length:.3g} mm wide"
    if strong < LOWERED:
        return (
            f"{said}, two cells of {1000 * dx:.3g} mm bind: {_percent(strong)} of the strength are "
            "left; hint: finer cells, or prefer: strength, which makes cracks tougher"
        )
    if tough * LOWERED > 1.0:
        return (
            f"{said}, two cells of {1000 * dx:.3g} mm bind: a crack takes {tough:.3g} times its "
            "toughness; hint: finer cells, or prefer: toughness"
        )
    if size < THIN_BODY * length:
        return (
            f"{said} in a body of {1000 * size:.3g} mm: its strength decides and not its "
            "toughness; hint: give tensile_strength, or finer cells"
        )
    return ""


def cells_for(scene: Scene, dx: float) -> int:
    """Cells along the largest solid that make a grid at least as fine as ``dx`` [m]."""
    return math.ceil(grid_spacing(scene, 1) / dx - 1e-9)


def setting(cells: int) -> str:
    """How a shot asks for so many cells along its largest solid."""
    enough = [name for name, count in QUALITY.items() if count >= cells]
    return f"solve.cells: {cells}" + (f" (or solve.quality: {enough[0]})" if enough else "")


def notes_of(
    thin: Mapping[str, Any],
    weak: Sequence[str],
    unbroken: Sequence[Mapping[str, Any]],
    pull: float,
) -> list[str]:
    """What a reader of the verdict must know although the run is sound, a sentence each.

    Args:
        thin: Of :func:`thin_walls`.
        weak: Of :func:`lowered`.
        unbroken: Of :meth:`gsfluent.stages.strikes.Strikes.unbroken`.
        pull: Strength of gravity [m/s^2].
    """
    notes = [report["note"] for report in thin.values() if report["note"]]
    notes.extend(weak)
    for row in unbroken:
        speed, needed = row["speed"], row["speed_needed"]
        fall = f" (a fall of {needed**2 / (2.0 * pull):.2g} m)" if pull > 0.0 else ""
        but = "" if speed < needed else "strike harder still, "
        hint = f"; hint: {row['hint']}" if row["hint"] else ""
        notes.append(
            f"{row['body']} met {row['met']} at {speed:.2g} m/s and nothing broke; {but}"
            f"{row['material']} is estimated to break from about {needed:.2g} m/s{fall}{hint}"
        )
    return notes


def summary(per_frame: Mapping[str, Sequence[Any]]) -> str:
    """How a run ended, in one sentence; what the run has not counted is left out."""

    def last(*names: str) -> Any:
        return next((per_frame[name][-1] for name in names if per_frame.get(name)), None)

    pieces, large = last("pieces", "fragments"), last("pieces_over_1_percent")
    loose, broken = last("loose_fraction"), last("broken_fraction", "damaged_fraction")
    said = []
    if pieces is not None:
        said.append(f"{pieces} {'piece' if pieces == 1 else 'pieces'}")
        said[0] += "" if large is None else f" ({large} over 1 % of the mass)"
    if loose is not None:
        said.append(f"{_percent(loose)} of the mass loose")
    if broken is not None:
        said.append(f"{_percent(broken)} broken")
    return ", ".join(said)


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"
