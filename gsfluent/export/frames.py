"""The frames of a run as an export wants them: chosen, relit, turned, with what each splat is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from gsfluent.data import Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.io.splats.delta import DeltaReader
from gsfluent.results.frames import SavedFrame, count_frames, frame_rate, frame_time, load_frame

Relight = Callable[[SavedFrame], Gaussians]
"""Gives the splats of a frame colours that carry the light."""

NOBODY = -1
"""Fragment and material of a splat that follows no material point."""

# what is up in the file; the scene has +z up, right-handed
_TURNS = {
    "z": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "y": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "-y": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
UPS = tuple(_TURNS)


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame for export."""

    # The frame; its splats are turned, relit and cut to the wanted SH degree, and its points and
    # velocities are turned.
    saved: SavedFrame
    # Fragment of each splat (that of the point it follows), int32 [N], -1 for none.
    fragment: Tensor
    material: Tensor  # Row of each splat in the scene's table of materials, int32 [N], -1 for none

    @property
    def gaussians(self) -> Gaussians:
        """The splats."""
        return self.saved.gaussians

    @property
    def number(self) -> int:
        """Number in file names, from 1."""
        return self.saved.index + 1


def upright(up: str) -> Frame:
    """The turn from the scene (+z up) to a file with another axis up.

    Args:
        up: ``z``, ``y`` (glTF, Houdini, Unity) or ``-y`` (what splat viewers expect of a .ply).

    Raises:
        InputError: None of these.
    """
    if up not in _TURNS:
        raise InputError(f"--up {up}", f"choose from {', '.join(UPS)}")
    return Frame(torch.tensor(_TURNS[up], dtype=torch.float64), torch.zeros(3).double(), 1.0)


class FrameSequence:
    """The chosen frames of a finished (or running) simulation.

    Args:
        out: Folder of the run.
        frames: Which ones, as in Python: ``12``, ``10:40``, ``::2``; all by default.
        sh: Highest SH degree to keep.
        relight: Bakes light into the colours; none leaves them as captured.
        up: See :func:`upright`.
        device: Where the work is done.

    Raises:
        InputError: No simulated frames, or none of them chosen.
    """

    def __init__(
        self,
        out: Path,
        *,
        frames: str | None = None,
        sh: int = 0,
        relight: Relight | None = None,
        up: str = "z",
        device: torch.device | None = None,
    ) -> None:
        self.out = out
        self.total = self._open(out)
        if not 0 <= sh <= 3:
            raise InputError(f"--sh {sh}", "give a degree from 0 to 3")
        self.indices = _chosen(frames, self.total)
        self.sh, self.relight, self.turn = sh, relight, upright(up)
        self.up, self.device = up, device or torch.device("cpu")

    def _open(self, out: Path) -> int:
        """Find the frames and return their number."""
        self.folder = out / "stages" / "simulate"
        count = count_frames(self.folder)
        if count == 0:
            raise InputError(f"{out}: no simulated frames", "run the shot first: gsfluent run")
        return count

    def _load(self, index: int) -> SavedFrame:
        return load_frame(self.folder, index)

    def times(self) -> list[float]:
        """Simulated times of the chosen frames [s]."""
        return [frame_time(self.folder, index) for index in self.indices]

    def rate(self) -> float:
        """Frames per second of simulated time, counting those that were not chosen."""
        return frame_rate(self.folder)

    def source(self) -> Path:
        """File that changes when the frames do."""
        return self.folder / "stage.json"

    def __len__(self) -> int:
        """Number of chosen frames."""
        return len(self.indices)

    def __iter__(self) -> Iterator[Moment]:
        """The chosen frames, one at a time."""
        for place in range(len(self)):
            yield self.moment(place)

    def turned(self, up: str) -> FrameSequence:
        """The same frames with another axis up (formats that fix it)."""
        other = object.__new__(FrameSequence)
        other.__dict__.update(self.__dict__, up=up, turn=upright(up))
        return other

    def moment(self, place: int) -> Moment:
        """Frame number ``place`` of the chosen ones."""
        saved = self._load(self.indices[place]).to(self.device)
        gaussians = saved.gaussians if self.relight is None else self.relight(saved)
        gaussians = gaussians.with_sh_degree(min(self.sh, gaussians.sh_degree))
        saved = replace(
            saved,
            gaussians=gaussians.transformed(self.turn) if self.up != "z" else gaussians,
            positions=self.turn.apply(saved.positions),
            velocity=self.turn.apply_vector(saved.velocity),
        )
        return Moment(saved, _of_points(saved, "fragments"), _of_points(saved, "material"))


def _of_points(saved: SavedFrame, name: str) -> Tensor:
    """A property of the material points, per splat."""
    values: Tensor = getattr(saved, name).to(torch.int32)
    anchor = saved.anchor.long()
    if values.numel() == 0:
        return torch.full_like(anchor, NOBODY, dtype=torch.int32)
    picked = values[anchor.clamp(min=0)]
    return torch.where(anchor >= 0, picked, torch.full_like(picked, NOBODY))


def _chosen(text: str | None, count: int) -> list[int]:
    """Frame numbers from ``a``, ``a:b`` or ``a:b:c``.

    Raises:
        InputError: Not such a text, or no frame.
    """
    hint = f"give a frame or a range such as 12, 10:40 or ::2; the run has frames 0 to {count - 1}"
    if text is None:
        return list(range(count))
    parts = text.strip().split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
        if len(numbers) == 1 and numbers[0] is not None:
            chosen = [range(count)[numbers[0]]]
        elif len(numbers) in (2, 3):
            chosen = list(range(count)[slice(*numbers)])
        else:
            raise ValueError
    except (ValueError, IndexError):
        raise InputError(f"--frames {text}", hint) from None
    if not chosen:
        raise InputError(f"--frames {text}: no frame", hint)
    return chosen


class DeltaSequence(FrameSequence):
    """The chosen frames of a ``.gsd`` file; there are no material points, only their fragments.

    Args: as :class:`FrameSequence`, with the file for ``out``.

    Raises:
        InputError: Not such a file, or damaged.
    """

    def _open(self, out: Path) -> int:
        self.reader = DeltaReader(out)
        self.folder = out.parent
        return len(self.reader)

    def times(self) -> list[float]:
        """Simulated times of the chosen frames [s]."""
        return [self.reader.header["times"][index] for index in self.indices]

    def rate(self) -> float:
        """Frames per second."""
        return float(self.reader.header["fps"])

    def source(self) -> Path:
        """The file itself."""
        return self.reader.path

    def _load(self, index: int) -> SavedFrame:
        """A frame whose points stand for its fragments, so that splats find theirs."""
        frame = self.reader.frame(index)
        count = len(frame.ids)
        pieces, anchor = torch.unique(torch.from_numpy(frame.fragment), return_inverse=True)
        nothing = torch.zeros(len(pieces), 3)
        whole = torch.zeros(len(pieces), dtype=torch.int32)
        gaussians = Gaussians(
            torch.from_numpy(frame.means),
            torch.from_numpy(frame.quats),
            torch.from_numpy(frame.scales),
            torch.from_numpy(frame.opacities),
            torch.from_numpy(frame.f_dc)[:, None],
        )
        return SavedFrame(
            index=index,
            time=frame.time,
            gaussians=gaussians,
            groups=torch.full((count,), NOBODY, dtype=torch.int32),
            carried=count,
            ids=torch.from_numpy(frame.ids),
            anchor=anchor.to(torch.int32),
            positions=nothing,
            volumes=nothing[:, 0],
            damage=nothing[:, 0],
            fragments=pieces.to(torch.int32),
            velocity=nothing,
            body=whole,
            material=torch.full_like(whole, NOBODY),
            facts={},
        )
