"""``gsfluent metrics``: statistics without weights, networks with the user's, plain skips."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import linalg, ndimage

from gsfluent.cli import main
from gsfluent.errors import InputError
from gsfluent.inspection.compare import compare, load_pictures
from gsfluent.inspection.compare_weights import (
    Lpips,
    clip_scores,
    frechet_distance,
    inception_features,
    kernel_distance,
)
from gsfluent.io.solid import save_solid
from gsfluent.lab.truth.interiors import known_interior

CPU = torch.device("cpu")


def _picture(seed: int, smooth: float = 2.0, size: int = 80) -> np.ndarray:
    """Coloured noise on a transparent ground, uint8 RGBA."""
    noise = np.random.default_rng(seed).standard_normal((size, size, 3))
    noise = ndimage.gaussian_filter(noise, (smooth, smooth, 0), mode="wrap")
    image = (0.5 + 0.12 * noise / noise.std()).clip(0, 1) * 255
    v, u = np.mgrid[:size, :size] - (size - 1) / 2
    alpha = 255 * (np.hypot(u, v) < 0.45 * size)
    return np.dstack([image, alpha]).astype(np.uint8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Pictures of one material twice, and of a coarser one."""
    root = tmp_path_factory.mktemp("pictures")
    made = {}
    for name, first, smooth in (("one", 0, 2.0), ("two", 10, 2.0), ("coarse", 20, 5.0)):
        made[name] = root / name
        made[name].mkdir()
        for k in range(4):
            picture = Image.fromarray(_picture(first + k, smooth))
            picture.save(made[name] / f"{k}.png")
    return made


def test_statistics_without_weights(folders: dict[str, Path]) -> None:
    same = compare(folders["one"], folders["one"])
    near = compare(folders["one"], folders["two"])
    far = compare(folders["coarse"], folders["two"])
    assert same["patch_distance"] == same["histogram_distance"] == 0.0
    assert same["sharpness_ratio"] == 1.0
    assert near["patch_distance"] < 0.6 * far["patch_distance"]
    assert far["sharpness_ratio"] < 0.5
    assert near["judged"] == {"pictures": 4}
    assert near["size"] == 72  # the disc, not the picture


def test_objects_are_brought_to_one_size(folders: dict[str, Path], tmp_path: Path) -> None:
    big = Image.open(folders["one"] / "0.png").resize((320, 320), Image.Resampling.BICUBIC)
    big.save(tmp_path / "big.png")
    found = compare(tmp_path / "big.png", folders["one"] / "0.png")
    assert found["size"] == 72
    other = compare(folders["coarse"] / "0.png", folders["one"] / "0.png")
    assert found["patch_distance"] < 0.2 * other["patch_distance"]


def test_a_textured_solid_is_compared_by_its_slices(tmp_path: Path) -> None:
    known = known_interior("marble", 32)
    solid = known.solid()
    save_solid(solid, tmp_path / "bare.ply")
    with pytest.raises(InputError, match="no colours inside"):
        load_pictures(tmp_path / "bare.ply")
    save_solid(replace(solid, color=torch.from_numpy(known.rgb)), tmp_path / "stone.ply")
    cut = (known.exemplars()["x"] * 255).round().astype(np.uint8)
    Image.fromarray(cut).save(tmp_path / "cut.png")
    found = compare(tmp_path / "stone.ply", tmp_path / "cut.png")
    assert found["judged"]["pictures"] == 12
    assert len(found["judged"]["neighbour_slice_ratio"]) == 3
    assert 0 < found["histogram_distance"] < 5


def test_absent_weights_give_one_plain_line_and_exit_0(
    folders: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["metrics", str(folders["one"]), str(folders["two"]), "--device", "cpu"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "clip_score: skipped (no CLIP weights given; pass --clip <folder>)\n" in text
    assert "lpips: skipped (no LPIPS weights given; pass --lpips <folder>)\n" in text
    assert "fid: skipped (no Inception weights given; pass --fid <file.pt>)\n" in text
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["clip_score"] is found["lpips"] is found["fid"] is found["kid"] is None
    assert found["patch_distance"] > 0
    assert set(found["skipped"]) == {"clip_score", "lpips", "fid", "kid"}


def test_bad_weights_and_inputs_are_explained(folders: dict[str, Path], tmp_path: Path) -> None:
    one, two = folders["one"], folders["two"]
    with pytest.raises(InputError, match="no CLIP model"):
        compare(one, two, clip=tmp_path, prompt="stone")
    with pytest.raises(InputError, match="alexnet"):
        compare(one, two, lpips=tmp_path)
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "alexnet-x.pth")
    (tmp_path / "alex.pth").write_bytes(b"not weights")
    with pytest.raises(InputError, match="not a file of weights"):
        compare(one, two, lpips=tmp_path)
    torch.save({}, tmp_path / "alex.pth")
    with pytest.raises(InputError, match="weights without"):
        compare(one, two, lpips=tmp_path)
    with pytest.raises(InputError, match="TorchScript"):
        compare(one, two, fid=tmp_path / "alex.pth")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="no pictures"):
        compare(empty, two)
    assert main(["metrics", str(one), str(tmp_path / "none.png")]) == 2


def test_missing_counterparts_are_skips_not_errors(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    one = folders["one"] / "0.png"
    found = compare(one, one, clip=tmp_path, lpips=None, fid=tmp_path)
    assert found["skipped"]["clip_score"] == "no text given; pass --prompt <text>"
    assert "no distribution" in found["skipped"]["fid"]
    found = compare(one, folders["two"], lpips=tmp_path)
    assert "not aligned" in found["skipped"]["lpips"]


@pytest.fixture(scope="module")
def tiny_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CLIP with random weights, saved to a folder."""
    pytest.importorskip("transformers")
    from tokenizers.pre_tokenizers import ByteLevel
    from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPProcessor, CLIPTokenizer

    torch.manual_seed(0)
    letters = sorted(ByteLevel.alphabet())
    words = [*letters, *(s + "</w>" for s in letters), "<|startoftext|>", "<|endoftext|>"]
    tokenizer = CLIPTokenizer(vocab={w: k for k, w in enumerate(words)}, merges=[])
    tokenizer.model_max_length = 77
    shape = dict(hidden_size=32, intermediate_size=37, num_hidden_layers=2, num_attention_heads=4)
    ids = dict(bos_token_id=512, eos_token_id=513, pad_token_id=513)
    text = dict(vocab_size=len(words), max_position_embeddings=77, **ids, **shape)
    vision = dict(image_size=32, patch_size=8, **shape)
    model = CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=16))
    crop = {"height": 32, "width": 32}
    images = CLIPImageProcessor(size={"shortest_edge": 32}, crop_size=crop)
    folder = tmp_path_factory.mktemp("clip")
    model.save_pretrained(folder)
    CLIPProcessor(image_processor=images, tokenizer=tokenizer).save_pretrained(folder)
    return folder


def test_clip_score_is_the_cosine_of_the_embeddings(
    folders: dict[str, Path], tiny_clip: Path
) -> None:
    from transformers import CLIPModel, CLIPProcessor

    images = [_picture(k)[..., :3] for k in range(18)]  # more than one batch
    scores = clip_scores(images, "a cut stone", tiny_clip, CPU)
    assert scores.shape == (18,) and (scores >= 0).all() and (scores <= 100).all()
    model, processor = (c.from_pretrained(tiny_clip) for c in (CLIPModel, CLIPProcessor))
    inputs = processor(
        text=["a cut stone"], images=[Image.fromarray(images[17])], return_tensors="pt"
    )
    with torch.no_grad():
        out = model(**inputs)
        embedded = model.visual_projection(model.vision_model(inputs["pixel_values"]).pooler_output)
    cosine = torch.nn.functional.cosine_similarity(embedded, out.text_embeds)
    assert scores[17] == pytest.approx(100 * max(float(cosine), 0.0), abs=1e-3)
    found = compare(folders["one"], folders["two"], clip=tiny_clip, prompt="a cut stone")
    assert found["clip_score"] >= 0 and "clip_score" not in found["skipped"]


def test_clip_score_depends_on_the_text(tiny_clip: Path) -> None:
    images = [_picture(k)[..., :3] for k in range(3)]
    texts = ("marble", "a red melon with seeds", "wood", "x")
    scores = [clip_scores(images, text, tiny_clip, CPU) for text in texts]
    assert len({tuple(s.tolist()) for s in scores if s.any()} | {()}) > 2


@pytest.fixture(scope="module")
def tiny_lpips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights in the shapes of AlexNet and the heads."""
    generator = torch.Generator().manual_seed(0)
    sizes = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
    backbone, heads = {}, {}
    for k, (place, (out, inner, edge)) in enumerate(sizes.items()):
        weight = torch.randn(out, inner, edge, edge, generator=generator)
        backbone[f"features.{place}.weight"] = weight / (inner * edge**2) ** 0.5
        backbone[f"features.{place}.bias"] = torch.zeros(out)
        heads[f"lin{k}.model.1.weight"] = torch.rand(1, out, 1, 1, generator=generator)
    folder = tmp_path_factory.mktemp("lpips")
    torch.save(backbone, folder / "alexnet-owt-test.pth")
    torch.save(heads, folder / "alex.pth")
    return folder


def test_lpips_is_a_distance(folders: dict[str, Path], tiny_lpips: Path) -> None:
    network = Lpips(tiny_lpips, CPU)
    first, second = _picture(0)[..., :3], _picture(1)[..., :3]
    assert network(first, first) == 0.0
    assert network(first, second) == pytest.approx(network(second, first))
    slightly = (0.9 * first + 0.1 * second).round().astype(np.uint8)
    assert 0 < network(first, slightly) < network(first, second)
    # channels of unit length: the first layer alone is at most 4 times its largest head
    assert network(first, second) <= 4 * sum(float(h.max()) for h in network.heads)
    found = compare(folders["one"], folders["two"], lpips=tiny_lpips)
    assert found["lpips"] > 0


class _Network(torch.nn.Module):
    def forward(self, image: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        x = image.float() / 255
        found = torch.cat([x.mean((2, 3)), x.square().mean((2, 3))], 1)
        return found if return_features else found[:, :1]


def test_fid_and_kid_of_a_torchscript_network(folders: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "inception.pt"
    torch.jit.script(_Network()).save(str(path))
    images = [_picture(k)[..., :3] for k in range(4)]
    features = inception_features(images, path, CPU)
    assert features.shape == (4, 6)
    assert features[2, :3] == pytest.approx(images[2].mean((0, 1)) / 255, abs=1e-5)
    found = compare(folders["one"], folders["coarse"], fid=path)
    assert found["fid"] > 0 and np.isfinite(found["kid"])
    assert compare(folders["one"], folders["one"], fid=path)["fid"] == pytest.approx(0, abs=1e-9)


def test_frechet_distance_is_that_of_gaussians() -> None:
    rng = np.random.default_rng(0)
    first = rng.standard_normal((4000, 5)) @ rng.standard_normal((5, 5))
    second = rng.standard_normal((4000, 5)) @ rng.standard_normal((5, 5)) + 1.0
    one, two = (np.cov(f, rowvar=False) for f in (first, second))
    root = linalg.sqrtm(one @ two)
    expected = ((first.mean(0) - second.mean(0)) ** 2).sum() + np.trace(one + two - 2 * root.real)
    assert frechet_distance(first, second) == pytest.approx(expected, rel=1e-6)
    assert frechet_distance(first, first + 2.0) == pytest.approx(20.0)


def test_kernel_distance_is_unbiased() -> None:
    rng = np.random.default_rng(0)
    same = [
        kernel_distance(rng.standard_normal((20, 4)), rng.standard_normal((20, 4)))
        for _ in range(400)
    ]
    assert abs(np.mean(same)) < 3 * np.std(same) / 20
    apart = kernel_distance(rng.standard_normal((50, 4)), rng.standard_normal((50, 4)) + 1.0)
    assert apart > 5 * np.std(same)
