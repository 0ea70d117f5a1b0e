"""The weld: what it may touch, and that nothing jumps."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from simulation_scenes import at
from simulation_shapes import ellipsoid
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.ops.plasticity import weakened
from gsfluent.pipeline.matter.fields import breakable
from gsfluent.pipeline.matter.fragments import rest_links
from gsfluent.pipeline.matter.pieces import Pieces, Web, find_pieces
from gsfluent.pipeline.matter.points import Matter, build_matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.matter.weld import HOPS, REST, STRENGTH, crushed, seen, weld, weldable
from gsfluent.scene.scene import Scene

DX = 0.02


def halves(gap: float = 1.0) -> tuple[Matter, Web, State, Pieces]:
    """A ball with a broken layer through its middle, its halves ``gap`` spacings apart, at 1 s."""
    scene = Scene(floor=None)
    scene.add(ellipsoid(), materials.fruit.apple, frame=at(0, 0, 0))
    matter = build_matter(scene, DX)
    rest = matter.rest.double()
    links = rest_links(matter.rest, matter.ranges, matter.spacing)
    layer = rest[:, 0].abs() < 3.0 * DX
    position = rest.clone()
    position[:, 0] += gap * matter.spacing[0] * torch.sign(rest[:, 0])
    p = matter.particles
    state = State.start(matter, torch.zeros(0, 32).double(), (True,), len(links))
    alpha = torch.where(layer, 0.05, p.alpha)
    particles = p.replace(alpha=alpha, position=position.float())
    state = state._replace(
        particles=particles, position=position, time=1.0, ever=layer,
        peak=torch.where(layer, 0.05, state.peak), alpha_seen=alpha,
    )  # fmt: skip
    web = Web(
        links, matter.rest, p.body.long(), torch.tensor(matter.spacing).double(), p.mass,
        torch.zeros_like(layer), breakable(matter), torch.ones(1).double(),
        torch.zeros(1, dtype=torch.bool),
    )  # fmt: skip
    pieces = find_pieces(web, position, state.peak >= 0, state.cut_links)
    assert pieces.fragments.count == 2
    return matter, web, state, pieces


def test_what_lies_near_the_crack_and_stands_still_is_welded() -> None:
    matter, web, state, pieces = halves()
    after = weld(matter, web, state, pieces)
    welded = (after.peak < 0) & (state.peak >= 0)
    assert torch.allclose(after.peak[welded], STRENGTH * matter.particles.alpha[welded])
    assert torch.equal(after.peak[welded], after.particles.alpha[welded])
    away = matter.rest[:, 0].abs() / matter.spacing[0]
    assert bool(welded.any()) and bool(((state.peak >= 0) & ~welded).any())
    # No link is longer than 1.5 spacings: three of them, from an end of one that is cut.
    assert float(away[welded].max()) < 1.5 * (HOPS + 1)
    assert bool(welded[(away < 1.0) & state.ever].all())
    assert torch.equal(after.ever, state.ever)
    # What is welded is a seed of its piece; the crack between the pieces stays.
    again = find_pieces(web, after.position, after.peak >= 0, pieces.cut_links, ever=after.ever)
    assert torch.equal(again.unit, pieces.unit)
    assert again.fragments.count == 2
    side = matter.rest[:, 0] > 0
    assert torch.unique(again.unit[side]).shape[0] == torch.unique(again.unit[~side]).shape[0] == 1


def test_what_is_not_ready_is_not_welded() -> None:
    matter, web, state, pieces = halves()
    young = state._replace(time_seen=torch.full_like(state.time_seen, 1.0 - 0.9 * REST))
    assert not weldable(matter, web, young, pieces).any()
    moved = state._replace(alpha_seen=state.alpha_seen - 0.01)
    assert not weldable(matter, web, seen(moved), pieces).any()
    assert weldable(matter, web, seen(state), pieces).any()
    deep = state._replace(lowest=matter.particles.alpha - 0.5)
    assert not weldable(matter, web, deep, pieces).any()
    whole = find_pieces(web, matter.rest, state.peak >= 2.0, state.cut_links)
    assert whole.fragments.count == 1
    assert not weldable(matter, web, state, whole).any()


def test_crushing_counts_from_a_tenth_of_the_strength() -> None:
    """The bound is the integral of the yield pressure: checked by quadrature."""
    matter, *_ = halves()
    row = matter.particles.material.long()
    harden = matter.params[row, 4].double()
    start = matter.particles.alpha.double()
    for extra in (1e-3, 1e-2, 0.1):
        low = start - extra
        steps = torch.linspace(0, 1, 2001, dtype=torch.float64)
        path = start[:, None] - extra * steps
        pressure = 1e-5 + torch.sinh(harden[:, None] * path.abs())
        work = torch.trapezoid(pressure, dx=extra / 2000, dim=1)
        wanted = work > 0.1 * (1e-5 + torch.sinh(harden * start.abs()))
        assert float((crushed(matter, low) == wanted).double().mean()) > 0.999
    assert not crushed(matter, start).any() and crushed(matter, start - 2.0).all()


def test_a_weld_changes_no_stress_energy_or_momentum() -> None:
    matter, web, state, pieces = halves()
    generator = torch.Generator().manual_seed(4)
    count = matter.particles.count
    params, law = matter.params.double(), matter.law
    material = matter.particles.material
    alpha = state.particles.alpha.double()
    zero = torch.zeros(count, 3, 3, dtype=torch.float64)

    def mapped(strain: Tensor, alpha: Tensor, peak: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Strain, alpha and stress after a step without motion, on the surface of ``peak``."""
        of, table = weakened(law, params, material, peak)
        strain, alpha, stress, _ = ops.return_mapping(strain, alpha, zero, law=of, params=table)
        return strain, alpha, stress

    # States on and inside the surface of broken matter, by way of the return map itself.
    loads = 0.1 * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    of, table = weakened(law, params, material, state.peak.double())
    strain, alpha, _, _ = ops.return_mapping(
        torch.zeros(count, 6, dtype=torch.float64), alpha, loads, law=of, params=table
    )
    before = mapped(strain, alpha, torch.maximum(alpha, state.peak.double()))
    p = state.particles
    particles = dataclasses.replace(
        p, strain=strain, alpha=alpha,
        velocity=torch.randn(count, 3, generator=generator, dtype=torch.float64),
        **{name: getattr(p, name).double() for name in ("position", "mass", "volume", "affine")},
        deformation=None if p.deformation is None else p.deformation.double(),
        viscous=None if p.viscous is None else p.viscous.double(),
    )  # fmt: skip
    state = state._replace(
        particles=particles, peak=torch.maximum(alpha, state.peak.double()), alpha_seen=alpha
    )
    after = weld(matter, web, state, pieces)
    at_ = after.peak < state.peak
    assert int(at_.sum()) > 50
    now = mapped(after.particles.strain, after.particles.alpha, after.peak)
    assert torch.equal(after.particles.strain, strain)
    assert torch.equal(now[1][at_], after.particles.alpha[at_])  # inside: no flow
    scale = float(before[2].abs().max())
    assert float((now[2] - before[2])[at_].abs().max()) <= 1e-12 * scale
    energy = [
        ops.elastic_energy(s, law=law, params=params, material=material)
        for s in (before[0], now[0])
    ]
    assert float((energy[1] - energy[0])[at_].abs().max()) <= 1e-12 * float(energy[0].max())
    for name in ("position",):
        assert torch.equal(getattr(after, name), getattr(state, name))
    assert torch.equal(after.particles.velocity, state.particles.velocity)
    assert torch.equal(after.particles.affine, state.particles.affine)


@pytest.mark.parametrize("cohesion", [None, 2.0, 10.0])
@pytest.mark.parametrize("share", [0.1, 0.7, 1.0])
def test_surfaces_are_nested_in_alpha(share: float, cohesion: float | None) -> None:
    """A state on the surface of weaker matter lies inside that of stronger matter."""
    generator = torch.Generator().manual_seed(7)
    matter = halves()[0]
    count = 2000
    params = matter.params[:1].double()
    if cohesion is not None:  # Rankine's surface
        params[0, 5] = -cohesion
    law = matter.law[:1]
    start = float(matter.particles.alpha[0])
    weak = torch.full((count,), share * start, dtype=torch.float64)
    load = 0.2 * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    strain, alpha, stress, info = ops.return_mapping(
        torch.zeros(count, 6, dtype=torch.float64), weak, load, law=law, params=params,
        material=torch.zeros(count, dtype=torch.int32),
    )  # fmt: skip
    assert int(info[0]) > 0.5 * count
    strong = torch.minimum(alpha, torch.full_like(alpha, start)) - 0.01
    again, kept, now, _ = ops.return_mapping(
        strain, strong, torch.zeros_like(load), law=law, params=params,
        material=torch.zeros(count, dtype=torch.int32),
    )  # fmt: skip
    assert torch.equal(kept, strong) and torch.equal(again, strain)
    assert float((now - stress).abs().max()) <= 1e-12 * float(stress.abs().max())
