"""Segmentations of photographs: every form, names, sizes, run lengths, and what is refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gsfluent.data import Camera, Capture
from gsfluent.errors import InputError
from gsfluent.io.segmentation.masks import load_masks, load_segmentation
from gsfluent.io.segmentation.sam import decode_rle

H, W = 12, 16


def capture(*names: str, distortion: tuple[float, ...] = ()) -> Capture:
    cameras = [
        Camera.look_at((2, 0, 0), (0, 0, 0), width=W, height=H, name=name).replace(
            distortion=distortion
        )
        for name in names or ("images/a.jpg", "images/b.jpg", "images/c.jpg")
    ]
    return Capture(cameras, torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), Path("."))


def labels() -> np.ndarray:
    """Two parts: 1 on the left, 2 a block on the right."""
    found = np.zeros((H, W), np.int32)
    found[:, :6], found[3:9, 8:14] = 1, 2
    return found


def png(path: Path, values: np.ndarray, palette: list[int] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(values)
    if palette is not None:
        image = image.convert("L")
        image.putpalette(palette)
    image.save(path)
    return path


def colored(values: np.ndarray) -> np.ndarray:
    return np.array([[0, 0, 0], [200, 30, 30], [30, 30, 200]], np.uint8)[values]


@pytest.mark.parametrize("form", ["grey", "grey16", "indexed", "color", "alpha", "npy"])
def test_label_images_of_every_kind(tmp_path: Path, form: str) -> None:
    truth = labels()
    if form == "grey":
        png(tmp_path / "a.png", truth.astype(np.uint8))
    elif form == "grey16":
        png(tmp_path / "a.png", (truth * 300).astype(np.uint16))
    elif form == "indexed":
        png(tmp_path / "a.png", truth.astype(np.uint8), [0, 0, 0, 200, 30, 30, 30, 30, 200])
    elif form == "color":
        png(tmp_path / "a.png", colored(truth))
    elif form == "alpha":
        solid = np.where(truth > 0, 255, 0).astype(np.uint8)[..., None]
        shown = np.where(truth[..., None] > 0, colored(truth), 90).astype(np.uint8)
        png(tmp_path / "a.png", np.concatenate([shown, solid], -1))
    else:
        np.save(tmp_path / "a.npy", truth)
    found = load_segmentation(tmp_path, capture())
    (view,) = found.views
    assert view.camera.name == "images/a.jpg" and found.linked
    names = {"grey16": ["300", "600"], "color": ["#1e1ec8", "#c81e1e"]}
    wanted = names["color"] if form in ("color", "alpha") else names.get(form, ["1", "2"])
    assert list(found.names.values()) == wanted
    first, second = wanted if form not in ("color", "alpha") else reversed(wanted)
    assert np.array_equal(view.labels == found.number(first), truth == 1)
    assert np.array_equal(view.labels == found.number(second), truth == 2)
    assert any("2 of 3 photographs have no labels" in note for note in found.notes)


def test_indices_with_other_palettes_are_colours(tmp_path: Path) -> None:
    truth = labels().astype(np.uint8)
    png(tmp_path / "a.png", truth, [0, 0, 0, 200, 30, 30, 30, 30, 200])
    swapped = np.array([2, 0, 1], np.uint8)[truth]  # index 0 is a part here, black is index 2
    png(tmp_path / "b.png", swapped, [200, 30, 30, 30, 30, 200, 0, 0, 0])
    first, second = load_segmentation(tmp_path, capture()).views
    assert np.array_equal(first.labels, second.labels) and set(np.unique(first.labels)) == {0, 1, 2}


def test_numbers_get_names_and_maps_of_another_size_are_resized(tmp_path: Path) -> None:
    png(tmp_path / "a.png", np.kron(labels(), np.ones((2, 2))).astype(np.uint8))
    (tmp_path / "labels.json").write_text('{"1": "rind", "2": "leaf"}')
    found = load_segmentation(tmp_path, capture(), max_size=W)
    assert found.number("leaf") == 2 == found.number(2) and found.names == {1: "rind", 2: "leaf"}
    assert np.array_equal(found.views[0].labels, labels())
    assert found.views[0].camera.width == W
    assert any("another size" in note for note in found.notes)
    with pytest.raises(InputError, match="no label 'stem'"):
        found.number("stem")


@pytest.mark.parametrize(
    "name", ["a.png", "a.jpg.png", "a_mask.png", "images/a.png", "a-label.png"]
)
def test_file_names_that_mean_a_photograph(tmp_path: Path, name: str) -> None:
    png(tmp_path / name, labels().astype(np.uint8))
    assert load_segmentation(tmp_path, capture()).views[0].camera.name == "images/a.jpg"


def test_names_that_two_photographs_share_need_the_folder(tmp_path: Path) -> None:
    two = capture("cam1/0.jpg", "cam2/0.jpg")
    png(tmp_path / "cam2" / "0.png", labels().astype(np.uint8))
    assert load_segmentation(tmp_path, two).views[0].camera.name == "cam2/0.jpg"
    png(tmp_path / "flat" / "0.png", labels().astype(np.uint8))
    with pytest.raises(InputError, match="named like a photograph"):
        load_segmentation(tmp_path / "flat", two)


def test_a_folder_of_masks_per_label(tmp_path: Path) -> None:
    truth = labels()
    for number, name in ((1, "rind"), (2, "leaf")):
        for view in "ab":
            mask = truth == number
            if name == "leaf" and view == "b":
                mask = mask | (truth == 1) & (np.arange(H) < 2)[:, None]  # claims what is rind's
            png(tmp_path / name / f"{view}.png", 255 * mask.astype(np.uint8))
    found = load_segmentation(tmp_path, capture())
    first, second = found.views
    number = [0, found.number("rind"), found.number("leaf")]
    assert np.array_equal(first.labels, np.array(number)[truth])
    assert (second.labels[:2, :6] == -1).all() and any("several" in n for n in found.notes)


@pytest.mark.parametrize("kind", ["white", "one", "alpha", "grey", "npy"])
def test_masks_of_one_part(tmp_path: Path, kind: str) -> None:
    mask = labels() == 2
    if kind == "npy":
        np.save(tmp_path / "a.npy", mask)
    elif kind == "alpha":
        grey = np.full((H, W, 3), 120, np.uint8)
        png(tmp_path / "a.png", np.concatenate([grey, 255 * mask[..., None].astype(np.uint8)], -1))
    else:
        top = {"white": 255, "one": 1, "grey": 200}[kind]
        png(tmp_path / "a.png", top * mask.astype(np.uint8))
    found = load_masks(tmp_path, capture())
    assert np.array_equal(found.views[0].labels == 1, mask) and found.names == {1: tmp_path.name}


def test_numpy_stacks(tmp_path: Path) -> None:
    stack = np.stack([labels()] * 3)
    np.save(tmp_path / "all.npy", stack)
    assert len(load_segmentation(tmp_path / "all.npy", capture()).views) == 3
    np.savez(tmp_path / "some.npz", b=labels())
    (view,) = load_segmentation(tmp_path / "some.npz", capture()).views
    assert view.camera.name == "images/b.jpg" and np.array_equal(view.labels, labels())
    np.save(tmp_path / "two.npy", stack[:2])
    with pytest.raises(InputError, match=r"\[3 views, H, W\]"):
        load_segmentation(tmp_path / "two.npy", capture())


def test_undistorted_maps_keep_whole_labels_and_tell_what_is_not_covered(tmp_path: Path) -> None:
    lens = capture("a.jpg", distortion=(0.4, 0.0, 0.0, 0.0))
    png(tmp_path / "a.png", labels().astype(np.uint8))
    (view,) = load_segmentation(tmp_path, lens).views
    assert view.camera.distortion == () and set(np.unique(view.labels)) <= {-1, 0, 1, 2}
    assert (view.labels == 2).any()


# Run-length codes: the text of a 9 x 10 mask that pycocotools documents, and its lengths.
KNOWN = {"size": [9, 10], "counts": "61X13mN000`0"}
LENGTHS = [6, 1, 40, 4, 5, 4, 5, 4, 21]


def encode_rle(mask: np.ndarray, *, compressed: bool = True) -> dict[str, Any]:
    """A mask [H, W] as pycocotools writes it."""
    flat = np.asarray(mask, bool).T.reshape(-1)
    change = np.flatnonzero(np.diff(flat.astype(np.int8))) + 1
    edges = np.concatenate([[0], change, [flat.size]])
    lengths = np.diff(edges).tolist()
    if flat.size and flat[0]:
        lengths = [0, *lengths]
    size = [int(n) for n in mask.shape]
    if not compressed:
        return {"size": size, "counts": [int(n) for n in lengths]}
    text = []
    for index, length in enumerate(lengths):
        rest = int(length) - (int(lengths[index - 2]) if index > 2 else 0)
        more = True
        while more:
            digit = rest & 31
            rest >>= 5
            more = rest != (-1 if digit & 16 else 0)
            text.append(chr(48 + (digit | (32 if more else 0))))
    return {"size": size, "counts": "".join(text)}


def test_known_run_lengths_are_read_and_written() -> None:
    mask = decode_rle(KNOWN)
    assert np.array_equal(mask, decode_rle({"size": [9, 10], "counts": LENGTHS}))
    flat = np.repeat([0, 1, 0, 1, 0, 1, 0, 1, 0], LENGTHS)
    assert np.array_equal(mask, flat.reshape(10, 9).T.astype(bool))  # down the columns
    assert encode_rle(mask) == KNOWN
    assert encode_rle(mask, compressed=False)["counts"] == LENGTHS


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_run_lengths_go_round(seed: int, compressed: bool) -> None:
    rng = np.random.default_rng(seed)
    size = tuple(int(n) for n in rng.integers(1, 70, 2))
    coarse = rng.random((size[0] // 5 + 1, size[1] // 5 + 1)) < rng.random()
    mask = np.kron(coarse, np.ones((5, 5)))[: size[0], : size[1]] > 0
    assert np.array_equal(decode_rle(json.loads(json.dumps(
        encode_rle(mask, compressed=compressed)))), mask)  # fmt: skip


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ({"size": [9, 10], "counts": LENGTHS[:-1]}, "add up to 69 pixels"),
        ({"size": [10, 10], "counts": "61X13mN000`0"}, "add up to 90"),
        ({"size": [9, 10], "counts": "61X13mN000`"}, "cut short"),
        ({"size": [9, 10], "counts": [-6, 96]}, "add up"),
        ({"size": [9], "counts": LENGTHS}, "height, width"),
        ({"size": [9, 10], "counts": [6.5, 83.5]}, "whole numbers"),
        ({"counts": LENGTHS}, "'size' and 'counts'"),
        ([[1, 2, 3]], "'size' and 'counts'"),
    ],
)
def test_run_lengths_that_do_not_add_up(code: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        decode_rle(code)


def annotations(*masks: np.ndarray, **more: Any) -> list[dict[str, Any]]:
    return [
        {
            "segmentation": encode_rle(mask), "area": int(mask.sum()), "bbox": [0, 0, 1, 1],
            "predicted_iou": 0.9, "stability_score": 0.95, **more,
        }
        for mask in masks
    ]  # fmt: skip


def test_sam_json_in_its_forms(tmp_path: Path) -> None:
    truth = labels()
    items = annotations(truth > -1, truth == 1, truth == 2)  # the whole, and two on top of it
    coco = {
        "images": [{"id": 7, "file_name": "a.jpg"}],
        "annotations": [{**item, "image_id": 7} for item in items],
    }
    forms: dict[str, Any] = {
        "a.json": items,
        "one.json": {"image": {"file_name": "a.jpg"}, "annotations": items},
        "map.json": {"a": items},
        "coco.json": coco,
    }
    for name, value in forms.items():
        folder = tmp_path / name.removesuffix(".json")
        folder.mkdir()
        (folder / name).write_text(json.dumps(value))
        for path in (folder, folder / name):
            found = load_segmentation(path, capture())
            assert not found.linked
            (view,) = found.views
            assert view.camera.name == "images/a.jpg"
            assert np.array_equal(view.labels, np.array([1, 2, 3])[truth])


def test_coco_categories_are_labels(tmp_path: Path) -> None:
    truth = labels()
    first, second = annotations(truth == 1), annotations(truth == 2)
    data = {
        "images": [{"id": 1, "file_name": "a.jpg"}, {"id": 2, "file_name": "b.jpg"}],
        "categories": [{"id": 5, "name": "rind"}, {"id": 6, "name": "leaf"}],
        "annotations": [
            {**first[0], "image_id": 1, "category_id": 5},
            {**second[0], "image_id": 1, "category_id": 6},
            {**second[0], "image_id": 2, "category_id": 6},
        ],
    }
    (tmp_path / "coco.json").write_text(json.dumps(data))
    found = load_segmentation(tmp_path / "coco.json", capture())
    assert found.linked and sorted(found.names.values()) == ["leaf", "rind"]
    one, two = found.views
    assert np.array_equal(one.labels == found.number("rind"), truth == 1)
    assert np.array_equal(two.labels == found.number("leaf"), truth == 2)
    data["annotations"][0]["image_id"] = 9
    (tmp_path / "coco.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="belongs to no image"):
        load_segmentation(tmp_path / "coco.json", capture())


def test_sam_folders(tmp_path: Path) -> None:
    truth = labels()
    folder = tmp_path / "a"
    for index, mask in enumerate((truth == 1, truth == 2, truth > -1)):
        png(folder / f"{index}.png", 255 * mask.astype(np.uint8))
    wanted = np.array([3, 1, 2])[truth]
    assert np.array_equal(load_segmentation(tmp_path, capture()).views[0].labels, wanted)
    with (folder / "metadata.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["id", "area", "predicted_iou", "stability_score"])
        writer.writeheader()
        for index, score in enumerate((0.9, 0.95, 0.4)):
            row = {"id": index, "area": 1, "predicted_iou": score, "stability_score": 0.99}
            writer.writerow(row)
    found = load_segmentation(tmp_path, capture())
    assert not found.linked and np.array_equal(found.views[0].labels, wanted)
    good = load_segmentation(tmp_path, capture(), least=0.5).views[0].labels
    assert np.array_equal(good, truth)  # the poor mask of everything is left out
    (folder / "1.png").unlink()
    with pytest.raises(InputError, match=r"1\.png"):
        load_segmentation(tmp_path, capture())


def broken(tmp_path: Path, kind: str) -> Path:
    truth = labels()
    if kind == "missing":
        return tmp_path / "nowhere"
    if kind == "no match":
        png(tmp_path / "z.png", truth.astype(np.uint8))
    elif kind == "size":
        png(tmp_path / "a.png", np.ones((W, W), np.uint8))
    elif kind == "empty file":
        (tmp_path / "a.png").write_bytes(b"")
    elif kind == "truncated":
        noise = np.random.default_rng(0).integers(0, 3, (200, 200)).astype(np.uint8)
        data = png(tmp_path / "a.png", noise).read_bytes()
        (tmp_path / "a.png").write_bytes(data[: len(data) // 2])
    elif kind == "text":
        (tmp_path / "a.png").write_text("no picture")
    elif kind == "jpeg":
        png(tmp_path / "a.jpg", colored(truth))
    elif kind == "photograph":
        png(tmp_path / "a.png", np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8))
    elif kind == "nothing":
        png(tmp_path / "a.png", np.zeros((H, W), np.uint8))
    elif kind == "nan":
        np.save(tmp_path / "a.npy", np.where(truth > 0, truth, np.nan))
    elif kind == "fraction":
        np.save(tmp_path / "a.npy", truth + 0.5)
    elif kind == "negative":
        np.save(tmp_path / "a.npy", -truth)
    elif kind == "npz":
        (tmp_path / "all.npz").write_bytes(b"PK no archive")
        return tmp_path / "all.npz"
    elif kind == "json":
        (tmp_path / "a.json").write_text('[{"segmentation"')
    elif kind == "area":
        (tmp_path / "a.json").write_text(json.dumps(annotations(truth == 1, area=3)))
    elif kind == "score":
        (tmp_path / "a.json").write_text(
            json.dumps(annotations(truth == 1, predicted_iou=float("nan")))
        )
    elif kind == "names":
        png(tmp_path / "a.png", truth.astype(np.uint8))
        (tmp_path / "labels.json").write_text("[1, 2]")
    elif kind == "twice":
        png(tmp_path / "a.png", truth.astype(np.uint8))
        png(tmp_path / "a_mask.png", truth.astype(np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("missing", "no such segmentation"),
        ("empty folder", "is empty"),
        ("no match", "files: z.png; photographs: images/a.jpg"),
        ("size", "16 x 16, the photograph is 16 x 12"),
        ("empty file", "is empty"),
        ("truncated", "damaged"),
        ("text", "not an image"),
        ("jpeg", "JPEG"),
        ("photograph", "are no labels"),
        ("nothing", "nothing is labelled"),
        ("nan", "NaN"),
        ("fraction", "whole"),
        ("negative", "negative"),
        ("npz", "damaged"),
        ("json", "not readable as JSON"),
        ("area", "says area 3"),
        ("score", "NaN"),
        ("names", "mapping"),
        ("twice", "both mean"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path: Path, kind: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_segmentation(broken(tmp_path, kind), capture())


def test_smoothed_outlines_of_colours_count_as_nothing(tmp_path: Path) -> None:
    import cv2

    truth = np.kron(labels(), np.ones((40, 40), np.int32))
    smooth = cv2.GaussianBlur(colored(truth), (0, 0), 1.5)
    png(tmp_path / "a.png", smooth)
    found = load_segmentation(tmp_path, capture())
    assert sorted(found.names.values()) == ["#1e1ec8", "#c81e1e"]
    assert any("smoothed" in note for note in found.notes)
