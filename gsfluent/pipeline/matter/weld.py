"""The weld: broken matter of a piece regains its strength inside of its piece.

Once the pieces on both sides of a crack have velocity fields of their own, these carry the crack,
and the loose band between them is no longer needed. Points of it that have come to rest inside get
``alpha = peak = w alpha0``; strain, velocity and place stay. Stored energy and stress are functions
of the strain alone, so energy, momentum and stress do not jump where the old state lies inside the
new surface. Yield surfaces of NACC are nested in alpha (``p0`` and the tip grow with ``-alpha``);
they are not in the cohesion that comes back, since ``q^2 ~ (p + beta p0) (p0 - p) / (1 + 2 beta)``
falls with beta above ``p0 / 2``. So the return map itself is asked, and what would flow is left as
it is: matter under nearly all the pressure that it holds. What breaks still, or was crushed, is
never welded.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsfluent import ops
from gsfluent.materials import LAWS, UNBROKEN
from gsfluent.pipeline.matter.pieces import Pieces, Web
from gsfluent.pipeline.matter.points import Matter
from gsfluent.pipeline.matter.state import State

STRENGTH = 0.7
"""Share of its alpha at the start that a welded point gets."""
STILL = 2e-3
"""Change of alpha below which a point stands still."""
REST = 2e-3
"""How long it must stand still [s]."""
HOPS = 3
"""Links from a cut between two pieces within which matter is welded."""
PIECE = 0.02
"""Share of its body's mass from which a piece counts."""
CRUSHED = 0.1
"""Work of crushing, in units of ``p0(alpha0)``, from which matter is powder for good."""
_TIP = 1e-5  # p0 / kappa of matter that has no strength left (csrc/core/material/nacc.h)


def seen(state: State) -> State:
    """Note whose alpha has moved since it was last noted, and when."""
    alpha = state.particles.alpha
    moved = (alpha - state.alpha_seen).abs() > STILL
    return state._replace(
        alpha_seen=torch.where(moved, alpha, state.alpha_seen),
        time_seen=torch.where(moved, state.time, state.time_seen),
    )


def crushed(matter: Matter, lowest: Tensor) -> Tensor:
    """Points that were crushed: compacted with more than a tenth of ``p0(alpha0)``, bool [N].

    The work of compaction is the integral of ``max(p, 0)`` over ``-d eps_v^p``. Without shear
    damage alpha *is* the plastic volume strain, it compacts only below its start, and the pressure
    there is at most ``p0(a) = kappa (1e-5 + sinh(xi |a|))``; so the work is at most the integral of
    ``p0`` from the lowest alpha ever seen to that of the start. That bound is what is asked: it
    errs towards powder. Alpha is seen after every call of the engine, 128 steps or less apart.

    Args:
        matter: The points.
        lowest: Least alpha each point ever had, [N].
    """
    row = matter.particles.material.long()
    harden = matter.params[row, 4].double()
    start = (-matter.particles.alpha.double()).clamp(min=0.0)
    deep = torch.maximum((-lowest.double()).clamp(min=0.0), start)
    work = _TIP * (deep - start)
    work = work + (torch.cosh(harden * deep) - torch.cosh(harden * start)) / harden.clamp(min=1e-30)
    return work > CRUSHED * (_TIP + torch.sinh(harden * start))


def weldable(matter: Matter, web: Web, state: State, pieces: Pieces) -> Tensor:
    """Points that may be welded now, bool [N].

    Args:
        matter: The points.
        web: What hangs together at rest.
        state: After :func:`seen`.
        pieces: The pieces of this state.
    """
    labels = pieces.fragments.labels.long()
    none = torch.zeros_like(state.ever)
    broken = matter.brittle & (state.peak >= 0) & (labels >= 0)
    broken = broken & (state.time - state.time_seen >= REST)
    if not bool(broken.any()):
        return none
    ids = pieces.fragments.ids.to(labels.device)
    fractions = pieces.fragments.mass_fractions.to(labels.device)
    bodies = web.may_break.shape[0]
    large = fractions > PIECE * web.share[web.body[ids]]
    apart = torch.bincount(web.body[ids[large]], minlength=bodies) >= 2
    if not bool(apart.any()):
        return none
    a, b = web.links.unbind(dim=1)
    both = (labels[a] >= 0) & (labels[b] >= 0)
    border = pieces.cut_links & both & (labels[a] != labels[b]) & apart[web.body[a]]
    near = none.index_fill(0, torch.cat([a[border], b[border]]), True)
    holds = ~pieces.cut_links & both
    a, b = a[holds], b[holds]
    for _ in range(HOPS):
        spread = near.clone()
        spread[a[near[b]]] = True
        spread[b[near[a]]] = True
        near = spread
    return broken & near & ~crushed(matter, state.lowest)


def weld(matter: Matter, web: Web, state: State, pieces: Pieces) -> State:
    """The state with those points of :func:`weldable` welded whose state the surface holds."""
    at = weldable(matter, web, state, pieces)
    rows = at.nonzero()[:, 0]
    if rows.numel() == 0:
        return state
    alpha, strain = state.particles.alpha, state.particles.strain
    strong = (STRENGTH * matter.particles.alpha).to(alpha)
    wanted, held = strong[rows], strain[rows]
    after, kept, _, _ = ops.return_mapping(
        held, wanted, strain.new_zeros(rows.shape[0], 3, 3), law=matter.law,
        params=matter.params.to(strain), material=state.particles.material[rows], dt=1.0,
    )  # fmt: skip
    fits = (after == held).all(dim=1) & (kept == wanted) & (alpha[rows] >= wanted)
    at = at.index_put((rows,), fits)
    alpha = torch.where(at, strong, alpha)
    # what is undamaged in a phase field has a peak of -1
    phase = matter.law[matter.particles.material.long()] == LAWS["phase_field"]
    peak = torch.where(phase, UNBROKEN, strong.to(state.peak))
    return state._replace(
        particles=state.particles.replace(alpha=alpha),
        peak=torch.where(at, peak, state.peak),
        alpha_seen=torch.where(at, alpha, state.alpha_seen),
    )
