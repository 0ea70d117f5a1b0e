"""The measure of a wetted ball: covered, torn open, and written to its page."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from loaded_scripts import load_script

from gsfluent.data import Gaussians
from gsfluent.results.frames import SavedFrame, save_frame

RADIUS, SPACING = 0.04, 0.004


@pytest.fixture(scope="module")
def script():
    return load_script("accuracy/liquids")


def ball_with_cap(script, tear: float) -> SavedFrame:
    """A ball under a film down to its equator, with a dry stripe ``tear`` wide [m]."""
    core = torch.cartesian_prod(*[torch.linspace(-RADIUS, RADIUS, 21)] * 3)
    core = core[core.norm(dim=1) <= RADIUS]
    way = script.directions(2500).float()
    film = (RADIUS + SPACING) * way[(way[:, 2] > 0.0) & (way[:, 0].abs() * RADIUS >= 0.5 * tear)]
    size = torch.full((film.shape[0],), 0.6 * SPACING)
    splats = Gaussians.from_colors(film, size, torch.ones_like(film), opacities=0.95)
    places = torch.cat([core, film])
    count = places.shape[0]
    body = (torch.arange(count) >= core.shape[0]).int()
    rows = torch.arange(film.shape[0])
    return SavedFrame(
        index=0, time=0.0, gaussians=splats, groups=torch.full_like(rows, -1).int(),
        carried=film.shape[0], ids=-1 - rows, anchor=(rows + core.shape[0]).int(),
        positions=places, volumes=torch.full((count,), SPACING**3), damage=torch.zeros(count),
        fragments=body, velocity=torch.zeros_like(places), body=body, material=body,
        facts={"bodies": [["ball", "rubber"], ["liquid", "milk"]]},
    )  # fmt: skip


def test_a_film_covers_and_a_tear_does_not(script) -> None:
    whole = script.figures(ball_with_cap(script, 0.0))
    assert whole["drawn"] == 0.0 and whole["balls"] == 0.0
    assert whole["wetted"] == pytest.approx(0.5, abs=0.05)
    torn = script.figures(ball_with_cap(script, 5.0 * SPACING))
    # The stripe is closed, so it is wetted, and open: its share less what the edges reach over.
    assert torn["wetted"] == pytest.approx(whole["wetted"], abs=0.02)
    assert 0.05 < torn["drawn"] < 5.0 * SPACING / (2.0 * RADIUS)
    wide = script.figures(ball_with_cap(script, 12.0 * SPACING))
    assert wide["wetted"] < whole["wetted"] - 0.1  # two films with a dry ball between


def test_lines_are_kept_and_the_table_is_written(script, tmp_path: Path) -> None:
    run, page, lines = tmp_path / "run", tmp_path / "page.md", tmp_path / "lines.jsonl"
    folder = run / "stages" / "simulate"
    folder.mkdir(parents=True)
    save_frame(folder, ball_with_cap(script, 0.0))
    report = {"momentum_error": 1e-7, "seconds": 3.0, "particles": 9}
    (run / "run.json").write_text(json.dumps({"simulation": report}), encoding="utf-8")
    page.write_text("# Page\n\n<!-- liquids: begin -->\n<!-- liquids: end -->\n", encoding="utf-8")
    given = ["--json", str(lines), "--page", str(page)]
    script.main([str(run), "--name", "first", *given])
    script.main([str(run), "--name", "second", *given])
    assert [json.loads(row)["name"] for row in lines.read_text().splitlines()] == [
        "first",
        "second",
    ]
    assert "| second | 1 | " in page.read_text() and "0.00 %, 0.00 %" in page.read_text()
