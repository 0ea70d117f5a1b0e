"""A run on disk to export: few splats, all unlike each other, some of them short-lived."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch

from gsfluent import geometry
from gsfluent.config import Shot
from gsfluent.data import TRANSITION, Camera, Gaussians
from gsfluent.draw import draw
from gsfluent.results.frames import SavedFrame, save_frame

FRAMES, CARRIED, POINTS = 4, 400, 600
FPS = 25.0
SIZE = (96, 64)
# births and deaths of transition splats: frame -> ids that live in it
LIVING = ((), (1000, 1001, 7000), (1001, 7000), (1001, 9000))


def splats(count: int, seed: int, degree: int = 1) -> Gaussians:
    """Splats in a ball of 0.3 m: no two alike, no axis like another, no rotation trivial."""
    random = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, generator=random)
    radius = 0.3 * torch.rand(count, 1, generator=random) ** (1 / 3)
    means = torch.nn.functional.normalize(normal, dim=1) * radius
    scales = torch.rand(count, 3, generator=random) * torch.tensor([0.05, 0.012, 0.003]) + 0.003
    sh = 0.15 * torch.randn(count, (degree + 1) ** 2, 3, generator=random)
    sh[:, 0] = geometry.rgb_to_sh0(torch.rand(count, 3, generator=random))
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1)
    opacities = 0.3 + 0.69 * torch.rand(count, generator=random)
    return Gaussians(means, quats, scales, opacities, sh)


def points_of_a_cube(side: float = 0.2, count: int = 12) -> tuple[torch.Tensor, float]:
    """Points on a grid that fill a cube, and the volume of each."""
    axis = (torch.arange(count) + 0.5) / count * side - side / 2
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    return grid, (side / count) ** 3


def make_run(out: Path, *, degree: int = 1, still: bool = False) -> Path:
    """Write the frames of a run: the ball turns and flies, its upper half tears off."""
    folder = out / "stages" / "simulate"
    folder.mkdir(parents=True)
    base, extra = splats(CARRIED, 1, degree), splats(4, 2, degree)
    number = {1000: 0, 1001: 1, 7000: 2, 9000: 3}
    matter, volume = points_of_a_cube()
    upper = matter[:, 2] > 0
    anchor = torch.arange(CARRIED) % matter.shape[0]
    for index in range(FRAMES):
        time = index / FPS
        ids = torch.tensor(LIVING[0 if still else index], dtype=torch.int64)
        rows = torch.tensor([number[int(i)] for i in ids], dtype=torch.int64)
        whole = Gaussians.cat([base, extra.select(rows)]) if len(rows) else base
        half = 0.0 if still else 0.2 * index
        turn = torch.tensor([math.cos(half / 2), 0.0, math.sin(half / 2), 0.0])
        rotation = geometry.quaternion_to_matrix(turn[None])[0]
        shift = torch.tensor([0.0, 0.0, 0.5 if still else 0.5 - 2.0 * time**2])
        gaussians = whole.replace(
            means=whole.means @ rotation.T + shift,
            quats=geometry.quaternion_multiply(turn.expand_as(whole.quats), whole.quats),
            sh=geometry.rotate_sh(whole.sh, rotation.double()).float(),
            labels=torch.full((whole.count,), TRANSITION, dtype=torch.int32),
        )
        apart = 0.0 if still or index < 2 else 0.1 * (index - 1)
        fragments = torch.where(upper & (apart > 0), int(upper.nonzero()[0]), 0).to(torch.int32)
        if not still and index == FRAMES - 1:
            fragments[:30] = -1
        frame = SavedFrame(
            index=index,
            time=time,
            gaussians=gaussians,
            groups=torch.full((whole.count,), -1, dtype=torch.int32),
            carried=CARRIED,
            ids=torch.cat([torch.arange(CARRIED), ids]),
            anchor=torch.cat([anchor, torch.zeros(len(ids), dtype=torch.int64)]).to(torch.int32),
            positions=matter @ rotation.T + shift + apart * upper[:, None] * rotation[:, 2],
            volumes=torch.full((matter.shape[0],), volume),
            damage=(matter[:, 2].abs() < 0.02).float(),
            fragments=fragments,
            velocity=torch.tensor([0.0, 1.0, -4.0 * time]).expand_as(matter).contiguous(),
            body=torch.zeros(matter.shape[0], dtype=torch.int32),
            material=(matter[:, 0] > 0).to(torch.int32),
            facts={"fragments": 1 if index < 2 else 2},
        )
        save_frame(folder, frame)
    return out


def add_record(out: Path) -> Path:
    """Write the run's record, which tells camera and light."""
    (out / "splats.ply").write_bytes(b"")
    values = {"splats": str(out / "splats.ply"), "output": {"fps": FPS, "size": list(SIZE)}}
    shot = Shot.from_dict(values, out)
    (out / "run.json").write_text(json.dumps({"shot": shot.resolved()}))
    return out


def picture(gaussians: Gaussians) -> torch.Tensor:
    """The splats from a fixed place, [H, W, 3]."""
    camera = Camera.look_at((1.3, -0.9, 1.0), (0.0, 0.0, 0.45), width=160, height=120, fov=22.0)
    return draw(gaussians, camera).image
