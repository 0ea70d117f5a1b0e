"""What a run says of breaking: strikes that broke nothing, walls too thin, the sentence at the end.

Speeds, heights and thicknesses are known in closed form.
"""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from simulation_scenes import at
from simulation_shapes import ellipsoid

from gsfluent import materials
from gsfluent.pipeline.matter.brittle import kept_strength
from gsfluent.pipeline.matter.points import grid_spacing
from gsfluent.pipeline.simulate.stage import Simulate
from gsfluent.pipeline.solid.walls import WALL_CELLS
from gsfluent.results.record import RunRecord
from gsfluent.scene.scene import Scene
from gsfluent.stages.breaking import breaks_from
from gsfluent.stages.findings import (
    MOSTLY,
    cells_for,
    cells_for_walls,
    lowered,
    notes_of,
    setting,
    summary,
    thin_walls,
    walls_note,
)
from gsfluent.stages.strikes import FILE, Strikes

HARD = materials.bread.override(
    tensile_strength=1e6,
    compressive_strength=2e6,
    fracture_energy=1e6,
    weibull_modulus=0.0,
    name="hard",
)
"""Brittle, slow waves (few steps), and too strong for what these tests do to it."""
DX = 0.02


def ball(scene: Scene, name: str, x: float, z: float, **more: Any) -> None:
    scene.add(
        ellipsoid((0.06,) * 3, voxels=16, splats=20), HARD, frame=at(x, 0, z), name=name, **more
    )


def watch(scene: Scene, folder: Path, seconds: float, fps: float = 50.0) -> Strikes:
    frames = Simulate(dx=DX, splats=False)(scene, fps=fps, seconds=seconds)
    strikes = Strikes(scene, frames.run.matter, folder)
    for frame in frames:
        strikes.see(frame)
    assert frames.report["verdict"] == "clean", frames.report["reason"]
    return strikes


@pytest.mark.parametrize("drop", [0.1, 0.3])
def test_a_fall_that_breaks_nothing_is_told_with_its_speed(drop: float, tmp_path: Path) -> None:
    scene = Scene()
    ball(scene, "ball", 0.0, 0.06 + drop, velocity=(3.0, 0, 0))  # what slides does not strike
    (found,) = watch(scene, tmp_path, math.sqrt(2 * drop / 9.81) + 0.1).unbroken()
    assert (found["body"], found["met"], found["material"]) == ("ball", "floor", "hard")
    assert found["speed"] == pytest.approx(math.sqrt(2 * 9.81 * drop), rel=0.1)
    low, high = scene.bodies[0].bounds()
    assert found["speed_needed"] == breaks_from(HARD, float((high - low).max()), DX)
    assert found["speed_needed"] > found["speed"]


def test_what_lies_there_or_falls_past_was_not_struck(tmp_path: Path) -> None:
    scene = Scene()
    ball(scene, "lies", 0.0, 0.06)
    ball(scene, "flies", 0.135, 0.45, velocity=(0, 0, -3.0))  # past it, 15 mm away
    strikes = watch(scene, tmp_path, 0.12)
    low = float(strikes.rows[-1]["bodies"][1]["low"][2])
    assert low < 0.06 and strikes.met == [] and strikes.unbroken() == []


def test_two_bodies_meet_at_their_relative_speed(tmp_path: Path) -> None:
    scene = Scene(floor=None, gravity=(0, 0, 0))
    ball(scene, "left", -0.11, 0.0, velocity=(2.0, 0, 0))
    ball(scene, "right", 0.11, 0.0, velocity=(-1.0, 0, 0))
    found = watch(scene, tmp_path, 0.12).unbroken()
    assert [(row["body"], row["met"]) for row in found] == [("left", "right"), ("right", "left")]
    assert [row["speed"] for row in found] == pytest.approx([3.0, 3.0], rel=0.02)


@pytest.mark.parametrize("rigid", [True, False])
@pytest.mark.parametrize("start", [0.0, 0.047])
def test_a_bullet_that_bounces_off_is_told(rigid: bool, start: float, tmp_path: Path) -> None:
    scene = Scene()
    ball(scene, "ball", 0.0, 0.06)
    name = scene.bullet((-0.2, 0, 0.08), (0, 0, 0.08), 6.0, radius=0.02, at=start, rigid=rigid)
    (found,) = watch(scene, tmp_path, 0.12).unbroken()
    assert (found["body"], found["met"]) == ("ball", name)
    assert found["speed"] == pytest.approx(6.0, rel=0.05)


def test_a_run_in_which_something_broke_has_nothing_to_tell(tmp_path: Path) -> None:
    scene = Scene()
    weak = materials.bread.override(
        tensile_strength=100.0, compressive_strength=1000.0, fracture_energy=0.1
    )
    ball(scene, "hard", 0.3, 0.1)
    scene.add(ellipsoid((0.06,) * 3, voxels=16), weak, frame=at(0, 0, 0.16), velocity=(0, 0, -4.0))
    strikes = watch(scene, tmp_path, 0.15)
    assert strikes.broken[0] == 0.0 and strikes.broken[1] > 0.01
    assert strikes.unbroken() == []


def test_a_run_taken_up_again_knows_what_came_before(tmp_path: Path) -> None:
    scene = Scene()
    ball(scene, "ball", 0.0, 0.16)
    frames = Simulate(dx=DX, splats=False)(scene, fps=50.0, seconds=0.24)
    matter, seen = frames.run.matter, list(frames)
    whole = Strikes(scene, matter, tmp_path)
    for frame in seen:
        whole.see(frame)
        if frame.index in (4, 9):
            whole.keep()
            kept = (tmp_path / FILE).read_bytes()
    assert whole.met != []
    # it stopped after the second file, with the state of the first or of the second
    for first in (5, 10):
        (tmp_path / FILE).write_bytes(kept)
        again = Strikes(scene, matter, tmp_path)
        for frame in seen[first:]:
            again.see(frame)
        assert (again.met, again.broken) == (whole.met, whole.broken)
        assert again.unbroken() == whole.unbroken() != []
    (tmp_path / FILE).write_text("{")
    assert Strikes(scene, matter, tmp_path).met == []


def slab() -> Scene:
    scene = Scene()
    scene.add(ellipsoid((0.1, 0.1, 0.015), voxels=64), HARD, frame=at(0, 0, 0.015), name="plate")
    return scene


def test_thin_walls_are_told_with_the_cells_that_would_do(caplog: pytest.LogCaptureFixture) -> None:
    scene = slab()
    coarse = grid_spacing(scene, 16)
    with caplog.at_level(logging.WARNING):
        report = thin_walls(scene, coarse)["plate"]
    assert report["limit"] == pytest.approx(WALL_CELLS * coarse)
    assert report["cells"] == pytest.approx(report["thinnest"] / coarse) and report["cells"] < 2.5
    cells = report["solve_cells"]
    assert f"plate: {report['warning']}" in caplog.text and f"solve.cells: {cells}" in caplog.text
    assert f"{report['cells']:.2g} cells" in report["warning"]
    # what it asks for is just enough
    fine = grid_spacing(scene, cells)
    assert WALL_CELLS <= report["thinnest"] / fine < WALL_CELLS * cells / (cells - 1)
    caplog.clear()
    again = thin_walls(scene, coarse, told=True)["plate"]
    assert again["warning"] == report["warning"] and again["note"] is None and caplog.text == ""
    enough = thin_walls(scene, grid_spacing(scene, 2 * cells))["plate"]
    assert enough["warning"] is enough["solve_cells"] is None and caplog.text == ""
    assert cells_for(scene, fine) == cells
    assert setting(30) == "solve.cells: 30 (or solve.quality: shot)"
    assert setting(1000) == "solve.cells: 1000"


def test_a_phase_field_in_thin_walls_is_told_that_it_is_punched_through() -> None:
    scene, other = slab(), Scene()
    material = HARD.override(law="phase_field", toughness=10.0)
    other.add(scene.bodies[0].solid, material, frame=at(0, 0, 0.015), name="plate")
    coarse = grid_spacing(scene, 16)
    plain, said = (thin_walls(s, coarse)["plate"]["note"] for s in (scene, other))
    assert said.startswith(plain) and "law: nacc" in said and "phase_field" not in plain


def test_walls_get_the_cells_that_they_want_within_bounds() -> None:
    scene = slab()
    cells, wanted = cells_for_walls(scene, "preview", 10**7)
    assert cells == wanted > 20
    report = thin_walls(scene, grid_spacing(scene, cells))["plate"]
    assert report["warning"] is None  # which is what they are for
    note = walls_note("preview", cells, wanted, 10**7)
    assert f"{cells} cells instead of the 20" in note and "would hold them" not in note
    # held back by the points, it says what it does not reach
    volume, dx = scene.bodies[0].volume, grid_spacing(scene, cells)
    most = int(8 * volume / dx**3) // 2
    held, same = cells_for_walls(scene, "preview", most)
    assert 20 <= held < cells and same == wanted
    assert 8 * volume / grid_spacing(scene, held) ** 3 <= most or held == 20
    note = walls_note("preview", held, wanted, most)
    assert f"{wanted} would hold them" in note
    # and what is given up: the cells that a wall has then
    assert f"{WALL_CELLS * held / wanted:.2g} cells, too few" in note
    assert cells_for_walls(scene, "preview", 0) == (20, 20)
    thick = Scene()
    ball(thick, "ball", 0.0, 0.1)
    assert cells_for_walls(thick, "preview", 10**7) == (20, 20)
    assert walls_note("preview", 20, 20, 10**7) == ""


def test_a_thin_rim_of_a_thick_body_is_told_but_makes_no_finer_cells(
    caplog: pytest.LogCaptureFixture,
) -> None:
    solid = ellipsoid((0.1, 0.1, 0.09), voxels=64)
    rim = solid.occupancy.clone()
    width, _, height = rim.shape
    core = (torch.arange(width) - 0.5 * width).abs()[:, None, None] < 0.3 * width
    level = (torch.arange(height) - 0.5 * height).abs() < 1.5
    rim &= core | level
    scene = Scene()
    scene.add(solid.replace(occupancy=rim), HARD, frame=at(0, 0, 0.1), name="rimmed")
    assert cells_for_walls(scene, "preview", 10**7) == (20, 20)
    with caplog.at_level(logging.WARNING):
        report = thin_walls(scene, grid_spacing(scene, 20))["rimmed"]
    assert 0.05 < report["share"] < MOSTLY and "solve.cells" in caplog.text


def test_notes_are_whole_sentences_and_honest() -> None:
    row = {"body": "head", "material": "plaster", "met": "floor", "speed": 2.0, "speed_needed": 4.0,
           "hint": "a drop from 1 m"}  # fmt: skip
    (note,) = notes_of({}, [], [row], 9.81)
    assert "head met floor at 2 m/s and nothing broke" in note and "about 4 m/s" in note
    assert (
        "harder" not in note
        and f"a fall of {16 / (2 * 9.81):.2g} m" in note
        and note.endswith("hint: a drop from 1 m")
    )
    (note,) = notes_of({}, [], [row | {"speed": 5.0}], 0.0)
    assert "nothing broke; strike harder still, plaster is" in note and "fall" not in note
    thin = {"head": {"note": None}, "arm": {"note": "arm: 9 % of it is thin"}}
    assert notes_of(thin, [], [], 9.81) == ["arm: 9 % of it is thin"]


def test_a_grid_that_lowers_the_strength_says_so_with_the_cells_that_would_do() -> None:
    scene = Scene()
    glass = materials.glass
    scene.add(ellipsoid((0.1, 0.1, 0.1), voxels=24), glass, frame=at(0, 0, 0.1), name="ball")
    coarse = grid_spacing(scene, 16)
    (note,) = lowered(scene, coarse)
    kept = kept_strength(glass, coarse)
    assert (
        note.startswith("ball: cells of 12.5 mm") and f"{100 * kept:.2g} % of the strength" in note
    )
    assert notes_of({}, [note], [], 9.81) == [note]
    cells = int(note.split("solve.cells: ")[1].split()[0])
    assert kept_strength(glass, grid_spacing(scene, cells)) == pytest.approx(1.0, abs=0.05)
    strong = Scene()
    strong.add(
        ellipsoid((0.1, 0.1, 0.1), voxels=24), glass.override(prefer="strength"),
        frame=at(0, 0, 0.1), name="ball",
    )  # fmt: skip
    assert lowered(strong, coarse) == []


def test_the_end_of_a_run_is_one_sentence() -> None:
    old = {"fragments": [1, 7], "damaged_fraction": [0.0, 0.25]}
    assert summary(old) == "7 pieces, 25 % broken"
    new = {"pieces": [1, 1], "pieces_over_1_percent": [1, 1], "loose_fraction": [0.0, 0.0123]}
    said = summary(old | new | {"broken_fraction": [0.0, 0.05]})
    assert said == "1 piece (1 over 1 % of the mass), 1.2 % of the mass loose, 5 % broken"
    assert summary({}) == ""


def test_the_verdict_of_a_run_names_its_notes(tmp_path: Path) -> None:
    record = RunRecord(tmp_path / "run.json", {}, torch.device("cpu"), 0)
    record.values["simulation"] = {"verdict": "clean", "reason": "", "notes": ["one", "two"]}
    record.finish([])
    values = json.loads((tmp_path / "run.json").read_text())
    assert values["verdict"] == "clean" and values["reason"].endswith("healed; one; two")
