"""Frames on disk: each array once while it stays, the same files after a break, damage told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsfluent.data import Gaussians
from gsfluent.errors import RunError
from gsfluent.results.frames import (
    FrameWriter,
    SavedFrame,
    frame_path,
    frame_positions,
    load_frame,
    packed_frame,
)

SPLATS, POINTS, COUNT = 40, 300, 5


def frames() -> list[SavedFrame]:
    """Matter that moves but in frames 3 and 4; a splat is born in frame 2."""
    found = []
    for index in range(COUNT):
        torch.manual_seed(0)
        count, moved = SPLATS + (index >= 2), 0.1 * min(index, 3)
        colors = torch.rand(SPLATS + 1, 3)[:count]
        means = torch.rand(SPLATS + 1, 3)[:count] + moved
        scales = 0.1 * torch.rand(SPLATS + 1, 3)[:count]
        found.append(
            SavedFrame(
                index=index,
                time=0.1 * index,
                gaussians=Gaussians.from_colors(means, scales, colors),
                groups=torch.full((count,), -1, dtype=torch.int32),
                carried=SPLATS,
                ids=torch.arange(count),
                anchor=torch.zeros(count, dtype=torch.int32),
                positions=torch.rand(POINTS, 3) + moved,
                volumes=torch.rand(POINTS),
                damage=torch.rand(POINTS),
                fragments=torch.zeros(POINTS, dtype=torch.int32),
                velocity=torch.rand(POINTS, 3),
                body=torch.zeros(POINTS, dtype=torch.int32),
                material=torch.zeros(POINTS, dtype=torch.int32),
                facts={"kinetic": 1.0},
            )
        )
    return found


def same(one: SavedFrame, other: SavedFrame) -> None:
    mine, theirs = packed_frame(one), packed_frame(other)
    assert mine.keys() == theirs.keys()
    assert all(np.array_equal(mine[name], theirs[name]) for name in mine)


def test_what_stays_is_stored_once(tmp_path: Path) -> None:
    writer = FrameWriter(tmp_path)
    for frame in frames():
        writer.write(frame.index, packed_frame(frame))
    for frame in frames():
        same(load_frame(tmp_path, frame.index), frame)
        assert torch.equal(frame_positions(tmp_path, frame.index), frame.positions)
    sizes = [frame_path(tmp_path, index).stat().st_size for index in range(COUNT)]
    assert sizes[1] < 0.6 * sizes[0]
    with np.load(frame_path(tmp_path, 4)) as held:
        assert held.files == ["head"]  # nothing has changed since frame 3
        kept = json.loads(str(held["head"]))["kept"]
    assert kept["positions"] == 3 and kept["volumes"] == 0 and kept["ids"] == 2


def test_a_bit_that_differs_is_a_change(tmp_path: Path) -> None:
    writer, (frame, *_) = FrameWriter(tmp_path), frames()
    writer.write(0, packed_frame(frame))
    other = frame.positions.clone()
    other[0, 0] = -0.0
    for index, value in ((1, 0.0), (2, -0.0)):
        other[0, 0] = value
        writer.write(index, packed_frame(replace(frame, index=index, positions=other.clone())))
    signs = [bool(frame_positions(tmp_path, index)[0, 0].signbit()) for index in (1, 2)]
    assert signs == [False, True]


@pytest.mark.parametrize("broken_after", [1, 3])
def test_files_are_the_same_after_a_break(tmp_path: Path, broken_after: int) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    writer = FrameWriter(whole)
    for frame in frames():
        writer.write(frame.index, packed_frame(frame))
    writer = FrameWriter(parts)
    for frame in frames():
        if frame.index == broken_after:
            writer = FrameWriter(parts, broken_after)
        writer.write(frame.index, packed_frame(frame))
    for index in range(COUNT):
        assert frame_path(whole, index).read_bytes() == frame_path(parts, index).read_bytes()


def test_frames_written_anew_serve_those_behind_them(tmp_path: Path) -> None:
    writer, given = FrameWriter(tmp_path), frames()
    for frame in given:
        writer.write(frame.index, packed_frame(frame))
    again = FrameWriter(tmp_path, 1)
    for frame in given[1:4]:
        again.write(frame.index, packed_frame(frame))
    same(load_frame(tmp_path, 4), given[4])


def test_a_frame_that_others_need_is_missed(tmp_path: Path) -> None:
    writer = FrameWriter(tmp_path)
    for frame in frames():
        writer.write(frame.index, packed_frame(frame))
    frame_path(tmp_path, 0).unlink()
    with pytest.raises(RunError, match=r"frame_0002\.npz: no readable frame"):
        load_frame(tmp_path, 1)
    with pytest.raises(RunError, match=r"frame_0002\.npz: no readable frame"):
        FrameWriter(tmp_path, 2)


@pytest.mark.parametrize("kept", [{"volumes": 1}, {"volumes": -1}, {"volumes": "0"}, [1], 3])
def test_a_head_that_points_elsewhere_is_refused(tmp_path: Path, kept: object) -> None:
    (frame, *_) = frames()
    arrays = packed_frame(frame)
    head = json.loads(str(arrays["head"])) | {"index": 1, "kept": kept}
    del arrays["volumes"]
    FrameWriter(tmp_path).write(0, packed_frame(frame))
    FrameWriter(tmp_path).write(1, arrays | {"head": np.array(json.dumps(head))})
    with pytest.raises(RunError, match="no readable frame"):
        load_frame(tmp_path, 1)
