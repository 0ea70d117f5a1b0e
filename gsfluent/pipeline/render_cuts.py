"""``interior.png``: the solid cut open, before anything happens to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.data import Solid
from gsfluent.io import save_image
from gsfluent.pipeline.fill_colors import skin_weights
from gsfluent.pipeline.fill_view import cut_view

_HEIGHT = 360
_GAP = 12
_TILT = 25.0  # degrees that the viewer of the last cut stands above it
_GROUND = 0.96


def save_cut_views(solid: Solid, path: Path) -> None:
    """Write four cuts through the middle side by side: across x, y, z (from above), and aslant.

    The axes are those of the scene where the solid has a frame, else its own.

    Raises:
        RunError: The disk is full.
    """
    weights = skin_weights(solid)
    turn = np.eye(3) if solid.frame is None else solid.frame.rotation.numpy()
    x, y, z = turn  # scene axes in the solid's own frame
    aslant = 0.8 * x + 0.6 * y
    asked: list[dict[str, Any]] = [
        {"axis": x, "up": z},
        {"axis": y, "up": z},
        {"axis": -z, "up": y},
        {"axis": aslant, "up": z, "tilt": _TILT},
    ]
    views = [
        cut_view(solid, **each, size=_HEIGHT, background=_GROUND, weights=weights) for each in asked
    ]
    height = max(view.shape[0] for view in views) + 2 * _GAP
    width = sum(view.shape[1] for view in views) + _GAP * (len(views) + 1)
    sheet = np.full((height, width, 3), _GROUND, np.float32)
    left = _GAP
    for view in views:
        top = (height - view.shape[0]) // 2
        sheet[top : top + view.shape[0], left : left + view.shape[1]] = view
        left += view.shape[1] + _GAP
    save_image(torch.from_numpy(sheet), path)
