"""A whole shot is looked through before any of its work begins."""

from __future__ import annotations

import dataclasses
import math

import torch

from gsfluent.config import Shot
from gsfluent.data import INTERIOR, Frame, Gaussians, Solid
from gsfluent.data.regions import source_key
from gsfluent.errors import InputError
from gsfluent.io import load_capture
from gsfluent.pipeline.colliders.blades import BladeSet
from gsfluent.pipeline.colliders.rigid import RigidSet
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.light.from_shot import light_of, looks_of
from gsfluent.pipeline.reconstruct.stage import Reconstruct
from gsfluent.pipeline.render.camera import Action, cameras_for
from gsfluent.pipeline.texture import Texture
from gsfluent.stages.simulate import build_scene, solver_options


def check_shot(shot: Shot) -> None:
    """Make all that a shot asks for out of stand-ins, so that what cannot be is refused now.

    What hangs on the input itself is found when it is read: by the first stages.

    Args:
        shot: What is asked for.

    Raises:
        InputError: A setting, material, event, collider, lamp or camera that cannot be.
    """
    Reconstruct(**shot.reconstruct.given())
    Fill(**shot.fill.given(1.0))
    texture = shot.texture.given()
    if texture.get("method", "auto") != "auto":  # which always can be
        Texture(**texture)
    light_of(shot)
    looks_of(shot)
    _check_camera(shot)
    solver_options(shot)
    # parts that photographs tell apart are looked at as if they were everywhere
    objects = {
        name: dataclasses.replace(
            settings,
            parts=None
            if settings.parts is None
            else tuple(p for p in settings.parts if source_key(p.where.given()) is None),
        )
        for name, settings in shot.objects.items()
    }
    plain = dataclasses.replace(shot, objects=objects)
    solids = {name: _stand_in(number) for number, name in enumerate(objects)}
    scene = build_scene(plain, solids, Frame.identity())
    try:
        BladeSet(scene, 1.0).rows(-math.inf, math.inf)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"event 'blade': {error}", "mend its path, edge or width") from error
    RigidSet(scene, 1.0)


def _stand_in(number: int) -> Solid:
    """A cube of 1 m, beside the others."""
    origin = torch.tensor([2.0 * number, 0.0, 0.0])
    one = Gaussians.from_colors(
        (origin + 0.5)[None], torch.full((1,), 0.1), torch.full((1, 3), 0.5), label=INTERIOR
    )
    matter = torch.ones(2, 2, 2, dtype=torch.bool)
    return Solid(one, matter, 0.25 * matter.float(), origin, 0.5)


def _check_camera(shot: Shot) -> None:
    """Refuse a camera that cannot be, before there is anything to be seen."""
    output = shot.output
    photographs = isinstance(output.camera, int) and shot.capture is not None
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    cameras_for(
        str(output.camera),
        Action.of([corners]),
        output.size,
        capture=load_capture(shot.capture) if photographs and shot.capture else None,
        frame=Frame.identity(),
    )
