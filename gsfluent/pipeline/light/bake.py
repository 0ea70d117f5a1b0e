"""Light baked into the splats, for viewers that know nothing of light.

A viewer of splats shows a constant colour (or one that depends on the view) per splat. The relit
colour of every splat is its own colour under the lamps and the environment at its centre and
normal: diffuse light, shadows and occlusion, without highlights, which belong to one eye only.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsfluent import geometry
from gsfluent.data import Gaussians
from gsfluent.pipeline.light.lamps import Lighting, pack_lamps
from gsfluent.pipeline.light.normals import grid_for, splat_normals
from gsfluent.pipeline.light.occlusion import ambient_occlusion
from gsfluent.pipeline.light.shade import shade_points, to_display, to_linear
from gsfluent.pipeline.light.shadow_maps import bulk, faces_of, shadow_maps

_RESOLUTION = 1024
# Splats deeper than this below the skin, in cells, look at the lamps from the skin above them.
_LIFT = 1.0


@torch.no_grad()
def bake_light(
    gaussians: Gaussians,
    light: Lighting,
    *,
    groups: Tensor | None = None,
    normal_cell: float | None = None,
    time: float = 0.0,
) -> Gaussians:
    """Splats whose colours hold the light.

    The view-dependent part of the colours is scaled with the rest, so that captured highlights
    darken in the shade. Relit colours above 1 are cut by whatever shows them, not here.

    Args:
        gaussians: Scene frame, any state.
        light: The light. Its highlights are left out.
        groups: Siblings of which only the nearest blocks a ray, int32 [N].
        normal_cell: Spacing [m] of the grid behind normals and occlusion; found here when None (a
            sequence fixes it with :func:`gsfluent.pipeline.light.normals.occupancy_cell`).
        time: Moment [s], for lamps that move.

    Returns:
        The same splats in the same order with relit ``sh``.
    """
    lighting = light.at(time)
    means = gaussians.means
    matter = bulk(gaussians)
    size = grid_for(gaussians, cell=normal_cell, radius=matter.radius)
    grid = size.of(gaussians, matter.center)
    normal = normalize(splat_normals(gaussians, grid), dim=-1)
    lamps = lighting.drawn()
    faces = faces_of(lamps, matter)
    texels = lighting.resolution or _RESOLUTION
    maps = shadow_maps(gaussians, lamps, faces, texels, matter, groups=groups)
    skin = means + (_LIFT * size.cell) * normal
    ao = None
    if lighting.occlusion > 0.0:
        ao = 1.0 - lighting.occlusion * (1.0 - ambient_occlusion(means, normal, grid))
    albedo = to_linear(gaussians.colors())
    dull = torch.zeros(2, dtype=means.dtype, device=means.device)
    lit = shade_points(
        skin,
        normal,
        normal,
        albedo,
        dull,
        pack_lamps(lamps, faces, means),
        lighting.around(means),
        ao=ao,
        maps=maps,
    )
    color = to_display(lit)
    ratio = color / gaussians.colors().clamp(min=1.0 / 255.0)
    sh = gaussians.sh * ratio[:, None].clamp(max=4.0)
    sh[:, 0] = geometry.rgb_to_sh0(color)
    return gaussians.replace(sh=sh)
