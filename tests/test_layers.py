"""The shape of the house: who may import whom, how long a file may be, what may not be in it."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gsfluent"
SOURCES = sorted(PACKAGE.rglob("*.py"))
CSRC = sorted(p for p in (ROOT / "csrc").rglob("*") if p.suffix in (".h", ".cpp", ".cu"))
LINE_LIMIT = 600
FILES_LIMIT = 12
CORE = [p for p in CSRC if ROOT / "csrc" / "core" in p.parents]

# Rooms, lowest first: a file imports from its own room or from one further up this list. A folder
# stands for what is in it and below it, as far as that has no line of its own.
ORDER = (
    "_lazy.py __init__.py lazy.py errors.py _load.py _check.py ops/_register.py ops/turns.py "
    "geometry.py colors.py progress.py hardware.py process.py "
    "data materials ops metrics.py draw.py io/checked spatial "
    "demo io posing "
    "scene figure config/yaml_file.py config config/physgaussian results "
    "pipeline/__init__.py pipeline/stage.py pipeline/carrying pipeline/capture "
    "pipeline/matter pipeline/heat pipeline/liquid "
    "pipeline/colliders "
    "pipeline/light pipeline/solid pipeline/reconstruct pipeline/regions pipeline/fill "
    "pipeline/texture/volume pipeline/texture/presets pipeline/texture/photo "
    "pipeline/texture/synthesis pipeline/texture/inpaint pipeline/texture "
    "pipeline/partition "
    "pipeline/render pipeline/cracks pipeline/simulate targets pipeline/fit "
    "export stages inspection live viewer/model viewer/draw viewer/panels viewer plan choose run "
    "sweep fit dataset studio lab/world lab/truth lab/textbook lab/problems lab/frozen lab/peers "
    "lab/charts lab/stability lab cli __main__.py"
).split()
# a scorer without torch: nothing of gsfluent but itself, and what asks it names it
ALONE = "fracturebench"
# one family of operators a file is the rule there, and nobody opens more than one
MANY_FILES = ("ops", "ops/reference")


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in SOURCES}


@functools.cache
def imported(path: Path) -> set[str]:
    """Modules of the package that a module imports anywhere: on top, in functions, for types."""
    found = set()
    package = list(path.relative_to(ROOT).parts[:-1])
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            # `from package import module` names the module, else the package itself is taken
            names = [f"{base}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else base for name in names]
        else:
            continue
        found.update(name for name in names if name in MODULES)
    return found - {module_of(path)}


def room(path: Path) -> str:
    """The longest line of the order that a file stands under."""
    name = str(path.relative_to(PACKAGE))
    under = [r for r in (*ORDER, ALONE) if name == r or name.startswith(f"{r}/")]
    assert under, f"{name} stands under no rule: give its folder a place in ORDER"
    return max(under, key=len)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    mine = room(path)
    rooms = {name: room(MODULES[name]) for name in imported(path)}
    if mine == ALONE:
        wrong = [name for name, other in rooms.items() if other != ALONE]
    else:
        rank = ORDER.index(mine)
        wrong = [n for n, other in rooms.items() if other != ALONE and ORDER.index(other) > rank]
    assert not wrong, f"{path.relative_to(ROOT)} ({mine}) imports {sorted(wrong)}"


def test_only_the_lab_and_the_command_line_know_the_lab() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in SOURCES
        if not room(path).startswith(("lab", "cli", ALONE))
        for name in imported(path)
        if name.startswith(("gsfluent.lab", "gsfluent.fracturebench"))
    ]
    assert wrong == []


def test_no_import_closes_a_loop() -> None:
    graph = {name: imported(path) for name, path in MODULES.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize(
    "folder", sorted({path.parent for path in SOURCES}), ids=lambda p: str(p.relative_to(ROOT))
)
def test_a_folder_can_be_overlooked(folder: Path) -> None:
    files = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
    if str(folder.relative_to(PACKAGE)) not in MANY_FILES:
        assert len(files) <= FILES_LIMIT, f"{folder.relative_to(ROOT)}: {len(files)} files"


# libraries: all that has no underscore may be taken; the other rooms name it in their __init__
LIBRARIES = (
    ". ops ops/reference data targets io materials config pipeline pipeline/texture cli demo "
    "figure fracturebench fracturebench/scenes"
).split()


def face(folder: Path) -> dict[str, set[str]]:
    """What the table in a room's ``__init__.py`` says that others may take, by module."""
    tree = tree_of(folder / "__init__.py")
    (call,) = (n for n in ast.walk(tree) if getattr(getattr(n, "func", None), "id", "") == "room")
    package = module_of(folder / "__init__.py")
    whole = {str(ast.literal_eval(word)) for word in call.args[1:]}
    given = {f"{package}.{k.arg}": set(ast.literal_eval(k.value).split()) for k in call.keywords}
    return {package: whole, **given} if whole else given


def test_a_room_names_what_others_take() -> None:
    taken: dict[Path, dict[str, set[str]]] = {}
    for path in SOURCES:
        for node in ast.walk(tree_of(path)):
            if not isinstance(node, ast.ImportFrom) or node.level or node.module not in MODULES:
                continue
            home = MODULES[node.module]
            if path.is_relative_to(home.parent):
                continue
            for alias in node.names:
                whole = home.name == "__init__.py"  # a module is taken, or a name of the room
                if not whole or f"{node.module}.{alias.name}" in MODULES:
                    rows = taken.setdefault(home.parent, {})
                    rows.setdefault(node.module, set()).add(alias.name)
    for folder in sorted({path.parent for path in SOURCES}):
        if str(folder.relative_to(PACKAGE)) not in LIBRARIES and folder in taken:
            assert face(folder) == taken[folder], folder.relative_to(ROOT)


def test_only_ops_call_the_dispatcher() -> None:
    calls = [
        str(p.relative_to(ROOT))
        for p in SOURCES
        if room(p) not in ("ops", "ops/turns.py", "_load.py")
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
        for node in ast.walk(tree_of(path)):
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
        for node in tree_of(path).body:
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
