"""Charts of rendering, reconstruction and texturing: what their errors are, and how they resume."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from in_process import swept

from gsfluent import geometry
from gsfluent.errors import InputError, RunError
from gsfluent.lab.charts import quality, reconstruction, rendering, texturing
from gsfluent.lab.charts.quality import Job, Outcome, chart_quality, gathered, run_jobs
from gsfluent.lab.charts.record import read

CPU = torch.device("cpu")


def moments(splats: rendering.Splats) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and second moment of all splats together, weighed by opacity."""
    weight = splats.opacities / splats.opacities.sum()
    mean = weight @ splats.means
    second = weight @ splats.covars[:, :3] + weight @ splats.means.square()
    return mean, second


def test_merging_keeps_the_moments() -> None:
    """Opacities are equal, so cubes weigh as many splats as they hold; moments add up exactly."""
    splats = rendering.glossy_melon(24)
    cubes = rendering.merged(splats, splats.means.shape[0] // 8)
    assert 0 < cubes.means.shape[0] < splats.means.shape[0] // 3
    # weigh each cube by its members again
    low, high = torch.aminmax(splats.means, dim=0)
    edge = float((high - low).max()) * math.sqrt(3.0 / (splats.means.shape[0] // 8))
    cell = torch.floor((splats.means - low) / edge)
    count = torch.unique(cell, dim=0, return_counts=True)[1].to(torch.float64)
    weighed = dataclasses.replace(cubes, opacities=cubes.opacities * count)
    for ours, theirs in zip(moments(weighed), moments(splats), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-12)


def test_the_gloss_is_seen_from_the_mirrored_side() -> None:
    """A Phong lobe: brightest against the mirrored key light, and plain skin from behind it."""
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    grey = torch.full((1, 3), 0.4, dtype=torch.float64)
    sh = rendering._glossy(grey, normal)
    key = torch.tensor(rendering._KEY, dtype=torch.float64)
    key = key / key.norm()
    mirrored = torch.tensor([-key[0], -key[1], key[2]])
    seen = [
        0.5 + float((geometry.sh_basis(-toward[None], 3)[..., None] * sh).sum(dim=-2)[0, 0])
        for toward in (mirrored, torch.linalg.cross(mirrored, normal[0]))
    ]
    assert seen[0] > seen[1] + 0.2
    assert seen[1] == pytest.approx(0.85 * 0.4, abs=0.08)  # a lobe of degree 3 rings a little


def test_the_smallest_charts_of_rendering(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    """All splats in float32 are round-off away from float64; fewer and plainer ones are not."""
    result = chart_quality("rendering", tmp_path, device=CPU, quick=True, repeat=1)
    records = {(r.case, r.variant): r for r in read(result["lines"])}
    near = {v: r.error for (case, v), r in records.items() if case == "glossy melon, near"}
    assert near[""] < 1e-5
    assert all(error > 1e-3 for variant, error in near.items() if variant)
    # Yu et al. 2024: the low-pass thickens what is small unless opacity makes up for it
    far = {v: r.error for (case, v), r in records.items() if case.startswith("glossy melon, far")}
    assert far["antialiased"] < 0.7 * far[""]
    for name in ("figure", "page", "tables"):
        assert result[name].stat().st_size > 500
    for record in records.values():
        psnr = next(m["value"] for m in record.measures if m["quantity"] == "PSNR [dB]")
        assert record.error == pytest.approx(10.0 ** (-psnr / 20.0), rel=1e-6)
    again = chart_quality("rendering", tmp_path, device=CPU, quick=True, repeat=1)
    assert {(r.case, r.variant): r for r in read(again["lines"])} == records  # nothing run again
    drawn = gathered("rendering", [result["lines"]], tmp_path / "drawn")
    assert drawn["cpu"]["settings"] == len(records)


def test_what_has_a_line_is_not_done_again(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    calls: list[str] = []

    def job(name: str, error: float) -> Job:
        def work(repeat: int) -> Outcome:
            calls.append(name)
            if error > 1.0:
                raise RunError("it diverged", hint="take smaller steps")
            return Outcome(error, [0.1] * repeat, 5, {}, band=0.02)

        return Job("case", name, {"a": 1}, work)

    lines = tmp_path / "x.jsonl"
    jobs = [job("good", 0.1), job("bad", 2.0)]
    first = run_jobs("texturing", jobs[:1], lines, device=CPU, repeat=2)
    both = run_jobs("texturing", jobs, lines, device=CPU, repeat=2)
    assert calls == ["good", "bad"]
    assert both[0] == first[0]
    assert both[0].wall_seconds == [0.1, 0.1]
    assert both[0].settings["band"] == 0.02
    assert "it diverged" in both[1].failed and not both[1].ok
    assert "it diverged" in quality.markdown(both)


def test_settings_that_are_placed_are_those_of_the_ladder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(quality, "map", swept(calls))
    monkeypatch.setattr(texturing, "jobs", _three)
    said = chart_quality("texturing", tmp_path, device=CPU, repeat=2, on="slurm")
    assert (said["settings"], said["failed"], calls[0]["on"]) == (3, 0, "slurm")
    assert [r.error for r in read(said["lines"])] == [0.0, 0.1, 0.2]
    assert not (tmp_path / "tasks").exists()


def _three(*, device: torch.device, quick: bool) -> list[Job]:
    def outcome(repeat: int, error: float) -> Outcome:
        return Outcome(error, [0.1] * repeat, 5, {})

    return [Job("c", f"{n}", {}, functools.partial(outcome, error=0.1 * n)) for n in range(3)]


def test_unknown_kinds_and_empty_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown kind 'sound'"):
        chart_quality("sound", tmp_path, device=CPU)
    empty = tmp_path / "empty.jsonl"
    empty.touch()
    with pytest.raises(InputError, match="no records of texturing"):
        gathered("texturing", [empty], tmp_path)


@pytest.mark.parametrize("kind", quality.KINDS)
def test_every_kind_has_a_ladder_with_names_of_their_own(kind: str) -> None:
    module = quality._module(kind)
    for quick in (False, True):
        keys = [job.key("cpu") for job in module.jobs(device=CPU, quick=quick)]
        assert len(keys) == len(set(keys)) >= 3


def test_more_steps_come_nearer_to_the_photographs_held_out() -> None:
    case = reconstruction._Case(10, 32, CPU)
    few, many = (case(1, {"iterations": n, "start_gaussians": 800}) for n in (5, 80))
    # five steps are cut at the hull, too, so the silhouette is right from the start
    assert many.error < 0.9 * few.error < 0.8
    assert many.measures["PSNR [dB]"] == pytest.approx(-20.0 * math.log10(many.error))
    assert many.settings["steps"] == 80
