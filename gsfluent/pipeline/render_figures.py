"""Figures of a film: holes and flicker of what is drawn, beside the splats without any care.

"Before" is what one gets by moving each splat rigidly with the material point that was nearest at
the start, as the peers do: no binding to pieces, no repair. Measured without light and from the
direction-independent colours, in the film's own camera, and in three that stand around the matter
in turn, one a frame. While nothing is broken both are the same and drawn once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Camera, Gaussians
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.draw import draw
from gsfluent.pipeline.flicker import Flow, flicker
from gsfluent.pipeline.render_camera import Action, look_at
from gsfluent.pipeline.render_holes import Holes, MatterView, small
from gsfluent.pipeline.run_frames import SavedFrame

AROUND = ((30.0, 15.0), (150.0, 15.0), (270.0, 15.0))
"""Azimuth and elevation of the cameras around the matter [degrees]."""
_SIZE = (200, 150)
_FIELD = 32.0  # degrees, of look_at
_NEIGHBOURS = 8
_FIGURES = ("hole_fraction", "see_through", "hole_fraction_around", "see_through_around", "flicker")


class RawCarry:
    """Splats that ride rigidly on the material point that was nearest to them at the start.

    Args:
        first: The first frame of the simulation.
    """

    def __init__(self, first: SavedFrame) -> None:
        from scipy.spatial import cKDTree

        # splats of solids have a number of their own; bullets, liquids, rigid things and repairs
        # are drawn as they are
        solids = (first.ids[: first.carried] >= 0).nonzero()[:, 0]
        chosen = _plain(first.gaussians.select(solids))
        quats = geometry.normalize_quaternions(chosen.quats)
        self.gaussians = chosen.replace(quats=quats)
        self._rest = first.positions
        body = first.body.long()
        splat_body = body[first.anchor[solids].long().clamp(min=0)]
        nearest = torch.zeros(len(solids), dtype=torch.int64)
        near = torch.zeros(len(body), _NEIGHBOURS, dtype=torch.int64)
        points, means = first.positions.cpu().numpy(), self.gaussians.means.cpu().numpy()
        for number in body.unique().tolist():
            rows = (body == number).nonzero()[:, 0].cpu()
            tree = cKDTree(points[rows.numpy()])
            k = min(_NEIGHBOURS, len(rows))
            found = tree.query(points[rows.numpy()], k=k)[1].reshape(-1, k)
            found = found[:, np.arange(_NEIGHBOURS).clip(max=k - 1)]
            near[rows] = rows[torch.from_numpy(found)]
            mine = (splat_body == number).nonzero()[:, 0].cpu()
            if len(mine):
                nearest[mine] = rows[torch.from_numpy(tree.query(means[mine.numpy()])[1])]
        device = first.positions.device
        self._nearest, self._near = nearest.to(device), near.to(device)

    def at(self, frame: SavedFrame) -> Gaussians:
        """The splats at another moment; colours of degree 0."""
        arm = self._rest[self._near] - self._rest[:, None]
        now = frame.positions[self._near] - frame.positions[:, None]
        # rotation of the best fit to how the neighbours have moved (Mueller et al. 2005)
        turn, _ = ops.polar_clamped((now.mT @ arm / arm.square().mean()).contiguous(), 0.3, 2.0)
        rest, point = self.gaussians, self._nearest
        offset = rest.means - self._rest[point]
        spin = geometry.matrix_to_quaternion(turn)[point]
        raw = rest.replace(
            means=frame.positions[point] + (turn[point] @ offset[..., None])[..., 0],
            quats=geometry.quaternion_multiply(spin, rest.quats),
        )
        others = frame.ids < 0
        if not bool(others.any()):
            return raw
        return Gaussians.cat([raw, _plain(frame.gaussians.select(others))])


def _plain(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(sh=gaussians.sh[:, :1].contiguous(), normals=None)


class _Last(NamedTuple):
    """What flicker needs of the frame before."""

    matter: MatterView
    camera: Camera
    positions: Tensor
    images: list[Tensor]


class FilmFigures:
    """Collects the figures of a film, frame by frame.

    Args:
        first: The first frame.
        around: Cameras around the matter, of which each frame takes the next.
    """

    def __init__(self, first: SavedFrame, around: Sequence[Camera] = ()) -> None:
        self._raw, self._around = RawCarry(first), list(around)
        volume = first.volumes
        self._spacing = float(volume.clamp(min=0.0).pow(1 / 3).median()) if len(volume) else 0.0
        self._last: _Last | None = None
        self._values: dict[str, list[float | int | None]] = {
            name + end: [] for name in _FIGURES for end in ("_before", "")
        }
        self._values["transition_gaussians"] = []

    @torch.no_grad()
    def add(self, frame: SavedFrame, camera: Camera) -> None:
        """Measure a frame: in the film's camera, and in the next of those around."""
        index = len(self._values["flicker"])
        added = frame.gaussians.count - frame.carried
        shown = [(_plain(frame.gaussians), frame.groups if added else None)]
        if added or bool((frame.damage >= 1.0).any()):
            shown.insert(0, (self._raw.at(frame), None))
        view = small(camera)
        matter = MatterView.of(frame.positions, frame.volumes, view)
        drawn = [_drawn(splats, view, groups) for splats, groups in shown]
        images = [picture.image for picture in drawn]
        self._enter("", [Holes.of(picture, matter) for picture in drawn])
        self._enter_flicker(_Last(matter, view, frame.positions, images))
        if self._around:
            view = self._around[index % len(self._around)]
            matter = MatterView.of(frame.positions, frame.volumes, view)
            drawn = [_drawn(splats, view, groups) for splats, groups in shown]
            self._enter("_around", [Holes.of(picture, matter) for picture in drawn])
        self._values["transition_gaussians"].append(added)

    def _enter(self, where: str, found: list[Holes]) -> None:
        for end, holes in (("_before", found[0]), ("", found[-1])):
            self._values[f"hole_fraction{where}{end}"].append(round(holes.fraction, 6))
            self._values[f"see_through{where}{end}"].append(round(holes.through, 6))

    def _enter_flicker(self, now: _Last) -> None:
        last, self._last = self._last, now
        changes: list[float | None] = [None, None]
        if last is not None and last.positions.shape == now.positions.shape:
            moved, views = (last.positions, now.positions), (last.camera, now.camera)
            flow = Flow.of(last.matter, now.matter, moved, views, self._spacing)
            pairs = [(last.images[k], now.images[k]) for k in (0, -1)]
            if len(last.images) == len(now.images) == 1:
                pairs = pairs[:1]
            changes = [flicker(*pair, flow) for pair in pairs]
        for end, change in (("_before", changes[0]), ("", changes[-1])):
            self._values["flicker" + end].append(None if change is None else round(change, 6))

    def report(self) -> dict[str, list[float | int | None]]:
        """Lists with one entry a frame; ``_around``: in the cameras around, in turn."""
        return {name: values for name, values in self._values.items() if values}


def _drawn(gaussians: Gaussians, camera: Camera, groups: Tensor | None) -> Rendered:
    white = gaussians.means.new_ones(3)
    return draw(gaussians, camera, groups=groups, near=0.01, median_depth=True, background=white)


def cameras_around(positions: list[Tensor]) -> list[Camera]:
    """Cameras that stand still and see nine tenths of the matter of all frames."""
    action = Action.of(positions)
    first = float(action.radius[0])
    center = action.center[len(positions) // 2 :].mean(0)
    away = (action.center - center).norm(dim=1) + action.radius
    reach = min(float(away.amax()), 2.5 * first)
    distance = reach / math.sin(math.radians(_FIELD / 2))
    return [look_at(center, distance, azimuth, height, _SIZE) for azimuth, height in AROUND]
