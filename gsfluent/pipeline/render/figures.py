"""Figures of a film: holes and flicker of what is drawn, beside the splats without any care.

"Before" is what one gets by moving each splat rigidly with the material point that was nearest at
the start, as the peers do: no binding to pieces, no repair. Holes in the film are counted in its
own pictures: every frame of liquids and of what has broken, one of twelve of what is whole. What
needs pictures of its own (before, flicker, and the view of one of three cameras around the matter)
is measured in two frames of every twelve in which something is broken, or it would cost as much as
the film; without light, from the direction-independent colours.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.ops.raster import Rendered
from gsfluent.pipeline.light.from_shot import clear_of
from gsfluent.pipeline.liquid.clear import OPACITY, Clear
from gsfluent.pipeline.render.camera import Action, look_at
from gsfluent.pipeline.render.flicker import Flow, flicker
from gsfluent.pipeline.render.holes import Holes, MatterView, small
from gsfluent.pipeline.render.stage import Picture, Render
from gsfluent.results.frames import SavedFrame
from gsfluent.spatial.neighbours import nearest_in_group

AROUND = ((30.0, 15.0), (150.0, 15.0), (270.0, 15.0))
"""Azimuth and elevation of the cameras around the matter [degrees]."""
EVERY = 12
_SIZE = (200, 150)
_FIELD = 32.0  # degrees, of look_at
_NEIGHBOURS = 8
_FIGURES = ("hole_fraction", "see_through", "hole_fraction_around", "see_through_around", "flicker")


def spacing_of(frame: SavedFrame) -> float:
    """Median edge of the material points [m]; 0 where there are none."""
    volume = frame.volumes
    return float(volume.clamp(min=0.0).pow(1 / 3).median()) if len(volume) else 0.0


class RawCarry:
    """Splats carried rigidly by the material point that was nearest to them at the start.

    Args:
        first: The first frame of the simulation.
    """

    def __init__(self, first: SavedFrame) -> None:
        # splats of solids have a number of their own; bullets, liquids, rigid things and repairs
        # are drawn as they are
        solids = (first.ids[: first.carried] >= 0).nonzero()[:, 0]
        chosen = _plain(first.gaussians.select(solids))
        quats = geometry.normalize_quaternions(chosen.quats)
        self.gaussians = chosen.replace(quats=quats)
        self._rest = first.positions
        body = first.body.long()
        splat_body = body[first.anchor[solids].long().clamp(min=0)]
        points, spacing = first.positions, spacing_of(first) or 1.0
        # of a body of fewer points, its own again
        near = nearest_in_group(points, body, points, body, _NEIGHBOURS, spacing)[1]
        self._near = torch.where(near < 0, near[:, :1], near)
        found = nearest_in_group(points, body, self.gaussians.means, splat_body, 1, spacing)[1]
        self._nearest = found[:, 0].clamp(min=0)

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

    number: int
    matter: MatterView
    camera: Camera
    shown: Tensor
    images: list[Tensor]


class FilmFigures:
    """Collects the figures of a film, frame by frame.

    Args:
        first: The first frame.
        around: Cameras around the matter.
        every: Of so many broken frames two are measured in full.
    """

    def __init__(
        self, first: SavedFrame, around: Sequence[Camera] = (), *, every: int = EVERY
    ) -> None:
        self._first, self._around, self._every = first, list(around), every
        self._spacing = spacing_of(first)
        # as the film, without its light
        self._render = Render()
        self._last: _Last | None = None
        self._broken = 0
        self._values: dict[str, list[float | int | None]] = {
            name + end: [] for name in _FIGURES for end in ("_before", "")
        }
        self._values["transition_gaussians"] = []

    @functools.cached_property
    def _raw(self) -> RawCarry:
        """Made when something has broken: without that nobody asks."""
        return RawCarry(self._first)

    @torch.no_grad()
    def add(self, frame: SavedFrame, camera: Camera, alpha: Tensor, depth: Tensor) -> None:
        """Measure a frame.

        Args:
            frame: The frame.
            camera: The film's camera.
            alpha: Opacity of the splats in the film's picture, [H, W].
            depth: Their expected depth there [m], [H, W].
        """
        index = len(self._values["flicker"])
        clear, added = clear_of(frame), frame.gaussians.count - frame.carried
        for values in self._values.values():
            values.append(None)
        self._set("transition_gaussians", added)
        whole = not added and not bool((frame.damage >= 1.0).any())
        if whole and clear is None and index % self._every:
            return  # nothing has parted: as in the frame before
        view = small(camera)
        places = frame.shown
        matter = MatterView.of(places, frame.volumes, view)
        film = Holes.of(alpha, depth, matter)
        if whole:
            self._enter("", [film, film])
            return
        turn, self._broken = self._broken % self._every, self._broken + 1
        # the second and third broken frame, and so on: in the first nothing has parted yet
        if turn not in (1 % self._every, 2 % self._every):
            self._enter("", [None, film])
            return
        raw, plain = self._raw.at(_solid(frame, clear)), _plain(frame.gaussians)

        def drawn(view: Camera) -> list[Rendered | Picture]:
            shown = self._render(
                plain,
                view,
                groups=frame.groups if added else None,
                rigid=frame.anchor < 0,
                clear=clear,
            )
            return [_drawn(raw, view), shown]

        pictures = drawn(view)
        self._enter("", [_holes(pictures[0], _bare(frame, matter, view)), film])
        images = [picture.image for picture in pictures]
        self._enter_flicker(_Last(index, matter, view, places, images))
        if self._around:
            view = self._around[index % len(self._around)]
            matter = MatterView.of(places, frame.volumes, view)
            pictures = drawn(view)
            before = _holes(pictures[0], _bare(frame, matter, view))
            self._enter("_around", [before, _holes(pictures[1], matter)])

    def _set(self, name: str, value: float | int | None) -> None:
        self._values[name][-1] = round(value, 6) if isinstance(value, float) else value

    def _enter(self, where: str, found: list[Holes | None]) -> None:
        for end, holes in zip(("_before", ""), found, strict=True):
            if holes is not None:
                self._set(f"hole_fraction{where}{end}", holes.fraction)
                self._set(f"see_through{where}{end}", holes.through)

    def _enter_flicker(self, now: _Last) -> None:
        last, self._last = self._last, now
        if last is None or last.number != now.number - 1:
            return
        if last.shown.shape != now.shown.shape:
            return
        moved, views = (last.shown, now.shown), (last.camera, now.camera)
        flow = Flow.of(last.matter, now.matter, moved, views, self._spacing)
        for k, end in enumerate(("_before", "")):
            self._set(f"flicker{end}", flicker(last.images[k], now.images[k], flow))

    def report(self) -> dict[str, list[float | int | None]]:
        """Lists with one entry a frame, None where not measured.

        ``_around``: in a camera around the matter, another one each time.
        """
        return self._values


def _bare(frame: SavedFrame, shown: MatterView, view: Camera) -> MatterView:
    """Matter where it is: with that a splat goes of which nobody takes care."""
    return shown if frame.led is None else MatterView.of(frame.positions, frame.volumes, view)


def _solid(frame: SavedFrame, clear: Clear | None) -> SavedFrame:
    """The frame with its clear liquids opaque: what is seen through water is no hole in it."""
    if clear is None:
        return frame
    opaque = torch.where(clear.rows, OPACITY, frame.gaussians.opacities)
    return replace(frame, gaussians=frame.gaussians.replace(opacities=opaque))


def _drawn(gaussians: Gaussians, camera: Camera) -> Rendered:
    white = gaussians.means.new_ones(3)
    return draw(gaussians, camera, near=0.01, depth=True, background=white)


def _holes(drawn: Rendered | Picture, matter: MatterView) -> Holes:
    assert drawn.depth is not None  # asked for; narrows the type
    return Holes.of(drawn.alpha, drawn.depth, matter)


def cameras_around(action: Action) -> list[Camera]:
    """Cameras that stand still and see nine tenths of the matter of all frames."""
    first = float(action.radius[0])
    center = action.center[len(action.center) // 2 :].mean(0)
    away = (action.center - center).norm(dim=1) + action.radius
    reach = min(float(away.amax()), 2.5 * first)
    distance = reach / math.sin(math.radians(_FIELD / 2))
    return [look_at(center, distance, azimuth, height, _SIZE) for azimuth, height in AROUND]
