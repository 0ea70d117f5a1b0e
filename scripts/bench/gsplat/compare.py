"""Reconstruct and gsplat's default trainer on the same photographs, side by side in one table.

python scripts/bench/gsplat/compare.py --device cuda --jsonl out.jsonl \\
    --markdown docs/measured/reconstruction.md
python scripts/bench/gsplat/compare.py --only fox demo:watermelon --ours mcmc:densify=mcmc

Captures: every folder of GSFLUENT_DATA/captures (or ../shared/data beside the checkout) and the
built-in objects, photographed first: demo:watermelon and demo:orange float before nothing and have
masks, demo:watermelon-table stands in a room and has none. Without masks whole photographs are
learned and judged by both. Every eighth photograph is held out. gsplat's side is
scripts/bench/gsplat/train.py; without gsplat installed only gsfluent runs.

The built-in objects are photographed into --demo-folder and found there again; --prepare does only
that. Each run is one line of the JSON file; runs already in it are not repeated. ``--ours
NAME:KEY=VALUE,KEY=VALUE`` adds a run of ours with those arguments of ``Reconstruct``.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import inspect
import json
import logging
import os
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
import train

import gsfluent as gf
from gsfluent.data import Capture
from gsfluent.demo import make_capture
from gsfluent.errors import GsfluentError
from gsfluent.figure.markdown import enter

DATA = Path(os.environ.get("GSFLUENT_DATA", Path(__file__).resolve().parents[4] / "shared/data"))
BUILT_IN = ("demo:watermelon", "demo:orange", "demo:watermelon-table")
WHOLE = {"sh_degree": 3, "separate": False, "clean": False}  # everything in the photographs
PSNR_SLACK, SSIM_SLACK = 0.1, 0.002  # of issue 4


def captures() -> list[str]:
    """Names of all captures: real ones found, then the built-in ones."""
    folder = DATA / "captures"
    real = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    return [*real, *BUILT_IN]


def opened(name: str, scratch: Path, views: int, size: int) -> Capture:
    """The capture of that name; a built-in object is photographed into ``scratch`` when new."""
    if not name.startswith("demo:"):
        return gf.load_capture(DATA / "captures" / name)
    folder = scratch / f"{name.replace(':', '_')}_{views}_{size}"
    thing, _, support = name.removeprefix("demo:").partition("-")
    if not (folder / "transforms.json").is_file():  # written last
        make_capture(
            thing, folder, views=views, size=size, support=support or "none", masks=not support
        )
    return gf.load_capture(folder)


def settings(text: str) -> tuple[str, dict[str, Any]]:
    """``NAME:KEY=VALUE,...`` as a name and arguments of Reconstruct.

    Raises:
        ValueError: It does not read so, or Reconstruct has no such argument.
    """
    name, _, rest = text.partition(":")
    known = inspect.signature(gf.pipeline.Reconstruct).parameters
    found: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, sign, value = part.partition("=")
        if not sign or key not in known:
            raise ValueError(f"{part!r}: wanted KEY=VALUE with a KEY of {', '.join(known)}")
        try:
            found[key] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            found[key] = value
    if not name:
        raise ValueError(f"{text!r}: wanted NAME:KEY=VALUE,...")
    return f"gsfluent {name}", found


def run_ours(
    capture: Capture, given: dict[str, Any], options: argparse.Namespace
) -> dict[str, Any]:
    """One run of Reconstruct, with the keys of scripts/bench/gsplat/train.py."""
    known = inspect.signature(gf.pipeline.Reconstruct).parameters
    values = {k: v for k, v in WHOLE.items() if k in known}
    values |= {"iterations": options.iterations, "image_size": options.image_size}
    values |= {"device": options.device, "seed": options.seed} | given
    report = gf.pipeline.Reconstruct(**values)(capture).report
    keys = ("iterations", "gaussians", "psnr", "ssim", "image_size", "held_out", "start")
    line = {key: report[key] for key in keys}
    line["seconds"] = report.get("train_seconds", report["seconds"])
    line["total_seconds"] = report["seconds"]
    return line


def run_theirs(capture: Capture, options: argparse.Namespace) -> dict[str, Any]:
    """One run of gsplat's default trainer."""
    device = torch.device(options.device)
    _, report = train.reconstruct(
        capture, options.iterations, options.image_size, device, options.seed
    )
    return report


def table(lines: list[dict[str, Any]]) -> str:
    """Markdown: every run, ours with the differences from gsplat on the same capture."""
    theirs = {
        (x["capture"], x["iterations"], x["image_size"]): x
        for x in lines
        if x["trainer"] == "gsplat"
    }
    devices = sorted({x["device"] for x in lines if "device" in x})
    rows = [
        "Same photographs, same held-out ones (every eighth), same number of steps. gsplat: its "
        "default loop and values (scripts/bench/gsplat/train.py). PSNR and SSIM on the "
        "held-out photographs; seconds are training alone, without reading and judging. Bar: PSNR "
        f"no more than {PSNR_SLACK} dB lower, SSIM {SSIM_SLACK}, no more Gaussians, less time. "
        + ("; ".join(devices) + "." if devices else ""),
        "",
        "| capture | held out | trainer | steps | Gaussians | PSNR dB | SSIM | seconds | "
        "against gsplat |",
        "| --- " * 9 + "|",
    ]
    for line in lines:
        other = theirs.get((line["capture"], line["iterations"], line["image_size"]))
        cells = [
            line["capture"],
            str(line["held_out"]),
            line["trainer"],
            str(line["iterations"]),
            f"{line['gaussians']:,}",
            f"{line['psnr']:.2f}",
            f"{line['ssim']:.4f}",
            f"{line['seconds']:.1f}",
            "" if other is None or other is line else verdict(line, other),
        ]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def verdict(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    """Differences from gsplat, and what of the bar is missed."""
    psnr, ssim = ours["psnr"] - theirs["psnr"], ours["ssim"] - theirs["ssim"]
    count = ours["gaussians"] / max(1, theirs["gaussians"])
    speed = ours["seconds"] / max(1e-9, theirs["seconds"])
    missed = [
        name
        for name, bad in (
            ("PSNR", psnr < -PSNR_SLACK),
            ("SSIM", ssim < -SSIM_SLACK),
            ("count", count > 1.0),
            ("time", speed >= 1.0),
        )
        if bad
    ]
    end = "met" if not missed else "misses " + ", ".join(missed)
    return f"{psnr:+.2f} dB, {ssim:+.4f}, count x {count:.2f}, time x {speed:.2f}: {end}"


def device_name(device: str) -> str:
    """The GPU's name, or the processor's."""
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(torch.device(device))
    return platform.processor() or platform.machine()


def read_lines(path: Path | None) -> list[dict[str, Any]]:
    """The runs made before."""
    if path is None or not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--only", nargs="+", help="captures; all of them when left out")
    add("--iterations", type=int, default=7000)
    add("--image-size", type=int, default=800)
    add("--device", default="cuda")
    add("--seed", type=int, default=0)
    add("--ours", action="append", metavar="NAME:KEY=VALUE,...", help="default: default:")
    add("--trainers", nargs="+", choices=["gsfluent", "gsplat"], default=["gsfluent", "gsplat"])
    add("--demo-views", type=int, default=60)
    add("--demo-size", type=int, default=400)
    add("--demo-folder", type=Path, help="default: a temporary one")
    add("--prepare", action="store_true", help="photograph the built-in objects, and end")
    add("--jsonl", type=Path, help="one line per run; runs in it are not repeated")
    add("--markdown", type=Path, help="page to enter the table into")
    options = parser.parse_args(arguments)
    unknown = set(options.only or ()) - set(captures())
    if unknown:
        parser.error(f"--only: {', '.join(sorted(unknown))} not among {', '.join(captures())}")
    try:
        options.ours = [settings(text) for text in options.ours or ["default:"]]
    except ValueError as error:
        parser.error(f"--ours {error}")
    return options


def main(arguments: list[str] | None = None) -> int:
    options = parsed(arguments)
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    lines, failed = read_lines(options.jsonl), 0
    has_gsplat = importlib.util.find_spec("gsplat") is not None
    if "gsplat" in options.trainers and not has_gsplat:
        sys.stderr.write("gsplat is not installed: gsfluent runs alone\n")
    todo: list[tuple[str, dict[str, Any] | None]] = []
    if "gsplat" in options.trainers and has_gsplat:
        todo.append(("gsplat", None))
    if "gsfluent" in options.trainers:
        todo += options.ours
    with tempfile.TemporaryDirectory() as temporary:
        scratch = options.demo_folder or Path(temporary)
        for name in options.only or captures():
            if options.prepare:
                opened(name, scratch, options.demo_views, options.demo_size)
                continue
            done = {
                x["trainer"]
                for x in lines
                if (x["capture"], x["iterations"], x["image_size"])
                == (name, options.iterations, options.image_size)
            }
            wanted = [(label, given) for label, given in todo if label not in done]
            if not wanted:
                continue
            capture = opened(name, scratch, options.demo_views, options.demo_size)
            for label, given in wanted:
                try:
                    if given is None:
                        line = run_theirs(capture, options)
                    else:
                        line = run_ours(capture, given, options)
                except GsfluentError as error:
                    failed += 1
                    sys.stderr.write(f"{name}, {label}: {error}\n")
                    continue
                line |= {"capture": name, "trainer": label, "device": device_name(options.device)}
                lines.append(line)
                text = json.dumps(line)
                sys.stderr.write(text + "\n")
                if options.jsonl is not None:
                    with options.jsonl.open("a") as file:
                        file.write(text + "\n")
                if options.device.startswith("cuda"):
                    torch.cuda.empty_cache()
    if options.prepare:
        return 0
    part = table(lines)
    sys.stdout.write(part + "\n")
    if options.markdown is not None:
        page = options.markdown
        old = page.read_text() if page.exists() else ""
        page.write_text(enter(old, "compare_reconstruction", part, "## Beside gsplat"))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
