"""Which splats belong to an object of a shot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsfluent.data import Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.io.checked.arrays import read_npy

if TYPE_CHECKING:
    from gsfluent.config import Select

_TOLERANCE = 0.15
"""RGB distance up to which a colour counts as near when the shot gives none."""


def select_mask(gaussians: Gaussians, select: Select, frame: Frame) -> Tensor:
    """Tell which splats a ``select:`` section picks, bool [N]; all its conditions must hold.

    Args:
        gaussians: Splats in world coordinates.
        select: The section.
        frame: World to scene metres, in which boxes and spheres are given.

    Raises:
        InputError: The label file does not fit, or nothing is selected.
    """
    position = frame.apply(gaussians.means)
    chosen = torch.ones(gaussians.count, dtype=torch.bool, device=gaussians.device)
    if select.box is not None:
        low, high = (position.new_tensor(corner) for corner in select.box)
        chosen &= ((position >= low) & (position <= high)).all(dim=1)
    if select.sphere is not None:
        *center, radius = select.sphere
        chosen &= (position - position.new_tensor(center)).norm(dim=1) <= radius
    if select.color_near is not None:
        distance = (gaussians.colors() - gaussians.means.new_tensor(select.color_near)).norm(dim=1)
        chosen &= distance <= (_TOLERANCE if select.tolerance is None else select.tolerance)
    if select.labels is not None:
        labels = _read_labels(gaussians, select)
        wanted = 1 if select.label is None else select.label
        if not bool((labels == wanted).any()):
            raise InputError(
                f"select: no splat has label {wanted} in {select.labels}", "look at its numbers"
            )
        chosen &= labels.to(gaussians.device) == wanted
    if not bool(chosen.any()):
        raise InputError(
            "select: no splat is selected",
            "look at the box in `gsfluent inspect` and widen the conditions",
        )
    return chosen


def _read_labels(gaussians: Gaussians, select: Select) -> Tensor:
    import numpy as np

    assert select.labels is not None
    try:
        values = read_npy(select.labels, hint="save it with numpy.save")
    except InputError as error:
        raise InputError(f"select.labels: {error.what}", error.hint) from error
    if values.shape != (gaussians.count,) or values.dtype.kind not in "iub":
        raise InputError(
            f"select.labels: must be whole numbers [{gaussians.count}], got "
            f"{values.dtype} {list(values.shape)}",
            "save one number per splat",
        )
    return torch.from_numpy(values.astype(np.int64))
