"""A sweep's shots become samples, and a plain PyTorch loader reads what was written."""

from __future__ import annotations

import importlib.util
import json
import re
import tarfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsfluent.dataset import write
from gsfluent.dataset.write import split_of, write_dataset
from gsfluent.errors import InputError, RunError
from gsfluent.pipeline.render.video import write_video
from gsfluent.sweep.engine import Outcome
from gsfluent.sweep.folder import ROW, SweepFolder

CPU = torch.device("cpu")
TESTS = Path(__file__).resolve().parents[1]
GUIDE = TESTS.parent / "docs" / "guide" / "sweep.md"
OBJECTS = {"one": "melon", "two": "melon", "three": "apple"}


def export_run() -> Any:
    """The run on disk of the tests of exports."""
    spec = importlib.util.spec_from_file_location("export_run", TESTS / "export" / "export_run.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep of three shots, two of one object, and one that has lost its frames."""
    runs, out = export_run(), tmp_path_factory.mktemp("swept")
    width, height = runs.SIZE
    for index, (name, thing) in enumerate([*OBJECTS.items(), ("bare", "melon")]):
        shot = out / "shots" / name
        if name != "bare":
            runs.add_record(runs.make_run(shot))
            record = json.loads((shot / "run.json").read_text())
            record["simulation"] = {"per_frame": {"fragments": [1, 1, 2, 2]}}
            (shot / "run.json").write_text(json.dumps(record))
            grey = [np.full((height, width, 3), 40 * i + 40, np.uint8) for i in range(runs.FRAMES)]
            write_video(shot / "video.mp4", grey, fps=runs.FPS, size=runs.SIZE)
        shot.mkdir(exist_ok=True, parents=True)
        value = {
            "index": 3 - index, "seed": index, "object": thing, "verdict": "clean",
            "changes": {"events.drop.height": 1.0 + index}, "figures": {"fragments": 2},
        }  # fmt: skip
        (shot / ROW).write_text(json.dumps({"id": name, "value": value, "tries": 1}))
    return out


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Samples are made in this process; their names are collected."""
    made: list[str] = []

    def mapped(
        function: Callable[[Any, Path], Any], items: Sequence[Any], folder: Path, *, ids: list[str],
        **options: Any,
    ) -> list[Outcome]:  # fmt: skip
        place = SweepFolder(folder)
        place.make()
        for item, name in zip(items, ids, strict=True):
            if not place.is_done(name):
                made.append(name)
                work = place.begin(name)
                place.finish(name, work, {"id": name, "value": function(item, work)})
        rows = [place.row(name) or {} for name in ids]
        return [Outcome(row["id"], place.shots / row["id"], row["value"]) for row in rows]

    monkeypatch.setattr(write, "map", mapped)
    return made


def test_the_loader_of_the_guide_reads_what_was_written(
    swept: Path, tmp_path: Path, here: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = write_dataset(
        swept, tmp_path / "data", ["webdataset", "huggingface"], device=CPU, shares=(1, 0, 0)
    )
    assert said["samples"] == {"train": 3, "validation": 0, "test": 0}
    assert said["objects"]["train"] == 2
    (block,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    read: dict[str, Any] = {}
    exec(block, read)
    samples = read["samples"]
    assert [sample["json"]["id"] for sample in samples] == ["three", "two", "one"]  # as drawn
    runs = export_run()
    width, height = runs.SIZE
    for sample in samples:
        assert sample["mp4"].shape == (runs.FRAMES, height, width, 3)
        levels = sample["mp4"].float().mean(dim=(1, 2, 3))
        assert (levels - torch.tensor([40.0, 80.0, 120.0, 160.0])).abs().max() < 4
        depth, flow, labels = (sample[name] for name in ("depth", "flow", "labels"))
        assert depth.shape == labels.shape == flow.shape[:3] == (runs.FRAMES, height, width)
        assert bool((depth[labels > 0] > 0).all()) and not bool(depth[labels == 0].any())
        assert 0.05 < float((labels > 0).float().mean()) < 0.95
        assert bool(flow[0].any()) and not bool(flow[-1].any())
        known = sample["json"]
        assert len(known["cameras"]) == len(known["times"]) == runs.FRAMES
        assert known["per_frame"]["fragments"] == [1, 1, 2, 2]
        # pieces come when they come apart, and all that is seen is told
        told = {row["label"]: row["what"] for row in known["labels"]}
        assert set(labels.unique().tolist()) <= set(told)
        assert int(labels[0].max()) == 3 and int(labels[2].max()) == 4 and told[4] == "piece"


def test_a_depth_is_that_of_the_saved_camera(swept: Path, tmp_path: Path, here: list[str]) -> None:
    write_dataset(swept, tmp_path, device=CPU)
    folder = tmp_path / "samples" / "shots" / "one"
    known = json.loads((folder / "one.json").read_text())
    depth = np.load(folder / "one.depth.npz")["depth"].astype(float)
    rows, columns = np.nonzero(depth[0])
    z = depth[0][rows, columns]
    view, lens = (np.array(known["cameras"][0][name]) for name in ("viewmat", "K"))
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))])
    seen = np.linalg.solve(lens, pixels) * z
    world = view[:3, :3].T @ (seen - view[:3, 3:])
    # the ball of the run stands 0.5 m up and is 0.3 m wide, splats apart
    assert np.abs(world.mean(axis=1) - [0.0, 0.0, 0.5]).max() < 0.2
    assert np.linalg.norm(world - [[0.0], [0.0], [0.5]], axis=0).max() < 0.45


def test_an_object_is_in_one_split_and_stays_there(
    swept: Path, tmp_path: Path, here: list[str]
) -> None:
    melon, apple = (split_of(name, (0.5, 0.0, 0.5)) for name in ("melon", "apple"))
    things = [f"object {i}" for i in range(300)]
    shares = (0.6, 0.3, 0.1)
    found = [split_of(thing, shares) for thing in things]
    for split, share in zip(write.SPLITS, shares, strict=True):
        assert abs(found.count(split) / len(things) - share) < 0.1
    assert {split_of(thing, (0.0, 0.0, 1.0)) for thing in things} == {"test"}
    said = write_dataset(swept, tmp_path, ["huggingface"], device=CPU, shares=(0.5, 0.0, 0.5))
    assert said["samples"] == {
        split: 2 * (melon == split) + (apple == split) for split in write.SPLITS
    }
    # other shares move samples and draw none anew
    drawn = list(here)
    write_dataset(swept, tmp_path, ["huggingface"], device=CPU, shares=(0.0, 1.0, 0.0))
    assert here == drawn
    folder = tmp_path / "huggingface"
    assert {path.name for path in folder.iterdir()} == {"README.md", "channels", "validation"}
    lines = (folder / "validation" / "metadata.jsonl").read_text().splitlines()
    for line in map(json.loads, lines):
        assert (folder / "validation" / line["file_name"]).is_file()
        assert (folder / line["depth"]).is_file() and (folder / line["json"]).is_file()
    assert len(lines) == 3 and "path: validation/*" in (folder / "README.md").read_text()


def test_tars_hold_whole_samples_and_the_same_bytes(
    swept: Path, tmp_path: Path, here: list[str]
) -> None:
    def tars(shard: int) -> dict[str, bytes]:
        write_dataset(swept, tmp_path, device=CPU, shares=(1, 0, 0), shard=shard)
        return {p.name: p.read_bytes() for p in sorted((tmp_path / "webdataset").iterdir())}

    many = tars(1)
    assert list(many) == [f"train-00000{i}.tar" for i in range(3)]
    for name in many:
        with tarfile.open(tmp_path / "webdataset" / name) as tar:
            names = tar.getnames()
        assert len(names) == 5 and len({name.partition(".")[0] for name in names}) == 1
    assert list(tars(10**9)) == ["train-000000.tar"]  # those of the longer set are gone
    assert tars(1) == many


def test_what_is_no_sweep_is_refused(swept: Path, tmp_path: Path) -> None:
    for sweep, words in ((tmp_path, "not the folder of a sweep"), (swept, "shares")):
        with pytest.raises(InputError, match=words):
            write_dataset(sweep, tmp_path / "data", device=CPU, shares=(1, 1, 1) if sweep is swept
                          else (1, 0, 0))  # fmt: skip
    with pytest.raises(InputError, match="--format"):
        write_dataset(swept, tmp_path, ["zip"], device=CPU)
    (tmp_path / "shots").mkdir()
    with pytest.raises(InputError, match="no finished shot with its frames"):
        write_dataset(tmp_path, tmp_path / "data", device=CPU)


def test_a_sample_that_cannot_be_made_is_named(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failure = {"message": "no readable frame"}
    monkeypatch.setattr(
        write, "map", lambda *given, **named: [Outcome("one", None, failure=failure)]
    )
    with pytest.raises(RunError, match=r"1 samples could not be made; one: no readable frame"):
        write_dataset(swept, tmp_path, device=CPU)
