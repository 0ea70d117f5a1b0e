"""Exemplar photographs: a cut object, or a patch of material."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsfluent._lazy import cv2
from gsfluent.colors import rgb_to_lab
from gsfluent.errors import InputError, check_choice
from gsfluent.pipeline.texture.photo.light import (
    match_skin,
    remove_glints,
    remove_shading,
    remove_tint,
    white_gains,
)
from gsfluent.pipeline.texture.photo.mask import CUTOUTS, cut_out, strip_ground, trim_rim
from gsfluent.pipeline.texture.photo.read import read_pixels
from gsfluent.pipeline.texture.photo.stain import fill_holes, grey_share, recolor, remove_stain
from gsfluent.pipeline.texture.volume.domain import nearest_in
from gsfluent.spatial.voxels import distance_transform

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PhotoOptions:
    """What is done to a photograph before its material is used; every step can be left out.

    Attributes:
        cutout: ``auto``, ``ground``, ``grabcut`` or ``none`` (:func:`.photo_mask.cut_out`); images
            with an alpha channel bring their mask.
        rim: Take leftovers of the surroundings off the rim.
        holes: Paint open cavities of the core in the colour of their walls.
        glints: Paint over specular spots.
        shading: Even out a smooth gradient of the light.
        white: White balance: ``auto``, ``none``, ``skin`` (the photographed skin gets the colour of
            the object's), a colour temperature [K], or the sRGB value of something white or grey.
        stain: Give stained (grey) parts the colour of the unstained ones. Off unless asked for.
        palette: Name of a preset whose colours replace those of a grey photograph.
    """

    cutout: str = "auto"
    rim: bool = True
    holes: bool = True
    glints: bool = True
    shading: bool = True
    white: Any = "auto"
    stain: bool = False
    palette: str | None = None

    def __post_init__(self) -> None:
        """Refuse what no step understands."""
        check_choice("texture: cutout", self.cutout, CUTOUTS, "leave it at auto")
        if self.white != "skin" if isinstance(self.white, str) else True:
            white_gains(self.white, np.zeros((4, 4, 3), np.float32), np.ones((4, 4), bool))
        if self.palette is not None:
            from gsfluent.pipeline.texture.presets.procedural import preset_names

            hint = "choose one of these, or leave it out"
            check_choice("texture: palette", self.palette, preset_names(), hint)


@dataclass(frozen=True)
class Exemplar:
    """A photograph of the inside.

    Attributes:
        image: float32 [H, W, 3] in 0..1; pixels outside the mask repeat the nearest one inside.
        mask: Object pixels, bool [H, W].
        depth: Distance to the silhouette [pixels], float32 [H, W]; 0 outside.
        silhouette: True when the photograph shows the whole cut face with its outline, so that
            depth below the outline means something; False for a patch of material.
        note: How the mask came about and what was done to the picture, for the report.
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
        height, width = self.mask.shape
        size = (max(4, round(width * factor)), max(4, round(height * factor)))
        method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        image = cv2.resize(self.image, size, interpolation=method).clip(0.0, 1.0)
        share = cv2.resize(self.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mask = share > 0.5
        if not mask.any():
            mask = share >= share.max()
        depth = cv2.resize(self.depth * factor, size, interpolation=method).clip(0.0, None)
        image = image[nearest_in(mask)].astype(np.float32)
        depth = np.where(mask, depth, 0.0).astype(np.float32)
        return replace(self, image=image, mask=mask, depth=depth)


Exemplars = dict[int, list[Exemplar]]
"""Photographs per slice axis; axes may share them."""
_AXES = {"x": 0, "y": 1, "z": 2}


def load_exemplar(
    source: str | Path | np.ndarray,
    mask: np.ndarray | None = None,
    options: PhotoOptions | None = None,
) -> Exemplar:
    """Read an exemplar and prepare it (:class:`PhotoOptions`).

    RGBA images bring their mask. A plain photograph is cut out by the colour of its ground or by
    graph cuts; when there is no object apart from it, the whole picture counts as material.

    Args:
        source: Image file, or an array [H, W, 3 or 4], uint8, uint16 or float in 0..1.
        mask: Optional bool [H, W] that overrides.
        options: What to do to the picture; None for the defaults.

    Raises:
        InputError: The file is missing, not an image, empty or too small.
    """
    options = options or PhotoOptions()
    name = "exemplar" if isinstance(source, np.ndarray) else str(source)
    values = read_pixels(source, name)
    image = values[..., :3].clip(0.0, 1.0)
    if mask is not None:
        if mask.shape != image.shape[:2]:
            raise InputError(
                f"{name}: the mask is {list(mask.shape)}, the exemplar {list(image.shape[:2])}",
                hint="give a mask of the photograph's size",
            )
        chosen, silhouette, note = mask.astype(bool), True, "mask given"
    elif values.shape[2] == 4 and (values[..., 3] < 0.5).mean() > 0.005:
        chosen = strip_ground(image, values[..., 3] > 0.5)
        silhouette, note = True, "mask from the alpha channel"
    else:
        chosen, silhouette, note = cut_out(image, options.cutout)
    if chosen.mean() < 0.01:
        raise InputError(
            f"{name}: the mask leaves {100 * chosen.mean():.2f} % of the exemplar",
            hint="give an image whose alpha channel is opaque on the cut face",
        )
    image, chosen, notes = _prepare(image, chosen, silhouette, options)
    note = "; ".join([note, *notes])
    logger.info("%s: %s", name, note)
    extended = image[nearest_in(chosen)].astype(np.float32)
    return Exemplar(extended, chosen, _depth(chosen), silhouette, note)


def load_exemplars(source: object, options: PhotoOptions | None = None) -> Exemplars:
    """Photographs per slice axis.

    Args:
        source: One image (path, array or :class:`Exemplar`) or a list of them for all axes, or a
            mapping from ``x``, ``y``, ``z`` (axes of the object, z its own axis) to images or
            lists.
        options: What to do to each picture; an :class:`Exemplar` stays what it is.

    Returns:
        Photographs by axis; only the axes that were named, or all three with the same list.

    Raises:
        InputError: An axis is unknown or an image cannot be used.
    """
    if isinstance(source, Mapping):
        if not source or any(key not in _AXES for key in source):
            raise InputError(
                f"texture: exemplar axes must be x, y, z, got {sorted(map(str, source))}",
                hint="write exemplar: {x: a.jpg, z: b.jpg} or one file",
            )
        return {_AXES[key]: _load_list(source[key], options) for key in sorted(source)}
    return dict.fromkeys(range(3), _load_list(source, options))


def _load_list(source: object, options: PhotoOptions | None) -> list[Exemplar]:
    if isinstance(source, Sequence) and not isinstance(source, str):
        if not source:
            raise InputError("texture: the list of exemplars is empty", hint="name a photograph")
        return [item for part in source for item in _load_list(part, options)]
    if isinstance(source, Exemplar):
        return [source]
    if not isinstance(source, str | Path | np.ndarray):
        raise InputError(
            f"texture: exemplar must be a file, an array or a mapping, got {type(source).__name__}",
            hint="give the path of a photograph",
        )
    return [load_exemplar(source, options=options)]


def each(exemplars: Exemplars, change: Callable[[Exemplar], Exemplar]) -> Exemplars:
    """The photographs changed, each once however many axes share it."""
    made: dict[int, Exemplar] = {}
    for photo in (photo for group in exemplars.values() for photo in group):
        if id(photo) not in made:
            made[id(photo)] = change(photo)
    return {axis: [made[id(photo)] for photo in group] for axis, group in exemplars.items()}


def one_per_axis(
    exemplar: Exemplar | Mapping[int, Exemplar | Sequence[Exemplar]] | None,
) -> dict[int, Exemplar]:
    """One photograph per axis: the first of a list, and the first axis' where there is none."""
    if exemplar is None or isinstance(exemplar, Exemplar):
        return {} if exemplar is None else dict.fromkeys(range(3), exemplar)
    found = {a: e if isinstance(e, Exemplar) else e[0] for a, e in sorted(exemplar.items())}
    first = next(iter(found.values()), None)
    return {} if first is None else {axis: found.get(axis, first) for axis in range(3)}


def with_skin(photo: Exemplar, skin: np.ndarray) -> Exemplar:
    """White balance that gives the photographed skin the object's colours [n, 3] in 0..1."""
    if not photo.silhouette:
        return replace(photo, note=f"{photo.note}; white: no skin in the photograph")
    image, note = match_skin(photo.image, photo.mask, photo.depth, skin)
    return replace(photo, image=image, note=f"{photo.note}; {note}")


def _prepare(
    image: np.ndarray, mask: np.ndarray, silhouette: bool, options: PhotoOptions
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The steps in the order in which the light and the knife undid them."""
    notes: list[str] = []

    def done(result: tuple[np.ndarray, str | None]) -> np.ndarray:
        if result[1] is not None:
            notes.append(result[1])
        return result[0]

    if options.rim and silhouette:
        mask = done(trim_rim(image, mask))
    depth = _depth(mask) if silhouette else None
    cavities = None
    if options.holes and depth is not None:
        image, cavities, note = fill_holes(image, mask, depth, _ground(image, mask))
        notes += [] if note is None else [note]
    if options.glints:
        image = done(remove_glints(image, mask))
    if options.shading:
        image = done(remove_shading(image, mask, depth))
    if options.white != "skin":
        image = done(remove_tint(image, mask, options.white))
    if options.stain:
        image = done(remove_stain(image, mask, cavities))
    if options.palette is not None:
        layers = _depth(mask) if depth is None else depth
        image = recolor(image, mask, layers, _palette(options.palette))
        notes.append(f"colours taken from preset {options.palette}")
    grey = grey_share(image, mask)
    if grey > 0.5:
        notes.append(
            f"grey exemplar: {100 * grey:.0f} % of it has no colour of its own"
            + ("" if options.stain else " (stained? photo: {stain: true}, or {palette: PRESET})")
        )
    return image, mask, notes


def _ground(image: np.ndarray, mask: np.ndarray) -> np.ndarray | None:
    """Lab colour of an even ground around a mask, or None."""
    ground = rgb_to_lab(image[~mask]) if not mask.all() else np.zeros((0, 3))
    if len(ground) < 0.02 * mask.size:
        return None
    middle = np.median(ground, axis=0)
    even = (np.linalg.norm(ground - middle, axis=1) < 8.0).mean() > 0.8
    return np.asarray(middle) if even else None


def _palette(name: str) -> np.ndarray:
    """Colours of a preset in a ball per relative depth, [bins, samples, 3]."""
    bins, samples = 24, 400
    from gsfluent.pipeline.texture.presets.procedural import PRESETS

    rng = np.random.default_rng(0)
    depth = (np.arange(bins)[:, None] + rng.random((bins, samples))) / bins
    direction = rng.standard_normal((bins, samples, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    points = ((1.0 - depth)[..., None] * direction).reshape(-1, 3).astype(np.float32)
    rgb, _ = PRESETS[name](points, depth.reshape(-1).astype(np.float32), 0)
    return np.asarray(rgb, np.float32).reshape(bins, samples, 3).clip(0.0, 1.0)


def _depth(mask: np.ndarray) -> np.ndarray:
    """Distance of pixel centres to the outline [pixels]."""
    distance = distance_transform(np.pad(mask, 1))[1:-1, 1:-1]
    return np.where(mask, distance - 0.5, 0.0).astype(np.float32)
