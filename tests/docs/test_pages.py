"""The documents do not drift: links, commands, examples and lengths of pages."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import pytest
import yaml
from loaded_scripts import load_script

import gsfluent
from gsfluent.cli.parse import VERBS, parse

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MEASURED = sorted((ROOT / "docs" / "measured").glob("*.md"))
MARKED = re.compile(r"<!-- ([^\n]+): begin -->\n.*?<!-- \1: end -->", re.DOTALL)
SHELVES = ("guide", "theory", "measured")
TABLES = {
    "formats.md",
    "shot-keys.md",
    "run-json.md",
    "physgaussian.md",
    "regions.md",
    "inpainting.md",
    "fracturebench.md",
}
"""Pages of the guide that are looked things up in, not read."""
GUIDE = [page for page in sorted((ROOT / "docs" / "guide").glob("*.md")) if page.name not in TABLES]
BLOCK = re.compile(r"```(\w+)\n(.*?)```", re.DOTALL)


def blocks(kind: str) -> list[tuple[str, str]]:
    return [
        (page.name, text)
        for page in PAGES
        for found, text in BLOCK.findall(page.read_text(encoding="utf-8"))
        if found == kind
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#\s]+)", text)
    broken = [t for t in targets if "://" not in t and not (page.parent / t).exists()]
    assert broken == []


def commands() -> list[tuple[str, str]]:
    lines = [(page, line.strip()) for page, text in blocks("bash") for line in text.splitlines()]
    return [(p, x) for p, x in lines if re.match(rf"gsfluent ({'|'.join(VERBS)})\b", x)]


@pytest.mark.parametrize(("page", "line"), commands())
def test_commands_parse(page: str, line: str) -> None:
    words = shlex.split(line, comments=True)[1:]
    if "--help" in words or "..." in words:
        words = [words[0], "--help"]
        with pytest.raises(SystemExit) as stop:
            parse(words)
        assert stop.value.code == 0
    else:
        assert isinstance(parse(words), VERBS[words[0]])


@pytest.mark.parametrize(("page", "text"), blocks("python"))
def test_python_examples_use_names_that_exist(page: str, text: str) -> None:
    ast.parse(text)
    for name in set(re.findall(r"\bgf\.([\w.]+)", text)):
        value: object = gsfluent
        for part in name.split("."):
            value = getattr(value, part)


@pytest.mark.parametrize(("page", "text"), blocks("yaml"))
def test_yaml_examples_load(page: str, text: str) -> None:
    assert yaml.safe_load(text) is not None


def test_the_smallest_shot_of_the_guide_is_a_shot(tmp_path: Path) -> None:
    from gsfluent.config import load_shot

    text = next(text for page, text in blocks("yaml") if page.endswith("shot-file.md"))
    (tmp_path / "captures" / "apple").mkdir(parents=True)
    (tmp_path / "shot.yaml").write_text(text)
    shot = load_shot(tmp_path / "shot.yaml")
    assert [type(event).__name__ for event in shot.events] == ["Drop"]


def test_the_index_names_every_page() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\]\(([\w/-]+\.md)\)", index))
    docs = ROOT / "docs"
    assert {f"{shelf}/README.md" for shelf in SHELVES[1:]} <= named
    assert {f"guide/{page.name}" for page in (docs / "guide").glob("*.md")} <= named
    for shelf in SHELVES[1:]:
        found = set(re.findall(r"\]\(([\w-]+\.md)\)", (docs / shelf / "README.md").read_text()))
        assert {page.name for page in (docs / shelf).glob("*.md")} - found == {"README.md"}


def test_every_page_stands_on_a_shelf() -> None:
    docs = ROOT / "docs"
    assert {page.name for page in docs.glob("*.md")} == {"index.md", "architecture.md"}
    assert all((docs / shelf).is_dir() for shelf in SHELVES)


def test_the_readme_is_short() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80
    good = text.split("## What it is good at")[1].split("\n## ")[0]
    lines = [line for line in good.splitlines() if line.startswith("* ")]
    assert 1 <= len(lines) <= 8
    assert all("](docs/measured/" in line for line in lines)  # every figure has its page
    python = next(text for page, text in blocks("python") if page == "README.md")
    assert len(python.splitlines()) <= 10


def test_architecture_is_short() -> None:
    assert len((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()) <= 80


@pytest.mark.parametrize("page", GUIDE, ids=lambda p: p.name)
def test_a_page_of_the_guide_is_read_in_minutes(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    prose = BLOCK.sub("", text)
    assert len(text.split()) <= 800
    assert len(prose.split()) >= 300
    assert BLOCK.search(text) is not None  # an example


@pytest.mark.parametrize("page", MEASURED, ids=lambda p: p.name)
def test_a_measured_page_names_the_command_that_writes_it(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    shell = "\n".join(found for kind, found in BLOCK.findall(text) if kind == "bash")
    writes = False
    for line in shell.replace("\\\n", " ").splitlines():
        program, named, *_ = words = shlex.split(line, comments=True)
        if program == "gsfluent":
            assert named in VERBS
            continue
        assert program in ("python", "bash") and (ROOT / named).is_file(), line
        source = (ROOT / named).read_text(encoding="utf-8")
        options = [word for word in words if word.startswith("--")]
        assert [word for word in options if not re.search(rf"{word}\b", source)] == []
        writes |= f"docs/measured/{page.name}" in words or f'"{page.name}"' in source
    assert writes, f"no command of {page.name} writes it"
    assert MARKED.search(text) is not None


@pytest.mark.parametrize("page", MEASURED, ids=lambda p: p.name)
def test_no_table_of_a_measured_page_is_typed_in(page: Path) -> None:
    typed = MARKED.sub("", page.read_text(encoding="utf-8"))
    assert re.findall(r"^\|.*", typed, re.MULTILINE) == []


def test_the_index_of_what_is_measured_is_made_from_the_pages() -> None:
    folder = ROOT / "docs" / "measured"
    made = load_script("pictures/measured_index").index(folder)
    assert f"begin -->\n{made}\n<!--" in (folder / "README.md").read_text(encoding="utf-8")
