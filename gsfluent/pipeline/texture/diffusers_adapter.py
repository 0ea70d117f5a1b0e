"""One adapter for every inpainting pipeline of diffusers.

Pipelines differ in the arguments they take and in what they do to known pixels. The adapter passes
only arguments that the pipeline's ``__call__`` names, works at a size the model accepts, seeds
every picture by itself, and puts known pixels back exactly (the VAE round trip changes them all).
The safety checker is switched off: slices through fruit are not photographs of people, and its
false alarms come back as black pictures.
"""

from __future__ import annotations

import inspect
import logging
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.errors import InputError, RunError

__all__ = ["DiffusersInpainter", "InpaintOptions"]

logger = logging.getLogger(__name__)

_MAX_STRENGTH = 0.99  # at 1.0 SD-XL starts from pure noise and its known quality problem shows
_CPU_PARAMETERS = 200_000_000  # above this a CPU needs hours to days


@dataclass(frozen=True)
class InpaintOptions:
    """Settings of the diffusion method.

    Attributes:
        slices: Slices per axis (fewer when the object has fewer voxels).
        strength: Denoising strength of the first pass (X slices).
        refine: Strengths of the following passes, each over X, Y and Z.
        size: Edge of the picture given to the model [pixels]; None takes the model's own.
        steps: Denoising steps at strength 1; raised where strength leaves fewer than four.
        guidance: Classifier-free guidance scale; None keeps the pipeline's default.
        negative_prompt: What the picture should not show.
        batch: Pictures per call.
        device: ``auto``, ``cpu`` or ``cuda``.
        dtype: ``auto`` (bfloat16 on CUDA, float32 on CPU), ``float32``, ``bfloat16``, ``float16``.
        revision: Commit or tag of a hub model.
        variant: File variant, for example ``fp16``.
        pipeline_class: Name of a diffusers class; None finds it.
        memory: ``high`` (all on the device), ``balanced`` (model offload, sliced VAE) or ``low``
            (sequential offload, tiled VAE).
        allow_slow: Run a full-size model on the CPU.
    """

    slices: int = 40
    strength: float = 0.99
    refine: tuple[float, ...] = (0.3, 0.2)
    size: int | None = None
    steps: int = 30
    guidance: float | None = None
    negative_prompt: str = "text, watermark, blurry"
    batch: int = 1
    device: str = "auto"
    dtype: str = "auto"
    revision: str | None = None
    variant: str | None = None
    pipeline_class: str | None = None
    memory: str = "high"
    allow_slow: bool = False

    def __post_init__(self) -> None:
        """Check ranges."""
        for name, value in [("strength", self.strength), *(("refine", r) for r in self.refine)]:
            if not 0.0 < value <= 1.0:
                raise InputError(
                    f"texture: inpaint {name} must be in 0..1, got {value}",
                    mend="0.99 for the first pass and 0.1 to 0.4 for the others are usual",
                )
        for name in ("slices", "steps", "batch"):
            if getattr(self, name) < 1:
                raise InputError(
                    f"texture: inpaint {name} must be at least 1, got {getattr(self, name)}",
                    mend="leave it out",
                )
        if self.dtype not in ("auto", "float32", "bfloat16", "float16"):
            raise InputError(
                f"texture: inpaint dtype must be auto, float32, bfloat16 or float16, "
                f"got {self.dtype!r}",
                mend="leave it at auto",
            )
        if self.memory not in ("high", "balanced", "low"):
            raise InputError(
                f"texture: inpaint memory must be high, balanced or low, got {self.memory!r}",
                mend="use balanced when the GPU runs out of memory",
            )


class DiffusersInpainter:
    """A loaded inpainting pipeline.

    Args:
        model: Local folder, or hub id (looked up in the local cache first; with
            ``HF_HUB_OFFLINE=1`` nowhere else).
        options: Settings.

    Raises:
        InputError: diffusers is missing, the weights are not there, or no inpainting pipeline
            belongs to them.
    """

    def __init__(self, model: str | Path, options: InpaintOptions) -> None:
        self.options = options
        self.device = _device(options.device)
        self.pipe = _load(model, options, self.device)
        self.accepts = set(inspect.signature(type(self.pipe).__call__).parameters)
        self.multiple = 16
        network = getattr(self.pipe, "unet", None) or getattr(self.pipe, "transformer", None)
        if options.size is not None:
            size = options.size
        else:
            latent = getattr(getattr(network, "config", None), "sample_size", None)
            size = int(latent) * 8 if isinstance(latent, int) else 1024
        self.size = max(self.multiple, size // self.multiple * self.multiple)
        count = sum(p.numel() for p in network.parameters()) if network is not None else 0
        if self.device.type == "cpu" and count > _CPU_PARAMETERS and not options.allow_slow:
            raise InputError(
                f"texture: {count / 1e6:.0f} million parameters on a CPU would take hours to days",
                mend="use a GPU, or set inpaint allow_slow to run anyway",
            )
        if "strength" not in self.accepts:
            logger.warning("%s takes no strength: every pass repaints fully", self.name)
        if getattr(getattr(network, "config", None), "in_channels", 9) == 4:
            logger.warning(
                "%s: the model has no mask channels; expect seams along the mask", self.name
            )

    @property
    def name(self) -> str:
        """Class name of the pipeline."""
        return type(self.pipe).__name__

    def __call__(
        self,
        images: np.ndarray,
        masks: np.ndarray,
        *,
        prompt: str,
        strength: float,
        seeds: list[int],
    ) -> np.ndarray:
        """Inpaint pictures.

        Args:
            images: float32 [B, H, W, 3] in 0..1.
            masks: bool [B, H, W]; True is repainted, everything else comes back bit for bit.
            prompt: Text.
            strength: Denoising strength in 0..1.
            seeds: One per picture: a picture does not depend on what shares its batch.

        Returns:
            float32 [B, H, W, 3].

        Raises:
            RunError: The model returned NaN or a constant picture, or memory ran out.
        """
        result = images.copy()
        wanted = np.flatnonzero(masks.any((1, 2)))
        batch = self.options.batch
        start = 0
        while start < len(wanted):
            part = wanted[start : start + batch]
            try:
                made = self._run(
                    images[part], masks[part], prompt, strength, [seeds[i] for i in part]
                )
            except torch.OutOfMemoryError as error:
                if batch == 1:
                    raise RunError(
                        f"{self.name}: out of GPU memory with one picture of {self.size} pixels",
                        mend="set inpaint memory to balanced or low, or a smaller inpaint size",
                    ) from error
                batch = max(1, batch // 2)
                logger.warning("%s: out of memory, batch is now %d", self.name, batch)
                continue
            result[part] = np.where(masks[part][..., None], made, images[part])
            start += len(part)
        return result

    def _run(
        self,
        images: np.ndarray,
        masks: np.ndarray,
        prompt: str,
        strength: float,
        seeds: list[int],
    ) -> np.ndarray:
        """One call of the pipeline on pictures padded to a square and enlarged."""
        import cv2

        count, height, width = masks.shape
        edge = max(height, width)
        big = np.full((count, edge, edge, 3), 0.5, np.float32)
        hole = np.zeros((count, edge, edge), np.float32)
        big[:, :height, :width], hole[:, :height, :width] = images, masks
        size = (self.size, self.size)
        picture = np.stack([cv2.resize(p, size, interpolation=cv2.INTER_LINEAR) for p in big])
        mask = np.stack([cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in hole])
        strength = min(strength, _MAX_STRENGTH)
        steps = max(self.options.steps, math.ceil(4.0 / strength))
        arguments: dict[str, Any] = {
            "prompt": [prompt] * count,
            "negative_prompt": [self.options.negative_prompt] * count,
            "image": torch.from_numpy(picture.clip(0, 1)).permute(0, 3, 1, 2).contiguous(),
            "mask_image": torch.from_numpy(mask)[:, None].contiguous(),
            "height": self.size,
            "width": self.size,
            "strength": strength,
            "num_inference_steps": steps,
            "generator": [torch.Generator("cpu").manual_seed(s) for s in seeds],
            "output_type": "np",
        }
        if self.options.guidance is not None:
            arguments["guidance_scale"] = self.options.guidance
            arguments["true_cfg_scale"] = self.options.guidance
        arguments = {k: v for k, v in arguments.items() if k in self.accepts}
        with torch.inference_mode():
            output = np.asarray(self.pipe(**arguments).images, dtype=np.float32)
        if not np.isfinite(output).all() or bool((output.std((1, 2, 3)) < 1e-5).any()):
            raise RunError(
                f"{self.name}: the model returned NaN or a constant picture",
                mend="this is how a float16 VAE overflows: use inpaint dtype float32 or bfloat16, "
                "or a model with the fp16-fixed VAE",
            )
        target = (edge, edge)
        small = [cv2.resize(o, target, interpolation=cv2.INTER_AREA) for o in output]
        made: np.ndarray = np.stack(small)[:, :height, :width].clip(0.0, 1.0)
        return made


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("texture: inpaint device is cuda, but no GPU is there", mend="use auto")
    return torch.device(name)


def _load(model: str | Path, options: InpaintOptions, device: torch.device) -> Any:
    """Find the pipeline class and load the weights."""
    try:
        import diffusers
        from diffusers.utils import is_transformers_available
    except ImportError as error:
        raise InputError(
            "texture: method 'diffusion' needs the package diffusers, which is not installed",
            mend="pip install diffusers transformers accelerate",
        ) from error
    if not is_transformers_available():
        raise InputError(
            "texture: method 'diffusion' needs the package transformers, which is not installed",
            mend="pip install transformers accelerate",
        )
    diffusers.utils.logging.set_verbosity_error()
    folder = Path(model)
    local = folder.is_dir()
    if local and not (folder / "model_index.json").is_file():
        raise InputError(
            f"{model}: not a diffusers model folder (no model_index.json)",
            mend="give the folder that save_pretrained or a hub download made",
        )
    if not local and (str(model).startswith(("/", ".", "~")) or str(model).count("/") != 1):
        raise InputError(
            f"{model}: model folder not found",
            mend="give an existing folder or a hub id (owner/name)",
        )
    offline = os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "ON", "YES", "TRUE")
    source: dict[str, Any] = {"local_files_only": local or offline}
    if options.revision is not None:
        source["revision"] = options.revision
    try:
        config = diffusers.DiffusionPipeline.load_config(str(model), **source)
        chosen = _pipeline_class(diffusers, str(config.get("_class_name", "")), options)
        if options.variant is not None:
            source["variant"] = options.variant
        # the argument was renamed; older versions know only the long name
        version = tuple(int(v) for v in diffusers.__version__.split(".")[:2])
        source["dtype" if version >= (0, 42) else "torch_dtype"] = _dtype(options, device)
        pipe = chosen.from_pretrained(str(model), use_safetensors=True, **source)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        where = "the local cache, and HF_HUB_OFFLINE is set" if offline else "the hub"
        raise InputError(
            f"{model}: the inpainting model cannot be loaded from "
            f"{'this folder' if local else where} ({str(error).strip().splitlines()[0]})",
            mend="check the name, download it beforehand, or give a local folder with .safetensors",
        ) from error
    return _prepare(pipe, options, device)


def _pipeline_class(diffusers: Any, name: str, options: InpaintOptions) -> Any:
    """Class that inpaints with these weights."""
    if options.pipeline_class is not None:
        if not hasattr(diffusers, options.pipeline_class):
            raise InputError(
                f"texture: diffusers {diffusers.__version__} has no {options.pipeline_class}",
                mend="leave pipeline_class out",
            )
        return getattr(diffusers, options.pipeline_class)
    if ("Inpaint" in name or "Fill" in name) and hasattr(diffusers, name):
        return getattr(diffusers, name)
    # classes outside AutoPipeline's table follow the naming rule
    variant = name.replace("Pipeline", "InpaintPipeline")
    from diffusers.pipelines.auto_pipeline import AUTO_INPAINT_PIPELINES_MAPPING

    known = {c.__name__ for c in AUTO_INPAINT_PIPELINES_MAPPING.values()}
    if variant in known or not hasattr(diffusers, variant):
        return diffusers.AutoPipelineForInpainting
    return getattr(diffusers, variant)


def _dtype(options: InpaintOptions, device: torch.device) -> torch.dtype:
    if options.dtype == "auto":
        return torch.bfloat16 if device.type == "cuda" else torch.float32
    chosen: torch.dtype = getattr(torch, options.dtype)
    return chosen


def _prepare(pipe: Any, options: InpaintOptions, device: torch.device) -> Any:
    """Switches that every pipeline gets."""
    if getattr(pipe, "safety_checker", None) is not None:
        pipe.safety_checker = None
    if getattr(pipe, "watermark", None) is not None:
        pipe.watermark = None
    pipe.set_progress_bar_config(disable=True)
    if options.memory != "high" and hasattr(pipe, "vae"):
        pipe.vae.enable_slicing()
        if options.memory == "low":
            pipe.vae.enable_tiling()
    if device.type == "cpu" or options.memory == "high":
        return pipe.to(device)
    if options.memory == "low":
        pipe.enable_sequential_cpu_offload(device=device)
    else:
        pipe.enable_model_cpu_offload(device=device)
    return pipe
