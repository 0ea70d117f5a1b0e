"""The underside that no photograph shows: it is where the object stood.

Photographs from above say nothing of it. What training and masks leave there is a cone, on whose
tip the object would balance. Nothing reaches below the plane that carried it, so it ends there.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Capture, Gaussians
from gsfluent.pipeline.capture.orient import below_support, orient
from gsfluent.pipeline.solid.field import SignedDistance


@dataclasses.dataclass(frozen=True)
class Support:
    """The plane that an object stood on: ``normal @ x = offset`` in world units."""

    normal: Tensor  # Unit vector towards the object [3], float64
    offset: float  # Of the plane along it

    @staticmethod
    def of(
        gaussians: Gaussians, capture: Capture | None, down: np.ndarray | None
    ) -> Support | None:
        """Find it among the sparse points of a capture; None where they show none.

        Args:
            gaussians: Splats of the object.
            capture: Its photographs, or None.
            down: Downward direction where it is known [3].
        """
        if capture is None:
            return None
        stance = orient(gaussians, capture, "auto" if down is None else (-down).tolist())
        if stance.floor_from != "support plane":
            return None
        return Support(torch.from_numpy(stance.up).double(), stance.floor)

    def above(self, gaussians: Gaussians) -> Gaussians:
        """Splats that do not lie below it; all where too many do for it to be their support."""
        means = gaussians.means.detach().double().cpu()
        below = below_support(means.numpy(), self.normal.numpy(), self.offset)
        return gaussians.select(torch.from_numpy(~below).to(gaussians.device))

    def cut(self, field: SignedDistance) -> SignedDistance:
        """The solid down to the plane; it is left where half of it or more lies below."""
        normal = self.normal.to(field.values)
        axes = [
            field.origin[i].to(field.values)
            + (torch.arange(n, device=field.values.device) + 0.5) * field.voxel
            for i, n in enumerate(field.values.shape)
        ]
        x, y, z = torch.meshgrid(*axes, indexing="ij")
        beneath = self.offset - (normal[0] * x + normal[1] * y + normal[2] * z)
        cut = field.replace(values=torch.maximum(field.values, beneath))
        share = 1.0 - cut.volume / max(field.volume, 1e-30)
        if share >= 0.5:
            return field
        return cut.replace(report={**field.report, "below_support": share})
