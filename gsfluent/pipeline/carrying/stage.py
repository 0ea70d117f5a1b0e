"""The stage that lets the points or the mesh of any program carry splats."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent import geometry, ops
from gsfluent.data import Gaussians
from gsfluent.errors import InputError
from gsfluent.io.sequences import Sequence
from gsfluent.pipeline.carrying.binding import Binding, bind
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress

STRETCH = (0.05, 20.0)
"""Bounds of the stretch that splats show."""
RIGID = 1e-9
"""Splats that are stretched by less keep their shape exactly."""
FAR = 3.0
"""Distance from its carriers [their spacings] from which a splat hangs on them by guess."""


@dataclasses.dataclass(frozen=True, eq=False)
class CarriedFrame:
    """One moment.

    Attributes:
        index: Number, from 0.
        time: [s].
        gaussians: The splats, as many as there were; those that are gone have opacity 0.
        carriers: Where the carriers are, float64 [N, 3]; NaN for those that are not there.
        anchor: Heaviest carrier of each splat, int64 [M].
        gone: Splats whose carriers are not there, bool [M].
        torn: Splats whose carriers have parted, bool [M]: between them there may be a hole.
    """

    index: int
    time: float
    gaussians: Gaussians
    carriers: Tensor
    anchor: Tensor
    gone: Tensor
    torn: Tensor


class Carry(Stage):
    """Lets moving points or a moving mesh carry splats (PhysGaussian, section 3.3; GASP).

    Centres follow, covariances become ``A S A^T``, spherical harmonics and normals turn with the
    rotation of A; see :mod:`gsfluent.pipeline.carrying.binding` for A.

    Args:
        rest: Frame of the sequence in which the carriers are where the splats lie.
        stretch: Least and largest stretch that splats show.
        device: Where to compute; where the splats are when absent.

    Raises:
        InputError: Bounds that are none.
    """

    name = "carry"

    def __init__(
        self,
        *,
        rest: int = 0,
        stretch: tuple[float, float] = STRETCH,
        device: torch.device | str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        if not 0.0 < stretch[0] <= 1.0 <= stretch[1] < 1e6:
            raise InputError(
                f"carry: stretch is {stretch}", "give a least below 1 and a largest above 1"
            )
        self.rest, self.stretch, self.device = int(rest), stretch, device
        self.report: dict[str, Any] = {}

    def forward(
        self, gaussians: Gaussians, sequence: Sequence, *, progress: Progress | None = None
    ) -> Iterator[CarriedFrame]:
        """Carry splats through all frames of a sequence.

        Args:
            gaussians: Where they lie at frame ``rest``, in the coordinates of the sequence.
            sequence: What moves.
            progress: Told after each frame.

        Returns:
            An iterator over the frames. ``report`` of the stage has ``far`` (splats further than
            three spacings from what carries them), and, frame by frame, ``torn`` and ``gone``.

        Raises:
            InputError: No such rest frame, no splats, or none of them near the carriers.
        """
        if not -len(sequence) <= self.rest < len(sequence):
            raise InputError(
                f"carry: rest is {self.rest}", f"the sequence has frames 0 to {len(sequence) - 1}"
            )
        if gaussians.count == 0:
            raise InputError("carry: there are no splats", "give a model that has some")
        device = torch.device(self.device) if self.device else gaussians.device
        splats = gaussians.to(device)
        rest = torch.from_numpy(sequence.positions[self.rest]).to(device)
        here = torch.isfinite(rest).all(dim=1)
        faces = None if sequence.faces is None else torch.from_numpy(sequence.faces).to(device)
        rows = here.nonzero()[:, 0]
        if faces is not None:
            faces = faces[here[faces].all(dim=1)]
            number = torch.cumsum(here.long(), 0) - 1
            faces = number[faces] if faces.shape[0] else None
        binding = bind(splats.means, rest[rows], faces)
        far = binding.reach > FAR
        if bool(far.all()):
            low, high = (v.tolist() for v in torch.aminmax(splats.means.double(), dim=0))
            a, b = (v.tolist() for v in torch.aminmax(rest[rows], dim=0))
            raise InputError(
                f"carry: no splat is near what should carry it: splats from {_short(low)} to "
                f"{_short(high)}, carriers from {_short(a)} to {_short(b)}",
                "give --scale and --up so that both agree at frame --rest",
            )
        self.report = {
            "splats": splats.count,
            "carriers": int(rows.numel()),
            "mesh": faces is not None,
            "frames": len(sequence),
            "spacing": binding.spacing,
            "far": int(far.sum()),
            "per_frame": {"time": [], "torn": [], "gone": []},
        }
        return self._frames(splats, sequence, binding, rows, progress)

    def _frames(
        self,
        splats: Gaussians,
        sequence: Sequence,
        binding: Binding,
        rows: Tensor,
        progress: Progress | None,
    ) -> Iterator[CarriedFrame]:
        anchor = rows[binding.index.gather(1, binding.weight.argmax(1, keepdim=True))[:, 0]]
        facts = self.report["per_frame"]
        for index in range(len(sequence)):
            now = torch.from_numpy(np.ascontiguousarray(sequence.positions[index])).to(rows.device)
            moved = binding.move(now[rows])
            frame = CarriedFrame(
                index=index,
                time=float(sequence.times[index]),
                gaussians=carried(splats, moved.means, moved.map, moved.gone, self.stretch),
                carriers=now,
                anchor=anchor,
                gone=moved.gone,
                torn=moved.torn,
            )
            facts["time"].append(frame.time)
            facts["torn"].append(float(moved.torn.double().mean()))
            facts["gone"].append(float(moved.gone.double().mean()))
            report_progress(progress, index + 1, len(sequence), f"t = {frame.time:.3f} s")
            yield frame


def carried(
    splats: Gaussians,
    means: Tensor,
    map: Tensor,
    gone: Tensor,
    stretch: tuple[float, float] = STRETCH,
) -> Gaussians:
    """Splats at new centres, stretched and turned by maps [M, 3, 3]; ``gone`` ones unseen."""
    rotation, clamped = ops.polar_clamped(map, *stretch)
    quats, scales = ops.carry_axes(
        splats.quats.double(), splats.scales.double(), clamped, rotation, rigid=RIGID
    )
    like, turn = splats.means, rotation.to(splats.sh)
    normals = splats.normals
    if normals is not None:
        normals = (rotation.to(normals) @ normals[..., None])[..., 0]
    return splats.replace(
        means=means.to(like),
        quats=quats.to(like),
        scales=scales.to(like),
        sh=geometry.rotate_sh(splats.sh, turn),
        opacities=splats.opacities.masked_fill(gone, 0.0),
        normals=normals,
    )


def _short(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in values) + ")"
