"""Markdown of what rasterizer.py measures: tables, and the bars that it is held against."""

from __future__ import annotations

import os
from typing import Any

import torch
from scenes import FIELDS

BARS = {  # (scene, image width): wall / kernels of forward, wall / kernels of both, MiB (issue 4)
    ("nat 1M", 1920): (0.8, 0.6, 2.0, 1.6, 350.0),
    ("nat 4M", 1920): (1.6, None, 4.5, None, None),
    ("heavy 1M", 1920): (1.6, None, 3.2, None, None),
    ("garden", 1920): (0.5, None, 1.6, None, None),
}
CPU_BARS = {("nat 100k", 800, 2): (100.0, 200.0)}  # forward, both [ms]
MIN_DECIBELS = 50.0  # of the difference of the two images


def better(row: dict[str, Any], key: str) -> float | None:
    """The smaller of gsplat's two figures, None without gsplat."""
    values = [row[name][key] for name in ("packed", "unpacked") if name in row]
    return min(values) if values else None


def _cell(row: dict[str, Any], key: str) -> list[str]:
    """Cells "wall (kernels)" of gsfluent, gsplat packed, unpacked, and both ratios."""
    cells = []
    for name in ("gsfluent", "packed", "unpacked"):
        entry = row.get(name)
        cells.append(f"{entry[key]:.2f} ({entry[f'{key}_kernels']:.2f})" if entry else "")
    ratios = []
    for part in (key, f"{key}_kernels"):
        theirs = better(row, part)
        ratios.append(f"{theirs / row['gsfluent'][part]:.2f}" if theirs else "")
    return [*cells, " / ".join(r for r in ratios if r)]


def cuda_table(name: str, rows: list[dict[str, Any]], version: str | None) -> str:
    """Markdown of a run on a GPU."""
    peer = f"gsplat {version}" if version else "gsplat not installed: gsfluent alone"
    lines = [
        f"Device: {name}; torch {torch.__version__}; {peer}. Milliseconds of one call, wall "
        "(kernels); ratio = the better of gsplat's two modes over gsfluent, wall / kernels.",
        "",
    ]
    head = "| scene | image | gsfluent | gsplat packed | unpacked | ratio |"
    for title, key in (("forward", "fwd"), ("forward + backward", "both")):
        lines += [head.replace("scene", f"{title}: scene"), "| --- " * 6 + "|"]
        for row in rows:
            cells = [row["scene"], f"{row['width']} x {row['height']}", *_cell(row, key)]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    lines += [
        "| scene | image | MiB above inputs, forward / both / both holding the image alone: "
        "gsfluent | gsplat unpacked | launches, forward / both: gsfluent | gsplat unpacked | "
        "difference dB | largest gradient difference |",
        "| --- " * 8 + "|",
    ]
    for row in rows:
        cells = [row["scene"], f"{row['width']} x {row['height']}"]
        for keys in (("fwd_mib", "both_mib", "image_mib"), ("fwd_launches", "both_launches")):
            for who in ("gsfluent", "unpacked"):
                entry = row.get(who)
                cells.append(" / ".join(f"{entry[k]:.0f}" for k in keys) if entry else "")
        entry = row.get("unpacked")
        if entry:
            worst = max(FIELDS, key=lambda field: entry[f"gradient_{field}"])
            cells += [
                f"{entry['difference_db']:.1f}",
                f"{entry[f'gradient_{worst}']:.1e} ({worst})",
            ]
        else:
            cells += ["", ""]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *bar_lines(rows), "", *kernel_lines(rows)])


def kernel_lines(rows: list[dict[str, Any]], label: str = "nat 1M", width: int = 1920) -> list[str]:
    """The longest kernels of forward + backward on one scene."""
    lines = []
    for row in rows:
        if (row["scene"], row["width"]) == (label, width):
            for who in ("gsfluent", "unpacked"):
                if who in row:
                    parts = (f"{k} {ms:.3f}" for k, ms in row[who]["both_longest"].items())
                    name = "gsfluent" if who == "gsfluent" else "gsplat, unpacked"
                    lines.append(f"* {label}, {name}, ms: {'; '.join(parts)}")
    return lines


def bar_lines(rows: list[dict[str, Any]]) -> list[str]:
    """The bars of issue 4 that these rows speak of."""
    lines = ["| bar | at most | gsfluent | gsplat | |", "| --- " * 5 + "|"]
    keys = ("fwd", "fwd_kernels", "both", "both_kernels", "both_mib")
    names = ("forward, wall", "forward, kernels", "both, wall", "both, kernels", "MiB, both")
    for row in rows:
        bars = BARS.get((row["scene"], row["width"]), ())
        for key, name, bar in zip(keys, names, bars, strict=False):
            if bar is None:
                continue
            value = row["gsfluent"][key]
            form = ".0f" if key.endswith("mib") else ".2f"
            other = better(row, key)
            peer = "" if other is None else f"{other:{form}}"
            verdict = "met" if value <= bar else f"missed by {value / bar:.2f}"
            lines.append(
                f"| {row['scene']}, {row['width']} x {row['height']}, {name} | {bar:g} | "
                f"{value:{form}} | {peer} | {verdict} |"
            )
    found = [row["unpacked"]["difference_db"] for row in rows if "unpacked" in row]
    if found:
        verdict = "met" if min(found) >= MIN_DECIBELS else "missed"
        name = f"| same picture, dB of the difference, at least | {MIN_DECIBELS:g} |"
        lines.append(f"{name} {min(found):.1f} | | {verdict} |")
    return lines


def cpu_table(name: str, rows: list[dict[str, Any]]) -> str:
    """Markdown of a run on the CPU."""
    lines = [
        f"CPU: {name}; torch {torch.__version__}; load {os.getloadavg()[0]:.1f}. Milliseconds, "
        "wall (process time of all threads), the least of the runs. Bars are held against the wall "
        "time, or the process time over the threads where others kept the cores busy.",
        "",
        "| scene | image | threads | forward | forward + backward | same bits |",
        "| --- " * 6 + "|",
    ]
    for row in rows:
        for threads, entry in row["threads"].items():
            cells = [row["scene"], f"{row['width']} x {row['height']}", str(threads)]
            for key in ("fwd", "both"):
                cells.append(f"{entry[f'{key}_wall']:.0f} ({entry[f'{key}_process']:.0f})")
            cells.append("yes" if row["same_bits"] else "no")
            lines.append("| " + " | ".join(cells) + " |")
    lines.append("")
    for row in rows:
        for threads, entry in row["threads"].items():
            bars = CPU_BARS.get((row["scene"], row["width"], int(threads)), ())
            for key, bar in zip(("fwd", "both"), bars, strict=False):
                value = min(entry[f"{key}_wall"], entry[f"{key}_process"] / int(threads))
                verdict = "met" if value <= bar else f"missed by {value / bar:.2f}"
                name = "forward" if key == "fwd" else "forward + backward"
                where = f"{row['scene']}, {threads} threads, {name}"
                lines.append(f"* {where}: bar {bar:g} ms, {value:.0f} ms, {verdict}")
    return "\n".join(lines).rstrip()
