"""Load the compiled libraries: ``_C`` (schemas, CPU kernels), and ``_C_cuda`` if torch has CUDA."""

from __future__ import annotations

import platform
from pathlib import Path

import torch

_HERE = Path(__file__).resolve().parent
_REBUILD = "run `pip install --no-build-isolation .` in the gsfluent checkout"


def _find(stem: str) -> Path | None:
    matches = sorted(_HERE.glob(f"{stem}.*so"))
    return matches[0] if matches else None


def _load_cpu() -> None:
    path = _find("_C")
    if path is None:
        raise ImportError(f"gsfluent was installed without its compiled library; {_REBUILD}")
    if (
        platform.machine() in ("x86_64", "AMD64")
        and torch.backends.cpu.get_cpu_capability() == "DEFAULT"
    ):
        raise ImportError(
            "gsfluent's compiled library needs AVX2, which this CPU lacks; "
            f"set GSFLUENT_MARCH=x86-64 and {_REBUILD}"
        )
    torch.ops.load_library(str(path))


def _load_cuda() -> str:
    """Load the library for GPUs; why not, empty when it is loaded."""
    if torch.version.cuda is None:
        return "this torch has no CUDA; install a CUDA torch"
    path = _find("_C_cuda")
    if path is None:
        return "gsfluent was built without its CUDA kernels; reinstall with GSFLUENT_CUDA=1"
    try:
        torch.ops.load_library(str(path))
    except OSError as error:
        if "libcudart" not in str(error):
            raise
        # this torch brought the runtime of another major version
        return (
            f"torch has CUDA {torch.version.cuda}, gsfluent's kernels another ({error}); "
            "install a torch of that CUDA, or build gsfluent from its source"
        )
    return ""


_load_cpu()
NO_CUDA_KERNELS: str = _load_cuda()
HAS_CUDA_KERNELS: bool = not NO_CUDA_KERNELS


def has_cuda() -> bool:
    """True when CUDA kernels are loaded and a CUDA device is usable."""
    return HAS_CUDA_KERNELS and torch.cuda.is_available()
