"""Inputs whose inside is known, so that nothing has to be guessed: meshes and filled solids."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsfluent.config import Shot
from gsfluent.data import SURFACE, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.io.solid import load_solid, volume_path
from gsfluent.pipeline.fill.stage import Fill
from gsfluent.progress import Progress
from gsfluent.results.store import content_digest, fingerprint
from gsfluent.spatial.mesh_file import mesh_files
from gsfluent.spatial.voxels import nearest_empty


def is_solid(path: Path | None) -> bool:
    """Whether splats are those of a filled solid, whose volume lies beside them."""
    return path is not None and volume_path(path).is_file()


def source_digest(shot: Shot) -> str:
    """Fingerprint of all files of an input without photographs: textures and volumes count, too."""
    if shot.mesh is not None:
        return fingerprint("mesh", [content_digest(file) for file in mesh_files(shot.mesh)])
    assert shot.splats is not None
    if is_solid(shot.splats):
        beside = volume_path(shot.splats)
        return fingerprint("solid", [content_digest(shot.splats), content_digest(beside)])
    return content_digest(shot.splats)


def known_solid(
    shot: Shot,
    splats: Gaussians,
    options: Mapping[str, Any],
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> Solid | None:
    """The whole input as a solid, where its inside is known; None where it has to be found.

    Args:
        shot: Names the mesh or the splats.
        splats: All splats of the input, those on a mesh's surface.
        options: Of :class:`gsfluent.pipeline.Fill`, for a mesh.
        seed: Seed of the Gaussians inside a mesh.
        progress: Of filling a mesh.

    Raises:
        InputError: The files cannot be read, or fill has settings and the solid is filled.
    """
    if shot.mesh is not None:
        return Fill(**options, seed=seed)(splats, None, progress, solid=shot.mesh)
    if not is_solid(shot.splats):
        return None
    if shot.fill.given() != type(shot.fill)().given():
        raise InputError(
            f"fill: does nothing: {shot.splats} is a filled solid",
            "remove the section, or the .volume.npz beside it to fill it anew",
        )
    assert shot.splats is not None
    solid = load_solid(shot.splats)
    inner = (
        int((solid.gaussians.labels != SURFACE).sum()) if solid.gaussians.labels is not None else 0
    )
    report = {**solid.report, "method": "filled before", "interior_gaussians": inner}
    return solid.replace(frame=None, report={**report, "volume": solid.volume})


def parted(solid: Solid, masks: Mapping[str, Tensor]) -> dict[str, Solid]:
    """A solid as several: every voxel goes with the nearest splat on the surface.

    Args:
        solid: The whole.
        masks: By name, which of its splats are an object's, bool [N]; they do not overlap.

    Raises:
        InputError: No voxel is nearest to an object's splats.
    """
    if len(masks) == 1 and bool(next(iter(masks.values())).all()):
        return dict.fromkeys(masks, solid)
    from scipy.spatial import cKDTree

    splats, device = solid.gaussians, solid.occupancy.device
    owner = torch.full((splats.count,), -1, dtype=torch.int64)
    for number, mask in enumerate(masks.values()):
        owner[mask.cpu()] = number
    assert splats.labels is not None  # a solid has labels
    skin = (splats.labels == SURFACE).cpu()
    index = solid.occupancy.nonzero()
    centers = solid.voxel_centers(index).double().cpu().numpy()
    _, near = cKDTree(splats.means.cpu()[skin].double().numpy()).query(centers)
    voxel_owner = owner[skin][torch.from_numpy(near)].to(device)
    parts = {}
    for number, (name, mask) in enumerate(masks.items()):
        own = torch.zeros_like(solid.occupancy)
        own[tuple(index[voxel_owner == number].T)] = True
        if not bool(own.any()):
            raise InputError(
                f"objects.{name}.select: no matter belongs to what is selected",
                "look at the box in `gsfluent inspect` and widen the conditions",
            )
        distance, _ = nearest_empty(_rimmed(own).cpu().numpy(), torch.device("cpu"))
        inner = torch.from_numpy(distance[1:-1, 1:-1, 1:-1]).to(solid.depth)
        parts[name] = dataclasses.replace(
            solid,
            gaussians=splats.select(mask.to(splats.device)),
            occupancy=own,
            depth=torch.where(own, (inner - 0.5) * solid.voxel, torch.zeros_like(inner)),
            report={**solid.report, "volume": int(own.sum()) * solid.voxel**3},
        )
    return parts


def extended(mask: Tensor, of: Gaussians, to: Gaussians) -> Tensor:
    """Which of more splats go with those selected: each with the nearest of them, bool [M]."""
    if to.count == of.count:
        return mask
    if bool(mask.all()):
        return torch.ones(to.count, dtype=torch.bool)
    from scipy.spatial import cKDTree

    _, near = cKDTree(of.means.cpu().numpy()).query(to.means.cpu().numpy())
    return mask.cpu()[torch.from_numpy(near)]


def _rimmed(voxels: Tensor) -> Tensor:
    """With an empty layer around."""
    return torch.nn.functional.pad(voxels, (1, 1) * 3)
