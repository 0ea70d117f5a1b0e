"""Exemplar photographs: a cut object, or a patch of material."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsfluent.errors import InputError

__all__ = ["Exemplar", "load_exemplar", "rgb_to_lab"]

logger = logging.getLogger(__name__)

_LARGEST = 1024  # pixels; exemplars are reduced to voxel pitch anyway


@dataclass(frozen=True)
class Exemplar:
    """A photograph of the inside.

    Attributes:
        image: float32 [H, W, 3] in 0..1; pixels outside the mask repeat the nearest one inside.
        mask: Object pixels, bool [H, W].
        depth: Distance to the silhouette [pixels], float32 [H, W]; 0 outside.
        silhouette: True when the photograph shows the whole cut face with its outline, so that
            depth below the outline means something; False for a patch of material.
        note: How the mask came about, for the report.
    """

    image: np.ndarray
    mask: np.ndarray
    depth: np.ndarray
    silhouette: bool
    note: str

    @property
    def max_depth(self) -> float:
        """Largest depth [pixels]."""
        return float(self.depth.max())

    def resized(self, factor: float) -> Exemplar:
        """The same photograph with ``factor`` times the pixels along each side."""
        import cv2
        from scipy import ndimage

        height, width = self.mask.shape
        size = (max(4, round(width * factor)), max(4, round(height * factor)))
        method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        image = cv2.resize(self.image, size, interpolation=method).clip(0.0, 1.0)
        share = cv2.resize(self.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mask = share > 0.5
        if not mask.any():
            mask = share >= share.max()
        depth = cv2.resize(self.depth * factor, size, interpolation=method).clip(0.0, None)
        nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
        image = image[tuple(nearest)].astype(np.float32)
        depth = np.where(mask, depth, 0.0).astype(np.float32)
        return Exemplar(image, mask, depth, self.silhouette, self.note)


def rgb_to_lab(rgb: np.ndarray) -> np.ndarray:
    """CIE Lab (D65) of sRGB values in 0..1, any leading shape [..., 3]."""
    import cv2

    flat = np.ascontiguousarray(rgb, dtype=np.float32).reshape(1, -1, 3)
    lab: np.ndarray = cv2.cvtColor(flat.clip(0.0, 1.0), cv2.COLOR_RGB2LAB).reshape(rgb.shape)
    return lab


def load_exemplar(source: str | Path | np.ndarray, mask: np.ndarray | None = None) -> Exemplar:
    """Read an exemplar.

    RGBA images bring their mask. A plain photograph on an even ground is separated from it by the
    colour of its border; when the border is not even, the whole picture counts as material.

    Args:
        source: Image file, or an array [H, W, 3 or 4], uint8 or float in 0..1.
        mask: Optional bool [H, W] that overrides.

    Raises:
        InputError: The file is missing, not an image, empty or too small.
    """
    if isinstance(source, np.ndarray):
        pixels, name = source, "exemplar"
    else:
        pixels, name = _read(Path(source)), str(source)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise InputError(
            f"{name}: exemplar must be an RGB or RGBA image, got shape {list(pixels.shape)}",
            mend="convert it to RGB",
        )
    values = pixels.astype(np.float32) / (255.0 if pixels.dtype == np.uint8 else 1.0)
    if not np.isfinite(values).all():
        raise InputError(f"{name}: exemplar holds NaN or infinite values", mend="replace it")
    if min(values.shape[:2]) < 16:
        raise InputError(
            f"{name}: exemplar is {values.shape[1]} x {values.shape[0]} pixels",
            mend="use a photograph of at least 16 x 16 pixels, better 300 x 300",
        )
    image = values[..., :3].clip(0.0, 1.0)
    if mask is not None:
        chosen, silhouette, note = mask.astype(bool), True, "mask given"
    elif values.shape[2] == 4 and (values[..., 3] < 0.5).mean() > 0.005:
        chosen = _strip_ground(image, values[..., 3] > 0.5)
        silhouette, note = True, "mask from the alpha channel"
    else:
        chosen, silhouette, note = _segment(image)
    if chosen.mean() < 0.01:
        raise InputError(
            f"{name}: the mask leaves {100 * chosen.mean():.2f} % of the exemplar",
            mend="give an image whose alpha channel is opaque on the cut face",
        )
    logger.info("%s: %s", name, note)
    return _finish(image, chosen, silhouette, note)


def _read(path: Path) -> np.ndarray:
    """Pixels of an image file as uint8 [H, W, 3 or 4], turned upright, at most _LARGEST wide."""
    from PIL import Image, ImageOps, UnidentifiedImageError

    if not path.is_file():
        raise InputError(f"{path}: exemplar not found", mend="check the path")
    try:
        with Image.open(path) as opened:
            picture = ImageOps.exif_transpose(opened)
            has_alpha = "A" in picture.getbands() or "transparency" in picture.info
            picture = picture.convert("RGBA" if has_alpha else "RGB")
            picture.thumbnail((_LARGEST, _LARGEST))
            return np.asarray(picture)
    except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path}: exemplar cannot be read ({error})", mend="use a PNG or JPEG file"
        ) from error


def _strip_ground(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Take pure black or white that touches the edge of an alpha mask out of it.

    Cut-outs exported with a coarse alpha keep corners of their ground.
    """
    from scipy import ndimage

    padded = np.pad(mask, 1)
    ring = mask & ~ndimage.binary_erosion(padded)[1:-1, 1:-1]
    for flat in (image.max(2) < 0.04, image.min(2) > 0.97):
        flat = flat & mask
        if (flat & ring).sum() < 0.1 * ring.sum():
            continue
        labels, _ = ndimage.label(flat)
        touching = np.unique(labels[ring & flat])
        mask = mask & ~np.isin(labels, touching[touching > 0])
    return _largest(mask)


def _segment(image: np.ndarray) -> tuple[np.ndarray, bool, str]:
    """Object mask of a plain photograph by the colour of its border."""
    from scipy import ndimage

    lab = rgb_to_lab(image)
    border = np.concatenate([lab[:2].reshape(-1, 3), lab[-2:].reshape(-1, 3)])
    border = np.concatenate([border, lab[:, :2].reshape(-1, 3), lab[:, -2:].reshape(-1, 3)])
    ground = np.median(border, axis=0)
    spread = np.linalg.norm(border - ground, axis=1)
    whole = np.ones(image.shape[:2], bool)
    if (spread < 10.0).mean() < 0.8:
        return whole, False, "border not even: the whole photograph is taken as material"
    near = np.linalg.norm(lab - ground, axis=2) < 14.0
    labels, _ = ndimage.label(near)
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    mask = _largest(~np.isin(labels, edge[edge > 0]))
    share = float(mask.mean())
    # an even patch of material also has an even border: then nothing compact is left standing
    if not 0.08 < share < 0.97:
        return whole, False, "no object apart from the border colour: the whole photograph is used"
    return mask, True, f"mask from the border colour ({100 * share:.0f} % of the picture)"


def _largest(mask: np.ndarray) -> np.ndarray:
    """Largest component with its holes filled."""
    from scipy import ndimage

    labels, count = ndimage.label(ndimage.binary_opening(mask, iterations=1))
    if count == 0:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    filled: np.ndarray = ndimage.binary_fill_holes(labels == sizes.argmax())
    return filled


def _finish(image: np.ndarray, mask: np.ndarray, silhouette: bool, note: str) -> Exemplar:
    """Depth below the outline, and colours extended outward."""
    from scipy import ndimage

    distance = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    depth = np.where(mask, distance - 0.5, 0.0).astype(np.float32)
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    extended = image[tuple(nearest)]
    return Exemplar(extended.astype(np.float32), mask, depth, silhouette, note)
