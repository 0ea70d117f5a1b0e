"""The film of a finished simulation: cameras, light and studio over its frames."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import torch

from gsfluent.config import Shot
from gsfluent.data import Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.io import load_capture, load_splats
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.light.albedo import Albedo
from gsfluent.pipeline.light.from_shot import clear_of, gloss_of, plates_of, transmission_of
from gsfluent.pipeline.light.glass import as_seen, on_a_face
from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.pipeline.light.wetness import Wetness, wet_colors, wet_gloss
from gsfluent.pipeline.render.backdrop import Backdrop, covered_floor, no_background, object_radius
from gsfluent.pipeline.render.camera import Action, cameras_for
from gsfluent.pipeline.render.figures import cameras_around
from gsfluent.pipeline.render.stage import Picture, Render, Room, RoomTurn
from gsfluent.pipeline.render.studio import Studio, wants_dark
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.results.frames import SavedFrame, count_frames, frame_positions, load_frame
from gsfluent.results.record import read_frame

# The pieces need a moment to part before a picture of them tells anything.
_POSTER_DELAY = 0.08
_READERS = {"cpu": 1}  # threads that read frames ahead
_READERS_ELSEWHERE = 3  # where a picture takes less than to read a frame
_AHEAD = 2  # pictures drawn ahead on each of several devices
_READ = ("image", "alpha", "depth")  # of a picture, on the first of them
_RESIDUE = 4.0  # voxels around a solid in which no background is believed


class Film:
    """Cameras, light and studio of one video over the frames of a simulation.

    Args:
        out: Folder of the finished run.
        shot: What the objects are made of, and where the camera is.
        light: The light.
        device: Where to render.

    Raises:
        InputError: There is no simulation, or the camera cannot be.
    """

    def __init__(self, out: Path, shot: Shot, light: Lighting, device: torch.device) -> None:
        self.folder, self.shot, self.device = out / "stages" / "simulate", shot, device
        count = count_frames(self.folder)
        if count == 0:
            raise InputError(f"{out}: no simulated frames", "run the shot first: gsfluent run")
        first = load_frame(self.folder, 0)
        positions = [first.positions]
        positions += [frame_positions(self.folder, index) for index in range(1, count)]
        action = Action.of(positions, _of_objects(first, shot))
        studio = None
        if shot.floor != "none":
            x, y = action.center[:, :2].mean(dim=0).tolist()
            extent = 1.3 * float(action.radius.amax())
            dark = studio_is_dark(first, shot)
            studio = Studio(0.0, (x, y), float(action.radius[0]), extent, dark)
        needs_capture = shot.capture is not None and isinstance(shot.output.camera, int)
        isolated = out / "stages" / "isolate"
        self.cameras = cameras_for(
            str(shot.output.camera),
            action,
            shot.output.size,
            capture=load_capture(shot.capture) if needs_capture and shot.capture else None,
            frame=read_frame(isolated) if (isolated / "frame.json").is_file() else None,
        )
        self.around = cameras_around(action)
        self.backdrop: Backdrop | None = None
        if shot.output.backdrop == "captured":
            self.backdrop = captured_backdrop(out / "stages", list(shot.objects), device)
        cell = occupancy_cell(first.gaussians)
        self.render = Render(light=light, studio=studio, normal_cell=cell)
        share = 0.0 if self.render.light is None else self.render.light.delight
        self._albedo = Albedo(self.frame(0), share) if share > 0.0 else None
        self._room: Room | None = None
        self._wetness = Wetness(self.frame, clear_of)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.cameras)

    def frame(self, index: int) -> SavedFrame:
        """Frame ``index`` on the film's device."""
        return load_frame(self.folder, index).to(self.device)

    def frames(self) -> Iterator[SavedFrame]:
        """All frames in order; while one is drawn, the next ones are read."""
        readers = _READERS.get(self.device.type, _READERS_ELSEWHERE)
        with ThreadPoolExecutor(readers) as pool:
            ahead = deque(
                pool.submit(self.frame, index) for index in range(min(readers, len(self)))
            )
            for index in range(readers, len(self) + readers):
                frame = ahead.popleft().result()
                if index < len(self):
                    ahead.append(pool.submit(self.frame, index))
                yield frame

    def picture(self, frame: SavedFrame, turn: RoomTurn | None = None) -> Picture:
        """The picture of a frame in the film's camera; ``turn`` knows the room of the one before.

        Without ``turn`` it is the last picture of this film.
        """
        gaussians = frame.gaussians if self._albedo is None else self._albedo.apply(frame)
        return self.drawn(gaussians, frame, self.cameras[frame.index], turn)

    def drawn(
        self, gaussians: Gaussians, frame: SavedFrame, camera: Camera, turn: RoomTurn | None = None
    ) -> Picture:
        """The picture of splats at the moment of a frame, in any camera."""
        gloss, clear = gloss_of(self.shot, frame), transmission_of(self.shot, frame)
        plates = plates_of(frame)
        shown, wet = gaussians, self._wetness.at(frame)
        if wet is not None:
            shown = wet_colors(shown, wet)
            gloss = None if gloss is None else wet_gloss(gloss, wet)
        if clear is not None:
            shown, gloss = as_seen(shown, gloss, clear, camera)
            plates = plates | ((clear > 0.0) & on_a_face(shown))
        made = self.render(
            shown,
            camera,
            groups=frame.groups,
            gloss=gloss,
            plates=plates,
            rigid=frame.anchor < 0,
            backdrop=self.backdrop,
            time=frame.time,
            room=self._room if turn is None else turn,
            clear=clear_of(frame),
            wet=wet,
        )
        if clear is not None:
            # what is seen through glass is no hole in it
            solid = draw(gaussians, camera, depth=True, groups=frame.groups)
            assert solid.depth is not None  # asked for
            made = replace(made, alpha=solid.alpha, depth=solid.depth)
        self._room = made.room
        return made


class _Turns:
    """The room of a film's pictures, handed on from each to the next one, whoever draws it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._room: Room | None = None
        self._next, self._failed = 0, math.inf  # the first picture that failed

    def of(self, index: int) -> RoomTurn:
        """The turn of picture ``index``: waits for the one before."""

        def turn(fitting: Callable[[Room | None], Room]) -> Room:
            with self._changed:
                self._changed.wait_for(lambda: self._next >= index or self._failed < index)
                if self._failed < index:
                    raise RuntimeError("a picture before this one failed")
                self._room = fitting(self._room)
                self._advance(index + 1)
                return self._room

        return turn

    def end(self, index: int, failed: bool) -> None:
        """Picture ``index`` is drawn, lit or not, or it failed."""
        with self._changed:
            if failed:  # those before it go on
                self._failed = min(self._failed, index)
                self._changed.notify_all()
                return
            self._changed.wait_for(lambda: self._next >= index or self._failed < index)
            self._advance(index + 1)

    def _advance(self, to: int) -> None:
        self._next = max(self._next, to)
        self._changed.notify_all()


def drawn_by(films: Sequence[Film]) -> Iterator[tuple[SavedFrame, Callable[[], Picture]]]:
    """All frames of a film in order, and what gives the picture of each.

    Args:
        films: The same film, on one device each. Frame i is drawn on the i-th of them, round
            about, ahead of who asks for it; frame and picture come on the first. Of one film, who
            asks draws. The pictures are the same either way.
    """
    if len(films) == 1:
        for frame in films[0].frames():
            yield frame, functools.partial(films[0].picture, frame)
        return
    turns, home = _Turns(), films[0].device

    def draw(film: Film, reading: Future[SavedFrame], index: int) -> Picture:
        failed = True
        try:
            on_gpu = film.device.type == "cuda"
            with torch.cuda.device(film.device) if on_gpu else contextlib.nullcontext():
                made = film.picture(reading.result(), turns.of(index))
            failed = False
        finally:
            turns.end(index, failed)
        return replace(made, **{name: getattr(made, name).to(home) for name in _READ})

    with contextlib.ExitStack() as stack:
        pools = [
            (
                stack.enter_context(ThreadPoolExecutor(_READERS_ELSEWHERE)),
                stack.enter_context(ThreadPoolExecutor(1)),
            )
            for _ in films
        ]
        ahead: deque[tuple[Future[SavedFrame], Future[Picture]]] = deque()
        count, most = len(films[0]), _AHEAD * len(films)
        for index in range(count + most):
            if index >= most and ahead:
                reading, drawing = ahead.popleft()
                yield reading.result().to(home), drawing.result
            if index < count:
                film, (readers, drawer) = films[index % len(films)], pools[index % len(films)]
                reading = readers.submit(film.frame, index)
                ahead.append((reading, drawer.submit(draw, film, reading, index)))


def studio_is_dark(frame: SavedFrame, shot: Shot) -> bool:
    """Whether the studio is the dark one, for the objects of a shot in its first frame."""
    if shot.output.backdrop in ("light", "dark"):
        return shot.output.backdrop == "dark"
    anchor = frame.anchor.long()
    ours = (anchor >= 0) & _of_objects(frame, shot).to(anchor.device)[anchor.clamp(min=0)]
    return wants_dark(frame.gaussians.select(ours))


def _of_objects(frame: SavedFrame, shot: Shot) -> torch.Tensor:
    """Which material points of a frame are those of the shot's objects, bool [N]."""
    bodies = frame.facts.get("bodies", ())
    numbers = [n for n, (name, _) in enumerate(bodies) if name in shot.objects]
    if frame.body is None or not numbers:
        return torch.ones(len(frame.positions), dtype=torch.bool)
    return torch.isin(frame.body.cpu(), torch.tensor(numbers, dtype=frame.body.dtype))


def captured_backdrop(stages: Path, objects: list[str], device: torch.device) -> Backdrop:
    """The background that the isolate stage left, in the scene, without what lies in the objects.

    Raises:
        InputError: It left none.
    """
    path = stages / "isolate" / "background.ply"
    if not path.is_file():
        raise no_background()
    frame = read_frame(stages / "isolate")
    around = load_splats(path)
    for name in objects:
        solid = SignedDistance.of_solid(load_solid(stages / "fill" / f"{name}.ply"))
        around = around.select(solid.at(around.means) > _RESIDUE * solid.voxel)
    whole = load_splats(stages / "isolate" / "object.ply").transformed(frame).means
    around = covered_floor(around.transformed(frame), whole, 0.0)
    return Backdrop(around.to(device), object_radius(whole))


def poster_frame(fragments: list[int], fps: float) -> int:
    """The most telling frame: shortly after the largest jump in the number of fragments.

    Without any break it is the middle of the video.
    """
    jumps = [b - a for a, b in itertools.pairwise(fragments)]
    if not jumps or max(jumps) <= 0:
        return len(fragments) // 2
    return min(len(fragments) - 1, jumps.index(max(jumps)) + 1 + round(_POSTER_DELAY * fps))
