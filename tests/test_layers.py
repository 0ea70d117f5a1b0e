"""The shape of the house: who may import whom, how long a file may be, what may not be in it."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gsfluent"
SOURCES = sorted(PACKAGE.rglob("*.py"))
CSRC = sorted(p for p in (ROOT / "csrc").rglob("*") if p.suffix in (".h", ".cpp", ".cu"))
CORE = [p for p in CSRC if ROOT / "csrc" / "core" in p.parents]
LINE_LIMIT = 450

# layer -> gsfluent packages it must not import (cli -> pipeline -> ops; data below all)
FORBIDDEN = {
    "ops": (
        "data",
        "io",
        "config",
        "pipeline",
        "cli",
        "scene",
        "materials",
        "demo",
        "progress",
        "lab",
        "viewer",
        "charts",
        "fracturebench",
        "figure",
    ),
    "data": ("pipeline", "cli", "ops.mpm", "scene", "config", "progress", "lab", "viewer"),
    "io": ("pipeline", "cli", "scene", "progress", "lab", "viewer"),
    "pipeline": ("cli", "lab", "viewer", "charts", "fracturebench"),
    "viewer": ("cli", "lab", "charts"),
    # charts drive stages and problems alike: above pipeline and lab, below the command line
    "charts": ("cli", "viewer"),
    # a scorer without torch: nothing of gsfluent but itself
    "fracturebench": (
        "_check",
        "_load",
        "charts",
        "cli",
        "config",
        "crack_band",
        "data",
        "demo",
        "errors",
        "figure",
        "geometry",
        "io",
        "lab",
        "materials",
        "metrics",
        "ops",
        "pipeline",
        "progress",
        "scene",
        "viewer",
    ),
    # drawing: numbers in, pictures and pages out
    "figure": (
        "charts",
        "cli",
        "config",
        "data",
        "demo",
        "fracturebench",
        "lab",
        "ops",
        "pipeline",
        "scene",
        "viewer",
    ),
    "demo": ("cli", "ops", "pipeline.run", "pipeline.render", "lab"),
    "scene": ("cli", "pipeline.run", "lab"),
    "config": ("cli", "pipeline.run", "lab"),
    "lab": ("pipeline", "cli", "scene", "config", "io", "progress", "demo", "charts", "figure"),
}

# what the rule lets through: the solids of known inside are the truth of the texture stage's
# volumes, and speak of them in its own types
ALLOWED = {"lab": ("pipeline.texture",)}


def imported(path: Path) -> set[str]:
    """Absolute dotted names that a module imports anywhere."""
    names = set()
    package = ["gsfluent", *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                start = package[: len(package) - node.level + 1]
                base = ".".join([*start, base] if base else start)
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


def layer(path: Path) -> str:
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    fine = tuple(f"gsfluent.{name}" for name in ALLOWED.get(layer(path), ()))
    wrong = [
        name
        for name in imported(path)
        if not any(name == f or name.startswith(f + ".") for f in fine)
        for below in FORBIDDEN.get(layer(path), ())
        if name == f"gsfluent.{below}" or name.startswith(f"gsfluent.{below}.")
    ]
    assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(set(wrong))}"


def test_only_ops_call_the_dispatcher() -> None:
    calls = [
        str(p.relative_to(ROOT))
        for p in SOURCES
        if layer(p) not in ("ops", "_load")
        and "torch.ops.gsfluent" in p.read_text(encoding="utf-8")
    ]
    assert calls == []


@pytest.mark.parametrize("path", [*SOURCES, *CSRC], ids=lambda p: str(p.relative_to(ROOT)))
def test_files_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LINE_LIMIT


@pytest.mark.parametrize(
    "path",
    [p for p in CSRC if p.suffix == ".cu" or p in CORE],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_kernels_and_core_do_not_know_torch(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    included = re.findall(r'#include\s*[<"]([^>"]+)[>"]', text)
    assert [name for name in included if "torch" in name or "ATen" in name or "c10" in name] == []


@pytest.mark.parametrize("path", CORE, ids=lambda p: str(p.relative_to(ROOT)))
def test_core_has_no_containers_and_includes_only_core(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert re.findall(r"std::(vector|map|string|unordered_map)\b", text) == []
    local = re.findall(r'#include\s*"([^"]+)"', text)
    assert [name for name in local if "/" in name and not name.startswith("core/")] == []


def tracked_text_files() -> list[Path]:
    try:
        names = subprocess.run(
            ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    suffixes = {".py", ".h", ".cpp", ".cu", ".sh", ".md", ".yaml", ".yml", ".toml"}
    return [ROOT / n for n in names if Path(n).suffix in suffixes and (ROOT / n).is_file()]


def test_no_machine_paths() -> None:
    # written apart so that this file does not match itself
    pattern = re.compile("/" + r"(root|home|work|Users)/\w")
    found = [
        f"{p.relative_to(ROOT)}:{number}"
        for p in tracked_text_files()
        for number, line in enumerate(p.read_text(encoding="utf-8").splitlines(), 1)
        if pattern.search(line)
    ]
    assert found == []


def test_library_does_not_print() -> None:
    found = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print":
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert found == []


def test_heavy_libraries_are_imported_late() -> None:
    heavy = (
        "diffusers",
        "transformers",
        "accelerate",
        "cv2",
        "trimesh",
        "scipy",
        "imageio_ffmpeg",
        "PIL",
    )
    found = []
    for path in SOURCES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Import):
                names = [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            else:
                continue
            found += [f"{path.relative_to(ROOT)}: {n}" for n in names if n.split(".")[0] in heavy]
    assert found == []


def test_an_op_is_a_function_whichever_is_asked_for_first() -> None:
    # gsfluent.ops.mvee is a module and a function
    code = "from gsfluent import ops; ops.mvee_lens; assert callable(ops.mvee)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
