"""The filled solid as a frame, for a run that has not simulated anything yet."""

from __future__ import annotations

import zipfile
from pathlib import Path

import torch

from gsfluent.data import Frame, Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.io.solid import load_solid
from gsfluent.results.frames import SavedFrame
from gsfluent.results.record import read_frame

_MOST_POINTS = 100_000


def still_frame(isolate: Path, solids: list[Path]) -> SavedFrame:
    """Frame 0 of a run that has only its solids, at rest where they were photographed.

    Args:
        isolate: Folder of the isolate stage (world to scene).
        solids: The solids' ``.ply`` files; each is a body, its voxels are the material points.

    Raises:
        RunError: A file is damaged or just being replaced.
    """
    from scipy.spatial import cKDTree

    try:
        frame = read_frame(isolate) if (isolate / "frame.json").is_file() else Frame.identity()
        loaded = [load_solid(path) for path in solids]
    except (InputError, OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise RunError(f"the solid cannot be read ({error})", "", "look again in a moment") from (
            error
        )
    splats, points, anchors, volumes, bodies, materials = [], [], [], [], [], []
    first = 0
    for body, solid in enumerate(loaded):
        index = solid.occupancy.nonzero()
        index = index[:: max(1, index.shape[0] // _MOST_POINTS)]
        share = float(solid.occupancy.sum()) / max(1, index.shape[0])
        place = frame.apply(solid.voxel_centers(index).float())
        gaussians = solid.gaussians.transformed(frame)
        _, nearest = cKDTree(place.numpy()).query(gaussians.means.numpy())
        region = torch.zeros(index.shape[0], dtype=torch.int32)
        if solid.regions is not None:
            region = solid.regions[index[:, 0], index[:, 1], index[:, 2]].to(torch.int32)
        splats.append(gaussians)
        points.append(place)
        anchors.append(torch.from_numpy(nearest).to(torch.int32) + first)
        volumes.append(torch.full((index.shape[0],), share * (frame.scale * solid.voxel) ** 3))
        bodies.append(torch.full((index.shape[0],), body, dtype=torch.int32))
        materials.append(region)
        first += index.shape[0]
    whole = Gaussians.cat(splats)
    positions = torch.cat(points)
    nothing = torch.zeros(positions.shape[0])
    return SavedFrame(
        index=0,
        time=0.0,
        gaussians=whole,
        groups=torch.full((whole.count,), -1, dtype=torch.int32),
        carried=whole.count,
        ids=torch.arange(whole.count),
        anchor=torch.cat(anchors),
        positions=positions,
        volumes=torch.cat(volumes),
        damage=nothing,
        fragments=torch.cat(bodies),
        velocity=torch.zeros_like(positions),
        body=torch.cat(bodies),
        material=torch.cat(materials),
        facts={"bodies": [[path.stem, ""] for path in solids]},
    )
