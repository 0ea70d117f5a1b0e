"""The film of a finished simulation: cameras, light and studio over its frames."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
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
from gsfluent.pipeline.light.glass import as_seen
from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.pipeline.light.wetness import Wetness, wet_colors, wet_gloss
from gsfluent.pipeline.render.backdrop import Backdrop, covered_floor, no_background, object_radius
from gsfluent.pipeline.render.camera import Action, cameras_for
from gsfluent.pipeline.render.figures import cameras_around
from gsfluent.pipeline.render.stage import Picture, Render, Room
from gsfluent.pipeline.render.studio import Studio, wants_dark
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.results.frames import SavedFrame, count_frames, frame_positions, load_frame
from gsfluent.results.record import read_frame

# The pieces need a moment to part before a picture of them tells anything.
_POSTER_DELAY = 0.08
_READERS = {"cpu": 1}  # threads that read frames ahead
_READERS_ELSEWHERE = 3  # where a picture takes less than to read a frame
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

    def picture(self, frame: SavedFrame) -> Picture:
        """The picture of a frame in the film's camera."""
        gaussians = frame.gaussians if self._albedo is None else self._albedo.apply(frame)
        return self.drawn(gaussians, frame, self.cameras[frame.index])

    def drawn(self, gaussians: Gaussians, frame: SavedFrame, camera: Camera) -> Picture:
        """The picture of splats at the moment of a frame, in any camera."""
        gloss, clear = gloss_of(self.shot, frame), transmission_of(self.shot, frame)
        shown, wet = gaussians, self._wetness.at(frame)
        if wet is not None:
            shown = wet_colors(shown, wet)
            gloss = None if gloss is None else wet_gloss(gloss, wet)
        if clear is not None:
            shown, gloss = as_seen(shown, gloss, clear, camera)
        made = self.render(
            shown,
            camera,
            groups=frame.groups,
            gloss=gloss,
            plates=plates_of(frame),
            rigid=frame.anchor < 0,
            backdrop=self.backdrop,
            time=frame.time,
            room=self._room,
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
