"""Texture: exemplar synthesis against baselines, presets, the stage's contract, errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from interior_shapes import ellipsoid_shell
from scipy import ndimage

from gsfluent import materials
from gsfluent.data import INTERIOR, SURFACE, Solid
from gsfluent.errors import InputError
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.texture import (
    InteriorDomain,
    InteriorTexture,
    Texture,
    load_exemplar,
    preset_names,
)
from gsfluent.pipeline.texture.photo.metrics import (
    depth_profile_error,
    lab_histogram_distance,
    neighbour_slice_ratio,
    patch_distance,
    volume_slices,
)
from gsfluent.pipeline.texture.photo.profile import match_colors
from gsfluent.pipeline.texture.presets.by_material import inside_of
from gsfluent.pipeline.texture.presets.plain import TINTED
from gsfluent.pipeline.texture.presets.procedural import procedural_texture
from gsfluent.pipeline.texture.synthesis.inclusions import find_inclusions
from gsfluent.pipeline.texture.volume.domain import SHELL, blend_skin

SIZE = 40


def _domain(
    size: int = SIZE, skin: tuple[float, float, float] = (0.2, 0.4, 0.15)
) -> InteriorDomain:
    """An ellipsoid in a cube, without any splats."""
    radii = np.array([1.0, 0.82, 0.9]) * (size / 2 - 2)
    grid = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1) + 0.5 - size / 2
    inside = ((grid / radii) ** 2).sum(-1) <= 1
    depth = np.where(inside, ndimage.distance_transform_edt(inside) - 0.5, 0).astype(np.float32)
    color = np.broadcast_to(np.array(skin, np.float32), (*inside.shape, 3)).copy()
    axis = np.array([0.0, 0.0, 1.0])
    shell = inside & (depth <= SHELL)
    return InteriorDomain(inside, depth, shell, color, axis, 1 / size, np.zeros(3))


def _photo(domain: InteriorDomain, texture: InteriorTexture) -> np.ndarray:
    """RGBA slice through the middle, four pixels per voxel."""
    k = domain.inside.shape[0] // 2
    alpha = domain.inside[k][..., None].astype(np.float32)
    image = np.concatenate([texture.rgb[k], alpha], -1)
    return np.kron(image, np.ones((4, 4, 1), np.float32))


@pytest.fixture(scope="module")
def melon() -> tuple[Solid, np.ndarray, InteriorTexture]:
    """A filled green shell, a photograph of a cut melon, and the melon it was taken of."""
    shell = ellipsoid_shell(
        2000, (1.0, 0.82, 0.9), color=lambda p: torch.tensor([0.2, 0.4, 0.15]).expand_as(p).double()
    )
    solid = Fill(SIZE)(shell)
    domain = InteriorDomain.from_solid(solid)
    truth = procedural_texture(domain, "watermelon", 0)
    k = domain.inside.shape[0] // 2
    alpha = domain.inside[k][..., None].astype(np.float32)
    photo = np.kron(np.concatenate([truth.rgb[k], alpha], -1), np.ones((4, 4, 1), np.float32))
    return solid, photo, truth


def _distance(solid: Solid, truth: InteriorTexture) -> float:
    assert solid.color is not None
    inside = solid.occupancy.numpy()
    ours = volume_slices(solid.color.numpy(), inside)
    return patch_distance(ours, volume_slices(truth.rgb, inside), patch=5, samples=2000)


@pytest.fixture(scope="module")
def textured(melon: tuple[Solid, np.ndarray, InteriorTexture]) -> Solid:
    solid, photo, _ = melon
    return Texture(exemplar=photo)(solid)


def test_exemplar_beats_color_copy_by_far(
    melon: tuple[Solid, np.ndarray, InteriorTexture], textured: Solid
) -> None:
    solid, _, truth = melon
    copy = Texture("color_copy")(solid)
    telea = Texture("telea")(solid)
    ours = _distance(textured, truth)
    assert ours < 4.5
    assert _distance(copy, truth) > 6 * ours
    assert _distance(telea, truth) > 6 * ours


def test_preview_is_close_and_cheap(melon: tuple[Solid, np.ndarray, InteriorTexture]) -> None:
    solid, photo, truth = melon
    preview = Texture(exemplar=photo, quality="preview")(solid)
    assert _distance(preview, truth) < 4.5
    assert preview.report["quality"] == "preview"


def test_report_and_consistency(textured: Solid) -> None:
    report = textured.report
    assert report["method"] == "exemplar"
    assert 0 < report["patch_distance"] < 8.0
    # one volume: no axis flickers more than another
    assert report["axis_consistency"] < 1.25
    assert report["axis_disagreement"] > 0
    assert report["depth_profile_error"] < 6.0
    assert report["surface_like_interior"] is False
    assert "fill" in textured.report


def test_surface_gaussians_are_untouched(
    melon: tuple[Solid, np.ndarray, InteriorTexture], textured: Solid
) -> None:
    solid, _, _ = melon
    before, after = solid.gaussians, textured.gaussians
    surface = before.labels == SURFACE
    assert torch.equal(before.sh[surface], after.sh[surface])
    assert torch.equal(before.means, after.means)
    inner = after.labels == INTERIOR
    deep = inner & (textured.depth_at(after.means) > 0.5 * float(textured.depth.max()))
    mean = after.colors()[deep].mean(0)
    assert mean[0] > 0.6 and mean[1] < 0.45 and mean[2] < 0.45  # red flesh
    assert not torch.equal(before.sh[inner], after.sh[inner])


def test_interior_gaussians_sample_the_volume(textured: Solid) -> None:
    inner = textured.gaussians.select(textured.gaussians.labels == INTERIOR)
    difference = (inner.colors() - textured.color_at(inner.means)).abs()
    assert float(difference.mean()) < 0.05


def test_skin_blends_into_flesh(textured: Solid) -> None:
    assert textured.color is not None
    shallow = textured.occupancy & (textured.depth < 0.6 * textured.voxel)
    skin = textured.color[shallow].mean(0)
    assert torch.allclose(skin, torch.tensor([0.2, 0.4, 0.15]), atol=0.06)


def test_same_seed_same_texture(melon: tuple[Solid, np.ndarray, InteriorTexture]) -> None:
    solid, photo, _ = melon
    colors = [Texture(exemplar=photo, quality=q, seed=3)(solid).color for q in ("preview",) * 2]
    assert torch.equal(colors[0], colors[1])
    other = Texture(exemplar=photo, quality="preview", seed=4)(solid).color
    assert not torch.equal(colors[0], other)


def test_patch_synthesis_is_deterministic() -> None:
    from gsfluent.pipeline.texture.photo.exemplar import load_exemplars
    from gsfluent.pipeline.texture.synthesis.method import exemplar_texture

    domain = _domain(24)
    photo = load_exemplars(_photo(domain, procedural_texture(domain, "watermelon", 0)))
    first, second = (exemplar_texture(domain, photo, seed=1).rgb for _ in range(2))
    assert np.array_equal(first, second)


def test_inclusions_are_found_counted_and_labelled() -> None:
    from gsfluent.pipeline.texture.photo.exemplar import load_exemplars
    from gsfluent.pipeline.texture.synthesis.method import exemplar_texture

    rng = np.random.default_rng(0)
    v, u = np.mgrid[:400, :400]
    image = np.full((400, 400, 3), 0.8, np.float32) + 0.01 * rng.standard_normal((400, 400, 1))
    spots = 0
    for center in rng.uniform(70, 330, (60, 2)):
        if np.hypot(*(center - 200)) > 150:
            continue
        spot = (v - center[0]) ** 2 + (u - center[1]) ** 2 < 49
        image[spot] = (0.1, 0.05, 0.05)
        spots += 1
    alpha = ((v - 200) ** 2 + (u - 200) ** 2 < 190**2)[..., None]
    photo = np.concatenate([image, alpha], -1).astype(np.float32)
    blobs = find_inclusions(load_exemplar(photo))
    assert blobs is not None and 0.6 * spots <= blobs.count <= spots
    domain = _domain(56)
    texture = exemplar_texture(domain, load_exemplars(photo), quality="preview", seed=0)
    count = texture.report["inclusions"]
    assert count == texture.labels.max() > 20
    body = texture.labels > 0
    # volume fraction equals area fraction (Delesse), within the scatter of a few dozen blobs
    area = spots * 49 / 190**2
    assert 0.4 * area < body.sum() / domain.inside.sum() < 2.0 * area
    assert texture.rgb[body].mean() < 0.45 < texture.rgb[domain.inside & ~body].mean()


def _star_photo() -> np.ndarray:
    """A disc with a dark five-lobed core."""
    v, u = np.mgrid[:200, :200] - 99.5
    radius, angle = np.hypot(u, v) / 90, np.arctan2(-v, u)
    core = radius < 0.45 + 0.2 * np.cos(5 * angle)
    image = np.where(core[..., None], (0.15, 0.1, 0.05), (0.9, 0.85, 0.6))
    image = image + 0.03 * np.random.default_rng(0).standard_normal((200, 200, 1))
    return np.concatenate([image.clip(0, 1), (radius < 1)[..., None]], -1).astype(np.float32)


def test_axis_guide_keeps_the_star_across_the_axis() -> None:
    from gsfluent.pipeline.texture.photo.exemplar import load_exemplars
    from gsfluent.pipeline.texture.synthesis.method import exemplar_texture

    domain = _domain(40)
    photo = load_exemplars(_star_photo())
    k = 20
    v, u = np.mgrid[:40, :40] + 0.5 - 20
    angle, radius = np.arctan2(u, v), np.hypot(u / 0.82, v) / 18

    def star(guide: str, seed: int) -> float:
        rgb = exemplar_texture(domain, photo, guide=guide, inclusions=False, seed=seed).rgb
        ring = (radius > 0.32) & (radius < 0.58)
        tone = rgb[:, :, k].mean(-1)[ring]
        # the photograph is dark where the cosine is high
        return -float(((tone - tone.mean()) * np.cos(5 * angle[ring])).mean())

    assert min(star("axis", seed) for seed in (1, 2)) > 0.1
    assert np.mean([star("depth", seed) for seed in (1, 2)]) < 0.05


@pytest.mark.parametrize("preset", preset_names())
def test_presets_are_point_functions(preset: str) -> None:
    domain = _domain(24)
    texture = procedural_texture(domain, preset, 0)
    inner = texture.rgb[domain.inside]
    assert np.isfinite(inner).all() and inner.min() >= 0 and inner.max() <= 1
    assert inner.std(0).max() > 0.01
    again = procedural_texture(domain, preset, 0)
    assert np.array_equal(texture.rgb, again.rgb)
    assert not np.array_equal(texture.rgb, procedural_texture(domain, preset, 1).rgb)


def test_preset_follows_the_given_axis(melon: tuple[Solid, np.ndarray, InteriorTexture]) -> None:
    solid, _, _ = melon
    along_z = Texture(preset="wood", axis=(0.0, 0.0, 1.0))(solid).color.numpy()
    along_x = Texture(preset="wood", axis=(1.0, 0.0, 0.0))(solid).color.numpy()
    deep = solid.depth.numpy() > 0.3 * float(solid.depth.max())
    # grain runs along the axis: colours change least that way
    ratio_z = neighbour_slice_ratio(along_z, deep)
    ratio_x = neighbour_slice_ratio(along_x, deep)
    assert ratio_z[2] == min(ratio_z) and ratio_x[0] == min(ratio_x)


def test_nothing_given_is_plain_matter_in_the_colour_of_the_skin(
    melon: tuple[Solid, np.ndarray, InteriorTexture], caplog: pytest.LogCaptureFixture
) -> None:
    solid, _, _ = melon
    with caplog.at_level("INFO"):
        result = Texture()(solid)
    assert "gets the inside 'plain'" in caplog.text
    assert (result.report["method"], result.report["preset"]) == ("procedural", "plain")
    inner = result.color[result.occupancy]
    assert torch.allclose(inner.mean(0), torch.tensor([0.2, 0.4, 0.15]), atol=0.03)
    assert float(inner.std(0).amax()) > 0.005


def test_the_material_says_what_is_inside(
    melon: tuple[Solid, np.ndarray, InteriorTexture], caplog: pytest.LogCaptureFixture
) -> None:
    solid, _, _ = melon
    with caplog.at_level("INFO"):
        found = Texture(material="watermelon")(solid)
    assert "watermelon gets the inside 'watermelon'" in caplog.text
    assert torch.equal(found.color, Texture(preset="watermelon")(solid).color)
    assert Texture(preset="wood", material="bone").preset == "wood"
    with pytest.raises(InputError, match="unobtainium"):
        Texture(material="unobtainium")


def test_every_inside_of_a_material_is_a_preset() -> None:
    solids = [name for name in materials.names() if materials.get(name).law != "fluid"]
    assert {inside_of(name) for name in solids} <= set(preset_names())
    # what is the same throughout has the skin's colour; what has an inside of its own does not
    for name, tinted in (("rock", True), ("steel", True), ("chocolate", True), ("bone", False)):
        assert (inside_of(name) in TINTED) == tinted


def test_a_thin_wall_has_an_inside_of_its_own() -> None:
    domain = _domain(24)
    wall = replace(domain, inside=domain.depth > 0, depth=np.minimum(domain.depth, 1.7))
    white = np.ones_like(domain.skin)
    found = blend_skin(wall, white)
    assert float(found[wall.depth >= 1.5].min()) == 1.0
    outer = (domain.depth > 0) & (domain.depth <= 0.5)
    assert np.allclose(found[outer], domain.skin[outer])
    # what is massive fades as deep as ever
    shallow = (domain.depth > 1.4) & (domain.depth < 1.6)
    assert float(blend_skin(domain, white)[shallow].max()) < 0.7


def test_no_smears_where_the_skin_has_a_pattern() -> None:
    domain = _domain()
    stripes = np.zeros_like(domain.skin)
    angle = np.arctan2(*np.moveaxis(np.indices(domain.inside.shape)[:2] - 20.0, 0, 0))
    stripes[np.cos(8 * angle) > 0] = 1.0
    texture = procedural_texture(replace(domain, skin=stripes), "plain", 0)
    deep = domain.depth > 3.0
    assert texture.rgb[deep].std() < 0.06


def test_masks_of_photographs(tmp_path: Path) -> None:
    from PIL import Image

    v, u = np.mgrid[:120, :160]
    disc = (v - 60) ** 2 + (u - 80) ** 2 < 45**2
    rng = np.random.default_rng(0)
    ground = np.full((120, 160, 3), 235, np.uint8)
    ground[disc] = rng.integers(60, 120, (int(disc.sum()), 3))
    Image.fromarray(ground).save(tmp_path / "disc.png")
    plain = load_exemplar(tmp_path / "disc.png")
    assert plain.silhouette and "border colour" in plain.note
    assert (plain.mask & disc).sum() / (plain.mask | disc).sum() > 0.95
    material = load_exemplar(rng.integers(0, 255, (64, 64, 3)).astype(np.uint8))
    assert not material.silhouette and material.mask.all()
    rgba = np.dstack([ground, 255 * disc.astype(np.uint8)])
    cut = load_exemplar(rgba)
    assert cut.silhouette and np.array_equal(cut.mask, ndimage.binary_fill_holes(cut.mask))
    assert cut.max_depth == pytest.approx(45, abs=1.5)


def test_material_patch_needs_no_outline(melon: tuple[Solid, np.ndarray, InteriorTexture]) -> None:
    solid, _, _ = melon
    rng = np.random.default_rng(1)
    patch = ndimage.gaussian_filter(rng.random((96, 96)), 2)
    patch = (patch - patch.min()) / (patch.max() - patch.min())
    image = np.stack([patch, patch, patch], -1).astype(np.float32)
    result = Texture(exemplar=image, quality="preview", inclusions=False)(solid)
    report = result.report
    assert report["guide"] == "none"
    assert report["color_distance"] < 6.0


def test_metrics_rank_as_they_should() -> None:
    domain = _domain()
    a = procedural_texture(domain, "watermelon", 0).rgb
    b = procedural_texture(domain, "watermelon", 5).rgb
    flat = np.full_like(a, 0.5)
    slices = [volume_slices(x, domain.inside) for x in (a, b, flat)]
    assert patch_distance(slices[0], slices[0]) < 1e-6 + patch_distance(slices[0], slices[1])
    assert patch_distance(slices[0], slices[1]) < 0.2 * patch_distance(slices[0], slices[2])
    inside = domain.inside
    assert lab_histogram_distance(a[inside], a[inside]) == 0.0
    assert lab_histogram_distance(a[inside], flat[inside]) > 5.0
    photo = load_exemplar(_photo(domain, procedural_texture(domain, "watermelon", 0)))
    assert depth_profile_error(domain, a, photo) < 0.3 * depth_profile_error(domain, flat, photo)
    # slices made independently flicker across their axis
    rng = np.random.default_rng(0)
    flicker = a + 0.25 * rng.standard_normal((a.shape[0], 1, 1, 1))
    assert neighbour_slice_ratio(flicker, inside)[0] > 2.0


def test_color_transport_reaches_the_reference_per_depth() -> None:
    rng = np.random.default_rng(0)
    depth = rng.random(4000)
    reference = np.stack([depth, 1 - depth, 0.3 + 0.1 * rng.random(4000)], 1)
    values = rng.random((3000, 3))
    own = rng.random(3000)
    moved = match_colors(values, own, reference, depth, bins=8, rng=rng)
    assert np.abs(moved[:, 0] - own).mean() < 0.1
    assert np.abs(moved[:, 2].mean() - 0.35) < 0.02


def test_errors(melon: tuple[Solid, np.ndarray, InteriorTexture], tmp_path: Path) -> None:
    solid, photo, _ = melon
    with pytest.raises(InputError, match="method must be one of"):
        Texture("magic")
    with pytest.raises(InputError, match="needs an exemplar"):
        Texture("exemplar")
    with pytest.raises(InputError, match="preset must be one of"):
        Texture("procedural", preset="granola")
    with pytest.raises(InputError, match="needs a model"):
        Texture("diffusion")
    with pytest.raises(InputError, match="quality"):
        Texture(preset="wood", quality="ultra")
    with pytest.raises(InputError, match="no such"):
        Texture(exemplar=tmp_path / "no.png")(solid)
    (tmp_path / "bad.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match="can read"):
        Texture(exemplar=tmp_path / "bad.png")(solid)
    with pytest.raises(InputError, match="NaN"):
        Texture(exemplar=np.full((32, 32, 3), np.nan, np.float32))(solid)
    with pytest.raises(InputError, match="16 x 16"):
        Texture(exemplar=np.zeros((8, 40, 3), np.float32))(solid)
    with pytest.raises(InputError, match="RGB"):
        Texture(exemplar=np.zeros((40, 40), np.float32))(solid)
    with pytest.raises(InputError, match="axes must be"):
        Texture(exemplar={"w": photo})(solid)
    with pytest.raises(InputError, match="outline"):
        material = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
        Texture(exemplar=material, guide="axis")(solid)
    with pytest.raises(InputError, match="guide must be"):
        Texture(exemplar=photo, guide="sideways")(solid)
    with pytest.raises(InputError, match="scale"):
        Texture(exemplar=photo, scale=-1.0)(solid)
    empty = replace(solid, occupancy=torch.zeros_like(solid.occupancy))
    with pytest.raises(InputError, match="empty"):
        Texture(preset="wood")(empty)


@pytest.mark.data
def test_real_apple_exemplar(
    data_root: Path, melon: tuple[Solid, np.ndarray, InteriorTexture]
) -> None:
    solid, _, _ = melon
    photo = data_root / "exemplars" / "apple_cross_sections" / "apple_cs_03.png"
    result = Texture(exemplar=photo)(solid)
    report = result.report
    copy = Texture("color_copy", exemplar=photo)(solid)
    assert report["guide"] == "depth"
    assert report["patch_distance"] < 0.4 * copy.report["patch_distance"]
