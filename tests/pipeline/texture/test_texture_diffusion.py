"""The diffusion path, run for real on a tiny SD-XL inpainting pipeline with random weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from interior_shapes import ellipsoid_shell

from gsfluent.data import Solid
from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.pipeline.texture import Texture
from gsfluent.pipeline.texture.inpaint.diffusers import DiffusersInpainter, InpaintOptions

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

OPTIONS = InpaintOptions(slices=3, refine=(0.3,), size=64, steps=2, device="cpu")


@pytest.fixture(scope="session")
def model(tiny_sdxl: Path) -> Path:
    return tiny_sdxl


@pytest.fixture(scope="module")
def inpainter(model: Path) -> DiffusersInpainter:
    return DiffusersInpainter(model, OPTIONS)


@pytest.fixture(scope="module")
def solid() -> Solid:
    return Fill(20)(
        ellipsoid_shell(600, color=lambda p: torch.tensor([0.2, 0.5, 0.2]).expand_as(p).double())
    )


def _pictures(count: int = 2, height: int = 20, width: int = 27) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    images = rng.random((count, height, width, 3)).astype(np.float32)
    masks = np.zeros((count, height, width), bool)
    masks[:, 5:15, 6:20] = True
    return images, masks


def _call(inpainter: DiffusersInpainter, images: np.ndarray, masks: np.ndarray) -> np.ndarray:
    return inpainter(images, masks, prompt="flesh", strength=0.9, seeds=list(range(len(images))))


def test_known_pixels_come_back_exactly(inpainter: DiffusersInpainter) -> None:
    images, masks = _pictures()
    made = _call(inpainter, images, masks)
    assert made.shape == images.shape and made.dtype == np.float32
    assert np.array_equal(made[~masks], images[~masks])
    assert not np.allclose(made[masks], images[masks], atol=0.02)
    assert np.isfinite(made).all() and made.min() >= 0 and made.max() <= 1
    assert inpainter.name == "StableDiffusionXLInpaintPipeline"


def test_a_picture_does_not_depend_on_its_batch(
    inpainter: DiffusersInpainter, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, masks = _pictures(3)
    one = _call(inpainter, images, masks)
    monkeypatch.setattr(inpainter, "options", replace(OPTIONS, batch=3))
    assert np.abs(one - _call(inpainter, images, masks)).max() < 1e-4


def test_empty_mask_calls_no_model(inpainter: DiffusersInpainter) -> None:
    images, masks = _pictures()

    def refuse(**_: Any) -> None:
        raise AssertionError("the model was called")

    calls = inpainter.pipe
    inpainter.pipe = refuse
    try:
        assert np.array_equal(_call(inpainter, images, np.zeros_like(masks)), images)
    finally:
        inpainter.pipe = calls


def test_low_strength_gets_enough_steps_and_stays_closer(inpainter: DiffusersInpainter) -> None:
    images, masks = _pictures(1)
    far = inpainter(images, masks, prompt="x", strength=1.0, seeds=[1])
    # 0.1 x 2 steps would be no step at all; the adapter raises the number
    near = inpainter(images, masks, prompt="x", strength=0.1, seeds=[1])
    assert not np.array_equal(far[masks], near[masks])


def test_prompt_changes_the_result(inpainter: DiffusersInpainter) -> None:
    images, masks = _pictures(1)
    a = inpainter(images, masks, prompt="red flesh", strength=0.9, seeds=[1])
    b = inpainter(images, masks, prompt="grey concrete", strength=0.9, seeds=[1])
    assert not np.array_equal(a, b)


def test_two_stage_texture_end_to_end(model: Path, solid: Solid, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    stage = Texture(
        "diffusion", model=model, prompt="flesh", inpaint=OPTIONS, resume=tmp_path / "slices"
    )
    result = stage(solid, progress=lambda done, total, note: seen.append((done, total)))
    report = result.report
    assert report["method"] == "diffusion"
    assert report["slices"] == 3 + 3 * 3
    assert report["passes"] == 2 and report["resumed_slices"] == 0
    assert (12, 12) in seen
    assert result.color is not None and bool(torch.isfinite(result.color).all())
    surface = solid.gaussians.labels == 0
    assert torch.equal(result.gaussians.sh[surface], solid.gaussians.sh[surface])
    deep = result.occupancy & (result.depth > 0.6 * result.depth.max())
    assert float(result.color[deep].std()) > 1e-3
    # a second run finds every slice and gives the same volume
    again = stage(solid)
    assert again.report["resumed_slices"] == 12
    assert torch.equal(again.color, result.color)


def test_nan_and_black_pictures_are_errors(inpainter: DiffusersInpainter) -> None:
    images, masks = _pictures(1)

    class Broken:
        def __init__(self, value: float) -> None:
            self.value = value

        def __call__(self, **kind: Any) -> Any:
            class Output:
                images = np.full((1, kind["height"], kind["width"], 3), self.value, np.float32)

            return Output()

    working = inpainter.pipe
    try:
        for value in (float("nan"), 0.0):
            inpainter.pipe = Broken(value)
            with pytest.raises(RunError, match="NaN or a constant"):
                _call(inpainter, images, masks)
    finally:
        inpainter.pipe = working


def test_out_of_memory_halves_the_batch(
    inpainter: DiffusersInpainter, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, masks = _pictures(2)
    inner = inpainter.pipe
    sizes: list[int] = []

    def tight(**kind: Any) -> Any:
        sizes.append(len(kind["prompt"]))
        if len(kind["prompt"]) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return inner(**kind)

    monkeypatch.setattr(inpainter, "options", replace(OPTIONS, batch=2))
    monkeypatch.setattr(inpainter, "pipe", tight)
    _call(inpainter, images, masks)
    assert sizes == [2, 1, 1]


def test_model_errors(
    model: Path, solid: Solid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="not found"):
        Texture("diffusion", model=tmp_path / "nowhere", inpaint=OPTIONS)(solid)
    with pytest.raises(InputError, match="model_index"):
        Texture("diffusion", model=tmp_path, inpaint=OPTIONS)(solid)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    with pytest.raises(InputError, match="HF_HUB_OFFLINE=1"):
        Texture("diffusion", model="gsfluent-tests/no-such-model", inpaint=OPTIONS)(solid)
    with pytest.raises(InputError, match="has no NoSuchPipeline"):
        DiffusersInpainter(model, InpaintOptions(pipeline_class="NoSuchPipeline", device="cpu"))
    with pytest.raises(InputError, match="strength"):
        InpaintOptions(strength=0.0)
    with pytest.raises(InputError, match="refine"):
        InpaintOptions(refine=(0.2, 1.5))
    with pytest.raises(InputError, match="memory"):
        InpaintOptions(memory="tiny")
    with pytest.raises(InputError, match="dtype"):
        InpaintOptions(dtype="int8")


def test_missing_diffusers_is_named(monkeypatch: pytest.MonkeyPatch, model: Path) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(InputError, match=r"gsfluent\[inpaint\]"):
        DiffusersInpainter(model, OPTIONS)
