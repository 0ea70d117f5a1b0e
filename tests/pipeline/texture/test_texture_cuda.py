"""Exemplar synthesis and cut views on a GPU against those on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsfluent.lab.truth.interiors import known_interior
from gsfluent.pipeline import Texture
from gsfluent.pipeline.render.cuts import cut_view
from gsfluent.pipeline.texture.photo.exemplar import load_exemplars
from gsfluent.pipeline.texture.synthesis.method import exemplar_texture

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


@pytest.mark.parametrize("name", ["bread", "orange", "cake"])
def test_a_gpu_makes_the_same_kind_of_inside_and_the_same_one_every_time(name: str) -> None:
    known = known_interior(name, 48, 0)
    photographs = load_exemplars(known.exemplars())
    first, again, expected = (
        exemplar_texture(known.domain, photographs, seed=0, device=device, **known.settings).rgb
        for device in ("cuda", "cuda", "cpu")
    )
    inside = known.domain.inside
    assert np.array_equal(first, again)
    # sums in another order choose other patches here and there: colours agree as a distribution
    levels = np.linspace(0.02, 0.98, 49)
    gpu, cpu = (np.quantile(volume[inside], levels, axis=0) for volume in (first, expected))
    assert np.abs(gpu - cpu).mean() < 0.02
    assert not first[~inside].any()


def test_a_solid_on_a_gpu_is_textured_and_cut() -> None:
    known = known_interior("bread", 48, 0)
    solid = known.solid()
    textured = [
        Texture(exemplar=known.exemplars(), device=device, seed=0)(solid.to(device))
        for device in ("cpu", "cuda")
    ]
    cut = [cut_view(one, "x", size=128) for one in textured]
    assert textured[1].color is not None and textured[1].color.device.type == "cuda"
    assert cut[0].shape == cut[1].shape
    assert np.abs(cut[0] - cut[1]).mean() < 0.06
