"""Several slices on one canvas: fewer calls, and neighbours that see each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gsfluent.errors import InputError
from gsfluent.pipeline.texture.inpaint.inpainter import Inpainter, SliceContext, combined_seed

GROUND = 0.5
"""Neutral grey around the object; known, so that a model sees the silhouette."""
_ALIGN = 8  # pixels: canvases of a latent model are cut into cells of 8, none may hold two slices


class TiledInpainter:
    """Grid of ``tile`` x ``tile`` neighbouring slices per picture.

    NeRFiller (Weber et al., CVPR 2024) reports that 2-D models give more consistent results on
    2 x 2 grids. Slices are grouped in the order of the call; a last group that is not full is
    filled up with its last slice, whose copies are known pixels.

    Args:
        inner: Backend that gets the canvases.
        tile: Slices along an edge of a canvas.
    """

    def __init__(self, inner: Inpainter, tile: int) -> None:
        if tile < 1:
            raise InputError(f"inpaint: tile must be at least 1, got {tile}", hint="use 1, 2 or 4")
        self.inner = inner
        self.tile = int(tile)
        self.name = f"{inner.name} ({tile}x{tile} tiles)"
        self.sequential = inner.sequential

    def __call__(
        self,
        slices: np.ndarray,
        mask: np.ndarray,
        *,
        seeds: Sequence[int] | None = None,
        context: SliceContext | None = None,
        **given: Any,
    ) -> np.ndarray:
        """Fill the holes: see :class:`Inpainter`."""
        own = [0] * len(slices) if seeds is None else [int(s) for s in seeds]
        where = context or SliceContext()
        group = self.tile * self.tile

        def canvas(field: np.ndarray | None, ground: object) -> np.ndarray | None:
            return None if field is None else self._canvas(field, ground)

        made = self.inner(
            self._canvas(slices.astype(np.float32), GROUND),
            self._canvas(mask.astype(bool), False, known_copies=True),
            seeds=[combined_seed(own[i : i + group]) for i in range(0, len(own), group)],
            context=replace(
                where,
                offsets=where.offsets[::group],
                inside=canvas(where.inside, False),
                guide=canvas(where.guide, 0.0),
                labels=canvas(where.labels, 0),
            ),
            **given,
        )
        height, width = mask.shape[1:]
        cell = [s + -s % _ALIGN for s in (height, width)]
        split = made.reshape(len(made), self.tile, cell[0], self.tile, cell[1], 3)
        split = split.transpose(0, 1, 3, 2, 4, 5).reshape(-1, cell[0], cell[1], 3)
        result = split[: len(slices), :height, :width]
        return np.where(mask.astype(bool)[..., None], result, slices).astype(np.float32)

    def _canvas(self, field: np.ndarray, ground: object, known_copies: bool = False) -> np.ndarray:
        """Pictures [B, H, W, ...] on canvases [ceil(B / tile^2), tile * h, tile * w, ...]."""
        count = len(field)
        missing = -count % (self.tile * self.tile)
        pad = [(0, 0)] + [(0, -s % _ALIGN) for s in field.shape[1:3]]
        pad += [(0, 0)] * (field.ndim - 3)
        cells = np.pad(field, pad, constant_values=ground)  # type: ignore[call-overload]
        extra = np.repeat(cells[-1:], missing, 0)
        if known_copies:
            extra = np.zeros_like(extra)
        cells = np.concatenate([cells, extra])
        h, w = cells.shape[1:3]
        t = self.tile
        grid = cells.reshape(-1, t, t, h, w, *cells.shape[3:])
        grid = np.moveaxis(grid, 3, 2)  # group, row, y, column, x
        return np.ascontiguousarray(grid).reshape(-1, t * h, t * w, *cells.shape[3:])
