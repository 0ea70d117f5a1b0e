"""Photographs as they come: cut-outs, light, tint, stains, and files that are not what they say."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from gsfluent.colors import linear_to_srgb, srgb_to_linear
from gsfluent.errors import InputError
from gsfluent.lab.truth.interiors import KNOWN_INTERIORS, known_interior
from gsfluent.pipeline.texture.photo.exemplar import (
    PhotoOptions,
    load_exemplar,
    load_exemplars,
    rgb_to_lab,
    with_skin,
)
from gsfluent.pipeline.texture.photo.light import (
    remove_glints,
    remove_shading,
    shading_field,
    white_gains,
)
from gsfluent.pipeline.texture.photo.stain import remove_stain
from gsfluent.pipeline.texture.volume.domain import options_of

DATA = Path(
    os.environ.get("GSFLUENT_DATA", Path(__file__).resolve().parents[4] / "shared" / "data")
)
EXEMPLARS = DATA / "exemplars"
UNTOUCHED = PhotoOptions("auto", False, False, False, False, "none")


def fruit(size: int = 240, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A cut fruit with rind, flesh and grain on nothing: image [H, W, 3] and mask."""
    rng = np.random.default_rng(seed)
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    radius = np.hypot(x / 0.86, y / 0.80)
    mask = radius < 1
    stops = [0.0, 0.80, 0.86, 0.95, 1.0]
    table = np.array(
        [(0.86, 0.30, 0.22), (0.82, 0.22, 0.2), (0.9, 0.86, 0.7), (0.5, 0.7, 0.3), (0.2, 0.4, 0.1)]
    )
    image = np.stack([np.interp(radius, stops, table[:, c]) for c in range(3)], -1)
    image *= 1 + 0.06 * rng.standard_normal((size, size, 1))
    return image.clip(0, 1).astype(np.float32), mask


def on_ground(image: np.ndarray, mask: np.ndarray, ground: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], image, ground).astype(np.float32)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def lab_error(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return float(np.linalg.norm(rgb_to_lab(a[mask]) - rgb_to_lab(b[mask]), axis=1).mean())


# cut-outs


def test_an_even_ground_is_cut_away_and_alpha_is_believed() -> None:
    image, mask = fruit()
    for ground in ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.3, 0.7)):
        found = load_exemplar(on_ground(image, mask, np.array(ground)), options=UNTOUCHED)
        assert found.silhouette
        assert overlap(found.mask, mask) > 0.97, ground
    cut = np.concatenate([image, mask[..., None]], -1)
    assert overlap(load_exemplar(cut, options=UNTOUCHED).mask, mask) > 0.99


def test_a_tight_crop_is_cut_out_by_its_corners() -> None:
    image, mask = fruit()
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0] + 6, rows[-1] - 5), slice(columns[0] + 6, columns[-1] - 5)
    photo = load_exemplar(on_ground(image, mask, np.zeros(3))[box], options=UNTOUCHED)
    assert "corner" in photo.note
    assert overlap(photo.mask, mask[box]) > 0.97


def test_graph_cuts_find_an_object_on_an_uneven_ground_and_none_in_material() -> None:
    from scipy import ndimage

    image, mask = fruit()
    rng = np.random.default_rng(1)
    blotch = ndimage.gaussian_filter(rng.standard_normal((240, 240)), 12)
    blotch = 0.5 + 0.9 * blotch / np.abs(blotch).max()
    ground = blotch[..., None] * np.array([0.35, 0.45, 0.75])
    photo = load_exemplar(on_ground(image, mask, ground.clip(0, 1)), options=UNTOUCHED)
    assert "graph cuts" in photo.note
    assert photo.silhouette
    assert overlap(photo.mask, mask) > 0.93
    grain = ndimage.gaussian_filter(rng.standard_normal((200, 260, 3)), (2, 2, 0))
    crumb = (0.6 + 0.8 * grain).clip(0, 1).astype(np.float32)
    patch = load_exemplar(crumb, options=UNTOUCHED)
    assert not patch.silhouette
    assert patch.mask.all()


def test_leftovers_on_the_rim_go_and_layers_all_round_stay() -> None:
    image, mask = fruit()
    plain = load_exemplar(image, mask)
    tab = np.zeros_like(mask)
    tab[20:60, 105:135] = True
    spoiled = np.where((tab & ~mask)[..., None], np.array([0.1, 0.1, 0.8]), image)
    photo = load_exemplar(spoiled.astype(np.float32), mask | tab)
    assert "rim" in photo.note
    assert (photo.mask & tab & ~mask).sum() < 0.2 * (tab & ~mask).sum()
    assert "rim" not in plain.note
    assert (plain.mask == mask).all()


# light


@pytest.mark.parametrize(("gx", "gy"), [(0.5, 0.0), (-0.3, 0.4)])
def test_a_known_gradient_of_light_is_found_and_taken_out(gx: float, gy: float) -> None:
    image, mask = fruit()
    y, x = (np.mgrid[:240, :240] + 0.5) / 240 * 2 - 1
    light = np.exp(gx * x + gy * y - 0.3)
    lit = linear_to_srgb(srgb_to_linear(image) * light[..., None])
    truth = linear_to_srgb(srgb_to_linear(image) * np.exp(-0.3))
    depth = load_exemplar(image, mask, UNTOUCHED).depth
    field, size = shading_field(lit, mask, depth)
    wanted = np.log(light)[mask]
    assert np.corrcoef(field[mask], wanted)[0, 1] > 0.98
    assert size == pytest.approx(np.subtract(*np.quantile(wanted, [0.95, 0.05])), rel=0.2)
    even, note = remove_shading(lit, mask, depth)
    assert note is not None
    assert lab_error(even, truth, mask) < 0.35 * lab_error(lit, truth, mask)


def test_layers_and_colours_by_height_are_not_taken_for_light() -> None:
    image, mask = fruit()
    depth = load_exemplar(image, mask, UNTOUCHED).depth
    assert remove_shading(image, mask, depth)[1] is None  # darker outside: the rind, not the light
    cake = np.full((160, 200, 3), (0.45, 0.2, 0.1), np.float32)
    cake[:50] = (0.95, 0.93, 0.88)
    cake[100:112] = (0.9, 0.8, 0.7)
    cake *= 1 + 0.03 * np.random.default_rng(0).standard_normal((160, 200, 1)).astype(np.float32)
    assert remove_shading(cake.clip(0, 1), np.ones((160, 200), bool), None)[1] is None


def test_specular_spots_are_painted_over() -> None:
    image, mask = fruit()
    y, x = np.mgrid[:240, :240]
    spots = [(90, 100), (120, 150), (150, 90), (110, 60), (165, 140)]
    shiny = image.copy()
    for r, c in spots:
        shiny[np.hypot(y - r, x - c) < 3.2] = 1.0
    clean, note = remove_glints(shiny, mask)
    assert note is not None
    hurt = np.abs(shiny - image).max(-1) > 0.1
    changed = np.abs(clean - shiny).max(-1) > 0.01
    assert changed.sum() < 3 * hurt.sum()
    assert np.abs(clean - image)[hurt].mean() < 0.1 * np.abs(shiny - image)[hurt].mean()
    assert remove_glints(image, mask)[1] is None


# tint


def test_white_balance_to_a_known_truth() -> None:
    image, mask = fruit()
    tint = np.array([1.25, 1.0, 0.72])
    ground = np.full(3, 0.72)
    seen = linear_to_srgb(srgb_to_linear(on_ground(image, mask, ground)) * tint * 0.8)
    truth = linear_to_srgb(srgb_to_linear(image) * 0.8)
    white = tuple(float(v) for v in linear_to_srgb(srgb_to_linear(ground) * tint * 0.8))
    for option in ("auto", white):
        gains, source = white_gains(option, seen, mask)
        assert source
        assert np.allclose(gains, 1.0 / tint, rtol=0.03)
        photo = load_exemplar(seen, options=PhotoOptions(white=option, glints=False))
        inner = mask & photo.mask
        assert lab_error(photo.image, truth, inner) < 0.3 * lab_error(seen, truth, inner)
    assert np.allclose(white_gains(6504.0, seen, mask)[0], 1.0)
    warm = white_gains(3000.0, seen, mask)[0]
    assert warm[0] < 0.75  # the light of a bulb is red
    assert warm[2] > 2.0


def test_brown_flesh_and_strong_grounds_are_left_alone() -> None:
    image, mask = fruit()
    brown = image.copy()
    brown[60:180, 60:180] = brown[60:180, 60:180] * 0.3 + 0.7 * np.array([0.45, 0.3, 0.14])
    for ground in ((0.02, 0.02, 0.02), (0.1, 0.3, 0.9), (0.5, 0.5, 0.5)):
        seen = on_ground(brown, mask, np.array(ground))
        photo = load_exemplar(seen)
        assert lab_error(photo.image, brown, mask & photo.mask) < 0.2, ground


def test_the_skin_as_reference_only_where_it_is_the_same_skin() -> None:
    image, mask = fruit()
    tint = np.array([1.3, 1.0, 0.7])
    seen = linear_to_srgb(srgb_to_linear(image) * tint * 0.7)
    options = PhotoOptions(white="skin")
    rim = load_exemplar(image, mask, UNTOUCHED)
    skin = image[mask & (rim.depth < 3)]
    photo = with_skin(load_exemplar(seen, mask, options), skin)
    truth = linear_to_srgb(srgb_to_linear(image) * 0.7)
    assert lab_error(photo.image, truth, mask) < 0.4 * lab_error(seen, truth, mask)
    other = with_skin(load_exemplar(seen, mask, options), np.array([[0.2, 0.2, 0.8]]))
    assert "not the object's skin" in other.note
    assert np.abs(other.image - load_exemplar(seen, mask, options).image).max() == 0


# holes, stains, greyness


def test_a_cavity_of_the_core_is_painted_as_its_wall_and_seeds_stay() -> None:
    image, mask = fruit()
    y, x = np.mgrid[:240, :240]
    hole = np.hypot((y - 118) / 7.0, (x - 122) / 16.0) < 1
    open_ = image.copy()
    open_[hole] = 0.0
    for r, c in [(60, 120), (180, 120), (120, 185)]:
        open_[np.hypot(y - r, x - c) < 5] = (0.12, 0.05, 0.03)
    photo = load_exemplar(on_ground(open_, mask, np.zeros(3)), mask)
    assert "holes" in photo.note
    inside = rgb_to_lab(photo.image[hole])
    assert inside[:, 0].mean() > 20  # no soot
    assert np.hypot(inside[:, 1], inside[:, 2]).mean() > 15
    seeds = np.abs(open_ - image).max(-1) * ~hole > 0.3
    assert np.abs(photo.image - open_)[seeds].mean() < 0.02


def test_a_grey_stain_is_taken_out_and_said() -> None:
    image, mask = fruit()
    y, x = (np.mgrid[:240, :240] + 0.5) / 240 * 2 - 1
    flesh = mask & (np.hypot(x, y) < 0.65)
    stained = flesh & (np.hypot(x, y) > 0.35)
    grey = image.copy()
    grey[stained] = 0.25 * image[stained].mean(1, keepdims=True)
    done, note = remove_stain(grey, flesh)
    assert note is not None
    assert lab_error(done, image, stained) < 0.35 * lab_error(grey, image, stained)
    assert remove_stain(image, flesh)[1] is None
    plain = load_exemplar(grey, mask)
    assert np.abs(plain.image - grey)[stained].mean() < 0.01  # only when asked for


def test_a_grey_exemplar_is_called_grey_and_takes_a_palette_by_name() -> None:
    image, mask = fruit()
    grey = np.repeat(image.mean(-1, keepdims=True), 3, -1)
    photo = load_exemplar(grey, mask)
    assert "grey exemplar" in photo.note
    red = load_exemplar(grey, mask, PhotoOptions(palette="watermelon"))
    assert "preset watermelon" in red.note
    deep = mask & (photo.depth > 0.5 * photo.max_depth)
    lab = rgb_to_lab(red.image[deep])
    assert lab[:, 1].mean() > 30  # red flesh
    pattern = np.corrcoef(lab[:, 0], rgb_to_lab(grey[deep])[:, 0])[0, 1]
    assert pattern > 0.7  # of the photograph


@pytest.mark.parametrize("name", KNOWN_INTERIORS)
def test_clean_exemplars_are_not_changed(name: str) -> None:
    for size in (64, 96):
        for picture in known_interior(name, size, 1).exemplars().values():
            raw = load_exemplar(picture, options=UNTOUCHED)
            done = load_exemplar(picture)
            assert (raw.mask == done.mask).all()
            assert lab_error(done.image, raw.image, raw.mask) < 0.2


# files


def test_files_of_every_kind_are_read(tmp_path: Path) -> None:
    from PIL import Image

    image, mask = fruit(96)
    picture = Image.fromarray((on_ground(image, mask, np.ones(3)) * 255).astype(np.uint8))
    reference = load_exemplar(np.asarray(picture), options=UNTOUCHED)
    picture.save(tmp_path / "a.png")
    picture.convert("CMYK").save(tmp_path / "cmyk.tif")
    picture.convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "palette.png")
    for name in ("a.png", "cmyk.tif", "palette.png"):
        photo = load_exemplar(tmp_path / name, options=UNTOUCHED)
        assert overlap(photo.mask, reference.mask) > 0.95, name
        assert lab_error(photo.image, reference.image, reference.mask) < 6, name
    grey = np.asarray(picture.convert("L"))
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    deep = load_exemplar(tmp_path / "deep.png", options=UNTOUCHED)
    assert np.abs(deep.image[reference.mask][:, 0] - grey[reference.mask] / 255).max() < 0.01
    turned = picture.crop((0, 0, 96, 60))
    exif = turned.getexif()
    exif[0x0112] = 6
    turned.save(tmp_path / "turned.jpg", exif=exif)
    assert load_exemplar(tmp_path / "turned.jpg").mask.shape == (96, 60)
    wide = load_exemplar((np.asarray(picture).astype(np.uint16)) * 257, options=UNTOUCHED)
    assert lab_error(wide.image, reference.image, reference.mask) < 0.1


def test_broken_pictures_and_settings_are_refused_in_plain_words(tmp_path: Path) -> None:
    from PIL import Image

    image, mask = fruit(64)
    Image.fromarray((image * 255).astype(np.uint8)).save(tmp_path / "good.jpg")
    data = (tmp_path / "good.jpg").read_bytes()
    (tmp_path / "half.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("not a picture")
    for name in ("half.jpg", "empty.png", "text.png", "missing.png"):
        with pytest.raises(InputError, match=name):
            load_exemplar(tmp_path / name)
    spoiled = image.copy()
    spoiled[3, 4] = np.nan
    bad = [
        (spoiled, "NaN"),
        (image[:8], "8 pixels|64 x 8"),
        (image[..., 0], "shape"),
        (image * 255, "float means 0..1"),
        (np.zeros((0, 0, 3), np.float32), "0 x 0"),
        (image.astype(complex), "complex"),
    ]
    for value, words in bad:
        with pytest.raises(InputError, match=words):
            load_exemplar(value)
    with pytest.raises(InputError, match="mask"):
        load_exemplar(image, mask[:30])
    for options in (
        {"cutout": "magic"},
        {"white": "snow"},
        {"white": 12.0},
        {"white": (0.0, 1.0, 1.0)},
        {"palette": "moon"},
        {"shine": True},
    ):
        with pytest.raises(InputError):
            options_of(PhotoOptions, "photo", options)


def test_every_step_can_be_switched_off_and_lists_are_opened() -> None:
    image, mask = fruit()
    _, x = (np.mgrid[:240, :240] + 0.5) / 240 * 2 - 1
    dark = srgb_to_linear(on_ground(image, mask, np.full(3, 0.0)))
    lit = linear_to_srgb(dark * np.exp(0.5 * x)[..., None])
    on = load_exemplars([lit, lit], PhotoOptions(shading=True))[0][0]
    off = load_exemplars(
        {"x": lit}, options_of(PhotoOptions, "photo", {"shading": False, "glints": False})
    )[0][0]
    assert "shading" in on.note
    assert "shading" not in off.note
    assert np.abs(off.image - lit)[off.mask].max() < 1e-6


# real photographs


@pytest.mark.skipif(not EXEMPLARS.is_dir(), reason="no photographs at GSFLUENT_DATA")
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("apple_cross_sections/apple_cs_04.png", 0.70, 0.76),
        ("apple_cross_sections/apple_cs_15.png", 0.70, 0.80),
        ("pine_trunk/F02c.jpg", 0.55, 0.72),
        ("bread_crumb/white_control.jpg", 1.0, 1.0),
        ("marble_ambientcg/Marble006_1K_Color.jpg", 1.0, 1.0),
    ],
)
def test_real_photographs_give_sane_masks(name: str, low: float, high: float) -> None:
    photo = load_exemplar(EXEMPLARS / name)
    assert low <= photo.mask.mean() <= high
    assert photo.silhouette == (high < 1.0)
    if photo.silhouette:
        rows, columns = np.nonzero(photo.mask)
        center = np.array([rows.mean(), columns.mean()]) / photo.mask.shape
        assert np.abs(center - 0.5).max() < 0.08


@pytest.mark.skipif(not EXEMPLARS.is_dir(), reason="no photographs at GSFLUENT_DATA")
def test_the_iodine_of_the_real_apple_is_reported_and_goes_when_asked() -> None:
    path = EXEMPLARS / "apple_cross_sections" / "apple_cs_12.png"
    plain = load_exemplar(path)
    assert "stained?" in plain.note
    clean = load_exemplar(path, options=PhotoOptions(stain=True))
    lab = rgb_to_lab(clean.image[clean.mask])
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    assert (chroma < 8).mean() < 0.1
    assert np.median(lab[:, 0]) > 70
