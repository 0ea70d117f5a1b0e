"""One shot as a sample: film, depth, flow, labels, and what is known of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.config import EVENTS, typed_dict
from gsfluent.dataset.channels import LOOSE, NOTHING, RIGID, Channels, Pieces, channels_of
from gsfluent.export.frames import FrameSequence
from gsfluent.io import write_json
from gsfluent.io.atomic import link_or_copy
from gsfluent.io.checked.files import read_json
from gsfluent.pipeline.light.from_shot import light_of
from gsfluent.pipeline.render.film import Film
from gsfluent.results.digests import require_intact
from gsfluent.results.record import shot_of

PARTS = ("mp4", "json", "depth.npz", "flow.npz", "labels.npz")
"""Endings of the files of a sample."""


@dataclasses.dataclass(frozen=True)
class Source:
    """A finished shot of a sweep."""

    id: str  # Its name
    folder: Path  # Where it lies
    line: dict[str, Any]  # What its sweep knows of it
    device: str  # Where to draw


def make_sample(source: Source, folder: Path) -> dict[str, Any]:
    """Write the files of a sample, ``ID.mp4`` and so on; returns its object and its bytes.

    Raises:
        InputError: The shot has no frames.
        RunError: Its files are not those that were written.
    """
    out, shot = source.folder, shot_of(source.folder)
    require_intact(out / "stages" / "simulate")
    device = torch.device(source.device)
    film = Film(out, shot, light_of(shot), device)
    sequence, pieces = FrameSequence(out, device=device), Pieces()
    drawn: list[Channels] = []
    bodies: list[list[str]] = []
    for index, camera in enumerate(film.cameras):
        moment = sequence.moment(index)
        bodies = moment.saved.facts.get("bodies", bodies)
        last = index + 1 == len(film)
        after = None if last else (film.frame(index + 1), film.cameras[index + 1])
        drawn.append(channels_of(moment, camera, after, pieces))
    for name in ("depth", "flow", "labels"):
        arrays = {name: np.stack([getattr(channels, name) for channels in drawn])}
        np.savez_compressed(folder / f"{source.id}.{name}.npz", **arrays)  # type: ignore[arg-type]
    record = read_json(out / "run.json")
    line = source.line
    labels = [
        {"label": NOTHING, "what": "nothing"},
        {"label": LOOSE, "what": "loose"},
        {"label": RIGID, "what": "rigid"},
    ]
    for number, label in pieces.label.items():
        body = pieces.body[label]
        known = bodies[body] if body < len(bodies) else ["", ""]
        labels.append(
            {
                "label": label, "what": "piece", "piece": number,
                "object": known[0], "material": known[1],
            }
        )  # fmt: skip
    write_json(
        folder / f"{source.id}.json",
        {
            "id": source.id,
            "object": line["object"],
            "seed": line["seed"],
            "changes": line["changes"],
            "verdict": line["verdict"],
            "size": list(shot.output.size),
            "times": sequence.times(),
            "film_fps": shot.output.video_fps,
            "materials": {name: item.material for name, item in shot.objects.items()},
            "events": [typed_dict(event, EVENTS) for event in shot.events],
            "cameras": [
                {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
                for camera in film.cameras
            ],
            "labels": labels,
            "figures": line["figures"],
            "per_frame": record["simulation"]["per_frame"],
        },
    )
    film_file = folder / f"{source.id}.mp4"
    film_file.unlink(missing_ok=True)  # of a try that was killed
    link_or_copy(out / "video.mp4", film_file)
    size = sum((folder / f"{source.id}.{part}").stat().st_size for part in PARTS)
    return {"object": line["object"], "bytes": size}
