"""Fragments of three materials: figures by hand, lines that are resumed, table and picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from loaded_scripts import load_script

from gsfluent import materials
from gsfluent.fracturebench.statistics import Figures

script = load_script("fracturebench/fragments")


def made(*pieces: float) -> Figures:
    """Figures of pieces of these masses."""
    return Figures(np.zeros((2, 3)), np.zeros(2), np.sort(np.array(pieces)), 0.1)


def line(name: str, cells: int, runs: list[Figures], **more: object) -> dict[str, object]:
    return {
        **script.key_of(name, cells, len(runs), "cpu"), "points": 100 * cells, "thrown_at": 3.0,
        "machine": "made", "commit": "", "wall": 0.0, "runs": [f.plain() for f in runs], **more,
    }  # fmt: skip


def test_figures_of_known_pieces() -> None:
    found = script.Fragments.of(made(0.6, 0.3, 0.08, 0.01, 0.006, 0.004))
    assert (found.count, found.largest) == (4, 0.6) and found.loose == pytest.approx(0.01)
    finer = script.finer(made(0.6, 0.3, 0.1), np.array([0.05, 0.1, 0.3, 0.59, 1.0]))
    assert finer.tolist() == pytest.approx([0.0, 0.1, 0.4, 0.4, 1.0])


def test_a_ball_is_thrown_once_per_seed_and_not_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = tmp_path / "lines.jsonl"
    words = ["-o", str(lines), "--cells", "2", "--seeds", "2"]
    assert script.main(words) == 0
    rows = script.read(lines)
    assert [r["name"] for r in rows] == [*script.THROWS]
    for row in rows:
        throw = script.THROWS[row["name"]]
        preset = materials.get(throw.preset)
        wanted = min(0.25, throw.speed * preset.failure_strain) * preset.wave_speed
        assert row["thrown_at"] == pytest.approx(wanted)
        runs = script.figures_of(row)
        assert len(runs) == 2 and all(f.pieces.sum() == pytest.approx(1.0) for f in runs)
    lines.write_text(lines.read_text() + '{"name": "gl')  # cut off
    capsys.readouterr()
    assert script.main(words) == 0
    assert capsys.readouterr().err.count(": there") == 3 and len(script.read(lines)) == 3
    # what is added after a line that was cut off can be read
    assert script.main([*words[:-1], "3"]) == 0 and len(script.read(lines)) == 6


def test_lines_of_another_throw_or_device_do_not_count() -> None:
    whole, split = [made(1.0)] * 2, [made(0.5, 0.5)] * 2
    rows = [
        line("glass", 4, whole), line("glass", 6, split), line("glass", 4, split),
        line("ceramic", 4, whole, speed=9.0, device="cuda"), line("watermelon", 4, whole, radius=1),
    ]  # fmt: skip
    found = script.ladders(rows, "cpu")
    assert list(found) == ["glass"] and [r["cells"] for r in found["glass"]] == [4, 6]
    assert [f.pieces.size for f in script.figures_of(found["glass"][0])] == [2, 2]  # the latest


def test_table_and_picture_show_the_spread(tmp_path: Path) -> None:
    coarse = [made(0.5, 0.5), made(0.9, 0.095, 0.005)]
    fine = [made(0.5, 0.3, 0.2), made(0.5, 0.3, 0.2)]
    found = script.ladders([line("glass", 4, coarse), line("glass", 8, fine)], "cpu")
    rows = [row for row in script.table(found).splitlines() if row.startswith("| glass")]
    assert "2.0 (2.0 to 2.0) | 0.70 (0.50 to 0.90) | 0.00 (0.00 to 0.01)" in rows[0]
    assert "| 3.0 (3.0 to 3.0) | 0.50 (0.50 to 0.50) |" in rows[1]
    assert rows[1].endswith("0.00 (0.00 to 0.00), band |")  # the same runs: no band
    # fine: 0.5 at 0.3, where halves have 0, and 1 at 0.5, where that of 0.9 has 0.1
    assert rows[0].endswith("| 0.70 (0.50 to 0.90) |")
    picture = tmp_path / "fragments.png"
    script.draw(found, picture)
    assert picture.read_bytes()[:4] == b"\x89PNG" and picture.stat().st_size > 20_000


def test_what_is_committed_has_three_materials_grids_and_a_band() -> None:
    found = script.ladders(script.read(script.LINES), "cpu")
    assert list(found) == [*script.THROWS]
    for rows in found.values():
        assert len(rows) >= 3 and all(len(r["runs"]) >= 5 for r in rows)
    text = script.PAGE.read_text(encoding="utf-8")
    for row in script.table(found).splitlines():
        assert row in text


def test_one_run_has_no_band(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        script.main(["-o", str(tmp_path / "x.jsonl"), "--seeds", "1"])
    assert not (tmp_path / "x.jsonl").exists()
