"""The built-in scenes: photographs drawn by gsfluent of an object whose inside it knows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsfluent.config import Shot
from gsfluent.demo import interior_error, load_truth, make_capture
from gsfluent.errors import InputError
from gsfluent.io import atomic_path
from gsfluent.io.solid import load_solid
from gsfluent.progress import LineReporter, Progress, Reporter
from gsfluent.results.lock import locked
from gsfluent.results.store import StageStore, fingerprint
from gsfluent.run.shot import run_in
from gsfluent.stages.context import RunContext


@dataclass(frozen=True)
class DemoSize:
    """How large a demo is: photographs, reconstruction, grid and picture."""

    views: int
    image_size: int
    iterations: int
    max_gaussians: int
    resolution: int
    quality: str
    size: tuple[int, int]
    seconds: float
    fps: float


SIZES = {
    "full": DemoSize(42, 256, 800, 30_000, 80, "preview", (640, 480), 1.4, 40.0),
    "preview": DemoSize(26, 128, 300, 8_000, 64, "preview", (320, 240), 0.9, 15.0),
}
SCENES: dict[str, dict[str, Any]] = {
    "watermelon": {"material": "fruit.watermelon", "height": 2.0},
    "orange": {"material": "fruit.orange", "height": 1.0},
}


def demo_shot(name: str, size: DemoSize, capture: Path, exemplar: Path) -> dict[str, Any]:
    """The shot of a demo, as a shot file has it."""
    scene = SCENES[name]
    return {
        "capture": str(capture),
        "scale": 1.0,  # the generator works in metres
        "up": "+z",
        "reconstruct": {"iterations": size.iterations, "max_gaussians": size.max_gaussians},
        "fill": {"resolution": size.resolution},
        "texture": {"method": "exemplar", "exemplar": str(exemplar)},
        "objects": {name: {"material": scene["material"]}},
        "events": [{"type": "drop", "height": scene["height"]}],
        "solve": {"quality": size.quality},
        "output": {
            "fps": size.fps,
            "seconds": size.seconds,
            "size": list(size.size),
            "what": ["mp4"],
        },
    }


def photograph_demo(
    name: str,
    folder: Path,
    size: DemoSize,
    seed: int = 0,
    progress: Progress | None = None,
    device: torch.device | str = "cpu",
) -> dict[str, Any]:
    """Photograph a built-in object: ``photographs/``, ``cut.png`` and ``truth.npz`` in a folder.

    What is known of the inside does not lie among the photographs that are reconstructed.

    Returns:
        ``folder`` and ``images``, their number.

    Raises:
        InputError: No such object.
    """
    paths = make_capture(
        name, folder / "photographs", views=size.views, size=size.image_size, seed=seed,
        device=device, progress=progress,
    )  # fmt: skip
    paths.truth.replace(folder / "truth.npz")
    paths.cut.replace(folder / "cut.png")
    return {"folder": str(folder), "images": len(paths.images)}


def run_demo(
    name: str = "watermelon",
    out: Path = Path("demo_out"),
    *,
    size: str = "full",
    device: torch.device | str = "cpu",
    seed: int = 0,
    force: bool = False,
    unlock: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Photograph a built-in object and run its shot.

    Leaves ``capture/`` and ``shot.yaml`` in ``out`` beside what a run leaves, so the demo can be
    changed and run again like any shot.

    Arguments as the options of ``gsfluent demo``; ``reporter`` receives progress.

    Returns:
        ``run.json`` with ``demo``: interior error against the truth, held-out PSNR.

    Raises:
        InputError: No such scene or size.
        RunError: A stage failed, or another run is at work in the folder.
    """
    if name not in SCENES:
        raise InputError(f"demo {name!r}", f"choose one of {', '.join(SCENES)}")
    if size not in SIZES:
        raise InputError(f"--size {size}", f"choose one of {', '.join(SIZES)}")
    reporter = reporter or LineReporter()
    with locked(out, unlock=unlock):
        return _run(name, out, SIZES[size], device, seed, force, reporter)


def _run(
    name: str,
    out: Path,
    scale: DemoSize,
    device: torch.device | str,
    seed: int,
    force: bool,
    reporter: Reporter,
) -> dict[str, Any]:
    import yaml

    store = StageStore(out / "stages", force=force)

    def photograph(folder: Path) -> dict[str, Any]:
        made = photograph_demo(name, folder, scale, seed, reporter.task("photograph"), device)
        return {"photographs": made["images"]}

    kind = torch.device(device).type  # whose roundings the photographs have
    drawn = () if kind == "cpu" else (kind,)
    key = fingerprint("photograph", name, scale.views, scale.image_size, seed, *drawn)
    made = store.run("photograph", key, photograph)
    values = demo_shot(name, scale, made.folder / "photographs", made.folder / "cut.png")
    with atomic_path(out / "shot.yaml") as part:
        part.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    shot = Shot.from_dict(values)

    def judge(context: RunContext) -> dict[str, Any]:
        solid = load_solid(context.store.root / "texture" / f"{name}.ply").to(device)
        error = interior_error(solid, load_truth(made.folder / "truth.npz"), seed=seed)
        reconstruction = context.record.values["reconstruction"]
        return {"demo": {"interior_error": error, "psnr": reconstruction["psnr"]}}

    return run_in(
        shot,
        out,
        device=device,
        seed=seed,
        force=force,
        reporter=reporter,
        aside=judge,
        before=made,
    )
