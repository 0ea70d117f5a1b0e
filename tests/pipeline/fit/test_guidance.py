"""Guidance by a video model with random weights: its gradient, its bits, and a search by it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fit_scenes import SIDE, elastic, scene
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.guidance import Film, Guide
from gsfluent.pipeline.fit.video_prior import VideoPrior


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A text-to-video pipeline with random weights, saved to a folder."""
    pytest.importorskip("transformers")
    from diffusers import AutoencoderKL, DDIMScheduler, TextToVideoSDPipeline, UNet3DConditionModel
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    torch.manual_seed(0)
    letters = sorted(ByteLevel.alphabet())
    words = [*letters, *(s + "</w>" for s in letters), "<|startoftext|>", "<|endoftext|>"]
    tokenizer = CLIPTokenizer(vocab={w: k for k, w in enumerate(words)}, merges=[])
    tokenizer.model_max_length = 77
    text = CLIPTextConfig(
        vocab_size=len(words), hidden_size=32, intermediate_size=37, num_hidden_layers=1,
        num_attention_heads=4, max_position_embeddings=77, bos_token_id=512, eos_token_id=513,
        pad_token_id=513,
    )  # fmt: skip
    unet = UNet3DConditionModel(
        block_out_channels=(8, 8), layers_per_block=1, in_channels=4, out_channels=4,
        down_block_types=("CrossAttnDownBlock3D", "DownBlock3D"),
        up_block_types=("UpBlock3D", "CrossAttnUpBlock3D"), cross_attention_dim=32,
        attention_head_dim=4, norm_num_groups=2, sample_size=8,
    )  # fmt: skip
    vae = AutoencoderKL(
        block_out_channels=(8, 8), down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2, latent_channels=4, norm_num_groups=2,
        sample_size=16,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("video")
    TextToVideoSDPipeline(
        vae=vae, unet=unet, text_encoder=CLIPTextModel(text), tokenizer=tokenizer,
        scheduler=DDIMScheduler(),
    ).save_pretrained(folder)  # fmt: skip
    return folder


def test_the_push_is_that_of_the_formula(model: Path) -> None:
    """w (e_guess - e) at the latents by hand, and its pull through the encoder by differences."""
    prior = VideoPrior(model, "a falling cube of jelly", scale=7.0)
    clip = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    push = prior.push(clip, torch.Generator().manual_seed(5))
    random = torch.Generator().manual_seed(5)
    time = int((0.02 + 0.96 * float(torch.rand((), generator=random))) * 999)
    with torch.no_grad():
        latents = prior.encode(clip)
        noise = torch.randn(latents.shape, generator=random)
        kept = prior.schedule.alphas_cumprod[time]
        noisy = kept.sqrt() * latents + (1 - kept).sqrt() * noise
        none, text = (
            prior.unet(noisy, torch.tensor(time), encoder_hidden_states=w[None]).sample
            for w in prior.words
        )
        wanted = (1 - kept) * (none + 7.0 * (text - none) - noise)
        assert float((text - none).abs().max()) > 1e-6
        found = prior.distil(latents, torch.Generator().manual_seed(5))
        torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)
        prior.vae.double()
        prior.dtype = torch.float64
        way = torch.randn(clip.shape, generator=random, dtype=torch.float64)
        ahead, behind = (prior.encode(clip.double() + h * way) for h in (1e-5, -1e-5))
        slope = float(((ahead - behind) * wanted.double()).sum()) / 2e-5
    assert float((push.double() * way).sum()) == pytest.approx(slope, rel=1e-3)


def test_the_same_seed_gives_the_same_bits(model: Path) -> None:
    def found(seed: int) -> dict[str, float]:
        prior = VideoPrior(model, "rubber")
        guide = Guide(["thing.young_modulus"], prior, seconds=0.2, frames=3, size=16, rounds=2,
                      cells=4, seed=seed)  # fmt: skip
        made = guide(scene(elastic(5e4)))
        assert made.sd == {} and "not measured" in made.report["warnings"][0]
        assert made.scene.bodies[0].material.young_modulus == made.values["thing.young_modulus"]
        assert made.report["runs"] == 4 and len(made.report["trace"]) == 3
        return made.values

    one = found(3)
    assert one == found(3) and one["thing.young_modulus"] != 5e4


class Wish:
    """Wants a clip that is given."""

    def __init__(self, clip: Tensor) -> None:
        self.clip = clip

    def push(self, clip: Tensor, random: torch.Generator) -> Tensor:
        return clip - self.clip


def test_numbers_follow_the_push() -> None:
    """A prior that wants the film of another velocity and stiffness gets it."""
    times = np.linspace(0.0, 0.3, 6).tolist()
    truth = Forward(scene(elastic(1e5), velocity=(0.0, 0.0, -2.0)), times, SIDE / 4)
    filmed = Film(truth, 32)
    clip = filmed(truth.run({}, 6, truth.step({})))
    assert float(clip.min()) < 0.6  # the thing is in the picture
    guide = Guide(["thing.velocity"], Wish(clip), seconds=0.3, frames=6, size=32, rounds=40,
                  cells=4, camera=filmed.camera)  # fmt: skip
    found = guide(scene(elastic(1e5), velocity=(0.0, 0.0, -1.0)))
    assert found.values["thing.velocity"][2] == pytest.approx(-2.0, abs=0.15)


def test_what_is_no_video_model_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no video model can be loaded"):
        VideoPrior(tmp_path, "rubber")
    with pytest.raises(InputError, match="rounds"):
        Guide(["thing.velocity"], Wish(torch.zeros(1)), rounds=0)
