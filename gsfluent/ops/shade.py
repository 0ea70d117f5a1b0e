"""Light per pixel in one kernel: :func:`shade`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsfluent import _load  # noqa: F401  (loads the compiled operators)
from gsfluent._check import check_tensor
from gsfluent.ops._register import fakes, no_gradient

_LAMP, _MAP, _STUDIO = 12, 15, 13


def shade(
    image: Tensor,
    alpha: Tensor,
    depth: Tensor,
    normal: Tensor,
    viewmat: Tensor,
    K: Tensor,
    lamps: Tensor,
    environment: Tensor,
    background: Tensor,
    *,
    gloss: Tensor | None = None,
    maps: tuple[Tensor, Tensor, Tensor] | None = None,
    grid: tuple[Tensor, Tensor, int] | None = None,
    occlusion: float = 1.0,
    studio: Tensor | None = None,
) -> Tensor:
    """The finished picture from what :func:`gsfluent.ops.rasterize` blended.

    Blinn-Phong by any number of lamps with percentage-closer soft shadows (Fernando 2005), light
    from everywhere as spherical harmonics of degree 2 (Ramamoorthi and Hanrahan 2001) less what
    matter hides, a floor and a backdrop. Pixels more opaque than 0.999 do not ask what is behind.
    The formulas and how the tables are packed: :mod:`gsfluent.pipeline.light.shade`; the whole
    picture in plain PyTorch, which the kernels are tested against: ``tests/ops/shade_model.py``.

    Args:
        image: Colours times opacity, display values, shape [H, W, 3], float32 or float64.
        alpha: Opacity, shape [H, W].
        depth: Camera z of the surface [m], shape [H, W].
        normal: Blended normals, shape [H, W, K]; columns 3 and 4 hold k_s and n_s of Blinn-Phong
            times opacity when ``gloss`` is not given.
        viewmat: Scene to camera, shape [4, 4].
        K: Intrinsics [px], shape [3, 3].
        lamps: Packed lamps, shape [L, 12].
        environment: Irradiance over pi, shape [9, 3].
        background: Display colour behind everything when there is no studio, shape [3].
        gloss: k_s and n_s for all pixels, shape [2].
        maps: Shadow maps: depth [M, S, S], opacity [M, S, S], packed cameras [M, 15].
        grid: Occupancy that hides the environment: values of the five levels of a pyramid one after
            the other, corner and cell [4], and the number of its finest cells per side.
        occlusion: Strength of that, 0 to 1.
        studio: Packed floor and backdrop, shape [13].

    Returns:
        Display values in [0, 1], shape [H, W, 3].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, or ``occlusion`` is not in [0, 1].

    Gradient: none.
    """
    op = "shade"
    check_tensor(op, "image", image, shape=("H", "W", 3))
    if not (0.0 <= occlusion <= 1.0 and math.isfinite(occlusion)):
        raise ValueError(f"{op}: occlusion must be in [0, 1], got {occlusion}")
    plane = tuple(image.shape[:2])
    wanted: list[tuple[str, Tensor | None, tuple[int | str, ...]]] = [
        ("alpha", alpha, plane),
        ("depth", depth, plane),
        ("normal", normal, (*plane, "K")),
        ("viewmat", viewmat, (4, 4)),
        ("K", K, (3, 3)),
        ("lamps", lamps, ("L", _LAMP)),
        ("environment", environment, (9, 3)),
        ("background", background, (3,)),
        ("gloss", gloss, (2,)),
        ("studio", studio, (_STUDIO,)),
    ]
    map_depth = map_alpha = map_cameras = values = frame = None
    nodes = 0
    if maps is not None:
        map_depth, map_alpha, map_cameras = maps
        wanted += [
            ("maps[0]", map_depth, ("M", "S", "S")),
            ("maps[1]", map_alpha, tuple(map_depth.shape)),
            ("maps[2]", map_cameras, (map_depth.shape[0], _MAP)),
        ]
    if grid is not None:
        values, frame, nodes = grid
        wanted += [("grid[0]", values, ("V",)), ("grid[1]", frame, (4,))]
    for name, value, shape in wanted:
        if value is not None:
            check_tensor(op, name, value, shape=shape, like=image)
    if normal.shape[2] < (5 if gloss is None else 3):
        raise ValueError(
            f"{op}: normal must have 5 columns, or 3 and gloss given, got {list(normal.shape)}"
        )
    return torch.ops.gsfluent.shade.default(
        image,
        alpha,
        depth,
        normal,
        gloss,
        viewmat,
        K,
        lamps,
        environment,
        background,
        map_depth,
        map_alpha,
        map_cameras,
        values,
        frame,
        int(nodes),
        float(occlusion),
        studio,
    )


fakes(shade=lambda image, *rest: image.new_empty((*image.shape[:2], 3)))
no_gradient("shade: no gradient", "shade")
