"""Materials learnt from films that VTK has drawn, of 3 and of 11 cameras.

python scripts/study/fit/films.py --draw --jobs 2                 # makes films; needs VTK
python scripts/study/fit/films.py --jobs 16 --minutes 8           # fits to them; goes on

Scenes as of tracks.py. The truth moves a triangle mesh, and VTK's OpenGL draws it: neither our
rasterizer nor our splats have seen these pictures. Masks are what is not background.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time as clock
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tracks import (
    DATA,
    FPS,
    KINDS,
    NUMBERS,
    PAGE,
    PUBLISHED,
    SIDE,
    SURE,
    ellipsoid,
    entered,
    errors_of,
    fall,
    in_pool,
    read,
    scene_of,
)

from gsfluent.data import SURFACE, Camera, Gaussians, Solid
from gsfluent.pipeline import Fit
from gsfluent.targets import Masks
from gsfluent.targets.target import Followers, Motion, Setting

MATTER = ("elastic", "plasticine")
SIZE, KEPT = 384, 64
FEW = (0, 2, 5)
"""Cameras that a fit from 3 views has."""
BARS_OF_FILMS = {
    3: {"young_modulus": (0.08, 0.6), "poisson_ratio": (0.09, None), "yield_stress": (None, 0.1),
        "velocity": (0.006, 0.006)},
    11: {"young_modulus": (0.05, 0.4), "poisson_ratio": (0.04, None), "yield_stress": (None, 0.06),
         "velocity": (0.004, 0.004)},
}  # fmt: skip
"""Of the specification, elastic and plasticine."""


def cameras() -> list[Camera]:
    """Eleven about the fall: seven low, four high."""
    middle = np.array([0.0, 0.0, 0.25])
    low = [(2.0 * math.pi * k / 7, 0.2) for k in range(7)]
    high = [(2.0 * math.pi * (k + 0.5) / 4, 0.8) for k in range(4)]
    made = []
    for k, (turn, lift) in enumerate(low + high):
        way = [math.cos(lift) * math.cos(turn), math.cos(lift) * math.sin(turn), math.sin(lift)]
        eye = (middle + 1.6 * np.array(way)).tolist()
        made.append(Camera.look_at(eye, middle.tolist(), width=SIZE, height=SIZE, fov=34.0,
                                   name=f"{k:02d}"))  # fmt: skip
    return made


def drawn(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pictures of a moving mesh by VTK, uint8 [C, T, SIZE, SIZE, 3]; black is background.

    Args:
        vertices: [T, V, 3].
        faces: [F, 3].
    """
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

    mesh, places, cells = vtk.vtkPolyData(), vtk.vtkPoints(), vtk.vtkCellArray()
    rows = np.concatenate([np.full((len(faces), 1), 3), faces], axis=1).astype(np.int64)
    cells.SetCells(len(faces), numpy_to_vtkIdTypeArray(rows.ravel(), deep=True))
    mesh.SetPoints(places)
    mesh.SetPolys(cells)
    mapper, actor, scene = vtk.vtkPolyDataMapper(), vtk.vtkActor(), vtk.vtkRenderer()
    mapper.SetInputData(mesh)
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(0.9, 0.5, 0.2)
    actor.GetProperty().SetAmbient(0.4)
    scene.AddActor(actor)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(SIZE, SIZE)
    window.AddRenderer(scene)
    found = []
    for camera in cameras():
        eye = scene.GetActiveCamera()
        center = camera.center()
        eye.SetPosition(*center.tolist())
        eye.SetFocalPoint(*(center + camera.forward()).tolist())
        eye.SetViewUp(*camera.up().tolist())
        eye.SetViewAngle(math.degrees(2.0 * math.atan(0.5 * SIZE / float(camera.K[1, 1]))))
        eye.SetClippingRange(0.1, 10.0)
        film = []
        for place in vertices:
            places.SetData(numpy_to_vtk(np.ascontiguousarray(place), deep=True))
            places.Modified()
            window.Render()
            grab = vtk.vtkWindowToImageFilter()
            grab.SetInput(window)
            grab.ReadFrontBufferOff()
            grab.Update()
            flat = vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
            film.append(flat.reshape(SIZE, SIZE, -1)[::-1, :, :3].copy())  # from the bottom up
        found.append(np.stack(film))
    return np.stack(found)


def draw(kind: str, number: int, cells: int, folder: Path) -> dict[str, Any]:
    """Simulate a scene, draw it, and keep its masks."""
    import trimesh

    torch.set_num_threads(1)
    random = np.random.default_rng([number, len(kind)])
    _, velocity, true, frames = fall(KINDS[kind], number, cells, random)
    ball = trimesh.creation.icosphere(4)
    half = 0.5 * SIDE * np.random.default_rng([number, len(kind)]).uniform(0.7, 1.0, 3)
    rest = frames[0].position.double()
    skin = torch.from_numpy(ball.vertices * half) + rest.mean(dim=0)
    setting = Setting(rest, True, SIDE / cells, 0.0, None, [], torch.zeros(0, 3))
    follow = Followers("films", skin, setting)
    motion = Motion(
        torch.stack([frame.position.double() for frame in frames]),
        torch.stack([frame.deformation.double() for frame in frames]),  # type: ignore[union-attr]
        torch.zeros(0), torch.zeros(()),
    )  # fmt: skip
    places = np.stack([follow.places(motion, k)[0].numpy() for k in range(len(frames))])
    pictures = drawn(places, np.asarray(ball.faces))
    masks = (pictures.max(axis=-1) > 0).reshape(*pictures.shape[:2], KEPT, SIZE // KEPT, KEPT, -1)
    np.savez_compressed(
        folder / f"{kind}_{number}.npz", masks=(255 * masks.mean(axis=(3, 5))).astype(np.uint8),
        half=half, velocity=velocity, names=list(true), values=list(true.values()),
        strip=pictures[0, :: max(1, len(frames) // 6)],
    )  # fmt: skip
    return {"kind": kind, "scene": number, "frames": len(frames)}


def skinned(solid: Solid, half: np.ndarray) -> Solid:
    """The solid with flat splats all over the ellipsoid with these half axes, about as far apart as
    they are wide; a solid's voxels have stairs, which a camera would see."""
    import trimesh

    ball = trimesh.creation.icosphere(4)
    normal = ball.vertices / half
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    places = torch.from_numpy(ball.vertices * half).float()
    places[:, 2] += float(half[2])
    wide = 0.5 * math.sqrt(trimesh.Trimesh(ball.vertices * half, ball.faces).area / len(places))
    splats = Gaussians.from_colors(
        places, torch.tensor([wide, wide, 0.1 * wide]).repeat(len(places), 1),
        torch.full((len(places), 3), 0.5), quats=upright(torch.from_numpy(normal).float()),
        label=SURFACE,
    )  # fmt: skip
    return dataclasses.replace(solid, gaussians=splats)


def upright(normal: torch.Tensor) -> torch.Tensor:
    """Quaternions that turn the z axis to normals [N, 3]: halfway from it, and a half turn."""
    middle = normal + torch.tensor([0.0, 0.0, 1.0])
    middle[middle.norm(dim=1) < 1e-3] = torch.tensor([1.0, 0.0, 0.0])
    return torch.cat([torch.zeros(len(normal), 1), torch.nn.functional.normalize(middle, dim=1)], 1)


def record(
    kind: str, number: int, views: int, cells: int, folder: Path, device: str = "cpu"
) -> dict[str, Any]:
    """Fit to a film: errors."""
    torch.set_num_threads(1)
    here = KINDS[kind]
    with np.load(folder / f"{kind}_{number}.npz") as film:
        masks, velocity = film["masks"].astype(np.float32) / 255.0, film["velocity"]
        true = dict(zip(film["names"].tolist(), film["values"].tolist(), strict=True))
        solid = skinned(ellipsoid(film["half"]), film["half"])
    used = list(FEW) if views == len(FEW) else list(range(views))
    random = np.random.default_rng([number, len(kind), 5])
    guess = scene_of(here, solid, here.start, velocity + random.uniform(-0.2, 0.2, 3))
    every = cameras()
    begun = clock.perf_counter()
    fit = Fit([f"it.{name}" for name in (*true, "velocity")], starts=1, cells=cells, device=device)
    found = fit(guess, Masks([every[k] for k in used], masks[used], fps=FPS))
    return {
        "kind": kind, "scene": number, "views": views, "cells": cells,
        "rows": errors_of(found, true, velocity), "rms": found.report["rms"],
        "runs": [g["runs"] for g in found.report["grids"]],
        "fit_seconds": clock.perf_counter() - begun,
    }  # fmt: skip


def table(records: list[dict[str, Any]]) -> str:
    """Mean absolute errors by matter, number and views."""
    head = ["matter", "number", "views", "scenes", "mean abs. error", "bar", "GIC, 3 views",
            "ProJo4D, 3 views", "80 % bands hold", "unidentified"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "| --- " * len(head) + "|"]
    for kind in MATTER:
        for name in (*KINDS[kind].truth, "velocity"):
            for views in (3, 11):
                mine = [r for r in records if r["kind"] == kind and r["views"] == views]
                rows = [row for r in mine for row in r["rows"] if row["name"] == name]
                if not rows:
                    continue
                errors = np.abs([row["error"] for row in rows])
                held = sum(e <= SURE * row["sd"] for e, row in zip(errors, rows, strict=True))
                bar = BARS_OF_FILMS[views].get(name, (None, None))[MATTER.index(kind)]
                theirs = PUBLISHED.get((kind, name), ("-", "-"))
                lines.append(
                    f"| {kind} | {NUMBERS[name]} | {views} | {len(mine)} | {errors.mean():.2g} | "
                    f"{bar or '-'} | {theirs[0]} | {theirs[1]} | {held} of {len(rows)} | "
                    f"{sum(row['unidentified'] for row in rows)} |"
                )
    seconds = [r["fit_seconds"] for r in records]
    lines += ["", f"A fit takes {np.median(seconds):.0f} s (longest "
              f"{max(seconds):.0f} s)."]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    """Draw, or fit what is left and enter the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draw", action="store_true", help="make the films that are not there")
    parser.add_argument("--films", type=Path, default=Path("build/fit_films"))
    parser.add_argument("--scenes", type=int, default=10, help="of each matter")
    parser.add_argument("--views", type=int, nargs="*", default=[3, 11], choices=[3, 11])
    parser.add_argument("--cells", type=int, default=8, help="along the thing, coarser grid")
    parser.add_argument("--only", nargs="*", default=list(MATTER), choices=list(MATTER))
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--minutes", type=float, default=1e6, help="what is not done by then is left"
    )
    parser.add_argument("--out", type=Path, default=DATA / "fit_films.jsonl")
    parser.add_argument("--markdown", type=Path, default=PAGE)
    options = parser.parse_args()
    folder: Path = options.films
    scenes = [(k, n) for n in range(options.scenes) for k in options.only]
    if options.draw:
        folder.mkdir(parents=True, exist_ok=True)
        left = [(*s, options.cells, folder) for s in scenes
                if not (folder / f"{s[0]}_{s[1]}.npz").is_file()]  # fmt: skip
        in_pool(draw, left, folder / "drawn.jsonl", options.jobs, options.minutes)
        return
    records = read(options.out)
    done = {(r["kind"], r["scene"], r["views"]) for r in records}
    tasks = [(k, n, v, options.cells, folder, options.device)
             for k, n in scenes for v in options.views
             if (k, n, v) not in done and (folder / f"{k}_{n}.npz").is_file()]  # fmt: skip
    records += in_pool(record, tasks, options.out, options.jobs, options.minutes)
    if records:
        entered(options.markdown, "films", table(records), "## Films that VTK has drawn")


if __name__ == "__main__":
    main()
