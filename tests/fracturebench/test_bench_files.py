"""Files of FractureBench: scenes and runs there and back, frozen scenes, scorer without torch."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import math
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from in_process import swept

from gsfluent.fracturebench.__main__ import main
from gsfluent.fracturebench.registry import cases, find, judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene, SceneError, quantised
from gsfluent.lab.frozen.answer import clock, run_case

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "scripts" / "fracturebench"


@pytest.fixture(scope="module")
def scripts() -> Callable[[str], ModuleType]:
    sys.path.insert(0, str(SCRIPTS))

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    return load


@pytest.fixture(scope="module")
def scene() -> Scene:
    return find("bar").build(1 / 8, 8)


@pytest.fixture(scope="module")
def run(scene: Scene) -> Run:
    return run_case(scene)


def test_scene_and_run_come_back_as_they_went(scene: Scene, run: Run, tmp_path: Path) -> None:
    again = Scene.load(scene.save(tmp_path / "bar.npz"))
    for field in dataclasses.fields(Scene):
        a, b = getattr(scene, field.name), getattr(again, field.name)
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b, field.name
    assert again.digest() == scene.digest()
    held = dataclasses.replace(run, stress=np.ones((*run.x.shape[:2], 6)), settings={"dx": 0.1})
    back = Run.load(held.save(tmp_path / "run.npz"))
    for field in dataclasses.fields(Run):
        a, b = getattr(held, field.name), getattr(back, field.name)
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b, field.name
    assert [m.error for m in judge(again, back)] == [m.error for m in judge(scene, run)]


def test_strain_at_the_start_is_part_of_a_scene(scene: Scene, tmp_path: Path) -> None:
    strained = dataclasses.replace(scene, strain=np.full((scene.count, 6), 1e-3))
    again = Scene.load(strained.save(tmp_path / "bar.npz"))
    assert again.strain is not None and np.array_equal(again.strain, strained.strain)
    assert again.digest() == strained.digest() != scene.digest()
    with pytest.raises(SceneError, match="strain has shape"):
        dataclasses.replace(scene, strain=np.zeros((scene.count, 3)))


def test_digest_sees_a_change_but_no_rounding(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    rounded = dataclasses.replace(
        scene, v=scene.v * (1.0 + 1e-15 * rng.standard_normal(scene.v.shape))
    )
    assert rounded.digest() == scene.digest()
    moved = scene.x.copy()
    moved[7, 1] += 1e-6
    assert dataclasses.replace(scene, x=moved).digest() != scene.digest()
    assert quantised(np.array([0.0, -0.0, 1e-20, 1.0])).tolist() == [0, 0, 0, 2**24]


@pytest.mark.parametrize("name", [c.name for c in cases()])
def test_builders_still_give_what_was_frozen(
    name: str, scripts: Callable[[str], ModuleType]
) -> None:
    frozen = scripts("frozen")
    assert frozen.drift(find(name), frozen.build(find(name))) == []


def test_a_scene_that_drifted_is_not_written(
    scripts: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    make, frozen = scripts("make"), scripts("frozen")
    assert make.make(["pull_apart"], tmp_path / "a", False) == 0
    assert Scene.load(tmp_path / "a" / "pull_apart.npz").name == "pull_apart"
    assert "sha256: " in (tmp_path / "a" / "pull_apart.yaml").read_text()
    other = find("pull_apart").build(0.02, 8)
    monkeypatch.setattr(frozen, "build", lambda case: other)
    assert make.make(["pull_apart"], tmp_path / "b", False) == 1
    assert "points: 1024 frozen, 128 built" in capsys.readouterr().err
    assert not (tmp_path / "b" / "pull_apart.npz").exists()


ALONE = """
import runpy, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "scipy", "yaml", "gsfluent", "matplotlib"):
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Block())
sys.argv = ["fracturebench", *sys.argv[1:]]
runpy.run_module("fracturebench", run_name="__main__", alter_sys=True)
"""


def alone(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line where nothing but NumPy and the folder gsfluent/ can be imported."""
    return subprocess.run(
        [sys.executable, "-c", ALONE, *arguments], capture_output=True, text=True, timeout=120,
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT / "gsfluent")},
    )  # fmt: skip


def test_scorer_needs_only_numpy(scene: Scene, run: Run, tmp_path: Path) -> None:
    scene.save(tmp_path / "scenes" / "bar.npz")
    run.save(tmp_path / "runs" / "gsfluent" / "bar.npz")
    table, values = tmp_path / "out" / "t.md", tmp_path / "out" / "s.json"
    done = alone(
        "score", str(tmp_path / "scenes"), str(tmp_path / "runs"), "--json", str(values),
        "--markdown", str(table),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "gsfluent: " in done.stdout
    (row,) = json.loads(values.read_text())
    assert row["measures"][0]["error"] == pytest.approx(judge(scene, run)[0].error)
    assert table.read_text().count("\n") == 2 + len(row["measures"])


def test_the_example_of_the_docs_is_a_submission(
    scene: Scene, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    page = (ROOT / "docs" / "guide" / "fracturebench.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    scene.save("scenes/bar.npz")
    exec(example, {"simulate": lambda *given: (run.x, run.v)})
    assert main(["score", "scenes", "runs"]) == 0
    assert "| bar | you |" in capsys.readouterr().out


def test_help_teaches_the_format() -> None:
    done = alone("score", "--help")
    assert done.returncode == 0
    said = " ".join(done.stdout.split())
    for word in ("x [T, N, 3]", "wall_seconds", "Exit status", "SCENES", "RUNS"):
        assert word in said
    listed = alone("list").stdout
    assert all(c.name in listed for c in cases())


def archive(**entries: bytes) -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as file:
        for name, data in entries.items():
            file.writestr(f"{name}.npy", data)
    return held.getvalue()


def saved(**arrays: object) -> bytes:
    held = io.BytesIO()
    np.savez(held, **arrays)  # type: ignore[arg-type]
    return held.getvalue()


BROKEN: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "empty": (lambda b: b"", "not a run"),
    "text": (lambda b: b"positions: 1 2 3", "not a run"),
    "cut": (lambda b: b[: len(b) // 2], "not a run"),
    "cut_at_the_end": (lambda b: b[:-10], "not a run"),
    "flipped": (lambda b: b[:5000] + bytes(2000) + b[7000:], "not a run"),
    "no_header": (lambda b: saved(x=np.zeros(3), v=np.zeros(3), times=np.zeros(1)), "header"),
    "header_short": (
        lambda b: saved(header="{}", x=np.zeros(3), v=np.zeros(3), times=np.zeros(1)),
        "lacks scene, method, wall_seconds, steps",
    ),
    "header_no_object": (
        lambda b: saved(header="[1, 2]", x=np.zeros(3), v=np.zeros(3), times=np.zeros(1)),
        "not a run",
    ),
    "no_numbers": (
        lambda b: saved(header="{}", x=np.array(["a"]), v=np.zeros(3), times=np.zeros(1)),
        "not a run",
    ),
    "pickled": (lambda b: saved(header=np.array({}, dtype=object)), "not a run"),
    "no_array": (lambda b: archive(header=b"junk"), "not a run"),
    "single_array": (
        lambda b: (h := io.BytesIO(), np.save(h, np.zeros(3)), h.getvalue())[2],
        "not a run",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_an_error_that_says_which(
    name: str, scene: Scene, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.save(tmp_path / "scenes" / "bar.npz")
    good = run.save(tmp_path / "runs" / "good.npz")
    spoil, said = BROKEN[name]
    (tmp_path / "runs" / "bad.npz").write_bytes(spoil(good.read_bytes()))
    assert main(["score", str(tmp_path / "scenes"), str(tmp_path / "runs")]) == 1
    out, err = capsys.readouterr()
    assert "| bar | gsfluent |" in out  # the good one is judged all the same
    assert "bad.npz" in err and said in err and "Traceback" not in err


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda r: dataclasses.replace(r, scene="cube"), "answers 'cube'; the scenes are bar"),
        (lambda r: dataclasses.replace(r, x=r.x[:, 1:], v=r.v[:, 1:]), "x has shape"),
        (lambda r: dataclasses.replace(r, times=r.times + 1.0), "other times"),
        (
            lambda r: dataclasses.replace(r, settings={"sha256": "0"}),
            "another version of the scene",
        ),
        (lambda r: r, "a second run of 'bar' by 'gsfluent'"),
    ],
)
def test_a_run_of_something_else_is_an_error(
    change: Callable[[Run], Run], said: str, scene: Scene, run: Run, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    scene.save(tmp_path / "scenes" / "bar.npz")
    run.save(tmp_path / "runs" / "a.npz")
    change(run).save(tmp_path / "runs" / "b.npz")
    assert main(["score", str(tmp_path / "scenes"), str(tmp_path / "runs")]) == 1
    assert said in capsys.readouterr().err


def test_a_run_that_broke_off_is_judged_so(
    scene: Scene, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.save(tmp_path / "scenes" / "bar.npz")
    lost = dataclasses.replace(run, x=np.full_like(run.x, math.nan), failed="left the grid")
    lost.save(tmp_path / "runs" / "a.npz")
    values = tmp_path / "s.json"
    assert (
        main(["score", str(tmp_path / "scenes"), str(tmp_path / "runs"), "--json", str(values)])
        == 0
    )
    assert "broke off" in capsys.readouterr().out
    assert json.loads(values.read_text())[0]["measures"][0]["error"] is None


def test_scenes_that_are_missing_or_changed(
    scene: Scene, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes, runs = tmp_path / "scenes", tmp_path / "runs"
    assert main(["score", str(scenes), str(runs)]) == 2
    assert "make.py" in capsys.readouterr().err
    scene.save(scenes / "bar.npz")
    assert main(["score", str(scenes), str(runs)]) == 2
    assert "no runs" in capsys.readouterr().err
    run.save(runs / "bar.npz")
    (scenes / "bar.yaml").write_text(f"sha256: {'0' * 64}\n")
    assert main(["score", str(scenes), str(runs)]) == 2
    assert "frozen" in capsys.readouterr().err
    (scenes / "bar.npz").write_bytes(b"PK")
    assert main(["score", str(scenes), str(runs)]) == 2
    assert "not a scene" in capsys.readouterr().err


def test_scene_of_wrong_shape_is_refused(scene: Scene) -> None:
    with pytest.raises(SceneError, match="volume has shape"):
        dataclasses.replace(scene, volume=scene.volume[1:])
    with pytest.raises(SceneError, match="not finite"):
        dataclasses.replace(scene, v=scene.v * math.nan)
    with pytest.raises(SceneError, match="rising times"):
        dataclasses.replace(scene, times=scene.times[::-1])


def test_clock_goes_straight_to_the_end(scene: Scene) -> None:
    seconds = clock(scene, 2)
    assert len(seconds) == 2 and all(0.0 < s < math.inf for s in seconds)
    straight = run_case(dataclasses.replace(scene, times=scene.times[-1:]))
    assert straight.steps < run_case(scene).steps  # stops shorten steps
    with pytest.raises(ValueError, match="repeat"):
        clock(scene, 0)


def test_one_table_of_several_methods(
    scripts: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    table, run_gsfluent = scripts("table"), scripts("run_gsfluent")
    runs, page, records = tmp_path / "runs", tmp_path / "p.md", tmp_path / "r.jsonl"
    page.write_text("# FractureBench\n")

    def call(module: ModuleType, *arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["x", *arguments])
        return int(module.main())

    given = ("pull_apart", "covariance_transport", "-o", str(runs), "--repeat", "1")
    assert call(run_gsfluent, *given) == 0
    assert call(run_gsfluent, *given) == 0
    assert "is there" in capsys.readouterr().err
    alone = Run.load(runs / "gsfluent" / "pull_apart.npz")
    (runs / "gsfluent" / "pull_apart.npz").unlink()
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(run_gsfluent, "sweep_map", swept(calls))
    assert call(run_gsfluent, *given, "--on", "slurm") == 0  # by a sweep: the same answer
    placed = Run.load(runs / "gsfluent" / "pull_apart.npz")
    assert calls[0]["on"] == "slurm" and np.array_equal(placed.x, alone.x)
    capsys.readouterr()
    assert call(run_gsfluent, *given, "--cfl", "0.25") == 2  # another setting under the same name
    assert "--method" in capsys.readouterr().err
    glued = Run.load(runs / "gsfluent" / "pull_apart.npz")
    glued = dataclasses.replace(glued, method="glue", v=0.5 * glued.v)
    glued.save(runs / "glue" / "pull_apart.npz")
    drawn = ("--records", str(records), "--page", str(page))
    assert call(table, str(runs), *drawn) == 0
    first = page.read_text()
    assert "| gsfluent, cpu | glue, cpu |" in first
    assert "| pull_apart | 0.001 | **" in first and "| 0.5 (0/1) |" in first
    assert call(table, *drawn) == 0  # from the records alone
    assert page.read_text() == first
    (runs / "glue" / "bar.npz").write_bytes(b"")
    assert call(table, str(runs), *drawn) == 1
    assert len(records.read_text().splitlines()) == 3
    # a peer's records of a ladder: the frozen resolution counts, and of its variants the best
    lines = []
    for dx, points, variant, error in (
        (0.02, 128, "a", 1e-4), (0.01, 1024, "a", 0.3), (0.01, 1024, "b", 0.2), (0.01, 9, "c", 0.1),
    ):  # fmt: skip
        line = next(
            r for r in map(json.loads, records.read_text().splitlines()) if r["method"] == "glue"
        )
        line |= {"method": "peer", "points": points, "variant": variant, "error": error}
        line["settings"] = {"dx": dx}
        lines.append(json.dumps(line) + "\n")
    peers = tmp_path / "peers.jsonl"
    peers.write_text("".join(lines))
    assert call(table, str(peers), *drawn) == 0
    assert "| gsfluent, cpu | glue, cpu | peer, cpu |" in page.read_text()
    assert "| 0.5 (0/1) | 0.2 (0/1) |" in page.read_text()


def test_ladder_and_references_enter_the_page(
    scripts: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ladder, page = scripts("ladder"), tmp_path / "p.md"
    monkeypatch.setattr(sys, "argv", ["x", "pull_apart", "--page", str(page)])
    assert ladder.main() == 0
    text = page.read_text()
    assert "(128)," in text and "| exact |" in text and "Hertz" in text
    dx = [0.4, 0.2, 0.1]
    assert ladder.order(dx, [3.0 * h**1.5 for h in dx]) == pytest.approx(1.5)
    assert math.isnan(ladder.order(dx, [1e-8, 1e-8, 1e-8]))
    assert math.isnan(ladder.order(dx, [0.1, 0.1, math.inf]))
