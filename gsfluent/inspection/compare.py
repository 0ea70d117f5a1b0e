"""Compare pictures of insides: a picture, a folder of pictures or a textured solid on each side.

Statistics that need no weights are always computed; CLIP score, LPIPS, FID and KID when the user
gives the weights (:mod:`gsfluent.inspection.compare_weights`). They measure likeness to a
reference,
not realism.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.errors import InputError
from gsfluent.inspection import compare_weights as weights
from gsfluent.io.images import IMAGE_SUFFIXES
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.texture.photo import metrics
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, load_exemplar

logger = logging.getLogger(__name__)

SLICES = 4
"""Slices of a solid per axis."""


@dataclass(frozen=True)
class Pictures:
    """What stands on one side."""

    names: list[str]  # of the pictures
    slices: list[metrics.Slice]  # images [H, W, 3] in 0..1 with the masks of what counts
    # what only this side has (a solid's ``neighbour_slice_ratio``).
    figures: dict[str, Any] = field(default_factory=dict)

    def extent(self) -> int:
        """Longest side of the smallest object among the pictures [pixels]."""
        return min(max(_box(mask)[1]) for _, mask in self.slices)


def load_pictures(path: str | Path) -> Pictures:
    """Read a picture, a folder of pictures (sorted by name), or a solid's .ply.

    An alpha channel, or an even ground around the object, is left out of the comparison.

    Raises:
        InputError: Nothing there, or nothing that can be compared.
    """
    path = Path(path)
    if path.suffix.lower() == ".ply":
        return _solid_slices(path)
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise InputError(f"{path}: no pictures in this folder", "give PNG or JPEG files")
    else:
        files = [path]
    photos = [load_exemplar(file) for file in files]
    return Pictures([f.name for f in files], [(p.image, p.mask) for p in photos])


def _solid_slices(path: Path) -> Pictures:

    solid = load_solid(path)
    if solid.color is None:
        raise InputError(
            f"{path}: this solid has no colours inside", "run `gsfluent texture` first"
        )
    rgb = solid.color.float().cpu().numpy()
    inside = solid.occupancy.cpu().numpy()
    slices = metrics.volume_slices(rgb, inside, SLICES)
    names = [f"{axis}{k}" for axis in "xyz" for k in range(SLICES)]
    ratio = metrics.neighbour_slice_ratio(rgb, inside)
    return Pictures(names, slices, {"neighbour_slice_ratio": ratio})


def compare(
    judged: str | Path,
    reference: str | Path,
    *,
    size: int = 256,
    clip: str | Path | None = None,
    prompt: str | None = None,
    lpips: str | Path | None = None,
    fid: str | Path | None = None,
    device: torch.device | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare two sets of pictures.

    Objects are brought to one size first: patches of pictures at different scales say nothing.

    Args:
        judged: Picture, folder, or solid .ply that is judged.
        reference: The same for what it should be like.
        size: Longest side of the objects [pixels]; smaller ones are not enlarged, the others
            follow the smallest.
        clip: Folder (or cached hub id) of a CLIP model with its processor.
        prompt: Text for the CLIP score.
        lpips: Folder with AlexNet's weights and LPIPS' linear heads.
        fid: TorchScript file of the Inception network.
        device: For the networks; CPU when None.
        seed: Seed of the draws of patches.

    Returns:
        ``patch_distance``, ``patch_distance_half``, ``histogram_distance``, ``coherence``,
        ``coverage``, ``sharpness_ratio``; ``clip_score``, ``clip_score_reference``, ``lpips``,
        ``fid``, ``kid``: null where not computed, and then ``skipped`` says why; what was compared.

    Raises:
        InputError: A side holds nothing, or weights are given that cannot be used.
    """
    if size < 16:
        raise InputError(f"size must be at least 16 pixels, got {size}", "leave it at 256")
    sides = [load_pictures(judged), load_pictures(reference)]
    common = min(size, *(side.extent() for side in sides))
    first, second = ([_scaled(s, common) for s in side.slices] for side in sides)
    coherence, coverage = metrics.patch_neighbours(first, second, seed=seed)
    colors = [np.concatenate([image[mask] for image, mask in side]) for side in (first, second)]
    result: dict[str, Any] = {
        "judged": {"pictures": len(first), **sides[0].figures},
        "reference": {"pictures": len(second), **sides[1].figures},
        "size": common,
        "patch_distance": metrics.patch_distance(first, second, seed=seed),
        "patch_distance_half": metrics.patch_distance(
            metrics.half_size(first), metrics.half_size(second), seed=seed
        ),
        "histogram_distance": metrics.lab_histogram_distance(*colors),
        "coherence": coherence,
        "coverage": coverage,
        "sharpness_ratio": metrics.sharpness(first) / max(metrics.sharpness(second), 1e-9),
    }
    found, skipped = _weighted(
        [[_shown(s) for s in side.slices] for side in sides],
        clip=clip,
        prompt=prompt,
        lpips=lpips,
        fid=fid,
        device=device or torch.device("cpu"),
    )
    return {**result, **found, "skipped": skipped}


def _weighted(
    sides: list[list[np.ndarray]],
    *,
    clip: str | Path | None,
    prompt: str | None,
    lpips: str | Path | None,
    fid: str | Path | None,
    device: torch.device,
) -> tuple[dict[str, Any], dict[str, str]]:
    """Figures of the networks whose weights were given, and why the others are missing."""
    found: dict[str, Any] = dict.fromkeys(
        ("clip_score", "clip_score_reference", "lpips", "fid", "kid")
    )
    skipped: dict[str, str] = {}
    if clip is None:
        skipped["clip_score"] = "no CLIP weights given; pass --clip <folder>"
    elif not prompt:
        skipped["clip_score"] = "no text given; pass --prompt <text>"
    else:
        scores = [weights.clip_scores(side, prompt, clip, device) for side in sides]
        found["clip_score"], found["clip_score_reference"] = (float(s.mean()) for s in scores)
    if lpips is None:
        skipped["lpips"] = "no LPIPS weights given; pass --lpips <folder>"
    elif [i.shape for i in sides[0]] != [i.shape for i in sides[1]]:
        skipped["lpips"] = "pictures are not aligned; give as many of the same size on both sides"
    else:
        network = weights.Lpips(lpips, device)
        pairs = zip(*sides, strict=True)
        found["lpips"] = float(np.mean([network(a, b) for a, b in pairs]))
    if fid is None:
        skipped["fid"] = skipped["kid"] = "no Inception weights given; pass --fid <file.pt>"
    elif min(len(side) for side in sides) < 2:
        skipped["fid"] = skipped["kid"] = "one picture has no distribution; give folders or solids"
    else:
        features = [weights.inception_features(side, fid, device) for side in sides]
        found["fid"] = weights.frechet_distance(*features)
        found["kid"] = weights.kernel_distance(*features)
        fewest = min(len(side) for side in sides)
        if fewest < 2048:
            logger.warning("fid: of %d pictures it is biased upward; kid is not", fewest)
    return found, skipped


def _box(mask: np.ndarray) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Bounding box of a mask and its size in pixels."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return box, (len(range(*box[0].indices(1 << 30))), len(range(*box[1].indices(1 << 30))))


def _scaled(plane: metrics.Slice, size: int) -> metrics.Slice:
    """The object cut out, its longest side reduced to ``size`` pixels."""
    image, mask = plane
    box, extent = _box(mask)
    factor = size / max(extent)
    if factor >= 1.0:
        return image[box], mask[box]
    flat = np.zeros(mask[box].shape, np.float32)
    small = Exemplar(image[box], mask[box], flat, True, "").resized(factor)
    return small.image, small.mask


def _shown(plane: metrics.Slice) -> np.ndarray:
    """The object cut out on white, uint8 [H, W, 3]: what a network is shown."""
    image, mask = plane
    box, _ = _box(mask)
    shown = np.where(mask[box][..., None], image[box], 1.0)
    pixels: np.ndarray = (shown.clip(0.0, 1.0) * 255).round().astype(np.uint8)
    return pixels
