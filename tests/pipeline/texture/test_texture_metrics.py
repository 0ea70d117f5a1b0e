"""Texture statistics: laws that each must obey, on images made here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from gsfluent.colors import rgb_to_lab
from gsfluent.pipeline.texture.photo.metrics import (
    Slice,
    depth_profile_difference,
    draw_patches,
    half_size,
    lab_histogram_distance,
    neighbour_change,
    neighbour_slice_ratio,
    patch_distance,
    patch_neighbours,
    radial_ratio,
    sharpness,
    volume_slices,
)
from gsfluent.pipeline.texture.volume.domain import SHELL, InteriorDomain

SIZE = 48


def _material(seed: int, smooth: float = 1.5, size: int = SIZE) -> Slice:
    """A stationary coloured noise with a round mask."""
    noise = np.random.default_rng(seed).standard_normal((size, size, 3))
    noise = ndimage.gaussian_filter(noise, (smooth, smooth, 0), mode="wrap")
    image = 0.5 + 0.12 * noise / noise.std()
    v, u = np.mgrid[:size, :size] - (size - 1) / 2
    return image.clip(0, 1).astype(np.float32), np.hypot(u, v) < 0.46 * size


def _blurred(slice_: Slice, sigma: float) -> Slice:
    return ndimage.gaussian_filter(slice_[0], (sigma, sigma, 0), mode="wrap"), slice_[1]


def _ball(size: int = 40) -> InteriorDomain:
    grid = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1) + 0.5 - size / 2
    inside = (grid**2).sum(-1) <= (size / 2 - 2) ** 2
    depth = np.where(inside, ndimage.distance_transform_edt(inside) - 0.5, 0).astype(np.float32)
    shell = inside & (depth <= SHELL)
    skin = np.zeros((*inside.shape, 3), np.float32)
    axis = np.array([0.0, 0.0, 1.0])
    return InteriorDomain(inside, depth, shell, skin, axis, 1 / size, np.zeros(3))


def test_lab_is_that_of_the_cie() -> None:
    white, black, grey = rgb_to_lab(np.array([[1.0, 1, 1], [0, 0, 0], [0.5, 0.5, 0.5]]))
    assert white == pytest.approx([100, 0, 0], abs=0.05)
    assert black == pytest.approx([0, 0, 0], abs=0.05)
    # L = 116 Y^(1/3) - 16 with Y = ((0.5 + 0.055) / 1.055)^2.4
    assert grey[0] == pytest.approx(116 * ((0.555 / 1.055) ** 2.4) ** (1 / 3) - 16, abs=0.1)


def test_distances_of_a_set_from_itself_are_zero() -> None:
    slices = [_material(k) for k in range(3)]
    assert patch_distance(slices, slices) == 0.0
    assert lab_histogram_distance(slices[0][0], slices[0][0]) == 0.0
    assert patch_neighbours(slices, slices) == pytest.approx((0, 0), abs=0.02)


def test_distances_do_not_care_which_set_comes_first() -> None:
    first, second = [_material(0)], [_blurred(_material(1), 1.0)]
    assert patch_distance(first, second) == pytest.approx(patch_distance(second, first))
    assert lab_histogram_distance(first[0][0], second[0][0]) == lab_histogram_distance(
        second[0][0], first[0][0]
    )
    coherence, coverage = patch_neighbours(first, second)
    assert patch_neighbours(second, first) == pytest.approx((coverage, coherence), rel=1e-5)


def test_distances_do_not_care_about_the_order_of_slices_or_pixels() -> None:
    slices, other = [_material(k) for k in range(4)], [_material(9, 3.0)]
    assert patch_distance(slices[::-1], other) == pytest.approx(patch_distance(slices, other))
    pixels = slices[0][0].reshape(-1, 3)
    mixed = pixels[np.random.default_rng(0).permutation(len(pixels))]
    assert lab_histogram_distance(pixels, mixed) < 1e-4
    # the same colours in another order are another texture
    shuffled = [(mixed.reshape(slices[0][0].shape), slices[0][1])]
    assert patch_distance(slices[:1], shuffled) > 1.0


def test_patch_distance_is_a_metric_in_brightness() -> None:
    image, mask = _material(0)
    # Lab lightness shifted by s moves every quantile of a projection by s times its sum
    lab = rgb_to_lab(image)
    distances = []
    for shift in (2.0, 4.0, 8.0):
        import cv2

        moved = cv2.cvtColor((lab + np.array([shift, 0, 0], np.float32)), cv2.COLOR_LAB2RGB)
        distances.append(patch_distance([(image, mask)], [(moved, mask)]))
    assert distances[1] / distances[0] == pytest.approx(2.0, abs=0.1)
    assert distances[2] / distances[0] == pytest.approx(4.0, abs=0.2)
    # E|sum of the lightness half of a random unit vector of 147| = sqrt(2 / pi) sqrt(49 / 147)
    expected = 2.0 * np.sqrt(2 / np.pi) * np.sqrt(1 / 3)
    assert distances[0] == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("change", ["blur", "noise"])
def test_distances_grow_with_the_damage(change: str) -> None:
    slices = [_material(k) for k in range(3)]
    found = []
    for amount in (0.3, 0.8, 2.0):
        if change == "blur":
            damaged = [_blurred(s, amount) for s in slices]
        else:
            rng = np.random.default_rng(5)
            noise = [0.1 * amount * rng.standard_normal(s[0].shape) for s in slices]
            damaged = [(s[0] + n).clip(0, 1) for s, n in zip(slices, noise, strict=True)]
            damaged = [(d, s[1]) for d, s in zip(damaged, slices, strict=True)]
        found.append((patch_distance(slices, damaged), sharpness(damaged) / sharpness(slices)))
    distances, sharp = zip(*found, strict=True)
    assert distances[0] < distances[1] < distances[2]
    assert list(sharp) == sorted(sharp, reverse=change == "blur")
    assert (sharp[0] < 1) == (change == "blur")


def test_another_draw_is_nearer_than_another_material() -> None:
    def draws(first: int, smooth: float, count: int = 6) -> list[Slice]:
        return [_material(k, smooth, 96) for k in range(first, first + count)]

    truth = draws(0, 1.0)
    floor = patch_distance(truth, draws(10, 1.0))
    assert patch_distance(truth, draws(20, 0.5)) > 2 * floor
    assert patch_distance(truth, draws(20, 3.0)) > 2 * floor
    darker = [(0.8 * image, mask) for image, mask in draws(10, 1.0)]
    assert patch_distance(truth, darker) > 2 * floor
    # two slices say less of the class than six
    assert patch_distance(truth[:2], draws(10, 1.0, 2)) > floor


def test_coherence_sees_inventions_and_coverage_sees_omissions() -> None:
    plain, rich = _material(0, 3.0), _material(1, 3.0)
    spots = rich[0].copy()
    spots[20:26, 20:26] = (0.9, 0.1, 0.1)
    coherence, coverage = patch_neighbours([(spots, rich[1])], [plain])
    alone = patch_neighbours([rich], [plain])
    assert coherence > 1.2 * alone[0]
    assert coverage < 1.1 * alone[1]
    missed = patch_neighbours([plain], [(spots, rich[1])])
    assert missed[1] > 1.2 * alone[1]


def test_patches_stay_inside_the_mask() -> None:
    image, mask = _material(0)
    poisoned = np.where(mask[..., None], image, np.nan).astype(np.float32)
    assert np.isfinite(draw_patches([(poisoned, mask)], 7, 500, 0)).all()
    thin = np.zeros_like(mask)
    thin[10:14] = True
    assert np.isnan(patch_distance([(image, thin)], [(image, mask)]))
    assert patch_neighbours([(image, thin)], [(image, mask)]) == pytest.approx(
        (np.nan, np.nan), nan_ok=True
    )


def test_half_size_keeps_means_and_only_whole_blocks() -> None:
    image, mask = _material(0, size=31)
    ((small, kept),) = half_size([(image, mask)])
    assert small.shape == (15, 15, 3) and kept.shape == (15, 15)
    assert small[3, 4] == pytest.approx(image[6:8, 8:10].mean((0, 1)))
    assert kept[3, 4] == mask[6:8, 8:10].all()
    assert 4 * kept.sum() <= mask.sum()


def test_radial_ratio_of_grain_streaks_and_shells() -> None:
    domain = _ball()
    center = np.stack(np.meshgrid(*[np.arange(40)] * 3, indexing="ij"), -1) - 19.5
    radius = np.linalg.norm(center, axis=-1)
    grain = np.random.default_rng(0).standard_normal((40, 40, 40))
    grain = ndimage.gaussian_filter(grain, 1.2)
    grain = 0.5 + 0.1 * grain / grain.std()
    # the surface carried inward: constant along the radius
    outer = 19.5 + 16.0 * center / np.maximum(radius, 1e-3)[..., None]
    streaks = ndimage.map_coordinates(grain, np.moveaxis(outer, -1, 0), order=1)
    shells = 0.5 + 0.2 * np.sin(1.2 * radius)
    values = {
        name: radial_ratio(domain, np.repeat(v[..., None], 3, -1).astype(np.float32))
        for name, v in (("grain", grain), ("streaks", streaks), ("shells", shells))
    }
    assert values["grain"] == pytest.approx(1.0, abs=0.08)
    assert values["streaks"] < 0.3 < 3.0 < values["shells"]


def test_depth_profile_is_relative_to_the_colour_range() -> None:
    domain = _ball()
    relative = domain.depth / domain.max_depth
    grey = np.repeat(relative[..., None], 3, -1).astype(np.float32)
    assert depth_profile_difference(domain, grey, domain, grey) == 0.0
    flat = np.full_like(grey, 0.5)
    lighter = (grey + 0.1).clip(0, 1)
    near, far = (depth_profile_difference(domain, v, domain, grey) for v in (lighter, flat))
    assert 0.03 < near < 0.15 < far < 0.6
    # half the contrast everywhere: the same share of it
    half_truth, half_flat = 0.25 + 0.5 * grey, 0.25 + 0.5 * flat
    again = depth_profile_difference(domain, half_flat, domain, half_truth)
    assert again == pytest.approx(far, rel=0.15)
    # the profile of another outline is compared at equal relative depth
    small = replace(domain, depth=domain.depth * 0.5)
    assert depth_profile_difference(small, grey, domain, grey) == 0.0


def test_neighbour_change_sees_the_axis_of_the_flicker() -> None:
    grain = np.random.default_rng(0).random((24, 24, 24, 3))
    volume = ndimage.gaussian_filter(grain, (1, 1, 1, 0), mode="wrap")
    inside = np.ones((24, 24, 24), bool)
    before = neighbour_change(volume, inside)
    assert max(before) < 1.05 * min(before)
    flicker = volume + 0.2 * np.random.default_rng(1).standard_normal((1, 24, 1, 1))
    ratios = neighbour_slice_ratio(flicker, inside)
    assert ratios[1] == max(ratios) > 2.0
    assert neighbour_change(flicker, inside)[0] == pytest.approx(before[0])


def test_volume_slices_are_slices_of_the_volume() -> None:
    domain = _ball(24)
    rgb = np.random.default_rng(0).random((24, 24, 24, 3)).astype(np.float32)
    slices = volume_slices(rgb, domain.inside, 3, axes=(2,))
    assert len(slices) == 3
    found = [np.flatnonzero((rgb == s[0][:, :, None]).all((0, 1, 3))) for s in slices]
    assert [len(f) for f in found] == [1, 1, 1]
    assert all(
        np.array_equal(s[1], domain.inside[:, :, f[0]]) for s, f in zip(slices, found, strict=True)
    )
