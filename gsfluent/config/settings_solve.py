"""``solve:`` of a shot."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from gsfluent.config.read import choice, flag, key, number, whole


@dataclasses.dataclass(frozen=True)
class SolveSettings:
    """``solve:`` - how accurately."""

    LATER: ClassVar[dict[str, str]] = {
        "error": "choosing the setting by an error bound",
    }
    quality: str = key(
        choice("preview", "shot", "hero"),
        default="shot",
        doc="Size of the cells of the grid.",
        example="preview",
    )
    cells: int | None = key(
        whole(8, 1024),
        default=None,
        doc="Cells along the longest side of the largest solid, instead of those of `quality`.",
        example="32",
    )
    seconds_per_frame: float | None = key(
        number(above=0.0),
        default=None,
        doc="Wall time that simulating a frame may take on this machine [s], instead of `quality` "
        "and `cells`: as many cells as that allows, by the cost model of `gsfluent plan`.",
        example="0.5",
    )
    standing: bool = key(
        flag,
        default=False,
        doc="What stands still on the floor sleeps from the start, without a strain, until "
        "something comes near; else its weight begins to act at the start.",
        example="true",
    )
    loose_crumbs: bool = key(
        flag,
        default=False,
        doc="Broken matter with next to nothing around it falls freely and stays where it meets "
        "the floor: much faster where an object goes to dust.",
        example="true",
    )
    deterministic: bool = key(
        flag,
        default=False,
        doc="Insist on the same bits from the same input on the same device. The solver gives them "
        "anyway; a blade at work on a GPU does not, and is refused then.",
        example="true",
    )
