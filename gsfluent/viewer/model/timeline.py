"""What the frames of a source have in common: extent, clock, figures, depth, colours of pieces."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsfluent.data import SURFACE
from gsfluent.errors import GsfluentError, RunError
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.pipeline.render.camera import Action
from gsfluent.results.frames import SavedFrame
from gsfluent.spatial.neighbours import nearest
from gsfluent.viewer.model.pieces import Pieces
from gsfluent.viewer.model.source import Source

_CACHE_BYTES = 1 << 30  # of frames kept ready
_SURVEYED = 24  # frames that are looked at for extent and top speed
_DEFAULT_FPS = 30.0


@dataclass(frozen=True)
class Survey:
    """What one frame adds to the whole."""

    center: tuple[float, float, float]  # Robust centre of the matter [m]
    radius: float  # Distance from it that holds nine tenths of the matter [m]
    extent: tuple[float, float]  # Beside it and above or below, 95 % of the matter each [m]
    speed: float  # Speed that one point in a hundred exceeds [m/s]

    @classmethod
    def of(cls, frame: SavedFrame) -> Survey:
        """Measure a frame."""
        action = Action.of([frame.positions])
        x, y, z = action.center[0].tolist()
        speed = frame.velocity.norm(dim=1)
        speed = speed[:: max(1, speed.shape[0] // 20_000)]
        top = float(torch.quantile(speed.float(), 0.99)) if speed.numel() else 0.0
        assert action.extent is not None  # of what was measured
        wide, tall = action.extent[0].tolist()
        return cls((x, y, z), float(action.radius[0]), (wide, tall), top)


class Timeline:
    """Frames of a source on a device, with what is known of them all.

    Safe to use from several threads.

    Raises:
        RunError: Not one frame can be read.
    """

    def __init__(self, source: Source, device: torch.device) -> None:
        self.source, self.device = source, device
        self._lock = threading.RLock()
        self._reset()

    def _reset(self) -> None:
        self.revision = self.source.revision
        self._frames: OrderedDict[int, SavedFrame] = OrderedDict()
        self._bytes = 0
        self._facts: dict[int, dict[str, Any]] = {}
        self._surveys: dict[int, Survey] = {}
        self.pieces = Pieces()
        self.count, self.running = 0, self.source.running
        self.refresh()
        self.first = self._first_readable()
        self.radius = self.survey(self.first.index).radius
        self.normal_cell = occupancy_cell(self.first.gaussians)
        self._depth = _depth_of_points(self.first)
        self._name_pieces()

    def refresh(self) -> bool:
        """Look for more frames; returns whether anything changed.

        Raises:
            RunError: The source began anew and not one frame can be read.
        """
        with self._lock:
            if self.source.revision != self.revision:
                self._reset()
                return True
            count, running = self.source.count(), self.source.running
            changed = count != self.count or running != self.running
            if self.running and not running:
                self._facts.clear()  # a finished run knows more, such as the holes
            self.count, self.running = count, running
            for index in range(count):
                if not self._facts.get(index):
                    self._facts[index] = self.source.facts(index)
            return changed

    def frame(self, index: int) -> SavedFrame:
        """Frame ``index`` on the device.

        Raises:
            RunError: It is missing or damaged.
        """
        with self._lock:
            if index in self._frames:
                self._frames.move_to_end(index)
                return self._frames[index]
            frame = self.source.frame(index).to(self.device)
            if not bool(frame.positions.isfinite().all()) or frame.gaussians.count == 0:
                raise RunError(f"frame {index + 1} holds no drawable matter", "the other frames")
            self._frames[index] = frame
            self._bytes += _size(frame)
            while self._bytes > _CACHE_BYTES and len(self._frames) > 1:
                self._bytes -= _size(self._frames.popitem(last=False)[1])
            return frame

    def survey(self, index: int) -> Survey:
        """What frame ``index`` looks like as a whole.

        Raises:
            RunError: It is missing or damaged.
        """
        with self._lock:
            if index not in self._surveys:
                self._surveys[index] = Survey.of(self.frame(index))
            return self._surveys[index]

    def surveys(self) -> list[Survey]:
        """Surveys of a few frames, evenly spread, the readable ones only."""
        step = max(1, self.count // _SURVEYED)
        found = []
        for index in {*range(0, self.count, step), max(0, self.count - 1)}:
            try:
                found.append(self.survey(index))
            except GsfluentError:
                continue
        return found

    def extent(self) -> float:
        """Largest distance that holds nine tenths of the matter in any frame [m]."""
        return max(survey.radius for survey in self.surveys())

    def top_speed(self) -> float:
        """Speed that hardly any point ever exceeds [m/s]; at least a millimetre a second."""
        return max(1e-3, *(survey.speed for survey in self.surveys()))

    def middle(self) -> tuple[float, float]:
        """Where on the floor the action is [m]."""
        places = [survey.center for survey in self.surveys()]
        return (
            sum(place[0] for place in places) / len(places),
            sum(place[1] for place in places) / len(places),
        )

    def fps(self) -> float:
        """Frames per second of simulated time."""
        times = [self._facts[i]["time"] for i in range(self.count) if self._facts.get(i)]
        span = times[-1] - times[0] if len(times) > 1 else 0.0
        return (len(times) - 1) / span if span > 0.0 else _DEFAULT_FPS

    def facts(self) -> list[dict[str, Any]]:
        """Figures of every frame; empty ones for frames that cannot be read."""
        with self._lock:
            return [self._facts.get(index, {}) for index in range(self.count)]

    def depth(self, frame: SavedFrame) -> Tensor:
        """Depth of each material point below the surface of the whole object [m], [P].

        Points that came later (poured, shot) have none.
        """
        known = torch.zeros(frame.positions.shape[0], device=frame.positions.device)
        shared = min(known.shape[0], self._depth.shape[0])
        known[:shared] = self._depth[:shared].to(known)
        return known

    def readable(self, index: int) -> int:
        """The readable frame nearest to ``index``."""
        for other in sorted(range(self.count), key=lambda i: abs(i - index)):
            try:
                self.frame(other)
            except GsfluentError:
                continue
            return other
        return self.first.index

    def _first_readable(self) -> SavedFrame:
        problem: GsfluentError | None = None
        for index in range(self.count):
            try:
                return self.frame(index)
            except GsfluentError as error:
                problem = problem or error
        raise RunError(f"no frame can be shown: {problem}", "", "run the shot again") from problem

    def _name_pieces(self) -> None:
        """Give the pieces of the last frame their numbers first, largest first: clear colours."""
        for index in (self.count - 1, self.first.index):
            try:
                self.pieces.of(self.frame(index))
            except GsfluentError:
                continue


def _depth_of_points(frame: SavedFrame) -> Tensor:
    """Distance from each material point to the nearest splat of the skin [m], [P]."""
    labels = frame.gaussians.labels
    means = frame.gaussians.means
    skin = means if labels is None else means[labels == SURFACE]
    if skin.shape[0] == 0:
        return torch.zeros(frame.positions.shape[0])
    spacing = max(float(frame.volumes.double().mean()) ** (1.0 / 3.0), 1e-9)
    distance, _ = nearest(skin, frame.positions.double().cpu().numpy(), 1, 4.0 * spacing)
    return torch.from_numpy(distance[:, 0]).float()


def _size(frame: SavedFrame) -> int:
    fields = [*vars(frame).values(), *vars(frame.gaussians).values()]
    return sum(f.numel() * f.element_size() for f in fields if isinstance(f, Tensor))
