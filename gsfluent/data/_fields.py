"""Declared shapes for tensor containers, checked once on construction.

A container is a frozen dataclass whose tensor fields are annotated
``Annotated[Tensor, Shape("N", 3, unit="m")]``. Letters name sizes that must agree between the
fields of one container, so a row of one field and the same row of another are always the same
particle or splat.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

_Self = TypeVar("_Self", bound="TensorContainer")

_KINDS = {
    "float": (torch.float32, torch.float64),
    "int": (torch.int32,),
    "bool": (torch.bool,),
}


@dataclasses.dataclass(frozen=True)
class Shape:
    """Shape, number kind and unit of one tensor field.

    Args:
        sizes: Integers are exact; letters are shared between the fields of the container.
        kind: ``"float"`` (float32 or float64), ``"int"`` (int32) or ``"bool"``.
        unit: Unit for the documentation, empty when the field has none.
    """

    sizes: tuple[int | str, ...]
    kind: str = "float"
    unit: str = ""

    def __str__(self) -> str:
        return "[" + ", ".join(str(size) for size in self.sizes) + "]"


def shape(*sizes: int | str, kind: str = "float", unit: str = "") -> Shape:
    """Short form of :class:`Shape` for annotations."""
    return Shape(sizes, kind, unit)


_FIELDS: dict[type, dict[str, tuple[Shape, bool]]] = {}


def tensor_fields(cls: type) -> dict[str, tuple[Shape, bool]]:
    """Return name -> (shape, may be None) for the annotated tensor fields of a container class."""
    if cls in _FIELDS:
        return _FIELDS[cls]
    found: dict[str, tuple[Shape, bool]] = {}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        optional = False
        for part in [hint, *get_args(hint)]:
            if part is type(None):
                optional = True
        for part in [hint, *get_args(hint)]:
            if get_origin(part) is Annotated:
                for extra in get_args(part)[1:]:
                    if isinstance(extra, Shape):
                        found[name] = (extra, optional)
    _FIELDS[cls] = found
    return found


class TensorContainer:
    """Shape checks, ``to``, ``map`` and ``replace`` for frozen dataclasses of tensors."""

    def __post_init__(self) -> None:
        """Check every declared tensor field."""
        self._check()

    def _check(self) -> None:
        owner = type(self).__name__
        sizes: dict[str, tuple[int, str]] = {}
        device: tuple[torch.device, str] | None = None
        dtype: tuple[torch.dtype, str] | None = None
        for name, (wanted, optional) in tensor_fields(type(self)).items():
            value = getattr(self, name)
            if value is None and optional:
                continue
            if not isinstance(value, Tensor):
                raise TypeError(
                    f"{owner}: {name} must be a torch.Tensor, got {type(value).__name__}"
                )
            if value.dtype not in _KINDS[wanted.kind]:
                got = str(value.dtype).removeprefix("torch.")
                names = " or ".join(
                    str(kind).removeprefix("torch.") for kind in _KINDS[wanted.kind]
                )
                raise TypeError(f"{owner}: {name} must be {names}, got {got}")
            _check_sizes(owner, name, value, wanted, sizes)
            if device is None:
                device = (value.device, name)
            elif value.device != device[0]:
                raise ValueError(
                    f"{owner}: {name} must be on {device[0]} like {device[1]}, got {value.device}; "
                    "move it with .to(device)"
                )
            if wanted.kind == "float":
                if dtype is None:
                    dtype = (value.dtype, name)
                elif value.dtype != dtype[0]:
                    raise TypeError(
                        f"{owner}: {name} must be {dtype[0]} like {dtype[1]}, got {value.dtype}"
                    )

    def map(self: _Self, function: Callable[[Tensor], Tensor]) -> _Self:
        """Return a copy with ``function`` applied to every tensor field that is present."""
        changed = {}
        for name in tensor_fields(type(self)):
            value = getattr(self, name)
            if value is not None:
                changed[name] = function(value)
        return dataclasses.replace(self, **changed)  # type: ignore[type-var]

    def to(
        self: _Self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> _Self:
        """Return a copy on ``device``; ``dtype`` applies to the float fields only."""

        def move(value: Tensor) -> Tensor:
            return value.to(device=device, dtype=dtype if value.is_floating_point() else None)

        return self.map(move)

    def replace(self: _Self, **changes: Any) -> _Self:
        """Return a copy with the named fields replaced; shapes are checked again."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


def _check_sizes(
    owner: str, name: str, value: Tensor, wanted: Shape, sizes: dict[str, tuple[int, str]]
) -> None:
    """Compare one tensor with its declared shape, learning the letters met for the first time."""
    got = list(value.shape)
    matches = len(got) == len(wanted.sizes)
    for size, target in zip(got, wanted.sizes, strict=False):
        if isinstance(target, str):
            matches = matches and sizes.get(target, (size, name))[0] == size
        else:
            matches = matches and size == target
    if not matches:
        known = [
            f"{letter} = {sizes[letter][0]} (from {sizes[letter][1]})"
            for letter in wanted.sizes
            if letter in sizes
        ]
        where = " with " + ", ".join(known) if known else ""
        raise ValueError(f"{owner}: {name} must have shape {wanted}{where}, got {got}")
    for size, target in zip(got, wanted.sizes, strict=True):
        if isinstance(target, str):
            sizes.setdefault(target, (size, name))
