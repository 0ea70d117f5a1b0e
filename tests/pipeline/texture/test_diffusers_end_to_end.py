"""The diffusers path from a solid to its colours, on the CPU and on a GPU, killed and resumed."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsfluent.pipeline.texture.inpaint.diffusers import DiffusersInpainter, InpaintOptions
from gsfluent.pipeline.texture.inpaint.method import diffusion_texture
from gsfluent.pipeline.texture.volume.domain import InteriorTexture

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

ROOT = Path(__file__).resolve().parents[3]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
OPTIONS = InpaintOptions(slices=5, refine=(0.3,), size=64, steps=2, dtype="float32")

SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
import test_diffusers_end_to_end as here
here.run(sys.argv[2], sys.argv[3], sys.argv[4], die_at=6)
"""


def run(model: str, folder: str | None, device: str, die_at: int = -1) -> InteriorTexture:
    """Texture a ball; killed from inside at a call of the model when asked to."""
    from test_inpaint_loop import ball, photo

    paint = DiffusersInpainter._run
    count = 0

    def counted(self: DiffusersInpainter, *given: Any) -> np.ndarray:
        nonlocal count
        count += 1
        if count == die_at:
            import os

            os.kill(os.getpid(), signal.SIGKILL)
        return paint(self, *given)

    DiffusersInpainter._run = counted  # type: ignore[method-assign]
    try:
        return diffusion_texture(
            ball(),
            model,
            prompt="red flesh",
            options=replace(OPTIONS, device=device),
            exemplar=photo(),
            resume=None if folder is None else Path(folder) / "slices",
            seed=3,
        )
    finally:
        DiffusersInpainter._run = paint  # type: ignore[method-assign]


@pytest.mark.parametrize("device", DEVICES)
def test_killed_between_slices_and_resumed(device: str, tiny_sdxl: Path, tmp_path: Path) -> None:
    here = str(Path(__file__).parent)
    words = [sys.executable, "-c", SCRIPT, here, str(tiny_sdxl), str(tmp_path), device]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr[-2000:]
    kept = len(list((tmp_path / "slices").glob("slice_*.npy")))
    again = run(str(tiny_sdxl), str(tmp_path), device)
    whole = run(str(tiny_sdxl), None, device)
    # the outermost slices are all shell and need no model: 3 along X, then 3 along each axis
    assert whole.report["model_calls"] == 3 + 9 and whole.report["slices"] == 5 + 15
    assert again.report["resumed_slices"] == kept >= 5
    assert (
        again.report["model_calls"] == 12 - 5
    )  # the call it died in is made anew, the five before not
    # the same bits on a CPU; a GPU may round its sums in another order from run to run
    assert np.abs(again.rgb - whole.rgb).max() <= (0.0 if device == "cpu" else 0.02)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["auto", "float16", "bfloat16", "float32"])
@pytest.mark.parametrize("memory", ["high", "balanced", "low"])
def test_precisions_and_memory_modes(dtype: str, memory: str, tiny_sdxl: Path) -> None:
    from test_diffusers_details import paint

    options = InpaintOptions(size=64, steps=2, device="cuda", dtype=dtype, memory=memory, batch=2)
    inpainter = DiffusersInpainter(tiny_sdxl, options)
    wanted = {"auto": torch.bfloat16}.get(dtype) or getattr(torch, dtype)
    assert inpainter.pipe.unet.dtype == wanted
    made = paint(inpainter, 3)
    assert np.abs(made - paint(inpainter, 3)).max() < 0.02
    if memory == "high":
        assert next(inpainter.pipe.unet.parameters()).device.type == "cuda"
    else:
        assert next(inpainter.pipe.unet.parameters()).device.type != "cuda"  # between calls


@pytest.mark.cuda
def test_real_out_of_memory_halves_the_batch(tiny_sdxl: Path) -> None:
    from test_diffusers_details import paint

    size = 512
    one = DiffusersInpainter(tiny_sdxl, InpaintOptions(size=size, steps=2, device="cuda", batch=1))
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    held = torch.cuda.memory_allocated()  # by whatever ran before: no part of what one slice needs
    paint(one, 1)
    need = torch.cuda.max_memory_allocated() - held
    many = DiffusersInpainter(tiny_sdxl, InpaintOptions(size=size, steps=2, device="cuda", batch=8))
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(0).total_memory
    room = 3.0 * need + torch.cuda.memory_reserved()
    torch.cuda.set_per_process_memory_fraction(min(1.0, room / total))
    try:
        paint(many, 8)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
        torch.cuda.empty_cache()
    assert many.calls > 1  # eight at once did not fit


@pytest.mark.cuda
def test_gpu_pictures_are_those_of_the_cpu(tiny_sdxl: Path) -> None:
    """The noise comes from CPU generators, so a seed means the same picture everywhere."""
    from test_diffusers_details import paint

    made = [
        paint(DiffusersInpainter(tiny_sdxl, InpaintOptions(size=64, steps=2, device=d, dtype=t)))
        for d, t in (("cpu", "float32"), ("cuda", "float32"))
    ]
    assert np.abs(made[0] - made[1]).mean() < 0.01
