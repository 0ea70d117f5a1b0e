"""Finding and loading an inpainting pipeline of diffusers, and saying plainly why it cannot be.

Nothing is downloaded that the user did not name: a path that does not exist is an error, and only
a hub id (owner/name) that is written as such may be looked up on the hub.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import torch

from gsfluent.errors import InputError, need
from gsfluent.pipeline.texture.inpaint.options import InpaintOptions

logger = logging.getLogger(__name__)


def pick_device(name: str) -> torch.device:
    """Device of a name: ``auto`` takes CUDA where it is.

    Raises:
        InputError: CUDA was asked for and is not there, or no device has this name.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("texture: inpaint device is cuda, but no GPU is there", hint="use auto")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(
            f"texture: no device is called {name!r}", hint="use auto, cpu or cuda"
        ) from error


def load_pipeline(model: str | Path, options: InpaintOptions, device: torch.device) -> Any:
    """Find the pipeline class of a model folder or hub id, load the weights, set the switches.

    Raises:
        InputError: A package is missing, the weights are not there, no inpainting pipeline belongs
            to them, or it has no place for the IP-adapter or ControlNet asked for.
    """
    diffusers = _packages(options)
    local = _is_local(model)
    offline = offline_asked(options)
    dtype = _dtype(options, device)
    source: dict[str, Any] = {"local_files_only": local or offline}
    if options.revision is not None:
        source["revision"] = options.revision
    try:
        config = diffusers.DiffusionPipeline.load_config(str(model), **source)
        chosen = _pipeline_class(diffusers, str(config.get("_class_name", "")), options)
        if options.variant is not None:
            source["variant"] = options.variant
        source[dtype_argument(diffusers.__version__)] = dtype
        extra: dict[str, Any] = {}
        if options.controlnet is not None:
            extra["controlnet"] = _controlnet(diffusers, options, dtype, offline)
        # parts that were left out when the model was saved (SD 3 without its T5 encoder) must be
        # named as left out
        for name, kind in config.items():
            if isinstance(kind, list | tuple) and len(kind) == 2 and kind[0] is None:
                extra[name] = None
        if not options.safety_checker and "safety_checker" in config:
            extra["safety_checker"] = None
            extra["requires_safety_checker"] = False
        pipe = chosen.from_pretrained(str(model), use_safetensors=True, **source, **extra)
    except InputError:
        raise
    except (OSError, ValueError, ImportError, AttributeError) as error:
        raise _load_error(model, error, local, offline, options) from error
    if options.ip_adapter is not None:
        _ip_adapter(pipe, options, offline)
    _prepare(pipe, options, dtype)
    return _place(pipe, options.memory, device)


def _packages(options: InpaintOptions) -> Any:
    """The module diffusers, with what it needs to run.

    Without transformers diffusers hands out dummy classes that fail only when called.
    """
    method = "texture: method 'diffusion'"
    need("transformers", "inpaint", method)
    if options.memory != "high":
        need("accelerate", "inpaint", f"{method} with inpaint memory {options.memory} (high: not)")
    diffusers = need("diffusers", "inpaint", method)
    diffusers.utils.logging.set_verbosity_error()
    diffusers.utils.logging.disable_progress_bar()
    return diffusers


def _is_local(model: str | Path) -> bool:
    """Whether the model is a folder; an error when it is neither folder nor hub id."""
    folder = Path(model).expanduser()
    if folder.is_dir():
        if not (folder / "model_index.json").is_file():
            raise InputError(
                f"{model}: not a diffusers model folder (no model_index.json)",
                hint="give the folder that save_pretrained or a hub download made",
            )
        return True
    text = str(model)
    # a mistyped folder must not become a look-up on the hub: an id has one slash, and no folder
    # of the owner's name lies here
    looks_local = isinstance(model, Path) or text.startswith(("/", ".", "~"))
    if looks_local or text.count("/") != 1 or folder.parent.is_dir():
        raise InputError(
            f"{model}: model folder not found",
            hint="give an existing folder or a hub id (owner/name)",
        )
    return False


def offline_asked(options: InpaintOptions) -> bool:
    """Whether the hub must not be asked."""
    names = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
    return options.offline or any(
        os.environ.get(n, "").upper() in ("1", "ON", "YES", "TRUE") for n in names
    )


def dtype_argument(version: str) -> str:
    """Name of the precision argument: renamed in 0.42, older versions know only the long one."""
    numbers = tuple(int(v) for v in version.split(".")[:2])
    return "dtype" if numbers >= (0, 42) else "torch_dtype"


def _load_error(
    model: str | Path, error: Exception, local: bool, offline: bool, options: InpaintOptions
) -> InputError:
    first = (str(error).strip() or type(error).__name__).splitlines()[0]
    if local:
        where = "this folder"
    elif offline:
        # diffusers says "does not appear to have a file named model_index.json" here
        asked = "offline is set" if options.offline else "HF_HUB_OFFLINE=1"
        where = f"the local cache, and {asked}, so the hub was not asked"
    else:
        where = "the hub"
    hint = "check the name, download it beforehand, or give a local folder with .safetensors"
    if options.variant is not None:
        hint = f"leave variant ({options.variant}) out, or give the one that the files have"
    elif "AutoPipeline can't find" in str(error):
        hint = "use an inpainting model (SD-XL inpainting for example), or name pipeline_class"
    return InputError(
        f"{model}: the inpainting model cannot be loaded from {where} ({first})", hint=hint
    )


def _pipeline_class(diffusers: Any, name: str, options: InpaintOptions) -> Any:
    """Class that inpaints with these weights."""
    if options.pipeline_class is not None:
        if not hasattr(diffusers, options.pipeline_class):
            raise InputError(
                f"texture: diffusers {diffusers.__version__} has no {options.pipeline_class}",
                hint="leave pipeline_class out",
            )
        return getattr(diffusers, options.pipeline_class)
    if options.controlnet is not None:
        return diffusers.AutoPipelineForInpainting
    if ("Inpaint" in name or "Fill" in name) and hasattr(diffusers, name):
        return getattr(diffusers, name)
    # classes outside AutoPipeline's table (FLUX.2 klein, Kontext) follow the naming rule
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


def _folder(name: str, what: str) -> bool:
    """Whether a part of the model is a folder; an error when it is neither folder nor hub id."""
    local = Path(name).expanduser().is_dir()
    if not local and (name.startswith(("/", ".", "~")) or name.count("/") != 1):
        raise InputError(f"{name}: {what} folder not found", hint="give a folder or a hub id")
    return local


def _controlnet(diffusers: Any, options: InpaintOptions, dtype: torch.dtype, offline: bool) -> Any:
    """The ControlNet that is shown the depth of a slice."""
    name = str(options.controlnet)
    local = _folder(name, "ControlNet")
    return diffusers.ControlNetModel.from_pretrained(
        name,
        local_files_only=local or offline,
        use_safetensors=True,
        **{dtype_argument(diffusers.__version__): dtype},
    )


def _ip_adapter(pipe: Any, options: InpaintOptions, offline: bool) -> None:
    """Load the IP-adapter that shows the exemplar to the model."""
    name = str(options.ip_adapter)
    if not hasattr(pipe, "load_ip_adapter"):
        raise InputError(
            f"texture: {type(pipe).__name__} takes no IP-adapter",
            hint="leave ip_adapter out, or use an SD or SD-XL model",
        )
    folder, local = Path(name).expanduser(), _folder(name, "IP-adapter")
    own = None
    if getattr(pipe, "image_encoder", None) is None:
        # the encoder lies beside the weights or, as in h94/IP-Adapter, in models/image_encoder
        own = "image_encoder"
        if local and not (folder / options.ip_adapter_subfolder / own).is_dir():
            own = "models/image_encoder" if (folder / "models/image_encoder").is_dir() else None
        elif not local and options.ip_adapter_subfolder:
            own = "models/image_encoder" if options.ip_adapter_subfolder == "models" else own
    weights = options.ip_adapter_weights
    if weights is None and local:
        found = sorted((folder / options.ip_adapter_subfolder).glob("*.safetensors"))
        weights = found[0].name if len(found) == 1 else None
    if weights is None:
        raise InputError(
            f"{name}: which file holds the IP-adapter's weights is not clear",
            hint="name it with ip_adapter_weights, for example ip-adapter_sdxl_vit-h.safetensors",
        )
    try:
        pipe.load_ip_adapter(
            str(folder) if local else name,
            subfolder=options.ip_adapter_subfolder,
            weight_name=weights,
            image_encoder_folder=own,
            local_files_only=local or offline,
        )
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"{name}: the IP-adapter cannot be used with {type(pipe).__name__} ({first})",
            hint="take the adapter made for this family of models",
        ) from error
    if getattr(pipe, "image_encoder", None) is None:
        raise InputError(
            f"{name}: the pipeline has no image encoder, so an exemplar cannot be shown to it",
            hint="put the encoder into image_encoder/ beside the adapter's weights",
        )
    pipe.set_ip_adapter_scale(options.ip_adapter_scale)


def _prepare(pipe: Any, options: InpaintOptions, dtype: torch.dtype) -> None:
    """Switches that every pipeline gets."""
    if not options.safety_checker and getattr(pipe, "safety_checker", None) is not None:
        pipe.safety_checker = None
    if getattr(pipe, "watermark", None) is not None:
        pipe.watermark = None
    pipe.set_progress_bar_config(disable=True)
    vae = getattr(pipe, "vae", None)
    if dtype == torch.float16 and vae is not None and hasattr(vae.config, "force_upcast"):
        # the SD-XL VAE overflows in float16 (black pictures): the pipeline decodes in float32
        vae.register_to_config(force_upcast=True)


def _place(pipe: Any, memory: str, device: torch.device) -> Any:
    """Put the pipeline on the device, all of it or part by part."""
    vae: Any = getattr(pipe, "vae", None)
    if memory != "high" and hasattr(vae, "enable_slicing"):
        vae.enable_slicing()
    if memory == "low" and hasattr(vae, "enable_tiling"):
        vae.enable_tiling()
    if device.type == "cpu" or memory == "high":
        return pipe.to(device)
    if memory == "low":
        pipe.enable_sequential_cpu_offload(device=device)
    else:
        pipe.enable_model_cpu_offload(device=device)
    return pipe


def lower_memory(pipe: Any, memory: str, device: torch.device) -> str | None:
    """The next thriftier mode after an out-of-memory, set on the pipeline; None: none is left."""
    following = {"high": "balanced", "balanced": "low"}.get(memory)
    if following is None:
        return None
    from diffusers.utils import is_accelerate_available

    if device.type == "cuda" and not is_accelerate_available():
        return None
    if hasattr(pipe, "remove_all_hooks"):
        pipe.remove_all_hooks()
    torch.cuda.empty_cache()
    _place(pipe, following, device)
    return following
