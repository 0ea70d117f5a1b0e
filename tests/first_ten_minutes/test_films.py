"""One command without a written shot, from what people have to a film.

The looks of the film and the errors on the way are tested elsewhere; here it is that each kind of
input gets there: splats, a model folder, a textured mesh. Sizes are tiny. Photographs stand in
test_photographs.py; a PhysGaussian folder with its config: tests/cli/test_physgaussian_run.py.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from first_film import first_film
from physgaussian_model import write_model
from PIL import Image

from gsfluent.data import Gaussians
from gsfluent.io import save_splats
from gsfluent.io.splats import save_spz

Maker = Callable[[Path], Path]
RADIUS = 0.3


def shell() -> Gaussians:
    """Splats on a ball with red and white stripes."""
    count = 1500
    index = torch.arange(count) + 0.5
    polar, turn = torch.acos(1 - 2 * index / count), math.pi * (1 + math.sqrt(5)) * index
    unit = torch.stack([turn.cos() * polar.sin(), turn.sin() * polar.sin(), polar.cos()], dim=-1)
    stripe = (unit[:, :1] * 9).sin() > 0
    colors = torch.where(stripe, torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.9, 0.9, 0.9]))
    size = torch.full((count,), 0.6 * RADIUS * math.sqrt(4 * math.pi / count))
    return Gaussians.from_colors(RADIUS * unit, size, colors, opacities=0.95)


def splat(folder: Path) -> Path:
    save_splats(shell(), folder / "thing.ply")
    return folder / "thing.ply"


def compressed_splat(folder: Path) -> Path:
    save_splats(shell(), folder / "thing.compressed.ply", compressed=True)
    return folder / "thing.compressed.ply"


def spz(folder: Path) -> Path:
    save_spz(shell(), folder / "thing.spz")
    return folder / "thing.spz"


def sog(folder: Path) -> Path:
    """Version 2 of the format, written from its description: bytes in pictures, code books."""
    splats = shell()
    count, width = splats.count, 40
    rows = -(-count // width)

    def webp(values: np.ndarray) -> bytes:
        full = np.zeros((rows * width, 4), np.uint8)
        full[:count] = values
        made = io.BytesIO()
        Image.fromarray(full.reshape(rows, width, 4)).save(made, "WEBP", lossless=True, exact=True)
        return made.getvalue()

    def coded(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
        book = np.linspace(values.min(), values.max() + 1e-6, 256)
        return np.abs(values[..., None] - book).argmin(axis=-1).astype(np.uint8), book.tolist()

    bent = splats.means.double().numpy()
    bent = np.sign(bent) * np.log1p(np.abs(bent))
    low, high = bent.min(axis=0), bent.max(axis=0)
    level = np.round((bent - low) / (high - low) * 65535).astype(np.int64)
    full = np.full((count, 1), 255)
    size, sizes = coded(np.log(splats.scales.double().numpy()))
    color, colors = coded(splats.sh[:, 0].double().numpy())
    opacity = np.round(255 * splats.opacities.double().numpy())[:, None]
    still = np.tile([[127, 127, 127, 252]], (count, 1))  # (1, 0, 0, 0), its largest left out
    files = {
        "means_l.webp": np.hstack([level % 256, full]),
        "means_u.webp": np.hstack([level // 256, full]),
        "scales.webp": np.hstack([size, full]),
        "quats.webp": still,
        "sh0.webp": np.hstack([color, opacity]),
    }
    meta = {
        "version": 2, "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(),
                  "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": sizes, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors, "files": ["sh0.webp"]},
    }  # fmt: skip
    with zipfile.ZipFile(folder / "thing.sog", "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, values in files.items():
            archive.writestr(name, webp(values))
    return folder / "thing.sog"


def model_folder(folder: Path) -> Path:
    """A model of the INRIA trainer, as PhysGaussian takes it, without a config."""
    return write_model(folder / "model")


def textured_mesh(folder: Path) -> Path:
    """An OBJ with a texture."""
    box = trimesh.creation.box((0.4, 1.0, 0.5))
    picture = np.zeros((16, 16, 3), dtype=np.uint8)
    picture[:8] = [200, 30, 30]
    picture[8:] = [230, 230, 230]
    at = np.clip(box.vertices[:, :2] + 0.5, 0.0, 1.0)
    skin = trimesh.visual.TextureVisuals(uv=at, image=Image.fromarray(picture))
    box.visual = skin
    box.export(folder / "crate.obj")
    return folder / "crate.obj"


@pytest.mark.parametrize(
    "make",
    [splat, compressed_splat, spz, sog, model_folder, textured_mesh],
)
def test_one_command_makes_a_film(
    make: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "in"
    place.mkdir()
    first_film(make(place), tmp_path / "out", capsys)


@pytest.mark.data
def test_a_real_toy_in_sog(
    tmp_path: Path, data_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = data_root / "splats" / "playbot" / "sog_lod3"
    if not place.is_dir():
        pytest.skip(f"no {place}")
    with zipfile.ZipFile(tmp_path / "toy.sog", "w") as archive:  # as its errors say
        for path in sorted(place.iterdir()):
            archive.write(path, path.name)
    first_film(tmp_path / "toy.sog", tmp_path / "out", capsys)
