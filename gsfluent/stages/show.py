"""From simulated frames to pictures: render and export stages, and ``gsfluent render``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.errors import InputError
from gsfluent.export.write import write_exports
from gsfluent.io import save_image
from gsfluent.pipeline.light.from_shot import changed, light_of, looks_of
from gsfluent.pipeline.render.figures import FilmFigures
from gsfluent.pipeline.render.film import Film, drawn_by, poster_frame
from gsfluent.pipeline.render.video import to_bytes, write_video
from gsfluent.progress import Progress, report_progress
from gsfluent.results.behind import Behind
from gsfluent.results.digests import require_intact
from gsfluent.results.record import shot_of
from gsfluent.results.store import content_digest, publish
from gsfluent.stages.context import RunContext


def render_stage(context: RunContext) -> None:
    """``video.mp4`` and ``poster.png``, and how many holes the repair closed."""
    shot = context.shot
    light = light_of(shot)
    output = [list(shot.output.size), str(shot.output.camera), shot.output.fps]
    output += [shot.output.slow, shot.output.backdrop]
    path = shot.output.camera
    camera_key = content_digest(path) if isinstance(path, Path) else None
    looks = [repr(light), repr(looks_of(shot))]

    def work(folder: Path) -> dict[str, Any]:
        devices = [context.device]
        if shot.solve.devices == "all" and context.device.type == "cuda":
            others = (torch.device("cuda", i) for i in range(torch.cuda.device_count()))
            devices += [device for device in others if device != _numbered(context.device)]
        films = [Film(context.out, shot, light, device) for device in devices]
        film = films[0]
        report: dict[str, Any] = {"frames": len(film)}
        figures = FilmFigures(film.frame(0), film.around)
        counts: list[int] = []
        drawing = 0.0
        progress = context.reporter.task("render")

        def pictures() -> Iterator[np.ndarray]:
            nonlocal drawing
            for frame, draw in drawn_by(films):
                start = time.perf_counter()
                made = draw()
                picture = to_bytes(made.image)
                drawing += time.perf_counter() - start
                camera = film.cameras[frame.index]
                beside.do(figures.add, frame, camera, made.alpha, made.depth)
                counts.append(int(frame.facts.get("fragments", 1)))
                report_progress(progress, frame.index + 1, len(film), "")
                yield picture

        video = folder / "video.mp4"
        with Behind() as beside:  # a frame is measured while the next is drawn
            write_video(video, pictures(), fps=shot.output.video_fps, size=shot.output.size)
        report |= figures.report()
        report["seconds_per_frame"] = drawing / len(film)
        report["poster_frame"] = poster_frame(counts, shot.output.fps)
        best = film.frame(report["poster_frame"])
        save_image(film.picture(best).image.cpu(), folder / "poster.png")
        return report

    result = context.do("render", work, looks, output, camera_key, section="render", hands_on=False)
    for name in ("video.mp4", "poster.png"):
        publish(result, name, context.out / name)
        context.record.values["outputs"][name.split(".")[0]] = name


def _numbered(device: torch.device) -> torch.device:
    """A GPU by its number."""
    index = torch.cuda.current_device() if device.index is None else device.index
    return torch.device("cuda", index)


def export_stage(context: RunContext) -> None:
    """What ``output.what`` asks for beside the video."""
    wanted = [kind for kind in context.shot.output.what if kind != "mp4"]
    if not wanted:
        return

    def work(folder: Path) -> dict[str, Any]:
        return write_exports(context.out, wanted, progress=context.reporter.task("export"))

    context.record.values["outputs"] |= context.do("export", work, wanted, hands_on=False).report


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

    Arguments as the options of ``gsfluent render`` (docs/guide/light-and-video.md).

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
    require_intact(out / "stages" / "simulate")
    film = Film(out, shot, changed(light_of(shot), **light), device)
    target = to or out / ("render.mp4" if frame is None else "render.png")
    start = time.perf_counter()
    if frame is not None:
        if not 0 <= frame < len(film):
            raise InputError(f"--frame {frame}", f"the run has frames 0 to {len(film) - 1}")
        save_image(film.picture(film.frame(frame)).image.cpu(), target)
        return {
            "output": str(target),
            "frames": 1,
            "seconds_per_frame": time.perf_counter() - start,
        }
    if target.suffix.lower() != ".mp4":
        raise InputError(f"-o {target}", "name a .mp4 file, or give --frame N for one .png")

    def pictures() -> Iterator[np.ndarray]:
        for frame in film.frames():
            yield to_bytes(film.picture(frame).image)
            report_progress(progress, frame.index + 1, len(film), "")

    count = write_video(target, pictures(), fps=shot.output.video_fps, size=shot.output.size)
    seconds = (time.perf_counter() - start) / count
    return {"output": str(target), "frames": count, "seconds_per_frame": seconds}
