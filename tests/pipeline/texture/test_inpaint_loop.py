"""The two-stage loop: schedules, tiles, colours, and going on after a kill."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsfluent.errors import InputError
from gsfluent.pipeline.texture.inpaint.inpainter import Job, MaskedInpainter, SliceContext
from gsfluent.pipeline.texture.inpaint.levels import coarse_domain, fuse_stacks, slice_positions
from gsfluent.pipeline.texture.inpaint.method import (
    InpaintOptions,
    SliceStore,
    inpaint_plan,
    inpaint_volume,
    make_inpainter,
)
from gsfluent.pipeline.texture.photo.exemplar import Exemplar, load_exemplar
from gsfluent.pipeline.texture.volume.domain import InteriorDomain, options_of


def ball(size: int = 20) -> InteriorDomain:
    """A green ball."""
    axes = np.mgrid[:size, :size, :size] + 0.5 - size / 2
    radius = np.sqrt((axes**2).sum(0))
    depth = np.maximum(size / 2 - 1 - radius, 0).astype(np.float32)
    inside = depth > 0
    skin = np.broadcast_to(np.float32([0.1, 0.5, 0.1]), (*inside.shape, 3)).copy()
    return InteriorDomain(
        inside, depth, inside & (depth <= 1.6), skin, np.array([0, 0, 1.0]), 1.0, np.zeros(3)
    )


def photo() -> Exemplar:
    row, column = np.mgrid[:60, :60] + 0.5 - 30
    radius = np.hypot(row, column)
    image = np.empty((60, 60, 4), np.float32)
    image[...] = (0.8, 0.2, 0.2, 1.0)
    image[radius > 24] = (0.9, 0.9, 0.8, 1.0)
    image[..., 3] = radius < 28
    return load_exemplar(image)


class Painter(MaskedInpainter):
    """A tone of its own for every slice; keeps a book of its calls, and can be told to die."""

    name = "painter"

    def __init__(self, book: Path | None = None, die_at: int = -1) -> None:
        self.calls: list[tuple[float, SliceContext]] = []
        self.book, self.die_at = book, die_at

    def paint(self, job: Job) -> np.ndarray:
        slices, strength, context = job.slices, job.strength, job.context
        self.calls.append((strength, context))
        if self.book is not None:
            with self.book.open("a") as stream:
                stream.write(f"{context.axis} {context.offsets}\n")
        if len(self.calls) == self.die_at:
            import os

            os.kill(os.getpid(), signal.SIGKILL)
        tones = [np.random.default_rng(s).random(3).astype(np.float32) for s in job.seeds]
        return slices + strength * (np.stack(tones)[:, None, None] - slices)


def test_stages_strengths_and_context() -> None:
    painter = Painter()
    options = InpaintOptions(slices=5, refine=(0.3, 0.2))
    texture = inpaint_volume(ball(), painter, prompt="", options=options)
    strengths = [s for s, _ in painter.calls]
    # the outermost slices are all shell: nothing to paint there, and the backend is not asked
    assert strengths == [0.99] * 3 + [0.3] * 9 + [0.2] * 9
    assert [c.axis for _, c in painter.calls] == [0] * 3 + ([0] * 3 + [1] * 3 + [2] * 3) * 2
    first = painter.calls[1][1]
    assert first.inside is not None and first.guide is not None
    assert first.max_depth == pytest.approx(float(first.guide.max()), abs=0.8)
    assert texture.report["slices"] == 5 + 2 * 15
    plan = inpaint_plan(ball(), options)
    assert plan["slices"] == 35 and plan["passes"] == 3 and plan["model_calls"] == 35
    # 29 steps of 30 at 0.99; 9 of 30 at 0.3; 6 of 30 at 0.2
    assert plan["denoising_steps"] == 5 * 29 + 15 * 9 + 15 * 6


def test_backends_see_slices_upright() -> None:
    """Slices across x and y have z up, those across z have y up; the answer is turned back."""
    domain = ball(16)
    where = np.mgrid[:16, :16, :16] / 16.0
    domain = replace(domain, skin=np.moveaxis(where, 0, -1).astype(np.float32))

    class Look(Painter):
        def paint(self, job: Job) -> np.ndarray:
            slices, mask, context = job.slices, job.mask, job.context
            right, up = (i for i in range(3) if i != context.axis)
            row, column = np.nonzero(context.inside[0] & ~mask[0])  # the shell, whose skin tells
            low, high = row > row.mean(), row < row.mean()
            color = slices[0][row, column]
            assert color[high, up].mean() > color[low, up].mean() + 0.2
            left = column < column.mean()
            assert color[~left, right].mean() > color[left, right].mean() + 0.2
            self.calls.append((0.0, context))
            made = slices.copy()
            made[:, : mask.shape[1] // 2] = 1.0  # the upper half white
            return made

    look = Look()
    options = InpaintOptions(slices=6, refine=(), match_colors=False)
    rgb = inpaint_volume(domain, look, prompt="", options=options).rgb
    hole = domain.inside & ~domain.shell
    middle = slice(6, 10)  # the outermost slices are all shell and not asked for
    rgb, hole = rgb[middle], hole[middle]
    assert (rgb[..., 8:, :][hole[..., 8:]] > 0.99).all()
    assert not (rgb[..., :8, :][hole[..., :8]] > 0.99).all()
    inpaint_volume(domain, look, prompt="", options=replace(options, refine=(0.3,)))
    assert {c.axis for _, c in look.calls} == {0, 1, 2}


def test_first_stage_can_be_another_backend() -> None:
    coarse, fine = Painter(), Painter()
    options = InpaintOptions(slices=4, refine=(0.3,))
    inpaint_volume(ball(), fine, prompt="", options=options, coarse=coarse)
    assert {s for s, _ in coarse.calls} == {0.99} and {s for s, _ in fine.calls} == {0.3}


def test_coupled_schedule_starts_at_a_coarse_level_with_all_axes() -> None:
    painter = Painter()
    options = InpaintOptions(slices=40, refine=(0.3,), schedule="coupled")
    texture = inpaint_volume(ball(40), painter, prompt="", options=options)
    sizes = [c.inside.shape[1] for _, c in painter.calls if c.inside is not None]
    assert sorted(set(sizes)) == [10, 20, 40] and sizes == sorted(sizes)
    coarse = {c.axis for _, c in painter.calls if c.inside is not None and c.inside.shape[1] == 10}
    assert coarse == {0, 1, 2}
    assert texture.rgb.shape == (40, 40, 40, 3) and np.isfinite(texture.rgb).all()


@pytest.mark.parametrize("tile", [1, 2, 4])
def test_tiles_give_every_slice_once(tile: int) -> None:
    painter = Painter()
    options = InpaintOptions(slices=20, refine=(0.3,), tile=tile, match_colors=False)
    inpaint_volume(ball(), painter, prompt="", options=options)
    along_x = [c for s, c in painter.calls if s == 0.99]
    count = len(slice_positions(ball().inside, 0, 20))
    assert len(along_x) <= -(-count // tile**2)
    assert inpaint_plan(ball(), options)["model_calls"] == 4 * -(-count // tile**2)


def test_surface_keeps_its_colour() -> None:
    domain = ball()
    texture = inpaint_volume(domain, Painter(), prompt="", options=InpaintOptions(slices=6))
    assert np.array_equal(texture.rgb[domain.shell], domain.skin[domain.shell])
    assert texture.rgb[domain.inside & ~domain.shell].std() > 0.01


def test_colours_come_back_to_the_photograph() -> None:
    """Whatever tones a model gives: at every depth the photograph's distribution is left."""
    domain = ball(24)
    options = InpaintOptions(slices=24, refine=(0.3,))
    with_photo = inpaint_volume(domain, Painter(), prompt="", options=options, exemplar=photo())
    hole = domain.inside & ~domain.shell
    core = with_photo.rgb[hole & (domain.depth > 5)].mean(0)
    assert np.abs(core - [0.8, 0.2, 0.2]).max() < 0.06
    without = inpaint_volume(domain, Painter(), prompt="", options=options)
    assert np.abs(without.rgb[hole & (domain.depth > 5)].mean(0) - [0.8, 0.2, 0.2]).max() > 0.1


def test_matching_evens_out_the_slices_of_a_stack() -> None:
    domain = ball(24)
    change = {}
    for match in (True, False):
        options = InpaintOptions(slices=24, refine=(), match_colors=match)
        rgb = inpaint_volume(domain, Painter(), prompt="", options=options).rgb
        deep = domain.depth > 4
        both = deep[1:] & deep[:-1]
        change[match] = float(np.abs(np.diff(rgb, axis=0))[both].mean())
    assert change[True] < 0.6 * change[False]


def test_fusion_interpolates_and_takes_the_mean_of_the_axes() -> None:
    ramp = np.stack([np.full((5, 5, 3), v, np.float32) for v in (0.0, 1.0)])
    fused, variance = fuse_stacks((5, 5, 5), [(0, [0, 4], ramp)])
    assert np.allclose(fused[:, 0, 0, 0], [0, 0.25, 0.5, 0.75, 1.0])
    assert np.allclose(variance, 0.0, atol=1e-6)
    level = np.full((2, 5, 5, 3), 0.5, np.float32)
    fused, variance = fuse_stacks((5, 5, 5), [(0, [0, 4], ramp), (1, [0, 4], level)])
    assert np.allclose(fused[:, 2, 2, 0], [0.25, 0.375, 0.5, 0.625, 0.75])
    # of two values d apart: d^2 / 4
    assert variance[0, 2, 2] == pytest.approx(0.25 / 4) and variance[2, 2, 2] < 1e-6


def test_coarse_domain_keeps_depth_in_its_own_voxels() -> None:
    fine = ball(40)
    half = coarse_domain(fine, 2)
    assert half.inside.shape == (20, 20, 20) and half.voxel == 2 * fine.voxel
    assert half.max_depth == pytest.approx(fine.max_depth / 2, rel=0.1)
    assert np.allclose(half.skin[half.shell], fine.skin[0, 0, 0], atol=1e-6)


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_inpaint_loop import run
run(Path(sys.argv[2]), die_at=9)  # in the middle of a slice of the second round
"""


def run(folder: Path, die_at: int, store: bool = True) -> Any:
    painter = Painter(folder / "book.txt", die_at)
    options = InpaintOptions(slices=7, refine=(0.3,))
    kept = SliceStore(folder / "slices", "key") if store else None
    return inpaint_volume(ball(), painter, prompt="", options=options, store=kept, seed=4)


def test_killed_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    words = [sys.executable, "-c", SCRIPT, str(Path(__file__).parent), str(tmp_path)]
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    calls = (tmp_path / "book.txt").read_text().splitlines()
    kept = len(list((tmp_path / "slices").glob("slice_*.npy")))
    assert len(calls) == 9
    again = run(tmp_path, -1)
    calls = (tmp_path / "book.txt").read_text().splitlines()
    (tmp_path / "whole").mkdir()
    whole = run(tmp_path / "whole", -1, store=False)
    uninterrupted = (tmp_path / "whole" / "book.txt").read_text().splitlines()
    # the slice it died in is made twice, all others once
    assert len(calls) == len(uninterrupted) + 1 and kept > 8
    assert np.array_equal(again.rgb, whole.rgb)


def test_store_forgets_other_settings_and_broken_files(tmp_path: Path) -> None:
    store = SliceStore(tmp_path, "a")
    image = np.full((4, 5, 3), 0.25, np.float32)
    store.put(1, 2, 3, image)
    assert np.array_equal(SliceStore(tmp_path, "a").get(1, 2, 3, image.shape), image)
    assert SliceStore(tmp_path, "a").get(1, 2, 3, (9, 9, 3)) is None
    (tmp_path / "slice_1_2_0004.npy").write_bytes(b"\x93NUMPY cut off")
    assert SliceStore(tmp_path, "a").get(1, 2, 4, image.shape) is None
    assert SliceStore(tmp_path, "b").get(1, 2, 3, image.shape) is None
    assert not list(tmp_path.glob("slice_*.npy"))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be kept"):
        SliceStore(tmp_path / "file" / "x", "a")


def test_options_and_backends_are_checked() -> None:
    for wrong in (
        {"strength": 0.0},
        {"refine": (0.2, 1.5)},
        {"memory": "tiny"},
        {"dtype": "int8"},
        {"tile": 3},
        {"backend": "photoshop"},
        {"schedule": "xyz"},
        {"backend": "command"},
        {"size": 4},
        {"batch": 0},
    ):
        with pytest.raises(InputError, match=next(iter(wrong))):
            InpaintOptions(**wrong)
    with pytest.raises(InputError, match="knows no stepz"):
        options_of(InpaintOptions, "inpaint", {"stepz": 3})
    assert options_of(InpaintOptions, "inpaint", {"refine": [0.1]}) == InpaintOptions(refine=(0.1,))
    with pytest.raises(InputError, match="needs a model"):
        make_inpainter("diffusers", InpaintOptions())
    names = [make_inpainter(n, InpaintOptions()).name for n in ("telea", "color", "exemplar")]
    assert names == ["telea", "color", "exemplar"]


def test_a_program_does_the_first_pass(tmp_path: Path) -> None:
    """MVInpainter's place: the ordered X stack goes to a command, the rest to another backend."""
    import json

    from test_inpainter_contract import program

    from gsfluent.pipeline.texture.inpaint.method import diffusion_texture

    options = InpaintOptions(
        backend="telea", coarse="command", command=program(tmp_path), window=4, overlap=1,
        slices=9, refine=(0.3,), tile=1,
    )  # fmt: skip
    texture = diffusion_texture(
        ball(), None, prompt="flesh", options=options, resume=tmp_path / "kept"
    )
    log = [json.loads(line) for line in (tmp_path / "runs.txt").read_text().splitlines()]
    assert {m["axis"] for m in log} == {"x"} and all(m["reference"] for m in log)
    offsets = [o for m in log for o in m["offsets"]]
    assert sorted(set(offsets)) == offsets[:4] + [o for m in log[1:] for o in m["offsets"][1:]]
    assert texture.report["pipeline"] == "telea" and texture.report["model"] is None
    again = diffusion_texture(
        ball(), None, prompt="flesh", options=options, resume=tmp_path / "kept"
    )
    assert again.report["resumed_slices"] == again.report["slices"]
    assert np.array_equal(again.rgb, texture.rgb)
    assert len((tmp_path / "runs.txt").read_text().splitlines()) == len(log)
