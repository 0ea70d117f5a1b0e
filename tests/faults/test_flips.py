"""A flipped bit, a lost file, a record by hand: none is believed, all is done anew and said."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fault_harm import flip, flips
from fault_shot import redone, results, run

from gsfluent.errors import RunError
from gsfluent.io import load_image
from gsfluent.results.digests import RECORD, Journal, read_record, write_record
from gsfluent.results.store import StageStore
from gsfluent.stages.show import render_again

STAGES = ("isolate", "fill", "texture", "simulate", "render")


class Begun(Exception):
    """A stage was not taken up but begun, with these files in its folder."""


def begin(folder: Path) -> dict[str, Any]:
    raise Begun(sorted(path.name for path in folder.iterdir()))


@pytest.mark.parametrize("stage", STAGES)
def test_every_flip_in_a_finished_stage_is_noticed(
    stage: str, finished: Path, tmp_path: Path
) -> None:
    source = finished / "stages" / stage
    key = json.loads((source / RECORD).read_text())["fingerprint"]
    names = [path.name for path in source.iterdir()]
    assert RECORD in names and len(names) > 2
    shutil.copytree(source, tmp_path / stage)
    assert StageStore(tmp_path).run(stage, key, begin).resumed
    for name, place in flips(source, names, 12):
        shutil.rmtree(tmp_path / stage)
        shutil.copytree(source, tmp_path / stage)
        flip(tmp_path / stage / name, place)
        store = StageStore(tmp_path)
        with pytest.raises(Begun, match=r"\['stage.json', 'written.txt'\]"):
            store.run(stage, key, begin)
        assert name in store.results[0].redone


def test_every_flip_in_a_stage_at_work_is_noticed(stopped: Path, tmp_path: Path) -> None:
    source = stopped / "stages" / "simulate"
    key = json.loads((source / RECORD).read_text())["fingerprint"]
    names = sorted(path.name for path in source.iterdir())
    assert {"state.pt", "frame_0001.npz", "strikes.json", "written.txt"} < set(names)
    for name, place in [*flips(source, names, 12), ("", 0)]:
        shutil.rmtree(tmp_path / "simulate", ignore_errors=True)
        shutil.copytree(source, tmp_path / "simulate")
        if name:
            flip(tmp_path / "simulate" / name, place)
        store = StageStore(tmp_path)
        with pytest.raises(Begun) as begun:
            store.run("simulate", key, begin)
        if name:  # begun anew, and said
            assert "frame_0001.npz" not in begun.value.args[0] and store.results[0].redone
        else:  # nothing is wrong: it goes on
            assert begun.value.args[0] == names and not store.results[0].redone


def test_a_stopped_run_goes_on_to_the_same_bits(
    stopped: Path, finished: Path, shot: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(stopped, out)
    first = (out / "stages" / "simulate" / "frame_0001.npz").stat().st_mtime_ns
    assert redone(run(shot, out)) == []
    assert (out / "stages" / "simulate" / "frame_0001.npz").stat().st_mtime_ns == first
    assert results(out) == results(finished)


def test_a_flip_in_the_state_of_a_stopped_run_begins_it_anew_to_the_same_bits(
    stopped: Path, finished: Path, shot: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(stopped, out)
    state = out / "stages" / "simulate" / "state.pt"
    flip(state, 8 * (state.stat().st_size // 2))
    values = run(shot, out)
    assert redone(values) == ["simulate"] and values["verdict"] == "clean"
    assert "simulate was done anew: state.pt differs from its digest" in values["reason"]
    assert results(out) == results(finished)


def _by_hand(path: Path) -> None:
    key = json.loads(path.read_text())["fingerprint"]
    path.write_text(json.dumps({"fingerprint": key, "complete": True, "verdict": "clean"}))


DAMAGE: dict[str, Callable[[Path], None]] = {
    "isolate/object.ply": lambda path: flip(path, 8 * 5000),
    "fill/stage.json": _by_hand,
    "texture/ball.ply": lambda path: flip(path, 8 * 9000 + 3),
    "simulate/frame_0002.npz": lambda path: path.unlink(),
    "render/video.mp4": lambda path: path.write_text("junk"),
}


def test_damage_in_every_stage_is_redone_to_the_same_bits(
    finished: Path, shot: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    for name, damage in DAMAGE.items():
        damage(out / "stages" / name)
    values = run(shot, out)
    assert redone(values) == list(STAGES) and values["verdict"] == "clean"
    for name in DAMAGE:
        stage, _, file = name.partition("/")
        assert file in next(s["redone"] for s in values["stages"] if s["name"] == stage)
        assert any(file in record.message for record in caplog.records)
        assert f"{stage} was done anew" in values["reason"]
    assert results(out) == results(finished)
    assert not any(stage.get("redone") for stage in run(shot, out)["stages"])


def test_only_the_damaged_stage_is_redone(finished: Path, shot: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    flip(out / "stages" / "fill" / "ball.volume.npz", 8 * 100)
    values = run(shot, out)
    assert redone(values) == ["fill"]
    assert [s["name"] for s in values["stages"] if not s["resumed"]] == ["fill"]
    assert results(out) == results(finished)


def test_other_verbs_refuse_what_is_damaged(finished: Path, tmp_path: Path) -> None:
    import torch

    out = tmp_path / "out"
    shutil.copytree(finished, out)
    render_again(out, device=torch.device("cpu"), frame=1, to=tmp_path / "a.png")
    assert load_image(tmp_path / "a.png").shape[:2] == (32, 32)
    flip(out / "stages" / "simulate" / "frame_0003.npz", 8 * 4000)
    with pytest.raises(RunError, match=r"frame_0003\.npz .* differs") as caught:
        render_again(out, device=torch.device("cpu"), frame=1, to=tmp_path / "b.png")
    assert "run the shot again" in caught.value.hint and not (tmp_path / "b.png").exists()


def test_a_record_is_read_as_it_was_written_or_not_at_all(tmp_path: Path) -> None:
    values = {"fingerprint": "k", "complete": True, "files": {}, "report": {"a": [1.5, None]}}
    write_record(tmp_path / RECORD, values)
    assert read_record(tmp_path / RECORD) == (values, "")
    bits = 8 * (tmp_path / RECORD).stat().st_size
    for place in range(0, bits, 5):
        flip(tmp_path / RECORD, place)
        assert read_record(tmp_path / RECORD)[0] == {}
        flip(tmp_path / RECORD, place)
    (tmp_path / RECORD).write_text("[" * 100_000)
    assert read_record(tmp_path / RECORD)[0] == {}


@pytest.mark.parametrize("name", ["report", "files", "seconds"])
def test_a_record_without_all_its_values_is_not_believed(name: str, tmp_path: Path) -> None:
    def work(folder: Path) -> dict[str, Any]:
        (folder / "a.ply").write_text("a")
        return {}

    StageStore(tmp_path).run("s", "key", work)
    values, _ = read_record(tmp_path / "s" / RECORD)
    del values[name]
    write_record(tmp_path / "s" / RECORD, values)  # with a digest that fits
    result = StageStore(tmp_path).run("s", "key", work)
    assert not result.resumed and f"without {name}" in result.redone
    assert StageStore(tmp_path).run("s", "key", work).resumed


@pytest.mark.parametrize("seconds", [0, 4e9], ids=["1970", "2096"])
def test_a_clock_that_was_set_changes_nothing(
    seconds: float, finished: Path, shot: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (out / "stages" / f".film.{2**30}.partial.mp4").write_text("of a dead run")
    for path in out.rglob("*"):
        os.utime(path, (seconds, seconds))
    values = run(shot, out)
    assert all(stage["resumed"] for stage in values["stages"]) and redone(values) == []
    assert results(out) == results(finished)  # the half-written film is gone


def test_other_results_of_a_stage_are_built_on_anew(tmp_path: Path) -> None:
    contents = []
    for text in ("one", "two", "two"):

        def work(folder: Path, text: str = text) -> dict[str, Any]:
            (folder / "a.ply").write_text(text)
            (folder / "s.json").write_text(str(len(contents)))  # its own report: times
            return {}

        contents.append(StageStore(tmp_path, force=True).run("s", "key", work).content)
    assert contents[0] != contents[1] == contents[2]


def test_exports_are_compared_too(tmp_path: Path) -> None:
    def work(folder: Path) -> dict[str, Any]:
        from gsfluent.io import write_json

        if not (tmp_path / "frames" / "1.json").exists():
            write_json(tmp_path / "frames" / "1.json", [1, 2, 3])
        return {}

    root = tmp_path / "stages"
    first = StageStore(root).run("export", "key", work)
    assert list(first.files) == ["../../frames/1.json"]
    assert StageStore(root).run("export", "key", work).resumed
    flip(tmp_path / "frames" / "1.json", 3)
    again = StageStore(root).run("export", "key", work)
    assert "1.json" in again.redone and json.loads((tmp_path / "frames" / "1.json").read_text())
    # what is not written again under another key keeps its digest
    other = StageStore(root).run("export", "another", work)
    assert other.files == first.files and not other.redone


def test_a_torn_last_line_is_no_damage(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    folder.mkdir()
    journal = Journal(folder, tmp_path)
    journal.keep({})
    (folder / "a").write_text("whole")
    journal.note(folder / "a", folder / "a")
    with (folder / "written.txt").open("a") as stream:
        stream.write('0123 "b')
    assert Journal(folder, tmp_path).read() == ""
    (folder / "a").unlink()
    assert Journal(folder, tmp_path).read() == "a is missing"
