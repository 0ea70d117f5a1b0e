"""The study of fracture over the resolution: areas of cuts, exponents, lines and tables."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from loaded_scripts import load_script
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.lab.problems.fracture.energy import rows_of
from gsfluent.pipeline.matter.crack_band import BAND_CELLS, softening_energy
from gsfluent.pipeline.matter.fragments import rest_links

study = load_script("study/fracture_resolution")


@pytest.mark.parametrize("jitter", [0.0, 0.25])
def test_area_of_cut_links_is_that_of_planes_of_all_directions(jitter: float) -> None:
    generator = torch.Generator().manual_seed(0)
    axis = (torch.arange(24, dtype=torch.float64) + 0.5) / 24.0 - 0.5
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    noise = 2.0 * torch.rand(points.shape, generator=generator, dtype=torch.float64) - 1.0
    points = points + jitter * noise / 24.0
    ball = points[points.norm(dim=1) < 0.5]
    links = rest_links(ball, ((0, ball.shape[0]),), (1.0 / 24.0,))
    each = study.link_area(links, ball, math.pi / 6.0)
    found = []
    for _ in range(40):
        normal = torch.randn(3, generator=generator, dtype=torch.float64)
        side = ball @ (normal / normal.norm()) > 0.01
        cut = side[links[:, 0]] != side[links[:, 1]]
        found.append(int(cut.sum()) * each / (math.pi / 4.0))
    assert sum(found) / len(found) == pytest.approx(1.0, abs=0.04)
    assert 0.85 < min(found) and max(found) < 1.15
    side = ball[:, 0] > 1e-9 if jitter == 0.0 else ball[:, 0] > 0.01
    flat = int((side[links[:, 0]] != side[links[:, 1]]).sum()) * each / (math.pi / 4.0)
    assert flat == pytest.approx(5.0 / 5.74, abs=0.06)


def test_exponent_is_that_of_a_power_law_and_none_of_one_grid() -> None:
    rows = [{"dx": dx, "v": 3.0 * dx**1.25} for dx in (0.1, 0.05, 0.02)]
    assert study.exponent(rows, "v") == pytest.approx(1.25)
    assert math.isnan(study.exponent(rows[:1], "v"))
    assert math.isnan(study.exponent([{"dx": 0.1, "v": 0.0}, {"dx": 0.2, "v": 1.0}], "v"))


def test_bodies_have_their_volumes() -> None:
    for shape, half, volume in (
        (study.ball, (0.1, 0.1, 0.08), 4.0 / 3.0 * math.pi * 0.1 * 0.1 * 0.08),
        (study.disc, (0.05, 0.02, 0.05), math.pi * 0.05**2 * 0.04),
        (study.notched, (0.02, 0.08, 0.02), 0.04 * 0.04 * 0.16 * (1.0 - 0.05 * 0.75)),
    ):
        body = study.solid(half, shape)
        assert int(body.occupancy.sum()) * body.voxel**3 == pytest.approx(volume, rel=0.05)


def test_a_fall_is_measured_once_and_entered(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    lines = tmp_path / "lines.jsonl"
    words = ["-o", str(lines), "--only", "drop", "--cells", "8"]
    assert study.main([*words, "--estimate"]) == 0 and not lines.exists()
    assert study.main(words) == 0
    row, higher = study.read(lines)
    assert higher["dissipated"] > 3.0 * row["dissipated"] and higher["broken"] > row["broken"]
    assert row["cells"] == 8 and row["verdict"] == "clean" and row["largest"] > 0.5
    assert 0.0 < row["dissipated"] < row["at_start"] and row["broken"] > 0.0
    assert row["blocks"] >= 0.9 * row["blocks_intact"] > 0.0
    lines.write_text(lines.read_text() + '{"part": "dr')  # cut off
    capsys.readouterr()
    assert study.main(words) == 0
    assert "there" in capsys.readouterr().err and len(study.read(lines)) == 2
    cells = study.line(row)
    assert len(cells) == len(study._HEAD) and cells[0] == "watermelon"
    assert "| 8 |" in study.seeds_table([row])
    assert study.main([*words, "--law", "rankine"]) == 0
    both = study.read(lines)
    assert [r["law"] for r in both] == ["nacc", "nacc", "rankine", "rankine"]
    assert both[2]["broken"] != row["broken"] and study.seeds_table(both).count("\n") == 3
    assert "rankine" in study.exponents(both)


def test_the_account_of_a_fall_adds_up() -> None:
    account = load_script("study/fracture_account")
    row = account.study(account.MELON, 8, 0)
    parts = [row[name] for name in ("relaxed", "torn", "pressed", "yielded")]
    assert min(parts) > -1e-3 * row["dissipated"]
    assert 0.75 * row["dissipated"] < sum(parts) < row["dissipated"]
    assert row["relaxed"] == max(parts) and row["torn"] > 0.0
    assert account.page_table([row]).count("\n") == 2


def stretched(share: float, rate: float, steps: int = 800) -> tuple[Any, float, float]:
    """Account of one point of melon that is torn, in float64: work done on it and stored in it."""
    account = load_script("study/fracture_account")
    melon = materials.get("fruit.watermelon")
    row, _, alpha = rows_of(melon, torch.ones(1, dtype=torch.float64), 0.0125)
    law, none = torch.tensor([1], dtype=torch.int32), torch.zeros(1, 6, dtype=torch.float64)
    viscous = torch.zeros(1, 9, dtype=torch.float64)
    viscous[0, 6:8] = torch.tensor([share, rate], dtype=torch.float64)
    pull = torch.zeros(1, 3, 3, dtype=torch.float64)
    pull[0, 0, 0] = 1.6 * abs(float(alpha[0])) / steps
    where = torch.zeros(1, dtype=torch.int32)
    volume = torch.ones(1, dtype=torch.float64)

    def state(strain: Tensor, alpha: Tensor, viscous: Tensor, time: float) -> Any:
        points = SimpleNamespace(
            strain=strain, alpha=alpha, viscous=viscous, affine=pull, volume=volume, mass=volume,
            material=where,
        )  # fmt: skip
        return SimpleNamespace(particles=points, time=time)

    now = state(none, alpha, viscous, 0.0)
    matter = SimpleNamespace(particles=now.particles, law=law, params=row)
    meter = account.Account()
    meter.begin(matter, now)
    work, stress = 0.0, none
    for step in range(steps):
        p = now.particles
        returned = ops.return_mapping(p.strain, p.alpha, pull, law=law, params=row, material=where)
        work += float(stress[0, 0] * pull[0, 0, 0])
        viscous, strain, alpha, stress = ops.viscous_step(
            p.viscous, p.strain, p.alpha, pull, returned[:3], law=law, params=row,
            material=where, dt=1.0,
        )  # fmt: skip
        now = state(strain, alpha, viscous, step + 1.0)
        meter(now)
    assert float(alpha[0]) >= 0.0
    held = ops.elastic_energy(now.particles.strain, law=law, params=row, material=where)
    stored = ops.viscous_energy(viscous, held, law=law, params=row, material=where)
    return meter, work, float(stored)


def test_the_account_of_a_torn_point_counts_what_its_spring_loses() -> None:
    melon = materials.get("fruit.watermelon")
    wanted = float(melon.fracture_energy or 0.0) / (BAND_CELLS * 0.0125)
    plain, work, stored = stretched(0.0, 0.0)
    assert float(plain.torn) == pytest.approx(wanted, rel=1e-2)
    kept, *_ = stretched(0.75, 0.0)  # a spring that never relaxes is not there
    assert float(kept.torn) == pytest.approx(float(plain.torn), rel=3e-3)
    assert abs(float(kept.relaxed)) < 3e-3 * float(kept.torn)  # steps are explicit
    slow, work, stored = stretched(0.75, 2e-3)
    assert float(slow.torn) < float(plain.torn) and float(slow.relaxed) > 0.0
    parts = float(slow.torn + slow.pressed + slow.relaxed)
    assert parts == pytest.approx(work - stored, rel=1e-10)


def test_what_a_point_takes_hangs_on_how_it_was_strained_before() -> None:
    account = load_script("study/fracture_account")
    row, _, alpha = rows_of(
        materials.get("fruit.watermelon"), torch.ones(1, dtype=torch.float64), 0.0125
    )
    held = account.energy_of_path(row, alpha, account.OPENED, 400)
    assert held == pytest.approx(softening_energy(row[0], float(alpha[0])), rel=1e-2)
    pulled = account.energy_of_path(row, alpha, (1.0, -0.32, -0.32), 400)
    sheared = account.energy_of_path(row, alpha, (1.0, -1.0, 0.0), 400)
    assert held < 0.6 * pulled < 0.2 * sheared
    with pytest.raises(ValueError, match="not broken"):
        account.energy_of_path(row, alpha, (0.0, 0.0, 0.0), 10)


@pytest.mark.parametrize("name", ["fruit.watermelon", "glass"])
def test_what_a_point_takes_by_rankine_is_its_energy_whichever_way_it_opens(name: str) -> None:
    account = load_script("study/fracture_account")
    melon = account.preset_of(name, "rankine")
    dx = account.SPACINGS[name]
    row, _, alpha = rows_of(melon, torch.ones(1, dtype=torch.float64), dx)
    wanted = float(melon.fracture_energy or 0.0) / (BAND_CELLS * dx)
    for way in (account.OPENED, (1.0, -0.3, -0.3), (1.0, -0.4, 0.0)):
        found = account.energy_of_path(row, alpha, way, 400)
        assert found == pytest.approx(wanted, rel=0.06), way


def test_the_account_by_rankine_tells_opening_from_sliding() -> None:
    account = load_script("study/fracture_account")
    trial = dataclasses.replace(account.MELON, height=2.0, law="rankine")
    row = account.study(trial, 8, 0)
    parts = [row[name] for name in ("relaxed", "torn", "pressed", "yielded")]
    assert row["law"] == "rankine" and min(parts) > -1e-3 * row["dissipated"]
    assert 0.75 * row["dissipated"] < sum(parts) < row["dissipated"]
    # the law itself takes no more than its share of the fracture energy from what broke
    area = row["broken_volume"] / (BAND_CELLS * row["dx"])
    assert row["torn"] > 0.25 * 25.0 * area


def test_a_thrown_ball_is_the_preset_on_its_grid(tmp_path: Path) -> None:
    scene = study.thrown("glass", 3e-4, 1e-4, 8)
    assert len(scene.materials) <= 16 and scene.v[0, 2] < 0.0
    strong = [math.sinh(-m["hardening"] * m["alpha"]) for m in scene.materials]
    assert min(strong) < max(strong)
    row = study.run_bench("watermelon", 3, 3, "cpu")
    row |= {"part": "bench", "name": "watermelon", "law": "nacc"}
    rows = [{**json.loads(json.dumps(row)), "cells": n} for n in (3, 4)]
    table = study.bench_table(rows)
    assert table.count("watermelon") == 2 and "band" in table


def test_a_melon_of_another_energy_is_measured_once(tmp_path: Path) -> None:
    surface = load_script("study/surface/melon")
    lines = tmp_path / "lines.jsonl"
    words = ["-o", str(lines), "--law", "rankine", "--energy", "60", "--cells", "8"]
    assert surface.main(words) == 0 and surface.main(words) == 0
    (row,) = study.read(lines)
    assert (row["law"], row["gc"], row["height"], row["cells"]) == ("rankine", 60.0, 2.0, 8)
    assert row["blocks"] > 1.0 and row["broken"] > 0.0
    trial = surface.Melon(study.MELON.material, study.MELON.half, 0.2, energy=60.0)
    assert trial.matter.fracture_energy == trial.matter.parts[0]["fracture_energy"] == 60.0


def test_an_unknown_part_is_named() -> None:
    with pytest.raises(SystemExit, match="dorp"):
        study.main(["--only", "dorp", "--estimate"])
