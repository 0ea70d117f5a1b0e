"""Finished slices on disk."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np

from gsfluent.errors import InputError

__all__ = ["SliceStore"]

logger = logging.getLogger(__name__)


class SliceStore:
    """Finished slices on disk, so that an interrupted run goes on where it stopped.

    Args:
        folder: Where to keep them; None keeps nothing.
        key: What the slices depend on; another key starts afresh.

    Raises:
        InputError: The folder cannot be written.
    """

    def __init__(self, folder: Path | None, key: str) -> None:
        self.folder = folder
        self.loaded = 0
        if folder is None:
            return
        try:
            folder.mkdir(parents=True, exist_ok=True)
            marker = folder / "key.txt"
            if not marker.is_file() or marker.read_text() != key:
                stale = list(folder.glob("slice_*.npy"))
                for path in stale:
                    path.unlink()
                if stale:
                    logger.info("%s: settings changed, %d slices redone", folder, len(stale))
                temporary = marker.with_suffix(".part")
                temporary.write_text(key)
                os.replace(temporary, marker)
        except OSError as error:
            raise InputError(
                f"{folder}: slices cannot be kept here ({error})", mend="choose a writable folder"
            ) from error

    def get(self, number: int, axis: int, index: int, shape: tuple[int, ...]) -> np.ndarray | None:
        """Slice ``index`` across ``axis`` of pass ``number``, if it was finished."""
        if self.folder is None:
            return None
        path = self.folder / f"slice_{number}_{axis}_{index:04d}.npy"
        if not path.is_file():
            return None
        try:
            image = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            return None  # cut off while writing: made again
        if image.shape != shape:
            return None
        self.loaded += 1
        return np.asarray(image, np.float32)

    def put(self, number: int, axis: int, index: int, image: np.ndarray) -> None:
        """Keep a finished slice."""
        if self.folder is None:
            return
        path = self.folder / f"slice_{number}_{axis}_{index:04d}.npy"
        temporary = path.with_suffix(".part.npy")
        np.save(temporary, image.astype(np.float32))
        os.replace(temporary, path)
