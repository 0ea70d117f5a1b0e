"""Cleaning: planted floaters go, each for its reason; the object and its background stay."""

from __future__ import annotations

import math

import pytest
import torch
from interior_shapes import ellipsoid_shell

from gsfluent import ops
from gsfluent.data import BACKGROUND, SURFACE, Camera, Gaussians
from gsfluent.errors import InputError
from gsfluent.pipeline.capture.hull import Hull
from gsfluent.pipeline.reconstruct.floaters import REASONS, CleanLimits, clean_floaters


def ring(count: int = 12, distance: float = 4.0, size: int = 96) -> list[Camera]:
    cameras = []
    for index in range(count):
        angle, rise = 2 * math.pi * index / count, 0.6 * math.sin(2.4 * index)
        eye = (
            distance * math.cos(angle) * math.cos(rise),
            distance * math.sin(angle) * math.cos(rise),
            distance * math.sin(rise),
        )
        cameras.append(Camera.look_at(eye, (0.0, 0.0, 0.0), width=size, height=size, fov=42.0))
    return cameras


def picture(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    return ops.rasterize(
        gaussians.means, gaussians.opacities, camera.viewmat.float(), camera.K.float(),
        camera.width, camera.height, quats=gaussians.quats, scales=gaussians.scales,
        sh=gaussians.sh,
    ).image  # fmt: skip


def planted(means: list[list[float]], scale: list[float], opacity: float = 0.6) -> Gaussians:
    points = torch.tensor(means)
    return Gaussians.from_colors(
        points,
        torch.tensor(scale).repeat(len(points), 1),
        torch.full_like(points, 0.9),
        opacities=opacity,
    )


@pytest.fixture(scope="module")
def shell() -> Gaussians:
    return ellipsoid_shell(2500)


def test_a_clean_object_stays_as_it_is(shell: Gaussians) -> None:
    kept, report = clean_floaters(shell, ring())
    assert report["removed"] <= 0.002 * shell.count
    assert kept.count == report["gaussians"] == shell.count - report["removed"]
    assert set(report["reasons"]) <= set(REASONS)


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        (planted([[0.0, 0.0, 1.3], [1.3, 0.2, 0.1]], [0.05] * 3, 0.2), "free_space"),
        (planted([[0.2, 0.1, 0.0], [-0.2, 0.0, 0.1]], [0.03] * 3), "unseen"),
        (planted([[1.0, 0.0, 0.0]], [0.5] * 3, 0.05), "huge"),
        (planted([[1.0, 0.0, 0.0]], [0.2, 0.005, 0.005]), "needle"),
        (planted([[math.nan, 0.0, 0.0]], [0.03] * 3), "non_finite"),
    ],
)
def test_planted_floaters_go_for_their_reason(
    shell: Gaussians, what: Gaussians, reason: str
) -> None:
    kept, report = clean_floaters(Gaussians.cat([shell, what]), ring())
    assert report["reasons"].get(reason, 0) >= what.count
    assert bool(torch.isfinite(kept.means).all())
    # the shell's own rows are all there: nothing else paid for it
    assert kept.count >= 0.998 * shell.count


def test_what_hangs_apart_goes_even_where_no_camera_sees_past_it(shell: Gaussians) -> None:
    speck = planted([[0.0, 0.0, -1.6], [0.02, 0.0, -1.6]], [0.03] * 3, 0.9)
    # a single camera cannot tell free space; only the distance to the body remains
    kept, report = clean_floaters(Gaussians.cat([shell, speck]), ring(count=1))
    assert float(kept.means[:, 2].min()) > -1.0
    assert report["reasons"]["apart"] >= 2


def test_the_hull_bounds_the_object(shell: Gaussians) -> None:
    hull = Hull(torch.ones(20, 20, 10, dtype=torch.bool), torch.tensor([-1.1, -1.1, 0.0]), 0.11)
    kept, report = clean_floaters(shell, ring(), hull=hull, limits=CleanLimits(hull_slack=0))
    below = int((shell.means[:, 2] < 0).sum())
    assert report["reasons"]["outside_hull"] == below
    assert float(kept.means[:, 2].min()) >= 0.0


def test_cleaning_never_costs_more_than_its_budget(shell: Gaussians) -> None:
    # photographs of the whole shell, a hull that forbids half of it: that half is given back
    cameras = ring(6)
    photographs = [picture(shell, camera) for camera in cameras]
    hull = Hull(torch.ones(20, 20, 10, dtype=torch.bool), torch.tensor([-1.1, -1.1, 0.0]), 0.11)
    _, report = clean_floaters(shell, cameras, hull=hull, photographs=photographs)
    assert report["given_back"] > 0
    assert report["psnr_after"] >= report["psnr_before"] - 0.05


def test_taking_a_floater_away_brings_the_picture_back(shell: Gaussians) -> None:
    cameras = ring(8)
    photographs = [picture(shell, camera) for camera in cameras]
    floater = planted([[1.4, 0.3, 0.4], [-0.2, 1.3, 0.3]], [0.06] * 3, 0.9)
    _, report = clean_floaters(Gaussians.cat([shell, floater]), cameras, photographs=photographs)
    assert report["psnr_after"] > report["psnr_before"] + 5.0
    assert report["given_back"] == 0


def test_background_is_never_removed(shell: Gaussians) -> None:
    wall = planted([[0.0, 6.0, 0.0], [3.0, 3.0, 0.0]], [0.8] * 3)
    both = Gaussians.cat([
        shell.replace(labels=torch.full((shell.count,), SURFACE, dtype=torch.int32)),
        wall.replace(labels=torch.full((2,), BACKGROUND, dtype=torch.int32)),
    ])  # fmt: skip
    kept, _ = clean_floaters(both, ring())
    assert kept.labels is not None and int((kept.labels == BACKGROUND).sum()) == 2


def test_bad_calls_are_refused(shell: Gaussians) -> None:
    with pytest.raises(InputError, match="no cameras"):
        clean_floaters(shell, [])
    with pytest.raises(InputError, match="1 photographs for 3"):
        clean_floaters(shell, ring(3), photographs=[torch.zeros(96, 96, 3)])
    away = Camera.look_at((4.0, 0.0, 0.0), (8.0, 0.0, 0.0), width=32, height=32)
    kept, report = clean_floaters(shell, [away] * 3)
    assert report["removed"] == 0 and kept.count == shell.count  # nobody looked, nobody knows
