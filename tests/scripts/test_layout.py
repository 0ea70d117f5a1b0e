"""Scripts lie in rooms that one overlooks, and who names one names a file that is there."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = sorted({path.parent for path in (ROOT / "scripts").rglob("*.py")})
ON_TOP = {"demo.sh", "lab.sh", "setup.sh", "test.sh", "wheel.sh", "wheel_try.sh"}
NAMED = re.compile(r"\bscripts/[\w/]+\.(?:py|sh)\b")


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_folder_has_at_most_twelve_files(folder: Path) -> None:
    assert len([path for path in folder.iterdir() if path.is_file()]) <= 12


def test_only_the_shell_scripts_lie_on_top() -> None:
    assert {path.name for path in (ROOT / "scripts").iterdir() if path.is_file()} == ON_TOP


def test_scripts_that_are_named_are_there() -> None:
    try:
        names = subprocess.run(
            ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    suffixes = {".py", ".h", ".cpp", ".cu", ".sh", ".md", ".yaml", ".yml", ".toml"}
    files = [ROOT / name for name in names if Path(name).suffix in suffixes]
    gone = [
        f"{path.relative_to(ROOT)}: {named}"
        for path in files
        if path.is_file()
        for named in NAMED.findall(path.read_text(encoding="utf-8"))
        if not (ROOT / named).is_file()
    ]
    assert gone == []
