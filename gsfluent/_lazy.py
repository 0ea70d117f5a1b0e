"""Names of a package, and modules, that cost nothing until somebody takes one (PEP 562).

``from gsfluent._lazy import cv2, ndimage`` stands at the top of a file like any other import.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy(
    package: str, homes: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Args:
        package: Its ``__name__``.
        homes: Module -> the names that it gives; under the package itself stand its submodules.
    """
    home = {name: module for module, names in homes.items() for name in names}

    def get(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if home[name] == package:
            return importlib.import_module(f"{package}.{name}")
        module = importlib.import_module(home[name])
        # all names of the module at once: importing gsfluent.ops.mvee has just put the module
        # under the name of its function
        found = {each: getattr(module, each) for each in homes[home[name]]}
        vars(sys.modules[package]).update(found)
        return found[name]

    return get, lambda: sorted({*vars(sys.modules[package]), *home}), list(home)


def room(
    package: str, *modules: str, **names: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """The same for a room: what others may take of it, which ``tests/test_layers.py`` checks.

    Args:
        package: Its ``__name__``.
        modules: Those that are taken whole.
        names: By module, the names that others take of it.
    """
    homes = {f"{package}.{module}": tuple(given.split()) for module, given in names.items()}
    return lazy(package, {package: modules, **homes})


class _Module:
    """A module that is imported when something is first asked of it."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, key: str) -> Any:
        return getattr(importlib.import_module(self._name), key)


cv2 = _Module("cv2")
ndimage = _Module("scipy.ndimage")
