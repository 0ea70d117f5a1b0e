"""Run the shots of examples/, collect a picture and the times of each, and write the page.

    python scripts/study/shots/gallery.py            # all scenes, resumable
    python scripts/study/shots/gallery.py cake_cut milk_poured -o gallery_out --device cpu
    python scripts/study/shots/gallery.py --quality shot --device cuda
    python scripts/study/shots/gallery.py --page     # only the page, from the lines there are

Each finished run adds one line to gallery.jsonl: the machine, the seconds of every stage, verdict
and pieces. Times in the page come from these lines only; a run that took up finished stages has
none of its own and adds no line. --images also writes a strip of pictures per scene to docs/images.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfluent.cli.common import choose_device
from gsfluent.config import Shot, load_shot
from gsfluent.errors import GsfluentError
from gsfluent.figure.markdown import enter
from gsfluent.hardware import processor
from gsfluent.progress import LineReporter
from gsfluent.run.demo import SIZES, photograph_demo
from gsfluent.run.shot import run_shot

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "examples"
PAGE = ROOT / "docs" / "measured" / "gallery.md"
LINES = ROOT / "docs" / "measured" / "data" / "gallery.jsonl"
STRIP = (4, 320)  # pictures side by side, width of each [px]
MOST_BYTES = 300_000


@dataclasses.dataclass(frozen=True)
class Scene:
    """One scene of the gallery.

    Attributes:
        title: For the page.
        drawn: Object of the built-in generator, or "" when the shot reads the data folder.
        moments: Shares of the frames at which the strip's pictures are taken.
    """

    title: str
    drawn: str
    moments: tuple[float, ...]


SCENES = {
    "watermelon_dropped": Scene("watermelon dropped", "watermelon", (0.2, 0.45, 0.6, 0.98)),
    "apple_shot": Scene("apple shot", "", (0.06, 0.14, 0.35, 0.98)),
    "skull_struck": Scene("skull struck", "", (0.05, 0.2, 0.45, 0.98)),
    "bread_torn": Scene("bread torn", "bread", (0.02, 0.2, 0.5, 0.98)),
    "cake_cut": Scene("cake cut by a blade", "cake", (0.12, 0.36, 0.56, 0.98)),
    "milk_poured": Scene("milk poured", "orange", (0.12, 0.35, 0.6, 0.98)),
    "water_splash": Scene("water splash", "orange", (0.1, 0.4, 0.6, 0.82)),
    "melons_collided": Scene("two bodies collided", "melons", (0.02, 0.2, 0.45, 0.98)),
    "glass_dropped": Scene("glass dropped", "pane", (0.14, 0.3, 0.55, 0.98)),
    "egg_dropped": Scene("egg dropped", "egg", (0.05, 0.2, 0.45, 0.98)),
    "chocolate_snapped": Scene("chocolate snapped", "chocolate", (0.02, 0.2, 0.45, 0.98)),
}


def machine(device: torch.device) -> str:
    """The processor and its cores, or the GPU."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{processor()}, {len(os.sched_getaffinity(0))} cores"


def shot_of(name: str, quality: str | None, device: torch.device | str = "cpu") -> Shot:
    """The shot of a scene, its photographs drawn where it needs them."""
    drawn = SCENES[name].drawn
    if drawn and not (EXAMPLES / "data" / drawn / "cut.png").is_file():
        photograph(drawn, EXAMPLES / "data" / drawn, device)
    shot = load_shot(EXAMPLES / f"{name}.yaml")
    if quality is None:
        return shot
    return dataclasses.replace(shot, solve=dataclasses.replace(shot.solve, quality=quality))


def photograph(drawn: str, folder: Path, device: torch.device | str) -> None:
    """Photographs of an object in a folder; the first of two that want them keeps its own."""
    logging.info("photographing %s", drawn)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{drawn}-") as own:
        photograph_demo(drawn, Path(own) / drawn, SIZES["full"], device=device)
        if (folder / "cut.png").is_file():
            return
        try:
            (Path(own) / drawn).replace(folder)
        except OSError:
            # somebody was quicker; what is left of a run that was cut short makes room
            if not (folder / "cut.png").is_file():
                shutil.rmtree(folder)
                (Path(own) / drawn).replace(folder)


def run(name: str, options: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    """Run one scene; return its line for gallery.jsonl."""
    shot = shot_of(name, options.quality, device)
    out = options.out / name
    start = time.perf_counter()
    record = run_shot(
        shot, out, device=device, seed=0, force=options.force, reporter=LineReporter()
    )
    frames = record["simulation"]["per_frame"]
    return {
        "scene": name,
        "machine": machine(device),
        "device": device.type,
        "quality": shot.solve.quality,
        "commit": commit(),
        "verdict": record["verdict"],
        "pieces": int(max(frames["fragments"])),
        "particles": record["simulation"]["particles"],
        "frames": record["simulation"]["frames"],
        "simulated_seconds": shot.output.seconds,
        "wall_seconds": time.perf_counter() - start,
        "stages": {stage["name"]: round(stage["seconds"], 2) for stage in record["stages"]},
        "resumed": [stage["name"] for stage in record["stages"] if stage["resumed"]],
        "hole_fraction": max(filter(None, record["render"]["hole_fraction"]), default=0.0),
    }


def commit() -> str:
    """Short name of the commit, or "unknown" outside a checkout."""
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return found.stdout.strip() or "unknown"


def strip(video: Path, moments: tuple[float, ...], target: Path) -> None:
    """Pictures of a video side by side as a JPEG of at most 300 kB."""
    import imageio_ffmpeg
    from PIL import Image

    reader = imageio_ffmpeg.read_frames(str(video))
    width, height = next(reader)["source_size"]
    frames = [np.frombuffer(raw, np.uint8).reshape(height, width, 3) for raw in reader]
    size = (STRIP[1], round(STRIP[1] * height / width))
    chosen = [frames[min(len(frames) - 1, round(m * (len(frames) - 1)))] for m in moments]
    pictures = [
        np.asarray(Image.fromarray(f).resize(size, Image.Resampling.LANCZOS)) for f in chosen
    ]
    whole = Image.fromarray(np.hstack(pictures))
    target.parent.mkdir(parents=True, exist_ok=True)
    for quality in (88, 80, 70, 60, 50):
        whole.save(target, quality=quality, optimize=True)
        if target.stat().st_size <= MOST_BYTES:
            return
    raise SystemExit(f"{target}: {target.stat().st_size} bytes even at JPEG quality 50")


def latest(lines: list[dict[str, Any]], name: str, device: str) -> dict[str, Any] | None:
    """The last line of a scene on a kind of device."""
    found = [line for line in lines if line["scene"] == name and line["device"] == device]
    return found[-1] if found else None


def seconds(line: dict[str, Any] | None) -> str:
    """Total time of a line, what took most of it, and where it ran."""
    if line is None:
        return "-"
    total = sum(line["stages"].values())
    parts = ", ".join(f"{name} {value:.0f}" for name, value in line["stages"].items() if value >= 1)
    where = f", {line['machine'].split()[1]}" if line["device"] == "cuda" else ""
    return f"{total:.0f} s ({parts}; {line['quality']}{where})"


def table(lines: list[dict[str, Any]]) -> str:
    """The page's table and the names of the machines."""
    titles = "scene, shot file, picture, verdict, pieces, points, holes, on 2 cores, on a GPU"
    rows = [f"| {titles.replace(', ', ' | ')} |", "| --- " * 9 + "|"]
    machines: dict[str, set[str]] = {"cpu": set(), "cuda": set()}
    for name, scene in SCENES.items():
        both = {device: latest(lines, name, device) for device in ("cpu", "cuda")}
        any_ = both["cuda"] or both["cpu"]
        for device, line in both.items():
            if line is not None:
                machines[device].add(line["machine"])
        picture = f"![{scene.title}](../images/gallery_{name}.jpg)"
        cells = [
            scene.title,
            f"[{name}.yaml](../../examples/{name}.yaml)",
            picture if (ROOT / "docs" / "images" / f"gallery_{name}.jpg").is_file() else "-",
            any_["verdict"] if any_ else "-",
            str(any_["pieces"]) if any_ else "-",
            f"{any_['particles'] / 1000:.0f} k" if any_ else "-",
            f"{100 * any_['hole_fraction']:.2f} %" if any_ else "-",
            seconds(both["cpu"]),
            seconds(both["cuda"]),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    named = [
        f"{label}: {'; '.join(sorted(machines[device]))}."
        for device, label in (("cpu", "2 cores"), ("cuda", "GPU"))
        if machines[device]
    ]
    return "\n".join([*rows, "", *named])


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SCENES)}")
    parser.add_argument("-o", "--out", type=Path, default=Path("gallery_out"))
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument(
        "--quality", choices=("preview", "shot", "hero"), help="the shot's own if absent"
    )
    parser.add_argument("--force", action="store_true", help="redo finished stages")
    parser.add_argument(
        "--lines",
        type=Path,
        default=LINES,
        help="where a line per run is added; elsewhere the page stays as it is",
    )
    parser.add_argument("--images", action="store_true", help="write docs/images/gallery_NAME.jpg")
    parser.add_argument("--page", action="store_true", help="write the page, run nothing")
    options = parser.parse_args()
    unknown = set(options.names) - set(SCENES)
    if unknown:
        parser.error(f"no scene {', '.join(sorted(unknown))}; choose of {', '.join(SCENES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    os.environ.setdefault("GSFLUENT_DATA", str(ROOT.parent / "shared" / "data"))
    failed = 0
    for name in [] if options.page else options.names or list(SCENES):
        if not SCENES[name].drawn and not Path(os.environ["GSFLUENT_DATA"], "captures").is_dir():
            logging.info("%s: left out, no data folder; set GSFLUENT_DATA", name)
            continue
        try:
            line = run(name, options, choose_device(options.device))
        except GsfluentError as error:
            failed += 1
            logging.info("%s: %s", name, error)
            continue
        options.out.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(options.out / name / "poster.png", options.out / f"{name}.png")
        video = options.out / name / "video.mp4"
        strip(video, SCENES[name].moments, options.out / f"{name}.jpg")
        if options.images:
            target = ROOT / "docs" / "images" / f"gallery_{name}.jpg"
            shutil.copyfile(options.out / f"{name}.jpg", target)
        sys.stdout.write(json.dumps(line) + "\n")
        if line["resumed"]:
            logging.info("%s: %s resumed, so no time is recorded", name, ", ".join(line["resumed"]))
            continue
        options.lines.parent.mkdir(parents=True, exist_ok=True)
        with options.lines.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")
    if options.lines != LINES and not options.page:
        return 1 if failed else 0  # the page tells of its own lines
    lines = []
    if options.lines.is_file():
        texts = options.lines.read_text(encoding="utf-8").splitlines()
        lines = [json.loads(text) for text in texts if text.strip()]
    PAGE.write_text(
        enter(PAGE.read_text(encoding="utf-8"), "gallery", table(lines)), encoding="utf-8"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
