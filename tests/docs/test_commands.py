"""Every command of README, CONTRIBUTING and guide is run, on small inputs of the names there."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml
from page_blocks import blocks_of, run_blocks

from gsfluent.cli import main
from gsfluent.config import Shot, load_shot
from gsfluent.run import demo as run_demo
from gsfluent.run import from_input
from gsfluent.sweep.attempt import DONE, attempt
from gsfluent.sweep.axes import draw
from gsfluent.sweep.engine import Outcome
from gsfluent.sweep.folder import SweepFolder
from gsfluent.sweep.tasks import read_sweep

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs/guide").glob("*.md"))]
TINY_DEMO = run_demo.DemoSize(9, 64, 40, 1500, 24, "preview", (64, 48), 0.3, 10.0)

SMALLER: dict[str, list[list[str]]] = {
    "demo": [["--size", "preview"]],
    "reconstruct": [["--iterations", "20"], ["--max-gaussians", "900"]],
    "fill": [["--resolution", "24"]],
    "mesh": [["--resolution", "24"]],
    "plan": [["--no-probe"]],
    "chart": [["--quick"]],
}
"""Flags that a command gets to be quick, unless its line has them already."""

NEEDS = {"sdxl-inpainting": "transformers", "poses photos": "pycolmap"}
"""What an example names that only an extra can read."""

LOOKS_ONLY = {"doctor", "plan", "metrics"}
"""Verbs that write no file."""


def blocks(kind: str) -> list[tuple[Path, str]]:
    return [(page, text) for page in PAGES for text in blocks_of(page, kind)]


def lines() -> list[list[str]]:
    """Words of every line of every bash block, each once."""
    words = (
        shlex.split(line, comments=True) for _, text in blocks("bash") for line in text.splitlines()
    )
    return [list(found) for found in dict.fromkeys(tuple(w) for w in words if w)]


BENCH = ROOT / "docs" / "guide" / "fracturebench.md"
COMMANDS = [words[1:] for words in lines() if words[0] == "gsfluent"]
OTHERS = [
    words for words in lines() if words[0] != "gsfluent" and "fracturebench" not in " ".join(words)
]
SERVES = [
    words
    for words in COMMANDS
    if words[0] == "studio" or (words[0] == "view" and "--check" not in words)
]
ENDS = [words for words in COMMANDS if words not in SERVES]


def skip_without_extra(text: str) -> None:
    for word, library in NEEDS.items():
        if word in text:
            pytest.importorskip(library)


def smaller(words: list[str]) -> list[str]:
    more = [flag for flag in SMALLER.get(words[0], []) if flag[0] not in words]
    if words[0] == "texture" and "--exemplar" in words:
        more.append(["--quality", "preview"])
    if "tile=2" in words:
        at = words.index("tile=2")
        words = [*words[:at], "slices=8", "steps=4", *words[at:]]
    return [*words, *(word for flag in more for word in flag)]


def one_by_one(
    function: Any, items: Any, folder: str | Path, *, ids: Any = None, **options: Any
) -> list[Outcome]:
    """A sweep without processes, which would import torch anew."""
    folder = Path(folder)
    place = SweepFolder(folder)
    place.make()
    ids = ids or [str(number) for number in range(len(items))]
    for item, name in zip(items, ids, strict=True):
        assert attempt(folder.absolute(), name, function, item) == DONE
    rows = [place.row(name) or {} for name in ids]
    return [Outcome(row["id"], place.shots / row["id"], row["value"], 1) for row in rows]


def files(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("words", ENDS, ids=" ".join)
def test_command_does_what_it_says(
    words: list[str],
    place: Path,
    small_quality: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    skip_without_extra(" ".join(words))
    monkeypatch.chdir(place)
    monkeypatch.setitem(run_demo.SIZES, "preview", TINY_DEMO)
    monkeypatch.setitem(from_input.SETTINGS, "fill", {"resolution": 24})
    monkeypatch.setitem(from_input.SETTINGS, "solve", {"cells": 8})
    monkeypatch.setitem(from_input.SETTINGS, "output", {"size": [64, 48], "fps": 5, "seconds": 0.8})
    monkeypatch.setattr("gsfluent.sweep.shots.map", one_by_one)
    monkeypatch.setattr("gsfluent.dataset.write.map", one_by_one)
    monkeypatch.setattr("gsfluent.lab.stability.run.sweep_map", one_by_one)
    before = files(place)
    assert main(smaller(words)) == 0
    said = capsys.readouterr().out
    assert said.strip()
    if "--json" in words:
        assert isinstance(json.loads(said), dict)
    changed = [path for path, when in files(place).items() if before.get(path) != when]
    assert changed or words[0] in LOOKS_ONLY or "--plan" in words
    if "-o" in words:
        assert (place / words[words.index("-o") + 1]).exists()


@pytest.mark.parametrize("words", SERVES, ids=" ".join)
def test_page_is_served_until_ctrl_c(
    words: list[str], place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    from gsfluent.studio.serve import Studio
    from gsfluent.viewer.app import App

    served: Any = Studio if words[0] == "studio" else App
    monkeypatch.chdir(place)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    answers: list[int] = []
    serving, over = threading.Event(), threading.Event()
    wait = served.wait

    address = [""]

    def say_so_and_wait(app: Any) -> None:
        address[0] = app.url.replace("localhost", "127.0.0.1")
        serving.set()
        wait(app)

    monkeypatch.setattr(served, "wait", say_so_and_wait)

    def visit() -> None:
        """Ask for the page as soon as it is served, then press Ctrl-C."""
        serving.wait(120.0)
        if over.is_set():
            return
        try:
            with urllib.request.urlopen(address[0], timeout=30) as page:
                answers.append(page.status)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    visitor = threading.Thread(target=visit)
    visitor.start()
    try:
        quiet = [word for word in words if word != "--no-open"]
        code = main([*quiet, "--no-open", "--port", str(port)])
    finally:
        over.set()
        serving.set()
        visitor.join()
    assert answers == [200]
    assert code == 0
    end = time.monotonic() + 10.0
    while True:  # the port is given back
        with socket.socket() as again:
            if again.connect_ex(("127.0.0.1", port)) != 0:
                break
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.parametrize("words", OTHERS, ids=" ".join)
def test_install_line_names_what_is_there(words: list[str]) -> None:
    """What pip and scripts do takes minutes, and CI runs it (.ci/run): here, do the names exist?"""
    while "=" in words[0] and words[0].split("=")[0].isupper():  # NAME=value before a command
        words = words[1:]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    if words[-1] == "dist/*.whl":
        assert "--wheel-dir dist " in (ROOT / "scripts" / "wheel.sh").read_text(encoding="utf-8")
        words = words[:-1]
    if words[:2] == ["pip", "install"]:
        setup = (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")
        for word in words[2:]:
            extras = re.fullmatch(r"\.(?:\[([\w,]+)\])?", word)
            if extras is None:
                assert word in re.findall(r"[\w.=>-]+", setup), f"{word}: setup.sh installs another"
            elif extras.group(1):
                assert set(extras.group(1).split(",")) <= set(project["optional-dependencies"])
        return
    assert words[0] == "bash", f"nothing checks {shlex.join(words)}"
    script = ROOT / words[1]
    subprocess.run(["bash", "-n", str(script)], check=True)
    text = script.read_text(encoding="utf-8")
    for word in words[2:]:
        assert word in text if word.startswith("-") else (ROOT / word).exists()


@pytest.mark.parametrize(("page", "text"), blocks("yaml"), ids=lambda x: getattr(x, "name", ""))
def test_shot_is_a_shot(page: Path, text: str, place: Path) -> None:
    values = yaml.safe_load(text)
    if "shot" in values:
        path = place / f"of_{page.stem}_sweep.yaml"
        path.write_text(text)
        sweep = read_sweep(path, {}, None)
        assert len(draw(sweep.vary, sweep.sample, sweep.count, 0)) == 200
    elif {"capture", "splats", "mesh"} & set(values):
        path = place / f"of_{page.stem}.yaml"
        path.write_text(text)
        assert load_shot(path).events
    else:  # a section alone
        whole: dict[str, Any] = {"splats": "melon.ply", "events": [{"type": "drop", "height": 1.0}]}
        assert Shot.from_dict(whole | values, place) != Shot.from_dict(whole, place)


def test_the_page_of_run_json_names_every_key(place: Path) -> None:
    page = (ROOT / "docs" / "guide" / "run-json.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+)`", page))
    record = json.loads((place / "out" / "run.json").read_text())
    simulation = record["simulation"]
    for part in (record, simulation, simulation["per_frame"], simulation["skipped"]):
        assert set(part) - named == set()


def test_help_of_every_verb_is_served(capsys: pytest.CaptureFixture[str]) -> None:
    verbs = {words[0] for words in COMMANDS}
    assert verbs >= {"doctor", "demo", "run", "view", "export", "chart", "fill", "texture"}
    for verb in sorted(verbs):
        assert main([verb, "--help"]) == 0
        assert "examples:" in capsys.readouterr().out.lower()


def test_any_simulator_takes_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page of FractureBench in its order: scenes, an answer to one of them, scores."""
    monkeypatch.chdir(tmp_path)
    make, score = (
        line
        for page, text in blocks("bash")
        for line in text.splitlines()
        if page == BENCH and not line.startswith("#")
    )

    def run(line: str) -> None:
        """Run it here, with paths of the repository as they are from its root."""
        words = shlex.split(line, comments=True)
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        if words[0].startswith("PYTHONPATH="):
            environment["PYTHONPATH"] = str(ROOT / words.pop(0).split("=")[1])
        assert words[0] == "python"
        words = [str(ROOT / word) if word.startswith("scripts/") else word for word in words]
        subprocess.run([sys.executable, *words[1:]], env=environment, check=True)

    run(make)
    run_blocks(BENCH, tmp_path)
    run(score)
    found = json.loads((tmp_path / "scores.json").read_text())
    assert "bar" in json.dumps(found) and "you" in (tmp_path / "scores.md").read_text()
