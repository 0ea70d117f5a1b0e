"""One moment, one camera, one look: a picture. No browser is needed for any of this."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.data import Camera, Gaussians
from gsfluent.errors import GsfluentError
from gsfluent.pipeline.light.from_shot import (
    clear_of,
    gloss_of,
    light_of,
    plates_of,
    transmission_of,
)
from gsfluent.pipeline.light.glass import as_seen
from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.pipeline.light.wetness import Wetness, wet_colors, wet_gloss
from gsfluent.pipeline.liquid.clear import Clear
from gsfluent.pipeline.render.backdrop import Backdrop
from gsfluent.pipeline.render.camera import FARTHEST, Action, orbit
from gsfluent.pipeline.render.film import captured_backdrop, studio_is_dark
from gsfluent.pipeline.render.stage import Render
from gsfluent.pipeline.render.studio import Studio
from gsfluent.results.frames import SavedFrame
from gsfluent.viewer.model.color import Legend, splat_colors
from gsfluent.viewer.model.look import Cut, Look
from gsfluent.viewer.model.source import RunSource
from gsfluent.viewer.model.timeline import Timeline

_log = logging.getLogger(__name__)
_BARE = (0.93, 0.93, 0.94)  # ground when there is no floor


@dataclass(frozen=True)
class Drawn:
    """What of a frame is drawn."""

    gaussians: Gaussians  # Splats, coloured and cut
    groups: Tensor  # Siblings, int32 [N]
    gloss: Tensor | None  # Highlights of each splat, [N, 2], or None
    plates: Tensor  # Splats of rigid things, bool [N]
    clear: Tensor | None  # Share of light that goes through, [N], or None
    rigid: Tensor  # Splats of rigid things, which are set into the picture by depth, bool [N]
    liquid: Clear | None  # Which are liquids, or None
    wet: Tensor | None  # How wet they are, [N], or None
    legend: Legend | None  # What the colours mean, or None


class PictureMaker:
    """Draws moments of a timeline."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self.device = timeline.device
        self.shot = timeline.source.shot
        self.floor = None if self.shot is not None and self.shot.floor == "none" else 0.0
        self._backdrop = self._captured()
        self._wetness = Wetness(timeline.frame, clear_of)
        self._dark: bool | None = None  # of the studio; known with the first picture

    def first_light(self) -> Lighting:
        """The shot's light, or the usual one."""
        return light_of(self.shot) if self.shot is not None else Lighting()

    def camera(self, index: int, width: int, height: int) -> Camera:
        """The film's first camera, turned to frame ``index``.

        Raises:
            RunError: That frame cannot be read.
        """
        survey = self.timeline.survey(index)
        first = self.timeline.survey(self.timeline.first.index)
        limit = FARTHEST * max(first.extent)
        extent = [
            min(max(now, before), limit)
            for now, before in zip(survey.extent, first.extent, strict=True)
        ]
        action = Action(
            torch.tensor([survey.center], dtype=torch.float64),
            torch.tensor([survey.radius], dtype=torch.float64),
            extent=torch.tensor([extent], dtype=torch.float64),
        )
        return orbit(action, (width, height))[0]

    def picture(self, index: int, camera: Camera, look: Look) -> np.ndarray:
        """As :meth:`picture_and_legend`, the picture only."""
        return self.picture_and_legend(index, camera, look)[0]

    def picture_and_legend(
        self, index: int, camera: Camera, look: Look
    ) -> tuple[np.ndarray, Legend | None]:
        """Draw frame ``index``.

        Args:
            index: Frame number from 0.
            camera: In the scene frame.
            look: Colours, light, cut.

        Returns:
            Display values, uint8 [H, W, 3], and what the colours mean, if they mean something.

        Raises:
            RunError: The frame is missing or damaged.
        """
        frame = self.timeline.frame(index)
        drawn = self.splats(frame, look)
        gaussians, gloss, time = drawn.gaussians, drawn.gloss, frame.time
        groups: Tensor | None = drawn.groups
        plates: Tensor | None = drawn.plates
        rigid: Tensor | None = drawn.rigid
        liquid, wet = drawn.liquid, drawn.wet
        if gaussians.count == 0:  # everything is cut away: one splat that nobody sees
            speck = frame.gaussians.select(torch.zeros(1, dtype=torch.int64, device=self.device))
            gaussians = speck.replace(opacities=torch.full_like(speck.opacities, 1e-6))
            groups, gloss, plates, time = None, None, None, 0.0
            rigid, liquid, wet = None, None, None
        elif drawn.clear is not None and look.light is not None:
            gaussians, gloss = as_seen(gaussians, gloss, drawn.clear, camera)
        render = Render(
            light=look.light,
            studio=self._studio() if look.floor else None,
            background=_BARE,
            normal_cell=self.timeline.normal_cell,
        )
        backdrop = self._backdrop if look.floor else None
        made = render(
            gaussians,
            camera,
            groups=groups,
            gloss=gloss,
            plates=plates,
            rigid=rigid,
            backdrop=backdrop,
            time=time,
            clear=liquid,
            wet=wet,
        )
        values = (made.image * 255.0).round().clamp(0, 255).to(torch.uint8)
        return values.cpu().numpy(), drawn.legend

    def splats(self, frame: SavedFrame, look: Look) -> Drawn:
        """The splats of a frame as a look shows them."""
        gaussians, groups, plates = frame.gaussians, frame.groups, plates_of(frame)
        gloss = None if self.shot is None else gloss_of(self.shot, frame)
        clear, rigid, liquid, wet = None, frame.anchor < 0, None, None
        colors, legend = splat_colors(frame, self.timeline, look.color_by)
        if colors is not None:
            gaussians = gaussians.with_sh_degree(0).with_colors(colors)
        else:  # colours that tell something are not looked through, and not darker where wet
            liquid, wet = clear_of(frame), self._wetness.at(frame)
            if self.shot is not None:
                clear = transmission_of(self.shot, frame)
            if wet is not None:
                gaussians = wet_colors(gaussians, wet)
                gloss = None if gloss is None else wet_gloss(gloss, wet)
        if look.cut is not None:
            kept = ~hidden(gaussians.means, look.cut, self.timeline.survey(frame.index).center)
            gaussians, groups, plates = gaussians.select(kept), groups[kept], plates[kept]
            gloss = None if gloss is None else gloss[kept]
            clear = None if clear is None else clear[kept]
            rigid, wet = rigid[kept], None if wet is None else wet[kept]
            liquid = None if liquid is None else liquid.select(kept)
        return Drawn(gaussians, groups, gloss, plates, clear, rigid, liquid, wet, legend)

    def _studio(self) -> Studio | None:
        if self.floor is None:
            return None
        timeline = self.timeline
        if self._dark is None and self.shot is not None:
            self._dark = studio_is_dark(timeline.frame(0), self.shot)
        extent = 1.3 * timeline.extent()
        return Studio(self.floor, timeline.middle(), timeline.radius, extent, bool(self._dark))

    def _captured(self) -> Backdrop | None:
        """The photographed surroundings where the shot asks for them and they are there."""
        source, shot = self.timeline.source, self.shot
        if shot is None or shot.output.backdrop != "captured" or not isinstance(source, RunSource):
            return None
        try:
            return captured_backdrop(source.out / "stages", list(shot.objects), self.device)
        except (GsfluentError, OSError) as error:
            _log.warning("viewer: the captured backdrop is left out: %s", error)
            return None


def hidden(points: Tensor, cut: Cut, center: tuple[float, float, float]) -> Tensor:
    """Which points [N, 3] lie in front of a cut plane through ``center`` + offset, bool [N]."""
    normal = points.new_tensor(cut.normal)
    normal = normal / normal.norm()
    return (points - points.new_tensor(center)) @ normal > cut.offset


def browser_camera(
    wxyz: np.ndarray,
    position: np.ndarray,
    fov: float,
    size: tuple[int, int],
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Camera:
    """The camera that sees what the browser's sees (both look along +z with +y down).

    Args:
        wxyz: Orientation, camera to world [4].
        position: Where it is [3].
        fov: Vertical angle of view [radians].
        size: (width, height) of the picture [px].
        shift: From the browser's space to the scene [m], when the view follows the object.
    """
    turn = torch.as_tensor(np.asarray(wxyz, dtype=np.float64))
    rotation = geometry.quaternion_to_matrix(turn[None])[0].T
    eye = torch.as_tensor(np.asarray(position, dtype=np.float64)) + torch.tensor(
        shift, dtype=torch.float64
    )
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * fov)
    intrinsics = torch.tensor(
        [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    return Camera(viewmat, intrinsics, width, height, name="browser")
