"""The frames of a ``.gsd`` file as an export wants them."""

from __future__ import annotations

from pathlib import Path

import torch

from gsfluent.data import Gaussians
from gsfluent.io.delta import DeltaReader
from gsfluent.pipeline.export_frames import NOBODY, Reel
from gsfluent.pipeline.run_frames import SavedFrame


class DeltaReel(Reel):
    """The chosen frames of a ``.gsd`` file; there are no material points, only their fragments.

    Args: as :class:`Reel`, with the file for ``out``.

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
