"""A sweep over shots: what names them, what they share, what becomes of them."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from gsfluent.data import SURFACE, Gaussians
from gsfluent.errors import InputError, RunError
from gsfluent.figure.page import Page
from gsfluent.io import save_splats
from gsfluent.results.store import StageStore
from gsfluent.sweep import shots
from gsfluent.sweep.bucket import SweepBucket
from gsfluent.sweep.engine import Outcome
from gsfluent.sweep.shots import REFUSED, make_shared_solids, run_sweep, run_task
from gsfluent.sweep.tasks import FILE, Sweep, Task, read_sweep, tasks_of

CPU = torch.device("cpu")


class Silent:
    def task(self, name: str) -> Callable[[int, int, str], None]:
        return lambda done, total, note: None


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A shot of a few splats; no test here simulates it."""
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    splats = Gaussians.from_colors(points, torch.full((40,), 0.1), points, label=SURFACE)
    save_splats(splats, tmp_path / "ball.ply")
    shot = {"splats": "ball.ply", "events": [{"type": "drop", "height": 1.0}], "size": 0.2}
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(shot))
    return tmp_path


def sweep_of(place: Path, **values: Any) -> Sweep:
    (place / "sweep.yaml").write_text(yaml.safe_dump({"shot": "shot.yaml", **values}))
    return read_sweep(place / "sweep.yaml", {}, None)


def tasks(place: Path, seed: int = 0, **values: Any) -> list[Task]:
    return tasks_of(sweep_of(place, **values), place / "out", device="cpu", seed=seed)


def test_shots_are_named_by_what_goes_in(place: Path) -> None:
    vary = {"events.drop.height": [0.5, 1.0], "seed": {"range": [0, 2]}}
    first = tasks(place, vary=vary)
    assert len({task.id for task in first}) == 4
    assert len({task.solids for task in first}) == len({task.object for task in first}) == 1
    assert [task.shot().events[0].height for task in first] == [0.5, 0.5, 1.0, 1.0]  # type: ignore[union-attr]
    # more of them keep their names, and so do shots found by another way
    more = tasks(place, vary=vary | {"events.drop.height": [1.0, 2.0, 0.5]})
    assert {task.id for task in first} < {task.id for task in more}
    moved = place / "elsewhere"
    moved.mkdir()
    for name in ("shot.yaml", "ball.ply"):
        (moved / name).write_bytes((place / name).read_bytes())
    assert [task.id for task in tasks(moved, vary=vary)] == [task.id for task in first]
    # one without its frames is another: what dropped them cannot give them back
    assert {task.id for task in tasks(place, keep="film", vary=vary)}.isdisjoint(
        t.id for t in first
    )
    assert {task.id for task in tasks(place, seed=1, vary=vary)}.isdisjoint(t.id for t in first)


def test_what_makes_another_solid_is_made_for_itself(place: Path) -> None:
    vary = {
        "objects.object.young_modulus": {"log_uniform": [1e4, 1e5]},
        "fill.resolution": [16, 20],
    }
    found = tasks(place, vary=vary, sample="random", count=12)
    assert len(found) == 12
    by_fill = {(task.solids, task.changes["fill.resolution"]) for task in found}
    assert len(by_fill) == 2


def test_the_list_is_found_again_until_something_changes(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vary = {"events.drop.height": [0.5, 1.0]}
    first = [task.id for task in tasks(place, vary=vary)]
    looked: list[int] = []
    sweep = sweep_of(place, vary=vary)

    def again() -> list[str]:
        looked.clear()
        found = tasks_of(
            sweep, place / "out", device="cpu", seed=0,
            progress=lambda done, total, note: looked.append(done),
        )  # fmt: skip
        return [task.id for task in found]

    assert again() == first and looked == []
    points = torch.zeros(3, 3)
    save_splats(
        Gaussians.from_colors(points, torch.full((3,), 0.1), points, label=SURFACE),
        place / "ball.ply",
    )
    assert set(again()).isdisjoint(first) and looked == [1, 2]
    (place / "out" / FILE).unlink()
    second = again()
    assert looked == [1, 2] and second == again()


def test_equal_draws_are_one_shot(place: Path) -> None:
    found = tasks(place, vary={"events.drop.height": [0.5, 1.0]}, sample="random", count=20)
    assert len(found) == 2


def test_a_shot_that_cannot_be_is_named_before_any_begins(place: Path) -> None:
    with pytest.raises(InputError, match=r"shot 1 \(solve.cells -3\): solve.cells"):
        tasks(place, vary={"solve.cells": [8, -3]})
    with pytest.raises(InputError, match=r"sweep\.yaml: vari: unknown key"):
        tasks(place, vari={})
    with pytest.raises(InputError, match="nothing differs"):
        read_sweep(place / "shot.yaml", {}, None)
    sweep_of(place, vary={"seed": [1]})
    with pytest.raises(InputError, match="are for a shot"):
        read_sweep(place / "sweep.yaml", {}, 3)
    made = read_sweep(place / "shot.yaml", {"solve.cells": [8, 9]}, 3)
    assert [axis.values for axis in made.vary] == [(8, 9), (0, 1, 2)]


def test_a_stage_is_done_once_for_all_and_anew_where_it_was_damaged(tmp_path: Path) -> None:
    done: list[str] = []

    def work(folder: Path) -> dict[str, Any]:
        done.append(folder.parts[-3])
        (folder / "solid.npz").write_text("solid")
        return {"volume": 1}

    def stored(name: str) -> StageStore:
        return StageStore(tmp_path / name / "stages", shared=tmp_path / "shared")

    first = stored("a").run("fill", "key", work)
    second = stored("b").run("fill", "key", work)
    assert done == ["a"] and second.resumed and not first.resumed
    assert second.report == {"volume": 1}
    assert (second.folder / "solid.npz").samefile(first.folder / "solid.npz")
    stored("b").run("fill", "other", work)
    assert done == ["a", "b"] and (first.folder / "solid.npz").exists()
    (first.folder / "solid.npz").write_text("solip")  # and so the file of all who linked it
    assert stored("c").run("fill", "key", work).redone
    assert stored("d").run("fill", "key", work).resumed and done == ["a", "b", "c"]


def test_solids_are_made_once_and_the_seed_moves_only_what_comes_after(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def solids(context: Any) -> None:
        def work(folder: Path) -> dict[str, Any]:
            (folder / "object.ply").write_text("object")
            made.append(context.seed)
            return {}

        context.do("isolate", work, "part")

    moved: list[int] = []

    def simulated(context: Any) -> None:
        def work(folder: Path) -> dict[str, Any]:
            moved.append(context.seed)
            return {}

        context.do("simulate", work)

    monkeypatch.setattr(shots, "make_solids", solids)
    monkeypatch.setattr("gsfluent.stages.chain.make_solids", solids)
    monkeypatch.setattr("gsfluent.stages.chain.simulate_stage", simulated)
    for stage in ("render_stage", "export_stage"):
        monkeypatch.setattr(f"gsfluent.stages.chain.{stage}", lambda context: None)
    for name in ("check_shot", "foresee_run", "judge_plan"):
        monkeypatch.setattr(f"gsfluent.run.shot.{name}", lambda *given, **named: None)
    found = tasks(place, vary={"seed": [3, 4]})
    make_shared_solids(found[0], place / "solids")
    lines = [run_task(task, place / task.id) for task in found]
    assert (made, moved) == ([0], [3, 4])
    assert [line["seed"] for line in lines] == [3, 4]
    record = json.loads((place / found[0].id / "run.json").read_text())
    assert record["sweep"] == {"changes": {}, "solids_seed": 0}
    assert not (place / found[0].id / "report.html").exists()  # `gsfluent report` makes one
    assert "report" not in record["outputs"]
    film = dataclasses.replace(found[0].common, keep="film")
    run_task(dataclasses.replace(found[0], common=film), place / "film")
    assert not (place / "film" / "stages").exists()


def test_what_a_shot_is_refused_or_fails_for_is_its_result(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (task,) = tasks(place, vary={"seed": [3]})

    def ends(error: Exception, simulation: dict[str, Any] | None) -> Callable[..., None]:
        def run(shot: Any, out: Path, **options: Any) -> None:
            out.mkdir(exist_ok=True)
            record = {"verdict": "failed", "reason": "NaN", "simulation": simulation, "stages": []}
            (out / "run.json").write_text(json.dumps(record))
            raise error

        return run

    monkeypatch.setattr(shots, "run_shot", ends(InputError("no inside"), None))
    line = run_task(task, place / "a")
    assert (line["verdict"], line["reason"]) == (REFUSED, "no inside")
    frames = {"fragments": [1, 7], "pieces": []}
    failed = {"verdict": "failed", "frames": 2, "per_frame": frames}
    monkeypatch.setattr(shots, "run_shot", ends(RunError("NaN"), failed))
    line = run_task(task, place / "b")
    assert (line["verdict"], line["figures"]["fragments"]) == ("failed", 7)
    monkeypatch.setattr(shots, "run_shot", ends(RunError("disk full"), None))
    with pytest.raises(RunError, match="disk full"):
        run_task(task, place / "c")


def test_a_sweep_leaves_table_sheet_and_failures(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything but the shots themselves, whose places two results and a failure take."""

    def mapped(function: Any, items: Any, folder: Path, *, ids: Any, **options: Any) -> Any:
        outcomes = []
        for task, name in zip(items, ids, strict=True):
            if function is make_shared_solids:
                outcomes.append(Outcome(name, folder, {}))
                continue
            if task.index == 2:
                failure = {"id": name, "kind": "process", "message": "killed by SIGKILL"}
                outcomes.append(Outcome(name, None, failure=failure))
                continue
            where = folder / "shots" / name
            where.mkdir(parents=True)
            verdict = ("clean", REFUSED)[task.index]
            if verdict == "clean":
                (where / "poster.png").touch()
            figures = {"pieces_over_1_percent": 5} if verdict == "clean" else {}
            value = {
                "index": task.index, "seed": task.seed, "object": task.object, "reason": "why",
                "changes": task.changes, "verdict": verdict, "figures": figures,
            }  # fmt: skip
            outcomes.append(Outcome(name, where, value, 1))
        return outcomes

    monkeypatch.setattr(shots, "map", mapped)
    out = place / "out"
    sweep = sweep_of(place, vary={"events.drop.height": [0.5, 1.0, 2.0]})
    said = run_sweep(sweep, out, device=CPU, reporter=Silent())
    assert (said["ok"], said["shots"], said["solids"], said["failed"]) == (False, 3, 1, 1)
    assert said["verdicts"] == {"clean": 1, REFUSED: 1}
    with (out / "table.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["vary.events.drop.height"] for row in rows] == ["0.5", "1.0"]
    assert [row["pieces_over_1_percent"] for row in rows] == ["5", ""]
    page = (out / "sheet.html").read_text()
    name = rows[0]["id"]
    assert f'src="shots/{name}/poster.png"' in page and f'href="shots/{name}/video.mp4"' in page
    assert "height 0.5, seed 0, 5 pieces, clean" in page and "killed by SIGKILL" in page
    (failure,) = (out / "failures.jsonl").read_text().splitlines()
    assert json.loads(failure)["kind"] == "process"


def test_a_sweep_in_a_store_leaves_its_table_there(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left: list[str] = []

    def mapped(function: Any, items: Any, folder: Any, *, ids: Any, **options: Any) -> Any:
        left.append(str(folder))
        value = {"index": 0, "seed": 0, "object": "o", "changes": {}, "verdict": "clean"}
        value |= {"reason": "", "figures": {}}
        return [Outcome(name, None, value, 1) for name in ids]

    monkeypatch.setattr("tempfile.tempdir", str(place))
    monkeypatch.setattr(shots, "map", mapped)
    monkeypatch.setattr(SweepBucket, "done", lambda self: set())
    monkeypatch.setattr(SweepBucket, "make", lambda self: None)
    monkeypatch.setattr(
        SweepBucket, "leave", lambda self, paths: left.extend(path.name for path in paths)
    )
    sweep = sweep_of(place, vary={"seed": [3]})
    said = run_sweep(sweep, Path("s3://bucket/drops"), device=CPU, reporter=Silent())
    assert left[:2] == ["s3://bucket/drops/solids", "s3://bucket/drops"]
    assert {"table.csv", "failures.jsonl"} <= set(left) and "sheet" not in said
    assert said["tables"][0] == "s3://bucket/drops/table.csv" and said["ok"]


def test_names_of_pictures_are_no_part_of_a_page() -> None:
    text = Page("t").sheet([('a"b.png', "c.mp4", "<d>")]).render()
    assert 'src="a&quot;b.png"' in text and "<figcaption>&lt;d&gt;</figcaption>" in text
