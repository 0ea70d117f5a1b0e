"""Light from everywhere, of low order: nine colours that say what arrives at each normal.

Irradiance is so smooth in the normal that spherical harmonics of degree 2 hold it to about a
percent (Ramamoorthi and Hanrahan 2001, "An Efficient Representation for Irradiance Environment
Maps"). Coefficients are those of irradiance over pi, so that a white surface under an environment
of radiance 1 sends back 1; basis and order: :func:`gsfluent.pipeline.light.shade.harmonics`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsfluent._lazy import cv2
from gsfluent.errors import InputError
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.pictures import check_pixels, opened_image
from gsfluent.pipeline.light.shade import harmonics, to_linear

Coefficients = tuple[tuple[float, float, float], ...]

# Share of each band that the cosine of Lambert's law keeps, over pi.
_COSINE = (1.0, 2.0 / 3.0, 1.0 / 4.0)
_BAND = (0, 1, 1, 1, 2, 2, 2, 2, 2)
_HDR_SIZE = re.compile(rb"\n[-+][XY] +(\d{1,18}) +[-+][XY] +(\d{1,18}) *\n")
_ROWS = 128  # of the picture that is projected; more do not change nine numbers
_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".hdr")


def sky_and_ground(
    sky: tuple[float, float, float], ground: tuple[float, float, float]
) -> Coefficients:
    """An even sky above and an even ground below, linear colours; exact."""
    upper, lower = np.asarray(sky, float), np.asarray(ground, float)
    values = np.zeros((9, 3))
    values[0] = 0.5 * (upper + lower) / 0.28209479177387814
    values[2] = 0.5 * (upper - lower) / 0.4886025119029199
    return _rows(torch.from_numpy(values))


def of_radiance(image: Tensor) -> Coefficients:
    """Coefficients of an equirectangular picture of linear radiance, [H, W, 3].

    Up is +z; the middle column looks toward +y, what is right of it toward +x.
    """
    directions, weight = _directions(image.shape[0], image.shape[1])
    basis = harmonics(directions) * weight[..., None]
    radiance = torch.einsum("hwk,hwc->kc", basis, image.double())
    cosine = torch.tensor([_COSINE[band] for band in _BAND], dtype=torch.float64)
    return _rows(radiance * cosine[:, None])


def of_file(path: Path) -> Coefficients:
    """Coefficients of an equirectangular picture: .hdr (linear) or a display picture.

    Raises:
        InputError: It cannot be read, or is not twice as wide as high.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"{path}: not a picture", f"give one of {', '.join(_ENDINGS)}")
    _check_size(path)
    try:
        found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        found = None
    if found is None or found.ndim != 3 or found.shape[2] < 3:
        raise InputError(f"{path}: no readable colour picture", "give an equirectangular picture")
    height, width = found.shape[:2]
    if not 1.8 < width / height < 2.2:
        raise InputError(
            f"{path}: {width} x {height} is not an equirectangular picture",
            "give one that is twice as wide as high",
        )
    pixels = found[..., 2::-1].astype(np.float64)
    if found.dtype.kind == "u":  # a display picture of 8 or 16 bits
        pixels = to_linear(torch.from_numpy(pixels / (256.0**found.itemsize - 1.0))).numpy()
    small = cv2.resize(pixels, (2 * _ROWS, _ROWS), interpolation=cv2.INTER_AREA)
    if not np.isfinite(small).all():
        raise InputError(f"{path}: holds NaN or infinity", "write the picture again")
    return of_radiance(torch.from_numpy(small))


def _check_size(path: Path) -> None:
    """Refuse a picture by the size its header declares; OpenCV would decode a gigapixel."""
    if path.suffix.lower() != ".hdr":
        with opened_image(path):
            return
    regular_file(path, "picture")
    with path.open("rb") as stream:
        head = stream.read(4096)
    found = _HDR_SIZE.search(head)
    if not head.startswith(b"#?") or found is None:  # OpenCV goes by what it finds, not by the name
        raise InputError(f"{path}: not a Radiance picture", "write it as .hdr or .png")
    check_pixels(int(found.group(1)), int(found.group(2)), path)


def turned(coefficients: Coefficients, degrees: float) -> Coefficients:
    """The environment turned about +z, against the clock seen from above."""
    angle = math.radians(degrees)
    directions, _ = _directions(8, 16)
    flat = directions.reshape(-1, 3)
    c, s = math.cos(angle), math.sin(angle)
    back = torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    values = harmonics(flat @ back.T) @ torch.tensor(coefficients, dtype=torch.float64)
    return _rows(torch.linalg.lstsq(harmonics(flat), values).solution)


def scaled(coefficients: Coefficients, factor: float) -> Coefficients:
    """The environment, ``factor`` times as bright."""
    return _rows(torch.tensor(coefficients, dtype=torch.float64) * torch.tensor(factor) + 0.0)


def _directions(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Unit directions [H, W, 3] of an equirectangular picture, and solid angles [H, W]."""
    polar = (torch.arange(height, dtype=torch.float64) + 0.5) * (math.pi / height)
    turn = (torch.arange(width, dtype=torch.float64) + 0.5) * (2.0 * math.pi / width) - math.pi
    sine, shape = polar.sin()[:, None], (height, width)
    directions = torch.stack(
        [sine * turn.sin(), sine * turn.cos(), polar.cos()[:, None].expand(shape)], -1
    )
    row = (2.0 * math.pi / width) * (
        (polar - 0.5 * math.pi / height).cos() - (polar + 0.5 * math.pi / height).cos()
    )
    return directions, row[:, None].expand(shape)


def _rows(values: Tensor) -> Coefficients:
    return tuple((float(r), float(g), float(b)) for r, g, b in values.tolist())
