"""Adjoints that are called by hand: those of autograd, bit by bit."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops

SIZE = (40, 28)


def splats(count: int = 60) -> dict[str, Tensor]:
    return {
        "means": torch.randn(count, 3) * 0.3,
        "opacities": torch.rand(count),
        "quats": torch.randn(count, 4),
        "scales": 0.02 + 0.1 * torch.rand(count, 3),
        "sh": torch.randn(count, 4, 3),
    }


def camera() -> tuple[Tensor, Tensor]:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    return viewmat, torch.tensor([[50.0, 0, 20], [0, 50.0, 14], [0, 0, 1]])


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("with_alpha", [False, True])
def test_a_recorded_picture_has_the_gradients_of_autograd(absgrad: bool, with_alpha: bool) -> None:
    given = splats()
    probe = torch.zeros(len(given["means"]), 2)
    recorded = ops.rasterize_recorded(
        given["means"], given["opacities"], *camera(), *SIZE, quats=given["quats"],
        scales=given["scales"], sh=given["sh"], probe=probe, absgrad=absgrad,
    )  # fmt: skip
    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    leaf = probe.clone().requires_grad_()
    which = {"means2d_absgrad" if absgrad else "means2d_offset": leaf}
    want = ops.rasterize(
        leaves["means"], leaves["opacities"], *camera(), *SIZE, quats=leaves["quats"],
        scales=leaves["scales"], sh=leaves["sh"], depth=False, **which,
    )  # fmt: skip
    assert torch.equal(recorded.rendered.image, want.image)
    assert torch.equal(recorded.rendered.alpha, want.alpha)
    assert torch.equal(recorded.rendered.radii, want.radii)
    of_image, of_alpha = torch.randn_like(want.image), torch.randn_like(want.alpha)
    loss = (want.image * of_image).sum() + with_alpha * (want.alpha * of_alpha).sum()
    expected = torch.autograd.grad(loss, [*leaves.values(), leaf])
    found = recorded.adjoint(of_image, of_alpha if with_alpha else None)
    for name, slope in zip([*leaves, "probe"], expected, strict=True):
        assert float(slope.abs().max()) > 0.0
        assert torch.equal(getattr(found, name), slope), name


def test_no_probe_no_gradient_of_it() -> None:
    given = splats()
    means, opacities = given.pop("means"), given.pop("opacities")
    recorded = ops.rasterize_recorded(means, opacities, *camera(), *SIZE, **given)
    assert recorded.adjoint(torch.ones(SIZE[1], SIZE[0], 3)).probe.numel() == 0


@pytest.mark.parametrize("masked", [False, True])
def test_slopes_of_the_loss_are_those_of_autograd(masked: bool) -> None:
    height, width = 24, 31
    image, target = torch.rand(2, height, width, 3)
    options: dict[str, Tensor | float] = {"valid": torch.rand(height, width)}
    alpha = torch.rand(height, width)
    if masked:
        mask, backdrop = torch.rand(height, width), torch.rand(3)
        options |= {"mask": mask, "backdrop": backdrop, "mask_weight": 2.0}
    leaves = [image.clone().requires_grad_(), alpha.clone().requires_grad_()]
    seen = {"alpha": leaves[1]} if masked else {}
    want = ops.photometric_loss(leaves[0], target, **seen, **options)
    kept = {"alpha": alpha} if masked else {}
    found, of_image, of_alpha = ops.photometric_slopes(image, target, **kept, **options)
    assert [float(a) for a in found] == [float(b.detach()) for b in want]
    expected = torch.autograd.grad(want.loss, leaves[: 1 + masked])
    assert torch.equal(of_image, expected[0])
    assert (of_alpha is not None) == masked
    if of_alpha is not None:
        assert torch.equal(of_alpha, expected[1])
