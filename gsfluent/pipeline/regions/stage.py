"""Labels of photographs and pictures become parts of a solid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from gsfluent.data import Capture, Frame, Solid
from gsfluent.pipeline.regions.project import label_regions
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress


class Regions(Stage):
    """Write labels into ``Solid.regions``.

    Args:
        sources: Where the labels are: ``{"mask": folder}``, ``{"labels": path}``,
            ``{"label_image": file}`` or ``{"label_image": {axis: file}}`` each; or parts of a
            scene, whose ``where`` says it. Those that ask for no labels are passed over.
        seed: Not needed: votes are counted, not drawn.
    """

    name = "regions"

    def __init__(self, sources: Iterable[Mapping[str, Any]], *, seed: int = 0) -> None:
        super().__init__(seed=seed)
        self.sources = [dict(source.get("where", source)) for source in sources]

    def forward(
        self,
        solid: Solid,
        capture: Capture | None = None,
        progress: Progress | None = None,
        *,
        frame: Frame | None = None,
    ) -> Solid:
        """Label a solid; see :func:`gsfluent.pipeline.label_regions`.

        Args:
            solid: The filled solid, in the world of the capture.
            capture: The photographs that masks and labels belong to.
            progress: Optional callback.
            frame: World to scene, for the axes of label images; default that of the solid.

        Returns:
            The solid; ``report`` holds ``regions`` (their table) and ``region_sources``.

        Raises:
            InputError: A source cannot be read, fits no photograph, or needs a capture.
        """
        return label_regions(solid, self.sources, capture, frame=frame, progress=progress)
