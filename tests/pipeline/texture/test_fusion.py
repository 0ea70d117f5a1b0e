"""Colours of Gaussians from slices: the linear map, its adjoint, and the solver."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsfluent.pipeline.texture.polish import (
    SlabRenderer,
    SlicePlane,
    fuse_colors,
    stack_planes,
)

SIZE = 12


def lattice(size: int = SIZE, jitter: float = 0.15) -> Tensor:
    torch.manual_seed(3)
    grid = torch.stack(torch.meshgrid(*[torch.arange(size)] * 3, indexing="ij"), -1).reshape(-1, 3)
    return grid + 0.5 + jitter * (2 * torch.rand(grid.shape) - 1)


def pattern(points: Tensor) -> Tensor:
    """Smooth colours that differ along every axis."""
    x, y, z = (points * (2 * math.pi / 8)).unbind(-1)
    return 0.5 + 0.3 * torch.stack([torch.sin(x), torch.cos(y), torch.sin(z) * torch.cos(x)], -1)


def planes(every: int = 1) -> list[SlicePlane]:
    """Slices across all axes, two pixels per Gaussian."""
    made = []
    for axis in range(3):
        made += stack_planes(
            axis, range(0, 2 * SIZE, 2 * every), (2 * SIZE,) * 3, torch.zeros(3), 0.5
        )
    return made


def test_adjoint_is_the_transpose() -> None:
    renderer = SlabRenderer(lattice(), planes()[::5], 1.0)
    color = torch.rand(SIZE**3, 3, generator=torch.Generator().manual_seed(1))
    pictures = [torch.rand(p.shape[0] * p.shape[1], 3) for p in renderer.planes]
    left = sum(
        float((a * b).double().sum()) for a, b in zip(renderer.render(color), pictures, strict=True)
    )
    right = float((color * renderer.adjoint(pictures)).double().sum())
    assert left == pytest.approx(right, rel=1e-5)


def test_weights_are_those_of_the_formula() -> None:
    """One pixel by hand: sum of w c over sum of w, both standard deviations 0.55 spacings."""
    means = lattice()
    [plane] = stack_planes(2, [11], (2 * SIZE,) * 3, torch.zeros(3), 0.5)
    color = pattern(means)
    row, column = 9, 14  # of the picture: x and y of the object
    point = torch.tensor([(row + 0.5) * 0.5, (column + 0.5) * 0.5, 11.5 * 0.5])
    delta = (means - point) / 0.55
    near = (delta.abs() <= 2.5).all(1)
    weight = torch.exp(-0.5 * (delta**2).sum(1)) * near
    wanted = (weight[:, None] * color).sum(0) / weight.sum()
    shown = SlabRenderer(means, [plane], 1.0).render(color)[0].reshape(2 * SIZE, 2 * SIZE, 3)
    assert torch.allclose(shown[row, column], wanted, atol=1e-5)


def test_constant_colour_is_seen_and_found_exactly() -> None:
    means, where = lattice(), planes(4)
    plain = torch.tensor([0.2, 0.6, 0.4])
    targets = [plain.expand(*p.shape, 3) for p in where]
    found, report = fuse_colors(means, where, targets, spacing=1.0, slab=2.0)
    assert torch.allclose(found, plain.expand_as(found), atol=1e-4)
    assert report["rms_after"] < 1e-5 and report["unseen"] == 0


def test_conjugate_gradients_take_the_blur_out() -> None:
    means, where = lattice(), planes()
    truth = pattern(means)
    targets = [
        s.reshape(*p.shape, 3)
        for s, p in zip(SlabRenderer(means, where, 1.0).render(truth), where, strict=True)
    ]
    error = {}
    for count in (0, 2, 5, 20):
        found, report = fuse_colors(means, where, targets, spacing=1.0, iterations=count)
        error[count] = report["rms_after"]
    # each step of the exact method lowers the residual of a consistent system
    assert error[20] < error[5] < error[2] < error[0]
    assert error[5] < 0.3 * error[0]
    assert float((found - truth).abs().mean()) < 0.2 * float(
        (fuse_colors(means, where, targets, spacing=1.0, iterations=0)[0] - truth).abs().mean()
    )


def test_least_squares_solution_is_the_dense_one() -> None:
    """Many steps on a small problem against torch's own dense solver."""
    means = lattice(5)
    where = [
        p for a in range(3) for p in stack_planes(a, range(10), (10,) * 3, torch.zeros(3), 0.5)
    ]
    renderer = SlabRenderer(means, where, 1.0)
    torch.manual_seed(7)
    targets = [0.4 + 0.2 * torch.rand(10, 10, 3) for _ in where]
    dense = torch.cat([renderer.render(torch.eye(len(means)))[k] for k in range(len(where))])
    counted = torch.cat(renderer.counted)
    aim = torch.cat([t.reshape(-1, 3) for t in targets])[counted]
    wanted = torch.linalg.lstsq(dense[counted].double(), aim.double()).solution.float()
    found, _ = fuse_colors(means, where, targets, spacing=1.0, iterations=200)
    inside = ((wanted > 0.02) & (wanted < 0.98)).all(1)  # others are clipped
    assert inside.float().mean() > 0.9
    assert float((found - wanted)[inside].abs().max()) < 0.02


def test_fixed_and_unseen_gaussians_keep_their_colours() -> None:
    means = torch.cat([lattice(), torch.tensor([[100.0, 100.0, 100.0]])])
    where = planes(2)
    fixed = torch.zeros(len(means), dtype=torch.bool)
    fixed[:200] = True
    initial = torch.rand(len(means), 3, generator=torch.Generator().manual_seed(2))
    targets = [torch.full((*p.shape, 3), 0.5) for p in where]
    found, report = fuse_colors(
        means, where, targets, spacing=1.0, initial=initial, fixed=fixed, iterations=3
    )
    assert torch.equal(found[:200], initial[:200])
    assert torch.equal(found[-1], initial[-1]) and report["unseen"] == 1
    assert not torch.equal(found[200:-1], initial[200:-1])
    with pytest.raises(ValueError, match="colours"):
        fuse_colors(means, where, targets, spacing=1.0, fixed=fixed)
    with pytest.raises(ValueError, match="planes"):
        fuse_colors(means, where, targets[:1], spacing=1.0)


def test_nothing_depends_on_what_is_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    from gsfluent.pipeline.texture import polish as fusion

    means, where = lattice(), planes(3)
    targets = [pattern(torch.rand(*p.shape, 3) * 8) for p in where]
    stored, _ = fuse_colors(means, where, targets, spacing=1.0)
    monkeypatch.setattr(fusion, "_STORED", 0)
    anew, _ = fuse_colors(means, where, targets, spacing=1.0)
    assert torch.equal(stored, anew)


@pytest.mark.cuda
def test_gpu_gives_the_colours_of_the_cpu() -> None:
    means, where = lattice(), planes(2)
    targets = [pattern(torch.rand(*p.shape, 3) * 8) for p in where]
    cpu, _ = fuse_colors(means, where, targets, spacing=1.0)
    there = [
        SlicePlane(p.center.cuda(), p.right.cuda(), p.down.cuda(), p.shape, p.pitch) for p in where
    ]
    gpu, _ = fuse_colors(means.cuda(), there, targets, spacing=1.0)
    assert torch.allclose(gpu.cpu(), cpu, atol=1e-4)


def test_polish_brings_coarse_gaussians_nearer_to_the_slices() -> None:
    """Gaussians at twice the voxels: cuts through them show the volume better than sampled ones."""
    from gsfluent.pipeline.texture.polish import polish_colors
    from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture

    grid = torch.stack(torch.meshgrid(*[torch.arange(24)] * 3, indexing="ij"), -1) + 0.5
    depth = (11.0 - (grid - 12).norm(dim=-1)).clamp(min=0).numpy()
    inside = depth > 0
    rgb = pattern(grid * 1.3).numpy()
    domain = InteriorDomain(inside, depth, inside & (depth < 1.6), rgb, *_AXIS)
    means = 2 * lattice()
    means = means[((means - 12).norm(dim=1) < 10.5)].double().numpy()
    sampled = InteriorTexture(rgb, inside * 0).sample(means, inside)
    polished, report = polish_colors(domain, rgb, means, sampled)
    assert report["polished"] and report["spacing"] == pytest.approx(2.0, rel=0.1)
    odd = stack_planes(1, range(5, 19, 2), (24, 24, 24), torch.zeros(3), 1.0)  # not fitted to
    renderer = SlabRenderer(torch.from_numpy(means), odd, 2.0, 1.0)
    error = []
    for color in (sampled, polished):
        shown = renderer.render(torch.from_numpy(color))
        error.append(0.0)
        for k, index in enumerate(range(5, 19, 2)):
            matter = torch.from_numpy((depth > 2)[:, index].reshape(-1)) & renderer.counted[k]
            aim = torch.from_numpy(rgb[:, index].reshape(-1, 3))
            error[-1] += float(((shown[k] - aim)[matter] ** 2).sum())
    assert error[1] < 0.7 * error[0]
    # as fine as the voxels: left alone
    fine = grid.reshape(-1, 3)[torch.from_numpy(inside.reshape(-1))].double().numpy()
    same, report = polish_colors(domain, rgb, fine, rgb[inside])
    assert not report["polished"] and (same == rgb[inside]).all()


_AXIS = (torch.tensor([0.0, 0.0, 1.0]).numpy(), 1.0, torch.zeros(3).numpy())
