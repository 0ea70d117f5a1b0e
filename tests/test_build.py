"""The compiled library is there and answers for the device it was built for."""

import torch

from gsfluent import _load, ops  # noqa: F401


def test_cpu_library_answers() -> None:
    assert torch.ops.gsfluent.compiled_for(torch.zeros(1)).startswith("cpu")


def test_has_cuda_agrees_with_torch() -> None:
    if not torch.cuda.is_available():
        assert not _load.has_cuda()
    else:
        assert _load.has_cuda() == _load.HAS_CUDA_KERNELS
