"""scripts/study/drop_heights.py: one tiny object from end to end, and how a median is found."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import ModuleType

import pytest
import torch
from loaded_scripts import load_script

from gsfluent import materials

SHAPES = load_script("study/drop_shapes")


@pytest.fixture
def drops() -> ModuleType:
    return load_script("study/drop_heights")


def fall(drops: ModuleType, height: float, broken: bool, seed: int = 0) -> object:
    return drops.Fall(height, seed, broken, broken, 1.0, 1, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, True)


def test_a_tiny_ball_from_end_to_end(
    drops: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = drops.Case("plaster_ball", SHAPES.ball(0.1), 20.0, 12.0)
    monkeypatch.setattr(drops, "case_of", lambda name, given: tiny)
    monkeypatch.setattr(drops, "LADDER", (1e-3, 1.0, 20.0))
    output, page = tmp_path / "drops.jsonl", tmp_path / "drops.md"
    page.write_text("# Drops\n\nwords\n")
    given = ["--quick", "--seeds", "1", "--only", "plaster_ball", "--stiffness", "preset",
             "-o", str(output), "--markdown", str(page)]  # fmt: skip
    assert drops.main(given) == 0
    (row,) = map(json.loads, output.read_text().splitlines())
    falls = row["falls"]
    assert falls[0]["height"] == pytest.approx(1.5e-3) and falls[0]["left"]
    assert falls[0]["ever"] == 0.0 and not falls[0]["broken"]  # 0.17 m/s: no plaster breaks
    assert 0.3 < falls[0]["restitution"] <= 1.0
    assert falls[-1]["height"] == 30.0 and falls[-1]["broken"]  # 24 m/s: all does
    assert falls[-1]["ever"] > 0.5
    assert row["low"] <= row["height"] <= row["high"]
    assert row["mass"] == pytest.approx(math.pi / 6 * 0.1**3 * 1000.0, rel=0.05)
    text = page.read_text()
    assert text.startswith("# Drops\n\nwords\n")
    assert text.count("| plaster ball | nacc | 1/100 |") == 1
    # what is there is not run again
    monkeypatch.setattr(drops, "study", lambda *_: pytest.fail("run again"))
    assert drops.main(given) == 0 and page.read_text() == text


def test_the_median_is_between_heights_of_which_half_break(drops: ModuleType) -> None:
    def middle(*groups: tuple[float, str]) -> tuple[float | None, float, float]:
        return drops.median(
            [fall(drops, h, c == "x", s) for h, word in groups for s, c in enumerate(word)]
        )

    assert middle((1.0, "...."), (4.0, "xxxx")) == (pytest.approx(2.0), 1.0, 4.0)
    assert middle((1.0, "...x"), (4.0, "xxx."))[0] == pytest.approx(2.0)
    # one specimen that happens to break lower down does not make two medians
    found = middle((1.0, "...."), (2.0, "xx.."), (4.0, "x..."), (8.0, "xxxx"))[0]
    assert found is not None and 4.0 < found < 8.0
    assert middle((1.0, "...."), (4.0, "x...")) == (None, 1.0, math.inf)
    assert middle((1.0, "xxxx"), (4.0, "xxxx")) == (None, 0.0, 1.0)


@pytest.mark.parametrize(
    "name", ["egg_on_side", "glass_plate_framed", "glass_tumbler", "ceramic_bowl", "bread"]
)
def test_bodies_have_the_mass_of_the_real_ones(drops: ModuleType, name: str) -> None:
    heights = drops.tomllib.loads((drops.DATA / "drop_heights.toml").read_text())
    given = heights[name]
    case = drops.case_of(name, given)
    drop = drops.Drop(case, given, "preset", "cpu", coarse=False)
    mass = float(drop.material.density) * drop.body.volume
    assert mass == pytest.approx(given["mass_kg"], rel=0.2)
    solid = drop.body
    assert solid.occupancy.shape[2] == pytest.approx(
        2.0 * case.shape.half[2] / solid.voxel, abs=max(4.0, 0.03 * solid.occupancy.shape[2])
    )
    assert bool(solid.occupancy[:, :, 0].any()) and float(solid.origin[2]) == 0.0


def test_a_pane_in_its_frame_cracks_along_its_middle(
    drops: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its edges are held and its middle falls on: only a high fall breaks it, and in bending."""
    given = drops.tomllib.loads((drops.DATA / "drop_heights.toml").read_text())[
        "glass_plate_framed"
    ]
    case = dataclasses.replace(drops.case_of("glass_plate_framed", given), cells=1.0, limit=10.0)
    drop = drops.Drop(case, given, "real", "cpu", coarse=False)
    runs = []

    class Watched(drops.Run):  # type: ignore[name-defined,misc]
        def __init__(self, *given: object) -> None:
            super().__init__(*given)
            runs.append((self, self.matter.particles.position.clone()))

    monkeypatch.setattr(drops, "Run", Watched)
    drop.fall([(0.02, 0), (8.0, 0)], 1e6)
    whole, broken = drop.falls
    assert (whole.ever, whole.broken, broken.broken) == (0.0, False, True)
    ((run, start),) = runs
    second = run.state.particles.body == 1
    ever, start = run.state.ever[second].bool(), start[second]
    away = (start[:, 1] - start[:, 1].mean()).abs() / start[:, 1].std()
    middle = away < 0.7
    assert bool(ever[middle].any())
    assert float(ever[middle].float().mean()) > 2.0 * float(ever[~middle].float().mean())


def test_a_thicker_shell_is_as_stiff_and_strong_under_a_point(drops: ModuleType) -> None:
    egg = materials.get("egg")
    made = drops.thicker(egg, 4.0, 0.06, 2e-5)
    assert made.softening == egg.softening and float(made.density) == pytest.approx(3000.0)
    assert made.young_modulus * 4.0**2 == pytest.approx(egg.young_modulus)
    tensile, compressive = (float(s) for s in made.strengths())
    assert (16.0 * tensile, 16.0 * compressive) == pytest.approx(
        tuple(float(s) for s in egg.strengths())
    )
    # Bazant's size number over the wall: E G / (s^2 h)
    before = egg.young_modulus * egg.fracture_energy / egg.tensile_strength**2
    after = made.young_modulus * made.fracture_energy / made.tensile_strength**2
    assert after == pytest.approx(4.0 * before)


def test_the_real_stiffness_is_that_of_the_handbook(drops: ModuleType) -> None:
    melon = drops.stiff(materials.get("fruit.watermelon"), "real")
    assert melon.young_modulus == pytest.approx(8e5) and melon.softening == 1.0
    assert dict(melon.parts[0])["young_modulus"] == pytest.approx(2e6)
    same = materials.get("bread")
    assert drops.stiff(same, "real") is same
    assert dataclasses.is_dataclass(melon) and torch.is_tensor(melon.parameters())


def test_a_fruit_is_cracked_by_what_broke_above_its_middle(drops: ModuleType) -> None:
    heights = drops.tomllib.loads((drops.DATA / "drop_heights.toml").read_text())
    assert drops.case_of("apple", heights["apple"]).fruit
    assert not drops.case_of("plaster_ball", heights["plaster_ball"]).fruit
    falls = {}
    for fruit in (True, False):
        case = dataclasses.replace(
            drops.case_of("watermelon", heights["watermelon"]), cells=10.0, fruit=fruit
        )
        drop = drops.Drop(case, heights["watermelon"], "preset", "cpu", False)
        drop.fall([(0.05, 0), (0.9, 0)], 1e6)
        falls[fruit] = drop.falls
    low, high = falls[True]
    assert not low.broken and low.above == low.ever == 0.0
    assert high.above > drops.PASSED and high.ever < drops.CRUSHED and not high.parted
    assert high.broken and not falls[False][1].broken
