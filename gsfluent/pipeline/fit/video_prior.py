"""What a video model thinks of a film: score distillation (DreamFusion: Poole et al. 2023).

A clip is encoded to latents x, noised to ``sqrt(a_t) x + sqrt(1 - a_t) e``, and the model guesses
the noise with and without the text. ``w_t (e_guess - e)`` with ``w_t = 1 - a_t`` is the push on the
latents; through the encoder it becomes one on the pixels. OmniPhysGS (Lin et al. 2025) learns laws
so. Pipelines of diffusers with a ``unet`` over [B, C, T, H, W] and a ``vae`` of single pictures are
taken: ModelScope's and zeroscope's text-to-video.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.errors import InputError, need

TIMES = (0.02, 0.98)
"""Of the noise, drawn uniformly between these parts of the schedule."""


class VideoPrior:
    """A text-to-video pipeline, asked what should change in a clip.

    Args:
        model: Folder that ``save_pretrained`` made, or a hub id that is in the local cache.
        prompt: What the film shows.
        negative: What it does not.
        scale: How much more the text counts than nothing (classifier-free guidance; 100 as Poole
            et al. have it).
        device: Where it runs; on a GPU in half precision.

    Raises:
        InputError: A package is missing, the weights are not there, or the pipeline is another.
    """

    def __init__(
        self, model: str | Path, prompt: str, *, negative: str = "", scale: float = 100.0,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        where = "fit: guidance by a video model"
        need("transformers", "inpaint", where)
        diffusers = need("diffusers", "inpaint", where)
        diffusers.utils.logging.set_verbosity_error()
        diffusers.utils.logging.disable_progress_bar()
        self.device, self.scale = torch.device(device), float(scale)
        kind = torch.float16 if self.device.type == "cuda" else torch.float32
        try:
            pipe: Any = diffusers.DiffusionPipeline.from_pretrained(
                str(model), local_files_only=True, use_safetensors=True
            )
        except (OSError, ValueError) as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise InputError(
                f"{model}: no video model can be loaded ({first})",
                "download a text-to-video pipeline beforehand, and give its folder",
            ) from error
        unet, vae = getattr(pipe, "unet", None), getattr(pipe, "vae", None)
        if type(unet).__name__ != "UNet3DConditionModel" or vae is None:
            raise InputError(
                f"{model}: {type(pipe).__name__} has no UNet3DConditionModel",
                "give a text-to-video pipeline such as ModelScope's or zeroscope's",
            )
        pipe.to(self.device, kind)
        self.unet: Any = pipe.unet
        self.vae: Any = pipe.vae
        self.schedule = pipe.scheduler
        for part in (self.unet, self.vae, pipe.text_encoder):
            part.requires_grad_(False)
        with torch.no_grad():
            text, none = pipe.encode_prompt(prompt, self.device, 1, True, negative)
        self.words, self.dtype = torch.cat([none, text]), kind

    def encode(self, clip: Tensor) -> Tensor:
        """Latents of a clip [T, 3, H, W] in 0..1, [1, C, T, h, w]."""
        given = (2.0 * clip - 1.0).to(self.device, self.dtype)
        found: Tensor = self.vae.encode(given).latent_dist.mean * self.vae.config.scaling_factor
        return found.permute(1, 0, 2, 3)[None]

    def push(self, clip: Tensor, random: torch.Generator) -> Tensor:
        """Gradient at the pixels of a clip; a step against it makes the film likelier.

        Args:
            clip: [T, 3, H, W] in 0..1.
            random: Of the time and the noise, on the CPU.

        Returns:
            [T, 3, H, W].
        """
        given = clip.detach().clone().requires_grad_()
        latents = self.encode(given)
        slope = self.distil(latents.detach(), random)
        (found,) = torch.autograd.grad((latents * slope).sum(), given)
        return found

    @torch.no_grad()
    def distil(self, latents: Tensor, random: torch.Generator) -> Tensor:
        """``w_t (e_guess - e)`` at latents, of their shape."""
        share = torch.rand((), generator=random)
        steps = self.schedule.config.num_train_timesteps
        time = int((TIMES[0] + (TIMES[1] - TIMES[0]) * float(share)) * (steps - 1))
        noise = torch.randn(latents.shape, generator=random).to(latents)
        kept = float(self.schedule.alphas_cumprod[time])
        noisy = kept**0.5 * latents + (1.0 - kept) ** 0.5 * noise
        both: Tensor = self.unet(
            torch.cat([noisy, noisy]), torch.tensor(time, device=self.device),
            encoder_hidden_states=self.words,
        ).sample  # fmt: skip
        without, text = both.chunk(2)
        guess = without + self.scale * (text - without)
        kind = self.schedule.config.prediction_type
        if kind == "v_prediction":
            guess = kept**0.5 * guess + (1.0 - kept) ** 0.5 * noisy
        elif kind != "epsilon":
            raise InputError(f"fit: the video model predicts {kind!r}", "give one of the noise")
        return (1.0 - kept) * (guess - noise)
