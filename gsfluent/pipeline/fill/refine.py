"""What the photographs say about interior Gaussians: sums over pixels, nothing is trained.

The blend weight of a Gaussian in a pixel is what its opacity lets one see of it. Its sum over all
photographs, and the same sum weighted with any picture, is one backward pass of the rasterizer to
the colours: ``d <image, f> / d color_i = sum_p w_i(p) f(p)``. So one pass tells for every interior
Gaussian how much of it shows, how much of that lies off the object, and how far its colour is from
the photographs', where a fit would take many. What contradicts them gets opacity zero and is
removed.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent.data import Capture, Gaussians
from gsfluent.data.capture import View
from gsfluent.draw import draw
from gsfluent.progress import Progress, report_progress

logger = logging.getLogger(__name__)

_CONTRADICTED = 2e-4  # share of its size that a Gaussian may show in the wrong place or colour
_OFF = 6.0  # no colour excuses what stands beside the object
_ODD = 4.0  # squared colour difference (three channels) of 1 / 4 counts once
_ROUNDS = 2  # what the first round lays bare is asked again
_LOW_PASS = 0.3  # pixels squared, added to every splat by the rasterizer


class Testimony(NamedTuple):
    """What photographs say about each Gaussian, [N]; sums over the pixels of all views."""

    size: Tensor
    """Blend weight that it would have with nothing in front of it."""
    seen: Tensor
    """Blend weight that it has."""
    off: Tensor
    """The part of it in pixels that the masks say are not the object; 0 without masks."""
    odd: Tensor
    """The part of it on the object, times the squared colour difference to the photograph."""

    @property
    def contradiction(self) -> Tensor:
        """Weighted share of its size that shows off the object or in the wrong colour, [N]."""
        return (_OFF * self.off + _ODD * self.odd) / self.size.clamp_min(1e-12)


def witness(
    gaussians: Gaussians, photographs: Sequence[View], progress: Progress | None = None
) -> Testimony:
    """Ask photographs about Gaussians, in one forward and one backward pass per view.

    Args:
        gaussians: Everything that is drawn; colours are those without direction.
        photographs: What :func:`asked_views` read; masks are used where there are any.
        progress: Optional callback.

    Returns:
        The sums, float64, on the device of the Gaussians.
    """
    own = gaussians.colors().clamp(0.0, 1.0).double()
    total = torch.zeros(gaussians.count, 4, dtype=torch.float64, device=gaussians.device)
    for done, view in enumerate(photographs):
        photo = view.image.to(gaussians.means)
        judged = torch.ones_like(photo[..., 0]) if view.valid is None else view.valid.to(photo)
        on = judged if view.mask is None else judged * view.mask.to(photo)
        square = photo.square().sum(-1, keepdim=True)
        asked = torch.cat(
            [
                judged[..., None],
                on[..., None] * torch.cat([torch.ones_like(square), square, photo], -1),
            ],
            -1,
        )
        probe = gaussians.means.new_zeros(gaussians.count, 6).requires_grad_(True)
        image = draw(gaussians, view.camera, colors=probe, deterministic=True).image
        # of the product: a given gradient costs half a second of imports (torch 2.11)
        sums = torch.autograd.grad((image * asked).sum(), probe)[0].double()
        total[:, 0] += _unhidden(gaussians, view.camera.viewmat, view.camera.K)
        total[:, 1] += sums[:, 0]
        total[:, 2] += sums[:, 0] - sums[:, 1]
        # |photo - own|^2 = |photo|^2 - 2 photo own + |own|^2
        cross = (sums[:, 3:] * own).sum(1)
        total[:, 3] += sums[:, 2] - 2.0 * cross + own.square().sum(1) * sums[:, 1]
        report_progress(progress, done + 1, len(photographs), "interior opacity")
    size, seen, off, odd = total.clamp_min(0.0).unbind(1)
    return Testimony(size, seen, off, odd)


def asked_views(capture: Capture, views: int, image_size: int) -> list[View]:
    """Read evenly chosen photographs, at most ``views`` of them."""
    names = torch.linspace(0, len(capture) - 1, max(1, min(views, len(capture)))).round().int()
    return capture.views(names.unique().tolist(), image_size)


def _unhidden(gaussians: Gaussians, viewmat: Tensor, K: Tensor) -> Tensor:
    """Sum of the opacity over the pixels that each Gaussian covers, as a ball, [N]."""
    view, K = viewmat.to(gaussians.means), K.to(gaussians.means)
    z = gaussians.means @ view[2, :3] + view[2, 3]
    area = gaussians.scales.log().mean(1).mul(2.0).exp() * K[0, 0] * K[1, 1] / z.square()
    size = 2.0 * math.pi * (area + _LOW_PASS) * gaussians.opacities
    return torch.where(z > 1e-4, size, torch.zeros_like(size)).double()


def refine_opacity(
    gaussians: Gaussians,
    interior: Tensor,
    capture: Capture,
    *,
    views: int = 24,
    image_size: int = 200,
    progress: Progress | None = None,
) -> tuple[Gaussians, Tensor, dict[str, Any]]:
    """Remove the interior Gaussians that the photographs contradict; all others stay as they are.

    Two rounds at most, each one pass over the photographs: what the first lays bare is asked again.

    Args:
        gaussians: Surface and interior Gaussians.
        interior: Mask bool [N] of the interior ones.
        capture: Posed photographs.
        views: Number of photographs asked, evenly chosen.
        image_size: Their longest side [pixels].
        progress: Optional callback.

    Returns:
        The Gaussians that are left, their mask ``interior``, and the report: ``pruned``;
        ``seen_before, seen_after``: share of all that is seen of the object that is interior, in
        the first pass and, of what is left, in the last; ``contradicted_before,
        contradicted_after``: share of the interior Gaussians that show off the object or in the
        wrong colour, in the first and in the last pass.
    """
    report: dict[str, Any] = {"pruned": 0}
    photographs = asked_views(capture, views, image_size)
    for round_ in range(_ROUNDS):
        said = witness(gaussians, photographs, progress)
        wrong = interior & (said.contradiction > _CONTRADICTED)
        left = interior & ~wrong
        seen = float(said.seen[interior].sum()) / max(float(said.seen.sum()), 1e-12)
        after = float(said.seen[left].sum()) / max(float(said.seen[~wrong].sum()), 1e-12)
        share = int(wrong.sum()) / max(int(interior.sum()), 1)
        if round_ == 0:
            report |= {"seen_before": seen, "contradicted_before": share}
        report |= {"seen_after": after, "contradicted_after": share}
        if not bool(wrong.any()):
            break
        report["pruned"] += int(wrong.sum())
        gaussians, interior = gaussians.select(~wrong), interior[~wrong]
    logger.info(
        "fill: of what photographs see, %.2f %% was interior, now %.2f %%; %d Gaussians removed",
        100 * report["seen_before"],
        100 * report["seen_after"],
        report["pruned"],
    )
    return gaussians, interior, report
