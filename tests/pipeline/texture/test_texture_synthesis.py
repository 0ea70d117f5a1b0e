"""Exemplar synthesis: its laws; how it looks is measured by scripts/accuracy/texture/known.py."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage

from gsfluent.colors import lab100_to_rgb, rgb_to_lab, rgb_to_lab100
from gsfluent.data import SURFACE, Frame, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.geometry import rgb_to_sh0
from gsfluent.pipeline.texture import InteriorDomain, Texture
from gsfluent.pipeline.texture.photo.exemplar import load_exemplar, load_exemplars
from gsfluent.pipeline.texture.synthesis.bank import Bank, LevelPhoto
from gsfluent.pipeline.texture.synthesis.choice import surface_verdict
from gsfluent.pipeline.texture.synthesis.guides import DepthGuide, place_photo
from gsfluent.pipeline.texture.synthesis.levels import ObjectFields, hashed_noise, nearest_inside
from gsfluent.pipeline.texture.synthesis.method import exemplar_texture
from gsfluent.pipeline.texture.synthesis.transport import match_near
from gsfluent.pipeline.texture.volume.domain import SHELL

CPU = torch.device("cpu")
GREEN = (0.2, 0.4, 0.15)


def _domain(inside: np.ndarray, skin: Any = GREEN, axis: Any = (0.0, 0.0, 1.0)) -> InteriorDomain:
    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1, 1:-1] - 0.5
    depth = np.where(inside, depth, 0.0).astype(np.float32)
    color = np.broadcast_to(np.asarray(skin, np.float32), (*inside.shape, 3)).copy()
    shell = inside & (depth <= SHELL)
    return InteriorDomain(inside, depth, shell, color, np.array(axis), 1.0, np.zeros(3))


def _ball(size: int, shift: float = 0.0, radii: tuple[float, float, float] = (1, 0.85, 0.9)) -> Any:
    grid = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1) + 0.5 - size / 2 - shift
    return ((grid / (np.array(radii) * (size / 2 - 2))) ** 2).sum(-1) <= 1


def _disc(size: int = 120, seed: int = 0, spots: bool = True) -> np.ndarray:
    """RGBA cut: pale rim, red body with soft blotches."""
    v, u = np.mgrid[:size, :size] + 0.5 - size / 2
    radius = np.hypot(u, v) / (size / 2 - 4)
    blotch = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((size, size)), 3)
    tone = 0.12 * blotch / blotch.std() * spots
    red = np.stack([0.75 + tone, 0.2 + tone, 0.2 + 0.5 * tone], -1)
    rim = np.clip((radius - 0.8) / 0.08, 0, 1)[..., None]
    image = red * (1 - rim) + rim * np.array([0.9, 0.9, 0.7])
    return np.concatenate([image.clip(0, 1), (radius < 1)[..., None]], -1).astype(np.float32)


def _same(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of two colour fields [n, 3] about their means."""
    return float(np.corrcoef((a - a.mean(0)).ravel(), (b - b.mean(0)).ravel())[0, 1])


def test_seed_decides_and_nothing_else() -> None:
    domain, photo = _domain(_ball(26)), load_exemplars(_disc())
    first, second, other = (exemplar_texture(domain, photo, seed=s).rgb for s in (3, 3, 4))
    assert np.array_equal(first, second)
    deep = domain.depth > 4
    assert np.abs(first - other)[deep].mean() > 0.01


def test_nothing_is_written_outside_and_colours_are_finite() -> None:
    domain = _domain(_ball(25))
    texture = exemplar_texture(domain, load_exemplars(_disc()), seed=0)
    assert not texture.rgb[~domain.inside].any() and not texture.labels[~domain.inside].any()
    inner = texture.rgb[domain.inside]
    assert np.isfinite(inner).all() and inner.min() >= 0 and inner.max() <= 1


@pytest.mark.parametrize("shape", [(9, 31, 20), (3, 3, 3), (1, 24, 24), (40, 1, 1), (17, 17, 2)])
def test_odd_thin_and_tiny_solids(shape: tuple[int, int, int]) -> None:
    inside = np.pad(np.ones(shape, bool), ((1, 0), (0, 2), (3, 1)))
    for guide in ("depth", "none", "height", "axis"):
        texture = exemplar_texture(
            _domain(inside), load_exemplars(_disc()), guide=guide, quality="preview", seed=0
        )
        inner = texture.rgb[inside]
        assert np.isfinite(inner).all() and inner.std() >= 0
        assert not texture.rgb[~inside].any()


def test_one_colour_gives_that_colour() -> None:
    image = np.full((64, 64, 3), (0.7, 0.3, 0.2), np.float32)
    domain = _domain(_ball(22))
    texture = exemplar_texture(domain, load_exemplars(image), guide="none", seed=0)
    assert np.abs(texture.rgb[domain.inside] - image[0, 0]).max() < 0.01


def test_depth_guide_puts_layers_at_their_depth() -> None:
    domain = _domain(_ball(40))
    rgb = exemplar_texture(domain, load_exemplars(_disc()), guide="depth", seed=0).rgb
    relative = domain.depth / domain.depth.max()
    rim, core = domain.inside & (relative > 0.04) & (relative < 0.12), relative > 0.35
    # the rim is pale, the body red: green tells them apart
    assert rgb[rim][:, 1].mean() > 0.7 and rgb[core][:, 1].mean() < 0.3
    assert np.quantile(rgb[core][:, 1], 0.99) < 0.6


def _layers(size: int = 96) -> np.ndarray:
    """Picture of a cut along the axis: dark below, bright above, a red band between."""
    image = np.full((size, size, 3), 0.85, np.float32)
    image[size // 2 :] = 0.25
    image[size // 2 - 8 : size // 2 + 8] = (0.8, 0.1, 0.1)
    image += 0.03 * np.random.default_rng(0).standard_normal((size, size, 1)).astype(np.float32)
    return np.concatenate([image.clip(0, 1), np.ones((size, size, 1), np.float32)], -1)


def _framed(picture: np.ndarray) -> np.ndarray:
    """With a transparent frame, so that the outline is known."""
    return np.pad(picture, ((6, 6), (6, 6), (0, 0)))


def test_height_guide_keeps_layers_straight_and_is_found() -> None:
    domain = _domain(np.pad(np.ones((32, 32, 32), bool), 2))
    photos = load_exemplars({"x": _framed(_layers()), "y": _framed(_layers())})
    texture = exemplar_texture(domain, photos, directional=True, inclusions=False, seed=0)
    assert texture.report["guide"] == "height"
    rgb = texture.rgb[6:-6, 6:-6]
    # upright: the top of the picture is the top of the object
    assert rgb[..., 28:32, :].mean() > 0.75 and rgb[..., 4:8, :].mean() < 0.35
    middle = rgb[..., 17:19, :]
    assert middle[..., 0].mean() - middle[..., 1].mean() > 0.5
    # straight: every column has the same layers
    assert rgb.std((0, 1)).mean() < 0.06


def test_section_is_carried_along_an_oblique_axis() -> None:
    v, u = np.mgrid[:120, :120] + 0.5 - 60
    radius = np.hypot(u, v) / 56
    rings = 0.5 + 0.4 * np.cos(2 * np.pi * radius * 2.5)
    picture = np.stack([rings, rings, rings, radius < 1], -1).astype(np.float32)
    axis = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    domain = _domain(_ball(44, radii=(1, 1, 1)), axis=axis)
    texture = exemplar_texture(
        domain, load_exemplars({"z": picture}), guide="axis", directional=True, seed=0
    )
    place = np.argwhere(domain.depth > 3) + 0.5 - 22
    along = place @ axis
    distance = np.linalg.norm(place - along[:, None] * axis, axis=1) / 20
    wanted = 0.5 + 0.4 * np.cos(2 * np.pi * distance * 2.5)
    tone = texture.rgb[domain.depth > 3].mean(1)
    # far from the middle the rim follows the surface, as a peel does
    near = np.abs(along) < 8
    assert np.corrcoef(tone[near], wanted[near])[0, 1] > 0.6


def test_surface_that_is_kept_is_kept() -> None:
    rng = np.random.default_rng(0)
    noise = ndimage.gaussian_filter(rng.standard_normal((30, 30, 30)), 1.2)
    volume = (0.5 + 0.15 * noise / noise.std()).clip(0, 1)[..., None].repeat(3, -1)
    domain = replace(_domain(_ball(30)), skin=volume.astype(np.float32))
    photo = np.kron(volume[15], np.ones((3, 3, 1))).astype(np.float32)
    texture = exemplar_texture(domain, load_exemplars(photo), guide="none", surface="keep", seed=0)
    change = np.abs(texture.rgb - domain.skin)[domain.shell]
    assert change.max() < 0.01
    assert np.abs(texture.rgb - domain.skin)[domain.depth > 4].mean() > 0.02


def test_streaks_forbid_copying_and_plain_stuff_allows_it() -> None:
    rng = np.random.default_rng(1)
    size = 48
    noise = ndimage.gaussian_filter(rng.standard_normal((size,) * 3), 1.5)
    volume = (0.5 + 0.15 * noise / noise.std()).clip(0, 1)[..., None].repeat(3, -1)
    bare = _domain(_ball(size, radii=(1, 1, 1)))
    nearest = ndimage.distance_transform_edt(
        ~bare.shell, return_distances=False, return_indices=True
    )
    copied = volume[tuple(nearest)].astype(np.float32)
    photo = volume[size // 2].astype(np.float32)
    picture = np.concatenate([photo, bare.inside[size // 2][..., None]], -1).astype(np.float32)
    domain = replace(bare, skin=copied)
    kept = exemplar_texture(domain, load_exemplars(picture), guide="none", quality="preview")
    report = kept.report
    assert report["surface_like_interior"] and not report["copy_suffices"]
    assert report["surface"] == "keep" and "streaks" in report["why"]
    assert report["copy_radial"] < 0.75 * report["photo_radial"]
    plain = np.full_like(photo, 0.6) + 0.004 * rng.standard_normal(photo.shape)
    picture[..., :3] = plain
    flat = replace(bare, skin=np.full_like(copied, 0.6))
    copy = exemplar_texture(flat, load_exemplars(picture), guide="none")
    assert copy.report["copy_suffices"] and copy.report["surface"] == "copy"
    assert np.array_equal(copy.rgb[bare.inside], flat.skin[bare.inside])
    # a skin of another colour is neither
    other = replace(bare, skin=np.broadcast_to(np.float32(GREEN), copied.shape).copy())
    fields = ObjectFields(other, True, CPU)
    placed = place_photo(
        load_exemplar(picture), fields, 0, guided=False, scale=1.0, depth_scale=None
    )
    assert not surface_verdict(other, [placed])["surface_like_interior"]


def test_all_patches_are_used_about_equally() -> None:
    rng = np.random.default_rng(0)
    noise = ndimage.gaussian_filter(rng.standard_normal((60, 60, 3)), (1.5, 1.5, 0))
    image = torch.from_numpy((0.5 + 0.1 * noise / noise.std()).astype(np.float32))
    photo = LevelPhoto(image, torch.ones(60, 60, dtype=torch.bool), torch.zeros(60, 60, 1))
    bank = Bank([photo], 600, 5, 5, True, torch.zeros(10, 1), rng)
    # washed-out queries, such as averaging makes them: the plain nearest patch is a dull one
    pick = rng.integers(0, 600, 3000)
    flat = bank.patches.reshape(600, -1)
    patches = (flat.mean(0) + 0.4 * (flat[pick] - flat.mean(0))).reshape(-1, 25, 3)
    query = bank.describe(patches, torch.zeros(3000, 1))

    def spread() -> tuple[float, float]:
        best = bank.nearest(query)[0]
        return len(best.unique()) / 600, float(flat[best].var(0).sum())

    used, variance = spread()
    bank.balance(query[::4], 5)
    balanced, livelier = spread()
    assert balanced > 1.5 * used and livelier > 1.3 * variance


def test_colours_are_matched_near_each_guide_value() -> None:
    rng = np.random.default_rng(0)
    guide = torch.rand(6000, 1, generator=torch.Generator().manual_seed(0))
    reference = torch.cat([guide, 1 - guide, 0.5 + 0.05 * torch.randn(6000, 1)], 1)
    moved = match_near(torch.rand(6000, 3), guide, reference, guide, rng)
    assert (moved[:, :1] - guide).abs().mean() < 0.12
    assert abs(float(moved[:, 2].mean()) - 0.5) < 0.02


def test_depth_guide_is_steep_where_colours_change() -> None:
    domain = _domain(_ball(40))
    fields = ObjectFields(domain, True, CPU)
    photo = load_exemplar(_disc(spots=False))
    placed = place_photo(photo, fields, 0, guided=True, scale=1.0, depth_scale=None)
    assert placed.fitted
    guide = DepthGuide([placed], fields.max_depth)
    rim, core = (
        float(
            guide(torch.tensor([b * fields.max_depth]))
            - guide(torch.tensor([a * fields.max_depth]))
        )
        for a, b in ((0.1, 0.25), (0.6, 0.75))
    )
    assert rim > 5 * core > 0


def test_lab_there_and_back() -> None:
    rgb = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    lab = rgb_to_lab100(rgb)
    assert torch.allclose(lab100_to_rgb(lab), rgb, atol=1e-3)
    assert np.abs(100 * lab.numpy() - rgb_to_lab(rgb.numpy())).max() < 0.5


def test_noise_belongs_to_the_object() -> None:
    inside = _ball(32)
    shifted = np.pad(inside, ((3, 0), (0, 5), (1, 1)))
    first, second = (
        hashed_noise(ObjectFields(_domain(i), True, CPU).lattices()[0], 3, 7, CPU)
        for i in (inside, shifted)
    )
    assert first.shape == second.shape and torch.equal(first, second)
    assert abs(float(first.mean())) < 0.05 and abs(float(first.std()) - 1) < 0.05


def test_extension_repeats_the_nearest_inside() -> None:
    inside = torch.from_numpy(_ball(16))
    target, source = nearest_inside(inside, 2)
    flat = inside.reshape(-1)
    assert flat[source].all() and not flat[target].any()
    a, b = (torch.stack(torch.unravel_index(i, inside.shape), 1) for i in (target, source))
    assert int((a - b).abs().sum(1).max()) <= 2


def test_the_grid_does_not_matter() -> None:
    """The same object on a shifted grid, and at three times the size: the same texture."""
    photo = load_exemplars(_disc())
    inside = _ball(26)
    plain = exemplar_texture(_domain(inside), photo, seed=2).rgb[inside]
    moved = np.pad(inside, ((5, 0), (0, 2), (1, 1)))
    again = exemplar_texture(_domain(moved), photo, seed=2).rgb[moved]
    assert np.array_equal(plain, again)
    scaled = replace(_domain(inside), voxel=3.0, origin=np.full(3, 7.0))
    assert np.array_equal(plain, exemplar_texture(scaled, photo, seed=2).rgb[inside])


def test_another_resolution_gives_the_same_texture() -> None:
    """Refilled at 1.4 times the resolution, off the old grid: alike where both can show it."""
    photo = load_exemplars(_disc())
    small, large = _ball(44), _ball(60, shift=0.3)
    coarse, fine, other = (
        exemplar_texture(_domain(i), photo, seed=s).rgb
        for i, s in ((small, 2), (large, 2), (large, 3))
    )
    deep = np.argwhere(_domain(small).depth > 5)
    place = (deep + 0.5 - 22) * (28 / 20) + 30.3 - 0.5

    def at(volume: np.ndarray) -> np.ndarray:
        # colours a coarse voxel can hold
        smooth = [ndimage.gaussian_filter(volume[..., c], 1.8) for c in range(3)]
        return np.stack([ndimage.map_coordinates(s, place.T, order=1) for s in smooth], 1)

    blurred = np.stack([ndimage.gaussian_filter(coarse[..., c], 1.3) for c in range(3)], -1)
    mine = blurred[tuple(deep.T)]
    # the coarse level is all but the same (0.94), the fine one starts from it and has its own grid
    assert _same(mine, at(fine)) > 0.4
    assert _same(mine, at(fine)) > _same(mine, at(other)) + 0.08


def _solid(inside: np.ndarray) -> Solid:
    domain = _domain(inside)
    points = torch.from_numpy(np.argwhere(domain.shell) + 0.5).float()
    count = len(points)
    sh = rgb_to_sh0(torch.tensor(GREEN)).expand(count, 1, 3).clone()
    gaussians = Gaussians(
        means=points,
        scales=torch.full((count, 3), 0.6),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        opacities=torch.full((count,), 0.9),
        sh=sh,
        labels=torch.full((count,), SURFACE, dtype=torch.int32),
    )
    return Solid(
        gaussians,
        torch.from_numpy(inside),
        torch.from_numpy(domain.depth),
        torch.zeros(3),
        1.0,
    )


def test_moving_the_solid_leaves_its_texture() -> None:
    solid = _solid(_ball(24))
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = solid.transformed(Frame(turn, torch.tensor([1.0, 2, 3]), 3.0))
    stage = Texture(exemplar=_disc(), quality="preview", device="cpu", seed=1)
    first, second = stage(solid), stage(moved)
    assert torch.equal(first.color, second.color)
    assert first.report["guide"] == "depth" and first.report["why"]


def test_several_photographs_are_one_bank() -> None:
    red, blue = _disc(spots=False), _disc(spots=False)
    blue[..., :3] = blue[..., [2, 1, 0]]
    domain = _domain(_ball(30))
    texture = exemplar_texture(
        domain, load_exemplars([red, blue]), guide="depth", inclusions=False, seed=0
    )
    assert texture.report["exemplars"] == 2
    core = texture.rgb[domain.depth > 6]
    share = float((core[:, 0] > core[:, 2]).mean())
    assert 0.15 < share < 0.85


def test_shown_parts_become_regions() -> None:
    picture = _disc(spots=False)
    labels = np.zeros(picture.shape[:2], np.uint8)
    centers = [(40, 45), (60, 80), (85, 50)]
    v, u = np.mgrid[:120, :120]
    for number, (row, column) in enumerate(centers, start=1):
        spot = (v - row) ** 2 + (u - column) ** 2 < 36
        labels[spot] = number
        picture[spot, :3] = (0.3, 0.5, 0.25)  # too few and too faint to be guessed
    domain = _domain(_ball(44))
    photo = load_exemplars(picture)
    assert exemplar_texture(domain, photo, quality="preview").labels.max() == 0
    for parts in (labels, labels > 0, (0.3, 0.5, 0.25)):
        texture = exemplar_texture(domain, photo, quality="preview", parts=parts, seed=0)
        assert texture.labels.max() == texture.report["inclusions"] >= 3
        body = texture.rgb[texture.labels > 0].mean(0)
        assert body[1] > body[0]
    with pytest.raises(InputError, match="pixels"):
        exemplar_texture(domain, photo, parts=labels[:50])
    with pytest.raises(InputError, match="nothing"):
        exemplar_texture(domain, photo, parts=np.zeros_like(labels))
    with pytest.raises(InputError, match="no such"):
        exemplar_texture(domain, photo, parts="nowhere.png")


def test_own_coordinate_and_errors() -> None:
    domain = _domain(_ball(24))
    photo = load_exemplars(_disc())
    own = np.broadcast_to(np.linspace(0, 1, 24, dtype=np.float32), (24, 24, 24)).copy()
    assert exemplar_texture(domain, photo, guide=own, quality="preview").report["guide"] == "array"
    with pytest.raises(InputError, match="guide array"):
        exemplar_texture(domain, photo, guide=own[:5])
    with pytest.raises(InputError, match="surface must be"):
        exemplar_texture(domain, photo, surface="paint")
    with pytest.raises(InputError, match="core must be"):
        exemplar_texture(domain, photo, core="ajar")
    with pytest.raises(InputError, match="depth_scale"):
        exemplar_texture(domain, photo, depth_scale=0.0)
    with pytest.raises(InputError, match="list of exemplars"):
        load_exemplars([])
