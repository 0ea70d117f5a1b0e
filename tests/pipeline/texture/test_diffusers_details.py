"""What users of diffusers trip on: each handled, or explained. Random weights throughout."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.texture.inpaint.diffusers import DiffusersInpainter, _Frame
from gsfluent.pipeline.texture.inpaint.diffusers_load import (
    _pipeline_class,
    dtype_argument,
    load_pipeline,
    offline_asked,
)
from gsfluent.pipeline.texture.inpaint.inpainter import SliceContext
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, load_exemplar

diffusers = pytest.importorskip("diffusers")
pytest.importorskip("transformers")

OPTIONS = InpaintOptions(size=64, steps=2, device="cpu")


def slices(count: int = 2) -> tuple[np.ndarray, np.ndarray, SliceContext]:
    rng = np.random.default_rng(0)
    images = rng.random((count, 20, 27, 3)).astype(np.float32)
    masks = np.zeros((count, 20, 27), bool)
    masks[:, 5:15, 6:20] = True
    depth = np.zeros(masks.shape, np.float32)
    depth[:, 3:17, 4:22] = np.linspace(0.5, 5, 18, dtype=np.float32)
    return images, masks, SliceContext(0, tuple(range(count)), 1.0, depth > 0, depth, 6.0)


def photo(red: float = 0.9) -> Exemplar:
    image = np.full((40, 40, 3), 0.1, np.float32)
    image[..., 0] = red
    image[::4] = 0.5
    return load_exemplar(image)


def paint(inpainter: DiffusersInpainter, count: int = 2, **more: Any) -> np.ndarray:
    images, masks, context = slices(count)
    given = {"prompt": "flesh", "strength": 0.9, "seeds": list(range(count)), "context": context}
    made = inpainter(images, masks, **{**given, **more})
    assert np.array_equal(made[~masks], images[~masks]) and np.isfinite(made).all()
    return made


@pytest.fixture(scope="module")
def xl(tiny_sdxl: Path) -> DiffusersInpainter:
    return DiffusersInpainter(tiny_sdxl, OPTIONS)


@pytest.fixture
def call(xl: DiffusersInpainter, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """What the pipeline was last called with."""
    seen: dict[str, Any] = {}
    inner = xl.pipe

    def watch(**given: Any) -> Any:
        seen.clear()
        seen.update(given)
        return inner(**given)

    monkeypatch.setattr(xl, "pipe", watch)
    yield seen


# --- pictures: size, steps, strength -----------------------------------------------------------


def test_voxels_sit_on_latent_cells() -> None:
    """64 voxels on a 512-pixel model: 8 pixels each; nothing of the mask within a cell."""
    frame = _Frame((60, 64), 512)
    assert frame.power == 3 and (frame.height, frame.width) == (512, 512)
    mask = np.zeros((1, 60, 64), bool)
    mask[0, 7:33, 5:18] = True
    cells = frame.mask(mask)[0].reshape(64, 8, 64, 8).transpose(0, 2, 1, 3).reshape(64, 64, 64)
    assert (cells == cells[..., :1]).all()
    assert np.array_equal(cells[:60, :, 0] > 0, mask[0])
    # enlarged and brought back a picture is the same up to the blur of linear enlargement
    smooth = np.random.default_rng(0).random((1, 4, 4, 3)).astype(np.float32)
    smooth = np.kron(smooth, np.ones((1, 15, 16, 1), np.float32))
    assert np.abs(frame.back(frame.picture(smooth)) - smooth).mean() < 0.02


@pytest.mark.parametrize(
    ("shape", "size"), [((37, 50), 512), ((129, 129), 1024), ((400, 300), 256), ((9, 9), 1024)]
)
def test_any_slice_fits_any_model(shape: tuple[int, int], size: int) -> None:
    frame = _Frame(shape, size)
    assert frame.height % 16 == 0 and frame.width % 16 == 0
    assert max(frame.height, frame.width) <= 1.35 * size
    assert max(frame.scaled) >= 0.6 * size
    open_ = np.zeros((1, *shape), bool)
    open_[0, shape[0] // 2, shape[1] // 2] = True
    assert frame.mask(open_).sum() >= 1  # a hole of one voxel stays one, also on a smaller canvas
    assert frame.back(frame.picture(np.zeros((2, *shape, 3), np.float32))).shape == (2, *shape, 3)


def test_pipeline_is_told_everything(xl: DiffusersInpainter, call: dict[str, Any]) -> None:
    paint(xl, 1, strength=1.0)
    assert (call["height"], call["width"]) == (64, 64)  # else it takes the model's own 1024
    assert call["strength"] == 0.99  # 1.0 would start from pure noise
    assert call["prompt"] == ["flesh"] and len(call["generator"]) == 1
    assert call["image"].shape == (1, 3, 64, 64)  # 4 channels would count as latents
    paint(xl, 1, strength=0.1)
    # 2 steps at strength 0.1 would be none, which is an error in diffusers
    assert call["num_inference_steps"] == 40
    assert "true_cfg_scale" not in call


def test_wrong_output_size_is_named(
    xl: DiffusersInpainter, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Output:
        images = np.random.default_rng(0).random((1, 32, 32, 3))

    monkeypatch.setattr(xl, "pipe", lambda **_: Output())
    with pytest.raises(RunError, match="32 x 32 pixels for a canvas of 64 x 64"):
        paint(xl, 1)


# --- broken pictures, precision ----------------------------------------------------------------


@pytest.mark.parametrize("value", [float("nan"), 0.0])
def test_nan_and_black_are_explained(
    xl: DiffusersInpainter, monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    class Output:
        images = np.full((1, 64, 64, 3), value, np.float32)

    monkeypatch.setattr(xl, "pipe", lambda **_: Output())
    with pytest.raises(RunError, match="float16 VAE overflows"):
        paint(xl, 1)


def test_float16_decodes_in_float32(tiny_sdxl: Path) -> None:
    half = DiffusersInpainter(tiny_sdxl, replace(OPTIONS, dtype="float16"))
    assert half.pipe.unet.dtype == torch.float16 and half.pipe.vae.config.force_upcast
    seen: list[torch.dtype] = []
    decode = half.pipe.vae.decode

    def watch(latents: torch.Tensor, *rest: Any, **more: Any) -> Any:
        seen.append(half.pipe.vae.dtype)
        return decode(latents, *rest, **more)

    half.pipe.vae.decode = watch
    paint(half, 1)
    assert seen == [torch.float32]


def test_bfloat16_runs(tiny_sdxl: Path) -> None:
    brain = DiffusersInpainter(tiny_sdxl, replace(OPTIONS, dtype="bfloat16"))
    assert brain.pipe.unet.dtype == torch.bfloat16
    paint(brain, 1)


def test_name_of_the_precision_argument() -> None:
    assert dtype_argument("0.42.1") == "dtype" and dtype_argument("0.36.0") == "torch_dtype"
    assert dtype_argument("1.0.0.dev0") == "dtype"


# --- memory -------------------------------------------------------------------------------------


def test_out_of_memory_goes_to_smaller_batches_then_thriftier_modes(
    tiny_sdxl: Path, caplog: pytest.LogCaptureFixture
) -> None:
    inpainter = DiffusersInpainter(tiny_sdxl, replace(OPTIONS, batch=4))
    inner, sizes = inpainter.pipe, []

    class Tight:
        """Fails until the VAE works in tiles."""

        vae = inner.vae

        def __call__(self, **given: Any) -> Any:
            sizes.append(len(given["prompt"]))
            if not self.vae.use_tiling:
                raise torch.OutOfMemoryError("CUDA out of memory")
            return inner(**given)

        def to(self, device: torch.device) -> Any:
            return self

    inpainter.pipe = Tight()
    with caplog.at_level(logging.WARNING):
        paint(inpainter, 4)
    assert sizes == [4, 2, 1, 1, 1, 1, 1, 1] and inpainter.memory == "low"
    assert "batch is now 2" in caplog.text and "mode is now balanced" in caplog.text

    class Full(Tight):
        def __call__(self, **given: Any) -> Any:
            raise torch.OutOfMemoryError("CUDA out of memory")

    inpainter.pipe = Full()
    with pytest.raises(RunError, match="one picture of 64 pixels in memory mode low"):
        paint(inpainter, 1)


def test_memory_modes_set_the_vae(tiny_sdxl: Path) -> None:
    low = DiffusersInpainter(tiny_sdxl, replace(OPTIONS, memory="low"))
    assert low.pipe.vae.use_slicing and low.pipe.vae.use_tiling
    paint(low, 1)
    high = DiffusersInpainter(tiny_sdxl, OPTIONS)
    assert not high.pipe.vae.use_slicing and not high.pipe.vae.use_tiling


def test_big_models_on_a_cpu_are_refused(tiny_sdxl: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsfluent.pipeline.texture.inpaint import diffusers as diffusers_adapter

    monkeypatch.setattr(diffusers_adapter, "_CPU_PARAMETERS", 1000)
    with pytest.raises(InputError, match="allow_slow"):
        DiffusersInpainter(tiny_sdxl, OPTIONS)
    DiffusersInpainter(tiny_sdxl, replace(OPTIONS, allow_slow=True))


# --- other pipelines ---------------------------------------------------------------------------


def test_four_channel_model_works_with_a_warning(
    tiny_sdxl_base: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        base = DiffusersInpainter(tiny_sdxl_base, OPTIONS)
    assert "no mask channels" in caplog.text
    assert base.name == "StableDiffusionXLInpaintPipeline"
    paint(base)


def test_safety_checker_is_off_unless_kept(tmp_path: Path) -> None:
    import tiny_diffusers

    folder = tiny_diffusers.save_sd15(tmp_path)
    off = DiffusersInpainter(folder, OPTIONS)
    assert off.name == "StableDiffusionInpaintPipeline" and off.pipe.safety_checker is None
    paint(off, 1)
    kept = DiffusersInpainter(folder, replace(OPTIONS, safety_checker=True))
    assert kept.pipe.safety_checker is not None

    def flags(images: Any, **_: Any) -> tuple[Any, list[bool]]:
        return images, [True] * len(images)

    kept.pipe.safety_checker.forward = flags
    with pytest.raises(RunError, match="safety checker blanked 1 of 1"):
        paint(kept, 1)


def test_flux_fill_is_found_outside_the_table(tmp_path: Path) -> None:
    import tiny_diffusers

    folder = tiny_diffusers.save_flux(tmp_path)
    with pytest.raises(ValueError, match="AutoPipeline can't find"):
        diffusers.AutoPipelineForInpainting.from_pretrained(folder, local_files_only=True)
    flux = DiffusersInpainter(folder, OPTIONS)
    assert flux.name == "FluxFillPipeline"
    assert "negative_prompt" not in flux.accepts  # and is not passed
    paint(flux)


def test_kontext_sees_the_exemplar_and_keeps_the_size(tmp_path: Path) -> None:
    import tiny_diffusers

    folder = tiny_diffusers.save_flux(tmp_path, "FluxKontextPipeline")
    kontext = DiffusersInpainter(folder, OPTIONS)
    assert kontext.name == "FluxKontextInpaintPipeline"  # its default size is a megapixel
    plain, red, dark = (paint(kontext, 1, exemplar=e) for e in (None, photo(0.9), photo(0.1)))
    assert not np.array_equal(plain, red) and not np.array_equal(red, dark)


def test_stable_diffusion_3(tmp_path: Path) -> None:
    import tiny_diffusers

    third = DiffusersInpainter(tiny_diffusers.save_sd3(tmp_path), OPTIONS)
    assert third.name == "StableDiffusion3InpaintPipeline"
    paint(third)


@pytest.mark.parametrize(
    ("stored", "chosen"),
    [
        ("FluxFillPipeline", "FluxFillPipeline"),
        ("FluxKontextPipeline", "FluxKontextInpaintPipeline"),
        ("Flux2KleinPipeline", "Flux2KleinInpaintPipeline"),
        ("StableDiffusionXLPipeline", "AutoPipelineForInpainting"),
        ("StableDiffusion3Pipeline", "AutoPipelineForInpainting"),
        ("StableDiffusionXLInpaintPipeline", "StableDiffusionXLInpaintPipeline"),
    ],
)
def test_class_for_stored_weights(stored: str, chosen: str) -> None:
    if not hasattr(diffusers, chosen):
        pytest.skip(f"diffusers {diffusers.__version__} has no {chosen}")
    assert _pipeline_class(diffusers, stored, OPTIONS).__name__ == chosen
    named = replace(OPTIONS, pipeline_class="StableDiffusionInpaintPipeline")
    assert _pipeline_class(diffusers, stored, named).__name__ == "StableDiffusionInpaintPipeline"


def test_model_that_cannot_inpaint(tmp_path: Path, tiny_sdxl: Path) -> None:
    import json
    import shutil

    shutil.copytree(tiny_sdxl, tmp_path / "m")
    index = tmp_path / "m" / "model_index.json"
    stored = json.loads(index.read_text())
    index.write_text(json.dumps(stored | {"_class_name": "AudioLDMPipeline"}))
    with pytest.raises(InputError, match=r"(?s)inpainting.*pipeline_class"):
        DiffusersInpainter(tmp_path / "m", OPTIONS)


# --- the exemplar and the depth ----------------------------------------------------------------


def test_ip_adapter_shows_the_exemplar(tiny_sdxl: Path, tmp_path: Path) -> None:
    import tiny_diffusers

    folder = tiny_diffusers.save_ip_adapter(tmp_path / "ip", tiny_sdxl)
    options = replace(OPTIONS, ip_adapter=str(folder), ip_adapter_scale=1.0)
    inpainter = DiffusersInpainter(tiny_sdxl, options)
    red, same, dark = (paint(inpainter, exemplar=photo(r)) for r in (0.9, 0.9, 0.1))
    assert np.array_equal(red, same) and not np.array_equal(red, dark)
    with pytest.raises(InputError, match="needs an exemplar"):
        paint(inpainter, 1)


def test_ip_adapter_errors(tiny_sdxl: Path, tmp_path: Path) -> None:
    import tiny_diffusers

    blind = tiny_diffusers.save_ip_adapter(tmp_path / "blind", tiny_sdxl, encoder=False)
    with pytest.raises(InputError, match="no image encoder"):
        DiffusersInpainter(tiny_sdxl, replace(OPTIONS, ip_adapter=str(blind)))
    with pytest.raises(InputError, match="IP-adapter folder not found"):
        DiffusersInpainter(tiny_sdxl, replace(OPTIONS, ip_adapter="./nowhere"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="ip_adapter_weights"):
        DiffusersInpainter(tiny_sdxl, replace(OPTIONS, ip_adapter=str(tmp_path / "empty")))


def test_controlnet_sees_the_depth(tiny_sdxl_base: Path, tmp_path: Path) -> None:
    import tiny_diffusers

    folder = tiny_diffusers.save_controlnet(tmp_path / "net")
    options = replace(OPTIONS, controlnet=str(folder), controlnet_scale=1.0)
    inpainter = DiffusersInpainter(tiny_sdxl_base, options)
    assert inpainter.name == "StableDiffusionXLControlNetInpaintPipeline"
    context = slices(1)[2]
    assert context.guide is not None
    other = replace(context, guide=context.guide[:, :, ::-1], inside=context.inside[:, :, ::-1])
    assert not np.array_equal(paint(inpainter, 1), paint(inpainter, 1, context=other))
    with pytest.raises(InputError, match="depth of the slices"):
        paint(inpainter, 1, context=None)
    with pytest.raises(InputError, match="ControlNet folder not found"):
        DiffusersInpainter(tiny_sdxl_base, replace(OPTIONS, controlnet="/nowhere"))


# --- packages, files, the hub ------------------------------------------------------------------


def test_missing_packages_are_named(tiny_sdxl: Path, without: Callable[[str], None]) -> None:
    without("accelerate")
    with pytest.raises(InputError, match=r"inpaint memory low .* needs accelerate"):
        DiffusersInpainter(tiny_sdxl, replace(OPTIONS, memory="low"))
    # without transformers diffusers hands out classes that fail only when called
    without("transformers")
    with pytest.raises(InputError, match="needs transformers"):
        DiffusersInpainter(tiny_sdxl, OPTIONS)


def test_variant_is_passed_and_its_absence_explained(tiny_sdxl: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)leave variant \(fp16\) out"):
        DiffusersInpainter(tiny_sdxl, replace(OPTIONS, variant="fp16"))
    pipe = diffusers.StableDiffusionXLInpaintPipeline.from_pretrained(
        tiny_sdxl, local_files_only=True
    )
    pipe.to(torch.float16).save_pretrained(tmp_path, variant="fp16")
    made = DiffusersInpainter(tmp_path, replace(OPTIONS, variant="fp16"))
    assert made.pipe.unet.dtype == torch.float32  # files are half, work is as asked


def test_pickled_weights_are_refused(tiny_sdxl: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(tiny_sdxl, tmp_path / "m")
    weights = tmp_path / "m" / "unet" / "diffusion_pytorch_model.safetensors"
    torch.save({}, weights.with_suffix(".bin"))
    weights.unlink()
    with pytest.raises(InputError, match="safetensors"):
        DiffusersInpainter(tmp_path / "m", OPTIONS)


def test_a_missing_folder_never_becomes_a_download(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("the hub was asked")

    monkeypatch.setattr(diffusers.DiffusionPipeline, "load_config", refuse)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    for wrong in ("./model", "~/no/model", "models/sdxl", "a/b/c", "sdxl", tmp_path / "x"):
        with pytest.raises(InputError, match="model folder not found"):
            load_pipeline(wrong, OPTIONS, torch.device("cpu"))


def test_offline_is_respected_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []
    pinned = replace(OPTIONS, revision="115134f")

    def watch(_: str, **given: Any) -> Any:
        seen.append(given["local_files_only"])
        assert given.get("revision") == "115134f"
        raise OSError("x does not appear to have a file named model_index.json")

    monkeypatch.setattr(diffusers.DiffusionPipeline, "load_config", watch)
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.delenv("TRANSFORMERS_OFFLINE", raising=False)
    with pytest.raises(InputError, match="cannot be loaded from the hub"):
        load_pipeline("owner/name", pinned, torch.device("cpu"))
    with pytest.raises(InputError, match="offline is set, so the hub was not asked"):
        load_pipeline("owner/name", replace(pinned, offline=True), torch.device("cpu"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(InputError, match="HF_HUB_OFFLINE=1, so the hub was not asked"):
        load_pipeline("owner/name", pinned, torch.device("cpu"))
    assert seen == [False, True, True] and offline_asked(OPTIONS)


def test_long_runs_say_how_long(
    xl: DiffusersInpainter, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from test_inpaint_loop import ball

    from gsfluent.pipeline.texture.inpaint import method as inpaint

    clock = iter(np.arange(0.0, 1e6, 30.0))
    monkeypatch.setattr(inpaint.time, "perf_counter", lambda: float(next(clock)))
    options = replace(OPTIONS, slices=3, refine=(0.3,))
    with caplog.at_level(logging.WARNING):
        inpaint.inpaint_volume(ball(), xl, prompt="", options=options)
    # the first slice takes 30 s; 11 are left
    assert "11 slices to go, about 6 minutes (30.0 s per slice" in caplog.text
