"""Bodies at rest under load: stretched bars, sheared layers; rest is reached by damping."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from gsfluent.lab.world.driver import World
from gsfluent.lab.world.registry import Result, compare, problem
from gsfluent.lab.world.shapes import box, moduli, parameters
from gsfluent.lab.world.walls import PLANE_STRAIN, wall

FACE = 1.0 / (3.0 + math.sqrt(3.0))
"""How far behind the outermost held node a face acts [dx], 0.211. In equilibrium the coefficients
of quadratic B-splines obey -c(i-2)/6 - c(i-1)/3 + c(i) - c(i+1)/3 - c(i+2)/6 = 0, whose solutions
are straight lines and the decaying (-2 + sqrt 3)^i; with c = 0 at the nodes 0 and -1 the line meets
zero at -1 / (3 + sqrt 3)."""


def damping(rate: float) -> Callable[[World, float], None]:
    """Force that lets every velocity decay at ``rate`` [1/s]."""

    def slow(world: World, dt: float) -> None:
        keep = 1.0 / (1.0 + rate * dt)
        world.velocity, world.affine = world.velocity * keep, world.affine * keep

    return slow


def settle(
    position: Tensor,
    load: Callable[[float], list[Tensor]],
    ramp: float,
    hold: float,
    rate: float,
    **given: Any,
) -> World:
    """Move the colliders for ``ramp`` seconds, hold them for ``hold``, damped at ``rate`` [1/s].

    ``load`` gives their rows at a share of full speed: 1 while they move, 0 while they hold.
    """
    force = damping(rate)
    world = World(position, [0.0, 0.0, 0.0], colliders=load(1.0), force=force, **given).run(ramp)
    moved = {"affine": world.affine, "strain": world.strain}
    again = World(
        world.position, world.velocity, colliders=load(0.0), force=force, **{**given, **moved},
    )  # fmt: skip
    return again.run(hold)


def slope(x: Tensor, y: Tensor) -> float:
    """Slope of the straight line through points."""
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x * x).sum())


def bar_strains(
    young: tuple[float, float], poisson: float, laws: tuple[int, int], mode: str
) -> tuple[list[float], list[float]]:
    """Pull the bar of GaussianBench B1 (soft left half, stiff right half) by 1 %.

    Returns:
        Strain in the middle of each half, measured and by two springs in series, where the ends
        are the rows of points nearest to the faces.
    """
    spacing, ramp, pull = 0.005, 0.2, 0.001
    points = box([0.0, 0.0, 0.0], [0.1, 0.04, 0.04], spacing)
    x = points[:, 0]
    material = (x > 0.05).to(torch.int32)

    def load(share: float) -> list[Tensor]:
        speed = (share * pull / ramp, 0.0, 0.0)
        return [wall(0, mode=mode), wall(0, 0.1, -1, mode, velocity=speed)]

    rows = torch.stack([parameters(e, poisson, 1000.0) for e in young])
    world = settle(
        points, load, ramp, 0.3, 40.0, volume=spacing**3, dx=0.01,
        law=torch.tensor(laws), params=rows, material=material,
    )  # fmt: skip
    end = world.position.double().cpu()[:, 0]
    left, right = x < spacing, x > 0.1 - spacing
    delta = float((end - x)[right].mean() - (end - x)[left].mean())
    length = 0.05 - 0.5 * spacing
    stress = delta / (length / young[0] + length / young[1])
    gauge, low = 0.1 - spacing, 0.5 * spacing
    measured = []
    for a, b in ((0.125, 0.375), (0.625, 0.875)):
        core = (x > low + a * gauge) & (x < low + b * gauge)
        measured.append(slope(x[core], end[core]) - 1.0)
    return measured, [stress / e for e in young]


@problem(tier="fast")
def two_material_bar() -> Iterator[Result]:
    """Bar of a soft and a stiff half in series: strains 4 to 1, equal traction."""
    cases = (
        ("free of Poisson's effect, slip ends", 0.0, (0, 0), "slip", "exact in one dimension"),
        (
            "nu 0.3, corotated and neo-Hookean",
            0.3,
            (6, 0),
            "sticky",
            "GaussianBench B1 allows 15 %",
        ),
    )
    young = (5e4, 2e5)
    for name, poisson, laws, mode, source in cases:
        measured, wanted = bar_strains(young, poisson, laws, mode)
        for half, got, want in zip(("soft", "stiff"), measured, wanted, strict=True):
            yield compare(
                f"strain of the {half} half, {name}", got, want, tolerance=0.03,
                source=f"springs in series; {source}",
            )  # fmt: skip
        traction = [e * s for e, s in zip(young, measured, strict=True)]
        jump = abs(traction[0] - traction[1]) / (0.5 * sum(traction))
        yield compare(
            f"jump of traction, {name}", jump, tolerance=0.03, source=f"equilibrium; {source}",
        )  # fmt: skip


def lateral_stretch(young: float, poisson: float, axial: float) -> float:
    """Lateral stretch of the neo-Hookean law in uniaxial stress at an axial stretch (bisection)."""
    mu, kappa = moduli(young, poisson)

    def side_stress(lateral: float) -> float:
        j = axial * lateral**2
        trace = axial**2 + 2.0 * lateral**2
        deviator = mu * j ** (-2.0 / 3.0) * (lateral**2 - trace / 3.0)
        return deviator + 0.5 * kappa * (j * j - 1.0)

    low, high = 0.5, 1.5
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if side_stress(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)


@problem(tier="fast")
def poisson_contraction() -> Iterator[Result]:
    """Block pulled by 2 % and by 30 % between slip plates: sideways contraction."""
    edge, grip, spacing, young, poisson = 0.16, 0.03, 0.01, 1e5, 0.3
    points = box([-grip, 0.0, 0.0], [edge + 2.0 * grip, 0.08, 0.08], spacing)
    for pull in (0.02, 0.3):
        ramp = 0.1

        def load(share: float, speed: float = pull * edge / ramp) -> list[Tensor]:
            return [wall(0), wall(0, edge, -1, velocity=(share * speed, 0.0, 0.0))]

        world = settle(
            points, load, ramp, 0.15, 40.0, volume=spacing**3, dx=0.02,
            law=0, params=parameters(young, poisson, 1000.0),
        )  # fmt: skip
        end = world.position.double().cpu()
        middle = (points[:, 0] > 0.4 * edge) & (points[:, 0] < 0.6 * edge)
        axial = slope(points[middle, 0], end[middle, 0])
        sides = [slope(points[middle, i], end[middle, i]) - 1.0 for i in (1, 2)]
        want = lateral_stretch(young, poisson, axial) - 1.0
        yield compare(
            f"lateral strain, pulled by {pull:.0%}", 0.5 * sum(sides), want, tolerance=0.03,
            source="uniaxial stress of the law; GaussianBench A5 allows 10 %",
            note=f"axial strain {axial - 1.0:.4f}, {-want / (axial - 1.0):.3f} of it sideways",
        )  # fmt: skip


@problem(tier="fast")
def shear_and_back() -> Iterator[Result]:
    """Elastic layer between plates, sheared to gamma = 1 and back, without ends."""
    dx, height, width = 0.02, 0.1, 0.08
    spacing = 0.5 * dx
    grip = 1.5 * dx  # matter inside the plates, so that the field is whole at their faces
    points = box([0.0, -grip, 0.0], [width, height + 2.0 * grip, dx], spacing)
    y = points[:, 1]
    seconds = 1.0

    def load(sense: float) -> list[Tensor]:
        speed = sense * (height + 2.0 * FACE * dx) / seconds  # the gap between the faces
        top = wall(1, height, -1, "sticky", velocity=(speed, 0.0, 0.0))
        return [wall(1, mode="sticky"), top, PLANE_STRAIN]

    given: dict[str, Any] = {
        "volume": spacing**3, "dx": dx, "law": 0,
        "params": parameters(5e4, 0.3, 1000.0), "period": (width, None, None),
        "force": damping(20.0),
    }  # fmt: skip
    inner = (y > 0.3 * height) & (y < 0.7 * height)
    out = World(points, [0.0, 0.0, 0.0], colliders=load(1.0), deformation=True, **given)
    out.run(seconds)
    assert out.deformation is not None
    exact = torch.eye(3, dtype=torch.float64)
    shear = slope_of_shear(out, inner)
    exact[0, 1] = shear
    middle = out.deformation.double().cpu()[inner]
    error = torch.linalg.matrix_norm(middle - exact) / torch.linalg.matrix_norm(exact)
    yield compare(
        "median error of F inside at the peak", float(error.median()), tolerance=0.05,
        source="simple shear; GaussianBench C2", note=f"shear of the middle {shear:.3f}",
    )  # fmt: skip
    yield compare(
        "shear of the middle at the peak", shear, 1.0, tolerance=0.05,
        source="simple shear; GaussianBench C2",
    )  # fmt: skip
    again = World(
        out.position, out.velocity, affine=out.affine, strain=out.strain, colliders=load(-1.0),
        **given,
    ).run(seconds)  # fmt: skip
    left = slope_of_shear(again, inner)
    yield compare(
        "shear left in the middle after the way back", left, tolerance=0.05, source="elastic",
        note=f"{out.steps + again.steps} steps",
    )  # fmt: skip


def slope_of_shear(world: World, rows: Tensor) -> float:
    """Shear gamma of a layer by the elastic strain: e_xy / (1 + e_yy), mean over rows."""
    e = world.strain.double().cpu()[rows]
    return float((e[:, 3] / (1.0 + e[:, 1])).mean())
