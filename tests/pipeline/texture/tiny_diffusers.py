"""Diffusers pipelines with random weights of a few megabytes, built from configs, saved to disk.

They show that the plumbing works: shapes, masks, seeds, memory modes. Their pictures mean nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch


def clip_tokenizer() -> Any:
    """Byte-level CLIP tokenizer without merges: 256 bytes, the same as word ends, two marks."""
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPTokenizer

    symbols = sorted(ByteLevel.alphabet())
    words = symbols + [s + "</w>" for s in symbols] + ["<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: i for i, word in enumerate(words)}
    return CLIPTokenizer(vocab=vocabulary, merges=[], model_max_length=77)


def _t5_tokenizer() -> Any:
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    letters = [(chr(c), -3.0) for c in range(33, 127)]
    table = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("▁", -2.0), *letters]
    tokenizer = Tokenizer(models.Unigram(table, unk_id=2))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>", unk_token="<unk>",
        model_max_length=64,
    )  # fmt: skip


def _text_config(vocabulary: int) -> Any:
    from transformers import CLIPTextConfig

    return CLIPTextConfig(
        vocab_size=vocabulary,
        hidden_size=32,
        intermediate_size=37,
        num_hidden_layers=2,
        num_attention_heads=4,
        max_position_embeddings=77,
        projection_dim=32,
        # pooled text is taken at the first end token: with another id it ignores the text
        bos_token_id=vocabulary - 2,
        eos_token_id=vocabulary - 1,
        pad_token_id=vocabulary - 1,
    )


def _vae(latent_channels: int = 4, **extra: Any) -> Any:
    from diffusers import AutoencoderKL

    return AutoencoderKL(
        block_out_channels=(16, 32, 32, 32),
        norm_num_groups=8,
        latent_channels=latent_channels,
        layers_per_block=1,
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        **extra,
    )


_UNET: dict[str, Any] = {
    "sample_size": 8,
    "out_channels": 4,
    "layers_per_block": 1,
    "block_out_channels": (32, 64),
    "norm_num_groups": 8,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
    "attention_head_dim": (2, 4),
}
_XL: dict[str, Any] = {
    "use_linear_projection": True,
    "transformer_layers_per_block": (1, 1),
    "addition_embed_type": "text_time",
    "addition_time_embed_dim": 8,
    "projection_class_embeddings_input_dim": 6 * 8 + 32,
    "cross_attention_dim": 64,
}


def save_sdxl(folder: Path, channels: int = 9) -> Path:
    """SD-XL inpainting: 9 UNet inputs as the trained one, or 4 as the base model."""
    from diffusers import (
        EulerDiscreteScheduler,
        StableDiffusionXLInpaintPipeline,
        StableDiffusionXLPipeline,
        UNet2DConditionModel,
    )
    from transformers import CLIPTextModel, CLIPTextModelWithProjection

    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    text = _text_config(len(tokenizer))
    kind = StableDiffusionXLInpaintPipeline if channels == 9 else StableDiffusionXLPipeline
    pipe = kind(
        vae=_vae(),
        text_encoder=CLIPTextModel(text),
        text_encoder_2=CLIPTextModelWithProjection(text),
        tokenizer=tokenizer,
        tokenizer_2=tokenizer,
        unet=UNet2DConditionModel(in_channels=channels, **_UNET, **_XL),
        scheduler=EulerDiscreteScheduler(steps_offset=1),
        add_watermarker=False,
    )
    pipe.save_pretrained(folder)
    return folder


def save_sd15(folder: Path) -> Path:
    """SD 1.5 inpainting with a safety checker."""
    from diffusers import (
        DDIMScheduler,
        StableDiffusionInpaintPipeline,
        UNet2DConditionModel,
    )
    from diffusers.pipelines.stable_diffusion import StableDiffusionSafetyChecker
    from transformers import CLIPConfig, CLIPImageProcessor, CLIPTextModel

    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    text = _text_config(len(tokenizer))
    checker = CLIPConfig(
        text_config={"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2},
        vision_config=_vision(),
        projection_dim=32,
    )
    pipe = StableDiffusionInpaintPipeline(
        vae=_vae(),
        text_encoder=CLIPTextModel(text),
        tokenizer=tokenizer,
        unet=UNet2DConditionModel(in_channels=9, cross_attention_dim=32, **_UNET),
        scheduler=DDIMScheduler(clip_sample=False),
        safety_checker=StableDiffusionSafetyChecker(checker),
        feature_extractor=CLIPImageProcessor(size=32, crop_size=32),
        requires_safety_checker=True,
    )
    pipe.save_pretrained(folder)
    return folder


def _vision() -> dict[str, Any]:
    return {
        "hidden_size": 32,
        "intermediate_size": 37,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 32,
        "patch_size": 16,
        "projection_dim": 32,
    }


def save_flux(folder: Path, kind: str = "FluxFillPipeline") -> Path:
    """FLUX.1 Fill or Kontext: outside AutoPipeline's table, each with arguments of its own."""
    import diffusers
    from transformers import CLIPTextModel, T5Config, T5EncoderModel

    torch.manual_seed(0)
    clip, t5 = clip_tokenizer(), _t5_tokenizer()
    transformer = diffusers.FluxTransformer2DModel(
        in_channels=16 * 4 * 2 + 256 if kind == "FluxFillPipeline" else 64,
        out_channels=64,
        num_layers=1,
        num_single_layers=1,
        attention_head_dim=16,
        num_attention_heads=2,
        joint_attention_dim=32,
        pooled_projection_dim=32,
        axes_dims_rope=(4, 4, 8),
        guidance_embeds=True,
    )
    encoder = T5Config(vocab_size=len(t5), d_model=32, d_kv=8, d_ff=37, num_layers=1, num_heads=4)
    pipe = getattr(diffusers, kind)(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=_vae(16, use_quant_conv=False, use_post_quant_conv=False, shift_factor=0.1),
        text_encoder=CLIPTextModel(_text_config(len(clip))),
        tokenizer=clip,
        text_encoder_2=T5EncoderModel(encoder),
        tokenizer_2=t5,
        transformer=transformer,
    )
    pipe.save_pretrained(folder)
    return folder


def save_sd3(folder: Path) -> Path:
    """Stable Diffusion 3 without its T5 encoder, as it is often used."""
    import diffusers
    from transformers import CLIPTextModelWithProjection

    torch.manual_seed(0)
    clip = clip_tokenizer()
    text = _text_config(len(clip))
    transformer = diffusers.SD3Transformer2DModel(
        sample_size=8,
        patch_size=2,
        in_channels=16,
        num_layers=1,
        attention_head_dim=8,
        num_attention_heads=4,
        joint_attention_dim=64,
        caption_projection_dim=32,
        pooled_projection_dim=64,
        out_channels=16,
        pos_embed_max_size=16,
    )
    pipe = diffusers.StableDiffusion3Pipeline(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=_vae(16, use_quant_conv=False, use_post_quant_conv=False, shift_factor=0.1),
        text_encoder=CLIPTextModelWithProjection(text),
        tokenizer=clip,
        text_encoder_2=CLIPTextModelWithProjection(text),
        tokenizer_2=clip,
        text_encoder_3=None,
        tokenizer_3=None,
        transformer=transformer,
    )
    pipe.save_pretrained(folder)
    return folder


def save_ip_adapter(folder: Path, model: Path, encoder: bool = True) -> Path:
    """IP-adapter for the SD-XL of :func:`save_sdxl`, with or without its image encoder."""
    from diffusers import UNet2DConditionModel
    from safetensors.torch import save_file
    from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModelWithProjection

    torch.manual_seed(0)
    unet = UNet2DConditionModel.from_pretrained(model / "unet", local_files_only=True)
    width = unet.config.cross_attention_dim
    tokens = 4
    weights = {
        "image_proj.proj.weight": torch.randn(tokens * width, 32) * 0.1,
        "image_proj.proj.bias": torch.zeros(tokens * width),
        "image_proj.norm.weight": torch.ones(width),
        "image_proj.norm.bias": torch.zeros(width),
    }
    number = 1
    for name in unet.attn_processors:
        if not name.endswith("attn2.processor"):
            continue
        module = unet.get_submodule(name.removesuffix(".processor"))
        for kind in ("k", "v"):
            shape = (module.to_k.weight.shape[0], width)
            weights[f"ip_adapter.{number}.to_{kind}_ip.weight"] = torch.randn(shape) * 0.3
        number += 2
    folder.mkdir(parents=True, exist_ok=True)
    save_file(weights, str(folder / "ip_adapter.safetensors"))
    if encoder:
        vision = CLIPVisionModelWithProjection(CLIPVisionConfig(**_vision()))
        vision.save_pretrained(folder / "image_encoder")
        CLIPImageProcessor(size=32, crop_size=32).save_pretrained(folder / "feature_extractor")
    return folder


def save_controlnet(folder: Path) -> Path:
    """Depth ControlNet for the 4-channel SD-XL of :func:`save_sdxl`."""
    from diffusers import ControlNetModel

    torch.manual_seed(0)
    shared = {k: v for k, v in _UNET.items() if k not in ("sample_size", "out_channels")}
    shared.pop("up_block_types")
    net = ControlNetModel(
        in_channels=4, conditioning_embedding_out_channels=(4, 8, 8, 16), **shared, **_XL
    )
    for weights in net.parameters():  # untrained it starts as zeros, and says nothing
        if not weights.any():
            torch.nn.init.normal_(weights, std=0.3)
    net.save_pretrained(folder)
    return folder
