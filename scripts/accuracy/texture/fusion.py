"""Solvers for the colours of Gaussians from slices: vote, conjugate gradients, Adam.

The interior of a known watermelon is shown by Gaussians at twice the voxel spacing. Slices across
all three axes are the targets; what counts are slices in between and at random angles, which no
solver has seen. Times are process CPU seconds. With --write the tables go
into docs/measured/inpainting.md.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsfluent.figure.markdown import enter
from gsfluent.lab.truth.interiors import known_interior
from gsfluent.lab.truth.interiors_judge import held_out_planes
from gsfluent.pipeline.texture.polish import (
    SlabRenderer,
    SlicePlane,
    fuse_colors,
    stack_planes,
)
from gsfluent.pipeline.texture.volume.domain import InteriorTexture

PAGE = Path(__file__).resolve().parents[3] / "docs" / "measured" / "inpainting.md"
SPACING = 2.0


class Scene:
    """A known interior, its Gaussians, and pictures of planes through it."""

    def __init__(self, name: str, size: int) -> None:
        self.known = known_interior(name, size, seed=0)
        domain = self.known.domain
        self.matter = domain.inside & ~domain.shell
        self.texture = InteriorTexture(self.known.rgb, self.known.labels)
        rng = np.random.default_rng(0)
        count = int(size / SPACING)
        grid = np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)
        means = SPACING * (grid + 0.5 + 0.15 * rng.uniform(-1, 1, grid.shape))
        voxel = np.floor(means).astype(int).clip(0, size - 1)
        means = means[domain.inside[tuple(voxel.T)]]
        self.means = torch.from_numpy(means).float()
        self.centers = torch.from_numpy(self.texture.sample(means, domain.inside)).float()

    def stack(self, step: int, start: int = 0) -> list[SlicePlane]:
        """Planes across all axes, one in ``step`` voxels."""
        shape, made = self.matter.shape, []
        for axis in range(3):
            made += stack_planes(axis, range(start, shape[axis], step), shape, torch.zeros(3), 1.0)
        return made

    def pictures(self, planes: Sequence[SlicePlane]) -> tuple[list[Tensor], list[Tensor]]:
        """What the volume shows on planes, and where it is matter below the skin."""
        images, masks = [], []
        for plane in planes:
            h, w = plane.shape
            row = (torch.arange(h) + 0.5 - h / 2)[:, None, None] * plane.pitch
            column = (torch.arange(w) + 0.5 - w / 2)[None, :, None] * plane.pitch
            point = (plane.center + row * plane.down + column * plane.right).reshape(-1, 3).numpy()
            voxel = np.floor(point).astype(int)
            within = ((voxel >= 0) & (voxel < self.matter.shape)).all(1)
            mask = np.zeros(len(point), bool)
            mask[within] = self.matter[tuple(voxel[within].T)]
            image = np.zeros((len(point), 3), np.float32)
            image[mask] = self.texture.sample(point[mask].astype(float), self.known.domain.inside)
            images.append(torch.from_numpy(image).reshape(h, w, 3))
            masks.append(torch.from_numpy(mask).reshape(h, w))
        return images, masks

    def held_out(self) -> list[SlicePlane]:
        """Slices halfway between the targets, and six oblique planes."""
        size = self.matter.shape[0]
        planes = []
        for axis in range(3):
            where = [int(size * f) // 8 * 8 + 5 for f in (0.3, 0.45, 0.6)]
            planes += stack_planes(axis, where, self.matter.shape, torch.zeros(3), 1.0)
        for center, u, v in held_out_planes(self.known)[6:]:
            c, r, d = (torch.from_numpy(np.asarray(x, np.float32)) for x in (center, u, -v))
            planes.append(SlicePlane(c, r, d, (size, size), 1.0))
        return planes


def psnr(scene: Scene, colors: Tensor, planes: list[SlicePlane], slab: float | None) -> float:
    """Decibels of planes shown by the Gaussians against the volume."""
    renderer = SlabRenderer(scene.means, planes, SPACING, slab)
    images, masks = scene.pictures(planes)
    error = count = 0.0
    for k, shown in enumerate(renderer.render(colors)):
        chosen = masks[k].flatten() & renderer.counted[k]
        error += float(((shown - images[k].reshape(-1, 3))[chosen] ** 2).sum())
        count += 3.0 * float(chosen.sum())
    return -10.0 * math.log10(error / count)


def adam(
    renderer: SlabRenderer, aim: list[Tensor], valid: list[Tensor], start: Tensor, n: int
) -> Tensor:
    """The usual way: gradient descent on the same squared error."""
    colors = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([colors], lr=0.02)
    for _ in range(n):
        shown = renderer.render(colors.detach())
        rest = [(s * v - a) for s, a, v in zip(shown, aim, valid, strict=True)]
        colors.grad = renderer.adjoint(rest)
        optimizer.step()
    return colors.detach().clamp(0, 1)


def solvers(scene: Scene, adam_steps: Sequence[int]) -> str:
    """Table of solvers."""
    planes = scene.stack(2)
    images, masks = scene.pictures(planes)
    test = scene.held_out()
    rows = []

    def row(name: str, make: Callable[[], Tensor], timed: bool = True) -> None:
        began = time.process_time()
        colors = make()
        seconds = time.process_time() - began
        off = float(((colors - scene.centers) ** 2).mean().sqrt())
        cost = f"{seconds:.2f}" if timed else "-"
        rows.append(f"| {name} | {cost} | {psnr(scene, colors, test, None):.2f} | {off:.3f} |")
        print(rows[-1], flush=True)

    def solve(count: int) -> Tensor:
        return fuse_colors(
            scene.means, planes, images, spacing=SPACING, masks=masks,
            initial=scene.centers, iterations=count,
        )[0]  # fmt: skip

    row("colour of the volume at the centre", lambda: scene.centers, timed=False)
    row("vote", lambda: solve(0))
    for count in (1, 2, 3, 4, 5, 10, 20):
        row(f"vote + {count} conjugate-gradient steps", lambda count=count: solve(count))
    renderer = SlabRenderer(scene.means, planes, SPACING)
    valid = [
        (c & m.flatten()).float()[:, None] for c, m in zip(renderer.counted, masks, strict=True)
    ]
    aim = [i.reshape(-1, 3) * v for i, v in zip(images, valid, strict=True)]
    grey = torch.full_like(scene.centers, 0.5)
    for count in adam_steps:
        row(f"Adam, {count} steps from grey", lambda n=count: adam(renderer, aim, valid, grey, n))
    head = (
        f"{len(scene.means)} Gaussians, {len(planes)} slices of {scene.matter.shape[0]}^2 pixels."
        "\n\n"
        "| solver | CPU s | held-out slices, dB | rms from the colour at the centre |\n"
        "| --- | --- | --- | --- |\n"
    )
    return head + "\n".join(rows)


def spacings(scene: Scene) -> str:
    """Table over the distance of the slices."""
    test, rows = scene.held_out(), []
    for step in (8, 4, 2, 1):
        planes = scene.stack(step, start=min(step // 2, 2))
        images, masks = scene.pictures(planes)
        figures = []
        for count in (0, 4):
            colors, _ = fuse_colors(
                scene.means, planes, images, spacing=SPACING, masks=masks,
                initial=torch.full_like(scene.centers, 0.5), iterations=count, slab=0.5 * step,
            )  # fmt: skip
            figures.append(f"{psnr(scene, colors, test, None):.2f}")
        rows.append(f"| {step / SPACING:g} | {len(planes)} | {' | '.join(figures)} |")
        print(rows[-1], flush=True)
    head = (
        "| distance of slices / spacing of Gaussians | slices | vote, dB | vote + 4 steps, dB |\n"
        "| --- | --- | --- | --- |\n"
    )
    return head + "\n".join(rows)


def main() -> None:
    """Measure; print; write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--name", default="watermelon", help="known interior")
    parser.add_argument("--size", type=int, default=128, help="voxels along an edge")
    parser.add_argument("--adam", type=int, nargs="*", default=[50, 200], help="Adam steps")
    parser.add_argument("--write", action="store_true", help="enter the tables in the docs")
    given = parser.parse_args()
    scene = Scene(given.name, given.size)
    first = solvers(scene, given.adam)
    second = spacings(scene)
    if given.write:
        text = enter(PAGE.read_text(encoding="utf-8"), "solvers", first)
        PAGE.write_text(enter(text, "slice-spacing", second), encoding="utf-8")


if __name__ == "__main__":
    main()
