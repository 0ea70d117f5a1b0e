"""The verb that finds poses: poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gsfluent.cli.common import Out, Verb, existing


@dataclass(kw_only=True)
class Poses(Verb):
    """Find where photographs were taken from, so that a run can start from them.

    Examples:
      gsfluent poses photos -o captures/apple              # a folder of photographs
      gsfluent poses clip.mp4 -o captures/apple            # frames of a video
      gsfluent poses clip.mp4 -o captures/apple --frames 80

    Needs the extra `poses` (pycolmap). Says how many photographs found their place, and what to do
    about the others. Then: gsfluent run captures/apple -o out
    """

    photographs: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photographs, or a video."""
    out: Out
    """Folder of the capture: images/, sparse/0 and poses.json."""
    frames: int = 120
    """Of a video: how many frames are taken, the sharpest of each stretch."""

    def execute(self) -> dict[str, Any]:
        """Pose and write."""
        from gsfluent.posing.colmap import find_poses

        existing(self.photographs, "PHOTOS")
        with self.progress("poses") as progress:
            return find_poses(
                self.photographs, self.out, frames=self.frames, seed=self.seed, progress=progress
            )

    def text(self, result: dict[str, Any]) -> str | None:
        """What a person reads."""
        lines = [
            f"{result['registered']} of {result['images']} photographs have poses, "
            f"{result['points']} points, reprojection error {result['reprojection_error']:.2f} px"
        ]
        if result["missing"]:
            lines.append(f"without: {', '.join(result['missing'][:10])}")
        lines += result["advice"]
        return "\n".join([*lines, f"next: gsfluent run {result['output']} -o out"])
