"""scripts/peers: scenes land in a peer's domain unchanged, runs are judged, an absent peer is said.

No peer is needed: a solver of free flight in NumPy stands in for one.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "scripts" / "peers"
NAMES = ("peerlib", "physgaussian", "taichi_mpm", "newton_mpm", "demo_scenes", "demo_settings")


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, ModuleType]]:
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in (*NAMES, "all", "collect", "failures"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield {name: importlib.import_module(name) for name in (*NAMES, "all", "collect", "failures")}
    for name in (*NAMES, "all", "collect", "failures"):
        sys.modules.pop(name, None)


def case(peers: dict[str, ModuleType], name: str, dx: float) -> Any:
    """A scene made by the modules that the adapters see."""
    return importlib.import_module("fracturebench.registry").find(name).build(dx, 8)


class Flight:
    """Points that fly on; breaks off, or leaves its domain, when told to."""

    def __init__(self, lib: ModuleType, scene: Any, end: str) -> None:
        self.lib, self.x, self.v, self.end = lib, scene.x.copy(), scene.v.copy(), end
        self.steps, self.advances = 0, 0

    def advance(self, count: int, dt: float) -> None:
        self.x += count * dt * self.v
        self.steps += count
        self.advances += 1

    def state(self) -> tuple[Any, Any]:
        if self.end == "raises":
            raise RuntimeError("no more of it\nat line 7")
        if self.end == "leaves":
            raise self.lib.Cannot("points reached the side of its domain")
        return (self.x * math.nan if self.end == "nan" else self.x.copy()), self.v.copy()


class FlightPeer:
    name, shipped, needs, install = "flight", "plain", "numpy", "It is here."
    variants = {"cpu": ("plain", "other"), "cuda": ("plain",)}
    courant = (0.5,)

    def __init__(self, lib: ModuleType, end: str = "") -> None:
        self.lib, self.end, self.made = lib, end, []

    def load(self, folder: Path | None) -> str:
        return "flight 1"

    def start(self, scene: Any, variant: str, device: str) -> Flight:
        if self.end == "cannot":
            raise self.lib.Cannot("has no law")
        self.made.append(Flight(self.lib, scene, self.end))
        return self.made[-1]


def test_lame_parameters_give_back_youngs_modulus(peers: dict[str, ModuleType]) -> None:
    mu, lam = peers["peerlib"].lame(2.5e5, 0.3)
    assert mu * (3 * lam + 2 * mu) / (lam + mu) == pytest.approx(2.5e5, rel=1e-12)
    assert lam / (2 * (lam + mu)) == pytest.approx(0.3, rel=1e-12)


@pytest.mark.parametrize(("name", "dx"), [("bar", 1 / 8), ("spin", 0.02), ("pull_apart", 0.01)])
def test_a_scene_lands_inside_on_the_same_nodes_and_comes_back(
    peers: dict[str, ModuleType], name: str, dx: float
) -> None:
    scene = case(peers, name, dx)
    placed = peers["peerlib"].place(scene)
    inside = placed.inward(scene.x)
    assert placed.holds(inside)
    np.testing.assert_allclose(placed.outward(inside), scene.x, atol=1e-12)
    cells = (scene.x - inside) / dx  # moved by whole cells, so that weights stay what they are
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-9)
    # where the bodies get by flying on is inside too
    last = placed.inward(scene.x + scene.seconds * np.where(name == "pull_apart", scene.v, 0.0))
    assert placed.holds(last)


def test_steps_are_not_longer_than_asked_and_end_on_the_times(peers: dict[str, ModuleType]) -> None:
    lib = peers["peerlib"]
    times = np.array([0.0, 0.1, 0.2, 0.5])
    plan = lib.intervals(times, 0.03)
    assert all(dt <= 0.03 for _, dt in plan)
    np.testing.assert_allclose(np.cumsum([n * dt for n, dt in plan]), times, atol=1e-15)
    even = lib.intervals(np.linspace(0.0, 1.0, 11)[1:], 0.03)
    assert len({dt for _, dt in even}) == 1, "one graph serves all of them"
    assert lib.merged(even) == [(40, even[0][1])]
    assert sum(n for n, _ in lib.merged(plan)) == sum(n for n, _ in plan)


def test_planes_become_physgaussians_walls_or_are_refused(peers: dict[str, ModuleType]) -> None:
    lib, walls = peers["peerlib"], peers["physgaussian"].walls
    scene = case(peers, "pull_apart", 0.01)

    def on(kind: str, normal: tuple[float, ...], friction: float = 0.0) -> Any:
        plane = {"point": (0.0, 0.0, -0.02), "normal": normal, "kind": kind, "friction": friction}
        given = dataclasses.replace(scene, colliders=(plane,))
        return walls(given, lib.place(given))

    _, sticky, box = on("sticky", (0.0, 0.0, 2.0))
    assert not box and sticky[0][3:].tolist() == [0.0, 0.0, 1.0]
    # its planes take nodes strictly below them; the scene's node on the wall is the wall's
    assert -0.02 < sticky[0][2] < -0.02 + 0.01 * 0.01
    placed, sticky, box = on("separate", (0.0, 0.0, 1.0))
    assert box and not sticky
    # its bounding box stops nodes 0 to 2: node 2 is the one on the plane
    assert (placed.shift[2] + 2) * 0.01 == pytest.approx(-0.02)
    for wrong in (("slip", (0.0, 0.0, 1.0)), ("separate", (0.0, 1.0, 1.0))):
        with pytest.raises(lib.Cannot):
            on(*wrong)
    with pytest.raises(lib.Cannot, match="at every plane"):
        on("separate", (0.0, 0.0, 1.0), 0.3)


def test_what_a_peer_has_one_of_is_refused_not_averaged(peers: dict[str, ModuleType]) -> None:
    lib, scene = peers["peerlib"], case(peers, "two_material_bar", 0.01)
    young = lib.per_point(scene, "young_modulus")
    with pytest.raises(lib.Cannot, match="one stiffness"):
        peers["taichi_mpm"].uniform(young, "stiffness")
    assert peers["taichi_mpm"].uniform(scene.volume, "volume") == pytest.approx(0.01**3 / 8)
    given = peers["newton_mpm"].material(scene)
    assert given["mpm:young_modulus"] == young.tolist() and len(set(young.tolist())) == 2
    rock = dataclasses.replace(scene, materials=({**scene.materials[0], "law": "nacc"},) * 2)
    with pytest.raises(lib.Cannot, match="nacc"):
        lib.only_elastic(rock)


def test_error_and_time_come_from_separate_runs(peers: dict[str, ModuleType]) -> None:
    lib, scene = peers["peerlib"], case(peers, "pull_apart", 0.02)
    peer = FlightPeer(lib)
    run = lib.play(peer, scene, variant="plain", device="cpu", dt=1e-3, repeat=2)
    assert [e.advances for e in peer.made] == [1, len(scene.times), 1, 1]
    assert len(run.settings["walls"]) == 2 and run.settings["timing"] == "uninterrupted"
    assert run.steps == peer.made[-1].steps and run.method == "flight" and not run.failed
    kept = importlib.import_module("fracturebench.registry").judge(scene, run)[0]
    assert kept.value == pytest.approx(1.0, abs=1e-12), "free flight is the answer of pull_apart"
    other = lib.play(peer, scene, variant="other", device="cpu", dt=1e-3)
    assert other.method == "flight, other"


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        ("nan", "not finite before"),
        ("leaves", "side of its domain"),
        ("cannot", "has no law"),
        ("raises", "RuntimeError: no more of it"),
    ],
)
def test_a_run_that_breaks_off_says_why(
    peers: dict[str, ModuleType], end: str, reason: str
) -> None:
    lib, scene = peers["peerlib"], case(peers, "pull_apart", 0.02)
    run = lib.play(FlightPeer(lib, end), scene, variant="plain", device="cpu", dt=1e-3)
    assert reason in run.failed and not np.isfinite(run.x).any()
    measure = importlib.import_module("fracturebench.registry").judge(scene, run)[0]
    assert measure.error == math.inf and not measure.passed


def test_an_absent_peer_is_said_and_is_no_error(
    peers: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    peer = peers["newton_mpm"].Newton()
    peer.needs = "no_such_module_at_all"
    scene = case(peers, "bar", 1 / 8).save(tmp_path / "bar.npz")
    arguments = ["--scene", str(scene), "--out", str(tmp_path / "run.npz")]
    assert peers["peerlib"].main(peer, "", arguments) == 0
    said = capsys.readouterr().out
    assert "skipped" in said and "pip install newton" in said
    assert not (tmp_path / "run.npz").exists()
    solver = peers["physgaussian"].PhysGaussian()
    solver.needs = "json"
    assert peers["peerlib"].main(solver, "", arguments) == 0
    assert "git clone https://github.com/XPandora/PhysGaussian" in capsys.readouterr().out


def test_runs_are_judged_once_and_failures_are_told(
    peers: dict[str, ModuleType], tmp_path: Path
) -> None:
    lib, collect = peers["peerlib"], peers["collect"]
    scene = case(peers, "pull_apart", 0.02)
    scene.save(tmp_path / "scenes" / "pull_apart-0.02.npz")
    for end, dt in (("", 1e-3), ("nan", 2e-3)):
        run = lib.play(FlightPeer(lib, end), scene, variant="plain", device="cpu", dt=dt, repeat=3)
        run.save(tmp_path / "flight" / f"run{end}.npz")
    out = tmp_path / "records.jsonl"
    first = collect.collect(tmp_path, out, "a machine")
    assert sorted(r.ok for r in first) == [False, True]
    good = next(r for r in first if r.ok)
    assert good.error < 1e-9 and len(good.wall_seconds) == 3 and good.machine == "a machine"
    assert good.settings["dx"] == 0.02 and "walls" not in good.settings
    assert collect.collect(tmp_path, out, "a machine") == []
    text = collect.table(collect.read(out))
    assert text.splitlines()[-1].startswith("| pull_apart | flight | 2 | ")
    assert text.endswith("| not finite (1) |"), "told without the time at which it happened"
    page = tmp_path / "peers.md"
    page.write_text("# Peers\n")
    data, collect.DATA = collect.DATA, tmp_path
    out.rename(tmp_path / "peers_cpu.jsonl")
    collect.page(page)
    collect.DATA = data
    assert "<!-- peers cpu: begin -->" in page.read_text() and "a machine" in page.read_text()


def test_dear_runs_are_left_out_and_said(peers: dict[str, ModuleType], tmp_path: Path) -> None:
    every = peers["all"]
    scenes = every.freeze(tmp_path, True, ["bar"])
    assert [p.name for p in scenes] == ["bar-0.125.npz", "bar-0.083333.npz"]
    options = importlib.import_module("argparse").Namespace(
        device="cpu", quick=False, repeat=0, budget=3.0
    )
    taken, left = every.jobs("physgaussian", scenes, tmp_path, options)
    whole = len(every.PEERS["physgaussian"][0].courant) * len(scenes)
    assert taken and left and len(taken) + len(left) == whole
    assert {job["courant"] for job in taken} >= {0.7}, "its fastest step comes first"


def write_config(folder: Path, **keys: Any) -> Path:
    path = folder / "config" / "thing_config.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(keys))
    return path


def test_a_config_is_read_with_its_own_defaults(
    peers: dict[str, ModuleType], tmp_path: Path
) -> None:
    demo = peers["demo_scenes"]
    setting = demo.read_config(write_config(tmp_path, E=2e6, density=50))
    assert (setting.name, setting.n_grid, setting.dt) == ("thing", 50, 1e-4)
    assert (setting.young, setting.poisson, setting.density) == (2e6, 0.4, 50.0)
    assert setting.dx == pytest.approx(0.04) and setting.fill is None
    with pytest.raises(FileNotFoundError):
        demo.settings(tmp_path / "nowhere")


def test_the_stand_in_has_its_matter_and_its_mode(
    peers: dict[str, ModuleType], tmp_path: Path
) -> None:
    demo, lib = peers["demo_scenes"], peers["peerlib"]
    fill = {"n_grid": 20, "max_partciels_per_cell": 2, "max_particles_num": 10**6}
    boxed = {**fill, "boundary": [0.4, 1.4, 0.0, 0.5, 0.0, 0.5]}
    soft = demo.read_config(write_config(tmp_path, E=1e4, density=1000, particle_filling=fill))
    assert demo.fill_cell(soft) == pytest.approx(0.1)
    # with a boundary its grid spans that, so its cells are finer
    assert demo.fill_cell(dataclasses.replace(soft, fill=boxed)) == pytest.approx(0.05)
    stiff = dataclasses.replace(soft, young=9e4)
    mode = demo.Mode(soft)
    assert demo.Mode(stiff).omega / mode.omega == pytest.approx(3.0, rel=1e-9)
    # Euler and Bernoulli's beam neglects shear and is too high, most for a body this thick
    slender = 4.730041**2 * math.sqrt(1e4 / 1000.0 / 12.0) * 0.25
    assert 0.6 * slender < mode.omega < slender
    x, volume = demo.lattice(soft, 0.05, 8)
    assert volume.sum() == pytest.approx(float(np.prod(soft.size)), rel=1e-12)
    assert len(x) == 40 * 10 * 20
    shape, _ = mode.at(x)
    momentum = np.abs(shape.sum(axis=0)) / len(x)
    assert momentum.max() < 5e-3, "a free body's mode moves no centre of mass"
    splats, counted = demo.pipeline(soft, 5000)
    cells = np.unique(np.floor(splats / soft.dx).astype(int), axis=0)
    assert counted.sum() == pytest.approx(len(cells) * soft.dx**3, rel=1e-9)
    assert len(splats) == 5000 + 2 * 10 * 2 * 4  # of 10 x 2 x 4 cells that lie wholly inside
    scene = demo.scene(soft, x, volume, 0.05, mode)
    phase = np.sin(mode.omega * scene.times)[:, None, None]
    exact = scene.x + mode.amplitude * phase * shape
    run = lib.Run(scene.name, "", scene.times, exact, np.zeros_like(exact), 0.0, 0, {}, "", "")
    assert demo.error(scene, run, mode) < 1e-9
    slow = np.sin(0.8 * mode.omega * scene.times)
    assert demo.pitch(scene.times, slow, mode.omega) == pytest.approx(0.8, abs=1e-3)
    still = dataclasses.replace(run, x=np.broadcast_to(scene.x, exact.shape))
    assert demo.error(scene, still, mode) == pytest.approx(1.0)


def test_the_table_of_demos_divides_times_at_equal_error(peers: dict[str, ModuleType]) -> None:
    demo = peers["demo_settings"]
    base = {"case": "demo_thing", "device": "cuda", "points": 1000, "machine": "a GPU"}
    theirs = {
        **base,
        "variant": "pipeline",
        "error": 0.2,
        "settings": {
            "dx": 0.02,
            "courant": 0.1,
            "mass_over_exact": 1.5,
            "frequency_over_exact": 0.9,
        },
    }
    rows = [
        {**theirs, "method": "physgaussian", "wall_per_simulated": 50.0},
        {**theirs, "method": "physgaussian, graph", "wall_per_simulated": 30.0},
        {**base, "method": "gsfluent", "variant": "at most the error of pipeline", "error": 0.19,
         "wall_per_simulated": 0.25, "settings": {"dx": 0.04, "cfl": 0.5}},
    ]  # fmt: skip
    last = demo.table(rows, "cuda").splitlines()[-1]
    assert (
        "| 1.50, 0.90 |" in last
        and last.endswith("| 200 | 120 |")
        and "| 0.2000 |" in last
        and ", 2.00, 0.5" in last
    )
    setting = importlib.import_module("types").SimpleNamespace(name="thing")
    assert demo.target(rows, setting, "pipeline") == 0.2
    rows[0]["error"] = 1.2
    assert demo.target(rows, setting, "pipeline") == 0.5, "an error of one is no answer"
    assert demo.table(rows[:2], "cuda").splitlines()[-1].count("no run") == 1


def test_the_file_of_failures_says_what_was_seen(peers: dict[str, ModuleType]) -> None:
    failures = peers["failures"]
    found = json.loads(failures.DATA.read_text())
    assert {p["name"] for p in found} == set(failures.FAILURES)
    by = {p["name"]: p for p in found}
    assert by["pull_apart"]["reproduced"] and by["pull_apart"]["axes"]["fields"] == 1
    assert not by["half_cell"]["reproduced"], "a suspected one that did not happen is kept"
    assert failures.table(found).count("\n") == len(found) + 1
