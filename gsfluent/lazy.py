"""Modules that take a while to import, imported when something is first asked of them.

``from gsfluent.lazy import cv2, ndimage`` stands at the top of a file like any other import, and
``import gsfluent`` still costs torch and nothing else.
"""

from __future__ import annotations

import importlib
from typing import Any


class _Lazy:
    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, key: str) -> Any:
        return getattr(importlib.import_module(self._name), key)


cv2 = _Lazy("cv2")
ndimage = _Lazy("scipy.ndimage")
