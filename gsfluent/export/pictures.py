"""Pictures of a simulation: video, animations and PNG sequences, along any camera path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsfluent.errors import InputError
from gsfluent.export.job import Job, span
from gsfluent.export.relit import lighting_for
from gsfluent.pipeline.render.camera import Action
from gsfluent.pipeline.render.film import Film, poster_frame
from gsfluent.pipeline.render.path import FREEZE_SECONDS, Cut, freeze
from gsfluent.pipeline.render.video import to_bytes, write_animation, write_video
from gsfluent.results.frames import count_frames, load_frame
from gsfluent.results.record import shot_of

_ALPHA_FLOOR = 1e-4  # below, a pixel has no colour of its own


def mp4(job: Job) -> str:
    """``video.mp4``.

    Raises:
        InputError: Alpha, which H.264 has not.
    """
    if job.options.alpha:
        raise InputError("--alpha: mp4 has no transparency", "use --to png or --to webp")
    sequence = _Pictures(job)
    write_video(job.folder / "video.mp4", sequence.frames("mp4"), fps=job.fps, size=sequence.size)
    return "video.mp4"


def gif(job: Job) -> str:
    """``video.gif``.

    Raises:
        InputError: Alpha, of which GIF has one bit.
    """
    if job.options.alpha:
        raise InputError("--alpha: gif has no soft transparency", "use --to png or --to webp")
    write_animation(job.folder / "video.gif", _Pictures(job).frames("gif"), fps=job.fps)
    return "video.gif"


def webp(job: Job) -> str:
    """``video.webp``."""
    write_animation(job.folder / "video.webp", _Pictures(job).frames("webp"), fps=job.fps)
    return "video.webp"


def png(job: Job) -> str:
    """``pictures/picture_0001.png``, numbered along the film."""
    from PIL import Image

    from gsfluent.io import atomic_path

    folder = job.folder / "pictures"
    names: list[str] = []
    for frame in _Pictures(job).frames("png"):
        names.append(f"picture_{len(names) + 1:04d}.png")
        with atomic_path(folder / names[-1]) as part:
            Image.fromarray(frame).save(part, compress_level=4)
    number = len(names) + 1
    while (stale := folder / f"picture_{number:04d}.png").is_file():
        stale.unlink()  # of an older, longer film
        number += 1
    return span("pictures", names)


class _Pictures:
    """The film of an export: which frame each picture shows, and from where."""

    def __init__(self, job: Job) -> None:
        self.job = job
        shot = shot_of(job.out)
        options, output = job.options, shot.output
        choice = options.camera
        frozen = choice is not None and (choice == "freeze" or choice.startswith("freeze:"))
        if choice is not None and not frozen:
            index = choice.lstrip("-").isdigit()
            output = replace(output, camera=int(choice) if index else choice)
        if options.size is not None:
            output = replace(output, size=options.size)
        self.size = output.size
        shot = replace(shot, output=output)
        self.film = Film(job.out, shot, lighting_for(shot, options), job.device)
        if options.alpha:
            self.film.render.studio = self.film.backdrop = None
            self.film.render.background = (0.0, 0.0, 0.0)
        cuts = [Cut(index, camera) for index, camera in enumerate(self.film.cameras)]
        if frozen:
            cuts = self._freeze(str(choice))
        wanted = set(job.sequence.indices)
        self.cuts = [cut for cut in cuts if cut.frame in wanted]

    def _freeze(self, choice: str) -> list[Cut]:
        """Cuts for ``freeze`` (shortly after the largest break) or ``freeze:FRAME``."""
        folder, count = self.job.sequence.folder, count_frames(self.job.sequence.folder)
        saved = [load_frame(folder, index) for index in range(count)]
        text = choice.partition(":")[2]
        if text and not text.isdigit():
            raise InputError(f"--camera {choice}", "give freeze, or freeze:12 for frame 12")
        pieces = [int(frame.facts.get("fragments", 1)) for frame in saved]
        frame = int(text) if text else poster_frame(pieces, self.job.fps)
        centers = Action.of([frame.positions for frame in saved]).center
        return freeze(self.film.cameras, centers, frame, self.job.fps, FREEZE_SECONDS)

    def frames(self, kind: str) -> Iterator[np.ndarray]:
        """The pictures as bytes, [H, W, 3], or [H, W, 4] with alpha."""
        loaded = None
        for done, cut in enumerate(self.cuts, start=1):
            if loaded is None or loaded.index != cut.frame:
                loaded = self.film.frame(cut.frame)
            made = self.film.drawn(loaded.gaussians, loaded, cut.camera)
            image = straight(made.image, made.alpha) if self.job.options.alpha else made.image
            yield to_bytes(image)
            self.job.report(done, len(self.cuts), kind)


def straight(image: Tensor, alpha: Tensor) -> Tensor:
    """An image over black [H, W, 3] with its opacity [H, W] as straight RGBA [H, W, 4]."""
    cover = alpha[..., None]
    color = image / cover.clamp(min=_ALPHA_FLOOR)
    return torch.cat([color.clamp(max=1.0), cover], dim=-1)
