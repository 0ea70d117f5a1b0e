"""A simulation as one compact file of key frames and differences (``.gsd``)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from gsfluent import geometry
from gsfluent.export.frames import Moment
from gsfluent.export.job import Job
from gsfluent.io.splats.delta import DeltaFrame
from gsfluent.io.splats.delta_write import Roster, steps, write_delta

_SHARE, _FINE = 0.03, 0.1
"""Largest error of a centre, as a share of a fine splat's middle standard deviation: nine tenths of
the splats are larger. Not of the smallest one, as thin discs have none to speak of."""


def delta(job: Job) -> str:
    """``splats.gsd``: every splat once, then only what changes; SH degree 0."""
    sequence, roster = job.sequence, Roster()
    error = float("inf")
    for place, moment in enumerate(sequence):
        frame = delta_frame(moment, place)
        roster.meet(frame)
        # splats that close cracks are finer than those they are born between
        middle = np.sort(frame.scales, axis=1)[:, 1]
        error = min(error, _SHARE * float(np.quantile(middle, _FINE)))
        job.report(place + 1, len(sequence), "delta: which splats there are")
    write_delta(
        job.folder / "splats.gsd",
        _told(job),
        roster,
        times=sequence.times(),
        fps=job.fps,
        step=steps(error),
        key_every=job.options.key_every,
        up=sequence.up,
    )
    return "splats.gsd"


def _told(job: Job) -> Iterator[DeltaFrame]:
    for place, moment in enumerate(job.sequence):
        yield delta_frame(moment, place)
        job.report(place + 1, len(job.sequence), "delta")


def delta_frame(moment: Moment, place: int) -> DeltaFrame:
    """A frame as numpy arrays, quaternions normalised."""
    host = moment.gaussians.to("cpu", torch.float32)
    return DeltaFrame(
        place,
        moment.saved.time,
        moment.saved.ids.cpu().numpy().astype(np.int64),
        moment.fragment.cpu().numpy().astype(np.int32),
        host.means.numpy(),
        geometry.normalize_quaternions(host.quats).numpy(),
        host.scales.numpy(),
        host.opacities.numpy(),
        host.sh[:, 0].numpy(),
    )
