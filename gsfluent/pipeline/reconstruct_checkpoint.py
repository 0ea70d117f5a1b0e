"""Saving training and going on from it."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.atomic import atomic_path

_log = logging.getLogger(__name__)

_FIELDS = ("means", "quats", "scales", "opacities", "sh")


class Checkpoint:
    """A file with the state of a training; tensors only, replaced atomically.

    Args:
        path: The file; None saves nothing.
        settings: What a saved state must agree on to be resumed.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any]) -> None:
        self.path = path
        self._mark = json.dumps(settings, sort_keys=True)

    def save(
        self,
        state: dict[str, Tensor],
        phase: int,
        scene: Gaussians | None,
    ) -> None:
        """Write the state within ``phase``, and the finished scene."""
        if self.path is None:
            return
        values = dict(state)
        values["phase"] = torch.tensor(phase)
        values["settings"] = torch.tensor(list(self._mark.encode()), dtype=torch.uint8)
        if scene is not None:
            values |= {f"scene.{name}": getattr(scene, name) for name in _FIELDS}
        with atomic_path(self.path) as temporary:
            torch.save(values, temporary)

    def load(self) -> dict[str, Tensor] | None:
        """The saved state, or None when there is none.

        Raises:
            InputError: The file is damaged, or of other settings.
        """
        if self.path is None or not self.path.is_file():
            return None
        try:
            state: dict[str, Tensor] = torch.load(self.path, map_location="cpu", weights_only=True)
            mark = bytes(state["settings"].tolist()).decode()
            _ = state["phase"], state["done"], state["steps"], state["recent"]
        except Exception as error:
            raise InputError(
                f"{self.path}: the checkpoint is damaged ({type(error).__name__})",
                "remove it to start afresh",
            ) from error
        if mark != self._mark:
            raise InputError(
                f"{self.path}: the checkpoint is of other settings, {mark}",
                "remove it, or reconstruct with those settings",
            )
        _log.info("resuming from %s", self.path)
        return state

    @staticmethod
    def scene(state: dict[str, Tensor], device: torch.device) -> Gaussians | None:
        """The finished scene of a saved second phase."""
        if "scene.means" not in state:
            return None
        return Gaussians(*(state[f"scene.{name}"].to(device) for name in _FIELDS))
