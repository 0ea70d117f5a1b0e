"""One adapter for every inpainting pipeline of diffusers.

Pipelines differ in the arguments they take and in what they do to known pixels. The adapter passes
only arguments that the pipeline's ``__call__`` names, works at a size the model accepts with voxel
edges on the edges of its 8-pixel latent cells, seeds every picture by itself, and puts known
pixels back exactly (the VAE round trip changes them all).
"""

from __future__ import annotations

import inspect
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent._lazy import cv2
from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.texture.inpaint.diffusers_load import (
    load_pipeline,
    lower_memory,
    pick_device,
)
from gsfluent.pipeline.texture.inpaint.inpainter import Job, MaskedInpainter, SliceContext
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions
from gsfluent.pipeline.texture.inpaint.tiles import GROUND
from gsfluent.pipeline.texture.photo.exemplar import Exemplar

logger = logging.getLogger(__name__)

_MAX_STRENGTH = 0.99  # at 1.0 SD-XL starts from pure noise and its known quality problem shows
_MIN_STEPS = 4  # real denoising steps; fewer leave blocks
_CPU_PARAMETERS = 200_000_000  # above this a CPU needs hours to days
_MULTIPLE = 16  # SD and SD-XL want multiples of 8, SD 3 and FLUX of 16


class DiffusersInpainter(MaskedInpainter):
    """A loaded inpainting pipeline.

    Args:
        model: Local folder, or hub id (looked up in the local cache first; with
            ``HF_HUB_OFFLINE=1`` nowhere else).
        options: Settings.

    Raises:
        InputError: diffusers is missing, the weights are not there, no inpainting pipeline
            belongs to them, or the model is too large for a CPU.
    """

    sequential = False

    def __init__(self, model: str | Path, options: InpaintOptions) -> None:
        self.options = options
        self.device = pick_device(options.device)
        self.memory = options.memory
        self.calls = 0
        self.pipe = load_pipeline(model, options, self.device)
        self.name = type(self.pipe).__name__
        self.accepts = set(inspect.signature(type(self.pipe).__call__).parameters)
        network = getattr(self.pipe, "unet", None) or getattr(self.pipe, "transformer", None)
        self.size = max(_MULTIPLE, (options.size or _own_size(self.pipe, network)))
        self.size = self.size // _MULTIPLE * _MULTIPLE
        count = sum(p.numel() for p in network.parameters()) if network is not None else 0
        if self.device.type == "cpu" and count > _CPU_PARAMETERS and not options.allow_slow:
            raise InputError(
                f"texture: {count / 1e6:.0f} million parameters on a CPU would take hours to days",
                hint="use a GPU, or set inpaint allow_slow to run anyway",
            )
        if "strength" not in self.accepts:
            logger.warning("%s takes no strength: every pass repaints fully", self.name)
        if getattr(getattr(network, "config", None), "in_channels", 9) == 4:
            logger.warning(
                "%s: the model has no mask channels (4 inputs instead of 9); expect seams along "
                "the mask. A model trained for inpainting does better",
                self.name,
            )

    def paint(self, job: Job) -> np.ndarray:
        """Run the pipeline in batches; smaller and thriftier ones when memory runs out.

        Raises:
            RunError: The model returned NaN or a constant picture, its safety checker blanked
                one, or memory ran out in the thriftiest mode.
        """
        made = np.empty_like(job.slices)
        batch = self.options.batch
        start = 0
        while start < len(made):
            part = np.arange(start, min(start + batch, len(made)))
            try:
                made[part] = self._run(job.take(part))
            except torch.OutOfMemoryError as error:
                if batch > 1:
                    batch = max(1, batch // 2)
                    logger.warning("%s: out of memory, batch is now %d", self.name, batch)
                    continue
                lower = lower_memory(self.pipe, self.memory, self.device)
                if lower is None:
                    raise RunError(
                        f"{self.name}: out of GPU memory with one picture of {self.size} pixels "
                        f"in memory mode {self.memory}",
                        hint="use a smaller inpaint size or model, or free the GPU",
                    ) from error
                self.memory = lower
                logger.warning("%s: out of memory, memory mode is now %s", self.name, lower)
                continue
            start += len(part)
        return made

    def _run(self, job: Job) -> np.ndarray:
        """One call of the pipeline on enlarged pictures."""
        count = len(job.slices)
        frame = _Frame(job.mask.shape[1:], self.size)
        strength = min(job.strength, _MAX_STRENGTH)
        arguments: dict[str, Any] = {
            "prompt": [job.prompt] * count,
            "negative_prompt": [self.options.negative_prompt] * count,
            "image": _tensor(frame.picture(job.slices).clip(0, 1)),
            "mask_image": torch.from_numpy(frame.mask(job.mask))[:, None].contiguous(),
            "height": frame.height,
            "width": frame.width,
            "strength": strength,
            "num_inference_steps": max(self.options.steps, math.ceil(_MIN_STEPS / strength)),
            "generator": [torch.Generator("cpu").manual_seed(s) for s in job.seeds],
            "output_type": "np",
            # Kontext would scale every picture to a megapixel of its own choice
            "max_area": frame.height * frame.width,
            "_auto_resize": False,
        }
        if self.options.guidance is not None:
            arguments["guidance_scale"] = self.options.guidance
            arguments["true_cfg_scale"] = self.options.guidance
        arguments |= self._conditions(job.exemplar, job.context, frame)
        arguments = {k: v for k, v in arguments.items() if k in self.accepts}
        self.calls += 1
        with torch.inference_mode():
            output = self.pipe(**arguments)
        flagged = getattr(output, "nsfw_content_detected", None)
        if flagged is not None and any(flagged):
            raise RunError(
                f"{self.name}: its safety checker blanked {sum(map(bool, flagged))} of {count} "
                "slices",
                hint="leave inpaint safety_checker off: it knows photographs, not slices",
            )
        pictures = np.asarray(output.images, dtype=np.float32)
        if not np.isfinite(pictures).all() or bool((pictures.std((1, 2, 3)) < 1e-5).any()):
            raise RunError(
                f"{self.name}: the model returned NaN or a constant picture",
                hint="this is how a float16 VAE overflows: use inpaint dtype float32 or bfloat16, "
                "or a model with the fp16-fixed VAE",
            )
        return frame.back(pictures)

    def _conditions(
        self, exemplar: Exemplar | None, context: SliceContext, frame: _Frame
    ) -> dict[str, Any]:
        """Arguments that show the exemplar and the depth to the model."""
        result: dict[str, Any] = {}
        if self.options.ip_adapter is not None:
            if exemplar is None:
                raise InputError(
                    "texture: ip_adapter needs an exemplar photograph to show to the model",
                    hint="add exemplar: cut.jpg, or leave ip_adapter out",
                )
            result["ip_adapter_image"] = [_pil(exemplar)]
        elif exemplar is not None and "image_reference" in self.accepts:
            result["image_reference"] = _pil(exemplar)
        if self.options.controlnet is not None:
            depth = context.guide
            if depth is None:
                raise InputError(
                    "texture: controlnet needs the depth of the slices", hint="leave it out"
                )
            near = 1.0 - depth / max(context.max_depth, float(depth.max()), 1e-6)
            if context.inside is not None:  # depth maps are bright near and black far away
                near = np.where(context.inside, near, 0.0)
            shown = np.repeat(near[..., None].astype(np.float32), 3, -1)
            result["control_image"] = _tensor(frame.picture(shown, ground=0.0))
            result["controlnet_conditioning_scale"] = self.options.controlnet_scale
        return result


class _Frame:
    """How slices of any size sit on the model's canvas.

    One slice pixel becomes a power of two of canvas pixels (8 where it fits: one voxel is then one
    latent cell, and the mask's edges fall between cells). The rest of the canvas is ground.
    """

    def __init__(self, shape: tuple[int, ...], size: int) -> None:
        self.shape = shape
        edge = max(shape)
        # the power of two that fills between 0.65 and 1.3 of the model's size
        self.power = math.floor(math.log2(1.3 * size / edge))
        scaled = [math.ceil(s * 2.0**self.power) for s in shape]
        canvas = [max(size, s + -s % _MULTIPLE) for s in scaled]
        self.height, self.width = canvas
        self.scaled = scaled

    def picture(self, images: np.ndarray, ground: float = GROUND) -> np.ndarray:
        """Images [B, H, W, 3] enlarged onto canvases of ground."""
        method = cv2.INTER_LINEAR if self.power >= 0 else cv2.INTER_AREA
        out = np.full((len(images), self.height, self.width, 3), ground, np.float32)
        size = (self.scaled[1], self.scaled[0])
        for k, image in enumerate(images):
            out[k, : size[1], : size[0]] = cv2.resize(image, size, interpolation=method)
        return out

    def mask(self, masks: np.ndarray) -> np.ndarray:
        """Masks [B, H, W] as 0 or 1 on canvases; a canvas pixel is open when any voxel in it is."""
        out = np.zeros((len(masks), self.height, self.width), np.float32)
        size = (self.scaled[1], self.scaled[0])
        method = cv2.INTER_NEAREST if self.power >= 0 else cv2.INTER_AREA
        for k, mask in enumerate(masks):
            scaled = cv2.resize(mask.astype(np.float32), size, interpolation=method)
            out[k, : size[1], : size[0]] = scaled > 0
        return out

    def back(self, pictures: np.ndarray) -> np.ndarray:
        """The slices [B, H, W, 3] out of the model's pictures."""
        if pictures.shape[1:3] != (self.height, self.width):
            raise RunError(
                f"the model returned {pictures.shape[2]} x {pictures.shape[1]} pixels for a "
                f"canvas of {self.width} x {self.height}",
                hint="name a size the model knows (inpaint size)",
            )
        size = (self.shape[1], self.shape[0])
        method = cv2.INTER_AREA if self.power >= 0 else cv2.INTER_LINEAR
        cut = pictures[:, : self.scaled[0], : self.scaled[1]]
        small = np.stack([cv2.resize(p, size, interpolation=method) for p in cut])
        return np.asarray(small.clip(0.0, 1.0))


def _own_size(pipe: Any, network: Any) -> int:
    """Edge of the pictures that the model was made for [pixels]."""
    latent = getattr(getattr(network, "config", None), "sample_size", None)
    if latent is None:
        latent = getattr(pipe, "default_sample_size", None)
    factor = int(getattr(pipe, "vae_scale_factor", 8) or 8)
    return int(latent) * factor if isinstance(latent, int) else 1024


def _tensor(pictures: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(pictures).permute(0, 3, 1, 2).contiguous()


def _pil(exemplar: Exemplar) -> Any:
    """The photograph as a picture, its ground made neutral."""
    from PIL import Image

    shown = np.where(exemplar.mask[..., None], exemplar.image, GROUND)
    return Image.fromarray((shown.clip(0, 1) * 255).round().astype(np.uint8))
