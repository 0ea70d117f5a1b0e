"""More things in a running simulation: bodies, colliders, blades, impulses that come meanwhile.

A run whose scene had an event from the start and a run that is told of it when it happens are the
same: bodies wait, plates stand and blades hang still until their time, and all of them come after
what was there before. Nothing of the old state is touched, so momentum and energy of what is there
stay as they are, to the bit.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from gsfluent.data import Particles
from gsfluent.errors import InputError
from gsfluent.ops.solver_state import UNBROKEN
from gsfluent.pipeline.liquid.nozzle import WAITING, pours
from gsfluent.pipeline.matter.fragments import rest_links
from gsfluent.pipeline.matter.points import Matter, build_matter
from gsfluent.pipeline.matter.state import State
from gsfluent.pipeline.simulate.health import figures_of
from gsfluent.pipeline.simulate.run import Run
from gsfluent.scene.scene import Scene


def copy_of(scene: Scene) -> Scene:
    """A scene that can be added to without changing the first."""
    twin = copy.copy(scene)
    twin.bodies, twin.colliders = list(scene.bodies), list(scene.colliders)
    twin.blades, twin.impulses = list(scene.blades), list(scene.impulses)
    return twin


def grow(run: Run, scene: Scene, *, seed: int = 0) -> None:
    """Take up what a scene has more than the one that runs.

    Args:
        run: The run; its state stays, with rows for the new bodies at the end.
        scene: A :func:`copy_of` its scene with more at the end of its lists.
        seed: Seed of the points.

    Raises:
        InputError: A new body is a solid (its splats could not follow).
    """
    old, state = run.scene, run.state
    _without_heat(run)
    fresh = scene.bodies[len(old.bodies) :]
    for body in fresh:
        if body.solid is not None:
            raise InputError(
                f"live: {body.name!r} cannot be added while the simulation runs",
                hint="start a session with it in the scene",
            )
    matter = run.matter
    if fresh:
        alone = copy_of(scene)
        alone.bodies = list(fresh)
        more = build_matter(
            alone, matter.dx, seed=seed, device=matter.particles.device,
            inertia=run.stepper.options.inertia,
        )  # fmt: skip
        if matter.particles.deformation is None:
            more = dataclasses.replace(more, particles=more.particles.replace(deformation=None))
        matter = _joined(matter, more)
        flies = run.stepper.options.free_flight
        landed = tuple(not flies or pours(body) for body in fresh)
        state = _joined_state(state, matter, landed)
    _refit(run, scene, matter, state)
    run.state = run.stepper.liquids.begun(run.state)
    run.state = run.state._replace(colliders=_colliders(run, old, state))
    if fresh:
        start = matter.ranges[len(old.bodies)][0]
        links = rest_links(
            matter.rest[start:],
            tuple((a - start, b - start) for a, b in matter.ranges[len(old.bodies) :]),
            matter.spacing[len(old.bodies) :],
        )
        run.links = torch.cat([run.links, (links + start).to(run.links)])
        cut = run.state.cut_links
        run.state = run.state._replace(cut_links=torch.cat([cut, cut.new_zeros(len(links))]))
        rows = torch.arange(start, matter.particles.count, device=matter.particles.device)
        held = [body.start if body.held and not pours(body) else 0.0 for body in fresh]
        _account(run, rows, held, sign=1.0)
        run.ledger.wait(run.stepper.liquids.held(start), run.state.time)


def shrink(run: Run, gone: Sequence[int], *, solids: int) -> None:
    """Take bodies without a solid out of a run: their matter leaves with its momentum and energy.

    Args:
        run: The run.
        gone: Numbers of the bodies.
        solids: How many bodies at the beginning cannot go.

    Raises:
        ValueError: A body is among the first, or does not exist.
    """
    wrong = [n for n in gone if not solids <= n < len(run.scene.bodies)]
    if wrong:
        raise ValueError(f"shrink: bodies {wrong} cannot leave")
    if not gone:
        return
    _without_heat(run)
    matter, state = run.matter, run.state
    device = matter.particles.device
    out = torch.isin(matter.particles.body, torch.tensor(list(gone), device=device).int())
    _account(run, out.nonzero()[:, 0], [0.0] * len(gone), sign=-1.0)
    keep = (~out).nonzero()[:, 0]
    place = torch.cumsum((~out).long(), 0) - 1
    stay = [n for n in range(len(run.scene.bodies)) if n not in set(gone)]
    number = torch.zeros(len(run.scene.bodies), dtype=torch.int32, device=device)
    number[stay] = torch.arange(len(stay), dtype=torch.int32, device=device)

    def kept(particles: Particles) -> Particles:
        rest = particles.select(keep)
        return rest.replace(body=number[rest.body.long()])

    ranges, done = [], 0
    for n in stay:
        a, b = matter.ranges[n]
        ranges.append((done, done + b - a))
        done += b - a
    matter = dataclasses.replace(
        matter,
        particles=kept(matter.particles),
        ranges=tuple(ranges),
        spacing=tuple(matter.spacing[n] for n in stay),
    )
    group = state.group[keep]
    # A group is called after its first row, which may be one that left.
    first = torch.where(out, torch.full_like(place, -1), place)
    for name in torch.unique(group[group >= 0]).tolist():
        if int(first[name]) < 0:
            group = torch.where(group == name, -2 - int((group == name).nonzero()[0, 0]), group)
    named = torch.where(group >= 0, first[group.clamp(min=0).long()].to(group), -2 - group)
    unit = state.unit[keep]  # pieces are of one body: their first rows stay with them
    state = state._replace(
        particles=kept(state.particles),
        landed=tuple(state.landed[n] for n in stay),
        group=torch.where((group == -1) | (group == WAITING), group, named),
        unit=torch.where(unit >= 0, place[unit.clamp(min=0)], unit),
        cut_links=state.cut_links[~out[run.links].any(dim=1)],
        **{
            key: getattr(state, key)[keep]
            for key in (
                "position",
                "peak",
                "loose",
                "field",
                "cut",
                "asleep",
                "calm",
                "calm_at",
                "ever",
                "lowest",
                "alpha_seen",
                "time_seen",
            )
        },
    )
    scene = copy_of(run.scene)
    scene.bodies = [run.scene.bodies[n] for n in stay]
    scene.impulses = [
        dataclasses.replace(push, body=int(number[push.body])) for push in scene.impulses
    ]
    run.links = place[run.links[~out[run.links].any(dim=1)]]
    run.stepper.flights = [run.stepper.flights[n] for n in stay]
    _refit(run, scene, matter, state)


def _without_heat(run: Run) -> None:
    """Refuse a run whose points have temperatures.

    Raises:
        InputError: They have.
    """
    if run.matter.ladder is not None:
        raise InputError(
            "live: nothing can be added to or taken from a scene that has temperatures",
            hint="start a session with it in the scene, or leave out the temperatures",
        )


def _refit(run: Run, scene: Scene, matter: Matter, state: State) -> None:
    """Give a run another scene, its matter and a state that fits them."""
    run.fit(scene, matter)
    run.state = state


def _colliders(run: Run, old: Scene, state: State) -> Tensor:
    """Rows of all colliders now: those that were there as they are, the new ones as at their start.

    Nothing new can have moved before its start.
    """
    rigid = run.stepper.rigid
    added = len(run.scene.colliders) - len(old.colliders)
    if added == 0:
        return state.colliders
    rows = torch.cat([state.colliders, rigid.start[rigid.count - added :]])
    return rigid.scheduled(rows, state.time)


def _joined(a: Matter, b: Matter) -> Matter:
    """Matter of both; the table of materials keeps its rows and gets those it lacks."""
    table = torch.cat([a.law[:, None].to(a.params), a.params], dim=1)
    more = torch.cat([b.law[:, None].to(b.params), b.params], dim=1)
    same = (table[:, None] == more[None]).all(dim=2)
    known = same.any(dim=0)
    row = torch.where(known, same.to(torch.int8).argmax(dim=0), 0)
    row[~known] = table.shape[0] + torch.arange(int((~known).sum()), device=row.device)
    points = b.particles
    points = points.replace(
        material=row[points.material.long()].to(torch.int32),
        body=points.body + len(a.ranges),
    )
    done = a.particles.count
    return Matter(
        particles=Particles.cat([a.particles, points]),
        law=torch.cat([a.law, b.law[~known]]),
        params=torch.cat([a.params, b.params[~known]]).contiguous(),
        ranges=a.ranges + tuple((first + done, last + done) for first, last in b.ranges),
        spacing=a.spacing + b.spacing,
        dx=a.dx,
    )


def _joined_state(state: State, matter: Matter, landed: tuple[bool, ...]) -> State:
    """A state with the points that matter has more, as they start."""
    first = state.particles.count
    rows = torch.arange(first, matter.particles.count, device=state.position.device)
    new = matter.particles.select(rows)
    brittle = matter.brittle[first:]
    starts = torch.tensor([a for a, _ in matter.ranges], device=rows.device)

    def more(name: str, value: bool | int) -> Tensor:
        old = getattr(state, name)
        return torch.cat([old, old.new_full((rows.shape[0],), value)])

    return state._replace(
        particles=Particles.cat([state.particles, new]),
        position=torch.cat([state.position, new.position.to(torch.float64)]),
        peak=torch.cat([state.peak, torch.where(brittle, new.alpha, UNBROKEN).to(state.peak)]),
        landed=state.landed + landed,
        loose=more("loose", False),
        field=torch.cat([state.field, new.body.to(state.field)]),
        cut=more("cut", 0),
        group=more("group", -1),
        asleep=more("asleep", False),
        calm=more("calm", 0),
        calm_at=torch.cat([state.calm_at, new.position.to(torch.float64)]),
        unit=torch.cat([state.unit, starts[new.body.long()]]),
        ever=torch.cat([state.ever, brittle & (new.alpha >= 0)]),
        lowest=torch.cat([state.lowest, new.alpha]),
        alpha_seen=torch.cat([state.alpha_seen, new.alpha]),
        time_seen=more("time_seen", 0),
    )


def _account(run: Run, rows: Tensor, held: list[float], *, sign: float) -> None:
    """Enter matter that comes (sign 1) or leaves (-1) in the balances of momentum and energy."""
    matter, state = run.matter, run.state
    body = matter.particles.body[rows]
    part = dataclasses.replace(matter, particles=matter.particles.select(rows))
    there = state._replace(
        particles=state.particles.select(rows), position=state.position[rows],
        peak=state.peak[rows], ever=state.ever[rows], field=state.field[rows],
    )  # fmt: skip
    now = figures_of(part, there, run.scene.gravity)
    run.watch.energy += sign * now.total
    run.watch.scale = max(run.watch.scale, now.kinetic + now.elastic)
    run.start = dataclasses.replace(run.start, gravity=run.start.gravity + sign * now.total)
    mass = part.particles.mass.double()
    names = torch.unique(body).tolist()
    momentum = torch.tensor(now.momentum, dtype=torch.float64)
    weights = [float(mass[body == name].sum()) for name in names]
    waits = [(m, t) for m, t in zip(weights, held, strict=True) if sign > 0 and t > 0]
    run.ledger.change(sign * sum(weights), sign * momentum, state.time, waits)
