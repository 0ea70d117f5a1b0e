"""Light for exports: of pictures, or baked into colours for programs that have none."""

from __future__ import annotations

from pathlib import Path

from gsfluent.config import Shot
from gsfluent.data import Gaussians
from gsfluent.export.frames import Relight
from gsfluent.export.job import ExportOptions
from gsfluent.pipeline.light.bake import bake_light
from gsfluent.pipeline.light.from_shot import changed, light_of
from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.pipeline.light.normals import occupancy_cell
from gsfluent.results.frames import SavedFrame, load_frame


def lighting_for(shot: Shot, options: ExportOptions) -> Lighting:
    """The shot's light with what the options change.

    Raises:
        InputError: A light that cannot be read.
    """
    return changed(
        light_of(shot), light=options.light, lamps=options.lamps, surroundings=options.environment
    )


def relight_of(out: Path, options: ExportOptions) -> Relight:
    """Bakes the run's light into the splats of a frame.

    Raises:
        InputError: Not a finished run, or a light that cannot be read.
    """
    from gsfluent.results.record import shot_of

    lighting = lighting_for(shot_of(out), options)
    # one grid for all frames, or normals and with them the light would jump between them
    cell = occupancy_cell(load_frame(out / "stages" / "simulate", 0).gaussians)

    def relight(saved: SavedFrame) -> Gaussians:
        return bake_light(
            saved.gaussians, lighting, groups=saved.groups, normal_cell=cell, time=saved.time
        )

    return relight
