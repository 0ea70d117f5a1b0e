"""Films of inputs without a shot, small, and sheets of their frames to be judged by eye.

    python scripts/pictures/first_films.py INPUT ... -o out/films [--size 160x120] [--frames 24]

    python scripts/pictures/first_films.py INPUT ... -o out/films --write    # rows of the page

Each input is run as ``gsfluent run INPUT -o out/films/NAME`` runs it, into a smaller picture.
Beside the folders lie NAME.png, frames at even distances in rows from left to right, and
films.json: verdict, pieces, warnings, and what leaves the picture: the largest share of all matter
in any frame, and of a piece of more than 1 % of it. A film that is there is not made again.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gsfluent.run.from_input as from_input
from gsfluent.cli import main as gsfluent
from gsfluent.config import load_shot
from gsfluent.figure.markdown import enter
from gsfluent.io.atomic import write_json
from gsfluent.pipeline.light.lamps import Lighting
from gsfluent.pipeline.render.film import Film

COLUMNS = 6
PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured" / "first_films.md"
DATA = PAGE.parent / "data" / "first_films.jsonl"
_PIECE = 0.01  # of the matter: what is smaller is a crumb


def made(source: Path, out: Path) -> dict[str, Any]:
    """Run one input, or take what is there; its run.json."""
    if not (out / "video.mp4").is_file():
        gsfluent(["run", str(source), "-o", str(out)])
    return dict(json.loads((out / "run.json").read_text(encoding="utf-8")))


def frames_of(path: Path) -> np.ndarray:
    """All frames of a film, uint8 [T, H, W, 3]."""
    import imageio_ffmpeg

    film = imageio_ffmpeg.read_frames(str(path))
    width, height = next(film)["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in film])


def sheet(film: np.ndarray, count: int) -> np.ndarray:
    """Frames of a film [T, H, W, 3] at even distances, in rows."""
    picked = film[np.linspace(0, len(film) - 1, min(count, len(film))).round().astype(int)]
    _, height, width, _ = picked.shape
    rows = -(-len(picked) // COLUMNS)
    page = np.zeros((rows * height, COLUMNS * width, 3), np.uint8)
    for index, frame in enumerate(picked):
        row, column = divmod(index, COLUMNS)
        page[row * height :, column * width :][:height, :width] = frame
    return page


def outside(out: Path) -> tuple[float, float]:
    """Largest share of the matter that is out of the picture, and of any piece above 1 % of it."""
    film = Film(out, load_shot(out / "shot.yaml"), Lighting(), torch.device("cpu"))
    most, piece = 0.0, 0.0
    for index, camera in enumerate(film.cameras):
        saved = film.frame(index)
        places, depth = camera.project(saved.positions.double())
        side = places.new_tensor([camera.width, camera.height])
        gone = ((places < 0.0) | (places > side)).any(dim=1) | (depth <= 0.0)
        most = max(most, float(gone.double().mean()))
        for number in saved.fragments.unique().tolist():
            mine = saved.fragments == number
            if number >= 0 and float(mine.double().mean()) > _PIECE:
                piece = max(piece, float(gone[mine].double().mean()))
    return most, piece


def told(path: Path) -> dict[str, Any]:
    """What a shot that was made says of its object and of what happens to it."""
    shot = load_shot(path)
    (thing,) = shot.objects.values()
    drop, *throws = shot.events
    down = f", thrown at {-throws[0].velocity[2]:g} m/s" if throws else ""
    return {
        "kind": "mesh" if shot.mesh is not None else "splat",
        "material": thing.material,
        "event": f"{drop.height:g} m{down}",
        "slow": shot.output.slow,
    }


def entered(rows: list[dict[str, Any]]) -> None:
    """Put rows into the data and the table of the page; those of other inputs stay."""
    known = {}
    if DATA.is_file():
        known = {row["name"]: row for row in map(json.loads, DATA.open(encoding="utf-8"))}
    known |= {row["name"]: row for row in rows}
    DATA.write_text("".join(json.dumps(known[name]) + "\n" for name in sorted(known)), "utf-8")
    PAGE.write_text(enter(PAGE.read_text("utf-8"), "first_films", table(known)), "utf-8")


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Markdown: what was filmed, how it broke, what left the picture."""
    head = ("input", "kind", "material", "falls", "slower", "pieces", "matter out of the picture",
            "of a piece", "warnings")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name in sorted(rows):
        row = rows[name]
        cells = [name, row["kind"], row["material"], row["event"], f"{row['slow']:g}",
                 str(row["pieces"]), f"{row['matter_outside']:.1%}",
                 f"{row['piece_outside']:.0%}", str(len(row["warnings"]))]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def judged(source: Path, folder: Path, frames: int) -> dict[str, Any]:
    """One film: made, laid out, and what can be said in numbers."""
    from PIL import Image

    name = source.parent.name if source.is_file() else source.name
    record = made(source, folder / name)
    film = frames_of(folder / name / "video.mp4")
    Image.fromarray(sheet(film, frames)).save(folder / f"{name}.png")
    most, piece = outside(folder / name)
    found = record["simulation"] or {}
    return told(folder / name / "shot.yaml") | {
        "name": name,
        "verdict": record["verdict"],
        "frames": len(film),
        "pieces": (found.get("per_frame") or {}).get("pieces", [0])[-1],
        "matter_outside": most,
        "piece_outside": piece,
        "warnings": record["warnings"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/films"))
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--frames", type=int, default=24, help="on a sheet")
    parser.add_argument("--write", action="store_true", help="enter the rows into the page")
    args = parser.parse_args()
    torch.set_num_threads(1)
    from_input.SETTINGS["output"] = {"size": [int(side) for side in args.size.split("x")]}
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for source in args.inputs:
        rows.append(judged(source, args.out, args.frames))
        print(json.dumps(rows[-1]), flush=True)
    write_json(args.out / "films.json", {"films": rows})
    if args.write:
        entered(rows)


if __name__ == "__main__":
    sys.exit(main())
