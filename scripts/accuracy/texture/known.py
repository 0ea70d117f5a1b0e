"""Judge texturing on six solids whose inside is known; enter docs/measured/texture_accuracy.md.

    python scripts/accuracy/texture/known.py [--size 128] [--only marble cake]
        [--methods default preview] [--device cuda] [--model FOLDER] [--seeds 0 1 2]
        [--draws 5] [--write] [--sheets]

Every run leaves one JSON line in docs/measured/data/texture_accuracy.jsonl (the latest per class,
size, method, device and seed). ``--write`` enters the tables made of all lines, ``--sheets`` draws
held-out planes side by side. ``default`` is what a user gets who gives a photograph and no method.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from sheets import draw_sheet

from gsfluent.figure.markdown import enter
from gsfluent.lab.charts.texturing import texture
from gsfluent.lab.truth.interiors import KNOWN_INTERIORS, known_interior
from gsfluent.lab.truth.interiors_judge import Judge, crossing_error

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "measured" / "texture_accuracy.md"
LINES = ROOT / "docs" / "measured" / "data" / "texture_accuracy.jsonl"
METHODS = (
    "photograph",
    "color_copy",
    "telea_x",
    "telea",
    "profile",
    "photo_profile",
    "procedural",
    "preview",
    "default",
    "full",
    "diffusion",
)
PATCH_BAR, PROFILE_BAR = 1.3, 0.05


def read_lines() -> dict[tuple[str, ...], dict[str, Any]]:
    """All runs on file by class, size, method and device."""
    if not LINES.is_file():
        return {}
    found = [json.loads(line) for line in LINES.read_text(encoding="utf-8").splitlines()]
    return {key(line): line for line in found}


def key(line: dict[str, Any]) -> tuple[str, ...]:
    return (line["class"], str(line["size"]), line["method"], line["device"], str(line["seed"]))


def write_lines(lines: dict[tuple[str, ...], dict[str, Any]]) -> None:
    LINES.parent.mkdir(exist_ok=True)
    text = "".join(json.dumps(lines[k], sort_keys=True) + "\n" for k in sorted(lines))
    LINES.write_text(text, encoding="utf-8")


def rounded(value: Any) -> Any:
    """Four significant digits, so that the file shows changes and not noise."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return {k: rounded(v) for k, v in value.items()} if isinstance(value, dict) else value


def passes(line: dict[str, Any]) -> bool:
    """The issue's bars on likeness."""
    ratio = line["figures"]["ratio"]
    worst = max(ratio[k] for k in ("patch", "patch_coarse", "hist"))
    return worst <= PATCH_BAR and line["figures"]["profile"] <= PROFILE_BAR


def row(line: dict[str, Any]) -> str:
    """One line of the large table."""
    figures = line["figures"]
    ratio = figures["ratio"]
    distances = [f"{figures[k]:.2f} ({ratio[k]:.2f})" for k in ("patch", "patch_coarse", "hist")]
    name = line["method"]
    if line["used"] not in (name, "exemplar"):
        name += f" = {line['used']}"
    volume = figures["neighbour"] is not None  # the photograph has none
    cells = [
        name,
        *distances,
        f"{100 * figures['profile']:.1f}" if volume else "-",
        f"{figures['sharp']:.2f}",
        "/".join(f"{v:.2f}" for v in figures["neighbour"]) if volume else "-",
        f"{figures['radial']:.2f}" if volume else "-",
        f"{ratio['coherence']:.2f}/{ratio['coverage']:.2f}",
        f"{line['crossing']:g}" if volume else "-",
        f"{line['cpu_seconds' if line['device'] == 'cpu' else 'seconds']:.1f}" if volume else "-",
    ]
    return "| " + " | ".join(cells) + " |"


def mean(values: list[Any]) -> Any:
    """Mean of equal structures, number by number."""
    first = values[0]
    if isinstance(first, dict):
        return {k: mean([v[k] for v in values]) for k in first}
    if isinstance(first, list):
        return [mean(list(group)) for group in zip(*values, strict=True)]
    if isinstance(first, (int, float)) and not isinstance(first, bool):
        return sum(values) / len(values)
    return first


def tables(lines: dict[tuple[str, ...], dict[str, Any]], size: int, device: str) -> str:
    """The bars, then every figure, of one size and device."""
    chosen = [v for v in lines.values() if v["size"] == size and v["device"] == device]
    classes = [name for name in KNOWN_INTERIORS if any(v["class"] == name for v in chosen)]
    unit = "CPU s" if device == "cpu" else "s"
    head = (
        "| method | patch | patch, half size | hist | profile % | sharp | neighbour x/y/z | radial "
        f"| coherence/coverage | crossing | {unit} |\n" + "| --- " * 11 + "|"
    )
    short = [
        "| class | used | objects | patch / floor (worst) | half size | hist | profile % "
        f"| {unit} | mean within the bars |"
    ]
    short.append("| --- " * 9 + "|")
    parts = []
    for name in classes:
        runs: dict[str, list[dict[str, Any]]] = {}
        for v in chosen:
            if v["class"] == name:
                runs.setdefault(v["method"], []).append(v)
        own = {method: mean(lines) for method, lines in runs.items()}
        floor = next(own[m] for m in ("default", *METHODS) if m in own)["figures"]["floor"]
        base = [f"{floor[k]:.2f} (1)" for k in ("patch", "patch_coarse", "hist")]
        base += [f"{100 * floor['profile']:.1f}", f"{floor['sharp']:.2f}"]
        base += ["/".join(f"{v:.2f}" for v in floor["neighbour"]), f"{floor['radial']:.2f}"]
        rows = ["| *another draw (floor)* | " + " | ".join([*base, "1/1", "0", "-"]) + " |"]
        rows += [row(own[m]) for m in METHODS if m in own]
        parts.append(f"**{name}**\n\n{head}\n" + "\n".join(rows))
        if "default" in own:
            line, several = own["default"], runs["default"]
            ratio = line["figures"]["ratio"]
            cells = [name, line["used"], str(len(several))]
            for k in ("patch", "patch_coarse", "hist"):
                worst = max(v["figures"]["ratio"][k] for v in several)
                cells.append(f"{ratio[k]:.2f} ({worst:.2f})")
            cells.append(f"{100 * line['figures']['profile']:.1f}")
            cells.append(f"{line['cpu_seconds' if device == 'cpu' else 'seconds']:.1f}")
            cells.append("yes" if passes(line) else "no")
            short.append("| " + " | ".join(cells) + " |")
    return "\n".join(short) + "\n\n" + "\n\n".join(parts)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="\n".join(__doc__.splitlines()[2:])
    )
    parser.add_argument("--size", type=int, default=128, help="voxels along an edge")
    parser.add_argument("--only", nargs="*", default=list(KNOWN_INTERIORS), metavar="CLASS")
    parser.add_argument("--methods", nargs="*", default=None, choices=METHODS, metavar="METHOD")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--model", default=None, help="diffusers pipeline for method diffusion")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0], help="objects to judge on")
    parser.add_argument(
        "--draws",
        type=int,
        default=5,
        help="other draws that make the floor; 0 only times the methods",
    )
    parser.add_argument("--write", action="store_true", help=f"enter tables into {PAGE.name}")
    parser.add_argument("--sheets", action="store_true", help="draw docs/images/texture_*.jpg")
    given = parser.parse_args(arguments)
    methods = given.methods
    if methods is None:
        methods = [m for m in METHODS if m != "diffusion" or given.model]
    lines = read_lines()
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    for name in given.only:
        highest = max(given.seeds) + given.draws
        draws = [known_interior(name, given.size, seed) for seed in range(highest + 1)]
        for seed in given.seeds:
            known = draws[seed]
            others = [draw for draw in draws if draw.seed != seed][: given.draws]
            judge = Judge(known, others) if others else None
            volumes = {}
            for method in methods:
                line: dict[str, Any] = {"class": name, "size": given.size, "method": method}
                line |= {"device": given.device, "seed": seed, "draws": given.draws}
                line["commit"] = commit
                if method == "photograph":
                    if judge is not None:
                        line |= {"used": method, "figures": judge.photograph()}
                        lines[key(line)] = rounded(line)
                        sys.stdout.write(f"{name:10s} {seed} {row(line)}\n")
                    continue
                run = texture(known, method, given.device, given.model)
                line |= {k: run[k] for k in ("cpu_seconds", "seconds")}
                spent = f"{line['cpu_seconds']:.1f} CPU s, {line['seconds']:.1f} s"
                if judge is None:
                    sys.stdout.write(f"{name:10s} {seed} {method}: {spent}\n")
                    continue
                line["used"] = run["used"] or method
                line["figures"] = judge(run["rgb"])
                line["crossing"] = crossing_error(known, run["rgb"])
                lines[key(line)] = rounded(line)
                volumes[method] = run["rgb"]
                sys.stdout.write(f"{name:10s} {seed} {row(line)} {spent}\n")
                sys.stdout.flush()
            if given.sheets and judge is not None and seed == given.seeds[0]:
                draw_sheet(ROOT / "docs" / "images" / f"texture_{name}.jpg", judge, volumes)
        write_lines(lines)
    if given.write:
        text = PAGE.read_text(encoding="utf-8")
        for size, device in sorted({(v["size"], v["device"]) for v in lines.values()}):
            marker = f"texture {size} {device}"
            heading = f"## {size}^3 on {'2 CPU cores' if device == 'cpu' else 'the GPU'}"
            text = enter(text, marker, tables(lines, size, device), heading)
        PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
