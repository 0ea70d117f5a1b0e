"""Hashes, boxes of labels, and what constants added to their fields make of them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.ops.reference import spatial as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def chance(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("device", DEVICES)
def test_hashes_are_those_of_whole_numbers(device: str) -> None:
    seed = torch.randint(0, 1 << 32, (40, 50), generator=chance(1))
    seed[0, :3] = torch.tensor([0, (1 << 32) - 1, -5])
    turns = [0, 1, 7, 112, 112, 1 << 40]
    values = ops.hashes(seed.to(device), turns)
    assert values.shape == (40, 50, 6) and values.dtype == torch.float64
    assert torch.equal(values.cpu(), reference.hashes(seed, turns))
    assert values.amin() < -0.99 and values.amax() < 1.0 and abs(float(values.mean())) < 0.02
    assert ops.hashes(seed[:0].to(device), turns).shape == (0, 50, 6)
    assert ops.hashes(seed.to(device), []).shape == (40, 50, 0)


@pytest.mark.parametrize("device", DEVICES)
def test_boxes_hold_their_labels(device: str) -> None:
    labels = torch.full((9, 11, 13), -1, dtype=torch.int16)
    labels[2:5, 3:4, 6:13] = 0
    labels[0, 0, 0], labels[8, 10, 12] = 2, 2
    labels[7, :, 1] = 3
    labels[4, 5, 6] = 9  # no label of these
    box = ops.label_boxes(labels.to(device), 5)
    assert torch.equal(box.cpu(), reference.label_boxes(labels, 5))
    assert box[:2].tolist() == [[2, 4, 3, 3, 6, 12], [9, -1, 11, -1, 13, -1]]
    assert ops.label_boxes(labels[:0].to(device), 2).tolist() == [[0, -1, 11, -1, 13, -1]] * 2
    assert ops.label_boxes(labels.to(device), 0).shape == (0, 6)
    some = torch.randint(-1, 40, (30, 31, 32), generator=chance(2), dtype=torch.int16)
    some[some == 17] = -1
    box = ops.label_boxes(some.transpose(0, 2).to(device), 40)
    assert torch.equal(box.cpu(), reference.label_boxes(some.transpose(0, 2), 40))


def pairs(count: int, labels: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    first = torch.randint(0, labels, (count,), generator=chance(3))
    second = (first + torch.randint(1, labels, (count,), generator=chance(4))) % labels
    offset = 0.3 * torch.randn(labels, generator=chance(5), dtype=torch.float64)
    return torch.rand(count, generator=chance(6)), first, second, offset


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("labels", [3, 1500])  # few enough for a block to count, and more
def test_voxels_are_counted_as_defined(device: str, labels: int) -> None:
    given = pairs(4000, labels)
    want = reference.margin_counts(*given, 0.2)
    got = ops.margin_counts(*(value.to(device) for value in given), 0.2)
    assert torch.equal(got.cpu(), want)
    assert int(want[0].sum()) == 4000 and 0 < int(want[1].sum()) < 8000
    # a voxel one of whose labels is none counts for nothing
    lead, first, second, offset = (value.to(device) for value in given)
    second[1000:] = torch.tensor([-1, labels, 1 << 40], device=device).repeat(1000)
    got = ops.margin_counts(lead, first, second, offset, 0.2)
    want = reference.margin_counts(*(value[:1000] for value in given[:3]), given[3], 0.2)
    assert torch.equal(got.cpu(), want)
    none = ops.margin_counts(lead[:0], first[:0], second[:0], offset, 0.2)
    assert none.tolist() == [[0] * labels] * 2


def test_errors_and_registration() -> None:
    with pytest.raises(ValueError, match="at most 64 turns"):
        ops.hashes(torch.arange(3), range(65))
    with pytest.raises(TypeError, match="seed"):
        ops.hashes(torch.arange(3.0), [1])
    labels = torch.zeros(3, 4, 5, dtype=torch.int16)
    with pytest.raises(TypeError, match="labels"):
        ops.label_boxes(labels.int(), 2)
    with pytest.raises(ValueError, match="count"):
        ops.label_boxes(labels, -1)
    lead, first, second, offset = pairs(9, 3)
    with pytest.raises(ValueError, match="second"):
        ops.margin_counts(lead, first, second[:8], offset, 0.2)
    with pytest.raises(TypeError, match="offset"):
        ops.margin_counts(lead, first, second, offset.float(), 0.2)
    lib, names = torch.ops.gsfluent, ("test_schema", "test_faketensor")
    torch.library.opcheck(lib.hashes.default, (torch.arange(5), [1, 2]), test_utils=names)
    torch.library.opcheck(lib.label_boxes.default, (labels, 2), test_utils=names)
    arguments = (lead, first, second, offset, 0.2)
    torch.library.opcheck(lib.margin_counts.default, arguments, test_utils=names)
