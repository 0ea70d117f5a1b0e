"""Ensemble statistics of FractureBench: laws they obey, with runs made by formula."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.stats import ks_2samp

from gsfluent.fracturebench import pieces, statistics
from gsfluent.fracturebench.registry import find, judge
from gsfluent.fracturebench.run import Run
from gsfluent.fracturebench.scene import Scene, SceneError
from gsfluent.fracturebench.scenes.shatter import RADIUS, SEEDS, lattice_ball, reference
from gsfluent.fracturebench.shapes import box, elastic, free
from gsfluent.lab.frozen.answer import run_case

DX = 0.1
TIMES = np.linspace(0.0, 1.0, 21)[1:]


def block(speed: float = 2.0) -> Scene:
    """A block of 8 x 4 x 4 points that flies along x."""
    points = box([0.0, 0.0, 0.0], [0.4, 0.2, 0.2], DX, 8)
    return free("block", points, [speed, 0.0, 0.0], DX, 8, TIMES, elastic(1e5, 0.2, 1000.0))


def answer(scene: Scene, x: np.ndarray, v: np.ndarray, **more: np.ndarray) -> Run:
    return Run(scene.name, "formula", scene.times, x, v, 0.0, 1, **more)


def flight(scene: Scene, slower: float = 1.0, split: float = 0.0) -> Run:
    """Free flight at a changed speed; the half at larger x leaves the other one at ``split``."""
    v = slower * scene.v + np.where(scene.x[:, :1] > 0.2, split, 0.0) * [0.0, 0.0, 1.0]
    x = scene.x + scene.times[:, None, None] * v
    return answer(scene, x, np.broadcast_to(v, x.shape))


def test_neighbours_and_components_are_those_of_scipy() -> None:
    x = np.random.default_rng(0).random((1500, 3))
    for distance in (0.05, 0.12):
        found = pieces.neighbours(x, distance)
        wanted = cKDTree(x).query_pairs(distance, output_type="ndarray")
        assert np.array_equal(found, wanted[np.lexsort((wanted[:, 1], wanted[:, 0]))])
        graph = coo_matrix((np.ones(len(found)), found.T), shape=(1500, 1500))
        count, label = connected_components(graph, directed=False)
        ours = pieces.components(1500, found)
        assert np.unique(ours).size == count
        assert all(np.unique(label[ours == c]).size == 1 for c in np.unique(ours))
    with pytest.raises(SceneError, match="positive"):
        pieces.neighbours(x, math.nan)


def test_a_lattice_has_eighteen_neighbours_inside() -> None:
    x = box([0.0] * 3, [0.5] * 3, DX, 8)
    pairs = pieces.neighbours(x, pieces.REACH * 0.05)
    inside = (np.abs(x - 0.25) < 0.15).all(axis=1)
    assert set(np.bincount(pairs.ravel(), minlength=len(x))[inside]) == {18}


def test_a_known_split_parts_the_pairs_that_cross_it() -> None:
    scene = block()
    found = statistics.figures(scene, flight(scene, split=1.0))
    # 8 x 4 x 4 points: pairs across a plane of 4 x 4 are 16 straight and 2 * 2 * 12 diagonal
    assert found.pieces.tolist() == [0.5, 0.5]
    pairs = pieces.neighbours(scene.x, pieces.REACH * 0.05).shape[0]
    assert found.parted == (16 + 48) / pairs
    whole = statistics.figures(scene, flight(scene))
    assert whole.pieces.tolist() == [1.0] and whole.parted == 0.0


def test_what_comes_together_again_has_not_parted_for_good() -> None:
    scene = block()
    run = flight(scene, split=1.0)
    x = run.x.copy()
    x[-1] = scene.x
    assert statistics.figures(scene, answer(scene, x, run.v)).parted == 0.0


def test_the_energy_lost_is_that_taken_from_the_motion() -> None:
    scene = block()
    found = statistics.figures(scene, flight(scene, slower=0.8))
    assert found.lost == pytest.approx(1.0 - 0.64) and found.momentum[:, 0] == pytest.approx(0.8)
    # falling loses nothing: what weight gives is in the balance
    falling = free(
        "fall", scene.x, scene.v, DX, 8, TIMES, elastic(1e5, 0.2, 1e3), gravity=(0.0, 0.0, -9.81)
    )
    v = scene.v + TIMES[:, None, None] * np.array([0.0, 0.0, -9.81])
    x = scene.x + TIMES[:, None, None] * scene.v
    x = x + 0.5 * TIMES[:, None, None] ** 2 * np.array([0.0, 0.0, -9.81])
    assert statistics.lost_energy(falling, answer(falling, x, v)) == pytest.approx(0.0, abs=1e-9)


def test_stress_handed_in_is_stored_energy_not_lost() -> None:
    scene = block()
    young, nu, strain = 1e5, 0.2, 1e-3
    mu, lame = young / (2.0 * (1.0 + nu)), young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    stress = np.zeros((len(TIMES), scene.count, 6))
    stress[..., :3] = lame * strain
    stress[..., 0] += 2.0 * mu * strain
    run = flight(scene)
    stored = 0.5 * (lame + 2.0 * mu) * strain**2 * scene.volume.sum()
    lost = statistics.lost_energy(scene, answer(scene, run.x, run.v, stress=stress))
    assert lost == pytest.approx(-stored)


def test_mass_ks_is_the_distance_of_the_weighed_curves() -> None:
    assert statistics.mass_ks(np.array([0.2, 0.8]), np.array([0.8, 0.2])) == 0.0
    assert statistics.mass_ks(np.array([0.5, 0.5]), np.array([1.0])) == 1.0
    assert statistics.mass_ks(np.array([0.1, 0.9]), np.array([1.0])) == pytest.approx(1.0)
    assert statistics.mass_ks(np.array([0.1, 0.9]), np.array([0.1] + 9 * [0.1])) == pytest.approx(
        0.9
    )
    # pieces of (almost) equal mass weigh what they count: the ordinary KS distance
    generator = np.random.default_rng(1)
    one, two = 1.0 + 1e-6 * generator.random(300), 1.0 + 1e-6 * (generator.random(200) + 0.2)
    assert statistics.mass_ks(one, two) == pytest.approx(ks_2samp(one, two).statistic, abs=1e-4)


def made(shift: float, seed: int, spread: float = 0.01) -> statistics.Figures:
    """Figures of a made-up method whose runs scatter about ``shift``."""
    noise = shift + spread * np.random.default_rng(seed).normal(size=4)
    momentum = np.tile([noise[0], 0.0, 0.0], (20, 1))
    masses = np.array([0.3 + noise[2], 0.7 - noise[2]])
    return statistics.Figures(momentum, np.full(20, 0.5 + noise[1]), masses, 0.4 + noise[3])


def test_no_method_may_claim_to_beat_the_band() -> None:
    ours = [made(0.0, seed) for seed in range(8)]
    same = statistics.distance(ours, ours)
    twin = statistics.distance(ours, [made(0.0, seed) for seed in range(20, 28)])
    for name in statistics.MEASURES:
        assert same[name].within and same[name].error == same[name].band > 0.0
        assert twin[name].within and "within the band" in str(twin[name])
    far = statistics.distance(ours, [made(0.2, seed) for seed in range(8)])
    for name in ("momentum history", "dissipated energy", "pairs parted for good"):
        assert not far[name].within
        assert far[name].error == far[name].value == pytest.approx(0.2, abs=0.02)
    with pytest.raises(SceneError, match="three runs"):
        statistics.distance(ours[:2], ours)


def test_figures_survive_the_record_and_refuse_what_has_none() -> None:
    figures = made(0.1, 3)
    back = statistics.Figures.of_plain(figures.plain())
    assert back.momentum == pytest.approx(figures.momentum, rel=1e-5)
    assert back.pieces == pytest.approx(figures.pieces, abs=1e-6)
    assert back.parted == pytest.approx(figures.parted, rel=1e-5)
    scene = block()
    run = flight(scene)
    broken = answer(scene, np.full_like(run.x, math.nan), run.v)
    with pytest.raises(SceneError, match="broke off"):
        statistics.figures(scene, broken)
    with pytest.raises(SceneError, match="momentum"):
        statistics.figures(block(speed=0.0), run)


def test_jitter_moves_points_and_walls_together_by_less_than_a_spacing() -> None:
    scene = find("shatter").build(RADIUS / 3.0, 1)
    assert statistics.jitter(scene, 0) is scene
    one, two = statistics.jitter(scene, 1), statistics.jitter(scene, 2)
    shift = one.x - scene.x
    assert (shift >= 0.0).all() and (shift < scene.dx).all() and np.ptp(shift, axis=0).max() < 1e-12
    moved = np.array(one.colliders[0]["point"]) - np.array(scene.colliders[0]["point"])
    assert moved == pytest.approx(shift[0]) and not np.allclose(one.x, two.x)
    with pytest.raises(SceneError, match="seeds"):
        statistics.jitter(scene, -1)


def test_the_ball_of_the_lattice_has_the_volume_of_a_ball() -> None:
    points = lattice_ball(RADIUS, RADIUS / 6.0, 8)
    volume = points.shape[0] * (RADIUS / 12.0) ** 3
    assert volume == pytest.approx(4.0 / 3.0 * math.pi * RADIUS**3, rel=0.02)
    assert np.abs(points.mean(axis=0)).max() < 1e-12


def test_shatter_breaks_and_its_record_is_one_of_pieces() -> None:
    runs = reference()
    assert len(runs) == len(SEEDS)
    assert all((r.pieces > 0.05).sum() >= 4 and r.pieces.sum() == pytest.approx(1.0) for r in runs)
    assert all(0.2 < r.parted < 0.6 and 0.5 < r.lost[-1] < 1.0 for r in runs)
    bands = statistics.distance(runs, runs)
    assert all(0.0 < d.band < 0.2 for d in bands.values())
    case = find("shatter")
    members = statistics.ensemble(case, RADIUS / 4.0, 8, (0,), lambda scene: run_case(scene))
    (member,) = members
    measures = judge(member.scene, run_case(member.scene))
    assert measures[0].quantity.startswith("mass over pieces")
    found = statistics.distance(runs, members)
    for m in measures:
        name = m.quantity.split(", distance")[0]
        assert m.error == pytest.approx(found[name].error) and m.error >= bands[name].band
    broken = Run("shatter", "none", member.run.times, np.full_like(member.run.x, math.nan),
                 member.run.v, 0.0, 0, failed="nan")  # fmt: skip
    assert all(m.error == math.inf and not m.passed for m in judge(member.scene, broken))
