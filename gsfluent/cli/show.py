"""What a person sees on stdout, and the one JSON object a program sees."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Any


def to_json(value: dict[str, Any]) -> str:
    """Strict JSON text; NaN and infinity become null, paths and dataclasses their plain form."""
    return json.dumps(_plain(value), allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int, bool)):
        return value
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return str(value)


def show(result: dict[str, Any]) -> None:
    """Print the result as indented ``key: value`` lines; long per-frame lists are summarised."""
    lines = list(_lines(_plain(result), 0))
    sys.stdout.write("\n".join(lines) + "\n")


def _lines(value: dict[str, Any], depth: int) -> list[str]:
    lines: list[str] = []
    for key, item in value.items():
        name = f"{'  ' * depth}{key}"
        if isinstance(item, dict):
            lines += [f"{name}:", *_lines(item, depth + 1)] if item else [f"{name}: none"]
        elif isinstance(item, list) and item and all(isinstance(x, dict) for x in item):
            lines.append(f"{name}:")
            lines += [f"{'  ' * (depth + 1)}- {_row(x)}" for x in item]
        elif isinstance(item, list) and len(item) > 8:
            numbers = [x for x in item if isinstance(x, (int, float)) and not isinstance(x, bool)]
            span = f", {_scalar(min(numbers))} to {_scalar(max(numbers))}" if numbers else ""
            lines.append(f"{name}: {len(item)} values{span}")
        else:
            lines.append(f"{name}: {_scalar(item)}")
    return lines


def _row(item: dict[str, Any]) -> str:
    return ", ".join(f"{k} {_scalar(v)}" for k, v in item.items())


def _scalar(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return "[" + ", ".join(_scalar(v) for v in value) + "]"
    return "-" if value is None else str(value)
