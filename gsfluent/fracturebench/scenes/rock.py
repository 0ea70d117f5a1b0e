"""Rock: strength against strain rate, and the shape of the pieces, both against the experiment.

Figures of the experiment are those of Rae et al. (split Hopkinson bar, sieves, photographs of the
fragments), worked out from the published tables by ``scripts/fracturebench/rock_reference.py``.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..pieces import REACH, components, neighbours, parted
from ..registry import case
from ..run import Measure, Run
from ..scene import Floats, Scene, SceneError
from ..scenes.rows import brittle, levels, shape_noise, uneven
from ..shapes import box, elastic, free, plane
from ..statistics import spacing

EXPERIMENT = Path(__file__).parents[1] / "data" / "rock.json"
SMALLEST = 12
"""Points of the smallest piece that has a shape."""
_SIZE, _RATES = 0.035, (180.0, 50.0)
_YIELD_TIME = 6e-6
"""Time of a yield of quartzite [s], to two digits that which meets the fast test on the frozen
grid. A crack at the speed of Rayleigh waves takes 7.5e-6 s from the middle to the side."""
_SOURCE = "Rae et al., sandstone, quartzite, limestone"


def experiment() -> dict[str, Any]:
    """Figures of the experiment.

    Raises:
        SceneError: The record is missing or broken.
    """
    try:
        found: dict[str, Any] = json.loads(EXPERIMENT.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SceneError(
            f"{EXPERIMENT.name}: no record of the experiment ({error}); make it with "
            "scripts/fracturebench/rock_reference.py"
        ) from error
    return found


@dataclasses.dataclass(frozen=True)
class Piece:
    """A piece: its share of the mass, and short over long side of its shadow when it lies flat."""

    share: float
    aspect: float


def pieces_of(rest: Floats, x: Floats, mass: Floats, distance: float) -> list[Piece]:
    """Pieces of at least SMALLEST points, largest first, by pairs that have not parted.

    A piece lies on its broad side, so that its shadow shows the two larger of its three axes: the
    roots of the moments of second order of its shape at rest.

    Args:
        rest: Positions before [m], [N, 3].
        x: Positions now [m], [N, 3].
        mass: [kg], [N].
        distance: Largest distance of neighbours [m].
    """
    pairs = neighbours(rest, distance)
    label = components(rest.shape[0], pairs[~parted(rest, x, pairs)])
    found = []
    for row in np.flatnonzero(np.bincount(label) >= SMALLEST):
        of = label == row
        arm = rest[of] - np.average(rest[of], axis=0, weights=mass[of])
        moments = np.linalg.eigvalsh((mass[of, None] * arm).T @ arm)
        aspect = math.sqrt(max(moments[1], 0.0) / moments[2])
        found.append(Piece(float(mass[of].sum() / mass.sum()), aspect))
    return sorted(found, key=lambda p: -p.share)


def rosin_rammler(size: Floats, passing: Floats) -> tuple[float, float]:
    """Modulus n and size x63 of ``P(s) = 1 - exp(-(s / x63)^n)``, by a line in its own axes.

    Args:
        size: Sieve openings, [S].
        passing: Share of the mass that is finer, [S]; what is not between 2 % and 98 % is left out.

    Returns:
        ``(n, x63)``; NaN with fewer than three sieves to go by.
    """
    use = (passing > 0.02) & (passing < 0.98)
    if int(use.sum()) < 3:
        return math.nan, math.nan
    n, b = np.polyfit(np.log(size[use]), np.log(-np.log(1.0 - passing[use])), 1)
    return float(n), float(math.exp(-b / n))


# --- Strength against strain rate -----------------------------------------------------------------


def _judge_press(scene: Scene, run: Run) -> Iterator[Measure]:
    if run.stress is None:
        raise SceneError(f"{run.method}, {scene.name}: hand in `stress`; this case is judged by it")
    fit = experiment()["quartzite"]["strength"]
    peaks = []
    for i, rate in enumerate(_RATES):
        points = (scene.body == 0) & (np.sign(scene.x[:, 0]) == 2 * i - 1)
        peaks.append(float(-run.stress[:, points, 2].mean(axis=1).min()))
        wanted = fit["at_1_per_s"] * rate ** fit["exponent"]
        yield Measure(
            f"strength of quartzite at {rate:g} 1/s", peaks[-1], wanted,
            abs(peaks[-1] / wanted - 1.0), 3.0 * fit["scatter"], "Pa", _SOURCE,
        )  # fmt: skip
    rise, wanted = peaks[0] / peaks[1], (_RATES[0] / _RATES[1]) ** fit["exponent"]
    yield Measure(
        "strength at 180 1/s over that at 50 1/s", rise, wanted, abs(rise / wanted - 1.0), 0.15, "",
        _SOURCE,
    )  # fmt: skip


@case(kind="fracture", dx=_SIZE / 8, ladder=(_SIZE / 6, _SIZE / 8, _SIZE / 10), judge=_judge_press)
def rock_press(dx: float, per_cell: int) -> Scene:
    """Two cylinders of quartzite pressed at 180 and 50 1/s: strength, and its rise with the rate.

    Each is 35 mm long and thick, between heavy plates that move at constant speed and hold nothing
    sideways. Strength is calibrated to the slow test (255 MPa), toughness to K_Ic, the time that a
    yield takes to the strength at 180 1/s: what is predicted is that at 50 1/s, and the rise. The
    strength of the rock scatters by a fifth over a quarter of its size.
    """
    young, nu, density = 38.1e9, 0.099, 2645.0
    row = brittle(
        young, nu, density, friction=2.4, cohesion=0.02, strength=0.0161, softening=0.0012,
        energy=0.0317, dx=dx, reference=_SIZE / 10.0,
    ) | {"yield_time": _YIELD_TIME}  # fmt: skip
    plate = elastic(30.0 * young, nu, 30.0 * density)
    half = 0.5 * _SIZE
    rock = box([-half] * 3, [_SIZE] * 3, dx, per_cell)
    rock = rock[np.hypot(rock[:, 0], rock[:, 1]) <= half]
    flat = box(
        [-half - dx, -half - dx, half], [_SIZE + 2 * dx, _SIZE + 2 * dx, 2 * dx], dx, per_cell
    )
    flat = flat[np.hypot(flat[:, 0], flat[:, 1]) <= half + dx]
    rows, index = levels(row, np.clip(1.0 + 0.2 * shape_noise(rock, 0.25 * _SIZE, 5), 0.3, 1.7))
    one = np.concatenate([rock, flat, flat * [1.0, 1.0, -1.0]])
    n, m = rock.shape[0], flat.shape[0]
    away = dx * math.ceil(_SIZE / dx)
    drives, velocity, affine = [], [], []
    for i, rate in enumerate(_RATES):
        speed, first = 0.5 * rate * _SIZE, i * one.shape[0] + n
        v, c = np.zeros_like(one), np.zeros((one.shape[0], 3, 3))
        v[:, 2], c[:n, 2, 2] = np.clip(-rate * one[:, 2], -speed, speed), -rate
        velocity.append(v)
        affine.append(c)
        for k, sign in enumerate((-1.0, 1.0)):
            rows_of = list(range(first + k * m, first + (k + 1) * m))
            drives.append({"points": rows_of, "velocity": [0.0, 0.0, sign * speed]})
    return free(
        "rock_press", np.concatenate([one - [away, 0.0, 0.0], one + [away, 0.0, 0.0]]),
        np.concatenate(velocity), dx, per_cell, np.linspace(0.0, 0.016 / _RATES[1], 65)[1:],
        (*rows, plate), affine=np.concatenate(affine),
        material=np.tile(np.append(index, np.full(2 * m, len(rows))), 2),
        body=np.tile(np.repeat([0, 1, 2], [n, m, m]), 2), drives=tuple(drives), asks=("stress",),
    )  # fmt: skip


# --- Shape of the pieces --------------------------------------------------------------------------


def _judge_struck(scene: Scene, run: Run) -> Iterator[Measure]:
    found = experiment()["pieces"]
    if not run.finite:
        pieces: list[Piece] = []
    else:
        pieces = pieces_of(scene.x, run.x[-1], scene.mass, REACH * spacing(scene))
    share = np.array([p.share for p in pieces])
    size = np.cbrt(share)
    # sieves a factor of 1.3 apart from the smallest piece with a shape to the whole
    low = (SMALLEST / scene.count) ** (1.0 / 3.0)
    sieves = low * 1.3 ** np.arange(1.0, math.log(1.0 / low) / math.log(1.3))
    finer = np.array([1.0 - share[size >= s].sum() for s in sieves])
    n, _ = rosin_rammler(sieves, finer)
    least, most = found["modulus"]
    off = max(least - n, n - most, 0.0) if math.isfinite(n) else math.inf
    yield Measure(
        "Rosin-Rammler modulus, distance to the experiment's range", n, found["modulus_median"],
        off, 0.2, "", f"{_SOURCE}: {least:.2f} to {most:.2f}",
    )  # fmt: skip
    aspect = float(np.mean([p.aspect for p in pieces])) if len(pieces) > 4 else math.nan
    least, most = found["aspect"]
    off = max(least - aspect, aspect - most, 0.0) if math.isfinite(aspect) else math.inf
    yield Measure(
        "mean aspect ratio of the pieces, distance to the experiment's range", aspect,
        found["aspect_median"], off, 0.1, "", f"{_SOURCE}: {least:.2f} to {most:.2f}",
    )  # fmt: skip


@case(
    kind="fracture", dx=_SIZE / 14, ladder=(_SIZE / 12, _SIZE / 14, _SIZE / 16),
    judge=_judge_struck,
)  # fmt: skip
def struck_rock(dx: float, per_cell: int) -> Scene:
    """Cylinder thrown on a plane at 0.4 of its wave speed: pieces shaped like those of struck rock.

    What is compared has no unit: the modulus of the distribution of sizes and the aspect ratio of
    the pieces. The material is that of ``shatter``, far softer than rock: pieces of stiff rock
    between bars part by less than a point spacing while they are pressed, and cannot be told apart.
    """
    half = 0.5 * _SIZE
    points = box([-half] * 3, [_SIZE] * 3, dx, per_cell)
    points = points[np.hypot(points[:, 0], points[:, 1]) <= half]
    rows, index, c = uneven(points, 0.4 * _SIZE, dx, _SIZE / 8.0)
    times = np.linspace(0.0, 30.0 * half / c, 11)[1:]
    return free(
        "struck_rock", points, [0.0, 0.0, -0.4 * c], dx, per_cell, times, rows, material=index,
        colliders=(plane(2, -half, kind="separate", friction=0.3),),
    )  # fmt: skip
