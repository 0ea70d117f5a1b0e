"""The film of a finished simulation: cameras, light and studio over its frames."""

from __future__ import annotations

import itertools
from pathlib import Path

import torch

from gsfluent.config import Shot
from gsfluent.data import Camera
from gsfluent.errors import InputError
from gsfluent.io import load_capture, load_splats
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.light.delight import Delit
from gsfluent.pipeline.light.from_shot import gloss_of
from gsfluent.pipeline.light.lamps import Light, Lighting, lighting_of
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.pipeline.render.backdrop import Backdrop, covered_floor, no_background, object_radius
from gsfluent.pipeline.render.camera import Action, cameras_for
from gsfluent.pipeline.render.figures import cameras_around
from gsfluent.pipeline.render.stage import Layers, Render
from gsfluent.pipeline.render.studio import Studio
from gsfluent.pipeline.solid.field import SignedDistance
from gsfluent.results.frames import SavedFrame, count_frames, load_frame
from gsfluent.results.record import read_frame

# The pieces need a moment to part before a picture of them tells anything.
_POSTER_DELAY = 0.08


_RESIDUE = 4.0  # voxels around a solid in which no background is believed


class Film:
    """Cameras, light and studio of one video over the frames of a simulation.

    Args:
        folder: ``OUT/stages/simulate``.
        cameras: One per frame; made by :meth:`of`.
        render: The render stage.
        shot: What the objects are made of.
        device: Where to render.
        around: Cameras that stand around the matter, for figures.
    """

    def __init__(
        self,
        folder: Path,
        cameras: list[Camera],
        render: Render,
        shot: Shot,
        device: torch.device,
        around: list[Camera] | None = None,
    ) -> None:
        self.folder, self.cameras, self.render, self.device = folder, cameras, render, device
        self.shot, self.around = shot, around or []
        lighting = lighting_of(render.light)
        share = 0.0 if lighting is None else lighting.delight
        self._delit = Delit(self.frame(0), share) if share > 0.0 else None

    @classmethod
    def of(cls, out: Path, shot: Shot, light: Light | Lighting, device: torch.device) -> Film:
        """Set up the film of a finished simulation.

        Raises:
            InputError: There is none, or the camera cannot be.
        """
        folder = out / "stages" / "simulate"
        count = count_frames(folder)
        if count == 0:
            raise InputError(f"{out}: no simulated frames", "run the shot first: gsfluent run")
        first = load_frame(folder, 0)
        positions = [first.positions]
        positions += [load_frame(folder, index).positions for index in range(1, count)]
        action = Action.of(positions)
        floor = None if shot.floor == "none" else 0.0
        studio = None
        if floor is not None:
            x, y = action.center[:, :2].mean(dim=0).tolist()
            studio = Studio(
                floor, (x, y), float(action.radius[0]), 1.3 * float(action.radius.amax())
            )
        needs_capture = shot.capture is not None and isinstance(shot.output.camera, int)
        isolated = out / "stages" / "isolate"
        frame = read_frame(isolated) if (isolated / "frame.json").is_file() else None
        cameras = cameras_for(
            str(shot.output.camera),
            action,
            shot.output.size,
            capture=load_capture(shot.capture) if needs_capture and shot.capture else None,
            frame=frame,
        )
        backdrop = None
        if shot.output.backdrop == "captured":
            backdrop = captured_backdrop(out / "stages", list(shot.objects), device)
        render = Render(
            light=light,
            studio=studio,
            backdrop=backdrop,
            normal_cell=occupancy_cell(first.gaussians),
        )
        return cls(folder, cameras, render, shot, device, cameras_around(positions))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.cameras)

    def frame(self, index: int) -> SavedFrame:
        """Frame ``index`` on the film's device."""
        return load_frame(self.folder, index).to(self.device)

    def picture(self, frame: SavedFrame) -> torch.Tensor:
        """The picture [H, W, 3] of a frame."""
        return self.layers(frame).image

    def layers(self, frame: SavedFrame) -> Layers:
        """The picture of a frame with its opacity and depth."""
        camera = self.cameras[frame.index]
        gloss = gloss_of(self.shot, frame)
        gaussians = frame.gaussians if self._delit is None else self._delit.apply(frame)
        return self.render.layers(
            gaussians, camera, groups=frame.groups, gloss=gloss, time=frame.time
        )


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
