"""Gaussians that are carried by material points, judged like points of their own.

The points of a dense scene (as many as a splat has Gaussians) are carried by those of a sparse one
as :mod:`gsfluent.pipeline.matter.carry` carries splats: each by its nearest points of its body at
rest,
with their total deformation, ``x = sum_k w_k (x_k + F_k (m0 - X_k))``.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.lab.world.driver import World
from gsfluent.pipeline.matter.carry import BLEND
from gsfluent.pipeline.matter.links import NEIGHBOURS
from gsfluent.spatial.neighbours import nearest_rows


class CarriedSplats:
    """The points of a dense scene on those of a sparse one."""

    def __init__(self, dense: Scene, sparse: Scene, device: str) -> None:
        self.dense, self.sparse, self.device = dense, sparse, torch.device(device)
        self._rest = torch.from_numpy(sparse.x).to(self.device)
        self._place = torch.from_numpy(dense.x).to(self.device)
        spacing = (dense.dx**3 / np.median(dense.dx**3 / sparse.volume)) ** (1.0 / 3.0)
        self._owner, self._near, self._none = _bind(
            self._rest, self._place, dense, sparse, float(spacing)
        )
        self._width = torch.full((sparse.count,), BLEND * float(spacing), dtype=torch.float64,
                                 device=self.device)  # fmt: skip
        shape = (dense.times.shape[0], dense.count, 3)
        self.x, self.v = np.full(shape, np.nan), np.full(shape, np.nan)
        self.seconds: list[float] = []
        """What carrying took at each time [s]."""

    def watch(self, world: World, i: int) -> None:
        """Carry the points to where the world is (for ``frozen.answer.run_case``).

        Raises:
            ValueError: The world tracks no deformation.
        """
        if world.deformation is None:
            raise ValueError("CarriedSplats: the world tracks no deformation (deformation=True)")
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        position = world.position.double()
        x, _ = ops.carry_place(
            self._place, self._owner, self._near, self._none, self._rest, position,
            world.deformation.double(), self._width,
        )  # fmt: skip
        arm = x - position[self._owner]
        spin = world.affine.double()[self._owner]
        v = world.velocity.double()[self._owner] + (spin @ arm[..., None])[..., 0]
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        self.seconds.append(time.perf_counter() - start)
        self.x[i], self.v[i] = x.cpu().numpy(), v.cpu().numpy()

    def run(self, below: Run) -> Run:
        """The run of what is carried, from that of the points below."""
        return Run(
            below.scene, below.method, below.times, self.x, self.v, below.wall_seconds,
            below.steps, below.settings, below.device, below.failed,
        )  # fmt: skip


def _bind(
    rest: Tensor, place: Tensor, dense: Scene, sparse: Scene, spacing: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest point of the own body of each carried one, and neighbours of each point.

    Returns:
        Owners int64 [M], neighbours int64 [N, K], and which of these are there only to fill the
        row of a body of fewer points, bool [N, K].
    """
    owner = torch.zeros(place.shape[0], dtype=torch.int64, device=place.device)
    count = rest.shape[0]
    near = torch.arange(count, device=place.device)[:, None].repeat(1, NEIGHBOURS)
    fill = torch.zeros(count, NEIGHBOURS, dtype=torch.bool, device=place.device)
    for body in range(int(sparse.body.max()) + 1):
        below = torch.from_numpy(np.flatnonzero(sparse.body == body)).to(place.device)
        above = torch.from_numpy(np.flatnonzero(dense.body == body)).to(place.device)
        k = min(NEIGHBOURS, below.shape[0])
        own = rest[below]
        owner[above] = below[nearest_rows(own, place[above], 1, spacing)[1][:, 0]]
        near[below, :k] = below[nearest_rows(own, own, k, spacing)[1]]
        fill[below, k:] = True
    return owner, near, fill
