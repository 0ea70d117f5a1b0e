"""Which photograph a label file belongs to."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePosixPath

from gsfluent.data.capture import Capture
from gsfluent.errors import InputError

_WORDS = re.compile(r"[_.-](masks?|labels?|seg|segm|segmentation|instances?|semantic)$", re.I)


class ViewNames:
    """Finds the view of a capture that a file name means.

    ``000``, ``000.png``, ``images/000`` and, for a file, ``000.jpg.png`` or ``000_mask.png`` mean
    the photograph ``images/000.jpg``; an ending that several photographs share means none.
    """

    def __init__(self, capture: Capture) -> None:
        self.names = [camera.name or str(camera.image_path or "") for camera in capture.cameras]
        self._index: dict[str, int | None] = {}
        for index, name in enumerate(self.names):
            parts = PurePosixPath(name.replace("\\", "/")).parts
            for start in range(len(parts)):
                whole = PurePosixPath(*parts[start:])
                for key in {str(whole), str(whole.with_suffix(""))}:
                    taken = self._index.get(key, index)
                    self._index[key] = index if taken == index else None

    def find(self, file: str) -> int | None:
        """Index of the view that a relative path (with or without suffix) means, or None."""
        path = PurePosixPath(file.replace("\\", "/"))
        bare = str(path.with_suffix("")) if path.suffix else str(path)
        for key in (str(path), bare, _WORDS.sub("", bare)):
            for candidate in (
                key,
                str(PurePosixPath(key).with_suffix("")),
                PurePosixPath(key).name,
            ):
                found = self._index.get(candidate)
                if found is not None:
                    return found
        return None

    def no_match(self, where: str, files: Iterable[str]) -> InputError:
        """The error when no file belongs to a photograph."""
        ours = ", ".join(self.names[:3])
        theirs = ", ".join(sorted(files)[:3]) or "nothing"
        return InputError(
            f"{where}: no file is named like a photograph (files: {theirs}; photographs: {ours})",
            "name each label file like its photograph, for example 000.png for images/000.jpg",
        )
