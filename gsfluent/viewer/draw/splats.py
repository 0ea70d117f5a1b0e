"""Splats drawn by the browser itself: smooth to turn, without light, for up to 200 000 of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.viewer.draw.picture import hidden
from gsfluent.viewer.model.color import Legend, splat_colors
from gsfluent.viewer.model.look import Look
from gsfluent.viewer.model.timeline import Timeline

if TYPE_CHECKING:
    import viser

MOST = 200_000
_NODE = "/splats"
_GROUND = 196  # grey value
_ORDER = [0, 3, 4, 3, 1, 5, 4, 5, 2]  # packed xx, yy, zz, xy, xz, yz to a full matrix


class BrowserSplats:
    """Sends the splats of one frame at a time.

    Raises:
        InputError: More splats than browsers draw.
    """

    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline
        self._sent: tuple[object, ...] = ()
        count = timeline.first.gaussians.count
        if count > MOST:
            raise InputError(
                f"--splats: {count} splats; browsers draw about {MOST}",
                "leave --splats out: the pictures are then drawn here",
            )

    def prepare(self, server: viser.ViserServer) -> None:
        """Grey ground behind the splats."""
        server.scene.set_background_image(np.full((2, 2, 3), _GROUND, np.uint8), format="png")

    def show(
        self, server: viser.ViserServer, index: int, look: Look, shift: tuple[float, float, float]
    ) -> Legend | None:
        """Send frame ``index`` unless it is there already; returns the legend.

        Raises:
            RunError: The frame cannot be read.
        """
        frame = self._timeline.frame(index)
        colors, legend = splat_colors(frame, self._timeline, look.color_by)
        key = (self._timeline.revision, index, look.color_by, look.cut, shift)
        if key == self._sent:
            return legend
        gaussians = frame.gaussians
        if look.cut is not None:
            kept = ~hidden(gaussians.means, look.cut, self._timeline.survey(index).center)
            gaussians = gaussians.select(kept)
            colors = None if colors is None else colors[kept]
        centers, covariances, size = unit_size(gaussians)
        shown = (gaussians.colors() if colors is None else colors).clamp(0.0, 1.0)
        server.scene.add_gaussian_splats(
            _NODE,
            centers=_numpy(centers),
            covariances=_numpy(covariances),
            rgbs=_numpy(shown),
            opacities=_numpy(gaussians.opacities[:, None]),
            scale=size,
            position=(-shift[0], -shift[1], -shift[2]),
        )
        self._sent = key
        return legend


def unit_size(gaussians: Gaussians) -> tuple[Tensor, Tensor, float]:
    """Centres [N, 3] and covariances [N, 3, 3] divided by a size [m], and that size.

    The browser keeps covariances in half precision, whose smallest number is a standard deviation
    of 2.4e-4: splats of a millimetre in an object of metres would vanish. So the median splat is
    made 0.05 wide.
    """
    if gaussians.count == 0:
        return gaussians.means, gaussians.means.new_zeros(0, 3, 3), 1.0
    size = float(gaussians.scales.median()) / 0.05
    packed = gaussians.covariances() / size**2
    return gaussians.means / size, packed[:, _ORDER].reshape(-1, 3, 3), size


def _numpy(value: Tensor) -> np.ndarray:
    return value.detach().to("cpu", torch.float32).numpy()
