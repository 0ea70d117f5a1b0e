"""Objects with a temperature: fronts, softening, freezing, energy, and what is refused."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import pytest
import torch

import gsfluent as gf
from gsfluent.config import Shot, load_shot
from gsfluent.data import INTERIOR, Frame, Gaussians, Solid
from gsfluent.errors import InputError
from gsfluent.lab.problems.heat.melting import stefan_number
from gsfluent.materials.heat import thermal
from gsfluent.pipeline.heat import Heat
from gsfluent.pipeline.heat.ladder import LEVELS, at_level, thawing
from gsfluent.pipeline.heat.touching import groups, touching, turned
from gsfluent.pipeline.matter.points import build_matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene import Scene, Surroundings


def block(size: tuple[float, float, float], voxel: float, frame: Frame | None = None) -> Solid:
    """A box that stands on z = 0."""
    count = [round(edge / voxel) for edge in size]
    inside = torch.nn.functional.pad(torch.ones(count, dtype=torch.bool), (1, 1) * 3)
    low = torch.tensor([-0.5 * size[0], -0.5 * size[1], 0.0])
    seed = torch.Generator().manual_seed(0)
    places = low + torch.rand(20, 3, generator=seed) * torch.tensor(size)
    splats = Gaussians.from_colors(places, torch.full((20, 3), voxel), torch.rand(20, 3))
    splats = splats.replace(labels=torch.full((20,), INTERIOR, dtype=torch.int32))
    color = torch.full((*inside.shape, 3), 0.5)
    return Solid(splats, inside, voxel * inside, low - voxel, voxel, color, None, {}, frame)


def scene_of(
    material: str, temperature: float | None, heat: Surroundings | None = None, **more: object
) -> Scene:
    scene = Scene(heat=heat, **more)  # type: ignore[arg-type]
    scene.add(block((0.02, 0.02, 0.02), 0.0025), material, temperature=temperature, name="it")
    return scene


def test_ice_on_a_warm_floor_melts_as_far_as_neumann_says() -> None:
    ice = thermal("ice").row()
    height, speed = 0.04, 20_000.0
    scene = Scene(heat=Surroundings(transfer=0.0, floor=20.0, speed=speed), gravity=(0, 0, 0))
    scene.add(block((0.01, 0.01, height), 0.00125), "ice", temperature=0.0, name="it")
    frames = gf.pipeline.Simulate(dx=height / 8, splats=False)(scene, fps=10, seconds=0.2)
    share = [frame.stats["heat"]["it"]["liquid"] for frame in frames][-1]
    spread = float(ice[1] / (917.0 * ice[3])) * speed * 0.1
    front = 2.0 * stefan_number(20.0, ice) * math.sqrt(spread)
    assert 0.2 < share < 0.4
    assert share * height == pytest.approx(front, rel=0.03)


def test_chocolate_on_a_stove_becomes_a_puddle_and_energy_does_not_rise() -> None:
    heat = Surroundings(air=60.0, transfer=100.0, floor=60.0, speed=3000.0)
    simulation = gf.pipeline.Simulate(dx=0.005)(scene_of("chocolate", 20.0, heat), 10, 0.6)
    frames = list(simulation)
    heights = [float(frame.particles.position[:, 2].max()) for frame in frames]
    shares = [frame.stats["heat"]["it"]["liquid"] for frame in frames]
    assert simulation.report["verdict"] == "clean"
    assert shares[0] == 0.0 and shares[-1] == 1.0
    assert all(a <= b for a, b in itertools.pairwise(shares))
    assert heights[-1] < 0.6 * heights[0]
    total = [sum(f.energy[k] for k in ("kinetic", "elastic", "gravity")) for f in frames]
    assert max(total) <= total[0] * 1.001


def stacked(turn: torch.Tensor, device: str = "cpu") -> tuple[Heat, State]:
    """Ice of -20 degrees C under wax of 20, both cubes of 2 cm, all turned; without air."""
    scene = Scene(floor=None, heat=Surroundings(transfer=0.0, speed=600.0))
    for name, degrees, up in (("ice", -20.0, 0.0), ("wax", 20.0, 0.02)):
        frame = Frame(turn, turn @ torch.tensor([0.0, 0.0, up]).double(), 1.0)
        scene.add(block((0.02,) * 3, 0.0025), name, frame=frame, temperature=degrees, name=name)
    run = gf.pipeline.Simulate(dx=0.005, device=device).run_of(scene, 10.0)
    return run.heat, run.state


@pytest.mark.parametrize(
    "turn", [torch.eye(3), torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])]
)
def test_heat_flows_between_bodies_that_touch(turn: torch.Tensor) -> None:
    """As much as between two half-spaces, and none is lost; not once they have parted."""
    heat, state = stacked(turn.double())
    mass, begun = state.particles.mass.double(), state.enthalpy
    ice, wax = (body.rows for body in heat._warm)
    seconds = 6
    for tick in range(1, seconds + 1):
        state = heat.look(state._replace(time=tick / 60.0))
    assert begun is not None and state.enthalpy is not None
    gained = (mass * (state.enthalpy - begun))[ice].sum()
    lost = (mass * (begun - state.enthalpy))[wax].sum()
    assert float(gained) == pytest.approx(float(lost), rel=1e-12)
    effusivity = []
    for rows, name in ((ice, "ice"), (wax, "wax")):
        k, c = (float(v) for v in thermal(name).row()[[0, 2]])
        effusivity.append(math.sqrt(k * c * float(mass[rows].sum()) / 8e-6))
    series = effusivity[0] * effusivity[1] / sum(effusivity)
    passed = series * 40.0 * 2.0 * math.sqrt(600.0 * seconds / 60.0 / math.pi) * 4e-4
    assert float(gained) == pytest.approx(passed, rel=0.05)
    apart = state.position.clone()
    apart[wax] += 0.003 * turn[:, 2]
    later = heat.look(state._replace(position=apart, time=0.2))
    assert later.enthalpy is not None
    assert float((mass * (later.enthalpy - state.enthalpy))[ice].sum()) == pytest.approx(
        0.0, abs=1e-9 * float(gained)
    )


def test_a_cube_on_a_table_touches_it_with_its_own_face() -> None:
    """Lattices off by part of a cell: the pairs stand for 8 x 8 faces, one for each point there."""
    side, wide = torch.arange(8).double() + 0.5, torch.arange(20).double() + 0.5
    grid = [torch.cartesian_prod(s, s, torch.zeros(1).double()) for s in (side, wide)]
    for off in ((6.0, 6.0), (6.5, 6.3), (5.8, 6.5)):
        top = grid[0] + torch.tensor([*off, 1.0])
        pairs, share = touching(top, grid[1], 1.0)
        face = torch.zeros(64).double().index_add(0, pairs[:, 0], share)
        assert torch.allclose(face, torch.ones_like(face))
        assert len(touching(top + torch.tensor([0.0, 0.0, 0.6]), grid[1], 1.0)[0]) == 0


def test_the_jitter_of_points_is_taken_back_as_their_body_has_turned() -> None:
    places = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).double()
    turn = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]).double()
    assert torch.allclose(turned(places, places @ turn.T + 3.0), turn)
    assert groups(5, [(0, 3), (1, 4), (3, 4)]) == [[0, 1, 3, 4], [2]]


def test_without_a_temperature_nothing_is_there() -> None:
    scene = scene_of("ice", None)
    run = gf.pipeline.Simulate(dx=0.005).run_of(scene, 10.0)
    assert run.matter.ladder is None and run.state.enthalpy is None
    assert run.heat.next_look(0.0) == math.inf and run.heat.look(run.state) is run.state
    assert "heat" not in run.record(0)[2]
    plain = build_matter(scene, 0.005)
    assert torch.equal(plain.params, run.matter.params)


def test_what_freezes_keeps_its_stress_and_energy_falls() -> None:
    run = gf.pipeline.Simulate(dx=0.005).run_of(scene_of("wax", 80.0), 10.0)
    state, heat = run.state, run.heat
    assert bool((run.matter.of_law("fluid", points=state.particles)).all())
    count = state.particles.count
    soft = heat._softened(state, torch.full((count,), LEVELS - 1, dtype=torch.int8))
    squeezed = soft.particles.strain.clone()
    squeezed[:, :3] = -1e-3
    soft = soft._replace(particles=soft.particles.replace(strain=squeezed))
    hard = heat._softened(soft, torch.zeros(count, dtype=torch.int8))
    before = run.matter.stored(soft.particles, soft.peak)
    after = run.matter.stored(hard.particles, hard.peak)
    assert torch.allclose(hard.particles.strain, squeezed / LEVELS, rtol=1e-4)
    assert torch.allclose(after, before / LEVELS, rtol=1e-2)
    assert torch.equal(hard.particles.material, run.matter.particles.material)


def test_melt_that_has_parted_freezes_without_tension() -> None:
    run = gf.pipeline.Simulate(dx=0.005).run_of(scene_of("wax", 80.0), 10.0)
    state, count = run.state, run.state.particles.count
    assert state.level is not None and int(state.level.min()) == LEVELS
    strain = torch.zeros(count, 6)
    strain[:, :3] = torch.linspace(-0.01, 0.1, count)[:, None]
    state = state._replace(particles=state.particles.replace(strain=strain))
    before = run.matter.stored(state.particles, state.peak)
    solid = run.heat._softened(state, torch.full((count,), LEVELS - 1, dtype=torch.int8))
    after = run.matter.stored(solid.particles, solid.peak)
    assert bool((after <= before + 1e-12).all())


def test_steps_are_the_solid_made_weaker_and_then_a_liquid() -> None:
    scene = scene_of("wax", 20.0)
    plain = build_matter(scene, 0.005)
    matter = thawing(scene, plain)
    solid = plain.params[0]
    for level in range(LEVELS):
        row = at_level(matter, torch.full((matter.particles.count,), level))[0]
        assert torch.allclose(matter.params[row, :3], solid[:3] * (1.0 - level / LEVELS))
        assert matter.params[row, 6] == solid[6]
    row = at_level(matter, torch.full((matter.particles.count,), LEVELS))[0]
    assert int(matter.law[row]) == 4 and float(matter.params[row, 2]) == pytest.approx(5e-3)


def test_the_lattice_is_found_in_a_turned_body() -> None:
    turn = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]).double()
    found = []
    for rotation in (torch.eye(3).double(), turn):
        frame = Frame(rotation, torch.tensor([0.3, -0.1, 0.2]).double(), 1.0)
        scene = Scene(floor=None)
        scene.add(block((0.02, 0.02, 0.02), 0.0025), "ice", frame=frame, temperature=-5.0)
        found.append(Heat(scene, thawing(scene, build_matter(scene, 0.005))))
    straight, turned = (heat._warm[0].links for heat in found)
    assert len(straight) == 3 * 7 * 8 * 8 and torch.equal(straight, turned)


def test_a_run_goes_on_with_its_heat(tmp_path) -> None:  # type: ignore[no-untyped-def]
    heat = Surroundings(air=80.0, transfer=100.0, floor=60.0, speed=2000.0)
    simulate = gf.pipeline.Simulate(dx=0.005, splats=False)
    whole = simulate(scene_of("chocolate", 20.0, heat), 20, 0.2)
    frames = []
    for frame in whole:
        frames.append(frame)
        if frame.index == 1:
            whole.save(tmp_path / "state.pt")
    resumed = list(
        simulate(scene_of("chocolate", 20.0, heat), 20, 0.2, resume=tmp_path / "state.pt")
    )
    assert frames[-1].stats["heat"]["it"]["liquid"] > 0.1
    assert frames[-1].stats["heat"] == resumed[-1].stats["heat"]
    assert torch.equal(frames[-1].particles.position, resumed[-1].particles.position)


def test_what_cannot_melt_is_refused() -> None:
    for material, words in (
        ("egg", "nothing is known of the heat of 'egg'"),
        (gf.materials.get("water"), "law 'fluid' cannot melt"),
        (dataclasses.replace(gf.materials.get("ice"), yield_time=1e-3), "viscous matter"),
    ):
        scene = Scene()
        scene.add(block((0.02, 0.02, 0.02), 0.0025), material, temperature=1.0)
        with pytest.raises(InputError, match=words):
            gf.pipeline.Simulate(dx=0.005).prepare(scene)
    with pytest.raises(InputError, match="temperature must lie in"):
        scene_of("ice", -300.0)
    with pytest.raises(InputError, match="heat: speed must lie in"):
        Surroundings(speed=-1.0)


def test_what_may_melt_has_a_loss_without_springs() -> None:
    scene = Scene()
    for temperature in (None, -5.0):
        scene.add(block((0.02, 0.02, 0.02), 0.0025), "ice", temperature=temperature)
    assert [b.material.hysteresis for b in scene.bodies] == ["unloading", "pressed"]
    assert [b.material.viscous for b in scene.bodies] == [True, False]


def test_a_live_scene_with_temperatures_takes_nothing_more() -> None:
    from gsfluent.pipeline.simulate.grow import copy_of, grow

    scene = scene_of("ice", -5.0)
    run = Run(scene, gf.pipeline.Simulate(dx=0.005).prepare(scene), 10.0)
    with pytest.raises(InputError, match="scene that has temperatures"):
        grow(run, copy_of(scene))


def test_a_shot_names_temperatures(tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "a.ply").write_bytes(b"")
    values = {"splats": "a.ply", "size": 0.1,
              "objects": {"bar": {"material": "chocolate", "temperature": 18}}}  # fmt: skip
    shot = Shot.from_dict({**values, "heat": {"floor": 50, "speed": 100}}, tmp_path)
    assert shot.objects["bar"].temperature == 18.0
    assert shot.heat is not None and shot.heat.floor == 50.0 and shot.heat.air == 20.0
    assert Shot.from_dict(shot.resolved(), tmp_path) == shot
    plain = Shot.from_dict({**values, "objects": {"bar": {"material": "chocolate"}}}, tmp_path)
    assert "heat" not in plain.resolved() and "temperature" not in plain.objects["bar"].to_dict()
    for wrong, words in (
        ({"heat": {"air": 5}, "objects": {"bar": {"material": "ice"}}}, "does nothing where no"),
        ({"objects": {"bar": {"material": "glass", "temperature": 1}}}, "objects.bar.temperature"),
        ({"heat": {"speed": -1}}, "heat.speed"),
        ({"floor": "none", "heat": {"floor": 5}}, "heat.floor does nothing without a floor"),
    ):
        with pytest.raises(InputError, match=words):
            Shot.from_dict({**values, **wrong}, tmp_path)


def test_the_example_reads(tmp_path) -> None:  # type: ignore[no-untyped-def]
    text = (Path(__file__).resolve().parents[3] / "examples" / "chocolate_melted.yaml").read_text()
    (tmp_path / "data/chocolate/photographs").mkdir(parents=True)
    (tmp_path / "data/chocolate/cut.png").touch()
    (tmp_path / "shot.yaml").write_text(text)
    shot = load_shot(tmp_path / "shot.yaml")
    assert shot.objects["bar"].temperature == 24.0
    assert shot.heat is not None and shot.heat.speed == 400.0


@pytest.mark.cuda
def test_ice_melts_on_the_gpu_as_on_the_cpu() -> None:
    heat = Surroundings(transfer=0.0, floor=20.0, speed=20_000.0)
    shares = []
    for device in ("cpu", "cuda"):
        scene = scene_of("ice", 0.0, heat, gravity=(0, 0, 0))
        simulate = gf.pipeline.Simulate(dx=0.005, splats=False, device=device)
        shares.append([f.stats["heat"]["it"]["liquid"] for f in simulate(scene, 10, 0.2)][-1])
    assert shares[1] == pytest.approx(shares[0], rel=1e-3)


@pytest.mark.cuda
def test_bodies_that_touch_give_each_other_the_same_heat_on_a_gpu() -> None:
    warm = []
    for device in ("cpu", "cuda"):
        heat, state = stacked(torch.eye(3).double(), device)
        state = state._replace(time=1.0 / 60.0)
        once, again = heat.look(state).enthalpy, heat.look(state).enthalpy
        assert once is not None and again is not None and torch.equal(once, again)
        warm.append(once.cpu())
    assert float((warm[0] - warm[0].mean()).abs().max()) > 1e4
    assert torch.allclose(warm[1], warm[0], rtol=1e-5, atol=1e-2)
