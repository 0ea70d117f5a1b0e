"""`gsfluent fit`: from a shot and tracks to fitted.yaml, resumed, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from gsfluent.choose.shot import shot_scene
from gsfluent.cli import main
from gsfluent.config import load_shot
from gsfluent.data import Camera, Frame
from gsfluent.draw import draw
from gsfluent.errors import InputError
from gsfluent.fit.job import fitted
from gsfluent.fit.read import read_masks
from gsfluent.geometry import look_at
from gsfluent.io.images import save_image
from gsfluent.pipeline.fit.forward import Forward
from gsfluent.pipeline.fit.laws import with_laws
from gsfluent.pipeline.fit.stage import Found
from gsfluent.pipeline.matter.points import body_frame
from gsfluent.progress import LineReporter
from gsfluent.targets.target import Followers

THROWN = [0.4, -0.2, -1.2]
TIMES = [k / 24 for k in range(7)]


@pytest.fixture(scope="module")
def thrown(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a shot of rubber and the tracks of a stiffer one."""
    folder = tmp_path_factory.mktemp("fit")
    shot: dict[str, Any] = {
        "splats": str(ball), "size": 0.3, "up": "+z", "floor": "auto",
        "fill": {"resolution": 24}, "texture": {"method": "color_copy"},
        "objects": {"it": {"material": "rubber", "law": "elastic", "young_modulus": 5e4,
                           "poisson_ratio": 0.3}},
        "events": [{"type": "drop", "height": 0.05},
                   {"type": "throw", "object": "it", "velocity": [0.1, 0.0, -1.5]}],
        "output": {"seconds": 0.3},
    }  # fmt: skip
    path = folder / "shot.yaml"
    path.write_text(yaml.safe_dump(shot))
    reporter = LineReporter()
    scene, _ = shot_scene(
        load_shot(path), folder / "out", device=torch.device("cpu"), reporter=reporter, make=True
    )
    truth = Forward(scene, TIMES, 0.3 / 5)
    values = {"it.young_modulus": 1.2e5}
    motion = truth.run(values, len(TIMES), truth.step(values))
    np.savez(folder / "track.npz", positions=motion.position[:, ::5].numpy(), times=TIMES)
    return folder


def test_tracks_become_a_shot_that_runs_on(
    thrown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = thrown / "out"
    words = ["fit", str(thrown / "shot.yaml"), "--points", str(thrown / "track.npz")]
    words += ["--learn", "it.young_modulus", "--starts", "1", "--grids", "1", "--cells", "5"]
    words += ["--jobs", "1", "-o", str(out), "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    number = found["parameters"]["it.young_modulus"]
    assert abs(np.log10(number["value"] / 1.2e5)) < 0.05 and found["unidentified"] == {}
    assert json.loads((out / "fit.json").read_text()) == found
    assert "it.young_modulus" in (out / "fit.html").read_text()
    fitted = load_shot(out / "fitted.yaml")
    assert fitted.objects["it"].overrides["young_modulus"] == pytest.approx(number["value"])
    assert [e["type"] for e in yaml.safe_load((out / "fitted.yaml").read_text())["events"]] == [
        "drop",
        "throw",
    ]
    done = list((out / "search").rglob("*"))
    assert main(words) == 0  # nothing is searched again
    assert json.loads(capsys.readouterr().out) == found
    assert sorted(done) == sorted((out / "search").rglob("*"))


def test_a_law_is_found_for_a_shot_of_another(
    thrown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The shot believes in clay: rubber foretells what is seen, and the fitted shot has it."""
    out = thrown / "laws"
    words = yaml.safe_load((thrown / "shot.yaml").read_text())
    words["objects"]["it"] = {"material": "rubber", "law": "von_mises", "young_modulus": 5e4,
                              "poisson_ratio": 0.3, "yield_stress": 2e3}  # fmt: skip
    (thrown / "clay.yaml").write_text(yaml.safe_dump(words))
    command = ["fit", str(thrown / "clay.yaml"), "--points", str(thrown / "track.npz")]
    command += ["--laws", "elastic, fluid", "--starts", "1", "--grids", "1", "--cells", "5"]
    assert main([*command, "--jobs", "1", "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["laws"]["it"]["taken"] == "elastic"
    assert set(found["laws"]["it"]["tried"]) == {"elastic", "fluid"}
    assert "Law of it" in (out / "fit.html").read_text()
    fitted = load_shot(out / "fitted.yaml").objects["it"].overrides
    assert fitted["law"] == "elastic" and "yield_stress" not in fitted
    assert fitted["young_modulus"] == found["parameters"]["it.young_modulus"]["value"]


def test_a_fitted_shot_says_what_its_parts_are(thrown: Path, tmp_path: Path) -> None:
    words = yaml.safe_load((thrown / "shot.yaml").read_text())
    where = {"sphere": [0.0, 0.0, 0.1, 0.1]}
    words["objects"]["it"]["parts"] = [{"name": "core", "where": where, "young_modulus": 1e5}]
    (thrown / "parts.yaml").write_text(yaml.safe_dump(words))
    shot = load_shot(thrown / "parts.yaml")
    scene, _ = shot_scene(
        shot, thrown / "out", device=torch.device("cpu"), reporter=LineReporter(), make=True
    )
    laws = {"it": "elastic", "it/core": "von_mises"}
    found = Found(
        {"it/core.young_modulus": 2e5}, {}, {}, {}, with_laws(scene, laws), {}, laws
    )  # fmt: skip
    path = tmp_path / "fitted.yaml"
    path.write_text(yaml.safe_dump(fitted(shot, found)))
    core = load_shot(path).objects["it"]
    entry = yaml.safe_load(path.read_text())["objects"]["it"]["parts"][0]
    assert entry["law"] == "von_mises" and entry["young_modulus"] == 2e5
    assert entry["where"] == where and entry["yield_stress"] == 1e-2 * 1e5
    assert core.overrides["law"] == "elastic"


@pytest.fixture(scope="module")
def films(thrown: Path) -> tuple[Path, Path]:
    """Masks of the thing, thrown faster, from two cameras in the frame of the splats."""
    shot = load_shot(thrown / "shot.yaml")
    scene, _ = shot_scene(
        shot, thrown / "out", device=torch.device("cpu"), reporter=LineReporter(), make=True
    )
    truth = Forward(scene, TIMES, 0.3 / 5)
    values = {"it.velocity": THROWN, "floor.offset": 0.4}
    motion = truth.run(values, len(TIMES), truth.step(values))
    splats = truth.setting().splats
    assert splats is not None
    follow = Followers("test", splats.means.double(), truth.setting())
    world = body_frame(scene.bodies[0], scene)
    middle = truth.rest.mean(dim=0)
    frames, masks = [], thrown / "films"
    for name, side in (("a", (1.0, 0.2, 0.3)), ("b", (-0.3, 1.0, 0.3))):
        eye = middle + torch.tensor(side, dtype=torch.float64)
        pose = look_at(eye, middle, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        K = torch.tensor([[200.0, 0, 64], [0, 200.0, 64], [0, 0, 1]], dtype=torch.float64)
        here = Camera(pose, K, 128, 128)
        (masks / name).mkdir(parents=True)
        for k in range(len(TIMES)):
            alpha = draw(splats.replace(means=follow.places(motion, k)[0].float()), here).alpha
            save_image(alpha[..., None].expand(-1, -1, 3), masks / name / f"{k:04}.png")
        seen = here.transformed(world.inverse())
        placed = torch.linalg.inv(seen.viewmat) @ torch.diag(
            torch.tensor([1.0, -1, -1, 1]).double()
        )
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": placed.tolist()})
    poses = {"fl_x": 200, "fl_y": 200, "cx": 64, "cy": 64, "w": 128, "h": 128, "frames": frames}
    (thrown / "transforms.json").write_text(json.dumps(poses))
    return masks, thrown / "transforms.json"


def test_films_of_masks_lead_to_the_velocity(
    thrown: Path, films: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["fit", str(thrown / "shot.yaml"), "--masks", str(films[0]), "--cameras", str(films[1])]
    words += ["--learn", "it.velocity", "--starts", "1", "--grids", "1", "--cells", "5"]
    assert main([*words, "--jobs", "1", "-o", str(thrown / "out"), "--json"]) == 0
    number = json.loads(capsys.readouterr().out)["parameters"]["it.velocity"]
    start = np.linalg.norm(np.subtract([0.1, 0.0, -1.5], THROWN))
    # five cells and eighty points: most of the way
    assert np.linalg.norm(np.subtract(number["value"], THROWN)) < 0.6 * start


def test_cameras_stand_where_the_splats_are_seen_from(
    thrown: Path, films: tuple[Path, Path]
) -> None:
    """On the grid of the truth nothing but the drawing of 32 pixels is left of the differences."""
    scene, _ = shot_scene(
        load_shot(thrown / "shot.yaml"), thrown / "out", device=torch.device("cpu"),
        reporter=LineReporter(), make=True,
    )  # fmt: skip
    target = read_masks(*films, body_frame(scene.bodies[0], scene), sigma=None, fps=None)
    truth = Forward(scene, target.times, 0.3 / 5)
    observer = target.observe(truth.setting())
    sizes = []
    for velocity in (THROWN, [0.1, 0.0, -1.5]):
        values = {"it.velocity": velocity, "floor.offset": 0.4}
        motion = truth.run(values, len(TIMES), truth.step(values))
        sizes.append(float(observer.residuals(motion, len(TIMES), None)[0].square().mean().sqrt()))
    assert sizes[0] < 2.0 and sizes[0] < 0.5 * sizes[1]


def test_films_without_a_camera_are_named(films: tuple[Path, Path], tmp_path: Path) -> None:
    world = Frame(torch.eye(3).double(), torch.zeros(3).double(), 1.0)
    (tmp_path / "c").mkdir()
    with pytest.raises(InputError, match="no camera 'c'"):
        read_masks(tmp_path, films[1], world, sigma=None, fps=None)
    (tmp_path / "c").rename(tmp_path / "a")
    with pytest.raises(InputError, match="no pictures"):
        read_masks(tmp_path, films[1], world, sigma=None, fps=None)


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ([], "needs one of"),
        (["--points", "track.npz", "--force", "track.npz"], "needs one of"),
        (["--points", "track.npz", "--cameras", "track.npz"], "go together"),
    ],
)
def test_one_target_it_is(
    more: list[str], what: str, thrown: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(thrown)
    words = ["fit", "shot.yaml", "--learn", "it.young_modulus", "-o", "other", *more]
    assert main(words) == 2
    assert what in capsys.readouterr().err


def test_a_text_and_a_video_model_guide(
    thrown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    class Darker:
        def __init__(self, model: Path, prompt: str, *, device: Any) -> None:
            assert prompt == "jelly falls"

        def push(self, clip: torch.Tensor, random: torch.Generator) -> torch.Tensor:
            return torch.rand(clip.shape, generator=random) - 0.5

    monkeypatch.setattr("gsfluent.fit.guided.VideoPrior", Darker)
    words = ["fit", str(thrown / "shot.yaml"), "--learn", "it.young_modulus", "--guidance", "sds"]
    words += ["--cells", "4", "--rounds", "1", "-o", str(tmp_path), "--device", "cpu"]
    assert main(words) == 2
    assert "--model and --prompt" in capsys.readouterr().err
    assert main([*words, "--model", str(tmp_path), "--prompt", "jelly falls"]) == 0
    assert "began at 50000.0" in capsys.readouterr().out
    values = json.loads((tmp_path / "fit.json").read_text())
    young = values["parameters"]["it.young_modulus"]["value"]
    assert young == pytest.approx(5e4 * 10**0.1, rel=1e-3) or young == pytest.approx(
        5e4 / 10**0.1, rel=1e-3
    )
    entry = yaml.safe_load((tmp_path / "fitted.yaml").read_text())["objects"]["it"]
    assert entry["young_modulus"] == pytest.approx(young)


def test_pieces_show_how_strong_a_thing_is(
    thrown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One generation with two seeds, in processes; taken up again without a simulation."""
    shot = yaml.safe_load((thrown / "shot.yaml").read_text())
    shot["objects"]["it"] = {"material": "chocolate"}
    shot["events"][1]["velocity"] = [0.0, 0.0, -5.0]
    (tmp_path / "shot.yaml").write_text(yaml.safe_dump(shot))
    (tmp_path / "pieces.csv").write_text("mass,x,y,z\n2.0,0,0,0.1\n1.0,0.2,0,0.1\n")
    out = tmp_path / "out"
    words = ["fit", str(tmp_path / "shot.yaml"), "--pieces", str(tmp_path / "pieces.csv"), "-o"]
    words += [str(out), "--seeds", "2", "--rounds", "1", "--cells", "4", "--jobs", "1"]
    words += ["--learn", "it.young_modulus", "--dust", "0.1", "--device", "cpu"]
    assert main(words) == 0
    assert "it.young_modulus" in capsys.readouterr().out
    values = json.loads((out / "fit.json").read_text())
    assert values["target"] == "pieces" and values["runs"] == 12 and len(values["tried"]) == 5
    before = {p: p.stat().st_mtime_ns for p in (out / "search").rglob("*.json")}
    assert main(words) == 0
    assert json.loads((out / "fit.json").read_text()) == values
    assert {p for p, at in before.items() if p.stat().st_mtime_ns == at}
    (tmp_path / "pieces.csv").write_text("weight\n1\n")
    assert main(words) == 2
    assert "mass,x,y,z" in capsys.readouterr().err
