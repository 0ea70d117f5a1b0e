"""Density control: laws of relocation, budgets, error targets, exposure and resumed runs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gsfluent import demo
from gsfluent.data import Capture, Gaussians
from gsfluent.errors import InputError
from gsfluent.io import load_capture, load_image
from gsfluent.metrics import psnr
from gsfluent.pipeline.capture.views import TrainView
from gsfluent.pipeline.reconstruct.density import (
    Adc,
    Mcmc,
    Place,
    Wanted,
    densify,
    draws,
    grow,
    relocate,
    reset_opacities,
    shared_out,
)
from gsfluent.pipeline.reconstruct.evaluate import write_report
from gsfluent.pipeline.reconstruct.model import Exposure, SplatModel
from gsfluent.pipeline.reconstruct.recipe import LONG, QUICK, LearningRates, recipe_for
from gsfluent.pipeline.reconstruct.stage import Reconstruct
from gsfluent.pipeline.reconstruct.target import ErrorTarget, attributed

SIZE = 48


def cloud(count: int = 120, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=g) - 0.5
    scales = 0.02 + 0.06 * torch.rand(count, 3, generator=g)
    return Gaussians.from_colors(
        means,
        scales,
        torch.rand(count, 3, generator=g),
        opacities=0.1 + 0.8 * torch.rand(count, generator=g),
        quats=torch.randn(count, 4, generator=g),
    )


def model_of(gaussians: Gaussians) -> SplatModel:
    return SplatModel(gaussians, 1.0, isotropic=False, rates=LearningRates())


def camera(turn: float = 0.0) -> TrainView:
    c, s = math.cos(turn), math.sin(turn)
    viewmat = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 3], [0, 0, 0, 1.0]])
    K = torch.tensor([[70.0, 0, 0.5 * SIZE], [0, 70.0, 0.5 * SIZE], [0, 0, 1]])
    black = torch.zeros(SIZE, SIZE, 3)
    return TrainView(black, None, None, viewmat, K, SIZE)


def photographed(model: SplatModel, view: TrainView) -> TrainView:
    color = model.render(view, 0).image
    return TrainView(color, None, None, view.viewmat, view.K, SIZE)


def picture(model: SplatModel) -> Tensor:
    return model.render(camera(), 0).image


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("melon")
    demo.make_capture("watermelon", folder, views=16, size=64)
    return load_capture(folder)


@pytest.mark.parametrize("copies", [1, 2, 3, 10, 50])
def test_sharing_keeps_transmittance_and_integral(copies: int) -> None:
    opacity = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    scales = torch.full((3, 3), 0.2, dtype=torch.float64)
    each, size = shared_out(opacity, scales, torch.full((3,), copies))
    assert torch.allclose(1.0 - (1.0 - each) ** copies, opacity, atol=1e-12)
    # A ray across the middle sees the same total alpha: quadrature of both sides (equation 8).
    x = torch.linspace(-4.0, 4.0, 20001, dtype=torch.float64)
    for o, e, s in zip(opacity, each, size[:, 0], strict=True):
        one = o * torch.exp(-0.5 * (x / 0.2) ** 2)
        many = 1.0 - (1.0 - e * torch.exp(-0.5 * (x / s) ** 2)) ** copies
        assert float(torch.trapezoid(many, x)) == pytest.approx(
            float(torch.trapezoid(one, x)), rel=1e-6
        )


def test_relocation_and_growth_keep_the_picture() -> None:
    model = model_of(cloud())
    model.parameters["opacities"].detach()[:30] = -9.0  # transparent: below 1/255
    before = picture(model)
    dead = model.opacities() <= 0.005
    assert int(dead.sum()) == 30
    relocate(model, dead, model.opacities() * ~dead, draws(0, 3, 0))
    assert float(model.opacities().detach().min()) > 0.005
    assert psnr(picture(model), before) > 35.0
    grow(model, 40, model.opacities(), draws(0, 3, 1))
    assert model.count == 160
    assert psnr(picture(model), before) > 32.0


def test_both_controls_stay_under_the_cap() -> None:
    place = Place(None, torch.tensor([[0.0, 0.0, -3.0]]))
    model = model_of(cloud())
    densify(model, torch.ones(120), 0.5, 150, draws(0, 1, 0))
    assert model.count == 150
    assert densify(model, torch.ones(150), 0.5, 150, draws(0, 1, 0)) == 0
    mcmc = Mcmc(QUICK, 1000, 155, place, seed=0)
    for done in range(100, 700, 100):
        mcmc.control(model, done, Wanted())
    assert model.count == 155


def test_what_is_misplaced_goes() -> None:
    gaussians = cloud()
    gaussians.means[0] = torch.tensor([0.0, 0.0, -2.9])  # before the lens
    gaussians.means[1] = math.nan
    gaussians.scales[2] = 1.5
    place = Place(None, torch.tensor([[0.0, 0.0, -3.0]]))
    model = model_of(gaussians)
    assert place.misplaced(model).nonzero()[:, 0].tolist() == [0, 1, 2]
    adc = Adc(QUICK, 1000, 1000, 1.0, place, absgrad=False, seed=0)
    adc.control(model, 100, Wanted(drop=torch.arange(120) == 5))
    assert model.count == 116


def test_opacity_reset_forgets_moments() -> None:
    model = model_of(cloud())
    model.first["opacities"] += 1.0
    reset_opacities(model)
    assert float(model.opacities().detach().max()) == pytest.approx(0.01, rel=1e-4)
    assert float(model.first["opacities"].abs().max()) == 0.0


def test_noise_spares_opaque_gaussians() -> None:
    gaussians = cloud()
    model = model_of(gaussians.replace(opacities=torch.full((120,), 0.9)))
    mcmc = Mcmc(LONG, 1000, 1000, Place(None, torch.zeros(1, 3)), seed=0)
    mcmc.after_step(model, 5)
    assert torch.allclose(model.parameters["means"], gaussians.means, atol=1e-7)
    model = model_of(gaussians.replace(opacities=torch.full((120,), 0.005)))
    mcmc.after_step(model, 5)
    assert float((model.parameters["means"].detach() - gaussians.means).norm()) > 1e-3


def test_error_is_attributed_to_where_it_is() -> None:
    model = model_of(cloud())
    views = [photographed(model, camera(turn)) for turn in (0.0, 0.8)]
    error, weight = attributed(model, views, 0)
    assert float(error.max()) < 1e-12 and float(weight.sum()) > 0
    alpha = sum(float(model.render(view, 0).alpha.sum()) for view in views)
    assert float(weight.sum()) == pytest.approx(alpha, rel=1e-4)
    model.parameters["sh0"].detach()[7] += 1.0
    error, weight = attributed(model, views, 0)
    assert int((error / weight.clamp_min(1e-3)).argmax()) == 7


def test_target_stops_growth_and_drops_what_is_not_seen() -> None:
    model = model_of(cloud())
    views = [photographed(model, camera(turn)) for turn in (0.0, 0.8)]
    target = ErrorTarget(views, 30.0)
    near = torch.tensor([1.5e-3, 1.5e-3])
    assert target.wanted(model, 0, near).stop  # it may fall by itself yet
    assert not target.wanted(model, 0, near).stop
    far_off = target.wanted(model, 0, torch.tensor([0.1, 0.1]))
    assert not far_off.stop and far_off.grow is not None and not bool(far_off.grow.any())
    model.parameters["opacities"].detach()[3] = -9.0  # blends into nothing
    met = target.wanted(model, 0, torch.tensor([1e-5, math.nan]))
    assert met.stop and met.drop is not None
    assert bool(met.drop[3]) and 1 <= int(met.drop.sum()) <= 12
    before = picture(model)
    model.keep(~met.drop)
    assert psnr(picture(model), before) > 30.0


def test_fewer_gaussians_for_a_lower_target(capture: Capture) -> None:
    counts = {}
    for wanted in (24.0, None):
        stage = Reconstruct(
            300, image_size=48, start_gaussians=800, target_psnr=wanted, gradient_threshold=2e-4
        )
        report = stage(capture).report
        counts[wanted] = report["gaussians"]
        if wanted is not None:
            assert report["history"][-1][2] > wanted
    assert counts[24.0] < 0.8 * counts[None]


def test_exposure_is_the_identity_where_photographs_agree() -> None:
    exposure = Exposure(3, torch.device("cpu"))
    image, alpha = torch.rand(8, 8, 3), torch.rand(8, 8)
    assert torch.equal(exposure.apply(image, alpha, 0), image)
    gains = torch.tensor([0.8, 1.0, 1.2])
    for visit in range(1, 401):
        for index in range(3):
            miss = exposure.apply(image, alpha, index) - image * gains[index]
            *_, row = exposure.adjoint(2.0 * miss / miss.numel(), image, alpha, index)
            exposure.step(row, index, visit, 0.0)
    assert float(exposure.delta.mean(0).abs().max()) < 1e-6  # no drift of all together
    assert float(exposure.delta[0, :, :3].diagonal().mean()) < -0.05
    assert float(exposure.delta[2, :, :3].diagonal().mean()) > 0.05
    assert float(exposure.delta[1].abs().max()) < 0.02


def test_exposure_has_the_gradients_of_autograd() -> None:
    exposure = Exposure(2, torch.device("cpu"))
    exposure.delta = torch.randn(2, 3, 4, dtype=torch.float64)
    image = torch.rand(5, 7, 3, dtype=torch.float64, requires_grad=True)
    alpha = torch.rand(5, 7, dtype=torch.float64, requires_grad=True)
    row = exposure.delta[1].clone().requires_grad_()
    slope = torch.randn(5, 7, 3, dtype=torch.float64)
    changed = image + image @ row[:, :3].T + alpha[..., None] * row[:, 3]
    loss = (changed * slope).sum() + 1e-2 * row.square().sum()
    assert torch.allclose(exposure.apply(image, alpha, 1), changed)
    found = exposure.adjoint(slope, image.detach(), alpha.detach(), 1)
    for got, want in zip(found, torch.autograd.grad(loss, (image, alpha, row)), strict=True):
        assert torch.allclose(got, want)


def test_exposure_of_consistent_photographs_stays_small(capture: Capture) -> None:
    settings = {"iterations": 120, "image_size": 48, "start_gaussians": 600}
    plain = Reconstruct(**settings)(capture).report
    learned = Reconstruct(**settings, exposure=True)(capture).report
    assert learned["psnr"] == pytest.approx(plain["psnr"], abs=0.4)


@pytest.mark.parametrize("densify", ["adc", "mcmc"])
def test_resumed_run_is_the_whole_run(capture: Capture, tmp_path: Path, densify: str) -> None:
    settings = {
        "iterations": 130, "image_size": 48, "start_gaussians": 600, "densify": densify,
        "exposure": True, "recipe": "long", "sh_degree": 1, "target_psnr": 25.0, "seed": 3,
    }  # fmt: skip
    whole = Reconstruct(**settings)(capture)
    report = whole.report
    stage = Reconstruct(**settings, checkpoint=tmp_path / "state.pt", checkpoint_every=45)

    def interrupt(done: int, total: int, note: str) -> None:
        if done == 110:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stage(capture, progress=interrupt)
    resumed = stage(capture)
    again = resumed.report
    assert again["resumed_at"] == 90 and again["psnr"] == report["psnr"]
    assert again["history"] == report["history"]
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(whole, name), getattr(resumed, name))


def test_recipe_follows_the_length_of_the_run() -> None:
    assert recipe_for("auto", 800) is QUICK and recipe_for("auto", 7000) is LONG
    assert Reconstruct(7000).image_size == 800
    with pytest.raises(InputError, match="recipe"):
        Reconstruct(recipe="slow")
    with pytest.raises(InputError, match="densify"):
        Reconstruct(densify="more")
    with pytest.raises(InputError, match="target_psnr"):
        Reconstruct(target_psnr=-3.0)


def test_report_shows_held_out_photographs_and_quality_against_count(
    capture: Capture, tmp_path: Path
) -> None:
    gaussians = Reconstruct(110, image_size=48, start_gaussians=600)(capture)
    report = gaussians.report
    files = write_report(tmp_path / "report", gaussians, capture)
    assert [file.name for file in files] == [
        "reconstruct.json",
        "reconstruct.md",
        "reconstruct.png",
    ]
    assert json.loads(files[0].read_text())["psnr"] == report["psnr"]
    step, count, db = report["history"][0]
    assert f"| {step} | {count} | {db:.2f} |" in files[1].read_text()
    rows = load_image(files[2])
    assert rows.shape == (2 * 48 + 4, 3 * 48 + 2 * 4, 3)  # two of 16 held out, three panels each
    assert float(rows[:48, 48:52].min()) == 1.0
