"""A law for every point: experts mixed on a grid of nodes (after OmniPhysGS, Lin et al. 2025).

At every place lies a point of each law, and its mass and volume are the law's share there. All move
with the same grid from the same start, so they stay together: the stress on the grid is that of the
laws weighted by their shares, and each has a strain of its own. Shares are a softmax of logits on
nodes over a temperature that falls. The resident solver does the runs: one gradient by the adjoint
of the composed step costs 80 of them, so differences for up to a hundred numbers are cheaper, and
give a whole Jacobian.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsfluent.data.solid import Solid
from gsfluent.errors import InputError
from gsfluent.materials import LAWS, Material
from gsfluent.pipeline.fit.forward import Forward, Matter
from gsfluent.pipeline.fit.laws import NUMBERS, under_law
from gsfluent.pipeline.fit.parameters import (
    FINER,
    LOGITS,
    VECTORS,
    Parameter,
    Unknowns,
    parameter,
    read_learn,
)
from gsfluent.pipeline.fit.solve import Problem, in_stages
from gsfluent.pipeline.fit.task import EXTRAPOLATION, OFFSET, OFFSET_PRIOR, RATIO
from gsfluent.scene.scene import Part, Scene
from gsfluent.targets.target import Target

Array = NDArray[np.float64]
TEMPERATURES = (1.0, 0.3, 0.1)
"""Of the softmax, one after the other."""
BELIEF = 1.0
"""Standard deviation of a logit beforehand."""
LEAST = 1e-6
"""Least share of a law: points without mass move by themselves."""
MOST_NUMBERS = 160


class Mixed(Forward):
    """A scene of one object whose every place has a share of each law.

    Args:
        scene: One object without parts.
        times: Of the frames [s].
        dx: Grid spacing [m].
        laws: At least two.
        nodes: Nodes along each axis.
        device: Where the solver runs.

    Raises:
        InputError: Several objects, or parts.
    """

    def __init__(
        self, scene: Scene, times: list[float], dx: float, laws: Sequence[str], nodes: int,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        if len(scene.bodies) != 1 or scene.bodies[0].parts:
            raise InputError(
                "fit: laws per point are for one object without parts",
                "take the others out, or try laws per part",
            )
        body = scene.bodies[0]
        self.laws, self.temperature, self.name = tuple(laws), 1.0, body.name
        self.experts = [under_law(body.material, law) for law in laws]
        plain = dataclasses.replace(body, material=self.experts[0])
        alone = Scene.__new__(Scene)
        alone.__dict__.update(scene.__dict__)
        alone.bodies = [plain]
        super().__init__(alone, times, dx, device=device)
        self.solid = "fluid" not in laws
        self.basis = corners(self.rest, self.rest, nodes)
        self._numbers = torch.tensor([LAWS[law] for law in laws], dtype=torch.int32)

    def shares(self, values: Mapping[str, Any]) -> Tensor:
        """Share of each law at each point, [N, K]."""
        return shares(self.basis, values[f"{self.name}.{LOGITS}"], len(self.laws), self.temperature)

    def _materials(self, values: Mapping[str, Any]) -> list[Material]:
        found = []
        for expert in self.experts:
            keys = {f: f"{self.name}.{f}" for f in expert.reads}
            changes = {f: values[key] for f, key in keys.items() if key in values}
            found.append(dataclasses.replace(expert, **changes) if changes else expert)
        return found

    def _matter(self, values: Mapping[str, Any]) -> Matter:
        share = self.shares(values).T.reshape(-1)
        count = len(self.laws)
        plain = super()._matter(values)
        return plain._replace(
            law=self._numbers, copies=count, mass=plain.mass.repeat(count) * share,
            volume=plain.volume.repeat(count) * share,
            material=torch.arange(count, dtype=torch.int32).repeat_interleave(self.count),
        )  # fmt: skip


def corners(places: Tensor, box: Tensor, nodes: int) -> Tensor:
    """Trilinear weights of the nodes of a grid about points.

    Args:
        places: [M, 3].
        box: Points that the grid encloses, [N, 3].
        nodes: Along each axis.

    Returns:
        [M, nodes^3]; rows add up to 1.
    """
    low, high = box.amin(dim=0), box.amax(dim=0)
    at = ((places - low) / (high - low).clamp(min=1e-12)).clamp(0.0, 1.0) * (nodes - 1)
    axis = torch.arange(nodes, dtype=at.dtype)
    hat = (1.0 - (at[:, :, None] - axis).abs()).clamp(min=0.0)  # [M, 3, nodes]
    return torch.einsum("mi,mj,mk->mijk", *hat.unbind(dim=1)).reshape(len(places), -1)


def shares(basis: Tensor, logits: Sequence[float], count: int, temperature: float) -> Tensor:
    """Softmax of logits over a temperature; the first law's logits are 0.

    Args:
        basis: [N, nodes^3].
        logits: Of the other laws at the nodes, nodes^3 (count - 1) numbers.
        count: How many laws.
        temperature: Small ones make shares 0 or 1.

    Returns:
        [N, count], none below :data:`LEAST`; rows add up to 1.
    """
    other = basis @ torch.as_tensor(logits, dtype=basis.dtype).reshape(-1, count - 1)
    all_ = torch.cat([torch.zeros_like(other[:, :1]), other], dim=1)
    found = torch.softmax(all_ / temperature, dim=1).clamp(min=LEAST)
    return found / found.sum(dim=1, keepdim=True)


@dataclasses.dataclass(frozen=True)
class FieldTask:
    """A search for a law per point: picklable.

    Attributes:
        scene: The start.
        target: What was seen.
        laws: Experts.
        learn: What is learnt beside their numbers, by ``OBJECT.NUMBER``: velocities.
        dx: Of the coarser grid [m].
        grids: 1 or 2.
        offset: Learn the offset of the floor.
        nodes: Along each axis.
        device: Where the solver runs.
    """

    scene: Scene
    target: Target
    laws: tuple[str, ...]
    learn: Mapping[str, Any]
    dx: float
    grids: int
    offset: bool
    nodes: int
    device: str = "cpu"


def run_field(task: FieldTask) -> dict[str, Any]:
    """Do the search; ``values``, ``rms`` and ``runs`` come back.

    Raises:
        InputError: More numbers than :data:`MOST_NUMBERS`, or what is to be learnt cannot be.
        TooFast: The start cannot be run.
    """
    times = list(task.target.times)
    grids = [Mixed(task.scene, times, task.dx / RATIO**k, task.laws, task.nodes, task.device)
             for k in range(task.grids)]  # fmt: skip
    unknowns = _unknowns(task, grids[0])
    if len(unknowns) > MOST_NUMBERS:
        raise InputError(
            f"fit: {len(unknowns)} numbers for {len(task.laws)} laws on {task.nodes}^3 nodes",
            f"take fewer laws or nodes: {MOST_NUMBERS} numbers at most",
        )
    bound = [task.target.observe(grid.setting()) for grid in grids]
    problem = Problem(grids[0], bound[0], unknowns, task.target.step,
                      fine=bound[1] if task.grids == 2 else None)  # fmt: skip
    free = unknowns.start
    for number, temperature in enumerate(TEMPERATURES):
        for grid in grids:
            grid.temperature = temperature
        problem.forget()
        part = (0.5,) if number == 0 else (1.0,)
        finer = grids[1] if task.grids == 2 else None
        last = temperature == TEMPERATURES[-1]
        found = in_stages(problem, free, finer=finer, shares=part, settle=last, weigh=False)
        free = found.free
    runs = [grid.runs for grid in grids]
    return {"values": unknowns.values(free), "rms": found.rms, "runs": runs}


def _unknowns(task: FieldTask, grid: Mixed) -> Unknowns:
    learn = [key for key in task.learn if key.partition(".")[2] in VECTORS]
    made = list(read_learn(task.scene, learn).parameters) if learn else []
    # a number that several laws read is one until their regions are known: two moduli that share a
    # place could not be told apart
    wanted = {f: expert for law, expert in zip(task.laws, grid.experts, strict=True)
              for f in NUMBERS[law]}  # fmt: skip
    made += [parameter(grid.name, expert, f, True) for f, expert in wanted.items()]
    count = task.nodes**3 * (len(task.laws) - 1)
    made.append(Parameter(f"{grid.name}.{LOGITS}", (0.0,) * count, spread=BELIEF))
    if task.offset and task.scene.floor is not None and not task.scene.colliders:
        made.append(Parameter(OFFSET, (OFFSET_PRIOR[0],), spread=OFFSET_PRIOR[1]))
    if task.grids == 2:
        made.append(Parameter(FINER, (EXTRAPOLATION[0],), spread=EXTRAPOLATION[1]))
    return Unknowns(made)


def regions(solid: Solid, logits: Sequence[float], count: int, nodes: int) -> Tensor:
    """The law with the largest share in each voxel, int32 [X, Y, Z]; 0 outside."""
    index = solid.occupancy.nonzero()
    centers = solid.voxel_centers(index).double().cpu()
    share = shares(corners(centers, centers, nodes), logits, count, TEMPERATURES[-1])
    found = torch.zeros(solid.occupancy.shape, dtype=torch.int32)
    found[tuple(index.cpu().T)] = share.argmax(dim=1).to(torch.int32)
    return found


def divided(scene: Scene, laws: Sequence[str], values: Mapping[str, Any], nodes: int) -> Scene:
    """The scene with a part for each law but the one that most of the object has.

    Args:
        scene: As of :class:`Mixed`.
        laws: Experts.
        values: Of :func:`run_field`; numbers stay those of the start.
        nodes: Along each axis.
    """
    body = scene.bodies[0]
    solid = body.solid
    assert solid is not None  # what is shot was refused
    number = regions(solid, values[f"{body.name}.{LOGITS}"], len(laws), nodes)
    size = torch.bincount(number[solid.occupancy.cpu()], minlength=len(laws))
    first = int(size.argmax())
    parts = tuple(
        Part(law, {"region": k}, {"material": under_law(body.material, law)})
        for k, law in enumerate(laws)
        if k != first and int(size[k])
    )
    made = Scene.__new__(Scene)
    made.__dict__.update(scene.__dict__)
    made.bodies = [
        dataclasses.replace(
            body, material=under_law(body.material, laws[first]), parts=parts,
            solid=dataclasses.replace(solid, regions=number.to(solid.occupancy.device)),
        )
    ]  # fmt: skip
    return made
