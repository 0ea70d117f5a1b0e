"""What all stages share: an ``nn.Module`` with a name, a seed and an optional progress callback."""

from __future__ import annotations

from torch import nn


class Stage(nn.Module):
    """Base class of the pipeline's stages.

    A stage is constructed complete (all settings in ``__init__``), holds no scene data, and is
    called with containers.

    Args:
        seed: Seed of everything random inside the stage.
    """

    name: str = "stage"

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__()
        self.seed = int(seed)
