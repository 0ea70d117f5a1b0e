"""Several tasks on a GPU: who gets which, how much, and what becomes of one that wants more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sweep_tasks import its_card, names, odd_ones_fail, square

from gsfluent.cli import main
from gsfluent.errors import InputError, RunError
from gsfluent.hardware import CONTEXT, graphics_cards, part_of_gpu
from gsfluent.sweep import engine, shots
from gsfluent.sweep.attempt import attempt
from gsfluent.sweep.engine import map
from gsfluent.sweep.folder import SweepFolder
from gsfluent.sweep.pool import LocalPool


def test_tasks_are_spread_over_the_cards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5, 7")
    assert graphics_cards() == ["5", "7"]
    found = map(its_card, range(4), tmp_path, ids=names(4), gpu=1.0)
    assert {o.value for o in found} == {"5", "7"}
    for part, room in ((1.0, 2), (0.5, 4), (0.3, 6), (0.125, 9)):
        assert LocalPool(tmp_path, square, jobs=9, minutes=None, gpu=part).room() == room
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with pytest.raises(InputError, match="no GPU"):
        LocalPool(tmp_path, square, jobs=9, minutes=None, gpu=0.5)
    with pytest.raises(InputError, match=r"gpu is 1\.5"):
        map(square, [1], tmp_path, ids=["a"], gpu=1.5)


@given(st.floats(0, 1e12), st.floats(1e9, 1e12))
def test_a_part_has_room_for_twice_what_is_used(used: float, total: float) -> None:
    part = part_of_gpu(used, total)
    assert part in [n / 8 for n in range(1, 9)]
    assert part == 1.0 or part * total >= 2 * used + CONTEXT - 1.0
    assert part == 0.125 or (part - 0.125) * total < 2 * used + CONTEXT + 1.0


class Here:
    """An engine that tries tasks in this process, and notes how large their part of a GPU is."""

    parts: list[float] = []

    def __init__(self, on: str, root: Path, function: Any, *, gpu: float, **more: Any) -> None:
        self.root, self.function, self.gpu = root, function, gpu
        self.parts.append(gpu)
        self.over: list[tuple[str, str]] = []

    def room(self) -> int:
        return 2 - len(self.over)

    def start(self, name: str, item: Any) -> None:
        def work(item: Any, folder: Path) -> Any:
            if item == "large" and self.gpu < 1.0:
                raise RunError("simulate: too much") from torch.OutOfMemoryError("2 GB wanted")
            return odd_ones_fail(item, folder) if isinstance(item, int) else self.gpu

        self.over.append((name, attempt(self.root, name, work, item)))

    def ended(self, seconds: float) -> list[tuple[str, str]]:
        over, self.over = self.over, []
        return over

    def close(self) -> None:
        assert not self.over


def test_what_finds_no_memory_on_a_part_gets_a_whole_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "_engine", Here)
    monkeypatch.setattr(Here, "parts", [])
    items = ["large", "small", 3, "large"]
    found = map(odd_ones_fail, items, tmp_path, ids=names(4), gpu=0.25)
    assert [o.value for o in found] == [1.0, 0.25, None, 1.0]
    assert [o.tries for o in found] == [2, 1, 1, 2] and Here.parts == [0.25, 1.0]
    assert not SweepFolder(tmp_path).failures("n0")
    map(odd_ones_fail, ["small"], tmp_path, ids=["n9"], gpu=0.25)
    assert Here.parts == [0.25, 1.0, 0.25]  # no second pass where none is crowded


def test_parts_come_from_peaks_and_else_from_plans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Card:
        total_memory = 80e9

    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: Card)
    monkeypatch.setattr(shots.CostModel, "load", lambda device: None)
    monkeypatch.setattr(shots, "plan_shot", lambda *given, **named: {"memory_bytes": 14e9})

    class Left:
        seed = 0

        def shot(self) -> None:
            return None

    place = SweepFolder(tmp_path)
    place.make()
    left: Any = [Left()]
    device = torch.device("cuda")
    assert shots._part(device, place, left) == 0.375
    for name, peak in (("a", None), ("b", 4e9)):
        figures = {"peak_device_memory_bytes": peak}
        place.finish(name, place.begin(name), {"id": name, "value": {"figures": figures}})
    assert shots._part(device, place, left) == 0.125


def test_the_verb_refuses_what_is_no_number_of_shots(tmp_path: Path) -> None:
    (tmp_path / "shot.yaml").write_text("splats: a.ply\n")
    words = ["sweep", str(tmp_path / "shot.yaml"), "-o", str(tmp_path), "--seeds", "1"]
    assert main([*words, "--pack", "0"]) == 2


@pytest.mark.cuda
def test_a_process_keeps_to_its_part(tmp_path: Path) -> None:
    found = map(_wants, [0.5, 2.0], tmp_path, ids=["half", "twice"], gpu=0.125, tries=2)
    assert [o.value for o in found] == [0.125, 1.0]


def _wants(parts: float, folder: Path) -> float:
    """Take so many parts of a GPU of an eighth; returns the part that this process may take."""
    total = torch.cuda.get_device_properties(0).total_memory
    torch.empty(int(parts * total / 8), dtype=torch.uint8, device="cuda")
    return 0.125 if torch.cuda.get_per_process_memory_fraction(0) < 0.2 else 1.0
