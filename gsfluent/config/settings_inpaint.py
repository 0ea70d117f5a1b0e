"""``texture.inpaint:`` - how slices are inpainted (methods diffusion and inpaint)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    Section,
    choice,
    flag,
    number,
    optional,
    section,
    several,
    text,
    whole,
)
from gsfluent.errors import InputError, short


@dataclasses.dataclass(frozen=True)
class InpaintSettings(Section):
    """``texture.inpaint:``. None leaves the choice to the stage."""

    backend: str | None = optional(
        choice("diffusers", "command", "exemplar", "telea", "color"),
        "Who fills the slices; diffusers unless set.",
        "diffusers",
    )
    coarse: str | None = optional(
        choice("diffusers", "command", "exemplar", "telea", "color"),
        "Who does the first pass along X, when another one.",
        "command",
    )
    command: str | None = optional(
        text,
        "Program of the backend command; {folder} is where its slices lie.",
        "python infer.py --folder {folder}",
    )
    schedule: str | None = optional(
        choice("paper", "coupled"),
        "X first, then X, Y and Z; or all axes together from the coarsest level on.",
        "coupled",
    )
    slices: int | None = optional(whole(1, 2048), "Slices per axis.", "40")
    strength: float | None = optional(
        number(0.0, 1.0, above=0.0), "Denoising strength of the first pass.", "0.99"
    )
    refine: tuple[float, ...] | None = optional(
        several(number(0.0, 1.0, above=0.0)),
        "Strengths of the rounds over X, Y and Z that follow.",
        "[0.3, 0.2]",
    )
    tile: int | None = optional(
        whole(1, 4), "Neighbouring slices along an edge of one picture: 1, 2 or 4.", "2"
    )
    match_colors: bool | None = optional(
        flag, "Bring the colours of every slice back to the exemplar's before fusion.", "true"
    )
    steps: int | None = optional(whole(1, 1000), "Denoising steps.", "30")
    guidance: float | None = optional(number(0.0, 100.0), "Classifier-free guidance scale.", "7.5")
    size: int | None = optional(whole(16, 4096), "Edge of the model's pictures [pixels].", "1024")
    batch: int | None = optional(whole(1, 256), "Pictures per call.", "4")
    memory: str | None = optional(
        choice("high", "balanced", "low"), "All on the GPU, or part by part.", "balanced"
    )
    dtype: str | None = optional(
        choice("auto", "float32", "bfloat16", "float16"),
        "Precision; auto is bfloat16 on a GPU.",
        "bfloat16",
    )
    variant: str | None = optional(text, "File variant.", "fp16")
    revision: str | None = optional(text, "Commit or tag of a hub model.", "115134f")
    offline: bool | None = optional(flag, "Look only in the local cache.", "true")
    safety_checker: bool | None = optional(flag, "Keep the model's safety checker.", "false")
    ip_adapter: str | None = optional(
        text,
        "Folder or hub id of an IP-adapter, which shows the exemplar to the model.",
        "models/ip-adapter",
    )
    ip_adapter_subfolder: str | None = optional(
        text, "Folder of its weights within it.", "sdxl_models"
    )
    ip_adapter_weights: str | None = optional(
        text, "File of its weights.", "ip-adapter_sdxl_vit-h.safetensors"
    )
    ip_adapter_scale: float | None = optional(
        number(0.0, 2.0), "How much the exemplar counts.", "0.5"
    )
    controlnet: str | None = optional(
        text, "Folder or hub id of a depth ControlNet.", "models/depth"
    )
    allow_slow: bool | None = optional(flag, "Run a full-size model on the CPU.", "false")


def read_inpaint(words: Sequence[str]) -> dict[str, Any]:
    """Settings from ``name=value`` words of a command line, values written as in a shot file.

    Raises:
        InputError: A word is no ``name=value``, or a name or value is refused.
    """
    import yaml

    found: dict[str, Any] = {}
    for word in words:
        name, separator, value = word.partition("=")
        try:
            found[name] = yaml.safe_load(value) if separator else None
        except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError):
            separator = ""
        if not separator or found[name] is None:
            raise InputError(
                f"--inpaint takes name=value, got {short(word)}", "write it like tile=2"
            )
    return section(InpaintSettings, found, Place("inpaint", Path())).given()
