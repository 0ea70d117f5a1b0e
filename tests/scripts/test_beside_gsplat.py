"""Scripts that run gsplat beside us: scenes, tables, the trainer around gsplat, the comparison."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from loaded_scripts import load_script
from torch import Tensor

import gsfluent as gf
from gsfluent import ops
from gsfluent.demo import make_capture, make_object
from gsfluent.errors import InputError

CPU = torch.device("cpu")


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a script by name; without gsplat, whatever is installed."""
    monkeypatch.setitem(sys.modules, "gsplat", None)
    return lambda name: load_script(f"bench/gsplat/{name}")


@pytest.fixture(scope="module")
def table_capture(tmp_path_factory: pytest.TempPathFactory) -> gf.data.Capture:
    folder = tmp_path_factory.mktemp("table")
    make_capture("watermelon", folder, views=9, size=40, support="table", masks=False)
    return gf.load_capture(folder)


def test_random_scenes_are_the_same_every_time_and_as_described(script: Any) -> None:
    scenes = script("scenes")
    first = scenes.random_scene("nat", 4000, 64, 48, CPU)
    scenes._random_inputs.cache_clear()
    again = scenes.random_scene("nat", 4000, 64, 48, CPU)
    for name in scenes.FIELDS:
        assert torch.equal(first.inputs[name], again.inputs[name])
    assert first.count == 4000
    assert float(first.inputs["means"].abs().max()) <= 1.0
    middle = math.log(0.7 * (8.0 / 4000) ** (1 / 3))
    logs = first.inputs["scales"].log()
    assert abs(float(logs.mean()) - middle) < 0.02
    assert abs(float(logs.std()) - 0.4) < 0.02
    # 50 degrees over the height: a point at the edge of the field is drawn on the border
    edge = first.K @ torch.tensor([0.0, math.tan(math.radians(25.0)), 1.0])
    assert float(edge[1]) == pytest.approx(48.0, abs=1e-4)
    heavy = scenes.random_scene("heavy", 4000, 64, 48, CPU)
    assert abs(float(heavy.inputs["scales"].log().mean()) - math.log(0.03)) < 0.02
    with pytest.raises(ValueError, match="nat or heavy"):
        scenes.random_scene("light", 10, 8, 8, CPU)


def test_garden_is_cropped_and_its_camera_rescaled(script: Any, tmp_path: Path) -> None:
    scenes = script("scenes")
    K = np.array([[[100.0, 0, 32], [0, 90.0, 24], [0, 0, 1]]])
    arrays = {
        "means3d": np.array([[0.0, 0, 0], [1.9, 0, 0], [2.1, 0, 0]]),
        "colors": np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]]),
        "viewmats": np.eye(4)[None], "Ks": K, "width": 64, "height": 48,
    }  # fmt: skip
    np.savez(tmp_path / "g.npz", **arrays)
    scene = scenes.garden_scene(tmp_path / "g.npz", 128, 48, CPU)
    assert scene.count == 2
    assert scene.K.tolist() == [[200.0, 0.0, 64.0], [0.0, 90.0, 24.0], [0.0, 0.0, 1.0]]
    dc = scene.inputs["sh"][:, 0] * 0.28209479177387814 + 0.5
    torch.testing.assert_close(dc, torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]), atol=1e-6, rtol=0)
    del arrays["Ks"]
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(ValueError, match="lacks Ks"):
        scenes.garden_scene(tmp_path / "bad.npz", 8, 8, CPU)


def test_kernel_names_lose_types_and_templates(script: Any) -> None:
    name = script("rasterizer").kernel_name
    assert name("void a::(anonymous namespace)::blend<float, 3>(a::Args<float>)") == "blend"
    assert name("void cub::X::Onesweep<cub::P<int(1)>, (cub::Order)1>(int)") == "Onesweep"
    assert name("Memset (Device)") == "Memset"


def test_decibels_and_gradient_differences(script: Any) -> None:
    bench, scenes = script("rasterizer"), script("scenes")
    zero = torch.zeros(4, 4, 3)
    assert bench.decibels(zero, zero + 0.1) == pytest.approx(20.0)
    assert bench.decibels(zero, zero) == math.inf
    scene = scenes.random_scene("nat", 300, 48, 32, CPU)
    ours = bench.gsfluent_renderer()

    def brighter(inputs: dict[str, Tensor], scene: Any) -> tuple[Tensor, Any]:
        image, kept = ours(inputs, scene)
        return 1.25 * image, kept

    row = bench.compare(ours, brighter, scene)
    for field in scenes.FIELDS:
        assert row[f"gradient_{field}"] == pytest.approx(0.2, rel=1e-4)
    assert bench.compare(ours, ours, scene)["difference_db"] == math.inf


def entry(wall: float, kernels: float) -> dict[str, Any]:
    return {
        "fwd": wall, "fwd_kernels": kernels, "both": 2 * wall, "both_kernels": 2 * kernels,
        "fwd_mib": 100.0, "both_mib": 300.0, "image_mib": 200.0, "fwd_launches": 20.0,
        "both_launches": 40.0, "both_longest": {"blend": 0.5},
    }  # fmt: skip


def test_tables_take_the_better_of_gsplats_modes(script: Any) -> None:
    tables = script("tables")
    judged = {"difference_db": 70.0} | {f"gradient_{f}": 1e-5 for f in tables.FIELDS}
    row = {
        "scene": "nat 1M", "gaussians": 1_000_000, "width": 1920, "height": 1080,
        "gsfluent": entry(0.5, 0.25), "packed": entry(2.0, 1.0) | judged,
        "unpacked": entry(1.0, 0.75) | judged,
    }  # fmt: skip
    text = tables.cuda_table("a GPU", [row], "1.6.0")
    assert "| 0.50 (0.25) | 2.00 (1.00) | 1.00 (0.75) | 2.00 / 3.00 |" in text
    assert "| nat 1M, 1920 x 1080, forward, wall | 0.8 | 0.50 | 1.00 | met |" in text
    assert "at least | 50 | 70.0 | | met |" in text
    assert "gsplat, unpacked, ms: blend 0.500" in text
    row["gsfluent"]["fwd"] = 1.6
    assert "| 0.8 | 1.60 | 1.00 | missed by 2.00 |" in tables.cuda_table("a GPU", [row], "1.6.0")
    alone = {k: v for k, v in row.items() if "packed" not in k}
    text = tables.cuda_table("a GPU", [alone], None)
    assert "gsplat not installed" in text
    assert "at least | 50" not in text


def test_bench_runs_alone_on_the_cpu(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    bench = script("rasterizer")
    threads = torch.get_num_threads()
    monkeypatch.setitem(bench.SIZES, "100k", 500)
    monkeypatch.setitem(bench.IMAGES, "800", (64, 48))
    page = tmp_path / "page.md"
    page.write_text("# Page\n")
    arguments = ["--device", "cpu", "--scenes", "nat", "garden", "--runs", "1"]
    try:
        for _ in range(2):  # the second run replaces the first one's table
            assert bench.main([*arguments, "--markdown", str(page)]) == 0
    finally:
        torch.set_num_threads(threads)
    text = page.read_text()
    assert text.startswith("# Page\n")
    assert text.count("bench_gsplat cpu: begin") == 1
    rows = [line for line in text.splitlines() if line.startswith("| nat 100k | 64 x 48 |")]
    assert len(rows) == 2
    assert all(row.endswith("| yes |") for row in rows)
    with pytest.raises(SystemExit):
        bench.main(["--garden", str(tmp_path / "absent.npz")])
    assert "does not exist" in capsys.readouterr().err


def test_normalised_frame_sees_the_same_pixels_and_comes_back(
    script: Any, table_capture: gf.data.Capture
) -> None:
    trainer = script("train")
    frame = trainer.Frame.of(table_capture)
    camera = table_capture.cameras[3]
    points = table_capture.points[:50].double()
    inside = (points - frame.center) * frame.scale
    homogeneous = torch.cat([inside, torch.ones(50, 1, dtype=torch.float64)], 1)
    seen = (frame.viewmat(camera.viewmat).double() @ homogeneous.T)[:3].T
    pixels = (camera.K.double() @ seen.T).T
    wanted, _ = camera.project(points)
    torch.testing.assert_close(pixels[:, :2] / pixels[:, 2:], wanted, atol=1e-3, rtol=1e-5)
    eyes = (table_capture.centers() - frame.center) * frame.scale
    assert float(eyes.norm(dim=1).median()) == pytest.approx(1.0)
    first = trainer.start(table_capture, frame, 40, 0)
    world = frame.world(first)
    torch.testing.assert_close(world.means, table_capture.points.float(), atol=1e-4, rtol=1e-4)
    assert float(world.opacities.mean()) == pytest.approx(0.1)
    torch.testing.assert_close(
        world.colors(), table_capture.point_colors.float(), atol=1e-5, rtol=0
    )


def test_nothing_to_start_from_is_an_error(script: Any, table_capture: gf.data.Capture) -> None:
    trainer = script("train")
    empty = torch.zeros(0, 3)
    capture = table_capture.replace(points=empty.double(), point_colors=empty)
    with pytest.raises(InputError, match="no sparse points and no masks"):
        trainer.start(capture, trainer.Frame.of(capture), 40, 0)


def test_first_scales_are_the_distance_of_three_neighbours(
    script: Any, table_capture: gf.data.Capture
) -> None:
    trainer = script("train")
    lattice = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij"), -1)
    points = lattice.reshape(-1, 3).double()  # every point has three neighbours at distance 1
    capture = table_capture.replace(points=points, point_colors=torch.zeros(64, 3))
    frame = trainer.Frame.of(table_capture)
    scales = trainer.start(capture, frame, 40, 0)["scales"].exp()
    torch.testing.assert_close(scales, torch.full((64, 3), frame.scale), rtol=1e-4, atol=0)


def test_a_capture_with_masks_starts_on_its_hull(script: Any, tmp_path: Path) -> None:
    trainer = script("train")
    make_capture("watermelon", tmp_path, views=9, size=40)
    capture = gf.load_capture(tmp_path)
    frame = trainer.Frame.of(capture)
    first = trainer.start(capture, frame, 40, 0)
    world = frame.world(first)
    thing = make_object("watermelon")
    reach = (world.means.double() - thing.center) / torch.tensor(thing.axes)
    # a hull encloses the object; nine views at 40 pixels leave it less than half too large
    assert float(reach.norm(dim=1).median()) == pytest.approx(1.05, abs=0.15)
    assert float(reach.norm(dim=1).max()) < 1.5
    views, white = trainer.photographs(capture, frame, 40, CPU)
    assert white is not None
    corner = torch.stack([view.color[0, 0] for view in views])
    assert torch.equal(corner, torch.ones(9, 3))  # composited over white


def test_loss_ignores_pixels_that_no_photograph_covers(script: Any) -> None:
    trainer = script("train")
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 24, 24, 3, generator=g)
    valid = torch.ones(24, 24, dtype=torch.bool)
    valid[:, 20:] = False
    view = trainer.Photograph(target, valid, torch.eye(4)[None], torch.eye(3)[None])
    changed = image.clone()
    changed[:, 20:] = 0.5
    assert float(trainer.loss_of(image, view)) == float(trainer.loss_of(changed, view))
    same = trainer.Photograph(target, None, torch.eye(4)[None], torch.eye(3)[None])
    assert float(trainer.loss_of(target, same)) == pytest.approx(0.0, abs=1e-6)
    flat = trainer.loss_of(image, same)
    wanted = 0.8 * (image - target).abs().mean() + 0.2 * (1 - gf.metrics.ssim(image, target))
    torch.testing.assert_close(flat, wanted)


class _Strategy:
    """Does nothing but remember when it was called."""

    seen: list[tuple[str, int]] = []

    def check_sanity(self, params: Any, optimizers: Any) -> None:
        assert set(params) == set(optimizers)

    def initialize_state(self, scene_scale: float) -> dict[str, Any]:
        assert scene_scale > 0
        return {}

    def step_pre_backward(self, p: Any, o: Any, s: Any, step: int, info: Any) -> None:
        assert p["means"].grad is None
        self.seen.append(("before", step))

    def step_post_backward(self, p: Any, o: Any, s: Any, step: int, info: Any, packed: Any) -> None:
        self.seen.append(("after", step))


def stand_in() -> ModuleType:
    """A module with gsplat's names that draws with our rasterizer."""
    module = ModuleType("gsplat")

    def rasterization(*values: Any, near_plane: float, far_plane: float, **rest: Any) -> Any:
        means, quats, scales, opacities, sh, viewmats, Ks, width, height = values
        kept = sh[:, : (rest["sh_degree"] + 1) ** 2].contiguous()
        back = rest["backgrounds"]
        image = ops.rasterize(
            means, opacities, viewmats[0], Ks[0], width, height, quats=quats, scales=scales,
            sh=kept, near=near_plane, far=far_plane, background=None if back is None else back[0],
        ).image  # fmt: skip
        return image[None], None, {}

    module.rasterization = rasterization  # type: ignore[attr-defined]
    module.DefaultStrategy = _Strategy  # type: ignore[attr-defined]
    return module


def test_the_training_loop_learns_and_reports(
    script: Any, table_capture: gf.data.Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = script("train")
    monkeypatch.setitem(sys.modules, "gsplat", stand_in())
    monkeypatch.setattr(_Strategy, "seen", [])
    _, before = trainer.reconstruct(table_capture, 1, 40, CPU)
    _Strategy.seen.clear()
    gaussians, report = trainer.reconstruct(table_capture, 300, 40, CPU)
    steps = [(kind, step) for step in range(300) for kind in ("before", "after")]
    assert _Strategy.seen == steps
    assert report["psnr"] > before["psnr"] + 1.0
    assert report["psnr"] == pytest.approx(report["psnr_own"], abs=0.05)
    assert report["gaussians"] == gaussians.count == len(table_capture.points)
    assert report["held_out"] == 1


def test_trainer_without_gsplat_says_so(script: Any, tmp_path: Path, capsys: Any) -> None:
    with pytest.raises(SystemExit):
        script("train").main([str(tmp_path)])
    assert "gsplat is not installed" in capsys.readouterr().err


def line(trainer: str, **changes: Any) -> dict[str, Any]:
    return {
        "capture": "demo:orange", "trainer": trainer, "iterations": 7000, "image_size": 800,
        "gaussians": 1000, "psnr": 30.0, "ssim": 0.9, "seconds": 10.0, "held_out": 7,
    } | changes  # fmt: skip


def test_verdicts_hold_to_the_bar(script: Any) -> None:
    verdict = script("compare").verdict
    theirs = line("gsplat")
    assert verdict(line("a", psnr=29.91, ssim=0.8981, seconds=9.0), theirs).endswith(": met")
    bad = line("a", psnr=29.8, ssim=0.89, gaussians=1001, seconds=10.0)
    assert verdict(bad, theirs).endswith("misses PSNR, SSIM, count, time")
    assert "+1.00 dB" in verdict(line("a", psnr=31.0), theirs)


def test_settings_are_arguments_of_reconstruct(script: Any) -> None:
    settings = script("compare").settings
    assert settings("few:max_gaussians=500,kernel=isotropic,separate=False") == (
        "gsfluent few", {"max_gaussians": 500, "kernel": "isotropic", "separate": False},
    )  # fmt: skip
    assert settings("plain:") == ("gsfluent plain", {})
    for text in ("x:nonsense=1", "x:kernel", ":kernel=isotropic"):
        with pytest.raises(ValueError, match="wanted"):
            settings(text)


def test_runs_already_made_are_not_repeated(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    module = script("compare")
    monkeypatch.setattr(module, "opened", lambda *_: pytest.fail("a capture was opened"))
    runs, page = tmp_path / "runs.jsonl", tmp_path / "page.md"
    done = [line("gsplat"), line("gsfluent default", psnr=31.0, gaussians=900, seconds=5.0)]
    runs.write_text("".join(json.dumps(x) + "\n" for x in done))
    arguments = ["--only", "demo:orange", "--jsonl", str(runs), "--markdown", str(page)]
    assert module.main(arguments) == 0
    assert "| 31.00 |" in page.read_text()
    assert "+1.00 dB, +0.0000, count x 0.90, time x 0.50: met" in page.read_text()
    assert len(runs.read_text().splitlines()) == 2
    with pytest.raises(SystemExit):
        module.main(["--only", "demo:pear"])
    assert "demo:pear" in capsys.readouterr().err


def test_built_in_captures_are_photographed_once(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = script("compare")
    made = []

    def photographed(name: str, folder: Path, **rest: Any) -> None:
        made.append((name, rest["support"], rest["masks"]))
        make_capture(name, folder, views=3, size=32, support=rest["support"], masks=rest["masks"])

    monkeypatch.setattr(module, "make_capture", photographed)
    for _ in range(2):
        capture = module.opened("demo:watermelon-table", tmp_path, 3, 32)
    assert made == [("watermelon", "table", False)]
    assert len(capture) == 3
    assert not capture.has_masks


def test_a_run_of_ours_has_the_keys_of_the_trainer(
    script: Any, table_capture: gf.data.Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = script("compare")
    options = module.parsed(["--iterations", "3", "--image-size", "40", "--device", "cpu"])
    found = module.run_ours(table_capture, {"max_gaussians": 4000}, options)
    missing = set(line("gsfluent")) - {"capture", "trainer"} - set(found)
    assert not missing
    assert found["iterations"] == 3
    assert found["held_out"] == 1
