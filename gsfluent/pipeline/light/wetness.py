"""Skin that a liquid has touched is wet: darker, glossier, and dries slowly.

A splat of something solid remembers one number, the moment at which it would have been all wet to
be as wet as it is: ``u = max(t_k + D ln c_k)`` over the frames k so far, with the contact ``c`` of
each, and it is ``exp((u - t) / D)`` wet. So a frame's wetness hangs on the frames up to it, on
nothing else, and drying asks for no steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gsfluent.data import Gaussians
from gsfluent.geometry import rgb_to_sh0
from gsfluent.pipeline.light.shade import to_display, to_linear
from gsfluent.pipeline.liquid.clear import Clear
from gsfluent.results.frames import DUST, SavedFrame
from gsfluent.spatial.neighbours import nearest_rows

TOUCH = (1.8, 2.5)
"""Distance of the nearest point of a liquid up to which it touches skin, and from which on it does
not, in spacings: contact on the grid keeps it 1.2 to 2.1 off what lies in it."""
DRIES = 30.0
"""Time in which wet skin dries to 1 / e [s]."""
FRESH = 0.95
"""What is wetter than this is not asked again whether it is touched."""
INTERNAL = 0.472
"""Share of diffuse light that water throws back into what it wets: 1 - 0.934 / 1.33^2."""
GLOSS = (0.55, 90.0)
"""k_s and n_s of wet skin; what is glossier stays so."""
_SIDE = 1 << 20


class _State(NamedTuple):
    """What is remembered of a frame: numbers of its splats, and ``u`` [s] of each in half."""

    ids: Tensor
    moment: Tensor


class Wetness:
    """The wetness of the splats of a film's frames.

    Args:
        load: A frame by its index, on the device of all others.
        liquids: The liquids of a frame, or None.
    """

    def __init__(
        self, load: Callable[[int], SavedFrame], liquids: Callable[[SavedFrame], Clear | None]
    ) -> None:
        self._load, self._liquids = load, liquids
        self._states: dict[int, _State] = {}

    def at(self, frame: SavedFrame) -> Tensor | None:
        """How wet each splat of a frame is, 0 to 1, [N]; None where there is no liquid.

        Frames are asked for in any order: those before that were never seen are loaded.
        """
        clear = self._liquids(frame)
        if clear is None:
            return None
        known = max((k for k in self._states if k <= frame.index), default=-1)
        for index in range(known + 1, frame.index):
            before = self._load(index)
            there = self._liquids(before)
            if there is not None:
                self._step(before, there)
        if frame.index not in self._states:
            self._step(frame, clear)
        moment = self._states[frame.index].moment.to(frame.gaussians.means)
        return torch.exp((moment - frame.time) / DRIES).clamp(max=1.0)

    def _step(self, frame: SavedFrame, clear: Clear) -> None:
        last = self._states.get(frame.index - 1)
        ids, means = frame.ids, frame.gaussians.means
        if last is None:
            moment = torch.full_like(means[:, 0], -torch.inf)
        elif torch.equal(last.ids, ids):
            ids, moment = last.ids, last.moment.to(means)
        else:
            moment = _handed(last, ids).to(means)
        wet = torch.exp((moment - frame.time) / DRIES)
        skin = (~clear.rows & (frame.ids < DUST) & (wet < FRESH)).nonzero()[:, 0]
        rows = clear.rows.nonzero()[:, 0]
        inside = frame.facts.get("liquid_inside", ())
        if inside:
            # what a solid holds does not wet its outside
            own = torch.isin(frame.body[frame.anchor[rows].long()], frame.body.new_tensor(inside))
            rows = rows[~own]
        if rows.numel() and skin.numel():
            h = float(clear.volume.median()) ** (1.0 / 3.0)
            near, liquid = _candidates(means[skin], means[rows], TOUCH[1] * h)
            skin = skin[near]
            if skin.numel():
                distance, _ = nearest_rows(liquid, means[skin], 1, TOUCH[0] * h)
                full, none = TOUCH
                contact = ((none - distance[:, 0] / h) / (none - full)).clamp(0.0, 1.0)
                touched = (frame.time + DRIES * contact.log()).to(means)
                moment = moment.index_copy(0, skin, torch.maximum(moment[skin], touched))
        self._states[frame.index] = _State(ids, moment.half())


def _handed(last: _State, ids: Tensor) -> Tensor:
    """The moments of splats by their numbers; minus infinity for new ones."""
    known, order = last.ids.sort()
    place = torch.searchsorted(known, ids).clamp(max=known.shape[0] - 1)
    moment = last.moment[order][place]
    return torch.where(known[place] == ids, moment, -torch.inf)


def _candidates(skin: Tensor, liquid: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Rows of ``skin`` [N, 3] near some of ``liquid`` [L, 3], and those of it that may be near."""
    low, high = skin.amin(dim=0) - reach, skin.amax(dim=0) + reach
    liquid = liquid[((liquid > low) & (liquid < high)).all(dim=1)]
    low = low - reach

    def keys(places: Tensor) -> Tensor:
        cell = ((places - low) / reach).long().clamp(0, _SIDE - 1)
        return (cell[:, 0] * _SIDE + cell[:, 1]) * _SIDE + cell[:, 2]

    step = torch.tensor([-1, 0, 1], device=skin.device)
    around = ((step[:, None, None] * _SIDE + step[:, None]) * _SIDE + step).flatten()
    wet = torch.unique(torch.unique(keys(liquid))[:, None] + around)
    if wet.numel() == 0:
        return wet, liquid
    mine = keys(skin)
    place = torch.searchsorted(wet, mine).clamp(max=wet.shape[0] - 1)
    return (wet[place] == mine).nonzero()[:, 0], liquid


def wet_colors(gaussians: Gaussians, wet: Tensor) -> Gaussians:
    """Splats as dark as they are wet [N].

    What a matt surface sends out is thrown back by the water on it, again and again, and is
    absorbed: of an albedo a remains ``a (1 - p) / (1 - p a)`` (Lekner and Dorf 1988).
    """
    rows = (wet > 0.0).nonzero()[:, 0]
    if rows.numel() == 0:
        return gaussians
    before = gaussians.select(rows).colors()
    albedo = to_linear(before).clamp(max=1.0)
    soaked = albedo * (1.0 - INTERNAL) / (1.0 - INTERNAL * albedo)
    after = to_display(torch.lerp(albedo, soaked, wet[rows, None].to(albedo)))
    factor = after / before.clamp(min=1.0 / 255.0)
    sh = gaussians.sh[rows] * factor[:, None].to(gaussians.sh)
    sh[:, 0] = rgb_to_sh0(after).to(sh)
    return gaussians.replace(sh=gaussians.sh.index_copy(0, rows, sh))


def wet_gloss(gloss: Tensor, wet: Tensor) -> Tensor:
    """k_s and n_s [N, 2] of splats as glossy as they are wet [N]."""
    return torch.lerp(gloss, torch.maximum(gloss, gloss.new_tensor(GLOSS)), wet[:, None].to(gloss))
