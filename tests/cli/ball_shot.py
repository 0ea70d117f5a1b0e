"""The shot that the command-line tests run: a small ball drops; a few seconds of work in all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml


def write_shot(path: Path, ball: Path, **changes: Any) -> Path:
    """Write the shot of ``ball`` to ``path``, with top-level keys replaced by ``changes``."""
    values: dict[str, Any] = {
        "splats": str(ball),
        "scale": 1.0,
        "up": "+z",
        "fill": {"resolution": 24},
        "texture": {"method": "color_copy"},
        "objects": {"ball": {"material": "bread"}},
        "events": [{"type": "drop", "height": 0.3}],
        "solve": {"quality": "preview"},
        "output": {"fps": 20, "seconds": 0.5, "size": [96, 64], "what": ["mp4", "ply-seq"]},
    }
    path.write_text(yaml.safe_dump(values | changes))
    return path
