"""What the light left in a photograph and the material does not have: shading, glints, tint.

Every step takes a picture float32 [H, W, 3] in 0..1 and its face, bool [H, W], some the distance to
the outline [pixels], and gives the picture and a sentence for the report, None for nothing done.
"""

from __future__ import annotations

import itertools

import numpy as np

from gsfluent._lazy import cv2, ndimage
from gsfluent.colors import linear_to_srgb, rgb_to_lab, srgb_to_linear
from gsfluent.errors import InputError

_WORK = 160  # pixels along the longest side while the shading is fitted
_LEAST_SHADING = 0.10  # range of log luminance below which shading is left alone
_MOST_SHADING = 1.1  # three times the light on one side is no gradient but another object
_KNOTS = 8
_LEAST_AREA = 12_000  # pixels of a face in which glints are looked for


def shading_field(
    image: np.ndarray, mask: np.ndarray, depth: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """Logarithm of a smooth illumination across the photograph, and its range.

    The gradient of log luminance is explained by a polynomial of the position (the light) and, for
    a cut face with an outline, by a piecewise linear function of depth (the material's layers);
    only the first is shading. Edges and places where the hue changes are material, not light, and
    drop out of the robust fit (Retinex: Land and McCann 1971; Tukey's biweight). The polynomial has
    the terms x, y, xy, x^2 - y^2, and x^2 + y^2 only where there is no depth that it would be
    confused with.

    Returns:
        Log illumination float32 [H, W] with mean zero in the mask, and its range there (the
        difference of its 95 and 5 % quantiles; 0.1 is about 10 % of the light).
    """
    height, width = mask.shape
    factor = min(1.0, _WORK / max(height, width))
    size = (max(8, round(width * factor)), max(8, round(height * factor)))
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    light = cv2.resize(srgb_to_linear(image) * mask[..., None], size, interpolation=cv2.INTER_AREA)
    small = share > 0.98
    blur = 1.5
    norm = ndimage.gaussian_filter(share, blur) + 1e-6
    light = np.stack([ndimage.gaussian_filter(light[..., c], blur) / norm for c in range(3)], -1)
    value = np.log(light @ np.array([0.2126, 0.7152, 0.0722]) + 2e-3)
    chroma = np.log(light + 4e-3)
    chroma = chroma - chroma.mean(-1, keepdims=True)
    usable = ndimage.binary_erosion(small, iterations=3) & ndimage.binary_erosion(
        np.pad(np.ones((size[1] - 2, size[0] - 2), bool), 1)
    )
    if usable.sum() < 60:
        return np.zeros(mask.shape, np.float32), 0.0
    scale = 0.5 * max(size)
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    x, y = (x - x[small].mean()) / scale, (y - y[small].mean()) / scale
    terms = [x, y, x * y, x * x - y * y]
    if depth is None:
        terms.append(x * x + y * y)
    columns = list(terms)
    if depth is not None:
        layer = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        knots = np.quantile(layer[small], np.linspace(0.0, 1.0, _KNOTS))
        pairs = itertools.pairwise(knots.tolist())
        columns += [np.clip((layer - a) / (b - a + 1e-6), 0, 1) for a, b in pairs]
    design = np.stack([_slope(c)[:, usable].reshape(-1) for c in columns], 1)
    wanted = _slope(value)[:, usable].reshape(-1)
    hue = np.sqrt(sum((_slope(chroma[..., c]) ** 2).sum(0) for c in range(3)))[usable]
    typical = float(np.median(hue)) + 1e-4
    trust = np.tile(1.0 / (1.0 + (hue / (2.0 * typical)) ** 2), 2)
    # twice, on the white and the black squares of a chessboard: light is seen by both alike,
    # while what a few grains or veins suggest differs
    block = max(4, max(size) // 12)
    rows, cols = np.nonzero(usable)
    white = np.tile((rows // block + cols // block) % 2 == 0, 2)
    halves = []
    for chosen in (white, ~white):
        found = _robust(design[chosen], wanted[chosen], trust[chosen])
        rough = sum(f * t for f, t in zip(found[: len(terms)], terms, strict=True))
        halves.append(np.asarray(rough - np.asarray(rough)[small].mean()))
    both = np.stack([h[small] for h in halves])
    extra = np.stack([c[small] for c in columns[len(terms) :]], 1) if depth is not None else None
    if not (_agree(both) and _explains(both.mean(0), value, small, extra)):
        return np.zeros(mask.shape, np.float32), 0.0
    field = cv2.resize(
        (0.5 * (halves[0] + halves[1])).astype(np.float32),
        (width, height),
        interpolation=cv2.INTER_CUBIC,
    )
    field -= field[mask].mean()
    low, high = np.quantile(field[mask], [0.05, 0.95])
    return field, float(high - low)


def _robust(design: np.ndarray, wanted: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Least squares reweighted by Tukey's biweight (12 rounds)."""
    weight = trust
    count = design.shape[1]
    ridge = 1e-4 * np.eye(count) * float((design**2).sum()) / count
    found = np.zeros(count)
    for _ in range(12):
        scaled = design * weight[:, None]
        found = np.linalg.solve(scaled.T @ design + ridge, scaled.T @ wanted)
        left = np.abs(wanted - design @ found)
        width = 4.685 * 1.4826 * float(np.median(left)) + 1e-9
        weight = trust * np.clip(1.0 - (left / width) ** 2, 0.0, None) ** 2
    return found


def _agree(fields: np.ndarray) -> bool:
    """Whether two estimates [2, n] of the same field differ by less than 0.6 of their mean."""
    mean, half = fields.mean(0), 0.5 * (fields[0] - fields[1])
    return bool(np.sqrt((half**2).mean()) < 0.3 * np.sqrt((mean**2).mean()) + 1e-9)


def _slope(field: np.ndarray) -> np.ndarray:
    """Differences along rows and columns [2, H, W]."""
    return np.stack(np.gradient(field))


def _explains(
    field: np.ndarray,
    value: np.ndarray,
    small: np.ndarray,
    layers: np.ndarray | None,
) -> bool:
    """Whether evening the light out takes three tenths of the broad unevenness away.

    Gradients can agree without the light being uneven (a saw of grains lit from one side). Broad
    means over an eighth of the picture; what depth explains is the material's.
    """
    width = max(value.shape) / 8.0
    norm = ndimage.gaussian_filter(small.astype(float), width) + 1e-6

    def broad(pixels: np.ndarray) -> np.ndarray:
        plane = np.zeros(value.shape)
        plane[small] = pixels
        result: np.ndarray = (ndimage.gaussian_filter(plane, width) / norm)[small]
        if layers is not None:
            wide = np.stack([np.ones(len(result)), *layers.T], 1)
            result = result - wide @ np.linalg.lstsq(wide, result, rcond=None)[0]
        return result - result.mean()

    before, after = broad(value[small]), broad(value[small] - field)
    return bool((after**2).mean() < 0.7 * (before**2).mean())


def remove_shading(
    image: np.ndarray, mask: np.ndarray, depth: np.ndarray | None
) -> tuple[np.ndarray, str | None]:
    """Divide the photograph by its illumination (:func:`shading_field`) in linear light."""
    field, size = shading_field(image, mask, depth)
    if size < _LEAST_SHADING:
        return image, None
    if size > _MOST_SHADING:
        return image, f"shading: left alone, too strong for a gradient of light ({size:.1f})"
    even = linear_to_srgb(srgb_to_linear(image) * np.exp(-field)[..., None])
    return even, f"shading: light that changes by {100 * np.expm1(size):.0f} % across it evened out"


def remove_glints(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Paint over small specular spots from around them.

    A highlight pulls the colour of a coloured surface towards white (dichromatic reflection, Shafer
    1985): small compact spots that are much lighter and much less coloured than their
    neighbourhood. On grey material a highlight cannot be told from a light grain by its colour;
    there only the smallest spots that reach white on a dark ground count.
    """
    area = float(mask.sum())
    if area < _LEAST_AREA:  # pixels larger than a highlight average it away
        return image, None
    edge = int(np.clip(0.03 * np.sqrt(area), 2, 20)) * 2 + 1
    bytes_ = (image * 255).round().astype(np.uint8)
    around = np.stack([cv2.medianBlur(bytes_[..., c], edge) for c in range(3)], -1)
    lab, base = rgb_to_lab(image), rgb_to_lab(around.astype(np.float32) / 255.0)
    color, surround = (np.hypot(v[..., 1], v[..., 2]) for v in (lab, base))
    lift = lab[..., 0] - base[..., 0]
    tinted = (surround > 15.0) & (color < 0.6 * surround) & (lift > 12.0)
    plain = (surround <= 15.0) & (lift > 40.0) & (image.min(-1) > 0.85)
    spots = (tinted | plain) & mask
    labels, count = ndimage.label(spots, np.ones((3, 3)))
    if count == 0:
        return image, None
    good = np.zeros(count + 1, bool)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        blob = labels[box] == number
        pixels = int(blob.sum())
        brightest = float(image[box].min(-1)[blob].max())
        limit = 3e-3 if tinted[box][blob].mean() > 0.5 else 4e-4
        # membranes and veins are long, highlights are not
        long = max(blob.shape) ** 2 / pixels
        good[number] = 3 <= pixels <= limit * area and brightest > 0.7 and long < 8.0
    chosen = good[labels]
    if chosen.any():
        # what is also found in larger pieces is a material (pith, cream), not light
        middle = np.median(lab[chosen], axis=0)
        alike = mask & ~ndimage.binary_dilation(chosen, iterations=2)
        alike &= np.linalg.norm(lab - middle, axis=2) < 8.0
        if alike.sum() > 1.5 * chosen.sum():
            return image, None
    share = float(chosen.sum()) / area
    if share < 1e-5:
        return image, None
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    hole = cv2.dilate(chosen.astype(np.uint8), kernel)
    clean = cv2.inpaint(bytes_, hole, 3, cv2.INPAINT_TELEA).astype(np.float32) / 255.0
    done: np.ndarray = np.where(hole[..., None] > 0, clean, image).astype(np.float32)
    return done, f"glints: {int(good.sum())} specular spots ({100 * share:.2f} %) painted over"


def white_gains(white: object, image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, str]:
    """Factors [3] of linear red, green (1) and blue that take the light's tint out; their source.

    Args:
        white: ``auto`` (the ground around a cut-out when it is nearly neutral and not dark, else
            nothing), ``none``, a colour temperature [K] of the light, or three numbers: the sRGB
            value (0..1 or 0..255) that a white or grey thing has in the photograph. Grey world is
            not offered: the mean of a fruit is not grey.
        image: The photograph.
        mask: The object.

    Raises:
        InputError: The value is none of these.
    """
    one = np.ones(3)
    if white is None or white == "none":
        return one, ""
    if isinstance(white, str):
        if white != "auto":
            raise InputError(
                f"texture: white must be auto, none, skin, kelvin or three numbers, got {white!r}",
                hint="for example white: 3200 or white: [0.9, 0.85, 0.7]",
            )
        return _ground_gains(image, mask)
    values = np.atleast_1d(np.asarray(white, dtype=float))
    if values.shape == (1,) and 1000.0 <= values[0] <= 25000.0:
        tint = _planck(float(values[0])) / _planck(6504.0)
        return tint[1] / tint, f"light of {values[0]:.0f} K"
    if values.shape == (3,) and np.isfinite(values).all() and (values > 0).all():
        seen = (values / 255.0 if values.max() > 1.0 else values).astype(np.float32)
        shade = srgb_to_linear(seen).astype(float)
        return shade[1] / np.maximum(shade, 1e-3), "the reference given"
    raise InputError(
        f"texture: white must be 1000 to 25000 kelvin or three positive numbers, got {white!r}",
        hint="for example white: 3200 or white: [0.9, 0.85, 0.7]",
    )


def _ground_gains(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, str]:
    """Gains that make a nearly neutral ground neutral."""
    ground = ~ndimage.binary_dilation(mask, iterations=max(2, round(0.02 * max(mask.shape))))
    if ground.sum() < 0.02 * ground.size:
        return np.ones(3), ""
    pixels = image[ground]
    lab = rgb_to_lab(pixels)
    middle = np.median(lab, axis=0)
    even = float((np.linalg.norm(lab - middle, axis=1) < 12.0).mean())
    tint = float(np.hypot(middle[1], middle[2]))
    # dark grounds say nothing, clipped ones hide their tint, strong hues are paint and not light
    if middle[0] < 45.0 or even < 0.6 or not 2.0 < tint < 16.0 or pixels.max(1).mean() > 0.995:
        return np.ones(3), ""
    shade = srgb_to_linear(np.median(pixels, axis=0)).astype(float)
    return shade[1] / shade, "its ground, which is nearly neutral"


def _planck(kelvin: float) -> np.ndarray:
    """Linear sRGB of a black body, green 1 (chromaticity after Kim et al. 2002)."""
    t = 1e3 / kelvin
    if kelvin < 4000.0:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if kelvin < 2222.0:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif kelvin < 4000.0:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1.0 - x - y) / y])
    matrix = np.array(
        [
            [3.2406, -1.5372, -0.4986],
            [-0.9689, 1.8758, 0.0415],
            [0.0557, -0.2040, 1.0570],
        ]
    )
    rgb = np.maximum(matrix @ xyz, 0.02)
    return rgb / rgb[1]


def remove_tint(
    image: np.ndarray, mask: np.ndarray, white: object
) -> tuple[np.ndarray, str | None]:
    """White balance by :func:`white_gains`."""
    gains, source = white_gains(white, image, mask)
    if not source or float(np.abs(gains - 1.0).max()) < 0.01:
        return image, None
    shown = ", ".join(f"{g:.2f}" for g in gains)
    even = linear_to_srgb(srgb_to_linear(image) * gains.astype(np.float32))
    return even, f"white balance from {source} ({shown})"


def match_skin(
    image: np.ndarray, mask: np.ndarray, depth: np.ndarray, skin: np.ndarray
) -> tuple[np.ndarray, str]:
    """White balance by which the photographed skin gets the colours [n, 3] of the object's surface.

    The rim of the photograph (a thirtieth of the largest depth) is compared with the surface; only
    when both have the same hue within 30 degrees is it the same skin under another light.
    """
    rim = mask & (depth <= max(1.5, float(depth.max()) / 30.0))
    if not rim.any() or len(skin) == 0:
        return image, "white: no skin to compare"
    seen, wanted = np.median(image[rim], axis=0), np.median(skin, axis=0)
    a, b = rgb_to_lab(seen[None])[0], rgb_to_lab(wanted[None])[0]
    chroma = np.hypot(a[1], a[2]), np.hypot(b[1], b[2])
    turn = np.degrees(np.arctan2(a[2], a[1]) - np.arctan2(b[2], b[1]))
    turn = abs((turn + 180.0) % 360.0 - 180.0)
    if min(chroma) < 10.0 or turn > 30.0:
        return image, (
            f"white: the photograph's rim is not the object's skin (chroma {chroma[0]:.0f} and "
            f"{chroma[1]:.0f}, hues {turn:.0f} degrees apart)"
        )
    gains = srgb_to_linear(wanted) / np.maximum(srgb_to_linear(seen), 1e-3)
    gains = np.clip(gains / gains[1], 0.5, 2.0)
    shown = ", ".join(f"{g:.2f}" for g in gains)
    even = linear_to_srgb(srgb_to_linear(image) * gains)
    return even, f"white balance from the object's skin ({shown})"
