"""A shot and a text, to the numbers that a video model takes for likely."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from gsfluent.choose.shot import shot_scene
from gsfluent.config import Shot
from gsfluent.errors import InputError
from gsfluent.fit.job import UNSEEN, left
from gsfluent.pipeline.fit import Guide, VideoPrior
from gsfluent.progress import LineReporter, Reporter


def guide_to(
    shot: Shot,
    out: Path,
    learn: Sequence[str],
    *,
    model: Path | None,
    prompt: str | None,
    rounds: int = 60,
    cells: int = 8,
    seed: int = 0,
    device: torch.device | str = "cpu",
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Learn numbers of a shot from a text, see :class:`gsfluent.pipeline.fit.Guide`.

    Args:
        shot: Where the search starts; its film is as long as the shot's.
        out: Folder for the results.
        learn: ``OBJECT.NUMBER`` or ``OBJECT/PART.NUMBER`` each.
        model: Folder of a text-to-video pipeline of diffusers.
        prompt: What the film shows.
        rounds: Steps.
        cells: Along the longest side of the largest body.
        seed: Of noise and times, and of solids.
        device: Where all of it runs.
        reporter: Told of the progress.

    Returns:
        The content of ``fit.json``.

    Raises:
        InputError: A name is wrong, or the model is missing.
        RunError: The numbers cannot be run.
    """
    if model is None or not prompt:
        raise InputError("fit: --guidance sds needs --model and --prompt", "give both")
    reporter = reporter or LineReporter()
    prior = VideoPrior(model, prompt, device=device)
    scene, _ = shot_scene(
        shot, out, device=torch.device(device), seed=seed, reporter=reporter, make=True
    )
    stage = Guide(
        list(learn), prior, seconds=shot.output.seconds, rounds=rounds, cells=cells, device=device,
        seed=seed,
    )  # fmt: skip
    found = stage(scene, progress=reporter.task("guided"))
    return left(shot, out, found, UNSEEN, target="sds", prompt=prompt)
