"""The verdict on a GPU: few looks, the same step as with many, the same boundaries as the CPU's."""

from __future__ import annotations

import pytest

from gsfluent.lab.stability.maps import Place
from gsfluent.lab.stability.run import all_maps
from gsfluent.lab.stability.scenes import block
from gsfluent.lab.stability.steps import shaken
from gsfluent.lab.world.invariants import OfWorld, first_violation

pytestmark = pytest.mark.cuda
GPU = Place("cuda")


def test_the_first_bad_step_does_not_depend_on_how_often_it_is_looked_at() -> None:
    found = [
        first_violation(OfWorld(shaken(*block(), 1.2, GPU)), 60, every=every)
        for every in (1, 8, 24)
    ]
    assert found[0] is not None and found[0].kind == "energy"
    assert {(v.step, v.kind) for v in found if v is not None} == {(found[0].step, "energy")}


@pytest.mark.parametrize(
    ("name", "inside", "outside"),
    [
        ("poisson", (1.0, 0.3), (1.2, 0.3)),
        ("fragments", (0.7, 8.0), (1.0, 8.0)),
        ("speed", (1.0, 0.1), (1.5, 0.1)),
        ("centre", (1.5, "dynamic, implicit"), (3.0, "dynamic, implicit")),
        ("precision", (2.5e5, "float32"), (3e5, "float32")),
    ],
)
def test_boundaries_lie_where_they_lie_on_the_cpu(
    name: str, inside: tuple[float, float], outside: tuple[float, float]
) -> None:
    m = all_maps()[name]
    assert m.run(*inside, m.variants[0], GPU).violation is None
    ours = m.run(*outside, m.variants[0], GPU).violation
    cpu = m.run(*outside, m.variants[0], Place("cpu")).violation
    assert ours is not None and cpu is not None and ours.kind == cpu.kind
