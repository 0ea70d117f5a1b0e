"""Known interiors: objects of a class differ and stay alike, and the judge obeys its laws."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from gsfluent.errors import InputError
from gsfluent.lab.truth.interiors import KNOWN_INTERIORS, KnownInterior, known_interior, upright
from gsfluent.lab.truth.interiors_judge import Judge, held_out_planes, judge, sample_plane
from gsfluent.pipeline.texture import load_exemplar
from gsfluent.pipeline.texture.baselines import color_copy

SIZE = 40


@cache
def _known(name: str, seed: int = 0) -> KnownInterior:
    return known_interior(name, SIZE, seed)


@cache
def _judge(name: str) -> Judge:
    return Judge(_known(name), [_known(name, 1)])


@pytest.mark.parametrize("name", KNOWN_INTERIORS)
def test_every_class_makes_whole_and_different_objects(name: str) -> None:
    one, two = _known(name), _known(name, 1)
    inside = one.domain.inside
    assert 0.05 < inside.mean() < 0.6
    # nothing touches the edge of the cube
    assert not any(np.take(inside, k, axis).any() for axis in range(3) for k in (0, -1))
    assert not np.array_equal(inside, two.domain.inside)
    assert np.isfinite(one.rgb).all() and one.rgb.min() >= 0 and one.rgb.max() <= 1
    assert one.rgb[~inside].max() == 0
    assert np.array_equal(one.rgb, known_interior(name, SIZE, 0).rgb)


@pytest.mark.parametrize("name", KNOWN_INTERIORS)
def test_the_method_is_given_the_surface_and_no_more(name: str) -> None:
    known = _known(name)
    shell = known.domain.shell
    assert np.array_equal(known.domain.skin[shell], known.rgb[shell])
    # every colour of the skin field is a colour of the shell
    colors = {tuple(c) for c in known.rgb[shell].tolist()}
    assert {tuple(c) for c in known.domain.skin.reshape(-1, 3).tolist()} <= colors


@pytest.mark.parametrize("name", KNOWN_INTERIORS)
def test_photographs_show_the_cut_upright(name: str) -> None:
    known = _known(name)
    for cut, picture in known.exemplars().items():
        axis, index = "xyz".index(cut), known.cuts[cut]
        assert picture.shape == (SIZE, SIZE, 4)
        loaded = load_exemplar(picture)
        assert loaded.silhouette
        # the last of the two axes is up: row 0 is its end
        first, last = np.take(known.domain.inside, index, axis)[:, [0, -1]].any(0)
        rows = picture[..., 3].any(1)
        assert (bool(rows[-1]), bool(rows[0])) == (first, last)
        assert np.array_equal(picture[SIZE - 1 - 9, 15, :3], np.take(known.rgb, index, axis)[15, 9])


def test_upright_puts_the_second_axis_up() -> None:
    plane = np.zeros((3, 4))
    plane[2, 3] = 1.0
    assert upright(plane)[0, 2] == 1.0


@pytest.mark.parametrize("name", KNOWN_INTERIORS)
def test_held_out_planes_avoid_the_photographs(name: str) -> None:
    known = _known(name)
    planes = held_out_planes(known)
    assert len(planes) == 12
    for point, u, v in planes:
        assert abs(u @ v) < 1e-9
        normal = np.abs(np.cross(u, v))
        if normal.max() > 1 - 1e-9:
            axis = int(normal.argmax())
            cut = known.cuts.get("xyz"[axis])
            assert cut is None or abs(point[axis] - 0.5 - cut) >= 3
        assert sample_plane(known.domain, known.rgb, (point, u, v))[1].sum() > 60


def test_an_axis_aligned_plane_is_the_slice_itself() -> None:
    known = _known("marble")
    point, u, v = held_out_planes(known)[0]
    image, mask = sample_plane(known.domain, known.rgb, (point, u, v))
    own = upright(known.rgb[int(point[0])])
    inside = upright(known.domain.inside[int(point[0])])
    assert mask.sum() == inside.sum()
    assert np.allclose(image[mask], own[inside], atol=1e-6)


@pytest.mark.parametrize("name", KNOWN_INTERIORS)
def test_the_truth_is_without_fault_and_the_floor_is_not(name: str) -> None:
    figures = _judge(name)(_known(name).rgb)
    for key in ("patch", "patch_coarse", "hist", "profile"):
        assert figures[key] == 0.0
        assert figures["floor"][key] > 0.0
    assert figures["sharp"] == figures["radial"] == 1.0
    assert figures["neighbour"] == [1.0, 1.0, 1.0]
    assert figures["coherence"] < 0.05 and figures["coverage"] < 0.05


def test_color_copy_is_far_off_where_the_skin_is_another_stuff() -> None:
    for name in ("watermelon", "bread", "cake", "orange"):
        figures = _judge(name)(color_copy(_known(name).domain).rgb)
        assert min(figures["ratio"]["patch"], figures["ratio"]["hist"]) > 3, name
        assert figures["profile"] > 0.05


def test_color_copy_of_marble_has_its_colours_but_runs_inward_in_streaks() -> None:
    figures = _judge("marble")(color_copy(_known("marble").domain).rgb)
    assert figures["ratio"]["hist"] < 1.3
    assert figures["radial"] < 0.7


def test_blur_and_noise_are_seen() -> None:
    from scipy import ndimage

    known = _known("marble")
    # outside stands the nearest skin: black would make an edge of its own
    whole = np.where(known.domain.inside[..., None], known.rgb, known.domain.skin)
    blurred = ndimage.gaussian_filter(whole, (1.5, 1.5, 1.5, 0))
    noisy = known.rgb + 0.05 * np.random.default_rng(0).standard_normal(known.rgb.shape)
    soft, rough = (_judge("marble")(v.clip(0, 1)) for v in (blurred, noisy))
    assert soft["sharp"] < 0.8 < 1.2 < rough["sharp"]
    assert min(rough["neighbour"]) > 1.1


def test_judge_takes_one_other_or_several() -> None:
    known, other = _known("wood"), _known("wood", 1)
    rgb = color_copy(known.domain).rgb
    alone = judge(rgb, known, other)
    assert alone == judge(rgb, known, [other])
    assert alone["ratio"]["patch"] == alone["patch"] / alone["floor"]["patch"]


def test_wood_runs_along_z_and_cake_lies_in_layers() -> None:
    from gsfluent.pipeline.texture.photo.metrics import neighbour_change

    wood, cake = (_known(n) for n in ("wood", "cake"))
    along = neighbour_change(wood.rgb, wood.domain.inside)
    assert along[2] < 0.6 * min(along[:2])
    deep = cake.domain.depth > 3
    height = neighbour_change(cake.rgb, deep)
    assert height[2] > 1.1 * max(height[:2])


def test_bad_requests_say_what_is_there() -> None:
    with pytest.raises(InputError, match="watermelon"):
        known_interior("granite")
    with pytest.raises(InputError, match="voxels"):
        known_interior("wood", 8)
