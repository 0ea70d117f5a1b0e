"""The object at coarser resolutions, and stacks of slices back into a volume."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gsfluent.errors import InputError
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, block_mean

logger = logging.getLogger(__name__)


def coarse_domain(domain: InteriorDomain, factor: int) -> InteriorDomain:
    """The domain at 1/factor of its resolution; depth in the new voxels."""
    if factor == 1:
        return domain
    blocks = functools.partial(block_mean, factor=factor, dimensions=3)
    share = blocks(domain.inside)
    inside = share > 0.4
    depth = blocks(domain.depth) / np.maximum(share, 1e-3) / factor
    skinned = blocks(domain.shell)
    skin = blocks(domain.skin * domain.shell[..., None]) / np.maximum(skinned, 1e-3)[..., None]
    # voxels without a piece of shell keep the mean of their nearest-surface colours
    plain = blocks(domain.skin * domain.inside[..., None]) / np.maximum(share, 1e-3)[..., None]
    return replace(
        domain,
        inside=inside,
        depth=np.where(inside, depth, 0.0).astype(np.float32),
        shell=inside & (skinned > 0) & (depth <= 1.0),
        skin=np.where((skinned > 0)[..., None], skin, plain).astype(np.float32),
        voxel=domain.voxel * factor,
    )


def enlarge(rgb: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Trilinear enlargement by two of a volume [X, Y, Z, 3], cropped or padded to ``shape``."""
    tensor = torch.from_numpy(np.moveaxis(rgb, -1, 0)[None].astype(np.float32))
    size = tuple(2 * s for s in rgb.shape[:3])
    big = torch.nn.functional.interpolate(tensor, size=size, mode="trilinear", align_corners=False)
    out = np.moveaxis(big[0].numpy(), 0, -1)
    grown = [(0, max(0, s - t)) for s, t in zip(shape, out.shape[:3], strict=True)]
    out = np.pad(out, [*grown, (0, 0)], mode="edge")
    return np.ascontiguousarray(out[: shape[0], : shape[1], : shape[2]])


def slice_positions(inside: np.ndarray, axis: int, count: int) -> list[int]:
    """Indices of at most ``count`` slices, evenly spread over the matter along an axis."""
    filled = np.flatnonzero(inside.any(tuple(i for i in range(3) if i != axis)))
    number = min(count, len(filled))
    if number == 0:
        return []
    picked = np.linspace(filled[0], filled[-1], number).round().astype(int)
    return [int(p) for p in np.unique(picked)]


def fuse_stacks(
    shape: Sequence[int], stacks: Sequence[tuple[int, Sequence[int], np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """One volume [X, Y, Z, 3] out of slices across several axes: their mean; and their variance.

    Slices between those made are interpolated. On the lattice of the voxels the mean over the axes
    is the least-squares answer (:func:`.fusion.fuse_colors` is the one for Gaussians anywhere).
    ``stacks`` holds axis, slice indices [K] and slices [K, ., ., 3] each.
    """
    total = np.zeros((*shape, 3), np.float32)
    square = np.zeros(tuple(shape), np.float32)
    for axis, positions, images in stacks:
        stack = _interpolate(images, positions, int(shape[axis]))
        proposal = np.moveaxis(stack, 0, axis)
        total += proposal / len(stacks)
        square += (proposal**2).sum(-1) / len(stacks)
    return total, (square - (total**2).sum(-1)).clip(0.0) / 3.0


def _interpolate(slices: np.ndarray, positions: Sequence[int], count: int) -> np.ndarray:
    """Linear interpolation of slices [K, ...] at ``positions`` to all 0..count-1."""
    if list(positions) == list(range(count)):
        return slices
    place = np.arange(count)
    upper = np.searchsorted(positions, place).clip(1, max(len(positions) - 1, 1))
    lower = upper - 1
    upper = np.minimum(upper, len(positions) - 1)
    known = np.asarray(positions, dtype=float)
    gap = np.maximum(known[upper] - known[lower], 1e-9)
    t = np.clip((place - known[lower]) / gap, 0.0, 1.0)[:, None, None, None]
    return ((1 - t) * slices[lower] + t * slices[upper]).astype(np.float32)


class SliceStore:
    """Finished slices on disk, so that an interrupted run goes on where it stopped.

    Args:
        folder: Where to keep them; None keeps nothing.
        key: What the slices depend on; another key starts afresh.

    Raises:
        InputError: The folder cannot be written.
    """

    def __init__(self, folder: Path | None, key: str) -> None:
        self.folder = folder
        self.loaded = 0
        if folder is None:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            marker = folder / "key.txt"
            if not marker.is_file() or marker.read_text() != key:
                stale = list(folder.glob("slice_*.npy"))
                for path in stale:
                    path.unlink()
                if stale:
                    logger.info("%s: settings changed, %d slices redone", folder, len(stale))
                temporary = marker.with_suffix(".part")
                temporary.write_text(key)
                os.replace(temporary, marker)
        except OSError as error:
            raise InputError(
                f"{folder}: slices cannot be kept here ({error})", hint="choose a writable folder"
            ) from error

    def get(self, number: int, axis: int, index: int, shape: tuple[int, ...]) -> np.ndarray | None:
        """Slice ``index`` across ``axis`` of pass ``number``, if it was finished."""
        if self.folder is None:
            return None
        path = self.folder / f"slice_{number}_{axis}_{index:04d}.npy"
        if not path.is_file():
            return None
        try:
            image = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            return None  # cut off while writing: made again
        if image.shape != shape:
            return None
        self.loaded += 1
        return np.asarray(image, np.float32)

    def put(self, number: int, axis: int, index: int, image: np.ndarray) -> None:
        """Keep a finished slice."""
        if self.folder is None:
            return
        path = self.folder / f"slice_{number}_{axis}_{index:04d}.npy"
        temporary = path.with_suffix(".part.npy")
        np.save(temporary, image.astype(np.float32))
        os.replace(temporary, path)
