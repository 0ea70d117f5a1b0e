"""The recorded maps: every default inside with margin; what reads, runs and draws such lines."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from in_process import swept

from gsfluent.cli import main
from gsfluent.errors import InputError
from gsfluent.figure.map import Cell, Plane, draw_planes, place_of
from gsfluent.lab.stability import maps as stability
from gsfluent.lab.stability import report as stability_report
from gsfluent.lab.stability import run as running
from gsfluent.lab.stability.maps import Axis, Map, Outcome, Place, Point, Violation
from gsfluent.lab.stability.peers import KNOWN, marks, measured

RECORDED = (
    Path(__file__).resolve().parents[3] / "docs" / "measured" / "data" / "stability_cpu.jsonl"
)


@pytest.fixture(scope="module")
def recorded() -> list[Point]:
    return stability.read(RECORDED)


def test_every_point_of_every_map_is_recorded(recorded: list[Point]) -> None:
    maps = list(running.all_maps().values())
    wanted = {f"{m}|{v}|{x}|{y}" for m, v, x, y in running.points(maps)}
    assert wanted == {f"{p.map}|{p.variant}|{p.x}|{p.y}" for p in recorded}
    assert len(maps) >= 12 and len(recorded) > 2000


@pytest.mark.parametrize("name", sorted(running.all_maps()))
def test_the_default_is_inside_with_margin(name: str, recorded: list[Point]) -> None:
    m = running.all_maps()[name]
    assert stability_report.verdict([m], recorded) == []
    walks = stability_report.worst(m, recorded)
    assert walks and all(w.inside for w in walks)
    for walk in walks:
        if walk.axis.setting and not walk.axis.words and walk.margin is not None:
            assert walk.margin >= 1.2


def test_the_verdict_sees_a_default_that_fails_or_is_near_failing(recorded: list[Point]) -> None:
    m = running.all_maps()["poisson"]

    def spoilt(x: float, y: float) -> list[str]:
        points = [
            dataclasses.replace(p, step=3, kind="energy")
            if (p.map, p.x, p.y) == ("poisson", x, y)
            else p
            for p in recorded
        ]
        return stability_report.verdict([m], points)

    assert any("fails at courant 0.5" in line for line in spoilt(0.5, 0.4))
    assert any("margin 1 of courant" in line for line in spoilt(0.6, 0.1))
    assert spoilt(0.8, 0.1) == []


def test_stable_courant_numbers_of_the_specification(recorded: list[Point]) -> None:
    """solver.md: 1.3 bulk, 1.0 free cube, 0.9 at nu 0.45, 0.7 and not 1.0 isolated."""
    held = {(p.map, p.variant, p.x, p.y): p.holds for p in recorded}
    assert held["points_per_cell", "held between planes", 1.35, 8.0]
    assert held["poisson", "gsfluent", 1.0, 0.3] and not held["poisson", "gsfluent", 1.1, 0.3]
    assert held["poisson", "gsfluent", 0.9, 0.45] and not held["poisson", "gsfluent", 1.0, 0.45]
    for size in range(1, 9):
        assert held["fragments", "gsfluent", 0.7, float(size)]
        assert not held["fragments", "gsfluent", 1.0, float(size)]


def test_named_points_of_the_peers_lie_where_their_choice_fails(recorded: list[Point]) -> None:
    maps = list(running.all_maps().values())
    lines = [x for m in maps for x in stability_report.named(m, recorded, marks(maps))]
    assert len(lines) == sum(map(len, KNOWN.values()))
    holding = [line for line in lines if line.endswith("holds")]
    assert len(holding) == 3 and all("its demo" in x or "step (0.6)" in x for x in holding)


def test_failures_measured_on_programs_become_points(tmp_path: Path) -> None:
    path = tmp_path / "failures.json"
    item = {
        "name": "pull_apart", "peer": "physgaussian", "version": "1", "what": "speed kept",
        "axes": {"fields": 1, "v_over_c": 0.02}, "seen": 0.46, "right": 1.0, "reproduced": True,
        "note": "",
    }  # fmt: skip
    path.write_text(json.dumps([item, item | {"name": "unknown"}, item | {"axes": {}}]))
    found = measured(path)
    assert [m.failed for m in found] == [True, True] and found[1].mark is None
    maps = list(running.all_maps().values())
    added = marks(maps, found)["fields", "one field"][0]
    assert (added.x, added.y, added.name) == (0.0, 0.02, "physgaussian, measured")
    path.write_text('{"a": 1}')
    with pytest.raises(InputError, match="failures of the peers"):
        measured(path)


RUNS: list[tuple[float, str]] = []


def slope(x: float, y: str, variant: str, place: Place) -> Outcome:
    """Fails above 2, later the nearer to it."""
    RUNS.append((x, y))
    bad = Violation(round(10 / (x - 2.0)), "energy", 2.0, 1.0) if x > 2.0 and y == "a" else None
    return Outcome(100, bad, 7)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Map:
    m = Map(
        "toy", "Toy", Axis("x", "x", (0.5, 1.0, 2.0, 3.0, 4.0), 1.0),
        Axis("y", "y", ("a", "b"), "a"), ("gsfluent",), slope, "test_toy",
    )  # fmt: skip
    monkeypatch.setattr(running, "all_maps", lambda: {"toy": m})
    RUNS.clear()
    return m


def test_a_broken_run_goes_on_and_nothing_is_run_twice(toy: Map, tmp_path: Path) -> None:
    path = tmp_path / "new" / "stability.jsonl"
    points = running.run_maps([toy], path)
    assert len(points) == len(RUNS) == 10
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:6]) + "\n" + lines[6][:40])  # stopped while writing
    RUNS.clear()
    seen: list[tuple[int, int, str]] = []
    again = running.run_maps([toy], path, progress=lambda *args: seen.append(args))
    assert len(RUNS) == 4 and seen[-1] == (10, 10, "toy")
    assert [(p.x, p.y, p.step) for p in again] == [(p.x, p.y, p.step) for p in points]
    assert len(stability.read(path)) == 10
    quick = running.points([toy], quick=True)
    assert [(x, y) for _, _, x, y in quick] == [(x, y) for y in "ab" for x in (0.5, 1.0, 4.0)]


def test_walks_margins_and_tables(toy: Map, tmp_path: Path) -> None:
    points = running.run_maps([toy], tmp_path / "s.jsonl")
    up, down, word = stability_report.boundaries(toy, points)
    assert (up.holds, up.fails, up.kind, up.step, up.margin) == (2.0, 3.0, "energy", 10, 2.0)
    assert (down.holds, down.fails, down.margin) == (0.5, None, 2.0)
    assert word.holds == "b" and word.margin is None
    assert stability_report.table([toy], points) == [
        ("toy", "x", "1", "a", "2", "3", "energy, step 10", "2")
    ]


def test_lines_that_are_none_are_refused_in_words(toy: Map, tmp_path: Path) -> None:
    path = tmp_path / "s.jsonl"
    path.write_text(json.dumps({"case": "bar"}) + "\n")
    with pytest.raises(InputError, match="line 1"):
        running.run_maps([toy], path)
    with pytest.raises(InputError, match="cannot be read"):
        stability.read(tmp_path)
    with pytest.raises(InputError, match="no such map"):
        running.chosen(["toy", "nonsense"])
    with pytest.raises(InputError, match="jobs"):
        running.run_maps([toy], path, jobs=0)


def test_where_a_value_lies_on_an_axis() -> None:
    assert place_of((1.0, 10.0, 100.0), 10.0) == 1.0
    assert place_of((1.0, 10.0, 100.0), 31.6227766) == pytest.approx(1.5)
    assert place_of((0.0, 1.0, 3.0), 2.0) == pytest.approx(1.5)
    assert place_of((1.0, 10.0), 11.0) is None
    assert place_of(("a", "b"), "b") == 1.0 and place_of(("a", "b"), "c") is None


def test_a_cell_has_the_colour_of_its_step(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from PIL import Image

    cells = {(0, 0): Cell(None), (1, 0): Cell(1, "E"), (2, 0): Cell(90, "E")}
    plane = Plane("Title", "", "x", "y", (1.0, 2.0, 3.0), (1.0,), cells, 100, star=(0, 0))
    path = draw_planes([plane], tmp_path / "map.png", kinds={"E": "energy"})
    pixels = Image.open(path).convert("RGB")
    colors = {color for _, color in pixels.getcolors(1 << 20) or []}
    assert (0xCF, 0xE9, 0xDC) in colors  # holds
    reds = [c for c in colors if c[0] > 180 and c[2] < 80 and c[1] < 60]
    pale = [c for c in colors if c[0] > 240 and 150 < c[1] < 245 and c[2] < 180]
    assert reds and pale  # at once, and late
    with pytest.raises(ValueError, match="no panels"):
        draw_planes([], tmp_path / "none.png", kinds={})


def test_the_verb_runs_a_map_and_draws_recorded_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    words = ["stability", "--device", "cpu", "--json", "-o", str(out)]
    assert main([*words, "--maps", "zero_weight,precision", "--quick"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["maps"] == 2 and result["points"] == 9 + 12
    assert result["not inside with margin"] == []
    page = (out / "stability.html").read_text()
    assert "zero_weight" in page and page.count("<img") == 2
    assert main([*words, "--draw", str(out / "stability.jsonl"), "--maps", "zero_weight"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 9
    assert main([*words, "--maps", "nonsense"]) == 2
    assert main([*words, "--draw", str(out / "stability.jsonl"), "--maps", "kernel"]) == 2


def test_rows_that_are_placed_leave_the_same_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = running.chosen(["zero_weight"])
    here = running.run_maps(wanted, tmp_path / "here.jsonl", quick=True)
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(running, "sweep_map", swept(calls))
    path = tmp_path / "there.jsonl"
    path.write_text(here[0].line())
    there = running.run_maps(wanted, path, quick=True, on="slurm")
    assert calls[0]["on"] == "slurm" and not path.with_suffix(".tasks").exists()
    same = [(p.key, p.step, p.kind, p.value, p.points) for p in here]
    assert [(p.key, p.step, p.kind, p.value, p.points) for p in there] == same
    assert [p.key for p in stability.read(path)] == [key for key, *_ in same]


@pytest.mark.slow
def test_two_processes_find_what_one_finds(tmp_path: Path) -> None:
    wanted = running.chosen(["zero_weight"])
    one, two = (
        running.run_maps(wanted, tmp_path / f"{jobs}.jsonl", quick=True, jobs=jobs)
        for jobs in (1, 2)
    )
    assert [(p.key, p.step, p.kind) for p in one] == [(p.key, p.step, p.kind) for p in two]
