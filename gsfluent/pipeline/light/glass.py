"""Glass as far as splats allow: what is seen face on lets light through, the rim reflects.

No ray is bent and nothing is mirrored. A splat of a clear body is as opaque as a pane of glass
looks from where the eye is (Schlick 1994), and wears the brightness of the studio where it
reflects.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent.data import Camera, Gaussians
from gsfluent.geometry import rgb_to_sh0
from gsfluent.pipeline.light.normals import plate_normals
from gsfluent.pipeline.light.shade import DISPLAY_GAMMA

_FACE_ON = 0.04  # reflected straight on by an index of 1.5
_STUDIO = 0.92  # display value of what is reflected
# Splats of a skin that a ray meets at one crossing: together they are as opaque as one pane.
_OVERLAP = 3.0
# A splat this much thinner than wide lies on a face.
_FLAT = 0.5
_LOST = 0.7  # of a highlight's display value, on a body that is all clear


def as_seen(
    gaussians: Gaussians, gloss: Tensor | None, clear: Tensor, camera: Camera
) -> tuple[Gaussians, Tensor | None]:
    """Splats and their highlights, k_s and n_s [N, 2], as a camera sees them.

    A highlight is composited with the splat's opacity, which says nothing about it: that of what
    is clear is made stronger by as much.
    """
    view = camera.viewmat.to(gaussians.means)
    seen = see_through(gaussians, clear, -(view[:3, 3] @ view[:3, :3]))
    if gloss is not None:
        gain = (1.0 - _LOST * clear) ** -DISPLAY_GAMMA
        gloss = torch.stack([gloss[:, 0] * gain, gloss[:, 1]], dim=1)
    return seen, gloss


def on_a_face(gaussians: Gaussians) -> Tensor:
    """Splats so flat that they lie on a face of a body, bool [N]; the others fill its inside."""
    thin, middle, _ = gaussians.scales.sort(dim=1).values.unbind(1)
    return thin < _FLAT * middle


def see_through(gaussians: Gaussians, clear: Tensor, eye: Tensor) -> Gaussians:
    """The splats as they are seen from ``eye``.

    Args:
        gaussians: Scene frame.
        clear: Share of the light that a face of the body lets through, [N] in [0, 1]; 0 leaves a
            splat as it is.
        eye: Where the picture is taken from [m], [3].

    Returns:
        The same splats in the same order, other opacities, and colours where they reflect.
    """
    away = torch.nn.functional.normalize(eye - gaussians.means, dim=1)
    facing = (plate_normals(gaussians, eye) * away).sum(dim=1).clamp(0.0, 1.0)
    mirror = _FACE_ON + (1.0 - _FACE_ON) * (1.0 - facing) ** 5
    tint = (1.0 - clear) * (1.0 - mirror)
    pane = mirror + tint
    face = on_a_face(gaussians)
    share = torch.where(face, 1.0 - (1.0 - pane) ** (1.0 / _OVERLAP), (1.0 - clear) ** 2)
    there = clear > 0.0
    opacities = torch.where(there, gaussians.opacities * share, gaussians.opacities)
    weight = torch.where(there & face, mirror / pane.clamp(min=1e-6), 0.0)[:, None]
    sh = gaussians.sh * (1.0 - weight[..., None])
    sh[:, 0] += weight * rgb_to_sh0(torch.full_like(sh[:, 0], _STUDIO))
    return gaussians.replace(opacities=opacities, sh=sh)
