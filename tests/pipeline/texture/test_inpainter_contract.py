"""What holds for every slice inpainter, whoever is behind it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.texture.inpaint.command import CommandInpainter
from gsfluent.pipeline.texture.inpaint.inpainter import Inpainter, Job, SliceContext
from gsfluent.pipeline.texture.inpaint.local import (
    ColorDiffusionInpainter,
    ExemplarInpainter,
    TeleaInpainter,
)
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions
from gsfluent.pipeline.texture.inpaint.tiles import TiledInpainter
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, load_exemplar

# fills holes with a colour made of the seed and the reference; counts its runs in a file
PROGRAM = """
import json, pathlib, sys
import numpy as np
from PIL import Image
folder = pathlib.Path(sys.argv[1])
meta = json.loads((folder / "meta.json").read_text())
with open(sys.argv[2], "a") as log:
    log.write(json.dumps(meta) + "\\n")
rng = np.random.default_rng(meta["seed"])
tone = rng.integers(0, 255, 3)
if meta["reference"]:
    tone = np.asarray(Image.open(folder / "inpainted" / "0000.png")).reshape(-1, 3).mean(0)
for k in range(meta["frames"]):
    image = np.asarray(Image.open(folder / "images" / f"{k:04d}.png")).copy()
    hole = np.asarray(Image.open(folder / "masks" / f"{k:04d}.png")) [..., 0] > 127
    image[hole] = tone
    image[~hole] = 255 - image[~hole]
    Image.fromarray(image.astype(np.uint8)).save(folder / "out" / f"{k:04d}.png")
"""


def photo() -> Exemplar:
    """A round cut: green rind, red inside with some structure."""
    row, column = np.mgrid[:80, :80]
    radius = np.hypot(row - 40, column - 40)
    image = np.empty((80, 80, 4), np.float32)
    image[...] = (0.8, 0.2, 0.2, 1.0)
    image[..., 1] += 0.15 * np.sin(row / 3.0) * np.cos(column / 4.0)
    image[radius > 30] = (0.1, 0.5, 0.1, 1.0)
    image[radius > 36, 3] = 0.0
    return load_exemplar(image)


def program(folder: Path) -> str:
    script = folder / "model.py"
    script.write_text(PROGRAM)
    return f'"{sys.executable}" "{script}" {{folder}} "{folder / "runs.txt"}"'


def diffusers(folder: Path, model: Path) -> Inpainter:
    from gsfluent.pipeline.texture.inpaint.diffusers import DiffusersInpainter

    return DiffusersInpainter(model, InpaintOptions(size=64, steps=2, device="cpu"))


MAKERS: dict[str, Callable[[Path], Inpainter]] = {
    "telea": lambda folder: TeleaInpainter(),
    "ns": lambda folder: TeleaInpainter(method="ns"),
    "color": lambda folder: ColorDiffusionInpainter(),
    "exemplar": lambda folder: ExemplarInpainter(photo()),
    "command": lambda folder: CommandInpainter(program(folder), window=3, overlap=1),
    "tiled": lambda folder: TiledInpainter(ExemplarInpainter(photo()), 2),
}


@pytest.fixture(scope="module", params=[*MAKERS, "diffusers"])
def inpainter(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Inpainter:
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "diffusers":
        return diffusers(folder, request.getfixturevalue("tiny_sdxl"))
    return MAKERS[request.param](folder)


def slices(count: int = 4, height: int = 21, width: int = 27) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    images = rng.random((count, height, width, 3)).astype(np.float32)
    masks = np.zeros((count, height, width), bool)
    masks[:, 4:16, 6:20] = True
    return images, masks


def context(masks: np.ndarray) -> SliceContext:
    inside = np.zeros_like(masks)
    inside[:, 2:18, 4:22] = True
    depth = np.zeros(masks.shape, np.float32)
    depth[:, 2:18, 4:22] = 3.0
    return SliceContext(0, tuple(range(len(masks))), 1.0, inside, depth, 8.0)


def call(inpainter: Inpainter, images: np.ndarray, masks: np.ndarray, **more: Any) -> np.ndarray:
    more = {"prompt": "flesh", "strength": 0.9, "context": context(masks), **more}
    return inpainter(images, masks, **{"seeds": list(range(len(images))), **more})


def test_known_pixels_come_back_exactly(inpainter: Inpainter) -> None:
    images, masks = slices()
    before = images.copy()
    made = call(inpainter, images, masks)
    assert isinstance(inpainter, Inpainter)
    assert made.shape == images.shape and made.dtype == np.float32
    assert np.array_equal(made[~masks], images[~masks])
    assert np.array_equal(images, before)  # what came in is not written to
    assert np.isfinite(made).all() and made.min() >= 0 and made.max() <= 1
    assert np.abs(made[masks] - images[masks]).mean() > 0.01


def test_odd_sizes_work_without_seeds_and_context(inpainter: Inpainter) -> None:
    images, masks = slices(3, 19, 33)
    images, masks = images[:, :, :31], masks[:, :, :31]
    made = inpainter(images, masks, prompt="flesh")
    assert made.shape == images.shape and np.isfinite(made).all()
    assert np.array_equal(made[~masks], images[~masks])


def test_a_hole_of_one_pixel(inpainter: Inpainter) -> None:
    images, _ = slices(2, 40, 40)
    masks = np.zeros((2, 40, 40), bool)
    masks[:, 11, 17] = True
    where = SliceContext(0, (0, 1), 1.0, np.ones_like(masks), np.full(masks.shape, 2.0), 8.0)
    made = call(inpainter, images, masks, context=where)
    assert np.isfinite(made).all() and np.array_equal(made[~masks], images[~masks])


def test_empty_mask_calls_no_model(inpainter: Inpainter, monkeypatch: pytest.MonkeyPatch) -> None:
    images, masks = slices()

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("the model was called")

    inner = inpainter.inner if isinstance(inpainter, TiledInpainter) else inpainter
    monkeypatch.setattr(type(inner), "paint", refuse)
    assert np.array_equal(call(inpainter, images, np.zeros_like(masks)), images)
    with pytest.raises(AssertionError, match="was called"):
        call(inpainter, images, masks)


def test_same_seeds_same_result(inpainter: Inpainter) -> None:
    images, masks = slices()
    assert np.array_equal(call(inpainter, images, masks), call(inpainter, images, masks))


def test_order_and_company_do_not_matter(inpainter: Inpainter) -> None:
    images, masks = slices()
    if inpainter.sequential or isinstance(inpainter, TiledInpainter):
        pytest.skip("neighbours are meant to matter here")
    whole = call(inpainter, images, masks)
    order = [2, 0, 3, 1]
    where = context(masks).take(order)
    mixed = call(inpainter, images[order], masks[order], seeds=order, context=where)
    assert np.abs(mixed - whole[order]).max() < 1e-4
    alone = call(inpainter, images[2:3], masks[2:3], seeds=[2], context=context(masks).take([2]))
    assert np.abs(alone[0] - whole[2]).max() < 1e-4


def test_slices_without_a_hole_stay_among_others(inpainter: Inpainter) -> None:
    images, masks = slices()
    masks[1] = False
    made = call(inpainter, images, masks)
    assert np.array_equal(made[1], images[1])
    assert not np.array_equal(made[0], images[0])


def test_wrong_shapes_are_refused() -> None:
    images, masks = slices()
    with pytest.raises(ValueError, match="mask"):
        TeleaInpainter()(images, masks[:2])
    with pytest.raises(ValueError, match="seeds"):
        TeleaInpainter()(images, masks, seeds=[1])
    with pytest.raises(ValueError, match="strength"):
        TeleaInpainter()(images, masks, strength=0.0)


def test_color_diffusion_is_harmonic() -> None:
    # x, y and xy have the discrete mean-value property: they come back whatever the hole
    y, x = np.mgrid[:20, :30].astype(np.float32)
    image = np.stack([x / 30, y / 20, x * y / 600], -1)[None].astype(np.float32)
    hole = np.zeros((1, 20, 30), bool)
    hole[0, 3:15, 4:26] = True
    hole[0, 6:9, 8:12] = False
    start = np.where(hole[..., None], 0.5, image).astype(np.float32)
    made = ColorDiffusionInpainter()(start, hole)
    assert np.abs(made - image).max() < 1e-5


def test_exemplar_patches_follow_depth() -> None:
    """Near the outline the photograph's rind appears, inside its flesh."""
    row, column = np.mgrid[:40, :40]
    radius = np.hypot(row - 20, column - 20)
    inside = (radius < 18)[None]
    depth = np.where(inside, 18 - radius, 0).astype(np.float32)
    hole = inside & (depth > 1.5)
    image = np.full((1, 40, 40, 3), 0.5, np.float32)
    image[inside] = (0.1, 0.5, 0.1)
    where = SliceContext(0, (0,), 1.0, inside, depth, 18.0)
    made = ExemplarInpainter()(image, hole, exemplar=photo(), seeds=[3], context=where)
    rind = made[hole & (depth < 2.5)].mean(0)
    flesh = made[hole & (depth > 6)].mean(0)
    assert rind[1] > rind[0] and flesh[0] > 0.6 and flesh[1] < 0.35
    with pytest.raises(InputError, match="exemplar photograph"):
        ExemplarInpainter()(image, hole)


def test_tiles_show_neighbours_on_one_canvas() -> None:
    seen: list[tuple[int, ...]] = []

    class Watch(TeleaInpainter):
        def paint(self, job: Job) -> np.ndarray:
            seen.append(job.slices.shape)
            assert job.context.inside is not None
            assert job.context.inside.shape == job.mask.shape
            return super().paint(job)

    images, masks = slices(7)
    made = call(TiledInpainter(Watch(), 2), images, masks)
    # 7 slices of 21 x 27: two canvases of 2 x 2 cells of 24 x 32
    assert seen == [(2, 48, 64, 3)]
    plain = call(TeleaInpainter(), images, masks)
    assert np.abs(made - plain).max() < 1e-6  # Telea looks 3 pixels far: cells are apart


def test_command_windows_and_references(tmp_path: Path) -> None:
    import json

    images, masks = slices(8)
    command = CommandInpainter(
        program(tmp_path), window=4, overlap=2, folder=tmp_path / "w", first=TeleaInpainter()
    )
    made = call(command, images, masks)
    log = [json.loads(line) for line in (tmp_path / "runs.txt").read_text().splitlines()]
    assert [m["offsets"] for m in log] == [[0, 1, 2, 3], [2, 3, 4, 5], [4, 5, 6, 7]]
    assert all(m["reference"] and m["axis"] == "x" for m in log)
    # the first slice is Telea's; the tone of later ones comes down through the references
    assert np.array_equal(made[0], call(TeleaInpainter(), images, masks)[0])
    window = sorted((tmp_path / "w").iterdir())[0]
    assert {p.name for p in window.iterdir()} >= {"images", "masks", "inpainted", "prompt.txt"}
    assert (window / "prompt.txt").read_text() == "flesh\n"
    # finished windows are found again
    again = CommandInpainter(
        program(tmp_path), window=4, overlap=2, folder=tmp_path / "w", first=TeleaInpainter()
    )
    assert np.array_equal(call(again, images, masks), made) and again.runs == 0


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("raise SystemExit('no GPU here')", "no GPU here"),
        ("", "0 pictures for 4 slices"),
        ("Image.new('RGB', (5, 5)).save(out / '0000.png')", "is missing"),
        ("[Image.new('RGB', (5, 5)).save(out / f'{k:04d}.png') for k in range(4)]", "5 x 5 pixels"),
        ("[(out / f'{k:04d}.png').write_text('x') for k in range(4)]", "not a picture"),
        ("[Image.new('RGB', (27, 21)).save(out / f'{k:04d}.png') for k in range(5)]", "too many"),
    ],
)
def test_command_answers_are_checked(tmp_path: Path, body: str, message: str) -> None:
    script = tmp_path / "model.py"
    script.write_text(
        "import pathlib, sys\nfrom PIL import Image\n"
        f"out = pathlib.Path(sys.argv[1]) / 'out'\n{body}\n"
    )
    images, masks = slices()
    with pytest.raises(RunError, match=message):
        call(CommandInpainter(f"{sys.executable} {script} {{folder}}"), images, masks)


def test_command_that_cannot_start() -> None:
    images, masks = slices()
    with pytest.raises(InputError, match="command not found"):
        call(CommandInpainter("/nowhere/model {folder}"), images, masks)
    with pytest.raises(InputError, match=r"\{folder\}"):
        CommandInpainter("model")
    with pytest.raises(InputError, match="overlap"):
        CommandInpainter("model {folder}", window=4, overlap=4)
    slow = f'{sys.executable} -c "import time, sys; time.sleep(30)" {{folder}}'
    with pytest.raises(RunError, match=r"longer than 0\.2 s"):
        call(CommandInpainter(slow, timeout=0.2), images, masks)
