"""``texture.inpaint:`` - how slices are inpainted (methods diffusion and inpaint)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsfluent.config.read import (
    Place,
    choice,
    flag,
    given,
    key,
    number,
    section,
    several,
    text,
    whole,
)
from gsfluent.errors import InputError

__all__ = ["InpaintSettings", "read_inpaint"]


@dataclasses.dataclass(frozen=True)
class InpaintSettings:
    """``texture.inpaint:``. None leaves the choice to the stage."""

    backend: str | None = key(
        choice("diffusers", "command", "exemplar", "telea", "color"),
        default=None,
        doc="Who fills the slices; diffusers unless set.",
        example="diffusers",
    )
    coarse: str | None = key(
        choice("diffusers", "command", "exemplar", "telea", "color"),
        default=None,
        doc="Who does the first pass along X, when another one.",
        example="command",
    )
    command: str | None = key(
        text,
        default=None,
        doc="Program of the backend command; {folder} is where its slices lie.",
        example="python infer.py --folder {folder}",
    )
    schedule: str | None = key(
        choice("paper", "coupled"),
        default=None,
        doc="X first, then X, Y and Z; or all axes together from the coarsest level on.",
        example="coupled",
    )
    slices: int | None = key(whole(1, 2048), default=None, doc="Slices per axis.", example="40")
    strength: float | None = key(
        number(0.0, 1.0, above=0.0),
        default=None,
        doc="Denoising strength of the first pass.",
        example="0.99",
    )
    refine: tuple[float, ...] | None = key(
        several(number(0.0, 1.0, above=0.0)),
        default=None,
        doc="Strengths of the rounds over X, Y and Z that follow.",
        example="[0.3, 0.2]",
    )
    tile: int | None = key(
        whole(1, 4),
        default=None,
        doc="Neighbouring slices along an edge of one picture: 1, 2 or 4.",
        example="2",
    )
    match_colors: bool | None = key(
        flag,
        default=None,
        doc="Bring the colours of every slice back to the exemplar's before fusion.",
        example="true",
    )
    steps: int | None = key(whole(1, 1000), default=None, doc="Denoising steps.", example="30")
    guidance: float | None = key(
        number(0.0, 100.0), default=None, doc="Classifier-free guidance scale.", example="7.5"
    )
    size: int | None = key(
        whole(16, 4096), default=None, doc="Edge of the model's pictures [pixels].", example="1024"
    )
    batch: int | None = key(whole(1, 256), default=None, doc="Pictures per call.", example="4")
    memory: str | None = key(
        choice("high", "balanced", "low"),
        default=None,
        doc="All on the GPU, or part by part.",
        example="balanced",
    )
    dtype: str | None = key(
        choice("auto", "float32", "bfloat16", "float16"),
        default=None,
        doc="Precision; auto is bfloat16 on a GPU.",
        example="bfloat16",
    )
    variant: str | None = key(text, default=None, doc="File variant.", example="fp16")
    revision: str | None = key(
        text, default=None, doc="Commit or tag of a hub model.", example="115134f"
    )
    offline: bool | None = key(
        flag, default=None, doc="Look only in the local cache.", example="true"
    )
    safety_checker: bool | None = key(
        flag, default=None, doc="Keep the model's safety checker.", example="false"
    )
    ip_adapter: str | None = key(
        text,
        default=None,
        doc="Folder or hub id of an IP-adapter, which shows the exemplar to the model.",
        example="models/ip-adapter",
    )
    ip_adapter_subfolder: str | None = key(
        text, default=None, doc="Folder of its weights within it.", example="sdxl_models"
    )
    ip_adapter_weights: str | None = key(
        text,
        default=None,
        doc="File of its weights.",
        example="ip-adapter_sdxl_vit-h.safetensors",
    )
    ip_adapter_scale: float | None = key(
        number(0.0, 2.0), default=None, doc="How much the exemplar counts.", example="0.5"
    )
    controlnet: str | None = key(
        text, default=None, doc="Folder or hub id of a depth ControlNet.", example="models/depth"
    )
    allow_slow: bool | None = key(
        flag, default=None, doc="Run a full-size model on the CPU.", example="false"
    )

    def given(self) -> dict[str, Any]:
        """Return the settings that are set, as a mapping for the stage."""
        return given(self)


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
        except yaml.YAMLError:
            separator = ""
        if not separator or found[name] is None:
            raise InputError(f"--inpaint takes name=value, got {word!r}", "write it like tile=2")
    return section(InpaintSettings, found, Place("inpaint", Path())).given()
