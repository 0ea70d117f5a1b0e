"""The probe measures the real thing: its capture can be reconstructed, its steps are counted."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gsfluent import materials
from gsfluent.config.settings import EXPORTS
from gsfluent.errors import InputError
from gsfluent.io import load_capture
from gsfluent.pipeline.capture.hull import hull_grid, masked_views
from gsfluent.pipeline.capture.orient import look_at_point
from gsfluent.plan import probe as plan_probe
from gsfluent.plan.fit import Sample
from gsfluent.plan.probe import draw_capture
from gsfluent.plan.probe_parts import _STEPS, ball, measured_ball


def test_the_drawn_photographs_fit_their_cameras(tmp_path: Path) -> None:
    draw_capture(tmp_path / "photographs")
    capture = load_capture(tmp_path / "photographs")
    views = masked_views(capture)
    assert len(views) == len(capture) == 10
    # a wrong pose or focal length leaves no hull, or one of another size: the melon is 0.26 m long
    grid, inside = hull_grid(views, capture, look_at_point(capture.cameras))
    places = torch.from_numpy(grid[inside])
    extent = float((places.amax(0) - places.amin(0)).max())
    assert 0.24 < extent < 0.29
    # the four points a side of the first round are all outside, as those around a pane are
    assert hull_grid(views, capture, look_at_point(capture.cameras), 8)[1].any()


def test_steps_points_and_blocks_of_a_measurement_are_counted() -> None:
    soft = materials.get("elastic").override(young_modulus=1e6)
    for resident in (True, False):
        features, seconds = measured_ball(soft, 6, "cpu", resident=resident)[1:]
        steps = features["steps"] + features["composed_steps"]
        assert _STEPS <= steps <= 1.5 * _STEPS and seconds > 0.0
        assert (features["composed_steps"] == 0.0) is resident
        points = features["point_steps_elastic"] + features["composed_point_steps"]
        # 8 a cell of pi/6 times 6^3 cells
        assert 800 < points / steps < 1100


def test_contact_is_seen_only_between_two() -> None:
    soft = materials.get("elastic").override(young_modulus=1e6)
    alone, pair = (measured_ball(soft, 6, "cpu", two=two).features for two in (False, True))
    assert alone["contact_block_steps"] == 0.0 < pair["contact_block_steps"]
    assert pair["contact_block_steps"] <= pair["block_steps"]


def test_crumbs_fill_more_blocks_than_their_volume() -> None:
    whole, debris = ball(0.1, 40), ball(0.1, 40, debris=True)
    assert float(debris.occupancy.sum()) < 0.02 * float(whole.occupancy.sum())


def test_an_export_whose_extra_is_missing_is_not_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def measured(_: Path, kind: str, splats: float) -> Sample:
        asked.append(kind)
        if kind == "usd":
            raise InputError("usd: usd-core is not installed", "install it")
        return Sample("export", {f"{kind}_gaussians": splats}, 1.0)

    monkeypatch.setattr(plan_probe, "export_sample", measured)
    found = plan_probe.export_samples(tmp_path, 10.0)
    assert asked == list(EXPORTS)
    assert {name for sample in found for name in sample.features} == {
        f"{kind}_gaussians" for kind in EXPORTS if kind != "usd"
    }
    costs = plan_probe.export_costs(found)[0]
    # as dear as the others are
    assert costs["usd_gaussians"] == pytest.approx(costs["spz_gaussians"]) == pytest.approx(0.1)
