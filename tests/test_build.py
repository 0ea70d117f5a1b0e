"""The compiled library is there and answers for the device it was built for."""

from __future__ import annotations

import logging
import os
import runpy
from pathlib import Path

import pytest
import torch
from loaded_scripts import load_script

from gsfluent import _load, ops  # noqa: F401
from gsfluent.cli.common import choose_device
from gsfluent.errors import InputError
from gsfluent.inspection.doctor import examine


def test_cpu_library_answers() -> None:
    assert torch.ops.gsfluent.compiled_for(torch.zeros(1)).startswith("cpu")


def test_has_cuda_agrees_with_torch() -> None:
    if not torch.cuda.is_available():
        assert not _load.has_cuda()
    else:
        assert _load.has_cuda() == _load.HAS_CUDA_KERNELS


def test_kernels_of_another_cuda_are_left_out_and_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    words = "libcudart.so.13: cannot open shared object file"

    def load(path: str) -> None:
        raise OSError(words)

    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(_load, "_find", lambda stem: Path(f"{stem}.so"))
    monkeypatch.setattr(torch.ops, "load_library", load)
    said = _load._load_cuda()
    assert "12.8" in said and words in said
    monkeypatch.setattr(_load, "NO_CUDA_KERNELS", said)
    with pytest.raises(InputError, match=r"12\.8") as refused:
        choose_device("cuda")
    assert refused.value.hint.startswith("install a torch of that CUDA") and "cpu" in str(refused)
    monkeypatch.setattr(_load, "HAS_CUDA_KERNELS", False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with caplog.at_level(logging.WARNING):
        assert choose_device("auto").type == "cpu"
    assert "12.8" in caplog.text
    # any other reason is a fault, not another CUDA
    words = "undefined symbol"
    with pytest.raises(OSError, match="undefined"):
        _load._load_cuda()


def test_the_doctor_says_why_there_are_no_kernels() -> None:
    said = examine(torch.device("cpu"))["cuda_library"]
    assert said == ("loaded" if _load.HAS_CUDA_KERNELS else _load.NO_CUDA_KERNELS)


def test_digests_that_wheels_are_compared_by_see_a_last_bit() -> None:
    bits = load_script("safety/bits")
    one = bits.fallen(torch.float32)
    assert bits.digest(one) == bits.digest(bits.fallen(torch.float32))
    before = bits.digest(one)
    one[1][0, 0] = torch.nextafter(one[1][0, 0], torch.tensor(9.0))
    assert bits.digest(one) != before


def test_kernels_are_compiled_anew_when_a_header_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("setuptools.setup", lambda **settings: None)
    build = runpy.run_path(str(Path(__file__).resolve().parents[1] / "setup.py"))
    for name, when in (("solver/step.o", 100), ("solver/new.o", 300), ("state.h", 200)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (when, when))
    build["remove_stale"](tmp_path, [tmp_path / "state.h"])
    assert [path.name for path in tmp_path.rglob("*.o")] == ["new.o"]
