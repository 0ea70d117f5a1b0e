"""What the fracture cases depend on: the grid's place in a scene, and where energy goes."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
import torch
from loaded_scripts import load_script

from gsfluent import ops
from gsfluent.fracturebench.registry import find, judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene
from gsfluent.fracturebench.shapes import box, elastic, free, plane
from gsfluent.lab.frozen.answer import law_of, rows, run_case, viscosity
from gsfluent.lab.world.driver import World
from gsfluent.pipeline.matter.brittle import softened

loads = load_script("fracturebench/loads")
DX = 0.1


def cube(colliders: tuple[dict[str, object], ...] = ()) -> Scene:
    """An elastic cube of random velocities, on the floor if there is one."""
    points = box([0.0, 0.0, 0.0], [0.4, 0.4, 0.4], DX, 8)
    v = np.random.default_rng(0).normal(size=points.shape)
    return free(
        "cube", points, v, DX, 8, np.array([0.005, 0.02]), elastic(1e4, 0.2, 1000.0),
        colliders=colliders,
    )  # fmt: skip


def test_a_grid_moved_by_whole_cells_gives_the_same_answer_and_by_a_part_another() -> None:
    here, there, beside = (run_case(cube(), dtype=torch.float64, place=p) for p in (0.0, 1.0, 0.25))
    assert np.abs(there.x - here.x).max() < 1e-12 and np.abs(there.v - here.v).max() < 1e-9
    assert np.abs(beside.v - here.v).max() > 1e-3  # the transfer differs, the place does not
    assert np.abs(beside.x[0] - here.x[0]).max() < 0.5 * DX
    assert beside.settings["place"] == 0.25 and "place" not in here.settings


def test_a_wall_stays_on_its_nodes() -> None:
    scene = cube((plane(2, 0.0, kind="sticky"),))
    seen: list[torch.Tensor] = []
    run_case(scene, place=0.25, setup=lambda world: seen.append(world.position.clone()))
    away = seen[0].double().numpy() - scene.x
    assert away[:, :2] == pytest.approx(0.25 * DX) and np.abs(away[:, 2]).max() < 1e-6


def energies(keep: float) -> tuple[float, float, float]:
    """Energy of the cube before and after, and what the account says that the transfer took [J]."""
    found: list[tuple[World, object]] = []
    run_case(
        cube(), dtype=torch.float64, cfl=0.02, engine="ops",
        setup=lambda world: found.append((world, loads.Account(world, keep))),
    )  # fmt: skip
    world, account = found[0]
    scene = cube()
    before = 0.5 * float((scene.mass * (scene.v**2).sum(axis=1)).sum())
    return before, world.kinetic() + world.elastic(), float(account.transfer.sum())


def test_two_fields_are_one_ahead_of_the_tip_and_part_behind_it() -> None:
    worlds: list[World] = []
    for sides in (False, True):

        def begin(world: World, sides: bool = sides) -> None:
            worlds.append(world)
            loads.Account(world, sides=sides)

        run_case(cube(), dtype=torch.float64, cfl=0.2, engine="ops", setup=begin)
    one, two = worlds  # nothing is broken: all is ahead of the tip
    assert float((one.position - two.position).abs().max()) < 1e-12

    fields = loads.Sides(one)
    with fields():
        pass
    points = (one.position, one.velocity, one.affine, one.scene.mass)
    where = {"dx": DX, "blocks": ops.build_blocks(one.position, DX)}
    shared = ops.p2g(*points, **where)[0]
    found = {}
    for tip in (-math.inf, math.inf):
        fields._tip = tip
        grid, _ = fields._to_nodes(*points, **where)
        assert torch.allclose(grid.sum(0), shared[0], rtol=1e-12, atol=1e-15)
        both = (grid[..., 3] > 1e-9).all(0)
        v = grid[:, both, :3] / grid[:, both, 3:]
        found[tip] = float((v[0] - v[1]).abs().max())
    assert found[-math.inf] < 1e-12 and found[math.inf] > 0.1


def test_the_account_closes_for_an_elastic_body() -> None:
    for keep in (0.0, 0.99):
        before, after, taken = energies(keep)
        assert taken == pytest.approx(before - after, rel=0.02)
        # random velocities do not fit a grid of eight points per cell: most goes, unless it is kept
        assert (taken > 0.7 * before) == (keep == 0.0)


def test_the_account_refuses_a_world_that_it_cannot_follow() -> None:
    with pytest.raises(TypeError, match="engine='ops'"):
        run_case(cube(), engine="solver", setup=lambda world: loads.Account(world))


def test_energy_per_area_is_the_slope_where_the_case_takes_it() -> None:
    tip = np.linspace(0.25, 0.7, 40)
    assert loads.per_area(tip, 3.0 + 20.0 * tip, 0.1) == pytest.approx(200.0)
    bent = np.where(tip > 0.5, 1e3, 20.0 * tip)
    assert loads.per_area(tip, bent, 0.1) == pytest.approx(200.0)


def test_cracks_side_by_side_are_counted_each() -> None:
    scene = find("double_cantilever").build(1 / 32, 8)
    x, y = scene.x[:, 0], scene.x[:, 1] - 0.1875
    one = (np.abs(y) < 0.03) & (x < 0.5)  # a band of two cells up to x = 0.5
    two = (np.abs(np.abs(y) - 0.05) < 0.01) & (x < 0.4)
    wide = (np.abs(y) < 0.06) & (x < 0.4)
    far = (np.abs(y) > 0.1) & (x < 0.5)
    damage = np.stack([np.zeros(len(x)), one, two, one & (x < 0.4) | wide, far])
    found = loads.crack_length(scene, damage.astype(np.float64), 0.1875, 0.0625)
    ends = [float(x[x < end].max()) + 1 / 128 - 0.25 for end in (0.4, 0.5)]
    # what touches is one wide crack, and what lies in the arms is none of it
    assert found == pytest.approx([0.0, ends[1], 2.0 * ends[0], ends[0], 0.0])


@pytest.fixture(scope="module")
def alone() -> Any:
    """Balance of the cantilever on the grid where it has one crack."""
    return loads.balance(find("double_cantilever").dx, place=0.25, cfl=0.8)


def test_the_frozen_double_cantilever_has_two_cracks_that_take_what_one_does(alone: Any) -> None:
    both = loads.balance(find("double_cantilever").dx, place=0.0, cfl=0.8)
    assert both.cracks > 1.7 and alone.cracks < 1.2
    assert both.gone == pytest.approx(alone.gone, rel=0.2)
    assert abs(both.gone / both.reference - 1.0) < 0.3


def test_the_cantilevers_account_is_of_its_frozen_row(alone: Any) -> None:
    case = find("double_cantilever")
    assert alone.reference == case.build(case.dx, 8).materials[1]["fracture_energy"]
    # what is gone is plastic work and the transfer's; explicit steps take the rest
    assert 0.85 * alone.gone < alone.plastic + alone.transfer < 1.1 * alone.gone
    assert alone.near > 0.8 * alone.transfer


def test_the_frozen_row_is_the_crack_band_of_its_fracture_energy() -> None:
    case = find("double_cantilever")
    row = case.build(case.dx, 8).materials[1]
    table = rows(case.build(case.dx, 8))[1][1:2].double()
    strength = table[:, 1] * np.sinh(-row["hardening"] * row["alpha"])
    energy = torch.tensor([row["fracture_energy"]], dtype=torch.float64)
    hardening, alpha, kept = softened(table, strength, energy, torch.ones_like(energy), case.dx)
    assert float(alpha) == pytest.approx(row["alpha"], rel=0.01)
    assert float(hardening) == pytest.approx(row["hardening"], rel=0.01) and float(kept) == 1.0


def test_an_unknown_table_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        loads.main(["--only", "cantilever_account,nonsense"])
    assert "nonsense" in capsys.readouterr().err


@functools.cache
def pressed(**options: Any) -> Run:
    """What becomes of pressed rock on its coarsest grid, worked out once."""
    case = find("rock_press")
    return run_case(case.build(case.ladder[0], 8), **options)


def test_pressed_rock_says_what_a_strength_without_a_rate_can_reach(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loads, "run_case", lambda scene, **options: pressed(**options))
    text = "\n".join(loads.strengths(quick=True))
    assert "| experiment | 448 MPa | 296 MPa | 1.51 | 1.29 to 1.74 |" in text
    ours = next(line for line in text.splitlines() if line.startswith("| without"))
    fast, slow = (float(cell.split()[0]) for cell in ours.split("|")[2:4])
    least, most = (float(word.strip(",;")) for word in
                   text.split("static strength times ")[1].split(";")[0].split(" to "))  # fmt: skip
    for factor, inside in ((least + 0.01, True), (most - 0.01, True), (least - 0.02, False)):
        within = abs(factor * fast / 448.0 - 1) < 0.25 and abs(factor * slow / 295.8 - 1) < 0.25
        assert within == inside


def test_a_row_that_yields_late_makes_its_points_viscous() -> None:
    scene = find("rock_press").build(find("rock_press").ladder[0], 8)
    found = viscosity(scene)
    assert found is not None and found.shape == (scene.count, 9)
    rock = torch.from_numpy(scene.body) == 0
    assert (found[rock, 8] == 6e-6).all() and not found[~rock].any() and not found[:, :8].any()
    assert viscosity(scene, "phase_field") is None and viscosity(cube()) is None


def test_matter_that_names_the_width_of_its_cracks_breaks_by_phase_field() -> None:
    cases = [find(name) for name in ("branching", "rock_press")]
    forks, rock = (case.build(case.ladder[0], 8) for case in cases)
    assert [law_of(m, "named") for m in forks.materials] == ["elastic", "elastic", "phase_field"]
    assert {law_of(m, "named") for m in rock.materials} <= {"nacc", "elastic"}
    for scene, law in ((forks, "phase_field"), (rock, "nacc")):
        for named, said in zip(rows(scene, "named"), rows(scene, law), strict=True):
            assert torch.equal(named, said)
    assert torch.equal(viscosity(rock, "named"), viscosity(rock))
    assert viscosity(forks, "named") is None


def test_where_nothing_touches_contact_at_points_changes_no_bit() -> None:
    floor = plane(2, kind="slip")
    nodes, points = (run_case(cube((floor,)), contact=name) for name in ("nodes", "points"))
    assert np.array_equal(points.x, nodes.x) and np.array_equal(points.v, nodes.v)


def test_strength_of_pressed_rock_rises_with_the_rate_because_of_its_row() -> None:
    case = find("rock_press")
    scene = case.build(case.ladder[0], 8)
    judged, at_once = judge(scene, pressed()), judge(scene, pressed(viscous=None))
    missed = {m.quantity for m in judged if not m.passed}
    assert missed == {"strength at 180 1/s over that at 50 1/s"}
    late, at_once = ([m.value for m in found] for found in (judged, at_once))
    assert at_once[2] < 1.2 and late[2] > 1.5
    # a yield that takes time only adds, and the more the faster
    assert 1.0 < late[1] / at_once[1] < late[0] / at_once[0]
