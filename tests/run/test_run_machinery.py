"""The machinery of a run: fingerprints, stages, frames on disk, video, record."""

from __future__ import annotations

import dataclasses
import json
import mmap
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsfluent.data import INTERIOR, TRANSITION, Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.render.video import to_bytes, write_video
from gsfluent.results.behind import Behind, held_here
from gsfluent.results.digests import file_digest
from gsfluent.results.frames import SavedFrame, count_frames, load_frame, save_frame
from gsfluent.results.record import RunRecord
from gsfluent.results.store import StageResult, StageStore, content_digest, fingerprint, publish


def test_fingerprint_sees_every_part() -> None:
    base = fingerprint("fill", [0, "cpu"], {"resolution": 96})
    assert base == fingerprint("fill", [0, "cpu"], {"resolution": 96})
    others = {
        fingerprint("fill", [1, "cpu"], {"resolution": 96}),
        fingerprint("fill", [0, "cuda"], {"resolution": 96}),
        fingerprint("fill", [0, "cpu"], {"resolution": 97}),
        fingerprint("texture", [0, "cpu"], {"resolution": 96}),
    }
    assert len(others) == 4 and base not in others


def test_content_digest_follows_content_and_names_not_times(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "sub").mkdir(parents=True)
        (tmp_path / name / "sub" / "x.txt").write_text("same")
    a, b = tmp_path / "a", tmp_path / "b"
    assert content_digest(a) == content_digest(b)
    (b / "sub" / "x.txt").write_text("sams")
    assert content_digest(a) != content_digest(b)
    (b / "sub" / "x.txt").rename(b / "sub" / "y.txt")
    (b / "sub" / "y.txt").write_text("same")
    assert content_digest(a) != content_digest(b)


def test_finished_stage_is_not_done_again(tmp_path: Path) -> None:
    calls: list[str] = []

    def work(folder: Path) -> dict[str, Any]:
        calls.append("worked")
        (folder / "result").write_text("done")
        return {"answer": 42}

    first = StageStore(tmp_path).run("s", "key", work)
    again = StageStore(tmp_path).run("s", "key", work)
    assert calls == ["worked"]
    assert not first.resumed and again.resumed
    assert again.report == {"answer": 42}
    assert again.seconds == pytest.approx(first.seconds, abs=1e-3)
    StageStore(tmp_path).run("s", "other key", work)
    StageStore(tmp_path, force=True).run("s", "other key", work)
    assert len(calls) == 3


def test_failed_stage_keeps_its_files_for_the_same_inputs_only(tmp_path: Path) -> None:
    def fail(folder: Path) -> dict[str, Any]:
        (folder / "half").write_text("so far")
        raise RuntimeError("stop")

    def look(folder: Path) -> dict[str, Any]:
        return {"found": (folder / "half").exists()}

    for key, found in (("same", True), ("changed", False)):
        with pytest.raises(RuntimeError, match="stop"):
            StageStore(tmp_path / key).run("s", "same", fail)
        assert StageStore(tmp_path / key).run("s", key, look).report == {"found": found}


def test_stage_that_gave_up_is_asked_again(tmp_path: Path) -> None:
    calls = []

    def work(_: Path) -> dict[str, Any]:
        calls.append(1)
        return {"verdict": "failed" if len(calls) == 1 else "clean"}

    StageStore(tmp_path).run("s", "key", work)
    assert StageStore(tmp_path).run("s", "key", work).report["verdict"] == "clean"
    assert len(calls) == 2


def test_damaged_marker_means_work(tmp_path: Path) -> None:
    StageStore(tmp_path).run("s", "key", lambda _: {})
    (tmp_path / "s" / "stage.json").write_text("{")
    assert not StageStore(tmp_path).run("s", "key", lambda _: {}).resumed


def test_peak_memory_is_that_of_the_stage(tmp_path: Path) -> None:
    def large(_: Path) -> dict[str, Any]:
        # 240 MB for a moment, in pages of their own: the allocator may hold as much already
        with mmap.mmap(-1, 240_000_000) as block:
            block.write(bytes([1]) * 240_000_000)
        return {}

    store = StageStore(tmp_path)
    small = store.run("small", "key", lambda _: {})
    big = store.run("big", "key", large)
    after = store.run("after", "key", lambda _: {})
    assert big.peak_memory_bytes - small.peak_memory_bytes > 150e6
    assert big.peak_memory_bytes - after.peak_memory_bytes > 150e6


def test_publish_replaces_without_touching_the_source(tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    target.write_text("old")
    source.write_text("new")
    result = StageResult("s", tmp_path, "key", files={"source": file_digest(source)})
    publish(result, "source", target)
    assert target.read_text() == source.read_text() == "new"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["source", "target"]
    source.write_text("another")
    with pytest.raises(RunError, match="changed since it was written"):
        publish(result, "source", target)


def make_frame(index: int = 0) -> SavedFrame:
    generator = torch.Generator().manual_seed(index)
    means = torch.rand(7, 3, generator=generator)
    gaussians = Gaussians.from_colors(
        means, 0.01 + 0.01 * torch.rand(7, generator=generator), torch.rand(7, 3), opacities=0.5
    )
    labels = torch.tensor([INTERIOR] * 5 + [TRANSITION] * 2, dtype=torch.int32)
    return SavedFrame(
        index=index,
        time=index / 30,
        gaussians=gaussians.replace(labels=labels),
        groups=torch.tensor([-1, -1, -1, 0, 0, 0, 1], dtype=torch.int32),
        carried=5,
        ids=torch.tensor([0, 1, 2, 3, -1, 31, 2**40]),
        anchor=torch.tensor([0, 1, 2, 3, -1, 3, 3], dtype=torch.int32),
        positions=torch.rand(4, 3, generator=generator),
        volumes=torch.full((4,), 1e-6),
        damage=torch.tensor([0.0, 0.25, 0.5, 1.0]),
        fragments=torch.tensor([0, 0, 1, -1], dtype=torch.int32),
        velocity=torch.tensor([[0.5, 0.0, -1.0]]).repeat(4, 1),
        body=torch.tensor([0, 0, 1, 1], dtype=torch.int32),
        material=torch.tensor([0, 2, 1, 1], dtype=torch.int32),
        facts={"fragments": 2},
    )


def test_a_frame_knows_where_its_points_are_drawn(tmp_path: Path) -> None:
    plain = make_frame(3)
    assert plain.shown is plain.positions
    led = (torch.tensor([1, 3], dtype=torch.int32), torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    save_frame(tmp_path, dataclasses.replace(plain, led=led))
    back = load_frame(tmp_path, 3)
    assert torch.equal(back.shown[[1, 3]], led[1]) and torch.equal(back.positions, plain.positions)
    assert torch.equal(back.shown[[0, 2]], plain.positions[[0, 2]])


def test_frame_comes_back_as_it_was(tmp_path: Path) -> None:
    frame = make_frame(3)
    save_frame(tmp_path, frame)
    back = load_frame(tmp_path, 3)
    assert (back.index, back.time, back.carried, back.facts) == (3, 0.1, 5, {"fragments": 2})
    for name in ("means", "scales", "labels"):
        assert torch.equal(getattr(back.gaussians, name), getattr(frame.gaussians, name))
    splats, points = ("groups", "ids", "anchor"), ("positions", "volumes", "damage", "fragments")
    for name in (*splats, *points, "velocity", "body", "material"):
        assert torch.equal(getattr(back, name), getattr(frame, name))
    torch.testing.assert_close(back.gaussians.sh, frame.gaussians.sh, atol=2e-3, rtol=1e-3)


def test_frames_count_from_the_first_without_gaps(tmp_path: Path) -> None:
    assert count_frames(tmp_path) == 0
    for index in (0, 1, 3):
        save_frame(tmp_path, make_frame(index))
    assert count_frames(tmp_path) == 2


def test_damaged_frame_is_named(tmp_path: Path) -> None:
    path = save_frame(tmp_path, make_frame())
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(RunError, match="frame_0001"):
        load_frame(tmp_path, 0)


def solid(value: int, size: tuple[int, int] = (32, 48)) -> np.ndarray:
    return np.full((*size, 3), value, np.uint8)


def test_video_holds_its_frames(tmp_path: Path) -> None:
    import imageio_ffmpeg

    path = tmp_path / "clip.mp4"
    assert write_video(path, (solid(v) for v in (0, 128, 255)), fps=10, size=(48, 32)) == 3
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    frames = [np.frombuffer(raw, np.uint8) for raw in reader]
    assert meta["source_size"] == (48, 32)
    np.testing.assert_allclose([f.mean() for f in frames], [0, 128, 255], atol=6)
    assert [p.name for p in tmp_path.iterdir()] == ["clip.mp4"]


@pytest.mark.parametrize(
    ("frames", "size", "said"),
    [([], (48, 32), "no frame"), ([solid(1)], (47, 32), "even"), ([solid(1)], (32, 32), "frame 0")],
)
def test_wrong_video_input_is_refused_and_leaves_nothing(
    tmp_path: Path, frames: list[np.ndarray], size: tuple[int, int], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        write_video(tmp_path / "clip.mp4", frames, fps=10, size=size)
    assert list(tmp_path.iterdir()) == []


def test_video_that_stops_half_way_leaves_nothing(tmp_path: Path) -> None:
    def frames() -> Any:
        yield solid(1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "clip.mp4", frames(), fps=10, size=(48, 32))
    assert list(tmp_path.iterdir()) == []


def test_bytes_are_rounded_and_clamped() -> None:
    image = torch.tensor([[[-0.5, 0.5, 2.0]]])
    assert to_bytes(image).tolist() == [[[0, 128, 255]]]


def record(tmp_path: Path) -> RunRecord:
    return RunRecord(tmp_path / "run.json", {"events": []}, torch.device("cpu"), 7)


def test_record_of_a_failure_says_where_and_why(tmp_path: Path) -> None:
    store = StageStore(tmp_path / "stages")
    store.run("fill", "key", lambda _: {})
    record(tmp_path).fail(KeyboardInterrupt(), store.results)
    value = json.loads((tmp_path / "run.json").read_text())
    assert value["verdict"] == "failed"
    assert value["reason"] == "interrupted by Ctrl-C during fill"
    assert value["seed"] == 7
    assert [stage["name"] for stage in value["stages"]] == ["fill"]


@pytest.mark.parametrize("verdict", ["clean", "healed", "failed"])
def test_record_takes_the_verdict_of_the_simulation(tmp_path: Path, verdict: str) -> None:
    made = record(tmp_path)
    made.values["simulation"] = {"verdict": verdict, "reason": "because"}
    assert made.finish([])["verdict"] == verdict
    assert json.loads((tmp_path / "run.json").read_text())["reason"] == "because"


def test_what_is_written_behind_the_work_keeps_its_order_and_its_errors() -> None:
    done: list[int] = []

    def write(number: int) -> None:
        if number == 3:
            raise RunError("the disk is full", "nothing", "free space")
        done.append(number)

    with Behind() as behind:
        for number in range(3):
            behind.do(write, number)
        behind.wait()
        assert done == [0, 1, 2]
        behind.do(write, 3)
        with pytest.raises(RunError, match="the disk is full"):
            behind.wait()
    with pytest.raises(RunError, match="the disk is full"), Behind() as behind:
        behind.do(write, 3)
    with pytest.raises(KeyboardInterrupt), Behind() as behind:
        behind.do(write, 4)
        behind.do(write, 3)
        raise KeyboardInterrupt
    assert done == [0, 1, 2, 4]
    # what was given after it is left undone, however much may wait
    with pytest.raises(RunError, match="the disk is full"), Behind(3) as behind:
        for number in (5, 3, 6):
            behind.do(write, number)
    assert done == [0, 1, 2, 4, 5]


def test_what_is_done_behind_computes_with_threads_of_its_own() -> None:
    def threads() -> None:
        seen.append(torch.get_num_threads())

    before, seen = torch.get_num_threads(), list[int]()
    torch.set_num_threads(4)
    try:
        with Behind(threads=2) as behind:
            behind.do(threads)
            behind.wait()
            other = threading.Thread(target=threads)
            other.start()
            other.join()
            behind.do(threads)
        assert seen == [2, 4, 2] and torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)


@pytest.mark.cuda
def test_what_is_done_behind_has_a_stream_of_its_own_and_finds_what_it_is_given() -> None:
    device, streams, sums = torch.device("cuda"), [], []

    def read(values: torch.Tensor) -> None:
        held_here((values, None))
        streams.append(torch.cuda.current_stream(device))
        sums.append(float(values.sum()))

    with Behind(3, device) as behind:
        for number in range(4):
            torch.cuda._sleep(20_000_000)  # so that the values are not there yet
            behind.do(read, torch.full((1 << 20,), float(number), device=device))
    assert sums == [float(number << 20) for number in range(4)]
    assert len(set(streams)) == 1 and streams[0] != torch.cuda.current_stream(device)
