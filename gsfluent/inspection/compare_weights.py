"""Metrics of pictures that need a network's weights. The user brings them; nothing is fetched.

Figures of another backbone, prompt or crop are not comparable; say which you used.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.errors import InputError, need

_BATCH = 16


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__


def clip_scores(
    images: Sequence[np.ndarray], prompt: str, model: str | Path, device: torch.device
) -> np.ndarray:
    """CLIP score of pictures with a text (Hessel et al. 2021, without their factor 2.5).

    Args:
        images: uint8 [H, W, 3] each.
        prompt: The text.
        model: Folder of a CLIP model and its processor, or a hub id that is in the local cache.
        device: Where to run it.

    Returns:
        100 max(cos, 0) per picture, [n].

    Raises:
        InputError: No usable model there.
    """
    from PIL import Image

    need("transformers", "inpaint", "--clip")
    from transformers import CLIPModel, CLIPProcessor

    try:
        network: Any = CLIPModel.from_pretrained(
            str(model), local_files_only=True, use_safetensors=True
        )
        processor = CLIPProcessor.from_pretrained(str(model), local_files_only=True)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"--clip {model}: no CLIP model with its processor ({_first_line(error)})",
            "give a folder that save_pretrained wrote, with model.safetensors",
        ) from error
    network.to(device).eval()
    scores = []
    for start in range(0, len(images), _BATCH):
        pictures = [Image.fromarray(image) for image in images[start : start + _BATCH]]
        inputs = processor(
            text=[prompt], images=pictures, return_tensors="pt", padding=True, truncation=True
        )
        with torch.no_grad():
            out = network(**inputs.to(device))
        cosine = functional.cosine_similarity(out.image_embeds, out.text_embeds)
        scores.append(100.0 * cosine.clamp_min(0.0).float().cpu().numpy())
    return np.concatenate(scores)


class Lpips:
    """Learned perceptual distance of aligned pictures, AlexNet version (Zhang et al. 2018).

    Args:
        folder: Holds AlexNet's weights as torchvision publishes them (``alexnet*.pth``) and the
            linear heads of LPIPS (``alex.pth``).
        device: Where to run it.

    Raises:
        InputError: A file is missing or is not what it should be.
    """

    # stride, padding and whether a pooling comes before; keys are those of torchvision
    _LAYERS = (
        (0, 4, 2, False),
        (3, 1, 2, True),
        (6, 1, 1, True),
        (8, 1, 1, False),
        (10, 1, 1, False),
    )

    def __init__(self, folder: str | Path, device: torch.device) -> None:
        folder = Path(folder)
        backbone = _one_file(folder, "alexnet*.pth")
        heads = _state(_one_file(folder, "alex.pth"))
        state = _state(backbone)
        try:
            self.layers = [
                (state[f"features.{k}.weight"].to(device), state[f"features.{k}.bias"].to(device))
                for k, *_ in self._LAYERS
            ]
            self.heads = [heads[f"lin{k}.model.1.weight"].to(device) for k in range(5)]
        except KeyError as error:
            raise InputError(
                f"--lpips {folder}: weights without {error}",
                "give torchvision's alexnet-owt-*.pth and the alex.pth of the lpips package (v0.1)",
            ) from error
        self.device = device

    def __call__(self, first: np.ndarray, second: np.ndarray) -> float:
        """Distance of two pictures uint8 [H, W, 3] of one size."""
        with torch.no_grad():
            pairs = zip(self._features(first), self._features(second), self.heads, strict=True)
            return float(sum((head * (a - b) ** 2).sum(1).mean() for a, b, head in pairs))

    def _features(self, image: np.ndarray) -> list[Tensor]:
        """Activations of the five layers, of unit length over the channels."""
        x = (
            torch.from_numpy(image.copy()).to(self.device).permute(2, 0, 1)[None].float() / 127.5
            - 1
        )
        shift = x.new_tensor([-0.030, -0.088, -0.188])[:, None, None]
        scale = x.new_tensor([0.458, 0.448, 0.450])[:, None, None]
        x = (x - shift) / scale
        found = []
        for (weight, bias), (_, stride, pad, pool) in zip(self.layers, self._LAYERS, strict=True):
            if pool:
                x = functional.max_pool2d(x, 3, 2)
            x = functional.conv2d(x, weight, bias, stride, pad).relu()
            found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return found


def _one_file(folder: Path, pattern: str) -> Path:
    files = sorted(folder.glob(pattern)) if folder.is_dir() else []
    if not files:
        raise InputError(
            f"--lpips {folder}: no {pattern} there",
            "put torchvision's alexnet-owt-*.pth and the lpips package's alex.pth into one folder",
        )
    return files[0]


def _state(path: Path) -> dict[str, Tensor]:
    import pickle

    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: not a file of weights ({error})", "fetch it again") from error
    if not isinstance(state, dict):
        raise InputError(f"{path}: not a state dict", "fetch it again")
    return state


def inception_features(
    images: Sequence[np.ndarray], path: str | Path, device: torch.device
) -> np.ndarray:
    """Features [n, F] of pictures uint8 [H, W, 3] by a TorchScript network.

    Args:
        images: The pictures.
        path: For example ``inception-2015-12-05.pt``, the original FID network as TorchScript. It
            takes uint8 [n, 3, H, W] and resizes for itself.
        device: Where to run it.

    Raises:
        InputError: Not a TorchScript file, or it does not give one row per picture.
    """
    path = Path(path)
    try:
        network: Any = torch.jit.load(str(path), map_location=device).eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(
            f"--fid {path}: not a TorchScript file ({_first_line(error)})",
            "give inception-2015-12-05.pt (the Inception network of FID as TorchScript)",
        ) from error
    names = [argument.name for argument in network.forward.schema.arguments]
    extra = {"return_features": True} if "return_features" in names else {}
    rows = []
    with torch.no_grad():
        for image in images:
            batch = torch.from_numpy(image.copy()).permute(2, 0, 1)[None].to(device)
            rows.append(network(batch, **extra).float().cpu().reshape(1, -1))
    return torch.cat(rows).double().numpy()


def frechet_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Frechet distance of Gaussians fitted to features [n, F] and [m, F] (Heusel et al. 2017)."""
    means = first.mean(0) - second.mean(0)
    one, two = (np.atleast_2d(np.cov(f, rowvar=False)) for f in (first, second))
    values, vectors = np.linalg.eigh(one)
    root = (vectors * np.sqrt(values.clip(0.0))) @ vectors.T
    # the trace of (C1 C2)^(1/2) is that of the symmetric (C1^(1/2) C2 C1^(1/2))^(1/2)
    cross = np.sqrt(np.linalg.eigvalsh(root @ two @ root).clip(0.0)).sum()
    return float(means @ means + np.trace(one) + np.trace(two) - 2.0 * cross)


def kernel_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Unbiased squared MMD under (x.y / F + 1)^3 (KID; Binkowski et al. 2018).

    It is 0 in expectation for equal distributions, however few the pictures, and so may be
    negative.
    """
    width = first.shape[1]

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        result: np.ndarray = (a @ b.T / width + 1.0) ** 3
        return result

    n, m = len(first), len(second)
    own, other = kernel(first, first), kernel(second, second)
    within = (own.sum() - np.trace(own)) / (n * (n - 1))
    within += (other.sum() - np.trace(other)) / (m * (m - 1))
    return float(within - 2.0 * kernel(first, second).mean())
