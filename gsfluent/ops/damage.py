"""The damage field of phase-field fracture: one solve on the nodes per step.

Node sums of the points, a seven-point Laplacian, red-black SOR with bounds and a fixed number of
sweeps (docs/theory/phase-field.md). Plain PyTorch, so that it runs on any device; the resident
solver on the CPU has its own (csrc/cpu/solver/damage.h). The sums are integers: their order does
not matter.

Sources: Bourdin, Francfort and Marigo 2000; Pham et al. 2011 (AT1); Miehe et al. 2010 (history);
Mangasarian 1977 (SOR with bounds).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsfluent._check import check_tensor
from gsfluent.materials.laws import LAWS
from gsfluent.materials.phase_field import GRID_ENERGY, MODELS
from gsfluent.ops.blocks import Blocks, check_blocks, check_dx
from gsfluent.ops.reference.phase_field import BROKEN, DRIVE_MAX, EMPTY, drive_threshold

SWEEPS = 4
OMEGA = 1.5
"""Over-relaxation (``kOmega``)."""
ACTIVE = {"at1": 0.5, "at2": 1e-3}
"""History over the threshold from which a point's block takes part (``kActiveDrive``)."""
_BITS = 62
_NEAR = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


class Nodes(NamedTuple):
    """The part of the grid that takes part, and where the points that reach it lie.

    Attributes:
        rows: Points that reach it, int64 [P].
        at: Row of each of their 27 nodes, int64 [P, 27]; -1 outside.
        weight: B-spline weights, [P, 27].
        near: Row of the six neighbours of each node, int64 [A, 6]; -1 in a block that takes no
            part, -2 where there is no block.
        odd: Whether the sum of a node's indices is odd, bool [A].
    """

    rows: Tensor
    at: Tensor
    weight: Tensor
    near: Tensor
    odd: Tensor


def reduced_toughness(toughness: Any, length: Any, dx: float, model: str) -> Any:
    """Toughness that the solver works with, so that a crack on this grid costs ``toughness``."""
    return toughness / (1.0 + GRID_ENERGY[model] * dx / length)


def _block_at(table: Tensor, cell: Tensor, origin: Sequence[int]) -> Tensor:
    """Index of the blocks at block coordinates [..., 3], -1 where there is none."""
    at = cell - torch.tensor(origin, device=cell.device)
    size = torch.tensor(table.shape, device=cell.device)
    inside = ((at >= 0) & (at < size)).all(dim=-1)
    at = torch.where(inside[..., None], at, 0)
    found = table[at[..., 0], at[..., 1], at[..., 2]].long()
    return torch.where(inside, found, -1)


def _nodes(position: Tensor, active: Tensor, field: Tensor, dx: float, blocks: Blocks) -> Nodes:
    """Nodes of the blocks of active points and of those around them, field by field."""
    device, count = position.device, blocks.block_count
    u = position.detach() * (1.0 / dx) - 0.5
    base = torch.floor(u).long()
    axis = torch.arange(-1, 2, device=device)
    around = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(27, 3)
    beside = _block_at(blocks.table, blocks.coords.long()[:, None] + around, blocks.origin)
    own = _block_at(blocks.table, base >> 2, blocks.origin)
    seeds = torch.unique((field * count + own)[active & (own >= 0)])
    found = beside[seeds % count]
    wide = torch.where(found >= 0, (seeds // count * count)[:, None] + found, -1)
    used = torch.unique(wide[wide >= 0])
    number = torch.full((count * (int(field.max()) + 1),), -1, dtype=torch.int64, device=device)
    number[used] = torch.arange(used.shape[0], device=device)

    def row(block: Tensor, local: Tensor, of: Tensor) -> tuple[Tensor, Tensor]:
        """Row and block of the nodes at ``local``, -1 to 7 an axis, from the corner of a block."""
        step, inner = (local >> 2) + 1, local & 3
        there = beside[block.clamp(min=0), (step[..., 0] * 3 + step[..., 1]) * 3 + step[..., 2]]
        place = torch.where(there >= 0, number[(of * count + there).clamp(min=0)], -1)
        node = (inner[..., 0] * 4 + inner[..., 1]) * 4 + inner[..., 2]
        return torch.where(place >= 0, place * 64 + node, -1), there

    corner = around.clamp(min=0)[(around != 0).all(dim=1)] * 2  # 0 or 2 on each axis
    reach = row(own[:, None], (base & 3)[:, None] + corner, field[:, None])[0]
    rows = (reach >= 0).any(dim=1).nonzero()[:, 0]
    local = (base[rows] & 3)[:, None] + around + 1
    at = row(own[rows][:, None], local, field[rows][:, None])[0]
    o = position[rows] * (1.0 / dx) - 0.5 - base[rows]
    w = torch.stack([0.5 * (1 - o) ** 2, 0.75 - (o - 0.5) ** 2, 0.5 * o**2], dim=1)
    i, j, k = (around + 1).unbind(dim=1)
    weight = w[:, i, 0] * w[:, j, 1] * w[:, k, 2]
    inner = torch.stack(torch.meshgrid(*[torch.arange(4, device=device)] * 3, indexing="ij"), -1)
    inner = inner.view(64, 3)
    step = torch.tensor(_NEAR, device=device)
    near, there = row(
        (used % count)[:, None, None], inner[None, :, None] + step, (used // count)[:, None, None]
    )
    near = torch.where(there < 0, -2, near).view(-1, 6)
    odd = ((inner.sum(dim=1) & 1) == 1).repeat(used.shape[0])
    return Nodes(rows, at, weight, near, odd)


def _sums(nodes: Nodes, values: Tensor) -> Tensor:
    """Sums of the columns of [P, C] at the nodes, [A, C], the same in any order of the points."""
    inside = nodes.at >= 0
    place = torch.where(inside, nodes.at, 0).view(-1)
    given = torch.where(inside, nodes.weight, 0.0)[..., None] * values[:, None]
    given = given.view(-1, values.shape[1])
    count = nodes.near.shape[0]
    with torch.no_grad():
        most = given.abs().amax(dim=0).double().clamp(min=1e-300)
        unit = torch.exp2(torch.ceil(torch.log2(most * given.shape[0])) - _BITS)
        words = torch.round(given.double() / unit).long()
        total = words.new_zeros(count, values.shape[1]).index_add_(0, place, words)
        exact = (total.double() * unit).to(given)
    if not given.requires_grad:
        return exact
    plain = given.new_zeros(count, values.shape[1]).index_add(0, place, given)
    return plain + (exact - plain).detach()


def _edges(nodes: Nodes, stiff: Tensor, there: Tensor) -> Tensor:
    """Coefficient towards the six neighbours of each node, [A, 6]; 0 towards empty ones.

    Neighbours that take no part are undamaged and weigh as the node itself.
    """
    other, known = nodes.near.clamp(min=0), nodes.near >= 0
    both = known & there[:, None] & there[other]
    edge = torch.where(both, 0.5 * (stiff[:, None] + stiff[other]), 0.0)
    return torch.where(nodes.near == -1, stiff[:, None], edge)


class _Relax(torch.autograd.Function):
    """Red-black SOR within bounds, and the adjoint of the solution on its free nodes."""

    @staticmethod
    def forward(
        start: Tensor, diagonal: Tensor, right: Tensor, edge: Tensor, near: Tensor, odd: Tensor,
        sweeps: int,
    ) -> Tensor:  # fmt: skip
        whole, edge = diagonal + edge.sum(dim=1), torch.where(near >= 0, edge, 0.0)
        d = start.clone()
        colours = [((odd == colour) & (whole > 0)).nonzero()[:, 0] for colour in (False, True)]
        parts = [(at, edge[at], near[at].clamp(min=0), right[at], whole[at]) for at in colours]
        for _ in range(sweeps):
            for at, k, other, b, a in parts:
                solved = (b + (k * d[other]).sum(dim=1)) / a
                d[at] = (d[at] + OMEGA * (solved - d[at])).clamp(0.0, 1.0)
        return d

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, diagonal, right, edge, near, odd, _ = inputs
        ctx.save_for_backward(output, diagonal, right, edge, near, odd)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        d, diagonal, _, edge, near, odd = ctx.saved_tensors
        other, whole = near.clamp(min=0), diagonal + edge.sum(dim=1)
        free = (d > 0) & (d < 1) & (whole > 0)
        given = torch.where(free, grads[0], 0.0)
        x, pull = torch.zeros_like(given), torch.where(near >= 0, edge, 0.0)
        # The system is symmetric: the same sweeps, without bounds, until nothing moves.
        for _ in range(_ADJOINT_SWEEPS):
            before = x.clone()
            for colour in (False, True):
                solved = (given + (pull * x[other]).sum(dim=1)) / torch.where(free, whole, 1.0)
                x = torch.where(free & (odd == colour), x + OMEGA * (solved - x), x)
            if not bool((x - before).abs().max() > 1e-14 * x.abs().max()):
                break
        return (
            None,
            -x * d,
            x,
            -x[:, None] * (d[:, None] - torch.where(near >= 0, d[other], 0.0)),
            None,
            None,
            None,
        )


_ADJOINT_SWEEPS = 2000


class Solved(NamedTuple):
    """Result of :func:`solve_drive`.

    Attributes:
        damage: Of every point, [N].
        nodes: Where the field was solved, or None where nothing takes part.
        field: Damage of those nodes, [A].
        volume: Their volumes [m^3], [A].
    """

    damage: Tensor
    nodes: Nodes | None
    field: Tensor
    volume: Tensor


def solve_drive(
    drive: Tensor,
    volume: Tensor,
    position: Tensor,
    damage: Tensor,
    length: Tensor,
    *,
    dx: float,
    blocks: Blocks,
    model: str,
    sweeps: int = SWEEPS,
    body: Tensor | None = None,
    takes_part: Tensor | None = None,
) -> Solved:
    """:func:`damage_solve` for a history that is over its threshold already.

    Args:
        drive: H / psi_t, [N].
        volume: As there.
        position: As there.
        damage: As there.
        length: l of each point [m], [N].
        dx: As there.
        blocks: As there.
        model: As there.
        sweeps: As there.
        body: As there.
        takes_part: Points of the law, bool [N]; None for all.
    """
    active = (drive > ACTIVE[model]) | (damage > 0)
    if takes_part is not None:
        active = active & takes_part
    none = drive.new_zeros(0)
    if not bool(active.any()):
        return Solved(damage, None, none, none)
    field = torch.zeros_like(active, dtype=torch.int64) if body is None else body.long()
    nodes = _nodes(position, active, field, dx, blocks)
    rows = nodes.rows
    if takes_part is not None:
        volume = torch.where(takes_part, volume, 0.0)
    v = volume[rows]
    stiff = 2.0 * (length[rows] / dx) ** 2
    given = torch.stack([v * damage[rows], v * drive[rows].clamp(max=DRIVE_MAX), v * stiff, v], 1)
    sums = _sums(nodes, given)
    there = sums[:, 3] > EMPTY * volume.detach().max()
    guess, driven, stiff, here = torch.where(there[:, None], sums, 0.0).unbind(dim=1)
    guess = torch.where(there, guess / torch.where(there, here, 1.0), 0.0).detach()
    edge = _edges(nodes, stiff, there)
    at1 = model == "at1"
    diagonal = driven if at1 else driven + 2.0 * here
    right = driven - here if at1 else driven
    d = _Relax.apply(guess, diagonal, right, edge, nodes.near, nodes.odd, sweeps)
    inside = nodes.at >= 0
    gathered = torch.where(inside, nodes.weight * d[nodes.at.clamp(min=0)], 0.0).sum(dim=1)
    found = torch.maximum(damage[rows], gathered.clamp(0.0, 1.0))
    if takes_part is not None:
        found = torch.where(takes_part[rows], found, damage[rows])
    return Solved(damage.index_copy(0, rows, found), nodes, d, here)


class DamageField:
    """The damage of the phase-field points of a scene, step by step.

    Args:
        law: Law of each row, int32 [M].
        params: Parameters of each row, [M, 8].
        material: Row of each point, int32 [N].

    Attributes:
        exists: Whether any row is of the law.
        model: ``at1`` or ``at2``.

    Raises:
        ValueError: Rows of both models: one field has one.
    """

    def __init__(self, law: Tensor, params: Tensor, material: Tensor) -> None:
        phase = law == LAWS["phase_field"]
        self.exists = bool(phase.any())
        self.model = "at1"
        if not self.exists:
            return
        codes = params[phase, 5].long() >> 2
        if bool((codes != codes[0]).any()):
            raise ValueError("phase_field: at1 and at2 in one simulation; give all matter one")
        self.model = "at2" if int(codes[0]) else "at1"
        row = material.long()
        self.points: Tensor | None = None if bool(phase.all()) else phase[row]
        self.threshold, self.length = params[row, 2], params[row, 4]

    def solve(
        self, alpha: Tensor, peak: Tensor, position: Tensor, volume: Tensor, *, dx: float,
        blocks: Blocks, body: Tensor | None = None, sweeps: int = SWEEPS,
    ) -> Solved:  # fmt: skip
        """The field for a history ``alpha``, from the damage of ``peak``; :func:`solve_drive`."""
        return solve_drive(
            alpha + 1.0, volume, position, damage_of(peak), self.length, dx=dx, blocks=blocks,
            model=self.model, sweeps=sweeps, body=body, takes_part=self.points,
        )  # fmt: skip

    def step(
        self, alpha: Tensor, peak: Tensor, position: Tensor, volume: Tensor, **grid: Any
    ) -> Tensor:
        """Peak after one solve; arguments as :meth:`solve`."""
        d = self.solve(alpha, peak, position, volume, **grid).damage
        return torch.where(d > 0, torch.maximum(peak, d - BROKEN), peak)

    def grown(self, peak: Tensor, alpha: Tensor) -> Tensor:
        """Largest alpha so far, [N]; of phase-field points the damage that the last step found."""
        most = torch.maximum(peak, alpha)
        if not self.exists:
            return most
        return peak if self.points is None else torch.where(self.points, peak, most)

    def energy(
        self, alpha: Tensor, peak: Tensor, position: Tensor, volume: Tensor, **grid: Any
    ) -> Tensor:
        """What all cracks cost [J], float64 []; arguments as :meth:`solve`."""
        solved = self.solve(alpha, peak, position, volume, **grid)
        if self.points is not None:
            volume = torch.where(self.points, volume, 0.0)
        return crack_energy(solved, self.threshold, self.length, volume, grid["dx"], self.model)


def damage_of(peak: Tensor) -> Tensor:
    """Damage of points with these peaks, d - 0.95 where there is any damage."""
    return (peak + BROKEN).clamp(0.0, 1.0)


def crack_energy(solved: Solved, threshold: Tensor, length: Tensor, volume: Tensor, dx: float,
                 model: str) -> Tensor:  # fmt: skip
    """Energy of the cracks of a field that was solved [J], float64 [].

    Args:
        solved: The field.
        threshold: psi_t of each point [J/m^3], [N].
        length: l of each point [m], [N].
        volume: Of each point [m^3], 0 for those of other laws, [N].
        dx: Node spacing [m].
        model: ``at1`` or ``at2``.
    """
    nodes = solved.nodes
    if nodes is None:
        return torch.zeros((), dtype=torch.float64, device=volume.device)
    given = (volume * threshold)[nodes.rows]
    stiff = 2.0 * (length[nodes.rows] / dx) ** 2
    local, across = _sums(nodes, torch.stack([given, given * stiff], dim=1)).double().unbind(1)
    d = solved.field.double()
    cost = d if model == "at1" else d**2
    edge = _edges(nodes, across, solved.volume > 0)
    jump = d[:, None] - torch.where(nodes.near >= 0, d[nodes.near.clamp(min=0)], 0.0)
    share = torch.where(nodes.near >= 0, 0.5, 1.0)  # the other half is the neighbour's
    return (2.0 * local * cost).sum() + (share * edge * jump**2).sum()


def damage_solve(
    energy: Tensor,
    volume: Tensor,
    position: Tensor,
    damage: Tensor,
    *,
    dx: float,
    blocks: Blocks,
    toughness: float | Tensor,
    length: float | Tensor,
    model: str = "at1",
    sweeps: int = SWEEPS,
    body: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Damage after one solve of the field, and what its cracks cost.

    AT1: ``2 H d - (2 Gc l / c0) lap d = 2 H - Gc / (c0 l)`` within 0 and 1; AT2:
    ``(2 H + 2 Gc / (c0 l)) d - (2 Gc l / c0) lap d = 2 H``. Node sums of volume and history, the
    mean of two nodal volumes on each edge, none towards empty nodes, ``sweeps`` of red-black SOR
    (omega 1.5) from the nodal mean of ``damage``. Points take the larger of the field and what they
    had. Only the blocks of points with damage, or with more than half of the threshold of AT1, and
    those around them take part. Gc is reduced by the energy that the grid adds,
    ``1 + 0.9 dx / l`` (AT2: 1.2).

    Args:
        energy: History H, the largest psi+ so far [J/m^3], [N]; counted up to 1e4 thresholds.
        volume: Volume at rest [m^3], [N].
        position: Positions [m], [N, 3].
        damage: d of each point, 0 to 1, [N].
        dx: Node spacing [m].
        blocks: From :func:`build_blocks` for these points.
        toughness: Energy of a crack per area Gc [J/m^2], a number or [N].
        length: Half the half width of a crack, l [m], at least 2 dx; a number or [N].
        model: ``at1`` or ``at2``.
        sweeps: Of SOR.
        body: Field of each point, int32 [N]; fields are solved apart.

    Returns:
        ``(damage, energy)``: of each point, [N]; of all cracks [J], float64 [].

    Raises:
        TypeError: A tensor has a wrong dtype.
        ValueError: A shape or device is wrong, an unknown model, a toughness or length that is not
            positive, a length below 2 dx, or fewer than one sweep.

    Gradient: of ``damage`` with respect to ``energy`` and ``volume``, by the adjoint of the solved
    field on its free nodes; exact where the sweeps have converged. Deterministic: the same bits for
    any order of the points.
    """
    op = "damage_solve"
    check_tensor(op, "energy", energy, shape=("N",))
    n = energy.shape[0]
    check_tensor(op, "volume", volume, shape=(n,), like=energy)
    check_tensor(op, "position", position, shape=(n, 3), like=energy)
    check_tensor(op, "damage", damage, shape=(n,), like=energy)
    if body is not None:
        check_tensor(op, "body", body, shape=(n,), dtype=torch.int32, like=energy)
    check_blocks(op, blocks, position)
    dx = check_dx(op, dx)
    if model not in MODELS:
        raise ValueError(f"{op}: model must be one of {', '.join(MODELS)}, got {model!r}")
    if not sweeps >= 1:
        raise ValueError(f"{op}: sweeps must be at least 1, got {sweeps}")
    numbers = {}
    for name, value in (("toughness", toughness), ("length", length)):
        wide = torch.as_tensor(value, dtype=energy.dtype, device=energy.device)
        if wide.shape not in ((), (n,)):
            raise ValueError(f"{op}: {name} must be a number or [{n}], got {list(wide.shape)}")
        if not bool(((wide > 0) & torch.isfinite(wide)).all()):
            raise ValueError(f"{op}: {name} must be positive and finite")
        numbers[name] = wide.expand(n)
    size = numbers["length"]
    if bool((size < 2.0 * dx * (1.0 - 1e-6)).any()):
        raise ValueError(
            f"{op}: length must be at least 2 dx = {2.0 * dx:g} m, got {float(size.min()):g}"
        )
    threshold = drive_threshold(
        reduced_toughness(numbers["toughness"], size, dx, model), size, model
    )
    solved = solve_drive(
        energy / threshold, volume, position, damage, size,
        dx=dx, blocks=blocks, model=model, sweeps=sweeps, body=body,
    )  # fmt: skip
    cost = crack_energy(solved, threshold.detach(), size, volume.detach(), dx, model)
    return solved.damage, cost


__all__ = [
    "DamageField",
    "SWEEPS",
    "crack_energy",
    "damage_of",
    "damage_solve",
    "reduced_toughness",
    "solve_drive",
]
