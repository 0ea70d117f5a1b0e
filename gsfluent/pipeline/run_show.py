"""From simulated frames to pictures: render and export stages, and ``gsfluent render``."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.config import Shot
from gsfluent.data import Camera
from gsfluent.errors import InputError
from gsfluent.io import load_capture, load_splats, save_image
from gsfluent.io.solid import load_solid
from gsfluent.pipeline.delight import Delit
from gsfluent.pipeline.export import write_exports
from gsfluent.pipeline.light import Light, Lighting, lighting_of
from gsfluent.pipeline.light_shot import changed, gloss_of, light_of, looks_of
from gsfluent.pipeline.render import Layers, Render
from gsfluent.pipeline.render_backdrop import (
    Backdrop,
    covered_floor,
    no_background,
    object_radius,
)
from gsfluent.pipeline.render_camera import Action, cameras_for
from gsfluent.pipeline.render_figures import FilmFigures, cameras_around
from gsfluent.pipeline.render_floor import Studio
from gsfluent.pipeline.render_normals import occupancy_cell
from gsfluent.pipeline.run_context import RunContext
from gsfluent.pipeline.run_frames import SavedFrame, count_frames, load_frame
from gsfluent.pipeline.run_prepare import read_frame
from gsfluent.pipeline.run_store import content_digest, fingerprint, publish
from gsfluent.pipeline.solid_field import SignedDistance
from gsfluent.pipeline.stage import Progress, report_progress
from gsfluent.pipeline.video import to_bytes, write_video

# The pieces need a moment to part before a picture of them tells anything.
_POSTER_DELAY = 0.08
_RESIDUE = 4.0  # voxels around a solid in which no background is believed


class Film:
    """Cameras, light and studio of one video over the frames of a simulation.

    Args:
        folder: ``OUT/stages/simulate``.
        cameras: One per frame; made by :meth:`of`.
        render: The render stage.
        shot: What the objects are made of.
        device: Where to render.
        around: Cameras that stand around the matter, for figures.
    """

    def __init__(
        self,
        folder: Path,
        cameras: list[Camera],
        render: Render,
        shot: Shot,
        device: torch.device,
        around: list[Camera] | None = None,
    ) -> None:
        self.folder, self.cameras, self.render, self.device = folder, cameras, render, device
        self.shot, self.around = shot, around or []
        lighting = lighting_of(render.light)
        share = 0.0 if lighting is None else lighting.delight
        self._delit = Delit(self.frame(0), share) if share > 0.0 else None

    @classmethod
    def of(cls, out: Path, shot: Shot, light: Light | Lighting, device: torch.device) -> Film:
        """Set up the film of a finished simulation.

        Raises:
            InputError: There is none, or the camera cannot be.
        """
        folder = out / "stages" / "simulate"
        count = count_frames(folder)
        if count == 0:
            raise InputError(f"{out}: no simulated frames", "run the shot first: gsfluent run")
        first = load_frame(folder, 0)
        positions = [first.positions]
        positions += [load_frame(folder, index).positions for index in range(1, count)]
        action = Action.of(positions)
        floor = None if shot.floor == "none" else 0.0
        studio = None
        if floor is not None:
            x, y = action.center[:, :2].mean(dim=0).tolist()
            studio = Studio(
                floor, (x, y), float(action.radius[0]), 1.3 * float(action.radius.amax())
            )
        needs_capture = shot.capture is not None and isinstance(shot.output.camera, int)
        isolated = out / "stages" / "isolate"
        frame = read_frame(isolated) if (isolated / "frame.json").is_file() else None
        cameras = cameras_for(
            str(shot.output.camera),
            action,
            shot.output.size,
            capture=load_capture(shot.capture) if needs_capture and shot.capture else None,
            frame=frame,
        )
        backdrop = None
        if shot.output.backdrop == "captured":
            backdrop = captured_backdrop(out / "stages", list(shot.objects), device)
        render = Render(
            light=light,
            studio=studio,
            backdrop=backdrop,
            normal_cell=occupancy_cell(first.gaussians),
        )
        return cls(folder, cameras, render, shot, device, cameras_around(positions))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.cameras)

    def frame(self, index: int) -> SavedFrame:
        """Frame ``index`` on the film's device."""
        return load_frame(self.folder, index).to(self.device)

    def picture(self, frame: SavedFrame) -> torch.Tensor:
        """The picture [H, W, 3] of a frame."""
        return self.layers(frame).image

    def layers(self, frame: SavedFrame) -> Layers:
        """The picture of a frame with its opacity and depth."""
        camera = self.cameras[frame.index]
        gloss = gloss_of(self.shot, frame)
        gaussians = frame.gaussians if self._delit is None else self._delit.apply(frame)
        return self.render.layers(
            gaussians, camera, groups=frame.groups, gloss=gloss, time=frame.time
        )


def captured_backdrop(stages: Path, objects: list[str], device: torch.device) -> Backdrop:
    """The background that the isolate stage left, in the scene, without what lies in the objects.

    Raises:
        InputError: It left none.
    """
    path = stages / "isolate" / "background.ply"
    if not path.is_file():
        raise no_background()
    frame = read_frame(stages / "isolate")
    around = load_splats(path)
    for name in objects:
        solid = SignedDistance.of_solid(load_solid(stages / "fill" / f"{name}.ply"))
        around = around.select(solid.at(around.means) > _RESIDUE * solid.voxel)
    whole = load_splats(stages / "isolate" / "object.ply").transformed(frame).means
    around = covered_floor(around.transformed(frame), whole, 0.0)
    return Backdrop(around.to(device), object_radius(whole))


def render_stage(context: RunContext) -> None:
    """``video.mp4`` and ``poster.png``, and how many holes the repair closed."""
    shot = context.shot
    light = light_of(shot)
    output = [list(shot.output.size), str(shot.output.camera), shot.output.fps]
    output += [shot.output.slow, shot.output.backdrop]
    path = shot.output.camera
    camera_key = content_digest(path) if isinstance(path, Path) else None
    looks = [repr(light), repr(looks_of(shot))]
    key = fingerprint("render", context.key(context.source_key, looks, output, camera_key))

    def work(folder: Path) -> dict[str, Any]:
        film = Film.of(context.out, shot, light, context.device)
        report: dict[str, Any] = {"frames": len(film)}
        figures = FilmFigures(film.frame(0), film.around)
        counts: list[int] = []
        drawing = 0.0
        progress = context.reporter.task("render")

        def pictures() -> Iterator[np.ndarray]:
            nonlocal drawing
            for index in range(len(film)):
                frame = film.frame(index)
                start = time.perf_counter()
                layers = film.layers(frame)
                picture = to_bytes(layers.image)
                drawing += time.perf_counter() - start
                figures.add(frame, film.cameras[index], layers.alpha, layers.depth)
                counts.append(int(frame.facts.get("fragments", 1)))
                report_progress(progress, index + 1, len(film), "")
                yield picture

        write_video(
            folder / "video.mp4", pictures(), fps=shot.output.video_fps, size=shot.output.size
        )
        report |= figures.report()
        report["seconds_per_frame"] = drawing / len(film)
        report["poster_frame"] = poster_frame(counts, shot.output.fps)
        best = film.frame(report["poster_frame"])
        save_image(film.picture(best).cpu(), folder / "poster.png")
        return report

    result = context.store.run("render", key, work)
    for name in ("video.mp4", "poster.png"):
        publish(result.folder / name, context.out / name)
        context.record.values["outputs"][name.split(".")[0]] = name
    context.record.values["render"] = dict(result.report)


def poster_frame(fragments: list[int], fps: float) -> int:
    """The most telling frame: shortly after the largest jump in the number of fragments.

    Without any break it is the middle of the video.
    """
    jumps = [b - a for a, b in itertools.pairwise(fragments)]
    if not jumps or max(jumps) <= 0:
        return len(fragments) // 2
    return min(len(fragments) - 1, jumps.index(max(jumps)) + 1 + round(_POSTER_DELAY * fps))


def export_stage(context: RunContext) -> None:
    """What ``output.what`` asks for beside the video."""
    wanted = [kind for kind in context.shot.output.what if kind != "mp4"]
    if not wanted:
        return
    key = fingerprint("export", context.key(context.source_key, wanted))

    def work(folder: Path) -> dict[str, Any]:
        return write_exports(context.out, wanted, progress=context.reporter.task("export"))

    result = context.store.run("export", key, work)
    context.record.values["outputs"] |= result.report


def render_again(
    out: Path,
    *,
    device: torch.device,
    to: Path | None = None,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    frame: int | None = None,
    progress: Progress | None = None,
    **light: Any,
) -> dict[str, Any]:
    """Render a finished simulation with another camera, light or size.

    Args:
        out: Folder of the run.
        device: Where to render.
        to: Video (.mp4) or picture (.png); ``render.mp4`` or ``render.png`` in ``out`` by default.
        camera: ``orbit``, a photograph's index, or a JSON file; the shot's own by default.
        size: (width, height) [px].
        frame: Only this frame.
        progress: Called per frame.
        light: Changes to the light, as :func:`gsfluent.pipeline.light_shot.changed` takes them.

    Returns:
        ``output``, ``frames`` and ``seconds_per_frame``.

    Raises:
        InputError: Not a finished run, or an argument out of range.
    """
    shot = shot_of(out)
    output = shot.output
    if camera is not None:
        index = camera.lstrip("-").isdigit()
        output = replace(output, camera=int(camera) if index else camera)
    if size is not None:
        output = replace(output, size=size)
    shot = replace(shot, output=output)
    film = Film.of(out, shot, changed(light_of(shot), **light), device)
    target = to or out / ("render.mp4" if frame is None else "render.png")
    start = time.perf_counter()
    if frame is not None:
        if not 0 <= frame < len(film):
            raise InputError(f"--frame {frame}", f"the run has frames 0 to {len(film) - 1}")
        save_image(film.picture(film.frame(frame)).cpu(), target)
        return {
            "output": str(target),
            "frames": 1,
            "seconds_per_frame": time.perf_counter() - start,
        }
    if target.suffix.lower() != ".mp4":
        raise InputError(f"-o {target}", "name a .mp4 file, or give --frame N for one .png")

    def pictures() -> Iterator[np.ndarray]:
        for index in range(len(film)):
            yield to_bytes(film.picture(film.frame(index)))
            report_progress(progress, index + 1, len(film), "")

    count = write_video(target, pictures(), fps=shot.output.video_fps, size=shot.output.size)
    seconds = (time.perf_counter() - start) / count
    return {"output": str(target), "frames": count, "seconds_per_frame": seconds}


def shot_of(out: Path) -> Shot:
    """The resolved shot of a run, from its ``run.json``.

    Raises:
        InputError: There is none.
    """
    path = out / "run.json"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["shot"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: not the record of a run ({error})", "run the shot first"
        ) from error
    return Shot.from_dict(values, out)
