"""Structure of a cut, told from material and swept about the object's axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfluent.errors import InputError
from gsfluent.pipeline.texture.photo.exemplar import (
    Exemplar,
    PhotoOptions,
    load_exemplar,
    load_exemplars,
)
from gsfluent.pipeline.texture.structure import (
    Structure,
    impose_structure,
    split_structure,
    take_apart,
    with_structure,
)
from gsfluent.pipeline.texture.sweep import Sweep, outline
from gsfluent.pipeline.texture.unseen_skin import mend_unseen_skin
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, InteriorTexture

RAW = PhotoOptions("auto", False, False, False, False, "none")
FLESH = np.array([0.92, 0.86, 0.60])
DARK = np.array([0.35, 0.20, 0.10])


def face(size: int = 160) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Noisy flesh in a disc, its mask, and radius (1 at the outline) and azimuth of the pixels."""
    rng = np.random.default_rng(0)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    radius, azimuth = np.hypot(x, y) / 0.92, np.arctan2(-y, x)
    image = FLESH * (1 + 0.04 * rng.standard_normal((size, size, 1)))
    return image.clip(0, 1).astype(np.float32), radius < 1, radius, azimuth


def starred() -> tuple[Exemplar, np.ndarray]:
    image, mask, radius, azimuth = face()
    star = (radius < 0.36) & (np.cos(5 * azimuth) > 0.2 + radius)
    image[star] = DARK
    return load_exemplar(image, mask, RAW), star


def solid(shape: str, size: int = 48, axis: tuple[float, float, float] = (0, 0, 1)):  # type: ignore[no-untyped-def]
    from scipy import ndimage

    p = np.stack(np.meshgrid(*[np.arange(size) + 0.5 - size / 2] * 3, indexing="ij"), -1)
    p /= size / 2 - 2
    unit = np.array(axis) / np.linalg.norm(axis)
    height = p @ unit
    flat = np.linalg.norm(p - height[..., None] * unit, axis=-1)
    inside = (
        (np.hypot(flat, height) < 1) if shape == "ball" else (flat < 0.8) & (np.abs(height) < 0.95)
    )
    depth = np.where(inside, ndimage.distance_transform_edt(inside) - 0.5, 0).astype(np.float32)
    color = np.broadcast_to(FLESH, (*inside.shape, 3)).astype(np.float32).copy()
    domain = InteriorDomain(inside, depth, inside & (depth < 1.6), color, unit, 0.02, np.zeros(3))
    return domain, color, flat, height


def swept(domain: InteriorDomain, photo: Exemplar, cut: str = "across") -> np.ndarray:
    rgb = np.zeros((*domain.inside.shape, 3), np.float32)
    center = np.argwhere(photo.mask).mean(0)
    sweep = Sweep(domain.inside, domain.axis, cut)
    rgb[domain.inside] = sweep.colors(photo.image, photo.mask, center)
    return rgb


def test_structure_is_what_depth_does_not_explain() -> None:
    photo, star = starred()
    material, structure = split_structure(photo)
    found = structure.share > 0.5
    assert (found & star).sum() > 0.9 * star.sum()
    assert found.sum() < 1.6 * star.sum()  # with its blurred edge
    assert structure.core
    left = np.abs(material.image - FLESH)[photo.mask].mean(-1)
    assert np.quantile(left, 0.999) < 0.25  # nothing dark is left
    beside = np.abs(photo.image - FLESH)[photo.mask & ~found].mean()
    assert np.abs(material.image - FLESH)[star].mean() == pytest.approx(beside, abs=0.02)


def test_layers_are_no_structure() -> None:
    image, mask, radius, _ = face()
    image[radius > 0.85] = (0.3, 0.5, 0.2)
    image[(radius > 0.78) & (radius <= 0.85)] = (0.95, 0.95, 0.85)
    photo = load_exemplar(image, mask, RAW)
    material, structure = split_structure(photo)
    assert structure.amount < 0.02
    assert np.abs(material.image - photo.image)[mask].mean() < 0.01


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (1, 1, 1)])
def test_the_star_stands_across_the_axis_and_closes_along_it(axis) -> None:  # type: ignore[no-untyped-def]
    photo, _ = starred()
    _, structure = split_structure(photo)
    domain, color, flat, height = solid("ball", 64, axis)
    rgb, report = impose_structure(domain, color, structure)
    dark = domain.inside & (np.abs(rgb - DARK).sum(-1) < np.abs(rgb - FLESH).sum(-1))
    assert report["core"]
    assert 0.001 < report["swept"] < 0.1
    middle = dark & (np.abs(height) < 0.05)
    p = np.argwhere(middle) + 0.5 - 32
    local = p @ _frame(axis).T
    ring = np.hypot(local[:, 0], local[:, 1])
    arms = local[(ring > 0.15 * 30) & (ring < 0.3 * 30)]
    wave = np.abs([np.exp(1j * k * np.arctan2(arms[:, 1], arms[:, 0])).mean() for k in range(1, 9)])
    assert wave.argmax() == 4  # five arms
    assert wave[4] > 0.5
    assert flat[dark].max() < 0.45  # as wide as photographed
    assert np.abs(height[dark]).max() < 0.75  # and closed before the poles
    assert np.abs(height[dark]).max() > 0.3


def _frame(axis: tuple[float, float, float]) -> np.ndarray:
    from gsfluent.pipeline.texture.volume.domain import axis_frame

    return axis_frame(np.array(axis, float))


def test_segments_run_through_a_log_to_its_ends() -> None:
    image, mask, radius, azimuth = face()
    lines = (np.cos(4 * azimuth) > 0.93) & (radius < 0.9)
    image[lines] = DARK
    _, structure = split_structure(load_exemplar(image, mask, RAW))
    assert not structure.core
    domain, color, flat, height = solid("log")
    rgb, report = impose_structure(domain, color, structure)
    assert not report["core"]
    dark = domain.inside & (np.abs(rgb - DARK).sum(-1) < np.abs(rgb - FLESH).sum(-1))
    share = [
        dark[(np.abs(height - h) < 0.06) & (flat < 0.6) & (flat > 0.2)].mean()
        for h in (-0.85, 0.0, 0.85)
    ]
    assert min(share) > 0.4 * max(share) > 0.02


def test_a_sweep_of_the_middle_plane_is_the_photograph() -> None:
    image, mask, radius, azimuth = face()
    image[(azimuth > 0.3) & (azimuth < 1.2) & (radius < 0.8)] = (0.1, 0.2, 0.9)
    photo = load_exemplar(image, mask, RAW).resized(44 / 160)
    domain, _, _, _ = solid("ball", 48)
    rgb = swept(domain, photo)
    plane = rgb[:, :, 24]
    again = np.swapaxes(plane, 0, 1)[::-1]  # columns along the first axis, rows up the second
    small = load_exemplar(image, mask, RAW).resized(44 / 0.92 / 160)
    edge = (small.mask.shape[0] - 48) // 2
    near = small.image[edge : edge + 48, edge : edge + 48] if edge >= 0 else small.image
    seen = domain.inside[:, :, 24]
    assert again.shape[0] - near.shape[0] in (0, 1)
    blue = np.swapaxes(plane[..., 2] - plane[..., 0], 0, 1)[::-1] > 0.3
    rows, columns = np.nonzero(blue)
    assert rows.mean() < 22  # above the middle
    assert columns.mean() > 26  # right of it
    truth = float(((azimuth > 0.3) & (azimuth < 1.2) & (radius < 0.8)).sum() / mask.sum())
    assert blue.sum() / seen.sum() == pytest.approx(truth, rel=0.12)


def test_a_cut_along_the_axis_keeps_up_and_down() -> None:
    image, mask, _, _ = face()
    image[:80] = (0.9, 0.1, 0.1)
    image[80:] = (0.1, 0.1, 0.9)
    photo = load_exemplar(image, mask, RAW).resized(0.3)
    domain, _, _, height = solid("ball", 40)
    rgb = swept(domain, photo, "along")
    red = rgb[..., 0] > rgb[..., 2]
    assert red[domain.inside & (height > 0.1)].mean() > 0.98
    assert red[domain.inside & (height < -0.1)].mean() < 0.02


def test_the_outline_is_measured_from_any_point_inside() -> None:
    y, x = np.mgrid[:100, :120]
    disc = np.hypot(y - 50, x - 60) < 40
    assert np.allclose(outline(disc, np.array([50.0, 60.0])), 40, atol=1.0)
    off = outline(disc, np.array([50.0, 70.0]))
    assert off[0] == pytest.approx(30, abs=1.0)  # to the right
    assert off[180] == pytest.approx(50, abs=1.0)


def test_what_cannot_be_swept_is_refused() -> None:
    photo, _ = starred()
    patch = load_exemplar(photo.image, options=PhotoOptions("none"))
    with pytest.raises(InputError, match="outline"):
        take_apart(load_exemplars(patch))
    with pytest.raises(InputError, match="exemplar"):
        take_apart({})
    domain, color, _, _ = solid("ball", 24)
    with pytest.raises(InputError, match="across"):
        Sweep(domain.inside, domain.axis, "sideways")
    materials, structure = take_apart(load_exemplars({"z": [photo, photo]}))
    assert len(materials[2]) == 2
    assert isinstance(structure, Structure)
    texture = InteriorTexture(color, np.zeros(domain.inside.shape, np.int32), {"levels": 1})
    done = with_structure(domain, texture, structure, "across")
    assert done.report["levels"] == 1
    assert done.report["cut"] == "across"
    assert np.isfinite(done.rgb).all()


def test_the_black_skin_of_a_closed_underside_is_mended_and_nothing_else() -> None:
    domain, _, _, height = solid("ball", 40)
    red, black = np.array([0.7, 0.12, 0.1]), np.array([0.02, 0.02, 0.02])
    shaded = np.where((height < -0.6)[..., None], black, red).astype(np.float32)
    given = replace(domain, skin=shaded)
    mended, share = mend_unseen_skin(given, (0.0, 0.0, -1.0))
    assert 0.1 < share < 0.4
    assert np.abs(mended.skin[domain.inside] - red).max() < 1e-6
    for side in (None, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)):
        same, none = mend_unseen_skin(given, side)
        assert none == 0.0
        assert np.array_equal(same.skin, given.skin)
    dark = replace(domain, skin=np.broadcast_to(black, shaded.shape).astype(np.float32))
    assert mend_unseen_skin(dark, (0.0, 0.0, -1.0))[1] == 0.0  # black all round is black
