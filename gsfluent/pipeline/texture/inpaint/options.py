"""Settings of texturing by inpainted slices."""

from __future__ import annotations

from dataclasses import dataclass

from gsfluent.errors import InputError, check_choice

BACKENDS = ("diffusers", "command", "exemplar", "telea", "color")
_CHOICES = {
    "backend": BACKENDS,
    "coarse": ("", *BACKENDS),
    "schedule": ("paper", "coupled"),
    "dtype": ("auto", "float32", "bfloat16", "float16"),
    "memory": ("high", "balanced", "low"),
}


@dataclass(frozen=True)
class InpaintOptions:
    """Settings of the slice methods.

    Attributes:
        backend: Who fills the holes: ``diffusers``, ``command`` (a program of the user's),
            ``exemplar`` (patches of the photograph), ``telea`` or ``color``.
        coarse: Backend of the first pass along X, when another one: ``command`` for a multi-view
            model. Empty takes ``backend``.
        command: Program of the backend ``command``, with ``{folder}``
            (:class:`~.inpaint_command.CommandInpainter`).
        window: Slices per run of the command.
        overlap: Slices shared by neighbouring runs.
        schedule: ``paper``: X alone at ``strength``, then rounds over X, Y and Z; ``coupled``: all
            three axes together from a quarter of the resolution on.
        slices: Slices per axis (fewer when the object has fewer voxels).
        strength: Denoising strength of the first pass.
        refine: Strengths of the following rounds, each over X, Y and Z.
        tile: Neighbouring slices along an edge of one picture: 1, 2 or 4.
        match_colors: Bring the colours of every slice back to the exemplar's (without one: to
            those of its whole stack), within depth ranges, before slices are fused.
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
        offline: Look only in the local cache, as ``HF_HUB_OFFLINE=1`` does.
        safety_checker: Keep the pipeline's safety checker. Off by default: it knows photographs
            of people, slices are none, and its false alarms come back as black pictures.
        ip_adapter: Folder or hub id of an IP-adapter, which shows the exemplar to the model.
        ip_adapter_subfolder: Folder of its weights within it.
        ip_adapter_weights: File of its weights.
        ip_adapter_scale: How much the exemplar counts beside the prompt.
        controlnet: Folder or hub id of a depth ControlNet; it is shown the depth of every slice.
        controlnet_scale: How much that counts.
        allow_slow: Run a full-size model on the CPU.
    """

    backend: str = "diffusers"
    coarse: str = ""
    command: str = ""
    window: int = 24
    overlap: int = 4
    schedule: str = "paper"
    slices: int = 40
    strength: float = 0.99
    refine: tuple[float, ...] = (0.3, 0.2)
    tile: int = 1
    match_colors: bool = True
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
    offline: bool = False
    safety_checker: bool = False
    ip_adapter: str | None = None
    ip_adapter_subfolder: str = ""
    ip_adapter_weights: str | None = None
    ip_adapter_scale: float = 0.5
    controlnet: str | None = None
    controlnet_scale: float = 0.5
    allow_slow: bool = False

    def __post_init__(self) -> None:
        """Check ranges."""
        object.__setattr__(self, "refine", tuple(float(r) for r in self.refine))
        for name, value in [("strength", self.strength), *(("refine", r) for r in self.refine)]:
            if not 0.0 < value <= 1.0:
                raise InputError(
                    f"texture: inpaint {name} must be in 0..1, got {value}",
                    hint="0.99 for the first pass and 0.1 to 0.4 for the others are usual",
                )
        for name in ("slices", "steps", "batch", "window"):
            if getattr(self, name) < 1:
                raise InputError(
                    f"texture: inpaint {name} must be at least 1, got {getattr(self, name)}",
                    hint="leave it out",
                )
        check_choice("texture: inpaint tile", self.tile, (1, 2, 4), "leave it out")
        if self.size is not None and self.size < 16:
            raise InputError(
                f"texture: inpaint size must be at least 16, got {self.size}",
                hint="leave it out: the model knows its own",
            )
        for name, allowed in _CHOICES.items():
            hint = "leave it out"
            if name == "memory":
                hint = "use balanced when the GPU runs out of memory"
            check_choice(f"texture: inpaint {name}", getattr(self, name), allowed, hint)
        if "command" in (self.backend, self.coarse) and not self.command:
            raise InputError(
                "texture: inpaint backend 'command' needs a command",
                hint='add command: "python infer.py --folder {folder}"',
            )
