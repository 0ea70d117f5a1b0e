"""Build the compiled half of gsfluent: `_C` (CPU), `_C_cuda` (when possible), `_core` (for tests).

Environment:
    GSFLUENT_CUDA   auto (default: CUDA when torch has CUDA and a toolkit is found) | 0 |
                    1 (also a cross build on CPU-only torch)
    GSFLUENT_ARCH   CUDA architectures, comma separated (default 90)
    GSFLUENT_CORE   auto (default: `_core` in checkouts, not in wheels, which it would tie to one
                    Python) | 0 | 1
    GSFLUENT_RELEASE  1 leaves line numbers out of the kernels and compresses them, and names of
                    what is not exported out of the libraries
    GSFLUENT_MARCH  CPU architecture for -march (default x86-64-v3 on x86-64; empty elsewhere)
    DEBUG           1 builds with -O1 -g
"""

import os
import platform
from pathlib import Path

import torch
from setuptools import Extension, setup
from torch.utils import cpp_extension

ROOT = Path(__file__).resolve().parent
DEBUG = os.environ.get("DEBUG") == "1"
RELEASE = os.environ.get("GSFLUENT_RELEASE") == "1"
NO_SYMBOLS = ["-s"] if RELEASE else []
CORE = os.environ.get("GSFLUENT_CORE", "auto")
if CORE not in ("auto", "0", "1"):
    raise SystemExit(f"GSFLUENT_CORE must be auto, 0 or 1, got {CORE!r}")

# Stable ABI, oldest supported torch 2.11: one binary serves every later torch
# (docs/design/0001-stable-abi.md).
TORCH_TARGET = "-DTORCH_TARGET_VERSION=0x020b000000000000"


def sources(*patterns: str) -> list[str]:
    return sorted(str(p.relative_to(ROOT)) for pattern in patterns for p in ROOT.glob(pattern))


def find_cuda_home() -> str | None:
    """The toolkit folder; `which nvcc` is not trusted because it may be a wrapper script."""
    candidates = [os.environ.get("CUDA_HOME"), cpp_extension.CUDA_HOME, "/usr/local/cuda"]
    for candidate in candidates:
        if candidate and (Path(candidate) / "include" / "cuda_runtime_api.h").exists():
            return str(Path(candidate).resolve())
    return None


def cxx_flags() -> list[str]:
    default_march = "x86-64-v3" if platform.machine() in ("x86_64", "AMD64") else ""
    march = os.environ.get("GSFLUENT_MARCH", default_march)
    flags = [
        "-std=c++20",
        "-g" if DEBUG else "-g0",
        "-O1" if DEBUG else "-O3",
        "-fno-math-errno",
        "-fno-trapping-math",
        "-fvisibility=hidden",
        "-Wall",
        "-Wextra",
        "-Wno-unused-parameter",  # torch headers
        f"-ffile-prefix-map={ROOT}/=",
    ]
    return flags + ([f"-march={march}"] if march else [])


def cpu_extension() -> cpp_extension.CppExtension:
    return cpp_extension.CppExtension(
        "gsfluent._C",
        sources("csrc/library.cpp", "csrc/cpu/**/*.cpp"),
        include_dirs=[str(ROOT / "csrc")],
        depends=sources("csrc/**/*.h"),
        extra_compile_args={"cxx": [TORCH_TARGET, *cxx_flags()]},
        extra_link_args=NO_SYMBOLS,
        py_limited_api=True,
    )


def cuda_extension() -> list:
    wish = os.environ.get("GSFLUENT_CUDA", "auto")
    if wish not in ("auto", "0", "1"):
        raise SystemExit(f"GSFLUENT_CUDA must be auto, 0 or 1, got {wish!r}")
    if wish == "0" or (wish == "auto" and torch.version.cuda is None):
        return []
    home = find_cuda_home()
    if home is None:
        if wish == "1":
            raise SystemExit("GSFLUENT_CUDA=1 needs the CUDA toolkit; set CUDA_HOME to its folder")
        return []
    # CPU-only torch leaves CUDA_HOME unset; the cross build needs it.
    cpp_extension.CUDA_HOME = home
    os.environ["CUDA_HOME"] = home
    arches = os.environ.get("GSFLUENT_ARCH", "90").split(",")
    gencode = [f"-gencode=arch=compute_{a},code=sm_{a}" for a in arches]
    gencode.append(f"-gencode=arch=compute_{arches[-1]},code=compute_{arches[-1]}")
    return [
        cpp_extension.CppExtension(
            "gsfluent._C_cuda",
            sources("csrc/cuda/**/*.cu", "csrc/cuda/**/*.cpp"),
            include_dirs=[str(ROOT / "csrc"), f"{home}/include"],
            library_dirs=[f"{home}/lib64"],
            libraries=["cudart"],
            depends=sources("csrc/**/*.h"),
            extra_compile_args={
                "cxx": [TORCH_TARGET, "-DUSE_CUDA", *cxx_flags()],
                "nvcc": [
                    "-DUSE_CUDA",
                    "-std=c++20",
                    "-O3",
                    *(
                        ["-Xfatbin=-compress-all", "--compress-mode=size"]
                        if RELEASE
                        else ["-lineinfo"]
                    ),
                    "--expt-relaxed-constexpr",
                    # float32 quotients and roots to 2 ulp: the exact ones branch, and the kernels
                    # are bound by instructions; tests hold them to the CPU's
                    "--prec-div=false",
                    "--prec-sqrt=false",
                    "-Xcompiler=-fPIC,-fvisibility=hidden",
                    *gencode,
                ],
            },
            # libtorch.so pulls in libtorch_cuda.so on the GPU machine; --as-needed would drop it.
            extra_link_args=["-Wl,--no-as-needed", "-ltorch", "-Wl,--as-needed", *NO_SYMBOLS],
            py_limited_api=True,
        )
    ]


def core_extension() -> list:
    """pybind11 face of csrc/core (one particle, one splat, one fit) for tests and the lab."""
    if CORE == "0":
        return []
    import pybind11

    return [
        Extension(
            "gsfluent._core",
            ["csrc/bindings.cpp"],
            include_dirs=[pybind11.get_include(), str(ROOT / "csrc")],
            depends=sources("csrc/core/**/*.h"),
            extra_compile_args=cxx_flags(),
            language="c++",
        )
    ]


def remove_stale(objects: Path, headers: list[Path]) -> None:
    """Remove what was compiled before a header changed.

    torch tells ninja the headers of a .cu file on machines with a CUDA torch only: a cross build
    would link kernels that know an older layout of the same struct.
    """
    newest = max((header.stat().st_mtime for header in headers), default=0.0)
    for compiled in objects.rglob("*.o"):
        if compiled.stat().st_mtime < newest:
            compiled.unlink()


class BuildExtension(cpp_extension.BuildExtension):
    """torch's, which leaves `_core` out of everything but checkouts."""

    def run(self) -> None:
        if CORE == "auto" and not (self.inplace or self.editable_mode):
            self.extensions = [e for e in self.extensions if e.name != "gsfluent._core"]
        if torch.version.cuda is None:
            remove_stale(Path(self.build_temp) / "csrc/cuda", list((ROOT / "csrc").rglob("*.h")))
        super().run()


setup(
    ext_modules=[cpu_extension(), *cuda_extension(), *core_extension()],
    cmdclass={"build_ext": BuildExtension},
    # without `_core` nothing in a wheel hangs on the version of Python
    options={} if CORE == "1" else {"bdist_wheel": {"py_limited_api": "cp311"}},
)
