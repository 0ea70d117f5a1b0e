"""Splats in the checkpoints of gsplat's trainer and of nerfstudio's splatfacto; read only.

A checkpoint is a zip with a pickle that names tensors, and their bytes. ``torch.load`` is not
asked, not even with ``weights_only``: it builds byte arrays of any size and believes the size of a
storage. Here the pickle may name ordered dictionaries and tensors, and of the tensors only those
of splats are read, so what an optimiser has left costs nothing.
"""

from __future__ import annotations

import collections
import io
import math
import pickle
import pickletools
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsfluent import geometry
from gsfluent.data.gaussians import Gaussians
from gsfluent.errors import InputError, short
from gsfluent.io.checked.files import regular_file
from gsfluent.io.checked.limits import unpacked_limit, within
from gsfluent.io.splats.compressed import float_tensor

_EXPORT = "export a .ply: gsplat's trainer with --save_ply, nerfstudio by ns-export gaussian-splat"
_STORAGES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?", "BFloat16Storage": "",
}  # fmt: skip
"""Number types; what NumPy has none for may stand in a checkpoint but is no splat."""

_GSPLAT = {
    "means": "means", "quats": "quats", "scales": "scales", "opacities": "opacities",
    "sh0": "sh0", "shN": "shN",
}  # fmt: skip
_NERFSTUDIO = {
    "means": "means", "quats": "quats", "scales": "scales", "opacities": "opacities",
    "sh0": "features_dc", "shN": "features_rest",
}  # fmt: skip
_PREFIX = "_model.gauss_params."


@dataclass(frozen=True)
class _Tensor:
    """Where the numbers of a tensor lie."""

    storage: tuple[str, str]  # number type, name of its bytes
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def load_checkpoint(path: str | Path) -> Gaussians:
    """Read the splats of a ``.pt`` or ``.ckpt``, as float32 on the CPU.

    Raises:
        InputError: Missing, damaged, of another trainer, above the limit of unpacked bytes, or it
            names something that is no tensor.
    """
    most = unpacked_limit(regular_file(path))
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            within("unpacked_bytes", sum(item.file_size for item in infos), path, most)
            if any(item.compress_type != zipfile.ZIP_STORED for item in infos):
                raise ValueError("its tensors are packed, which torch does not do")
            (record,) = (i.filename for i in infos if i.filename.endswith("/data.pkl"))
            values = _unpickle(archive.read(record))
            found, logistic = _splats(path, values)
            folder = record.removesuffix("data.pkl") + "data/"
            arrays = {name: _read(archive, folder, tensor, most) for name, tensor in found.items()}
        return _gaussians(arrays, logistic).validated(str(path))
    except InputError:
        raise
    except pickle.UnpicklingError as error:
        raise InputError(f"{path}: {error}", _EXPORT) from error
    except (
        OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, OverflowError,
        AttributeError, RecursionError, MemoryError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        raise InputError(
            f"{path}: is no checkpoint of splats, or damaged ({type(error).__name__}: "
            f"{short(str(error), bare=True)})",
            _EXPORT,
        ) from error


class _Unpickler(pickle.Unpickler):
    """Builds dictionaries, lists, numbers and descriptions of tensors, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """What a name of the pickle stands for."""
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return lambda data, *rest: data
        if module == "torch" and name in _STORAGES:
            return name
        raise pickle.UnpicklingError(
            f"the checkpoint names {short(f'{module}.{name}', bare=True)}, which is no tensor"
        )

    def persistent_load(self, pid: Any) -> Any:
        """The storage that a tensor lies in."""
        _, kind, key, *_ = pid
        return (_STORAGES[kind], str(key))


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *rest: Any) -> _Tensor:
    return _Tensor(storage, int(offset), tuple(map(int, size)), tuple(map(int, stride)))


def _unpickle(data: bytes) -> Any:
    for code, argument, _ in pickletools.genops(data):
        # the memory of what is put at a place is allocated up to that place
        if "PUT" in code.name and argument is not None and int(argument) > len(data):
            raise ValueError("the pickle remembers more than it holds")
    return _Unpickler(io.BytesIO(data)).load()


def _splats(path: str | Path, values: Any) -> tuple[dict[str, _Tensor], bool]:
    """The tensors of the splats by gsplat's names, and whether colours are logistic."""
    if not isinstance(values, Mapping):
        raise ValueError("it holds no dictionary")
    if isinstance(values.get("pipeline"), Mapping):
        held = {
            str(key).removeprefix(_PREFIX): value
            for key, value in values["pipeline"].items()
            if str(key).startswith(_PREFIX)
        }
        names = _NERFSTUDIO
    else:
        held, names = values.get("splats", values), _GSPLAT
    if not isinstance(held, Mapping):
        raise ValueError("'splats' is no dictionary")
    if "features" in held and "sh0" not in held and "features_dc" not in held:
        raise InputError(f"{path}: its colours depend on the photograph (app_opt)", _EXPORT)
    found = {name: held[key] for name, key in names.items() if key in held}
    missing = [names[name] for name in names if name not in found and name != "shN"]
    wrong = [names[name] for name, value in found.items() if not isinstance(value, _Tensor)]
    if missing or wrong:
        what = f"lacks {', '.join(missing)}" if missing else f"{wrong[0]} is no tensor"
        raise InputError(f"{path}: is no checkpoint of splats ({what})", _EXPORT)
    rest = found.get("shN")
    # splatfacto without bands trains the logit of the colour
    logistic = names is _NERFSTUDIO and (rest is None or 0 in rest.size)
    return found, logistic


def _read(archive: zipfile.ZipFile, folder: str, tensor: _Tensor, most: int) -> NDArray[Any]:
    kind, key = tensor.storage
    numbers = np.frombuffer(archive.read(folder + key), dtype=kind or "u1")
    within("unpacked_bytes", 8 * math.prod(tensor.size), archive.filename, most)
    last = tensor.offset + sum((n - 1) * s for n, s in zip(tensor.size, tensor.stride, strict=True))
    if not kind or min((tensor.offset, *tensor.size, *tensor.stride)) < 0:
        raise ValueError("a tensor of splats is not of plain numbers")
    if 0 not in tensor.size and last >= len(numbers):
        raise ValueError(f"a tensor of {list(tensor.size)} in {len(numbers)} numbers")
    if 0 in tensor.size:
        return np.zeros(tensor.size)
    strides = [step * numbers.itemsize for step in tensor.stride]
    view = np.lib.stride_tricks.as_strided(numbers[tensor.offset :], tensor.size, strides)
    return view.astype(np.float64)


def _gaussians(arrays: dict[str, NDArray[Any]], logistic: bool) -> Gaussians:
    count = len(arrays["means"])
    constant = arrays["sh0"].reshape(count, 1, 3)
    if logistic:
        constant = (_sigmoid(constant) - 0.5) / geometry.SH0
    rest = arrays.get("shN", np.zeros((count, 0, 3))).reshape(count, -1, 3)
    geometry.sh_degree(rest.shape[1] + 1)
    with np.errstate(over="ignore"):
        scales = np.exp(arrays["scales"].reshape(count, 3))
    quats = torch.from_numpy(arrays["quats"].reshape(count, 4))
    return Gaussians(
        means=float_tensor(arrays["means"].reshape(count, 3)),
        quats=geometry.normalize_quaternions(quats).to(torch.float32),
        scales=float_tensor(scales),
        opacities=float_tensor(_sigmoid(arrays["opacities"].reshape(count))),
        sh=float_tensor(np.concatenate([constant, rest], axis=1)),
    )


def _sigmoid(logit: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(over="ignore"):
        return 1.0 / (1.0 + np.exp(-logit))
