"""The partition of a run on disk: how its solids were split, and by which points."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import Frame
from gsfluent.errors import RunError
from gsfluent.io import atomic_path
from gsfluent.io.checked.arrays import read_npz

FILE = "partition.npz"
"""Its name in the folder of the simulation."""
_ARRAYS = ("rest", "body", "carries", "crumbs")


@dataclass(frozen=True)
class SavedBody:
    """One body that has a partition."""

    number: int  # In the scene; also the number of its first region
    name: str  # That of its object
    frame: Frame  # From the coordinates of its solid to where it is at time 0
    spacing: float  # Distance between its points [m]
    amplitude: float  # Rms height of its crack faces [spacings]


@dataclass(frozen=True, eq=False)
class SavedSplit:
    """One region that was divided."""

    region: int  # Its number
    frame: int  # First frame in which it is divided, from 0
    rows: Tensor  # Its points that are of a piece, int64 [S]
    rank: Tensor  # Which one, int64 [S]
    dust: int = -1  # The rank that is dust, which is no piece; -1 for none


@dataclass(frozen=True, eq=False)
class SavedPartition:
    """All splits of a run, in their order."""

    rest: Tensor  # Material points at time 0 [m], [P, 3]
    body: Tensor  # Body of each, int64 [P]
    carries: Tensor  # Which may carry a piece, bool [P]
    crumbs: Tensor  # Those that hang on next to nothing and follow others, int64 [C]
    regions: int  # Numbers of regions begin here, but for the first one of each body
    bodies: tuple[SavedBody, ...]
    splits: tuple[SavedSplit, ...]


def save_partition(folder: Path, saved: SavedPartition) -> Path:
    """Write a partition atomically.

    Raises:
        RunError: The disk is full.
    """
    bodies = [vars(body) | {"frame": body.frame.to_dict()} for body in saved.bodies]
    splits = [[split.region, split.frame, split.dust] for split in saved.splits]
    head = {"regions": saved.regions, "bodies": bodies, "splits": splits}
    arrays = {name: getattr(saved, name).cpu().numpy() for name in _ARRAYS}
    for number, split in enumerate(saved.splits):
        arrays[f"rows_{number}"] = split.rows.cpu().numpy().astype(np.int64)
        arrays[f"rank_{number}"] = split.rank.cpu().numpy().astype(np.int32)
    path = folder / FILE
    with atomic_path(path) as part, part.open("wb") as stream:
        np.savez(stream, head=np.array(json.dumps(head)), **arrays)
    return path


def load_partition(folder: Path) -> SavedPartition | None:
    """Read the partition of a run; None where it has none.

    Raises:
        RunError: It is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        found = read_npz(path)
        head: dict[str, Any] = json.loads(str(found.pop("head")))
        arrays = {name: torch.from_numpy(array) for name, array in found.items()}
        return SavedPartition(
            **{name: arrays[name] for name in _ARRAYS},
            regions=head["regions"],
            bodies=tuple(
                SavedBody(**body | {"frame": Frame.from_dict(body["frame"])})
                for body in head["bodies"]
            ),
            splits=tuple(
                SavedSplit(region, frame, arrays[f"rows_{n}"], arrays[f"rank_{n}"].long(), *dust)
                for n, (region, frame, *dust) in enumerate(head["splits"])
            ),
        )
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        hint = "run the shot again with --force"
        raise RunError(f"{path}: no readable partition ({error})", "the frames", hint) from error
