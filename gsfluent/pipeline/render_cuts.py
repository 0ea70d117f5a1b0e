"""``interior.png``: the solid cut open along its three axes, before anything happens to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gsfluent.data import Solid
from gsfluent.io import save_image
from gsfluent.pipeline.fill_view import cut_view

_HEIGHT = 360
_GAP = 12
_GROUND = 0.96


def save_cut_views(solid: Solid, path: Path) -> None:
    """Write three cuts, across x, y and z through the middle, side by side.

    Raises:
        RunError: The disk is full.
    """
    views = [cut_view(solid, axis, size=_HEIGHT, background=_GROUND) for axis in range(3)]
    height = max(view.shape[0] for view in views) + 2 * _GAP
    width = sum(view.shape[1] for view in views) + _GAP * (len(views) + 1)
    sheet = np.full((height, width, 3), _GROUND, np.float32)
    left = _GAP
    for view in views:
        top = (height - view.shape[0]) // 2
        sheet[top : top + view.shape[0], left : left + view.shape[1]] = view
        left += view.shape[1] + _GAP
    save_image(torch.from_numpy(sheet), path)
